"""Roots of information matrices, by which scores become independent and of unit variance."""

from __future__ import annotations

import numpy as np

from omnibench.robot.kinematics import Array

# Share of the largest eigenvalue or variance below which another one is rounding: far above the rounding of products
# between columns (1e-15), and far below a direction of wheel rates that are a hundredth of the strongest (1e-4).
ROUNDING = 1e-12


def roots_of(information: Array) -> Array:
    """Roots R (n, d) with R'AR = 1 of a positive semi-definite matrix A (n, n).

    Directions whose eigenvalue is rounding are left out: R R' is the pseudo-inverse of A.
    """
    values, vectors = np.linalg.eigh(information)
    known = values > ROUNDING * values.max(initial=0.0)
    roots: Array = vectors[:, known] / np.sqrt(values[known])
    return roots
