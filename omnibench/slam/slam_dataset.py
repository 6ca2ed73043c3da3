"""SLAM of a run, whose scans one after another become poses and a map, and of every run of a data set; its accuracy.

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

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from omnibench.config import Model, parse_settings, validate
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.scans import Ranges, Scanner, TrajectoryScans
from omnibench.data.storage import check_dataset_folder, load_dataset, save_dataset
from omnibench.data.true_poses import TruePath, read_true_poses, robot_of_truth
from omnibench.errors import ConfigError, DataError, Interrupted, OmnibenchError
from omnibench.files import TableFormat, refuse_existing, resolved
from omnibench.jobs.job import Failure, Job, JobWatch, ResultStore, code_digest, content_key, run_jobs
from omnibench.jobs.job_process import local_backend
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.calibration import read_calibration
from omnibench.robot.kinematics import Array, JsonArray, interpolated, moved_to, relative, rotated, rotation
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
    along: complex = 0j
    share: float | None = None

    def __str__(self) -> str:
        if self.share is not None:
            return self.problem.format(share=f"{100 * self.share:.0f} %")
        if not self.along:
            return self.problem
        degrees = round(float(np.degrees(np.angle(self.along)) / 2)) % 180
        return f"{self.problem} along {degrees} deg of the run's frame"


def path_warnings(matches: Sequence[Match], options: SlamOptions, odometry: Array | None) -> Iterator[PathWarning]:
    """Warnings about a run. odometry (S, 3): poses at the stamps of its scans, if it has any."""
    lost = [match.matched < LOST for match in matches]
    weak = [match.observability.min() < _DEGENERATE for match in matches]
    if any(lost):
        yield PathWarning("less than a fifth of a scan lies on the map, and its pose is the start of the search")
    degenerate = [match for match, is_lost, is_weak in zip(matches, lost, weak, strict=True) if is_weak and not is_lost]
    if len(degenerate) > _OFTEN * len(matches):
        x, y, heading = np.array([match.directions[:, match.observability.argmin()] for match in degenerate]).T
        if (np.abs(heading) > np.hypot(x, y)).mean() > 0.5:
            yield PathWarning("scans tell too little of the heading")
        else:
            yield PathWarning("scans tell too little", complex(((x + 1j * y) ** 2).sum()))
    if odometry is None:
        return
    # Motions from scan to scan in the robot's frame, so that an early error does not count again later; where the
    # search starts from the last pose, a direction that is not measured shows no motion.
    measured = ~(np.array(lost) | weak) | (options.start == "odometry")
    poses = np.array([match.pose for match in matches])
    steps = np.flatnonzero(measured[:-1] & measured[1:])
    motions = [(relative(*poses[step : step + 2]), relative(*odometry[step : step + 2])) for step in steps]
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

    start (3,): the robot's pose at the first scan. odometry: function from increasing times (K,) >= 0, s, to poses
    (K, 3) in any frame. Only its increments are used: to start the search, to deskew, and along directions that scans
    do not measure. It is needed unless the search starts from the last pose. deviations (3,): standard deviations of
    the start pose along the robot's axes, m, m, rad; default: it is exact. DataError in one line: no scan, or one
    without returns.
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
    slam = _Slam(scanner, noise, options, motion, np.asarray(start, dtype=float), PoseErrors(start, deviations))
    located = [slam.begin(scans.ranges[0])]
    located += [slam.go_on(number, ranges) for number, ranges in enumerate(scans.ranges[1:], 1)]
    matches, covariances = zip(*located, strict=True)
    poses, matched = (np.array([getattr(match, name) for match in matches]) for name in ("pose", "matched"))
    driven = None if odometry is None else motion_prior.poses_at(odometry, scans.times)
    warnings = path_warnings(matches, options, driven)
    return SlamPath(scans.times, poses, np.array(covariances), matched, tuple(warnings))


@dataclass
class _Slam:
    """SLAM in progress: the map so far, the last pose, and the errors of both."""

    scanner: Scanner
    noise: float
    options: SlamOptions
    motion: motion_prior.MotionPrior
    pose: Array
    errors: PoseErrors

    def __post_init__(self) -> None:
        self.map, self.keyframe = ScanMap(self.options.spacing), self.pose

    def begin(self, ranges: Ranges) -> tuple[Match, Array]:
        """The first scan, with which the map begins, at the start pose; its covariance (3, 3)."""
        within, deviations = self.motion.first()
        deviations = deviations if self.options.deskew else within.mean
        scan = self._points(ranges, within)
        self._add(scan, deviations)
        match = replace(refine(self.map, scan, self.pose, self.pose, self.options), pose=self.pose)
        # Uncertainty of the start pose, and of this scan, to which the following are matched.
        scatter = np.linalg.inv(match.information + np.diag(self.options.limits**-2.0))
        return match, self.errors.covariance + scatter

    def go_on(self, number: int, ranges: Ranges) -> tuple[Match, Array]:
        """The next scan: its match and the covariance of its pose (3, 3)."""
        options, motion, last = self.options, self.motion, self.pose
        predicted = motion.predict(number, last)
        scan = self._points(ranges, predicted.within)
        pose = search(self.map, scan, predicted.start, options)
        raw = scan
        correction: Array = np.zeros(3)
        for _ in range(_CORRECTIONS):
            pose = refine(self.map, scan, pose, predicted.start, options, steps=1).pose
            before = correction
            correction, deviations = motion.correct(number, last, pose, before)
            if not options.deskew:
                deviations = predicted.within.mean + correction  # the motion that is not undone
                break
            scan = raw.deskewed(correction)
            if not self._skews(correction - before):
                break
        match = refine(self.map, scan, pose, predicted.start, options)
        covariance = self.errors.step(match, predicted.deviations, deviations)
        self.pose = match.pose
        # New surfaces once the robot has come far enough; a scan that may be skewed waits while it can.
        x, y, turned = match.pose - self.keyframe
        far = np.hypot(x, y) > options.keyframe_distance or abs(turned) > options.keyframe_angle
        if bool(far and (match.matched < _NEEDED or not self._skews(deviations))) or not self.map.is_usable:
            self._add(scan, deviations)
        return match, covariance

    def _skews(self, twist: Array) -> bool:
        """True if an error (3,) of the twist during a scan, m/s, m/s, rad/s, matters."""
        return bool(np.abs(twist).max() * self.scanner.delays[-1] > _SKEWED)

    def _points(self, ranges: Ranges, within: motion_prior.MotionWithinScan) -> ScanPoints:
        still = motion_prior.MotionWithinScan.steady(np.zeros(3), within.duration)
        return scan_points(ranges, self.scanner, self.noise, within if self.options.deskew else still)

    def _add(self, scan: ScanPoints, deviations: Array) -> None:
        """Make the last pose a keyframe, if its scan saw something new.

        deviations (3,): standard deviations of the twist within the scan, m/s, m/s, rad/s.
        """
        self.keyframe = self.pose
        if not self.map.add(scan.lines, self.pose, self.errors.keyframes):
            return
        self.errors.keep(deviations * self.scanner.delays[-1] / 2)
        if self.errors.keyframes > _KEYFRAMES:
            self.map.merge_oldest()
            self.errors.merge_oldest()


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
    # The key covers all that a path depends on.
    of_model = [model.robot, model.matrix, model.integration, model.sample_period]
    terms = [[term.name, dict(term.values)] for term in model.terms]
    facts = {"scanner": scans.scanner, "options": options, "model": of_model, "terms": terms, "code": _code()}

    def job(run: Trajectory) -> Job[SlamPath]:
        recorded = scans.of(run.id)
        argument = dataset.name, run, recorded, scans.scanner, options, model
        return Job(content_key({"run": run, "scans": recorded, **facts}), _locate, argument)

    paths = _Paths(dataset, watch)
    with nullcontext(folder) if folder else TemporaryDirectory(prefix="omnibench-slam-") as place:
        store = ResultStore(Path(place), SlamPath)
        backend = local_backend(min(workers, len(dataset.trajectories)), PRELOAD)
        run_jobs(map(job, dataset.trajectories), store, backend, paths)
    return [paths.found[number] for number in range(len(dataset.trajectories))]


class _Paths(JobWatch[SlamPath]):
    """The paths found so far, by the numbers of their runs."""

    def __init__(self, dataset: Dataset, report: Reporter) -> None:
        self.found: dict[int, SlamPath] = {}
        self._dataset, self._report = dataset, report
        self._tell()

    def ended(self, number: int, ending: SlamPath | Failure, reused: bool) -> None:  # noqa: ARG002
        if isinstance(ending, Failure):
            run = f"data set {self._dataset.name}: trajectory {self._dataset.trajectories[number].id}"
            raise ending.error or OmnibenchError(f"{run}: SLAM: {ending.reason}; is there too little memory?")
        self.found[number] = ending
        self._tell()

    def _tell(self) -> None:
        self._report(Progress("SLAM", len(self.found), len(self._dataset.trajectories), "run"))


def with_paths(dataset: Dataset, paths: Sequence[SlamPath]) -> Dataset:
    """The data set with the poses, times and covariances of ``paths``, whose warnings are added to its own."""
    runs, by_problem = [], defaultdict[str, list[tuple[str, PathWarning]]](list)
    for run, path in zip(dataset.trajectories, paths, strict=True):
        # Data sets hold symmetric covariances.
        covariances = (path.covariances + np.swapaxes(path.covariances, 1, 2)) / 2
        runs.append(replace(run, pose_times=path.times, poses=path.poses, pose_covariances=covariances))
        for warning in path.warnings:
            by_problem[warning.problem].append((run.id, warning))
    described: dict[str, Any] = {name: getattr(dataset, name) for name in ("description", "source", "licence")}
    simulated, scans = dataset.simulated, dataset.scans
    made = make_dataset(
        dataset.name, dataset.robot, dataset.sample_period, runs, simulated=simulated, scans=scans, **described
    )
    warnings = []
    for problem, concerned in by_problem.items():  # of several runs: along their mean direction, with the mean share
        shares = [warning.share for _, warning in concerned if warning.share is not None]
        along = sum((warning.along for _, warning in concerned), 0j)
        mean = PathWarning(problem, along, sum(shares) / len(shares) if shares else None)
        names = ", ".join(run for run, _ in concerned[:3])
        warnings.append(f"SLAM: {mean}: {len(concerned)} of {len(paths)} runs, e.g. {names}")
    return replace(made, warnings=(*made.warnings, *warnings))


@cache
def _code() -> str:
    """Hash of the code that a path depends on."""
    package = Path(__file__).parents[1]
    return code_digest(package, (file for room in ("robot", "data", "slam") for file in (package / room).rglob("*.py")))


def _locate(
    argument: tuple[str, Trajectory, TrajectoryScans, Scanner, SlamOptions, OdometryModel], _: Reporter
) -> SlamPath:
    """The path of one run from t = 0 on. argument: name of its data set, run, scans, scanner, options, odometry."""
    dataset, trajectory, recorded, scanner, options, model = argument
    kept = recorded.times >= -_AT_START
    scans = TrajectoryScans(np.maximum(recorded.times[kept], 0.0), recorded.ranges[kept])

    def odometry(times: Array) -> Array:
        return model.poses([trajectory.log(times)])[0]

    try:
        if not len(scans.times):
            raise DataError("SLAM: no scan at or after t = 0")
        if scans.times[0] <= _AT_START:
            return run_slam(scans, scanner, options, trajectory.start, odometry)
        # The way along x and y and the turn before the first scan, m, m, rad; motion back and forth adds up.
        until = float(scans.times[0])
        poses = odometry(np.linspace(0.0, until, 2 + int(until / _STEP)))
        driven = np.sum([np.abs(relative(one, other)) for one, other in pairwise(poses)], axis=0)
        deviations = motion_prior.odometry_deviations(driven, options.odometry_error)
        path = run_slam(scans, scanner, options, poses[-1], odometry, deviations)
    except DataError as error:
        raise DataError(f"data set {dataset}: trajectory {trajectory.id}: {error}") from None
    # The start pose at t = 0 stands before the path of a run whose first scan comes later.
    late = "the robot moves before the first scan, whose pose is therefore as uncertain as the odometry"
    return SlamPath(
        np.append(0.0, path.times),
        np.vstack([trajectory.start, path.poses]),
        np.concatenate([FLOOR[None], path.covariances]),
        np.append(path.matched[:1], path.matched),
        (*path.warnings, PathWarning(late)) if motion_prior.length(driven) > _FAR else path.warnings,
    )


# Share of the largest variance below which a covariance counts as singular: rounding of its eigenvalues.
_SINGULAR = 1e-14


class ErrorSummary(Model):
    """Errors of poses. The bias is the mean error along the robot's axes, the systematic part of the error."""

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
    nees_mean: float | None = Field(
        description="mean of error' covariance^-1 error; 3 for honest covariances; singular ones are left out"
    )


