"""SLAM of a run, whose scans one after another become poses and a map, and of every run of a data set.

Covariance of the poses of SLAM and of the map that they made: a Schmidt-Kalman (consider) filter.

A consider filter counts errors that it does not correct, with their correlations (Schmidt, Application of state-space
methods to navigation problems, Adv. Control Systems 3:293, 1966; Jazwinski, Stochastic Processes and Filtering Theory,
1970, section 8.4; Woodbury and Junkins, On the consider Kalman filter, AIAA 2010-7752). Here these are

    x = (mu, xi_0, ..., xi_m, xi)   with the covariance P,                                        (P1)

mu the error of the motion in units of its standard deviation, the same in the whole run, xi_j that of keyframe j and xi
that of the last pose. Each xi is a small motion of the whole run's frame (m, m, rad), which moves a pose p by

    dp = D(p) xi,   D(p) = [1 0 -y; 0 1 x; 0 0 1].                                                (P2)

The search for the next pose starts where the motion since the last pose p', with standard deviations s along the
robot's axes T(p'), leads. Errors of the motion act at its beginning:

    d_start = D(p) xi + D(p) D(p')^-1 T(p') diag(s) mu.                                           (P3)

The scan moves the pose from there by the gain G towards the pose of least squares, p = start + G (p* - start). With
I_j the part of the information I that lies on surfaces of keyframe j, n the noise of the gradient (covariance S) and K
its derivative by a twist within the scan, whose standard deviations are k along the robot's axes,

    d_p* = I^-1 (sum_j I_j D(p) xi_j + n + K T(p) diag(k) nu),   cov(nu) = 1                      (P4)
    d_p  = (1 - G) d_start + W sum_j I_j D(p) xi_j + W (n + K T(p) diag(k) nu),   W = G I^-1.     (P5)

The first two terms are R x, so that the covariance of the pose, and that with all other errors, is

    cov(d_p) = R P R' + W S W' + (W K T diag(k)) (W K T diag(k))'                                 (P6)
    cov(d_p, x) = R P,   xi = D(p)^-1 d_p.                                                        (P7)
"""

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
from omnibench.robot.kinematics import Array, JsonArray, relative, rotation
from omnibench.robot.model import OdometryModel
from omnibench.slam import motion_prior
from omnibench.slam.scan_matching import LOST, Match, ScanMap, ScanPoints, noise_factor, refine, scan_points, search
from omnibench.slam.slam_options import PRELOAD, SlamOptions

# The study tests/studies/constants_slam.py varies these numbers by 0.5 and 2. In three rooms, in round ones, with a
# quick robot and with a mirrored scanner the warnings stay the same, except that _DEGENERATE = 1 warns always and
# _BEYOND = 10 misses the mirrored scanner.
_DEGENERATE = 0.5  # observability below which a direction counts as not measured by a scan
_OFTEN = 0.1  # share of a run's scans that may be degenerate without a warning
_BEYOND = 5.0  # times the odometry's stated error: a larger disagreement is no error of calibration
_NOISE = 0.01  # m: noise of the motion between two poses of SLAM, at most
_MOST_SHARE = 10.0  # largest disagreement that is reported: the odometry may even stand still
_FEWEST = 3  # motions that are needed for a judgement


@dataclass(frozen=True)
class PathWarning:
    """A problem of one run, or of several.

    along: its direction, if it has one, as the square of x + iy in the run's frame: a direction and its opposite have
    the same square, so that squares of several runs can be added up. share: size of the problem, if it has one; it is
    put where the problem's text has {share}.
    """

    problem: str
    along: complex | None = None
    share: float | None = None

    def __str__(self) -> str:
        if self.share is not None:
            return self.problem.format(share=f"{100 * self.share:.0f} %")
        if self.along is None:
            return self.problem
        degrees = round(float(np.degrees(np.angle(self.along)) / 2)) % 180
        return f"{self.problem} along {degrees} deg of the run's frame"


def path_warnings(matches: Sequence[Match], options: SlamOptions, odometry: Array | None) -> tuple[PathWarning, ...]:
    """Warnings about a run. odometry (S, 3): poses at the stamps of its scans, if it has any."""
    return (*_weak_matches(matches), *([] if odometry is None else _disagreement(matches, options, odometry)))


