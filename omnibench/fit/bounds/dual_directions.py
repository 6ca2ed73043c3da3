"""Vectors u_s in the unit ball that make a lower bound tight: the dual solution of a sum of norms in a box.

The bound holds for any u_s (lower_bound.py); the best are u_s = e_s / |e_s| at the minimiser of the sum of norms

    sum_s share_s |e_s|,   e_s = r_s + J_s v,   lower <= v <= upper,                              (D1)

because sum_s share_s J_s^T u_s vanishes there (or points out of the box), so that phi does not fall with v. Iteratively
reweighted least squares (Daubechies, DeVore, Fornasier and Guentuerk, Comm. Pure Appl. Math. 63:1, 2010) minimises

    sum_s share_s w_s |r_s + J_s v|^2   with   w_s = 1 / sqrt(|e_s|^2 + eps^2)                    (D2)

at the e_s before, with eps falling in steps. The residuals times w_s of the last step,

    u_s = w_s e_s,                                                                                (D3)

solve its normal equations exactly, so that they are balanced even where residuals vanish.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from omnibench.robot.kinematics import Array

# These numbers change how tight a bound is, not whether it holds. In tests/benchmarks/constants_fit.py each is halved
# and doubled: _SMOOTHING and _SETTLED then move the bound by 4 % and 0.3 % of the gap that is asked for, the others not
# at all.
_STEPS = 25  # steps of the reweighted least squares
_SMOOTHING = 3.0  # digits: eps falls to this negative power of ten of the mean norm
# The reweighting ends when no deviation changes by more, in units in which the normal equations' diagonal is 1.
_SETTLED = 1e-5
_RIDGE = 1e-13  # added to the normalised normal equations, which are singular where the data leave a direction open
_INSIDE = 1 - 1e-14  # length of the vectors: the margin covers the rounding of their norm, some 1e-15


class Minimum(NamedTuple):
    """An approximate minimiser (n,) of Eq. (D1) and its directions (S, k), Eq. (D3)."""

    point: Array
    directions: Array


def least_sum_of_norms(
    residuals: Array, jacobian: Array, shares: Array, lower: Array, upper: Array, begin: Array
) -> Minimum:
    """Minimise sum_s shares_s |residuals_s + jacobian_s v| over v (n,) in the box; residuals (S, k)."""
    free = (upper > lower) & (np.abs(jacobian).max(axis=(0, 1)) > 0)
    point = np.clip(begin, lower, upper)
    errors = residuals + jacobian @ point
    weights = 1 / np.maximum(np.linalg.norm(errors, axis=1), 1e-300)
    fixed, moving = residuals + jacobian[:, :, ~free] @ point[~free], jacobian[:, :, free]
    columns = moving.reshape(fixed.size, moving.shape[2])
    for step in range(_STEPS if free.any() else 0):
        lengths = np.linalg.norm(errors, axis=1)
        weights = 1 / np.hypot(lengths, 1e-12 + lengths.mean() * 10.0 ** -min(1 + step / 2, _SMOOTHING))  # Eq. (D2)
        weighted = columns * np.repeat(shares * weights, fixed.shape[1])[:, None]
        normal, target = weighted.T @ columns, weighted.T @ fixed.ravel()
        scale = 1 / np.sqrt(np.diag(normal))
        factor = np.linalg.cholesky(normal * np.outer(scale, scale) + _RIDGE * np.eye(len(scale))).T
        wanted = -np.linalg.solve(factor.T, scale * target)
        best = scale * np.linalg.solve(factor, wanted)
        if (best < lower[free]).any() or (best > upper[free]).any():
            best = lsq_linear(factor / scale, wanted, (lower[free], upper[free]), method="bvls").x
        settled = 1 + step / 2 > _SMOOTHING and np.abs((best - point[free]) / scale).max() < _SETTLED
        point[free] = np.clip(best, lower[free], upper[free])
        errors = fixed + moving @ point[free]
        if settled:
            break
    return Minimum(point, errors * weights[:, None])  # Eq. (D3)


def into_unit_ball(directions: Array) -> tuple[Array, Array, Array]:
    """Vectors (S, k) of length about one in the unit ball: shrunk by one factor, each by its own, or all of length one.

    The first keeps the balance between the vectors, the second the short ones of residuals that vanish; the third is
    exact in a box without width.
    """
    lengths = np.linalg.norm(directions, axis=1)
    one_by_one = directions / np.maximum(1.0, lengths)[:, None] * _INSIDE
    of_length_one = directions / np.maximum(1e-300, lengths)[:, None] * _INSIDE
    return directions / max(1.0, float(lengths.max())) * _INSIDE, one_by_one, of_length_one
