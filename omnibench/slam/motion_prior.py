"""What is known of the robot's motion besides the scan in question: odometry, or only how it moved before.

A motion is written as the constant twist that makes it in unit time: (3,), m, m, rad.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from omnibench.robot.kinematics import Array
from omnibench.robot.planar import compose, relative, unit_twist
from omnibench.slam.motion_within_scan import MotionWithinScan, smoothed
from omnibench.slam.slam_options import SlamOptions

_ARM = 0.3  # m; a turn counts as what it moves there
_EACH: Array = np.array([1.0, 1.0, 1 / _ARM])
_UNSTEADY = 0.5  # 1/s; in a second a twist changes by this share of what the robot may drive
_FOUND: Array = np.array([1e-3, 1e-3, 5e-4])  # m, m, rad; standard deviations of a motion between poses found


@dataclass(frozen=True, eq=False)
class MotionPrediction:
    """Of a scan before it is matched. start (3,): where the robot may be. deviations (3,): standard deviations of its
    motion since the last scan, in the robot's frame, m, m, rad. within: its motion during the scan.
    """

    start: Array
    deviations: Array
    within: MotionWithinScan


class MotionPrior(ABC):
    """Of one run, scan by scan. The first scan is number 0."""

    def __init__(self, times: Array, duration: float) -> None:
        self._periods, self._duration = np.diff(times, prepend=times[0]), duration

    @abstractmethod
    def first(self) -> tuple[MotionWithinScan, Array]:
        """The motion during the first scan, and the standard deviations (3,) of its twist."""

    @abstractmethod
    def predict(self, scan: int, last: Array) -> MotionPrediction:
        """What to expect of a scan after the first, the robot's last pose (3,) known."""

    @abstractmethod
    def correct(self, scan: int, last: Array, found: Array, before: Array) -> tuple[Array, Array]:
        """What a scan whose pose is roughly known tells of the motion during it.

        The twist (3,) that is to be added to what was expected, and the standard deviations (3,) of what is then left.
        before (3,): the twist that had been added when the pose was found.
        """

    def _unseen(self, scan: int, change: Array) -> Array:
        """Of a change (3,) of the twist within a scan that its own pose told: what that pose, skewed by it, hides."""
        return self._duration / (2 * self._periods[scan]) * np.abs(change)


class OdometryPrior(MotionPrior):
    """Odometry, which may be uncalibrated (wrong in scale and direction by a few per cent) and coarse.

    times (S,): of the scans, each of which takes ``duration``, s.
    """

    def __init__(self, odometry: Callable[[Array], Array], times: Array, duration: float, options: SlamOptions) -> None:
        stamps, place = np.unique(times, return_inverse=True)
        self._poses = odometry(stamps)[place]
        self._within, self._coarse = smoothed(odometry, times, duration)
        self._error = options.odometry_error
        super().__init__(times, duration)

    def first(self) -> tuple[MotionWithinScan, Array]:
        return self._within[0], self._doubt(0, self._within[0].mean)

    def predict(self, scan: int, last: Array) -> MotionPrediction:
        driven = relative(self._poses[scan - 1], self._poses[scan])
        return MotionPrediction(compose(last, driven), odometry_deviations(driven, self._error), self._within[scan])

    def correct(self, scan: int, last: Array, found: Array, before: Array) -> tuple[Array, Array]:
        """As wrong as the odometry was since the last scan, in proportion to the motion.

        The less the robot has moved since, or the less its odometry's error exceeds that of the pose found, the less is
        known of it.
        """
        if not self._duration:
            return np.zeros(3), np.zeros(3)
        twist = self._within[scan].mean
        driven = unit_twist(relative(self._poses[scan - 1], self._poses[scan]))
        noise = np.hypot(np.sqrt(2) * self._coarse, _FOUND)
        share = length(driven) * length(twist) / (length(driven) ** 2 + (length(noise) / self._error) ** 2)
        correction = share * (unit_twist(relative(last, found)) - driven)
        doubts = self._doubt(scan, twist - share * driven), share * noise, self._unseen(scan, correction - before)
        return correction, np.sqrt(np.square(doubts).sum(axis=0))

    def _doubt(self, scan: int, unknown: Array) -> Array:
        """Standard deviations (3,) of the twist within a scan, a part (3,) of which is as wrong as odometry may be."""
        return np.hypot(odometry_deviations(unknown, self._error), self._within[scan].deviations)


class LastPosePrior(MotionPrior):
    """Only the poses so far are known; the last one is where the search starts. At the first scan the robot stands."""

    def __init__(self, times: Array, duration: float, options: SlamOptions) -> None:
        super().__init__(times, duration)
        self._deviations = np.array([options.speed, options.speed, options.turn_rate])
        self._mean: Array = np.zeros(3)  # twist between the last two scans
        self._before: Array | None = None  # the pose of the first of them

    def first(self) -> tuple[MotionWithinScan, Array]:
        return MotionWithinScan.steady(self._mean, self._duration), np.zeros(3)

    def predict(self, scan: int, last: Array) -> MotionPrediction:
        if self._before is not None:
            self._mean = unit_twist(relative(self._before, last)) / self._periods[scan - 1]
        self._before = last
        within = MotionWithinScan.steady(self._mean, self._duration)
        return MotionPrediction(last, self._deviations * self._periods[scan], within)

    def correct(self, scan: int, last: Array, found: Array, before: Array) -> tuple[Array, Array]:
        """The mean twist since the last scan, carried on as it changes; it may as well have changed otherwise."""
        period = self._periods[scan]
        mean = unit_twist(relative(last, found)) / period
        change = (mean - self._mean) * (period + self._duration) / (period + self._periods[scan - 1]) / 2
        correction = mean + change - self._mean
        doubts = change, _UNSTEADY * self._deviations * self._duration / 2, self._unseen(scan, correction - before)
        return correction, np.sqrt(np.square(doubts).sum(axis=0))


def odometry_deviations(driven: Array, error: float) -> Array:
    """Standard deviations (3,) of a motion (3,) of the robot that its odometry tells but for an ``error``, a share."""
    return error * length(driven) * _EACH


def length(moved: Array) -> float:
    """Of a motion (3,) or twist: m or m/s, its turn included."""
    return float(np.hypot(np.hypot(moved[0], moved[1]), _ARM * moved[2]))