def merged_warning(warnings: Sequence[PathWarning]) -> PathWarning:
    """One warning for several runs with one problem: along their mean direction, with the mean of their shares."""
    directions = [warning.along for warning in warnings if warning.along is not None]
    shares = [warning.share for warning in warnings if warning.share is not None]
    return PathWarning(
        warnings[0].problem, sum(directions) if directions else None, sum(shares) / len(shares) if shares else None
    )


def _weak_matches(matches: Sequence[Match]) -> Iterator[PathWarning]:
    if any(match.matched < LOST for match in matches):
        yield PathWarning("less than a fifth of a scan lies on the map, and its pose is the start of the search")
    degenerate = [match for match in matches if match.matched >= LOST and match.observability.min() < _DEGENERATE]
    if len(degenerate) <= _OFTEN * len(matches):
        return
    worst = np.array([match.directions[:, match.observability.argmin()] for match in degenerate])
    x, y, heading = worst.T
    if (np.abs(heading) > np.hypot(x, y)).mean() > 0.5:
        yield PathWarning("scans tell too little of the heading")
    else:
        yield PathWarning("scans tell too little", complex(((x + 1j * y) ** 2).sum()))


def _disagreement(matches: Sequence[Match], options: SlamOptions, odometry: Array) -> Iterator[PathWarning]:
    """Compare motions from scan to scan in the robot's frame, so that an early error does not count again later."""
    motions = [
        (relative(*ours), relative(*theirs))
        for ours, theirs, measured in zip(
            pairwise(match.pose for match in matches),
            pairwise(odometry),
            pairwise(match.matched >= LOST and match.observability.min() >= _DEGENERATE for match in matches),
            strict=True,
        )
        if all(measured) or options.start == "odometry"  # else a direction that is not measured shows no motion
    ]
    if len(motions) < _FEWEST:
        return
    apart = _typical([ours - theirs for ours, theirs in motions])
    driven = _typical([theirs for _, theirs in motions])
    if apart > _BEYOND * options.odometry_error * driven + _NOISE:
        yield PathWarning(
            "poses and odometry disagree by {share} of the motion: is the scanner mirrored, or is its mount or the "
            "robot's wheels given wrongly?",
            share=min(apart / max(driven, _NOISE / _MOST_SHARE), _MOST_SHARE),
        )


def _typical(motions: Sequence[Array]) -> float:
    """Root mean square length of motions (3,), m."""
    return float(np.sqrt(np.mean([motion_prior.length(motion) ** 2 for motion in motions])))


# m^2, m^2, rad^2: least covariance that is stated, for a start pose that is exact by definition. A hundredth of the
# variances that poses of SLAM have (tests/studies/slam_study.py), so that a covariance can be inverted. Half of it
# and twice change stated deviations by 3 % at most (tests/studies/constants_slam.py).
FLOOR: Array = np.diag([1e-4, 1e-4, 1e-5]) ** 2


