"""Summary of SLAM of a data set in numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from omnibench.config import Model
from omnibench.data.dataset import Dataset
from omnibench.robot.kinematics import Array, interpolated
from omnibench.slam.accuracy import SlamAccuracy
from omnibench.slam.slam_run import SlamPath

_SAME_TIME = 1e-6  # s: rounding of stamps; poses that are nearer in time are of the same time


class Distances(Model):
    """Distances between two sets of poses of the same runs and times, without the start poses."""

    poses: int
    position_mean_m: float
    position_p95_m: float
    heading_mean_rad: float
    heading_p95_rad: float


class SlamSummary(Model):
    """SLAM of a data set. Deviations are the standard deviations that SLAM states for the runs' last poses."""

    dataset: str
    simulated: bool
    runs: int
    scans: int
    matched_mean: float = Field(description="share of a scan's points that lie on the map, mean over all scans")
    matched_min: float = Field(description="matched share of the worst scan")
    position_deviation_mean_m: float = Field(description="along the least certain direction; mean over runs")
    position_deviation_max_m: float = Field(description="along the least certain direction; worst run")
    heading_deviation_mean_rad: float
    heading_deviation_max_rad: float
    recorded: Distances | None = Field(
        description="distance from the poses that the data set held before; None: not comparable"
    )
    accuracy: SlamAccuracy | None = Field(description="against the truth of a simulation, if that is known")
    warnings: tuple[str, ...]


def summarise(
    before: Dataset, after: Dataset, paths: Sequence[SlamPath], accuracy: SlamAccuracy | None = None
) -> SlamSummary:
    """Summary of SLAM. before: the data set with its recorded poses. after: with the poses of ``paths``."""
    matched = np.concatenate([path.matched for path in paths])
    last = np.array([path.covariances[-1] for path in paths])
    position = np.sqrt(np.linalg.eigvalsh(last[:, :2, :2])[:, -1])
    heading = np.sqrt(last[:, 2, 2])
    return SlamSummary(
        dataset=after.name,
        simulated=after.simulated,
        runs=len(paths),
        scans=sum(len(before.scans.times(run.id)) for run in before.trajectories) if before.scans else 0,
        matched_mean=float(matched.mean()),
        matched_min=float(matched.min()),
        position_deviation_mean_m=float(position.mean()),
        position_deviation_max_m=float(position.max()),
        heading_deviation_mean_rad=float(heading.mean()),
        heading_deviation_max_rad=float(heading.max()),
        recorded=distances(before, after),
        accuracy=accuracy,
        warnings=after.warnings,
    )


def distances(one: Dataset, other: Dataset) -> Distances | None:
    """Distances between the reference poses of two data sets of the same runs; None when they have no common times.

    Compared at the stamps of the data set with fewer poses; the other's poses are interpolated by straight lines.
    """
    differences = [
        _apart((mine.pose_times, mine.poses), (theirs.pose_times, theirs.poses))
        for mine, theirs in zip(one.trajectories, other.trajectories, strict=True)
    ]
    errors = np.concatenate(differences)
    if not len(errors):
        return None
    position = np.hypot(errors[:, 0], errors[:, 1])
    heading = np.abs(errors[:, 2])
    return Distances(
        poses=len(errors),
        position_mean_m=float(position.mean()),
        position_p95_m=float(np.quantile(position, 0.95)),
        heading_mean_rad=float(heading.mean()),
        heading_p95_rad=float(np.quantile(heading, 0.95)),
    )


def _apart(one: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
    """Differences (K, 3) at the common times after the start; only whole turns at the start are taken away."""
    (times, poses), (dense_times, dense) = sorted((one, other), key=lambda path: len(path[0]))
    common = (times > _SAME_TIME) & (times >= dense_times[0] - _SAME_TIME) & (times <= dense_times[-1] + _SAME_TIME)
    turns = np.round((poses[0, 2] - dense[0, 2]) / (2 * np.pi))
    return poses[common] - interpolated(times[common], dense_times, dense) - [0.0, 0.0, 2 * np.pi * turns]
