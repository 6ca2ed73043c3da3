"""Minimising a weighted sum of norms of affine residuals in a box: a second-order cone program (cvxpy, Clarabel).

Of many residuals e_s(d) = r_s + J_s d Newton's method is ten to a hundred times as fast. With their directions
u_s = e_s / |e_s| the sum f = sum_s w_s |e_s| has

    f' = sum_s w_s J_s' u_s,    f'' = sum_s w_s / |e_s| J_s' (1 - u_s u_s') J_s.                          (1)

f is convex, so that a minimum inside the box is that of the program. Where a residual vanishes, or the minimum lies on
a bound, f has no such derivatives there, and the cone program decides.
"""

from __future__ import annotations

import warnings
from typing import Any

import cvxpy as cp
import numpy as np

from omnibench.errors import OmnibenchError
from omnibench.robot.kinematics import Array

# Relative and absolute gaps, tighter than Clarabel's defaults (1e-8) and near the rounding of its sums: the optimum is
# a reference that searches are measured against.
_ACCURACY = {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-12}

# Stamps from which on Newton's method is tried first: it takes an eighth of the program's time there, and none of 36
# drawn sums of 1,000 to 4,000 stamps was higher by it (lower by 1e-15 to 5e-14). Fewer keep the program's results.
_MANY = 1000

# Newton's method: most steps; residuals, as shares of their mean, that count as vanished; the decrease, as a share of
# the sum, after which one more step reaches rounding, as convergence is quadratic; the least part of a step. Chosen:
# where they stop too early, the cone program decides.
_MOST_STEPS, _VANISHING, _NO_GAIN, _LEAST_PART = 30, 1e-9, 1e-16, 1e-6
_SINGULAR = 1e-12  # share of the largest curvature: less is rounding (chosen)


class SolverError(OmnibenchError):
    """The solver did not reach an optimum."""


def least_step(residuals: Array, jacobian: Array, shares: Array, lower: Array, upper: Array) -> tuple[Array, int, int]:
    """The step d (n,) in a box that minimises sum_s shares_s * norm(residuals_s + jacobian_s @ d).

    residuals (S, k), jacobian (S, k, n), shares (S,) >= 0, lower and upper (n,). Also returns how many Newton steps and
    cone programs were made. Raises SolverError.
    """
    count, components, size = jacobian.shape
    shares, newton_steps = shares / shares.sum(), 0
    # Steps in units of the box and residuals in units of their size keep the program well scaled.
    unit = np.where(upper > lower, (upper - lower) / 2, 1.0)
    if count >= _MANY:
        step, newton_steps = _newton_step(residuals, jacobian, shares, lower, upper, unit)
        if step is not None:
            return step, newton_steps, 0
    reach = jacobian * unit
    scale = max(float(np.linalg.norm(residuals, axis=1).mean()), 1e-6 * float(np.abs(reach).max()), 1e-12)
    variable = cp.Variable(size)
    columns = reach.reshape(count * components, size) / scale
    moved = cp.reshape(columns @ variable + residuals.ravel() / scale, (count, components), order="C")
    constraints = [variable >= lower / unit, variable <= upper / unit]
    solve_program(cp.Problem(cp.Minimize(shares @ cp.norm(moved, 2, axis=1)), constraints))
    return np.clip(variable.value * unit, lower, upper), newton_steps, 1


def _newton_step(
    residuals: Array, jacobian: Array, shares: Array, lower: Array, upper: Array, unit: Array
) -> tuple[Array | None, int]:
    """The best step (n,) by Eq. (1), None where it is not found inside the box; and how many steps were made."""
    free = upper > lower
    unit = unit[free]
    columns, step, errors = jacobian[..., free] * unit, np.zeros(len(unit)), residuals
    for count in range(1, _MOST_STEPS + 1):
        sizes = np.linalg.norm(errors, axis=1)
        value, used = float(shares @ sizes), shares > 0
        if (sizes[used] <= _VANISHING * value).any():
            return None, count
        directions = errors / np.maximum(sizes, 1e-300)[:, None]
        along = np.einsum("sk,skn->sn", directions, columns)
        weighted = np.sqrt(shares / np.maximum(sizes, 1e-300))
        spread = (columns * weighted[:, None, None]).reshape(-1, len(unit))
        reach = along * weighted[:, None]
        slope, curvature = shares @ along, spread.T @ spread - reach.T @ reach
        strengths = np.linalg.eigvalsh(curvature)
        if strengths[0] <= _SINGULAR * strengths[-1]:  # a direction that nothing determines
            return None, count
        change = -np.linalg.solve(curvature, slope)
        gain = -float(slope @ change)
        if gain <= _NO_GAIN * value:
            best = np.zeros(len(free))
            best[free] = (step + change) * unit
            inside = (best > lower) & (best < upper)
            return (best if inside[free].all() else None), count
        part = 1.0
        while shares @ np.linalg.norm(errors + columns @ (part * change), axis=1) > value - part * gain / 4:
            part /= 2
            if part < _LEAST_PART:
                return None, count
        step = step + part * change
        errors = residuals + columns @ step
    return None, _MOST_STEPS


def solve_program(problem: Any) -> None:
    """Solve a cvxpy problem with Clarabel, at its own accuracy where ours is not reached. Raises SolverError."""
    for accuracy in (_ACCURACY, {}):
        try:
            with warnings.catch_warnings():  # the status is checked below, and only steps that lower the cost are taken
                warnings.simplefilter("ignore", UserWarning)
                problem.solve(solver=cp.CLARABEL, **accuracy)
            break
        except cp.error.SolverError:
            continue
    else:
        raise SolverError("rounding stopped Clarabel, the solver of cone programs")
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise SolverError(f"Clarabel ended with status {problem.status!r}")
