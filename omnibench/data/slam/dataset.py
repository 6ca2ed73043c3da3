"""SLAM of a whole data set: every run's reference poses from its scans alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.scans import Scanner, TrajectoryScans
from omnibench.data.slam.doubts import Doubt, together
from omnibench.data.slam.options import SlamOptions
from omnibench.data.slam.run import SlamPath, run_slam
from omnibench.errors import DataError
from omnibench.processes import in_processes
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel

_AT_START = 1e-6  # s; a scan that is nearer to t = 0 is taken there
_FEW = 0.5  # of the points: runs in which fewer match are named

Watch = Callable[[str, int, int], None]


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
        begin = float(scans.times[0])
        late = begin > _AT_START
        start = odometry(np.array([begin]))[0] if late else trajectory.start
        path = run_slam(scans, job.scanner, job.options, start, odometry)
    except DataError as error:
        raise DataError(f"data set {job.dataset}: trajectory {trajectory.id}: {error}") from None
    return _from_start(path, trajectory.start) if late else path


def _from_start(path: SlamPath, start: Array) -> SlamPath:
    """The path with a row for t = 0, when the first scan came later."""
    return replace(
        path,
        times=np.concatenate([[0.0], path.times]),
        poses=np.vstack([start, path.poses]),
        covariances=np.concatenate([path.covariances[:1], path.covariances]),
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
