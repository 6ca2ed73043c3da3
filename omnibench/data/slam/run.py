"""SLAM of one run: its scans, one after another, become poses and a map."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.scans import Ranges, Scanner, TrajectoryScans
from omnibench.data.slam.errors import PoseErrors
from omnibench.data.slam.map import ScanMap
from omnibench.data.slam.matching import LOST, Match, refine, search
from omnibench.data.slam.motion import Motion, OdometryMotion, UnknownMotion
from omnibench.data.slam.options import SlamOptions
from omnibench.data.slam.points import ScanPoints, noise_factor, scan_points
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

_UNTOLD = 0.5  # share of a direction that scans tell: when it is less,
_OFTEN = 0.1  # in more than this share of the scans, it is said


@dataclass(frozen=True, eq=False)
class SlamPath:
    """Poses of the robot at the stamps of its scans.

    times (S,): s. poses (S, 3): m, m, rad, in the run's frame, headings continuous. covariances (S, 3, 3).
    matched (S,): share of each scan's points that lie on the map. problems: what went wrong, in words.
    """

    times: Array
    poses: Array
    covariances: Array
    matched: Array
    problems: tuple[str, ...] = ()


def run_slam(
    scans: TrajectoryScans,
    scanner: Scanner,
    options: SlamOptions,
    start: Array,
    odometry: Callable[[Array], Array] | None = None,
) -> SlamPath:
    """The poses at which a run's scans lie best on the map that they make.

    start (3,): the robot's pose at the first scan. odometry: poses (K, 3) at times (K,) in s, in any frame, of which
    only the increments are used, to begin the search, to deskew, and where scans tell nothing; needed unless the
    search starts from the last pose. DataError in one line: no scan, or one without returns.
    """
    _check(scans, scanner, options, odometry)
    motion: Motion
    if options.start == "odometry" and odometry is not None:
        motion = OdometryMotion(odometry, options)
    else:
        motion = UnknownMotion(options)
    noise = noise_factor(scans.ranges, scanner)
    slam = _Slam(scanner, noise, options, motion, np.asarray(start, dtype=float))
    located = [slam.begin(scans.ranges[0], float(scans.times[0]))]
    located += [slam.go_on(*scan) for scan in zip(scans.ranges[1:], scans.times[1:].tolist(), strict=True)]
    return SlamPath(
        scans.times,
        np.array([match.pose for match, _ in located]),
        np.array([covariance for _, covariance in located]),
        np.array([match.matched for match, _ in located]),
        tuple(_problems([match for match, _ in located])),
    )


class _Slam:
    """A run on its way: the map so far, and how wrong it is."""

    def __init__(self, scanner: Scanner, noise: float, options: SlamOptions, motion: Motion, start: Array) -> None:
        self._scanner, self._noise, self._options, self._motion = scanner, noise, options, motion
        self._duration = float(scanner.delays[-1])
        self._map = ScanMap(options.spacing)
        self._errors = PoseErrors(start)
        self._pose = self._keyframe = start
        self._time = 0.0

    def begin(self, ranges: Ranges, time: float) -> tuple[Match, Array]:
        """The first scan, with which the map begins, at the start pose; its covariance (3, 3)."""
        twist = self._motion.twist(time, self._duration)
        scan = self._deskewed(scan_points(ranges, self._scanner, self._noise, twist), twist)
        self._add(scan)
        match = replace(refine(self._map, scan, self._pose, self._pose, self._options), pose=self._pose)
        self._time = time
        # The pose is exact; what it is for the scans that follow is as uncertain as the scan's noise makes it.
        limits = [*[self._options.constrained_position] * 2, self._options.constrained_heading]
        return match, np.linalg.inv(match.information + np.diag(np.power(limits, -2.0)))

    def go_on(self, ranges: Ranges, time: float) -> tuple[Match, Array]:
        """The next scan: its match and the covariance of its pose (3, 3)."""
        options, motion, last, before = self._options, self._motion, self._pose, self._time
        start, twist = motion.predicted(last, before, time), motion.twist(time, self._duration)
        scan = scan_points(ranges, self._scanner, self._noise, twist)
        still = self._deskewed(scan, twist)
        found = search(self._map, still, start, options)
        found = refine(self._map, still, found, start, options, steps=1).pose
        twist, doubt = motion.corrected(twist, last, found, before, time)
        still = self._deskewed(scan, twist)
        match = refine(self._map, still, found, start, options)
        covariance = self._errors.step(match, motion.deviations(before, time), doubt * self._duration / 2)
        motion.went(last, match.pose, before, time)
        self._pose, self._time = match.pose, time
        x, y, turned = self._pose - self._keyframe
        if np.hypot(x, y) > options.keyframe_distance or abs(turned) > options.keyframe_angle or not len(self._map):
            self._add(still)
        return match, covariance

    def _deskewed(self, scan: ScanPoints, twist: Array) -> ScanPoints:
        return scan.deskewed(twist) if self._options.deskew else scan

    def _add(self, scan: ScanPoints) -> None:
        """The last pose becomes a keyframe, if its scan saw something new."""
        self._keyframe = self._pose
        if self._map.add(scan.lines, self._pose, self._errors.keyframes):
            self._errors.keep()


def _problems(matches: Sequence[Match]) -> Iterator[str]:
    if any(match.matched < LOST for match in matches):
        yield "less than a fifth of a scan lies on the map, and its pose is the start of the search"
    untold = [match for match in matches if match.matched >= LOST and match.told.min() < _UNTOLD]
    if len(untold) > _OFTEN * len(matches):
        worst = np.array([match.directions[:, match.told.argmin()] for match in untold])
        if (np.abs(worst[:, 2]) > np.hypot(worst[:, 0], worst[:, 1])).mean() > 0.5:
            yield "scans tell too little of the heading"
        else:  # a direction and its opposite are the same
            double = np.angle(((worst[:, 0] + 1j * worst[:, 1]) ** 2).sum()) / 2
            yield f"scans tell too little along {_rounded(np.degrees(double)):.0f} deg of the run's frame"


def _rounded(degrees: float) -> float:
    """To a tenth of a right angle, from 0 to 180."""
    return 9.0 * round(degrees / 9) % 180


def _check(
    scans: TrajectoryScans, scanner: Scanner, options: SlamOptions, odometry: Callable[[Array], Array] | None
) -> None:
    if len(scans.times) == 0:
        raise DataError("SLAM: there is no scan")
    if scans.ranges.shape != (len(scans.times), scanner.rays):
        raise DataError(
            f"SLAM: ranges have shape {scans.ranges.shape}, expected {(len(scans.times), scanner.rays)}: scans, rays"
        )
    for index in np.flatnonzero(~scanner.valid(scans.ranges).any(axis=1))[:1]:
        raise DataError(
            f"SLAM: the scan at {scans.times[index]:g} s is empty: no range from {scanner.range_min:g} to "
            f"{scanner.range_max:g} m; leave it out"
        )
    if options.start == "odometry" and odometry is None:
        raise DataError("SLAM: start is odometry, but there is none; choose start: last_pose")
