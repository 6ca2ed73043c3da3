"""SLAM of a run, whose scans one after another become poses and a map, and of every run of a data set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.scans import Ranges, Scanner, TrajectoryScans
from omnibench.errors import DataError, OmnibenchError
from omnibench.jobs.job import Failure, Job, JobWatch, ResultStore, code_digest, content_key, run_jobs
from omnibench.jobs.job_process import local_backend
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.kinematics import Array, JsonArray, relative
from omnibench.robot.model import OdometryModel
from omnibench.slam.motion_prior import (
    LastPosePrior,
    MotionPrior,
    MotionWithinScan,
    OdometryPrior,
    length,
    odometry_deviations,
)
from omnibench.slam.pose_errors import FLOOR, PathWarning, PoseErrors, merged_warning, path_warnings
from omnibench.slam.scan_matching import Match, ScanMap, ScanPoints, noise_factor, refine, scan_points, search
from omnibench.slam.slam_options import PRELOAD, SlamOptions

# The study tests/studies/constants_slam.py varies these numbers by 0.5 and 2. In three rooms _SKEWED moves poses by
# 0.2 of their deviations at most, the others not at all.
_SKEWED = 1e-3  # m or rad of unknown motion between a scan's first and last ray: less does not matter
_CORRECTIONS = 4  # times at most that the motion within a scan is corrected
_KEYFRAMES = 300  # keyframes with an error of their own: older ones are merged, so that the time of a step is limited
_SAMPLE = 100  # scans that the noise of ranges is estimated from
_NEEDED = 0.6  # share of matched points: with fewer, the scan goes into the map even if it may be skewed


@dataclass(frozen=True, eq=False)
class SlamPath:
    """Poses of the robot at the stamps of its scans.

    times (S,): s. poses (S, 3): m, m, rad, in the run's frame, headings continuous. covariances (S, 3, 3).
    matched (S,): share of each scan's points that lie on the map. warnings: what went wrong.
    """

    times: JsonArray
    poses: JsonArray
    covariances: JsonArray
    matched: JsonArray
    warnings: tuple[PathWarning, ...] = ()


def run_slam(
    scans: TrajectoryScans,
    scanner: Scanner,
    options: SlamOptions,
    start: Array,
    odometry: Callable[[Array], Array] | None = None,
    deviations: Array | None = None,
) -> SlamPath:
    """The poses at which a run's scans lie best on the map that they make.

    start (3,): the robot's pose at the first scan. odometry: function from times (K,) >= 0, s, to poses (K, 3) in any
    frame. Only its increments are used: to start the search, to deskew, and along directions that scans do not
    measure. It is needed unless the search starts from the last pose. deviations (3,): standard deviations of the
    start pose along the robot's axes, m, m, rad; default: it is exact. DataError in one line: no scan, or one without
    returns.
    """
    if len(scans.times) == 0:
        raise DataError("SLAM: there is no scan")
    if scans.ranges.shape != (len(scans.times), scanner.rays):
        raise DataError(
            f"SLAM: ranges have shape {scans.ranges.shape}, expected {(len(scans.times), scanner.rays)}: scans, rays"
        )
    walls = scanner.valid(scans.ranges) & ~scanner.on_floor(scans.ranges)
    for index in np.flatnonzero(~walls.any(axis=1))[:1]:
        floor = ", but of the floor" if scanner.valid(scans.ranges[index]).any() else ""
        raise DataError(
            f"SLAM: the scan at {scans.times[index]:g} s is empty: no range from {scanner.range_min:g} to "
            f"{scanner.range_max:g} m{floor}; leave it out"
        )
    if options.start == "odometry" and odometry is None:
        raise DataError("SLAM: start is odometry, but there is none; choose start: last_pose")
    duration = float(scanner.delays[-1])
    motion: MotionPrior = LastPosePrior(scans.times, duration, options)
    if options.start == "odometry" and odometry is not None:
        motion = OdometryPrior(odometry, scans.times, duration, options)
    noise = noise_factor(scans.ranges[:: 1 + len(scans.times) // _SAMPLE], scanner)
    errors = PoseErrors(start, deviations)
    slam = _Slam(scanner, noise, options, motion, np.asarray(start, dtype=float), errors)
    located = [slam.begin(scans.ranges[0])]
    located += [slam.go_on(number, ranges) for number, ranges in enumerate(scans.ranges[1:], 1)]
    # Among the times of scans several may be equal.
    stamps, place = np.unique(scans.times, return_inverse=True)
    return SlamPath(
        scans.times,
        np.array([match.pose for match, _ in located]),
        np.array([covariance for _, covariance in located]),
        np.array([match.matched for match, _ in located]),
        path_warnings([match for match, _ in located], options, None if odometry is None else odometry(stamps)[place]),
    )


class _Slam:
    """SLAM in progress: the map so far, the last pose, and the errors of both."""

    def __init__(
        self,
        scanner: Scanner,
        noise: float,
        options: SlamOptions,
        motion: MotionPrior,
        start: Array,
        errors: PoseErrors,
    ) -> None:
        self._scanner, self._noise, self._options, self._motion = scanner, noise, options, motion
        self._map = ScanMap(options.spacing)
        self._errors = errors
        self._pose = self._keyframe = start

    def begin(self, ranges: Ranges) -> tuple[Match, Array]:
        """The first scan, with which the map begins, at the start pose; its covariance (3, 3)."""
        within, deviations = self._motion.first()
        if not self._options.deskew:
            deviations = within.mean
        scan = self._points(ranges, within)
        self._add(scan, deviations)
        match = replace(refine(self._map, scan, self._pose, self._pose, self._options), pose=self._pose)
        # Uncertainty of the start pose, and of this scan, to which the following are matched.
        scatter = np.linalg.inv(match.information + np.diag(self._options.limits**-2.0))
        return match, self._errors.covariance + scatter

    def go_on(self, number: int, ranges: Ranges) -> tuple[Match, Array]:
        """The next scan: its match and the covariance of its pose (3, 3)."""
        options, motion, last = self._options, self._motion, self._pose
        predicted = motion.predict(number, last)
        scan = self._points(ranges, predicted.within)
        pose = search(self._map, scan, predicted.start, options)
        raw = scan
        correction: Array = np.zeros(3)
        for _ in range(_CORRECTIONS):
            pose = refine(self._map, scan, pose, predicted.start, options, steps=1).pose
            before = correction
            correction, deviations = motion.correct(number, last, pose, before)
            if not options.deskew:
                deviations = predicted.within.mean + correction  # the motion that is not undone
                break
            scan = raw.deskewed(correction)
            if not self._skews(correction - before):
                break
        match = refine(self._map, scan, pose, predicted.start, options)
        covariance = self._errors.step(match, predicted.deviations, deviations)
        self._pose = match.pose
        # New surfaces once the robot has come far enough; a scan that may be skewed waits while it can.
        x, y, turned = match.pose - self._keyframe
        far = np.hypot(x, y) > self._options.keyframe_distance or abs(turned) > self._options.keyframe_angle
        if bool(far and (match.matched < _NEEDED or not self._skews(deviations))) or not self._map.is_usable:
            self._add(scan, deviations)
        return match, covariance

    def _skews(self, twist: Array) -> bool:
        """True if an error (3,) of the twist during a scan, m/s, m/s, rad/s, matters."""
        return bool(np.abs(twist).max() * self._scanner.delays[-1] > _SKEWED)

    def _points(self, ranges: Ranges, within: MotionWithinScan) -> ScanPoints:
        still = MotionWithinScan.steady(np.zeros(3), within.duration)
        return scan_points(ranges, self._scanner, self._noise, within if self._options.deskew else still)

    def _add(self, scan: ScanPoints, deviations: Array) -> None:
        """Make the last pose a keyframe, if its scan saw something new.

        deviations (3,): standard deviations of the twist within the scan, m/s, m/s, rad/s.
        """
        self._keyframe = self._pose
        if not self._map.add(scan.lines, self._pose, self._errors.keyframes):
            return
        self._errors.keep(deviations * self._scanner.delays[-1] / 2)
        if self._errors.keyframes > _KEYFRAMES:
            self._map.merge_oldest()
            self._errors.merge_oldest()


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
