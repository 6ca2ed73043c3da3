"""How good reference poses are, judged by a simulation's hidden truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import Field

from omnibench.config import Model
from omnibench.data.dataset import Dataset
from omnibench.data.simulate.truth_poses import TruePath
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array


class ErrorSummary(Model):
    """Errors of poses. The bias is the mean error in the robot's frame, and what repeats in it is systematic."""

    poses: int
    position_mean_m: float
    position_p95_m: float
    position_max_m: float
    heading_mean_rad: float
    heading_p95_rad: float
    heading_max_rad: float
    bias_forward_m: float
    bias_left_m: float
    bias_heading_rad: float
    nees_mean: float | None = Field(description="mean of error' covariance^-1 error; 3 for an honest covariance")


class SlamAccuracy(Model):
    """Errors of the last pose of every run, and of all poses after the first, which is where the run starts."""

    runs: int
    distance_m: float = Field(description="driven in all")
    final: ErrorSummary
    every: ErrorSummary
    drift_position: float = Field(description="growth of the position's error, m per m driven")
    drift_heading: float = Field(description="growth of the heading's error, rad per m driven")


def slam_accuracy(poses: Dataset, truth: Mapping[str, TruePath]) -> SlamAccuracy:
    """Errors of a data set's reference poses against the true paths.

    DataError in one line: a run is not in the truth, or has no pose after its start.
    """
    runs = []
    for trajectory in poses.trajectories:
        if trajectory.id not in truth:
            raise DataError(f"data set {poses.name}: trajectory {trajectory.id} is not in the truth; is it of others?")
        path = truth[trajectory.id]
        times, found = trajectory.pose_times[1:], trajectory.poses[1:]
        if not len(times):
            raise DataError(f"data set {poses.name}: trajectory {trajectory.id} has no pose after its start")
        true = np.column_stack([np.interp(times, path.times, column) for column in path.poses.T])
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path.poses[:, :2], axis=0).T))])
        covariances = None if trajectory.pose_covariances is None else trajectory.pose_covariances[1:]
        runs.append(_Errors.of(found, true, covariances, np.interp(times, path.times, way)))
    return SlamAccuracy(
        runs=len(runs),
        distance_m=sum(float(run.way[-1]) for run in runs),
        final=_summary([run.last() for run in runs]),
        every=_summary(runs),
        drift_position=_growth(runs, [run.position for run in runs]),
        drift_heading=_growth(runs, [np.abs(run.in_robot[:, 2]) for run in runs]),
    )


class _Errors:
    """Of one run. in_robot (K, 3): along the robot's axes. way (K,): driven so far, m. nees (K,), if it is known."""

    def __init__(self, in_robot: Array, way: Array, nees: Array | None) -> None:
        self.in_robot, self.way, self.nees = in_robot, way, nees
        self.position = np.hypot(in_robot[:, 0], in_robot[:, 1])

    @classmethod
    def of(cls, found: Array, true: Array, covariances: Array | None, way: Array) -> _Errors:
        errors = found - true
        errors[:, 2] -= 2 * np.pi * np.round(errors[:, 2] / (2 * np.pi))
        nees = None
        if covariances is not None:
            nees = np.einsum("ki,ki->k", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])
        turned = (errors[:, 0] + 1j * errors[:, 1]) * np.exp(-1j * true[:, 2])
        return cls(np.column_stack([turned.real, turned.imag, errors[:, 2]]), way, nees)

    def last(self) -> _Errors:
        return _Errors(self.in_robot[-1:], self.way[-1:], None if self.nees is None else self.nees[-1:])


def _summary(runs: list[_Errors]) -> ErrorSummary:
    errors = np.concatenate([run.in_robot for run in runs])
    position, heading = np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2])
    nees = [run.nees for run in runs if run.nees is not None]
    forward, left, turned = errors.mean(axis=0).tolist()
    return ErrorSummary(
        poses=len(errors),
        position_mean_m=float(position.mean()),
        position_p95_m=float(np.quantile(position, 0.95)),
        position_max_m=float(position.max()),
        heading_mean_rad=float(heading.mean()),
        heading_p95_rad=float(np.quantile(heading, 0.95)),
        heading_max_rad=float(heading.max()),
        bias_forward_m=forward,
        bias_left_m=left,
        bias_heading_rad=turned,
        nees_mean=float(np.concatenate(nees).mean()) if nees else None,
    )


def _growth(runs: list[_Errors], sizes: list[Array]) -> float:
    """The slope k of size^2 = noise^2 + (k way)^2, by least squares; 0 where errors do not grow."""
    squares = np.concatenate(sizes) ** 2
    ways = np.concatenate([run.way for run in runs]) ** 2
    ways -= ways.mean()
    spread = float(ways @ ways)
    return float(np.sqrt(max(0.0, ways @ squares / spread))) if spread > 0 else 0.0
