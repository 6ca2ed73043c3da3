"""SLAM of a whole data set: reference poses of every run from its scans."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.scans import Scanner, TrajectoryScans
from omnibench.errors import DataError, OmnibenchError
from omnibench.jobs.job import Failure, Job, JobWatch, ResultStore, code_digest, content_key, run_jobs
from omnibench.jobs.local_backends import local_backend
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.kinematics import Array, relative
from omnibench.robot.model import OdometryModel
from omnibench.slam.motion_prior import length, odometry_deviations
from omnibench.slam.pose_errors import FLOOR, PathWarning, merged_warning
from omnibench.slam.slam_options import PRELOAD, SlamOptions
from omnibench.slam.slam_run import SlamPath, run_slam

_AT_START = 1e-6  # s: rounding of stamps; a scan that is nearer to t = 0 counts as taken at t = 0
# s between the odometry poses whose distances add up to the way before the first scan. Coarser and finer steps measure
# the same way up to its bends: 0.1 s on a circle at 1 rad/s shorten it by 0.04 % (the chord, 1 - (w t)^2 / 24).
_STEP = 0.05
_FAR = 5e-3  # m: a longer way before the first scan is warned of; poses of SLAM are known to 1 mm (slam_study.py)


def slam_dataset(
    dataset: Dataset,
    options: SlamOptions,
    *,
    model: OdometryModel | None = None,
    workers: int = 2,
    watch: Reporter = no_progress,
) -> Dataset:
    """The data set with poses, pose times and covariances computed from its scans; each run keeps its start pose.

    Arguments and errors are those of ``slam_paths``, warnings those of ``with_paths``.
    """
    return with_paths(dataset, slam_paths(dataset, options, model=model, workers=workers, watch=watch))


def slam_paths(
    dataset: Dataset,
    options: SlamOptions,
    *,
    model: OdometryModel | None = None,
    workers: int = 2,
    folder: Path | None = None,
    watch: Reporter = no_progress,
) -> list[SlamPath]:
    """The path of every run by SLAM, from its start pose on.

    model: the odometry that the search starts from; default: the robot's design matrix, in arcs. workers: processes;
    the result does not depend on their number. folder: of the paths that are found already and not searched again;
    default: a temporary one. watch: told of every run that ends. DataError in one line: the data set or one of its
    runs has no scans, or they are bad.
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
        _Run(trajectory, scans.of(trajectory.id), scans.scanner, options, model, dataset.name).job()
        for trajectory in dataset.trajectories
    )
    paths = _Paths(dataset, watch)
    with _store(folder) as store:
        run_jobs(jobs, store, local_backend(min(workers, len(dataset.trajectories)), PRELOAD), paths)
    return [paths.found[number] for number in range(len(dataset.trajectories))]


@contextmanager
def _store(folder: Path | None) -> Iterator[ResultStore[SlamPath]]:
    if folder is not None:
        yield ResultStore(folder, SlamPath)
        return
    with TemporaryDirectory(prefix="omnibench-slam-") as temporary:
        yield ResultStore(Path(temporary), SlamPath)


class _Paths(JobWatch[SlamPath]):
    """The paths found so far, by the numbers of their runs."""

    def __init__(self, dataset: Dataset, report: Reporter) -> None:
        self.found: dict[int, SlamPath] = {}
        self._dataset, self._report = dataset, report
        self._tell()

    def ended(self, number: int, ending: SlamPath | Failure, reused: bool) -> None:  # noqa: ARG002
        if isinstance(ending, Failure):
            run = self._dataset.trajectories[number].id
            raise ending.error or OmnibenchError(
                f"data set {self._dataset.name}: trajectory {run}: SLAM: {ending.reason}; is there too little memory?"
            )
        self.found[number] = ending
        self._tell()

    def _tell(self) -> None:
        self._report(Progress("SLAM", len(self.found), len(self._dataset.trajectories), "run"))


