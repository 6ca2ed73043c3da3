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

# Stamps from which on the program is compiled anew for every step: prepared, it would take memory that grows with their
# square. Both ways solve the same program; half of it and twice change nothing (tests/studies/constants_fit.py).
_MOST_PREPARED = 5000

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


class SumOfNormsProgram:
    """Minimises sum_s shares_s * norm(residuals_s + jacobian_s @ d) over steps d in a box, for any shares.

    residuals (S, k), jacobian (S, k, n), lower and upper (n,). newton_steps, cone_programs: how many were made so far.
    """

    def __init__(self, residuals: Array, jacobian: Array, lower: Array, upper: Array) -> None:
        count, components, size = jacobian.shape
        self._residuals, self._jacobian = residuals, jacobian
        self._lower, self._upper = lower, upper
        self.newton_steps = self.cone_programs = 0
        # Steps in units of the box and residuals in units of their size keep the program well scaled.
        self._unit = np.where(upper > lower, (upper - lower) / 2, 1.0)
        reach = jacobian * self._unit
        scale = max(float(np.linalg.norm(residuals, axis=1).mean()), 1e-6 * float(np.abs(reach).max()), 1e-12)
        self._step = cp.Variable(size)
        columns = reach.reshape(count * components, size) / scale
        moved = cp.reshape(columns @ self._step + residuals.ravel() / scale, (count, components), order="C")
        self._shares = cp.Parameter(count, nonneg=True)
        constraints = [self._step >= lower / self._unit, self._step <= upper / self._unit]
        self._program = cp.Problem(cp.Minimize(self._shares @ cp.norm(moved, 2, axis=1)), constraints)

    def step(self, shares: Array) -> Array:
        """The best step (n,) for shares (S,) >= 0. Raises SolverError."""
        if len(shares) >= _MANY and (step := self._by_newton(shares / shares.sum())) is not None:
            return step
        self.cone_programs += 1
        self._shares.value = shares / shares.sum()
        # A program that cvxpy prepares for changing shares takes memory that grows with the square of their number.
        solve_program(self._program, ignore_dpp=len(shares) > _MOST_PREPARED)
        return np.clip(self._step.value * self._unit, self._lower, self._upper)

    def _by_newton(self, shares: Array) -> Array | None:
        """The best step (n,) by Eq. (1); None where it is not found inside the box."""
        free = self._upper > self._lower
        unit = self._unit[free]
        columns, step = self._jacobian[..., free] * unit, np.zeros(len(unit))
        errors = self._residuals
        for _ in range(_MOST_STEPS):
            self.newton_steps += 1
            sizes = np.linalg.norm(errors, axis=1)
            value, used = float(shares @ sizes), shares > 0
            if (sizes[used] <= _VANISHING * value).any():
                return None
            directions = errors / np.maximum(sizes, 1e-300)[:, None]
            along = np.einsum("sk,skn->sn", directions, columns)
            weighted = np.sqrt(shares / np.maximum(sizes, 1e-300))
            spread = (columns * weighted[:, None, None]).reshape(-1, len(unit))
            reach = along * weighted[:, None]
            slope, curvature = shares @ along, spread.T @ spread - reach.T @ reach
            strengths = np.linalg.eigvalsh(curvature)
            if strengths[0] <= _SINGULAR * strengths[-1]:  # a direction that nothing determines
                return None
            change = -np.linalg.solve(curvature, slope)
            gain = -float(slope @ change)
            if gain <= _NO_GAIN * value:
                best = np.zeros(len(free))
                best[free] = (step + change) * unit
                inside = (best > self._lower) & (best < self._upper)
                return best if inside[free].all() else None
            part = 1.0
            while shares @ np.linalg.norm(errors + columns @ (part * change), axis=1) > value - part * gain / 4:
                part /= 2
                if part < _LEAST_PART:
                    return None
            step = step + part * change
            errors = self._residuals + columns @ step
        return None


def solve_program(problem: Any, ignore_dpp: bool = False) -> None:
    """Solve a cvxpy problem with Clarabel, at its own accuracy where ours is not reached. Raises SolverError."""
    for accuracy in (_ACCURACY, {}):
        try:
            with warnings.catch_warnings():  # the status is checked below, and only steps that lower the cost are taken
                warnings.simplefilter("ignore", UserWarning)
                problem.solve(solver=cp.CLARABEL, ignore_dpp=ignore_dpp, **accuracy)
            break
        except cp.error.SolverError:
            continue
    else:
        raise SolverError("rounding stopped Clarabel, the solver of cone programs")
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise SolverError(f"Clarabel ended with status {problem.status!r}")
