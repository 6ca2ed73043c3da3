"""Gauss-Newton steps of a trajectory fit within the box of a calibration problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from omnibench.fit.least_squares.trajectory_fit import Estimate, Linearisation, TrajectoryFit, Weighting
from omnibench.fit.problem import CalibrationProblem
from omnibench.robot.kinematics import Array

_MOST_STEPS = 25  # Gauss-Newton steps; chosen
_MOST_HALVINGS = 8  # lengths of one step that are tried, each half the one before; chosen
_SHARES = (1.0, 0.3, 0.0)  # parts of the nuisances' step that every run tries
_RANK = 1e-12  # share of the largest eigenvalue of the information below which a direction is undetermined
# Decrease of chi2 that ends the steps with free nuisances: absolute, and as a share of chi2. Chosen.
_NO_GAIN, _NO_SHARE = 1e-2, 1e-5


@dataclass(frozen=True, eq=False)
class Descent:
    """Result of a descent: the estimate, the fit linearised about it, and settled: True if it has converged."""

    estimate: Estimate
    linear: Linearisation
    settled: bool


def descend(
    problem: CalibrationProblem,
    fit: TrajectoryFit,
    estimate: Estimate,
    weightings: Sequence[Weighting],
    deviations: Array,
    tolerance: float,
) -> Descent:
    """Gauss-Newton steps within the box until a step of the vector is below ``tolerance`` standard errors.

    deviations (3,): standard deviations of the nuisances, 0 for one that is held. The recorded path has a kink at every
    sample, and so has the objective as a function of a clock's offset. Every run therefore takes the part of its
    nuisances' step that lowers chi2 most; when that lowers chi2 no more, the vector converges with the nuisances held.

    ``problem.cost`` counts every vector that is tried; a vector whose cost is not finite is rejected.
    """
    move = _Move(problem, fit, weightings)
    linear = fit.linearise(estimate, weightings, deviations)
    if (deviations > 0).any():
        for _ in range(_MOST_STEPS):
            before = float(linear.chi2.sum())
            lower, size = move.step(estimate, linear, deviations)
            if lower is None:
                break
            estimate = lower
            linear = fit.linearise(estimate, weightings, deviations)
            after = float(linear.chi2.sum())
            if size < tolerance or before - after < _NO_GAIN + _NO_SHARE * after:
                break
    settled = False
    for _ in range(_MOST_STEPS):
        held = fit.linearise(estimate, weightings, np.zeros(3))
        lower, size = move.step(estimate, held, np.zeros(3))
        settled = size < tolerance and lower is not None
        if lower is None:
            settled = size < 10 * tolerance and move.is_finite(estimate.vector)  # rounding hides the decrease
            break
        estimate = lower
        if settled:
            break
    return Descent(estimate, fit.linearise(estimate, weightings, deviations), settled)


@dataclass(frozen=True, eq=False)
class _Move:
    """Steps of one fit that lower its chi2 within the box."""

    problem: CalibrationProblem
    fit: TrajectoryFit
    weightings: Sequence[Weighting]

    def is_finite(self, vector: Array) -> bool:
        """True if a vector (n,) has a finite cost."""
        return bool(np.isfinite(self.problem.cost(vector[None])[0]))

    def step(self, estimate: Estimate, linear: Linearisation, deviations: Array) -> tuple[Estimate | None, float]:
        """The estimate after one step, None if no part of it lowers chi2, and the step's size in standard errors."""
        problem, total = self.problem, linear.information.sum(axis=0)
        whole = bounded_step(problem, estimate.vector, total, linear.scores.sum(axis=0))
        size = float(np.sqrt(max(whole @ total @ whole, 0.0)))
        limit = float(linear.chi2.sum()) * (1 + 1e-12)
        for halvings in range(_MOST_HALVINGS):
            step = 0.5**halvings * whole
            vector = np.clip(estimate.vector + step, problem.lower, problem.upper)
            if not self.is_finite(vector):
                continue
            shares = _SHARES if (deviations > 0).any() else (0.0,)
            nuisance_steps = linear.nuisance_steps(step)
            trials = [Estimate(vector, estimate.nuisances + share * nuisance_steps) for share in shares]
            values = np.array([self.fit.chi2(trial, self.weightings, deviations) for trial in trials])
            best = values.argmin(axis=0)
            if values.min(axis=0).sum() <= limit:
                nuisances = np.array([trial.nuisances for trial in trials])[best, np.arange(len(best))]
                return Estimate(vector, nuisances), size
        return None, size


def bounded_step(problem: CalibrationProblem, vector: Array, information: Array, score: Array) -> Array:
    """The step d (n,) within the box that minimises d'A d / 2 + g'd; zero along directions without information.

    information (n, n): A. score (n,): g.
    """
    free = problem.free
    step = np.zeros(len(vector))
    if not free.any():
        return step
    unit = (problem.upper - problem.lower)[free]
    values, directions = np.linalg.eigh(information[np.ix_(free, free)] * np.outer(unit, unit))
    known = values > _RANK * max(float(values[-1]), 0.0)
    roots, directions = np.sqrt(values[known]), directions[:, known]
    target = -(directions.T @ (score[free] * unit)) / roots
    inner = directions @ (target / roots)
    low, high = ((bound - vector)[free] / unit for bound in (problem.lower, problem.upper))
    if ((inner < low) | (inner > high)).any() and known.any():
        room = 1e-9  # share of the box: lsq_linear needs an interior, and the vector is clipped afterwards
        bounds = (np.minimum(low, 0.0) - room, np.maximum(high, 0.0) + room)
        inner = lsq_linear(roots[:, None] * directions.T, target, bounds=bounds, tol=1e-12).x
    step[free] = inner * unit
    return step
