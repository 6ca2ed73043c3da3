"""SLAM of one run: its scans, one after another, become poses and a map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.scans import Ranges, Scanner, TrajectoryScans
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array, JsonArray
from omnibench.slam.map import ScanMap
from omnibench.slam.motion_prior import LastPosePrior, MotionPrior, MotionWithinScan, OdometryPrior
from omnibench.slam.pose_errors import PathWarning, PoseErrors, path_warnings
from omnibench.slam.scan_matching import Match, ScanPoints, noise_factor, refine, scan_points, search
from omnibench.slam.slam_options import SlamOptions

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
