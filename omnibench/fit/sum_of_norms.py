"""Minimising a weighted sum of norms of affine residuals in a box: a second-order cone program (cvxpy, Clarabel)."""

from __future__ import annotations

import warnings
from typing import Any

import cvxpy as cp
import numpy as np

from omnibench.errors import OmnibenchError
from omnibench.robot.kinematics import Array

# Tighter than Clarabel's defaults (1e-8): the optimum is a reference that searches are measured against.
_ACCURACY = {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-12}


class SolverError(OmnibenchError):
    """The solver did not reach an optimum."""


def least_squares(design: Array, target: Array, lower: Array, upper: Array) -> Array:
    """The x (n,) in the box that minimises the squares of design (m, n) @ x - target (m,)."""
    x = cp.Variable(design.shape[1])
    scale = max(float(np.abs(target).max(initial=0.0)), 1e-12)
    objective = cp.Minimize(cp.sum_squares((design @ x - target) / scale))
    _solve(cp.Problem(objective, [x >= lower, x <= upper]))
    return np.clip(x.value, lower, upper)


def minimise_sum_of_norms(
    residuals: Array, jacobian: Array, shares: Array, lower: Array, upper: Array, across: Array
) -> Array:
    """The step d (n,) in the box that minimises sum_s shares_s * norm(residuals_s + jacobian_s @ d).

    residuals (S, k), jacobian (S, k, n), shares (S,) >= 0, lower and upper (n,); ``across`` (q, n): directions that
    the step must not take. Raises SolverError.
    """
    count, components, size = jacobian.shape
    # Steps in units of the box and residuals in units of their size keep the program well scaled.
    unit = np.where(upper > lower, (upper - lower) / 2, 1.0)
    scale = max(float(shares @ np.linalg.norm(residuals, axis=1)) / float(shares.sum()), 1e-12)
    step = cp.Variable(size)
    columns = (jacobian * unit).reshape(count * components, size) / scale
    moved = cp.reshape(columns @ step + residuals.ravel() / scale, (count, components), order="C")
    constraints = [step >= lower / unit, step <= upper / unit]
    if len(across):
        constraints.append((across * unit) @ step == 0)
    _solve(cp.Problem(cp.Minimize(shares @ cp.norm(moved, 2, axis=1)), constraints))
    return np.clip(step.value * unit, lower, upper)


def _solve(problem: Any) -> None:
    try:
        with warnings.catch_warnings():  # the status is looked at below, and steps are only taken downhill
            warnings.simplefilter("ignore", UserWarning)
            problem.solve(solver=cp.CLARABEL, **_ACCURACY)
    except cp.error.SolverError as error:
        raise SolverError(f"Clarabel failed: {error}") from None
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise SolverError(f"Clarabel ended with status {problem.status!r}")
