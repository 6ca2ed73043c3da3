"""Hypotheses on what changed, and stretches: the motion between two reference poses as a calibration predicts it.

Contacts of wheels with the ground slip independently of each other, so much that they turn the robot as its training
runs were turned: a random walk over the way of each contact, with half as much of the place beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from omnibench.live.health import Kind
from omnibench.live.odometry import UNKNOWN_NOISE
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array, CarDrive
from omnibench.robot.odometry import chord_shares
from omnibench.robot.physical import directions_of, read_matrix, unit_of

_UNSTATED: Final = 0.01  # of each row's largest element: what a calibration without a covariance does not know; chosen
_LARGEST_SHARE: Final = 0.5  # of a parameter, or rad, that a change is believed to be; chosen
_LEAST_SLIP: Final = 1e-4  # rad and m per root metre: nothing rolls more exactly; chosen
_ONE: Final = 1 - 1e-9  # cosine of two directions that are one but for rounding
_NO_ANGLE: Final = 1e-9  # rad or m in a stretch: an encoder that stands still
LEAST_STEP: Final = 0.02  # m and, times the reach, rad: smaller steps are slip; chosen


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """What may have changed: P directions (q, P) in the space of q, Eq. (G1), each per unit of its name.

    values (P,): the calibration's. kinds, units: of each. largest (P,): changes that are believed. prior (q, q):
    covariance P of Eq. (G3).
    """

    names: tuple[str, ...]
    kinds: tuple[Kind, ...]
    units: tuple[str, ...]
    values: Array
    directions: Array
    largest: Array
    prior: Array

    @classmethod
    def of(cls, calibration: Calibration) -> Hypotheses:
        """The hypotheses on the robot of a calibration."""
        robot, matrix = calibration.robot, calibration.matrix_array
        size = matrix.size
        count = size + 1
        rows: list[tuple[str, Kind, str, float, Array]] = []
        changes = directions_of(robot)
        covariance = None if calibration.covariance is None else np.array(calibration.covariance)
        reading = read_matrix(robot, matrix, covariance, effects=calibration.effects)
        known = {each.name: each.value for each in reading.parameters}  # none, where no wheels have this matrix
        floor = np.sum([design * change for n, (design, change) in changes.items() if n.startswith("radius")], axis=0)
        alike: list[
            Array
        ] = []  # directions of unit length: of two that are one, such as a car's radii, the first stays
        for name, (design, change) in changes.items():
            direction = change / np.linalg.norm(change)
            if not any(abs(float(direction @ other)) > _ONE for other in alike):
                alike.append(direction)
                rows.append((name, "change", unit_of(name), known.get(name, design), change))
        if not any(abs(float(floor @ other)) > _ONE * np.linalg.norm(floor) for other in alike):
            rows.append(("floor", "change", "1", 1.0, floor))
        scale = (matrix * np.array([[1.0], [1.0], [0.0]])).ravel()
        rows.append(("reference_scale", "reference", "1", 1.0, scale))
        directions = np.zeros((count, len(rows) + 1))
        directions[:size, : len(rows)] = np.column_stack([row[4] for row in rows])
        directions[-1, -1] = 1.0
        prior = np.zeros((count, count))
        if calibration.covariance is None:
            prior[:size, :size] = np.diag(np.repeat((_UNSTATED * robot.row_scales) ** 2, matrix.shape[1]))
        else:
            prior[:size, :size] = np.array(calibration.covariance)[:size, :size]
        return cls(
            (*(row[0] for row in rows), "reference_clock"),
            (*(row[1] for row in rows), "reference"),
            (*(row[2] for row in rows), "s"),
            np.array([*(row[3] for row in rows), 0.0]),
            directions,
            np.array([*(_LARGEST_SHARE * _size(row) for row in rows), 3.0]),
            prior,
        )


def _size(row: tuple[str, Kind, str, float, Array]) -> float:
    """The size of a hypothesis's parameter: its value, or 1 rad."""
    return 1.0 if row[2] == "rad" else abs(row[3])


@dataclass(frozen=True, eq=False)
class Stretch:
    """The motion between two reference poses, as a calibration predicts it, in the robot's frame at its begin.

    moved (3,): m, m, rad. slopes (3, q): its derivatives G. spread (3, 3): covariance that slip adds. rolled: m that
    the wheels rolled in the mean. way: m that the tracked point went. seconds: it took. begun, velocity (3,): at its
    begin and end, in the frame of its begin, m/s, m/s, rad/s. still: wheels that stood while others turned.
    """

    moved: Array
    slopes: Array
    spread: Array
    rolled: float
    way: float
    seconds: float
    begun: Array
    velocity: Array
    still: tuple[int, ...]


