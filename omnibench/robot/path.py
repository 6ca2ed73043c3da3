"""Path of a robot with constant twist within every sample, at any times: Eq. (1) and (2), or exact arcs."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex, Integration, locate


class Path:
    """The path of F samples.

    times (F,): their ends, s. start (3,): pose at t = 0. moved (F, 3): motion in the robot's frame, m, m, rad. drift
    (F, 2): further displacement in the reference's frame, m; None for none.
    """

    def __init__(
        self, times: Array, start: Array, moved: Array, integration: Integration, drift: Array | None = None
    ) -> None:
        self._times, self._arc = times, integration == "arc"
        self._moved = moved
        self._drift: Complex = np.zeros(len(moved), dtype=complex) if drift is None else drift[:, 0] + 1j * drift[:, 1]
        self._headings = start[2] + np.concatenate([[0.0], np.cumsum(moved[:, 2])])
        steps = self._steps(moved, self._headings[:-1]) + self._drift
        self._positions: Complex = complex(start[0], start[1]) + np.concatenate([[0.0], np.cumsum(steps)])

    @cached_property
    def ends(self) -> Array:
        """Poses (F + 1, 3) at the start and at the end of each sample."""
        return np.column_stack([self._positions.real, self._positions.imag, self._headings])

    @property
    def middles(self) -> Array:
        """Means (F, 3) of the poses before and after each sample."""
        middles: Array = (self.ends[1:] + self.ends[:-1]) / 2
        return middles

    def poses(self, stamps: Array) -> Array:
        """Poses (S, 3) in m, m, rad at stamps (S,) in s, in any order; headings are not wrapped.

        Before t = 0 it is the start pose, after the last sample the pose at its end.
        """
        sample, share = locate(self._times, stamps)
        piece = share[:, None] * self._moved[sample]
        heading = self._headings[sample]
        position = self._positions[sample] + self._steps(piece, heading) + share * self._drift[sample]
        return np.column_stack([position.real, position.imag, heading + piece[:, 2]])

    def lengths(self, stamps: Array) -> Array:
        """Distances driven along the path, backwards too, up to stamps (S,) in s, in any order, m."""
        sample, share = locate(self._times, stamps)
        speeds = np.abs(self._moved[:, 0] + 1j * self._moved[:, 1] + self._drift * np.exp(-1j * self._headings[:-1]))
        before = np.concatenate([[0.0], np.cumsum(speeds)])
        lengths: Array = before[sample] + share * speeds[sample]
        return lengths

    def _steps(self, moved: Array, headings: Array) -> Complex:
        """x + iy of motions (n, 3) that begin with headings (n,)."""
        steps: Complex = moved[:, 0] + 1j * moved[:, 1]
        if not self._arc:
            return steps * np.exp(1j * headings)
        half = moved[:, 2] / 2
        return steps * (np.sinc(half / np.pi) * np.exp(1j * (headings + half)))
