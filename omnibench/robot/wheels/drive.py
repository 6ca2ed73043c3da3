"""Drive signals: the quantities u (M,) in which a robot's twist is linear, twist = K u, from what its wheels measure.

Let omega_i be the rate of wheel i and phi_j the steering angle of wheel j, both in the middle of a sample. A wheel
that rolls in a fixed direction, or on rollers, has the signal omega_i. A steered wheel whose rate is measured moves the
robot over itself by

    r omega (cos phi, sin phi)                                                    (1)

along x and y, and has the two signals omega cos phi and omega sin phi; K then holds its radius, its place and the
offset of its steering angle. A car steers by wheels of which only the angle is measured. Its rear wheels, at the rates
omega_i, have the mean rate m. With w the rate of turn and v the speed of the middle of its rear axle, a front wheel at
(L_j, y_j) from there rolls without sliding if

    tan phi_j = L_j w / (v - y_j w),  so that  w / v = tan phi_j / (L_j + y_j tan phi_j),       (2)

by which every steered wheel gives the tangent t_j = L w / v of the one on the middle line, L ahead, with L the mean of
L_j. The car's signals are m, m t with t the mean of t_j, and, of two rear wheels, the difference of their rates.

phi of sample k is the mean of phi(k-1) and phi(k), measured at the ends of the samples; the first sample holds phi(1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.arrays import Array
from omnibench.robot.wheels.wheel import Wheel

FASTEST = 100.0  # rad/s; chosen, above the wheels of usual robots
FASTEST_RIM = 5.0  # m/s, of small wheels, which turn faster; chosen


def fastest_rates(radii: Array) -> Array:
    """Rates (N,), rad/s, that no wheels of radii (N,), m, exceed."""
    rates: Array = np.maximum(FASTEST, FASTEST_RIM / radii)
    return rates


@dataclass(frozen=True)
class Drive:
    """The drive signals of a robot's measured wheels: Eq. (1) of each steered wheel, the rates of the others.

    wheels (N): names of the wheels with a measured rate. steered (S): of those with a measured steering angle. names
    (M): of the signals. pairs (N): index of the steering angle that turns each wheel; -1 for one that does not steer.
    """

    wheels: tuple[str, ...]
    steered: tuple[str, ...]
    names: tuple[str, ...]
    pairs: tuple[int, ...]

    @property
    def direct(self) -> bool:
        """True if the wheel rates are the signals."""
        return not self.steered

    def signals(self, rates: Array, steering: Array | None) -> Array:
        """Signals (F, M) of mean wheel rates (F, N), rad/s, at steering angles (F, S) in the samples' middles, rad."""
        if self.direct:
            return rates
        assert steering is not None  # there are steered wheels
        wheels, factors = self._columns
        table = np.concatenate([np.ones((len(rates), 1)), np.cos(steering), np.sin(steering)], axis=1)
        return rates.take(wheels, axis=1) * table.take(factors, axis=1)

    @cached_property
    def _columns(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Of each signal (M) the wheel, and the column of 1, cos phi (S), sin phi (S) by which its rate counts."""
        columns: list[tuple[int, int]] = []
        for wheel, pair in enumerate(self.pairs):
            columns += [(wheel, 0)] if pair < 0 else [(wheel, 1 + pair), (wheel, 1 + pair + len(self.steered))]
        wheels, factors = np.array(columns).T
        return wheels, factors

    def slopes(self, rates: Array, steering: Array | None) -> tuple[Array, Array]:
        """Derivatives (F, M, N) and (F, M, S) of the signals by the rates and by the steering angles in the middles."""
        by_rate = np.zeros((len(rates), len(self.names), len(self.wheels)))
        by_angle = np.zeros((len(rates), len(self.names), len(self.steered)))
        signal = 0
        for wheel, pair in enumerate(self.pairs):
            if pair < 0:
                by_rate[:, signal, wheel] = 1
                signal += 1
                continue
            assert steering is not None  # this wheel steers
            cosine, sine, both = np.cos(steering[:, pair]), np.sin(steering[:, pair]), slice(signal, signal + 2)
            by_rate[:, both, wheel] = np.column_stack([cosine, sine])
            by_angle[:, both, pair] = rates[:, wheel, None] * np.column_stack([-sine, cosine])
            signal += 2
        return by_rate, by_angle

    def commands(self, signals: Array) -> tuple[Array, Array]:
        """Wheel rates (F, N), rad/s, and steering angles (F, S), rad, that give signals (F, M): what to command.

        Steering angles lie within half a turn, and the rates of steered wheels are not negative; one that stands steers
        straight ahead.
        """
        rates, steering = np.empty((len(signals), len(self.wheels))), np.zeros((len(signals), len(self.steered)))
        signal = 0
        for wheel, pair in enumerate(self.pairs):
            if pair < 0:
                rates[:, wheel] = signals[:, signal]
                signal += 1
            else:
                along, across = signals[:, signal], signals[:, signal + 1]
                rates[:, wheel], steering[:, pair] = np.hypot(along, across), np.arctan2(across, along)
                signal += 2
        return rates, steering


@dataclass(frozen=True)
class CarDrive(Drive):
    """The drive signals of a car: mean rate, mean rate times the tangent of Eq. (2), and difference of two rates.

    ahead (S): L_j and y_j of every steered wheel as in Eq. (2), m.
    """

    ahead: tuple[tuple[float, float], ...]

    def signals(self, rates: Array, steering: Array | None) -> Array:
        assert steering is not None  # a car steers
        mean = rates.mean(axis=1)
        columns = [mean, mean * self._tangent(steering)]
        if rates.shape[1] == 2:
            columns.append(rates[:, 1] - rates[:, 0])
        return np.stack(columns, axis=1)

    def slopes(self, rates: Array, steering: Array | None) -> tuple[Array, Array]:
        assert steering is not None  # a car steers
        wheels = len(self.wheels)
        by_rate = np.zeros((len(rates), len(self.names), wheels))
        by_angle = np.zeros((len(rates), len(self.names), len(self.steered)))
        by_rate[:, 0] = 1 / wheels
        by_rate[:, 1] = self._tangent(steering)[:, None] / wheels
        by_rate[:, 2:] = (-1, 1)[:wheels]
        along, across = np.array(self.ahead).T
        tangents = np.tan(steering)
        slopes = along.mean() * along * (1 + tangents**2) / (along + across * tangents) ** 2 / len(along)
        by_angle[:, 1] = rates.mean(axis=1, keepdims=True) * slopes
        return by_rate, by_angle

    def commands(self, signals: Array) -> tuple[Array, Array]:
        mean = signals[:, 0]
        tangent = np.divide(signals[:, 1], mean, out=np.zeros(len(mean)), where=mean != 0)[:, None]
        along, across = np.array(self.ahead).T
        steering: Array = np.arctan(along * tangent / (along.mean() - across * tangent))
        rates = np.repeat(mean[:, None], len(self.wheels), axis=1)
        if signals.shape[1] == 3:
            rates += signals[:, 2:] * (-0.5, 0.5)
        return rates, steering

    def _tangent(self, steering: Array) -> Array:
        """Mean t (F,) of the tangents by which the steering angles (F, S) turn the car, Eq. (2)."""
        along, across = np.array(self.ahead).T
        tangents = np.tan(steering)
        mean: Array = (along.mean() * tangents / (along + across * tangents)).mean(axis=1)
        return mean


@lru_cache(maxsize=64)
def drive_of(wheels: tuple[Wheel, ...]) -> Drive:
    """The drive signals of a robot's wheels; those that are not measured are left out."""
    rolling = [wheel for wheel in wheels if wheel.has_rate]
    steered = [wheel for wheel in wheels if wheel.has_steering]
    names, angles = tuple(wheel.name for wheel in rolling), tuple(wheel.name for wheel in steered)
    pairs = tuple(angles.index(wheel.name) if wheel.has_steering else -1 for wheel in rolling)
    guiding = [wheel.position for wheel in steered if not wheel.has_rate]
    if guiding and rolling:
        x, y = np.mean([wheel.position for wheel in rolling], axis=0).tolist()
        ahead = tuple((front - x, left - y) for front, left in guiding)
        return CarDrive(names, angles, ("mean", "mean_tan", "difference")[: 1 + len(rolling)], pairs, ahead)
    signals = ((name,) if pair < 0 else (f"{name}_cos", f"{name}_sin") for name, pair in zip(names, pairs, strict=True))
    return Drive(names, angles, tuple(name for each in signals for name in each), pairs)


def in_the_middle(steering: Array) -> Array:
    """Steering angles (F, S) in the middles of the samples from those at their ends, rad; the first one holds."""
    before = np.vstack([steering[:1], steering[:-1]])
    middle: Array = (before + steering) / 2
    return middle
