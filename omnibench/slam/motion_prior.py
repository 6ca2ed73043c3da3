"""Motion priors: the next scan's pose and the motion within it, predicted from odometry or from the last poses.

A motion (3,) is written as the constant twist that makes it in unit time, m, m, rad.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from omnibench.robot.kinematics import Array, compose, relative, unit_twist
from omnibench.slam.slam_options import SlamOptions

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
        return _powers(delays, len(self.coefficients)) @ self.coefficients

    @property
    def mean(self) -> Array:
        """The mean twist (3,) over the scan."""
        return self.duration ** np.arange(len(self.coefficients)) @ self.coefficients


def poses_at(odometry: Callable[[Array], Array], times: Array) -> Array:
    """Poses (..., 3) at times (...), s, of an odometry that takes increasing times."""
    stamps, place = np.unique(times, return_inverse=True)
    return odometry(stamps)[place.reshape(times.shape)]


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
    poses = poses_at(odometry, np.column_stack([times, times[:, None] + delays]))
    motions = unit_twist(relative(poses[:, 0][:, None], poses[:, 1:]))
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
    scans = zip(fitted[:, 1:], deviations, strict=True)
    return [MotionWithinScan(powers, duration, errors) for powers, errors in scans], np.sqrt(coarse)


def _powers(delays: Array, count: int) -> Array:
    """The first ``count`` powers of delays (..., n), from 1 on: (..., n, count)."""
    return delays[..., None] ** np.arange(1, count + 1)


# The study tests/studies/constants_slam.py varies these numbers by 0.5 and 2. In three rooms SLAM's median error
# stays between 1.07 and 1.08 mm and the median NEES between 2.3 and 2.7 (3 for an honest covariance).
_ARM = 0.3  # m: lever arm that turns a rotation into a distance
_PER_LENGTH: Array = np.array([1.0, 1.0, 1 / _ARM])  # m, m, rad for each m of the way
_UNSTEADY = 0.5  # 1/s: change of a twist in a second, as a share of the robot's greatest twist
_MATCH_NOISE: Array = np.array([1e-3, 1e-3, 5e-4])  # m, m, rad: standard deviations of a motion between matched poses


class MotionPrediction(NamedTuple):
    """Prediction for a scan before it is matched.

    start (3,): predicted pose. deviations (3,): standard deviations of the motion since the last scan, in the robot's
    frame, m, m, rad. within: motion during the scan.
    """

    start: Array
    deviations: Array
    within: MotionWithinScan


class OdometryPrior:
    """Prior from odometry, which may be uncalibrated (wrong in scale and direction by a few per cent) and coarse.

    odometry: poses (K, 3) at increasing times (K,), s. times (S,): of the scans, s. duration: of a scan, s.
    """

    def __init__(self, odometry: Callable[[Array], Array], times: Array, duration: float, options: SlamOptions) -> None:
        self._poses, self._error = poses_at(odometry, times), options.odometry_error
        self._within, self._coarse = smoothed(odometry, times, duration)
        self._periods, self._duration = np.diff(times, prepend=times[0]), duration

    def first(self) -> tuple[MotionWithinScan, Array]:
        """The motion during the first scan, and standard deviations (3,) of its twist, m/s, m/s, rad/s."""
        return self._within[0], self._deviations(0, self._within[0].mean)

    def predict(self, scan: int, last: Array) -> MotionPrediction:
        """The prediction for a scan after the first. last (3,): pose of the scan before it."""
        driven = relative(self._poses[scan - 1], self._poses[scan])
        return MotionPrediction(compose(last, driven), odometry_deviations(driven, self._error), self._within[scan])

    def correct(self, scan: int, last: Array, pose: Array, before: Array) -> tuple[Array, Array]:
        """Correct the motion during a scan by its roughly known ``pose`` (3,).

        Returns the twist (3,) to add to the predicted one, and standard deviations (3,) of the corrected twist. last
        (3,): pose of the scan before. before (3,): twist that had been added when the pose was estimated. The error of
        the odometry since the last scan is scaled to this scan: by a smaller share the less the robot has moved, and
        the less the odometry's error exceeds that of the matched pose.
        """
        if not self._duration:
            return np.zeros(3), np.zeros(3)
        twist = self._within[scan].mean
        driven = unit_twist(relative(self._poses[scan - 1], self._poses[scan]))
        noise = np.hypot(np.sqrt(2) * self._coarse, _MATCH_NOISE)
        share = length(driven) * length(twist) / (length(driven) ** 2 + (length(noise) / self._error) ** 2)
        correction = share * (unit_twist(relative(last, pose)) - driven)
        errors = (
            self._deviations(scan, twist - share * driven),
            share * noise,
            _skew_error(self._duration, self._periods[scan], correction - before),
        )
        return correction, np.sqrt(np.square(errors).sum(axis=0))

    def _deviations(self, scan: int, uncorrected: Array) -> Array:
        """Standard deviations (3,) of the twist within a scan. uncorrected (3,): its part with the odometry's error."""
        return np.hypot(odometry_deviations(uncorrected, self._error), self._within[scan].deviations)


class LastPosePrior:
    """Prior from the last poses alone: the search starts from the last one. At the first scan the robot stands.

    Its methods are those of ``OdometryPrior``.
    """

    def __init__(self, times: Array, duration: float, options: SlamOptions) -> None:
        self._periods, self._duration = np.diff(times, prepend=times[0]), duration
        self._greatest = np.array([options.speed, options.speed, options.turn_rate])
        self._mean: Array = np.zeros(3)  # twist between the last two scans
        self._before: Array | None = None  # the pose of the first of them

    def first(self) -> tuple[MotionWithinScan, Array]:
        return MotionWithinScan.steady(self._mean, self._duration), np.zeros(3)

    def predict(self, scan: int, last: Array) -> MotionPrediction:
        if self._before is not None:
            self._mean = unit_twist(relative(self._before, last)) / self._periods[scan - 1]
        self._before = last
        within = MotionWithinScan.steady(self._mean, self._duration)
        return MotionPrediction(last, self._greatest * self._periods[scan], within)

    def correct(self, scan: int, last: Array, pose: Array, before: Array) -> tuple[Array, Array]:
        """Extrapolate the mean twist since the last scan linearly; deviations cover any other change."""
        period = self._periods[scan]
        mean = unit_twist(relative(last, pose)) / period
        change = (mean - self._mean) * (period + self._duration) / (period + self._periods[scan - 1]) / 2
        correction = mean + change - self._mean
        skew = _skew_error(self._duration, period, correction - before)
        errors = change, _UNSTEADY * self._greatest * self._duration / 2, skew
        return correction, np.sqrt(np.square(errors).sum(axis=0))


MotionPrior = OdometryPrior | LastPosePrior


def _skew_error(duration: float, period: float, change: Array) -> Array:
    """Standard deviations (3,) of the twist after a change (3,) by a pose that this change itself had skewed."""
    return duration / (2 * period) * np.abs(change)


def odometry_deviations(driven: Array, error: float) -> Array:
    """Standard deviations (3,) of a motion (3,) measured by odometry. error: relative, as a share of the length."""
    return error * length(driven) * _PER_LENGTH


def length(moved: Array) -> float:
    """Length of a motion (3,), m, or a twist (3,), m/s; the turn counts at the lever arm."""
    return float(np.hypot(np.hypot(moved[0], moved[1]), _ARM * moved[2]))