class PoseErrors:
    """The joint covariance of the motion's error, of every keyframe and of the last pose.

    start (3,): the first pose. moved (3,): standard deviations of the motion until then, in the robot's frame, m, m,
    rad; default: the first pose is exact.
    """

    def __init__(self, start: Array, moved: Array | None = None) -> None:
        # Errors of the motion, of every keyframe and of the last pose, three rows each. The motion's error, in units of
        # its standard deviation, is the same in the whole run.
        self._joint = np.zeros((6, 6))
        self._joint[:3, :3] = np.eye(3)
        self._pose = start
        if moved is not None:
            row = np.linalg.solve(_deviation(start), rotation(start[2]) * moved)  # Eq. (P2): xi = D^-1 T diag(s) mu
            self._joint[-3:, :3], self._joint[:3, -3:] = row, row.T
            self._joint[-3:, -3:] = _square(row)

    def step(self, match: Match, moved: Array, skew: Array) -> Array:
        """Go on to the pose of a match, and return its covariance (3, 3).

        moved (3,): standard deviations of the motion from the last pose to the start, in the robot's frame, m, m, rad.
        skew (3,): standard deviations of the twist within the scan, m/s, m/s, rad/s.
        """
        before, here = _deviation(self._pose), _deviation(match.pose)
        rest = np.eye(3) - match.gain
        row = np.zeros((3, len(self._joint)))  # R of Eq. (P5)
        row[:, :3] = rest @ here @ np.linalg.solve(before, rotation(self._pose[2]) * moved)  # Eq. (P3)
        row[:, -3:] = rest @ here
        for keyframe, part in match.by_keyframe.items():
            row[:, 3 + 3 * keyframe : 6 + 3 * keyframe] += match.weight @ part @ here
        noise = match.weight @ match.scatter @ match.weight.T + _square(
            match.weight @ match.delayed @ (rotation(match.pose[2]) * skew)
        )
        covariance = row @ self._joint @ row.T + noise  # Eq. (P6)
        back = np.linalg.inv(here)  # Eq. (P7)
        across = back @ row @ self._joint[:, :-3]
        self._joint[-3:, :-3], self._joint[:-3, -3:] = across, across.T
        self._joint[-3:, -3:] = back @ covariance @ back.T
        self._pose = match.pose
        return covariance + FLOOR

    @property
    def covariance(self) -> Array:
        """Covariance of the last pose (3, 3)."""
        here = _deviation(self._pose)
        return here @ self._joint[-3:, -3:] @ here.T + FLOOR

    @property
    def keyframes(self) -> int:
        """Number of keyframes."""
        return len(self._joint) // 3 - 2

    def keep(self, skewed: Array | None = None) -> None:
        """Make the last pose a keyframe.

        skewed (3,): standard deviations of the shift of what its scan saw, along the robot's axes, m, m, rad; default:
        none.
        """
        size = len(self._joint)
        every = np.concatenate([np.arange(size), np.arange(size - 3, size)])
        self._joint = self._joint[np.ix_(every, every)]
        if skewed is not None:
            kept = slice(size - 3, size)
            self._joint[kept, kept] += _square(
                np.linalg.solve(_deviation(self._pose), rotation(self._pose[2]) * skewed)
            )

    def merge_oldest(self) -> None:
        """Remove keyframe 0; the next one, whose error is larger, stands for it."""
        others = np.delete(np.arange(len(self._joint)), [3, 4, 5])
        self._joint = self._joint[np.ix_(others, others)]


def _square(matrix: Array) -> Array:
    return matrix @ matrix.T


def _deviation(pose: Array) -> Array:
    """Derivative (3, 3) of a pose with respect to a small motion of the run's frame."""
    return np.array([[1.0, 0.0, -pose[1]], [0.0, 1.0, pose[0]], [0.0, 0.0, 1.0]])


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
    motion: motion_prior.MotionPrior = motion_prior.LastPosePrior(scans.times, duration, options)
    if options.start == "odometry" and odometry is not None:
        motion = motion_prior.OdometryPrior(odometry, scans.times, duration, options)
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
        motion: motion_prior.MotionPrior,
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

    def _points(self, ranges: Ranges, within: motion_prior.MotionWithinScan) -> ScanPoints:
        still = motion_prior.MotionWithinScan.steady(np.zeros(3), within.duration)
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
        deviations = motion_prior.odometry_deviations(driven, run.options.odometry_error)
        path = run_slam(scans, run.scanner, run.options, poses[-1], odometry, deviations)
    except DataError as error:
        raise DataError(f"data set {run.dataset}: trajectory {trajectory.id}: {error}") from None
    # The start pose at t = 0 stands before the path of a run whose first scan comes later.
    late = "the robot moves before the first scan, whose pose is therefore as uncertain as the odometry"
    return replace(
        path,
        warnings=(*path.warnings, PathWarning(late)) if motion_prior.length(driven) > _FAR else path.warnings,
        times=np.concatenate([[0.0], path.times]),
        poses=np.vstack([trajectory.start, path.poses]),
        covariances=np.concatenate([FLOOR[None], path.covariances]),
        matched=np.concatenate([path.matched[:1], path.matched]),
    )


def _with_path(trajectory: Trajectory, path: SlamPath) -> Trajectory:
    symmetric = (path.covariances + np.swapaxes(path.covariances, 1, 2)) / 2  # data sets hold symmetric covariances
    return replace(trajectory, pose_times=path.times, poses=path.poses, pose_covariances=symmetric)
