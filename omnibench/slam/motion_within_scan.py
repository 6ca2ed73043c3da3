"""Motion of the robot within a scan as a smooth function of time, fitted to its odometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from omnibench.robot.kinematics import Array, relative, unit_twist

# The study tests/studies/constants_slam.py varies these numbers by 0.5 and 2. In three rooms SLAM's median error
# stays at 1.07 mm and the median NEES between 2.5 and 2.6 (3 for an honest covariance).
_AROUND = 0.25  # s of odometry besides the scan's own time that the fit takes in
_INSTANT = 0.02  # s between the odometry poses of the fit
_DEGREE = 3  # degree of the polynomial in time
_ALIKE = 4.0  # successive poses with one error, as encoder ticks give


@dataclass(frozen=True, eq=False)
class MotionWithinScan:
    """Motion from a scan's stamp to a delay t: the one that the twist c_1 t + c_2 t^2 + ... makes in unit time.

    coefficients (k, 3): m/s^k, m/s^k, rad/s^k, in the robot's frame at the stamp. duration: of the scan, s. deviations
    (3,): standard deviations of mean twists since the stamp due to coarse odometry, m/s, m/s, rad/s.
    """

    coefficients: Array
    duration: float
    deviations: Array

    @classmethod
    def steady(cls, twist: Array, duration: float) -> MotionWithinScan:
        """The motion of a robot that keeps one twist (3,), m/s, m/s, rad/s, for the whole scan (duration, s)."""
        return cls(twist[None], duration, np.zeros(3))

    def at(self, delays: Array) -> Array:
        """The motions (n, 3) until delays (n,), s, each as the twist that makes it in unit time."""
        motions: Array = _powers(delays, len(self.coefficients)) @ self.coefficients
        return motions

    @property
    def mean(self) -> Array:
        """The mean twist (3,) over the scan."""
        mean: Array = self.duration ** np.arange(len(self.coefficients)) @ self.coefficients
        return mean


def smoothed(odometry: Callable[[Array], Array], times: Array, duration: float) -> tuple[list[MotionWithinScan], Array]:
    """The motion within each scan, and standard deviations (3,) of the odometry's poses about the fit, m, m, rad.

    A motion is the cubic through the odometry about a scan, by least squares. times (S,): times of the scans, s.
    duration: duration of a scan, s. There is no odometry before t = 0.
    """
    if not duration:
        return [MotionWithinScan.steady(np.zeros(3), 0.0)] * len(times), np.zeros(3)
    count = 2 + int((_AROUND + duration) / _INSTANT)
    delays = np.linspace(-_AROUND / 2, duration + _AROUND / 2, count)
    delays = np.maximum(times[:, None] + delays, 0.0) - times[:, None]  # (S, count)
    stamps, place = np.unique(np.column_stack([times, times[:, None] + delays]), return_inverse=True)
    poses = odometry(stamps)[place.reshape(len(times), -1)]
    motions = _since(poses[:, 0], poses[:, 1:])
    basis = np.concatenate([np.ones((*delays.shape, 1)), _powers(delays, _DEGREE)], axis=2)
    inverse = np.linalg.pinv(basis)
    fitted = inverse @ motions
    residuals = motions - basis @ fitted
    squares = (residuals**2).sum(axis=1) / (count - _DEGREE - 1)
    coarse = squares.mean(axis=0)
    squares = np.maximum(squares, coarse)  # a scan without encoder ticks looks smoother than its odometry is
    parts = duration * np.linspace(0.2, 1.0, 5)
    means = parts[:, None] ** np.arange(_DEGREE) @ inverse[:, 1:]  # twists of parts of the scan: (S, 5, count)
    deviations = np.sqrt(_ALIKE * (means**2).sum(axis=2).mean(axis=1)[:, None] * squares)
    motions_within = [
        MotionWithinScan(coefficients[1:], duration, scan_deviations)
        for coefficients, scan_deviations in zip(fitted, deviations, strict=True)
    ]
    return motions_within, np.sqrt(coarse)


def _powers(delays: Array, count: int) -> Array:
    """The first ``count`` powers of delays (..., n), from 1 on: (..., n, count)."""
    return delays[..., None] ** np.arange(1, count + 1)


def _since(first: Array, poses: Array) -> Array:
    """Poses (S, n, 3) as motions since the poses (S, 3)."""
    return unit_twist(relative(first[:, None], poses))
