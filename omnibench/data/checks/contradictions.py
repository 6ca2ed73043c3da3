"""Steering angles of one wheel by which the wheels contradict each other, whatever the reference is.

Of a robot that has more drive signals than ways to move, a twist gives signals in the range of E Z only (E: from twist
to signals, Z: the twists in which no fixed wheel slides). What lies outside is noise, slip and design; or one wheel
that is misread, which the others outvote in the odometry: 10 degrees of one of four leave a misfit of 0.03 there.
"""

from __future__ import annotations

import numpy as np

from omnibench.data.checks.misfit import EXPLAINED, Reading, Recording
from omnibench.data.checks.odd_steering import (
    DEGREE,
    LEAST_ZERO,
    best_zero,
    clockwise,
    frozen,
    in_degrees,
    scaled,
    zero_in_words,
)
from omnibench.robot.kinematics import Array

# Share of the signals outside of the range (chosen): 10 degrees of one of four wheels leave 0.06; radii all 5 %
# off the design leave 0.04, of which no single wheel explains much.
_SUSPICIOUS = 0.03


def contradictions(recording: Recording) -> list[str]:
    """A warning of the steered wheel whose angle, read otherwise, lets the wheels agree; empty if there is none."""
    drive = recording.robot.drive
    names, count = drive.steered, len(drive.steered)
    outside = _outside(recording.robot.signal_equations @ recording.robot.allowed_basis)
    present = _share(recording, outside)
    if max(drive.pairs) < 1 or present < _SUSPICIOUS:  # one steered wheel may be as wrong as all others together
        return []

    def share(reading: Reading) -> float:
        return _share(recording.reread(steering=reading), outside)

    readings: list[tuple[float, str]] = []
    for wheel, group in enumerate(np.eye(count)):
        signs = [-1 if index == wheel else 1 for index in range(count)]
        readings.append((share(scaled(wheel, count, -1.0)), clockwise(f"wheel {names[wheel]}", signs)))
        readings.append((share(scaled(wheel, count, DEGREE)), in_degrees(names, wheel)))
        zero, left = best_zero(group, share)
        if abs(zero) >= LEAST_ZERO:
            readings.append((left, zero_in_words(recording, group, round(zero))))
    least, words = min(readings)
    return [words] if least < EXPLAINED * present else frozen(recording)


def _share(recording: Recording, outside: Array) -> float:
    """Share of the drive signals that no twist gives."""
    signals = np.concatenate(
        [log.signals * np.sqrt(np.diff(log.times, prepend=0.0))[:, None] for log in recording.logs]
    )
    whole = float(np.linalg.norm(signals))
    return float(np.linalg.norm(signals @ outside)) / whole if whole else 0.0


def _outside(equations: Array) -> Array:
    """The projection (M, M) that takes from signals those that a twist gives."""
    within, strengths, _ = np.linalg.svd(equations, full_matrices=False)
    within = within[:, strengths > 1e-9 * strengths[0]]
    outside: Array = np.eye(len(equations)) - within @ within.T
    return np.where(np.abs(outside) < 1e-12, 0.0, outside)