def with_paths(dataset: Dataset, paths: Sequence[SlamPath]) -> Dataset:
    """The data set with the poses, times and covariances of ``paths``, whose warnings are added to its own."""
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
    # One sentence for a problem that several runs have.
    by_problem: dict[str, list[tuple[str, PathWarning]]] = {}
    for trajectory, path in zip(dataset.trajectories, paths, strict=True):
        for warning in path.warnings:
            by_problem.setdefault(warning.problem, []).append((trajectory.id, warning))
    warnings = (
        f"SLAM: {merged_warning([warning for _, warning in concerned])}: {len(concerned)} of {len(paths)} runs, "
        f"e.g. {', '.join(run for run, _ in concerned[:3])}"
        for concerned in by_problem.values()
    )
    return replace(made, warnings=(*made.warnings, *warnings))


@dataclass(frozen=True, eq=False)
class _Run:
    """A run of the data set called ``dataset``, and how its path is searched."""

    trajectory: Trajectory
    scans: TrajectoryScans
    scanner: Scanner
    options: SlamOptions
    model: OdometryModel
    dataset: str

    def job(self) -> Job[SlamPath]:
        """The search for its path; the key covers all that the path depends on."""
        model = self.model
        facts = {
            "run": self.trajectory,
            "scans": self.scans,
            "scanner": self.scanner,
            "options": self.options,
            "model": [model.robot, model.matrix, model.integration, model.sample_period],
            "terms": [[term.name, dict(term.values)] for term in model.terms],
            "code": _code(),
        }
        return Job(content_key(facts), _locate, self)


@cache
def _code() -> str:
    """Hash of the code that a path depends on."""
    package = Path(__file__).parents[1]
    return code_digest(package, (file for room in ("robot", "data", "slam") for file in (package / room).rglob("*.py")))


def _locate(run: _Run, _: Reporter) -> SlamPath:
    """The path of one run from t = 0 on."""
    trajectory = run.trajectory
    kept = run.scans.times >= -_AT_START
    scans = TrajectoryScans(np.maximum(run.scans.times[kept], 0.0), run.scans.ranges[kept])

    def odometry(times: Array) -> Array:
        stamps, place = np.unique(times, return_inverse=True)
        return run.model.poses([trajectory.log(stamps)])[0][place]

    try:
        if not len(scans.times):
            raise DataError("SLAM: no scan at or after t = 0")
        if scans.times[0] <= _AT_START:
            return run_slam(scans, run.scanner, run.options, trajectory.start, odometry)
        # The way along x and y and the turn before the first scan, m, m, rad; motion back and forth adds up.
        until = float(scans.times[0])
        poses = odometry(np.linspace(0.0, until, 2 + int(until / _STEP)))
        driven = np.sum([np.abs(relative(one, other)) for one, other in pairwise(poses)], axis=0)
        deviations = odometry_deviations(driven, run.options.odometry_error)
        path = run_slam(scans, run.scanner, run.options, poses[-1], odometry, deviations)
    except DataError as error:
        raise DataError(f"data set {run.dataset}: trajectory {trajectory.id}: {error}") from None
    # The start pose at t = 0 stands before the path of a run whose first scan comes later.
    late = "the robot moves before the first scan, whose pose is therefore as uncertain as the odometry"
    return replace(
        path,
        warnings=(*path.warnings, PathWarning(late)) if length(driven) > _FAR else path.warnings,
        times=np.concatenate([[0.0], path.times]),
        poses=np.vstack([trajectory.start, path.poses]),
        covariances=np.concatenate([FLOOR[None], path.covariances]),
        matched=np.concatenate([path.matched[:1], path.matched]),
    )


def _with_path(trajectory: Trajectory, path: SlamPath) -> Trajectory:
    symmetric = (path.covariances + np.swapaxes(path.covariances, 1, 2)) / 2  # data sets hold symmetric covariances
    return replace(trajectory, pose_times=path.times, poses=path.poses, pose_covariances=symmetric)
