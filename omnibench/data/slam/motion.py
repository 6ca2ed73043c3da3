"""What is known of the robot's motion besides the scan in question: odometry, or only how it moved before."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from omnibench.data.slam.options import SlamOptions
from omnibench.robot.kinematics import Array
from omnibench.robot.planar import compose, relative

_ARM = 0.3  # m; a turn counts as what it moves there
_STANDING = 1e-4  # m; who moves less stands


@dataclass(frozen=True, eq=False)
class Expected:
    """Of a scan before it is matched. start (3,): where the robot may be. deviations (3,): standard deviations of its
    motion since the last scan, in the robot's frame, m, m, rad. twist (3,): during the scan, m/s, m/s, rad/s.
    """

    start: Array
    deviations: Array
    twist: Array


class Motion(ABC):
    """Of one run, scan by scan. The first scan is number 0."""

    @abstractmethod
    def first_twist(self) -> Array:
        """The twist (3,) during the first scan."""

    @abstractmethod
    def expected(self, scan: int, last: Array) -> Expected:
        """What to expect of a scan after the first, the robot's last pose (3,) known."""

    @abstractmethod
    def corrected(self, scan: int, last: Array, found: Array) -> tuple[Array, Array]:
        """The twist (3,) during a scan whose pose is roughly known, and its standard deviations (3,)."""


class OdometryMotion(Motion):
    """Odometry, which may be uncalibrated: wrong in scale and direction by a few per cent.

    times (S,): of the scans, each of which takes ``duration``, s.
    """

    def __init__(self, odometry: Callable[[Array], Array], times: Array, duration: float, options: SlamOptions) -> None:
        stamps, place = np.unique(np.concatenate([times, times + duration]), return_inverse=True)
        poses = odometry(stamps)[place]
        self._begin, self._end = poses[: len(times)], poses[len(times) :]
        self._duration, self._error = duration, options.odometry_error

    def first_twist(self) -> Array:
        return self._twist(0)

    def expected(self, scan: int, last: Array) -> Expected:
        driven = self._driven(scan)
        deviations = self._error * _length(driven) * np.array([1.0, 1.0, 1 / _ARM])
        return Expected(compose(last, driven), deviations, self._twist(scan))

    def corrected(self, scan: int, last: Array, found: Array) -> tuple[Array, Array]:
        """As wrong as the odometry was since the last scan, in proportion to the motion."""
        twist, driven = self._twist(scan), self._driven(scan)
        way = _length(driven)
        if way < _STANDING:
            return twist, np.zeros(3)
        return twist + (relative(last, found) - driven) * (_length(twist) / way), np.zeros(3)

    def _driven(self, scan: int) -> Array:
        return relative(self._begin[scan - 1], self._begin[scan])

    def _twist(self, scan: int) -> Array:
        if not self._duration:
            return np.zeros(3)
        return relative(self._begin[scan], self._end[scan]) / self._duration


class UnknownMotion(Motion):
    """Only the poses so far are known; the last one is where the search starts. At the first scan the robot stands."""

    def __init__(self, times: Array, options: SlamOptions) -> None:
        self._periods = np.diff(times, prepend=times[0])
        self._deviations = np.array([options.speed, options.speed, options.turn_rate])
        self._mean: Array = np.zeros(3)  # twist between the last two scans
        self._before: Array | None = None  # the pose of the first of them

    def first_twist(self) -> Array:
        return self._mean

    def expected(self, scan: int, last: Array) -> Expected:
        if self._before is not None:
            self._mean = relative(self._before, last) / self._periods[scan - 1]
        self._before = last
        return Expected(last, self._deviations * self._periods[scan], self._mean)

    def corrected(self, scan: int, last: Array, found: Array) -> tuple[Array, Array]:
        """The mean twist since the last scan, carried on as it changes; it may as well have changed otherwise."""
        period = self._periods[scan]
        mean = relative(last, found) / period
        change = (mean - self._mean) * period / (period + self._periods[scan - 1]) / 2
        return mean + change, np.abs(change)


def _length(moved: Array) -> float:
    return float(np.hypot(np.hypot(moved[0], moved[1]), _ARM * moved[2]))
