"""Intervals of estimates whose variances are estimates themselves: half-widths by Student's t."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from omnibench.robot.kinematics import Array

INTERVAL = 0.95  # probability of the intervals, by convention; every table of the program says 95 %
# Degrees of freedom that stand for infinity: the quantile of Student's t differs from the normal one by 2e-9 there.
MANY = 1e9
_ROUNDING = 1e-12  # share of the largest derivative: a smaller one is rounding


@dataclass(frozen=True, eq=False)
class EstimatedCovariance:
    """Covariance (n, n) of n numbers, and degrees of freedom (n,) of their variances, or one for all."""

    matrix: Array
    degrees_of_freedom: Array | float = np.inf

    def of(self, slopes: Array) -> EstimatedCovariance:
        """Covariance of q functions of the numbers, with derivatives (q, n), and degrees of freedom of their variances.

        The reciprocal of a function's degrees of freedom is the mean of those of the numbers, weighted by their shares
        in its variance: what depends on one number has that number's, and numbers that agree give theirs.
        """
        weights = np.abs(slopes * (slopes @ self.matrix))
        freedom = np.broadcast_to(np.minimum(self.degrees_of_freedom, MANY), len(self.matrix))
        reciprocals = (weights / freedom).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-300)
        return EstimatedCovariance(slopes @ self.matrix @ slopes.T, 1 / np.maximum(reciprocals, 1 / MANY))

    @property
    def standard_deviations(self) -> Array:
        """Standard deviations (n,)."""
        return np.sqrt(np.maximum(np.diag(self.matrix), 0.0))

    @property
    def reach(self) -> Array:
        """Half-widths (n,) of the 95 % intervals."""
        quantile = stdtrit(np.minimum(self.degrees_of_freedom, MANY), (1 + INTERVAL) / 2)
        return np.asarray(quantile * self.standard_deviations)


def depending(slopes: Array, inputs: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which functions (q,) with derivatives (q, n) depend on one of the n inputs that are marked."""
    return np.asarray((np.abs(slopes[:, inputs]) > _ROUNDING * np.abs(slopes).max()).any(axis=1))
