"""True motion of a simulated robot: constant twists integrated about their centres of rotation, on code of its own.

With the twist (vx, vy, w) in the frame of a pose (p, theta), positions as complex numbers, a robot is after a time s at

    p + exp(i theta) (vx + i vy) (exp(i w s) - 1) / (i w).                                            (1)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex, Integration

_SMALL = 1e-4  # rad: below it the series of Eq. (1) is exact to rounding


class TrueMotion:
    """Motion with a constant twist within every sample.

    times (F,): the samples' ends, s. start (3,): pose at t = 0. twists (F, 3): in the robot's frame, m/s, m/s, rad/s.
    drift (F, 2): velocity that is added in the reference's frame, m/s. integration: ``euler`` moves straight ahead
    within a sample and turns at its end.
    """

    def __init__(
        self, times: Array, start: Array, twists: Array, integration: Integration, drift: Array | None = None
    ) -> None:
        self._begins, self._ends = np.append(0.0, times[:-1]), times
        self._twists, self._exact = twists, integration == "arc"
        self._drift: Complex = np.zeros(len(times), complex) if drift is None else drift[:, 0] + 1j * drift[:, 1]
        lengths = times - self._begins
        self._headings = start[2] + np.append(0.0, np.cumsum(twists[:, 2] * lengths))
        steps = self._travel(np.arange(len(times)), lengths)
        self._positions: Complex = complex(start[0], start[1]) + np.append(0.0, np.cumsum(steps))

    def poses(self, stamps: Array) -> Array:
        """Poses (K, 3) at stamps (K,), s; before t = 0 and after the last sample the robot stands."""
        held = np.clip(stamps, 0.0, self._ends[-1])
        sample = np.minimum(np.searchsorted(self._ends, held), len(self._ends) - 1)
        passed = held - self._begins[sample]
        position = self._positions[sample] + self._travel(sample, passed)
        heading = self._headings[sample] + self._twists[sample, 2] * passed
        return np.column_stack([position.real, position.imag, heading])

    def _travel(self, sample: NDArray[np.intp], seconds: Array) -> Complex:
        """Displacements (K,) within samples (K,) after some seconds (K,) of each, Eq. (1)."""
        vx, vy, turn = self._twists[sample].T
        velocity: Complex = (vx + 1j * vy) * np.exp(1j * self._headings[sample])
        angle = 1j * turn * seconds
        series = 1 + angle / 2 * (1 + angle / 3 * (1 + angle / 4))
        exact = np.divide(np.expm1(angle), angle, out=series.copy(), where=np.abs(angle) > _SMALL)
        return (velocity * (exact if self._exact else 1.0) + self._drift[sample]) * seconds
