"""Warnings of wrong units and swapped wheels, with which the recordings would make more sense."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import OdometryBatch, WheelLog
from omnibench.robot.planar import wrapped

_DEGREE = math.pi / 180
# Units that a column may have been recorded in: factor to the SI unit, and warning.
_RATES = (
    (1.0, ""),
    (2 * math.pi / 60, "wheel rates look like rpm; omega_* must be rad/s"),
    (_DEGREE, "wheel rates look like deg/s; omega_* must be rad/s"),
)
_HEADINGS = ((1.0, ""), (_DEGREE, "theta looks like degrees; it must be rad"))
_POSITIONS = (
    (1.0, ""),
    (1e-3, "positions look like mm; x and y must be m"),
    (1e-2, "positions look like cm; x and y must be m"),
)
_MOST_TRAJECTORIES = 24  # trajectories checked, at most (chosen)
# Misfit of the design model (chosen): errors of calibration, slip and noise stay below, wrong units and wheels do not.
_SUSPICIOUS = 0.15
_EXPLAINED = 0.35  # share of the misfit that may remain with an explanation (chosen)


def implausible(robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array]) -> list[str]:
    """Warnings about units and wheels, from a comparison of the reference with the design model's odometry.

    ``poses`` (K, 3) of each log are as recorded, at the log's stamps; headings may be wrapped.
    """
    if not any(log.rates.any() for log in logs):
        return ["the wheels never turn; check the omega_* columns"]
    every = math.ceil(len(logs) / _MOST_TRAJECTORIES)
    recording = _Recording(robot, logs[::every], poses[::every])
    design = robot.inverse_kinematic_matrix
    misfit = recording.misfits(design[None])[0]
    if misfit < _SUSPICIOUS:
        return []
    units = [unit for unit in _odd_units(recording, design) if unit.misfit < _EXPLAINED * misfit]
    single = [unit for unit in units if len(unit.warnings) == 1]  # the simplest explanation first
    explanations = single or [*units, *_odd_wheels(recording, design)]
    best = min(explanations, key=lambda explanation: explanation.misfit, default=None)
    return list(best.warnings) if best and best.misfit < _EXPLAINED * misfit else []


@dataclass(frozen=True)
class _Explanation:
    """Warnings of what may be wrong, and the misfit that remains if they are right."""

    warnings: tuple[str, ...]
    misfit: float


class _Recording:
    """Moments of some runs: path since the start of the run, and turn since the moment before."""

    def __init__(self, robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array]) -> None:
        moments = [_moments(log, robot.inverse_kinematic_matrix[2]) for log in logs]
        seen_from_start = [
            WheelLog(log.times, log.rates, np.zeros(3), log.stamps[chosen])
            for log, chosen in zip(logs, moments, strict=True)
        ]
        self._odometry = OdometryBatch(seen_from_start, "arc")
        self._poses = np.concatenate([pose[chosen] for pose, chosen in zip(poses, moments, strict=True)])
        self._starts = np.array([pose[0] for pose in poses])[self._odometry.trajectory]
        self._first = np.diff(self._odometry.trajectory, prepend=-1) > 0
        self._length = float(np.mean([wheel.distance for wheel in robot.wheels]))  # m: mean lever arm of the wheels
        self.wheels = robot.wheel_names

    def misfits(self, matrices: Array, metre: float = 1.0, radian: float = 1.0) -> Array:
        """Misfit (P,) of matrices (P, 3, N) to the reference, from 0 (exact) to 1 (unrelated).

        metre, radian: units of the recorded positions, in m, and headings, in rad.
        """
        odometry = self._odometry.poses(matrices)
        moved = (self._poses - self._starts) * [metre, metre, radian]
        path = (moved[:, 0] + 1j * moved[:, 1]) * np.exp(-1j * radian * self._starts[:, 2])
        driven = odometry[..., 0] + 1j * odometry[..., 1]
        turned = self._turns(odometry[..., 2])
        # Whole turns between two moments do not show in the headings.
        missed = wrapped(turned - self._turns(moved[:, 2]))
        lengths = (np.abs(driven) + np.abs(path)).sum(axis=1)
        angles = (np.abs(turned) + np.abs(turned - missed)).sum(axis=1)
        # Noise and slip may amount to a radian and the robot's size at every moment, and to more while it turns.
        count, rims = len(self._poses), np.abs(turned).sum(axis=1)
        position = np.abs(driven - path).sum(axis=1) / (lengths + self._length * (rims + count))
        heading = np.abs(missed).sum(axis=1) / (angles + count)
        runs = np.count_nonzero(self._first)
        still = (lengths < runs * self._length) & (angles < runs)  # a robot at rest fits any matrix
        return np.where(still, 1.0, np.maximum(position, heading))

    def _turns(self, headings: Array) -> Array:
        """Turns (..., S) since the moment before from headings since the start."""
        turns: Array = headings - np.where(self._first, 0.0, np.roll(headings, 1, axis=-1))
        return turns


def _moments(log: WheelLog, row_3: Array) -> NDArray[np.intp]:
    """Indices of a log's stamps between which the odometry turns by a radian or more, and the last index."""
    turned = np.cumsum((log.rates @ row_3) * np.diff(log.times, prepend=0.0))
    headings = np.interp(log.stamps, np.append(0.0, log.times), np.append(0.0, turned))
    chosen, last = [], headings[0]
    for index, heading in enumerate(headings):
        if abs(heading - last) >= 1.0:
            chosen.append(index)
            last = heading
    return np.unique([*chosen, len(headings) - 1])


def _odd_units(recording: _Recording, design: Array) -> list[_Explanation]:
    matrices = np.array([factor * design for factor, _ in _RATES])
    explanations = []
    for (metre, position), (radian, heading) in product(_POSITIONS, _HEADINGS):
        for misfit, (_, rate) in zip(recording.misfits(matrices, metre, radian), _RATES, strict=True):
            explanations.append(_Explanation(tuple(text for text in (rate, heading, position) if text), float(misfit)))
    return explanations


def _odd_wheels(recording: _Recording, design: Array) -> list[_Explanation]:
    """The order and signs of the wheels that explain the reference best, if there are not too many to try."""
    names = recording.wheels
    if len(names) > 4:
        return []
    arrangements = list(product(permutations(range(len(names))), product((1, -1), repeat=len(names))))
    misfits = recording.misfits(np.array([_rearranged(design, order, signs) for order, signs in arrangements]))
    best = int(misfits.argmin())
    order, signs = arrangements[best]
    shown = ", ".join(
        f"{name} <- {'-' if sign < 0 else ''}{names[column]}"
        for name, column, sign in zip(names, order, signs, strict=True)
    )
    warning = (
        f"wheels look swapped or sign-flipped; the reference fits with omega of {shown} "
        "(importer csv: wheel_columns and wheel_signs set them right)"
    )
    return [_Explanation((warning,), float(misfits[best]))]


def _rearranged(matrix: Array, order: Sequence[int], signs: Sequence[int]) -> Array:
    """The columns of ``matrix`` for recordings whose wheel i is signs[i] times column order[i]."""
    result = np.empty_like(matrix)
    for wheel, (column, sign) in enumerate(zip(order, signs, strict=True)):
        result[:, column] = sign * matrix[:, wheel]
    return result
