"""A box of matrices, in which the fast evaluator answers and lower bounds hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from omnibench.fit.parameterisation import ParameterisationName
from omnibench.robot.kinematics import Array

# Share by which the box of a curved parameterisation is widened beyond its linear reach. Candidates outside are
# integrated directly, so that it decides on speed alone: half of it and twice change costs by 4e-14 m and the memory by
# a third at most (tests/studies/constants_fit.py).
_MARGIN = 0.1
_ROUNDING = 1e-9, 1e-15  # shares of the reach and of a row's largest element by which a box is widened against rounding


class _Matrices(Protocol):
    """What a box is made around."""

    @property
    def name(self) -> ParameterisationName: ...
    def matrices(self, vectors: Array) -> Array: ...


@dataclass(frozen=True, eq=False)
class ElementBox:
    """Bounds ``lower`` and ``upper`` (3, N) of the matrix elements."""

    lower: Array
    upper: Array

    @classmethod
    def of(cls, parameterisation: _Matrices, lower: Array, upper: Array) -> ElementBox:
        """The box around the matrices of all vectors between ``lower`` and ``upper`` (n,).

        It holds all of them where the matrix is linear in the vector, and nearly all where it is curved.
        """
        middle, half = (lower + upper) / 2, (upper - lower) / 2
        centre, *moved = parameterisation.matrices(middle + np.vstack([np.zeros(len(half)), np.diag(half)]))
        reach: Array = np.abs(np.array(moved) - centre).sum(axis=0)
        reach *= 1 + (_ROUNDING[0] if parameterisation.name == "matrix" else _MARGIN)
        slack = _ROUNDING[1] * np.abs(centre).max(axis=1, keepdims=True)
        return cls(centre - reach - slack, centre + reach + slack)

    @property
    def centre(self) -> Array:
        """The middle (3, N)."""
        return (self.lower + self.upper) / 2

    @property
    def reach(self) -> Array:
        """Half-widths (3, N)."""
        return (self.upper - self.lower) / 2

    @property
    def largest(self) -> Array:
        """The largest magnitudes (3, N) of the elements."""
        return np.maximum(np.abs(self.lower), np.abs(self.upper))

    @property
    def speed(self) -> Array:
        """The largest |m1j + i m2j| (N,) in the box, m per rad."""
        speed: Array = np.hypot(*self.largest[:2])
        return speed
