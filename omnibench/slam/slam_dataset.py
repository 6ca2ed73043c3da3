"""SLAM of a whole data set: every run's reference poses from its scans."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.progress import Watch
from omnibench.data.scans import Scanner, TrajectoryScans
from omnibench.errors import DataError
from omnibench.processes import in_processes
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.planar import relative
from omnibench.slam.motion_prior import length, odometry_deviations
from omnibench.slam.path_warnings import Doubt, together
from omnibench.slam.pose_errors import FLOOR
from omnibench.slam.slam_options import SlamOptions
from omnibench.slam.slam_run import SlamPath, run_slam

_AT_START = 1e-6  # s; a scan that is nearer to t = 0 is taken there
_STEP = 0.05  # s between poses that the way before the first scan is added up from
_FAR = 5e-3  # m; who moves farther before the first scan is told


def slam_dataset(
    dataset: Dataset,
    options: SlamOptions,
    *,
    model: OdometryModel | None = None,
    workers: int = 2,
    watch: Watch | None = None,
) -> Dataset:
    """The data set with poses, pose times and covariances computed from its scans; each run keeps its start pose.

    As ``slam_paths`` and ``with_paths``. DataError as for them.
    """
    return with_paths(dataset, slam_paths(dataset, options, model=model, workers=workers, watch=watch))


def slam_paths(
    dataset: Dataset,
    options: SlamOptions,
    *,
    model: OdometryModel | None = None,
    workers: int = 2,
    watch: Watch | None = None,
) -> list[SlamPath]:
    """The path of every run, from its scans and from its start pose on.

    model: the odometry that the search starts from; default: the robot's design matrix, in arcs. workers: processes;
    the result does not depend on their number. watch: told what is done, how many runs of how many. DataError in one
    line: there are no scans, of some run or at all, or they are bad.
    """
    scans = dataset.scans
    if scans is None:
        raise DataError(f"data set {dataset.name}: it has no scans (scans.parquet), which SLAM needs")
    known = set(scans.trajectories)
    for trajectory in dataset.trajectories:
        if trajectory.id not in known:
            raise DataError(f"data set {dataset.name}: trajectory {trajectory.id} has no scans; leave it out for SLAM")
    model = model or OdometryModel.of_design(dataset.robot, "arc")
    jobs = (
        _Job(trajectory, scans.of(trajectory.id), scans.scanner, options, model, dataset.name)
        for trajectory in dataset.trajectories
    )
    total = len(dataset.trajectories)
    paths = []
    for path in in_processes(_locate, jobs, min(workers, total), preload=__name__):
        paths.append(path)
        if watch is not None:
            watch("SLAM", len(paths), total)
    return paths


def with_paths(dataset: Dataset, paths: Sequence[SlamPath]) -> Dataset:
    """The data set with the poses, times and covariances of ``paths``; what is doubtful is among its warnings."""
    made = make_dataset(
        dataset.name,
        dataset.robot,
        dataset.sample_period,
        [_with_path(trajectory, path) for trajectory, path in zip(dataset.trajectories, paths, strict=True)],
        description=dataset.description,
        source=dataset.source,
        licence=dataset.licence,
        simulated=dataset.simulated,
        scans=dataset.scans,
    )
    return replace(made, warnings=made.warnings + _doubts(dataset.trajectories, paths))


@dataclass(frozen=True, eq=False)
class _Job:
    trajectory: Trajectory
    scans: TrajectoryScans
    scanner: Scanner
    options: SlamOptions
    model: OdometryModel
    dataset: str


def _locate(job: _Job) -> SlamPath:
    """The path of one run from t = 0 on."""
    trajectory = job.trajectory
    kept = job.scans.times >= -_AT_START
    scans = TrajectoryScans(np.maximum(job.scans.times[kept], 0.0), job.scans.ranges[kept])

    def odometry(times: Array) -> Array:
        stamps, place = np.unique(times, return_inverse=True)
        return job.model.poses([trajectory.log(stamps)])[0][place]

    try:
        if not len(scans.times):
            raise DataError("SLAM: no scan at or after t = 0")
        if scans.times[0] <= _AT_START:
            return run_slam(scans, job.scanner, job.options, trajectory.start, odometry)
        before = _before_first_scan(odometry, float(scans.times[0]))
        deviations = odometry_deviations(before.driven, job.options.odometry_error)
        path = run_slam(scans, job.scanner, job.options, before.end, odometry, deviations)
        return _from_start(path, trajectory.start, before)
    except DataError as error:
        raise DataError(f"data set {job.dataset}: trajectory {trajectory.id}: {error}") from None


@dataclass(frozen=True, eq=False)
class _Before:
    """The motion from t = 0 to the first scan. driven (3,): m, m, rad, ways there and back added up. end (3,): pose."""

    driven: Array
    end: Array


def _before_first_scan(odometry: Callable[[Array], Array], until: float) -> _Before:
    poses = odometry(np.linspace(0.0, until, 2 + int(until / _STEP)))
    moved = [np.abs(relative(one, other)) for one, other in pairwise(poses)]
    return _Before(np.sum(moved, axis=0), poses[-1])


def _from_start(path: SlamPath, start: Array, before: _Before) -> SlamPath:
    """The path with a row for t = 0, when the first scan came later."""
    far = length(before.driven) > _FAR
    late = "the robot moves before the first scan, whose pose is therefore as uncertain as the odometry"
    return replace(
        path,
        doubts=(*path.doubts, Doubt(late)) if far else path.doubts,
        times=np.concatenate([[0.0], path.times]),
        poses=np.vstack([start, path.poses]),
        covariances=np.concatenate([FLOOR[None], path.covariances]),
        matched=np.concatenate([path.matched[:1], path.matched]),
    )


def _with_path(trajectory: Trajectory, path: SlamPath) -> Trajectory:
    symmetric = (path.covariances + np.swapaxes(path.covariances, 1, 2)) / 2  # as a data set holds them
    return replace(trajectory, pose_times=path.times, poses=path.poses, pose_covariances=symmetric)


def _doubts(trajectories: Sequence[Trajectory], paths: Sequence[SlamPath]) -> tuple[str, ...]:
    """What went wrong, the same of many runs in one sentence."""
    found: dict[str, list[tuple[str, Doubt]]] = {}
    for trajectory, path in zip(trajectories, paths, strict=True):
        for doubt in path.doubts:
            found.setdefault(doubt.problem, []).append((trajectory.id, doubt))
    return tuple(
        f"SLAM: {together([doubt for _, doubt in each])}: {len(each)} of {len(paths)} runs, "
        f"e.g. {', '.join(name for name, _ in each[:3])}"
        for each in found.values()
    )
