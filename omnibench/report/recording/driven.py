"""The choice of runs that a report shows, and their names."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.scans import Scanner, TrajectoryScans
from omnibench.report.blocks import LegendItem
from omnibench.report.numbers import fixed, motion_in_words
from omnibench.report.style import INK, PALETTE, REFERENCE, THEORETICAL
from omnibench.robot.kinematics import Array, compose, interpolated
from omnibench.robot.model import OdometryModel

_SHOWN = 4  # runs, where kinds of motion are not known
_STRAIGHT = 1e-3  # rad/s; a slower turn counts as straight
ON_THE_SPOT = "on the spot"


def describe(trajectory: Trajectory) -> str:
    """A trajectory's motion command as the paper writes it; without one, its name."""
    if trajectory.alpha is None or trajectory.omega is None:
        command = "" if trajectory.command is None else f"{trajectory.command}, "
        return f"{command}{trajectory.id}"
    speed = "" if trajectory.v is None else f"{trajectory.v:.3g} m/s, "
    turn = fixed(trajectory.omega, 2)
    return f"({speed}{math.degrees(trajectory.alpha):.0f}°, {turn} rad/s), {trajectory.id}"


def representative_runs(dataset: Dataset) -> dict[str, Trajectory]:
    """One run of each kind of motion (straight, turning left, turning right, on the spot), by a name that says which.

    The run chosen of a kind has the median final position error of the design odometry. Where the data set has
    scans, only runs with scans are chosen. Where commands are unknown or of one kind: runs spread over the recording.
    """
    runs: Sequence[Trajectory] = dataset.trajectories
    if dataset.scans is not None:
        scanned = set(dataset.scans.trajectories)
        runs = [run for run in runs if run.id in scanned]
    design = OdometryModel.of_design(dataset.robot, "arc")
    by_kind = {kind: _of_median_error(like, design) for kind, like in kinds_of(runs).items()}
    if len(by_kind) > 1:
        return {f"{kind}: {describe(run)}": run for kind, run in by_kind.items()}
    return {describe(run): run for run in spread(runs)}


def motion_titles(runs: Sequence[Trajectory]) -> dict[str, Trajectory]:
    """Runs by their motions in words, with their names where motions are not known or alike."""
    words = [motion_in_words(run.id, run.v, run.alpha, run.omega) for run in runs]
    unique = len(set(words)) == len(words)
    return {name if unique else f"{name}, {run.id}": run for name, run in zip(words, runs, strict=True)}


def spread(runs: Sequence[Trajectory], number: int = _SHOWN) -> list[Trajectory]:
    """Some runs, evenly spaced, the first and the last among them."""
    picks = np.unique(np.linspace(0, len(runs) - 1, min(number, len(runs))).round().astype(int))
    return [runs[index] for index in picks]


def kinds_of(runs: Sequence[Trajectory]) -> dict[str, list[Trajectory]]:
    """The runs of each kind of commanded motion; of turning ones only those at the highest rate."""
    kinds: dict[str, list[Trajectory]] = {"straight": [], "turning left": [], "turning right": [], ON_THE_SPOT: []}
    for run in runs:
        if run.omega is None or run.alpha is None:
            continue
        turns = abs(run.omega) >= _STRAIGHT
        if run.v == 0 and turns:
            kinds[ON_THE_SPOT].append(run)
        elif run.v != 0:
            kinds["straight" if not turns else "turning left" if run.omega > 0 else "turning right"].append(run)
    fastest = {kind: max((abs(run.omega or 0.0) for run in like), default=0.0) for kind, like in kinds.items()}
    return {
        kind: [run for run in like if kind == "straight" or math.isclose(abs(run.omega or 0.0), fastest[kind])]
        for kind, like in kinds.items()
        if like
    }


def _of_median_error(runs: Sequence[Trajectory], odometry: OdometryModel) -> Trajectory:
    ends = odometry.poses([run.final_log for run in runs])
    errors = [math.hypot(*(end[-1, :2] - run.final_pose[:2])) for end, run in zip(ends, runs, strict=True)]
    return runs[int(np.argsort(errors)[(len(errors) - 1) // 2])]


SCANS, TRUTH, COVARIANCE, PLAN = "#7c8894", INK, PALETTE[0], "#b8977e"

REFERENCE_ITEM = LegendItem("reference", "reference poses", REFERENCE)
ODOMETRY_ITEM = LegendItem("odometry", "odometry by the design values", THEORETICAL, "dash")
TRUTH_ITEM = LegendItem("truth", "true path", TRUTH, "dot")
SCANS_ITEM = LegendItem("scans", "scan points", SCANS)
PLAN_ITEM = LegendItem("plan", "floor plan (truth)", PLAN)
COVARIANCE_ITEM = LegendItem("covariance", "covariance", COVARIANCE)


_GOES_ON = 0.1  # s of motion after the last pose: longer than a scan takes


def poses_at(trajectory: Trajectory, times: Array) -> Array:
    """Reference poses (..., 3) interpolated linearly at times (...), s.

    Before the first pose the robot rests; after the last one it keeps its velocity for 0.1 s.
    """
    stamps, poses = trajectory.pose_times, trajectory.poses
    if len(stamps) > 1:
        velocity = (poses[-1] - poses[-2]) / (stamps[-1] - stamps[-2])
        stamps, poses = np.append(stamps, stamps[-1] + _GOES_ON), np.vstack([poses, poses[-1] + velocity * _GOES_ON])
    return interpolated(times, stamps, poses)


def scan_points(trajectory: Trajectory, scanner: Scanner, scans: TrajectoryScans, scan: int, stride: int = 1) -> Array:
    """Points (n, 2) of one scan's walls, m; each ray starts at the reference pose of the time when it was measured."""
    ranges = scans.ranges[scan]
    seen = np.flatnonzero(scanner.valid(ranges) & ~scanner.on_floor(ranges))
    seen = seen[seen % stride == 0]
    poses = compose(poses_at(trajectory, scans.times[scan] + scanner.delays[seen]), scanner.mount.pose)
    directions = poses[:, 2] - scanner.mount.yaw + scanner.bearings[seen]
    over_the_floor = (ranges[seen] * scanner.level_shares[seen])[:, None]
    points: Array = poses[:, :2] + over_the_floor * np.column_stack([np.cos(directions), np.sin(directions)])
    return points


def evenly(count: int, limit: int) -> Array:
    """At most ``limit`` of the indices 0 to ``count`` - 1, evenly spaced, the first and the last among them."""
    picks: Array = np.unique(np.linspace(0, count - 1, min(limit, count)).round().astype(int))
    return picks


def thinned(points: Array, limit: int, cell: float = 0.01) -> Array:
    """At most ``limit`` of the points (n, 2): one for each occupied cell of a grid (``cell`` m), widened as needed."""
    while True:
        _, first = np.unique(np.round(points / cell).astype(np.int64), axis=0, return_index=True)
        if len(first) <= limit:
            kept: Array = points[np.sort(first)]
            return kept
        cell *= 1.25