class SlamAccuracy(Model):
    """Errors of the last pose of every run, and of all poses but the start poses."""

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
    place = f"data set {poses.name}"
    _check_truth(truth, poses, place)
    for run in poses.trajectories:
        if not run.has_poses:
            raise DataError(f"{place}: trajectory {run.id} has no pose after its start")
    errors = [run_errors(run, truth[run.id]) for run in poses.trajectories]
    driven = np.concatenate([run.driven for run in errors])
    return SlamAccuracy(
        runs=len(errors),
        distance_m=sum(float(run.driven[-1]) for run in errors),
        final=_summary([run.of(slice(-1, None)) for run in errors]),
        every=_summary(errors),
        drift_position=_growth(driven, np.concatenate([run.position for run in errors])),
        drift_heading=_growth(driven, np.concatenate([run.heading for run in errors])),
    )


def _check_truth(truth: Mapping[str, TruePath], dataset: Dataset, place: str) -> None:
    for run in dataset.trajectories:
        if run.id not in truth:
            raise DataError(f"{place}: trajectory {run.id} is not in the truth; name that of this data set")


@dataclass(frozen=True, eq=False)
class RunErrors:
    """Errors of a run's reference poses after the first.

    times (K,): times of the poses, s. driven (K,): true distance driven until then, m. in_robot (K, 3): errors along
    the robot's axes, m, m, rad. nees (K,): error' covariance^-1 error, NaN where the covariance is singular; None
    without covariances.
    """

    times: Array
    driven: Array
    in_robot: Array
    nees: Array | None

    @property
    def position(self) -> Array:
        """Magnitudes (K,) of the position's errors, m."""
        return np.hypot(self.in_robot[:, 0], self.in_robot[:, 1])

    @property
    def heading(self) -> Array:
        """Magnitudes (K,) of the heading's errors, rad."""
        return np.abs(self.in_robot[:, 2])

    def of(self, poses: slice | NDArray[np.bool_]) -> RunErrors:
        """The errors of some of the poses."""
        nees = None if self.nees is None else self.nees[poses]
        return RunErrors(self.times[poses], self.driven[poses], self.in_robot[poses], nees)


