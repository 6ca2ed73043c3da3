"""What is known of the robot's motion besides its scans: odometry, or only how it moved before."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from omnibench.data.slam.options import SlamOptions
from omnibench.robot.kinematics import Array
from omnibench.robot.planar import compose, relative

_STANDING = 1e-4  # m
_ARM = 0.3  # m; a turn counts as what it moves there


class Motion(ABC):
    """Where a robot is going, as far as that is known without the scan in question."""

    @abstractmethod
    def predicted(self, last: Array, before: float, time: float) -> Array:
        """The pose (3,) at ``time``, s, from the last one, of the time ``before``."""

    @abstractmethod
    def deviations(self, before: float, time: float) -> Array:
        """Standard deviations (3,) of the predicted motion, in the robot's frame, m, m, rad."""

    @abstractmethod
    def twist(self, time: float, duration: float) -> Array:
        """The mean twist (3,) over ``duration``, s, from ``time`` on, m/s, m/s, rad/s."""

    @abstractmethod
    def corrected(self, twist: Array, last: Array, found: Array, before: float, time: float) -> tuple[Array, Array]:
        """The twist (3,) once the scan's pose is roughly known, and its standard deviations (3,)."""

    @abstractmethod
    def went(self, last: Array, pose: Array, before: float, time: float) -> None:
        """Told every pose."""


class OdometryMotion(Motion):
    """Odometry, which may be uncalibrated: wrong in scale and direction by a few per cent."""

    def __init__(self, odometry: Callable[[Array], Array], options: SlamOptions) -> None:
        self._odometry, self._error = odometry, options.odometry_error

    def predicted(self, last: Array, before: float, time: float) -> Array:
        return compose(last, self._between(before, time))

    def deviations(self, before: float, time: float) -> Array:
        way = _length(self._between(before, time))
        return self._error * way * np.array([1.0, 1.0, 1 / _ARM])

    def twist(self, time: float, duration: float) -> Array:
        return self._between(time, time + duration) / duration if duration > 0 else np.zeros(3)

    def corrected(self, twist: Array, last: Array, found: Array, before: float, time: float) -> tuple[Array, Array]:
        """As wrong as the odometry was since the last scan, in proportion to the motion."""
        driven = self._between(before, time)
        way = _length(driven)
        if way < _STANDING:
            return twist, np.zeros(3)
        error = relative(last, found) - driven
        return twist + error * (_length(twist) / way), np.zeros(3)

    def went(self, last: Array, pose: Array, before: float, time: float) -> None:
        """Odometry knows."""

    def _between(self, first: float, second: float) -> Array:
        poses = self._odometry(np.array([first, second]))
        return relative(poses[0], poses[1])


class UnknownMotion(Motion):
    """Only the poses so far are known; the last one is where the search starts."""

    def __init__(self, options: SlamOptions) -> None:
        self._deviations = np.array([options.speed, options.speed, options.turn_rate])
        self._mean: Array = np.zeros(3)  # twist between the last two scans, which are ``since`` apart
        self._since = 0.0

    def predicted(self, last: Array, before: float, time: float) -> Array:  # noqa: ARG002
        return last

    def deviations(self, before: float, time: float) -> Array:
        return self._deviations * (time - before)

    def twist(self, time: float, duration: float) -> Array:  # noqa: ARG002
        return self._mean

    def corrected(self, twist: Array, last: Array, found: Array, before: float, time: float) -> tuple[Array, Array]:  # noqa: ARG002
        """The mean twist since the last scan, carried on as it changes; it may as well have changed otherwise."""
        mean = relative(last, found) / (time - before)
        change = (mean - self._mean) * (time - before) / (time - before + self._since)
        return mean + change / 2, np.abs(change) / 2

    def went(self, last: Array, pose: Array, before: float, time: float) -> None:
        self._since = time - before
        self._mean = relative(last, pose) / self._since


def _length(moved: Array) -> float:
    return float(np.hypot(np.hypot(moved[0], moved[1]), _ARM * moved[2]))