class Predictor:
    """Makes stretches of wheel samples, by a calibration's noise and geometry."""

    def __init__(self, calibration: Calibration) -> None:
        robot, noise, slip = calibration.robot, calibration.noise or UNKNOWN_NOISE, calibration.slip
        self._robot = robot
        self._arc = calibration.integration == "arc"
        self.reach, self._matrix, self._radii = robot.reach, calibration.matrix_array, robot.radii
        counts = [1] if isinstance(robot.drive, CarDrive) else [1 + wheel.has_steering for wheel in robot.measured]
        self.columns = np.cumsum([0, *counts[:-1]])  # first column of each wheel
        # Contacts slip independently, as much as turns the robot as its training runs were turned.
        turning = math.sqrt(float(np.square(self._matrix[2] / self._of_wheel(self._radii)).sum()))
        self._by_metre = slip is not None
        walk = noise.walk_heading or UNKNOWN_NOISE.walk_heading
        self._contact = max(walk if slip is None else slip.heading, _LEAST_SLIP) / max(turning, 1e-9)

    def _of_wheel(self, values: Array) -> Array:
        """Values (..., M) of the wheels of the drive signals, from those (..., N) of the wheels."""
        signals = self._matrix.shape[1]
        if self._robot.drive.direct:
            return values
        if isinstance(self._robot.drive, CarDrive):
            return np.repeat(values.mean(axis=-1, keepdims=True), signals, axis=-1)
        return np.repeat(values, [1 + wheel.has_steering for wheel in self._robot.measured], axis=-1)

    def stretch(self, moved: Array, driven: Array, seconds: Array) -> Stretch:
        """The stretch of n samples: motions (n, 3), integrals (n, M) of the drive signals, durations (n,), s."""
        turn = moved[:, 2]
        before = np.cumsum(turn) - turn
        unit = np.exp(1j * (before + turn / 2)) * chord_shares(turn / 2) if self._arc else np.exp(1j * before)
        steps = (moved[:, 0] + 1j * moved[:, 1]) * unit
        after = np.cumsum(steps)
        end = after[-1]
        lever = end - after + steps / 2  # from the middle of each sample to the end
        by_place, by_turn = unit @ driven, (1j * lever) @ driven
        signals = driven.shape[1]
        slopes = np.zeros((3, 3 * signals + 1))
        by_row = slopes[:, : 3 * signals].reshape(3, 3, signals)
        by_row[0] = by_place.real, -by_place.imag, by_turn.real
        by_row[1] = by_place.imag, by_place.real, by_turn.imag
        by_row[2, 2] = driven.sum(axis=0)
        rolled = np.hypot(moved[:, 0], moved[:, 1]) + self.reach * np.abs(turn)
        # Slip of each contact, and half as much of the place in all directions.
        metres = (
            np.abs(driven) * self._of_wheel(self._radii) if self._by_metre else np.repeat(seconds[:, None], signals, 1)
        )
        metres[rolled <= 0] = 0.0
        carried = np.zeros((len(seconds), 3, 3))
        carried[:, 0, 0] = carried[:, 1, 1] = unit.real
        carried[:, 1, 0], carried[:, 0, 1] = unit.imag, -unit.imag
        carried[:, 0, 2], carried[:, 1, 2], carried[:, 2, 2] = -lever.imag, lever.real, 1.0
        slipping = carried @ (self._matrix / self._of_wheel(self._radii)) * np.sqrt(metres)[:, None]
        slipping = np.swapaxes(slipping, 0, 1).reshape(3, -1)
        spread = slipping @ slipping.T
        spread[0, 0] += (anywhere := float(metres.mean(axis=1).sum()) / 4)
        spread[1, 1] += anywhere
        spread *= self._contact**2
        duration = float(seconds.sum())
        begun, velocity = (
            np.array([steps[k].real, steps[k].imag, turn[k]]) / max(float(seconds[k]), 1e-9) for k in (0, -1)
        )
        whole = np.array([end.real, end.imag, turn.sum()])
        way = float(np.abs(steps).sum())
        metres = np.add.reduceat(np.abs(driven).sum(axis=0) * self._of_wheel(self._radii), self.columns)
        still: tuple[int, ...] = ()
        if metres.max() > LEAST_STEP and metres.min() < _NO_ANGLE:
            still = tuple(np.flatnonzero(metres < _NO_ANGLE).tolist())
        return Stretch(whole, slopes, spread, float(rolled.sum()), way, duration, begun, velocity, still)