def run_errors(trajectory: Trajectory, truth: TruePath) -> RunErrors:
    """Errors of a run's reference poses after the first, at their stamps; the true path begins at the run's start."""
    times = trajectory.pose_times[1:]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth.poses[:, :2], axis=0).T))])
    true = TruePath(truth.times, moved_to(trajectory.start, truth.poses)).at(times)
    errors = trajectory.poses[1:] - true
    nees = None
    if (covariances := trajectory.pose_covariances) is not None:  # e' C^-1 e
        values, directions = np.linalg.eigh(covariances[1:])
        regular = values[:, 0] > _SINGULAR * values[:, -1]
        along = np.einsum("kij,ki->kj", directions[regular], errors[regular])
        nees = np.full(len(errors), np.nan)
        nees[regular] = (along**2 / values[regular]).sum(axis=1)
    in_robot = np.column_stack([rotated(errors, -true[:, 2]), errors[:, 2]])
    return RunErrors(times, np.interp(times, truth.times, way), in_robot, nees)


def _summary(runs: Sequence[RunErrors]) -> ErrorSummary:
    errors = np.concatenate([run.in_robot for run in runs])
    nees = np.concatenate([np.zeros(0), *(run.nees for run in runs if run.nees is not None)])
    nees = nees[np.isfinite(nees)]
    bias = dict(zip(("bias_forward_m", "bias_left_m", "bias_heading_rad"), errors.mean(axis=0).tolist(), strict=True))
    return ErrorSummary(**_spread(errors), **bias, nees_mean=float(nees.mean()) if len(nees) else None)


def _spread(errors: Array) -> dict[str, float]:
    """Number of errors (K, 3), and mean, 95 % quantile and maximum of their positions and headings."""
    sizes = {"position_{}_m": np.hypot(errors[:, 0], errors[:, 1]), "heading_{}_rad": np.abs(errors[:, 2])}
    spread: dict[str, float] = {"poses": len(errors)}
    for name, size in sizes.items():
        spread |= {name.format("mean"): float(size.mean()), name.format("p95"): float(np.quantile(size, 0.95))}
        spread[name.format("max")] = float(size.max())
    return spread


def _growth(driven: Array, sizes: Array) -> float:
    """Slope k of error^2 = noise^2 + (k distance)^2 by least squares; 0 where errors do not grow."""
    ways = driven**2 - (driven**2).mean()
    spread = float(ways @ ways)
    return float(np.sqrt(max(0.0, ways @ sizes**2 / spread))) if spread > 0 else 0.0


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
    parts = []
    for runs in zip(one.trajectories, other.trajectories, strict=True):
        sparse, dense = sorted(runs, key=lambda run: len(run.pose_times))
        times, within = sparse.pose_times, dense.pose_times[[0, -1]] + [-_SAME_TIME, _SAME_TIME]
        common = (times > _SAME_TIME) & (times >= within[0]) & (times <= within[1])
        turns = np.round((sparse.poses[0, 2] - dense.poses[0, 2]) / (2 * np.pi))  # only these are taken away
        there = interpolated(times[common], dense.pose_times, dense.poses)
        parts.append(sparse.poses[common] - there - [0.0, 0.0, 2 * np.pi * turns])
    if not len(errors := np.concatenate(parts)):
        return None
    return Distances(**{name: value for name, value in _spread(errors).items() if name in Distances.model_fields})


_WORKERS = 2  # processes at a time: results do not depend on their number


@dataclass(frozen=True, eq=False)
class SlamResult:
    """The data set with its new poses, their summary, and the true paths, if they are known."""

    dataset: Dataset
    summary: SlamSummary
    truth: Mapping[str, TruePath] | None


class SlamRequest(Model):
    """What ``omnibench slam`` was asked for. settings: of SlamOptions, as KEY=VALUE.

    ConfigError in one line: an option is wrong, or the recording would be written over.
    """

    dataset: Path
    output: Path | None = None
    start: Literal["odometry", "last_pose"] | None = Field(
        None, description="First guess of each scan's pose. Default: odometry."
    )
    no_deskew: bool = Field(False, description="Leave out the correction for the robot's motion during a scan.")
    model: Path | None = Field(None, description="Calibration for that odometry. Default: the design values.")
    truth: Path | None = Field(None, description="Folder that simulate --truth wrote: show the errors against it.")
    settings: tuple[str, ...] = ()
    force: bool = False

    @cached_property
    def options(self) -> SlamOptions:
        """The options of SLAM, by ``settings`` and by those that have an option of their own."""
        given = parse_settings(self.settings) | ({} if self.start is None else {"start": self.start})
        return validate(SlamOptions, given | ({"deskew": False} if self.no_deskew else {}), "slam --set")

    @model_validator(mode="after")
    def _go_together(self) -> SlamRequest:
        if self.output is not None and resolved(self.output) == resolved(self.dataset):
            raise ConfigError(f"-o {self.output}: is the recording itself; name another folder")
        if self.options.start != "odometry" and self.model is not None:
            raise ConfigError(f"--model {self.model}: is for --start odometry; leave one of the two out")
        return self

    def run(self, watch: Reporter = no_progress, table_format: TableFormat = "parquet") -> SlamResult:
        """Find the poses and write the data set. DataError in one line, before the work where that can be.

        Until the data set is written, the paths found so far are kept in a folder beside it, with which the command
        goes on when it is run again. Interrupted: Ctrl-C; the message names that folder, as a note of any error does.
        """
        recorded, truth, model = load_dataset(self.dataset), None, None
        if self.truth is not None:
            truth = read_true_poses(self.truth)
            if robot_of_truth(self.truth) not in (None, recorded.robot):
                raise DataError(f"--truth {self.truth}: it is another robot's; name the truth of this data set")
            _check_truth(truth, recorded, f"--truth {self.truth}")
        if self.model is not None:
            calibration = read_calibration(self.model)
            calibration.check_wheels(recorded.robot, f"the data set {recorded.name}", place=f"--model {self.model}: ")
            model = calibration.model
        if self.output is not None:
            check_dataset_folder(self.output)
            going_on = any(_paths_beside(self.output).glob("*.json"))  # stopped before the data set was complete
            refuse_existing(self.output, force=self.force or going_on, folders=True)
        # Terms of plug-ins, whose classes other processes do not know and no path's key covers.
        terms = () if model is None else model.terms
        local = not all(type(term.effect).__module__.startswith("omnibench.") for term in terms)
        folder = None if local or self.output is None else _paths_beside(self.output)
        try:
            workers = 1 if local else _WORKERS
            paths = slam_paths(recorded, self.options, model=model, workers=workers, folder=folder, watch=watch)
            found = with_paths(recorded, paths)
            if self.output is not None:
                save_dataset(found, self.output, table_format, overwrite=self.force)
        except (KeyboardInterrupt, Exception) as error:
            if folder is None or not any(folder.glob("*.json")):
                raise
            kept = f"the paths found so far are kept in {folder}"
            if isinstance(error, KeyboardInterrupt):
                raise Interrupted(f"interrupted; {kept}: run the command again") from None
            error.add_note(kept)
            raise
        if folder is not None:
            ResultStore(folder, SlamPath).remove()
        accuracy = None if truth is None else slam_accuracy(found, truth)
        return SlamResult(found, summarise(recorded, found, paths, accuracy), truth)


def _paths_beside(output: Path) -> Path:
    named = output if output.name not in ("", "..") else resolved(output)
    return named.with_name(f"{named.name}.slam-paths")
