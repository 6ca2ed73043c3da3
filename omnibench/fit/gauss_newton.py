"""Gauss-Newton steps of a trajectory fit within the box of a calibration problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.trajectory_fit import Estimate, Linearisation, TrajectoryFit, Weighting
from omnibench.robot.kinematics import Array

_MOST_STEPS = 30
_MOST_HALVINGS = 12
_RANK = 1e-12  # share of the strongest direction below which one is not determined at all
_NO_GAIN = 1e-6  # of the objective


@dataclass(frozen=True, eq=False)
class Descent:
    """Where the steps led: the estimate, the fit about it, and whether it has settled there."""

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
    """Steps within the box until one of the vector is smaller than ``tolerance`` standard errors.

    deviations (3,): of the nuisances, 0 for one that is held. Every vector that is tried is counted by
    ``problem.cost``; where the cost is not finite the way does not lead.
    """
    for _ in range(_MOST_STEPS):
        linear = fit.linearise(estimate, weightings, deviations)
        total = linear.information.sum(axis=0)
        step = bounded_step(problem, estimate.vector, total, linear.scores.sum(axis=0))
        nuisances = linear.nuisance_steps(step)
        small = float(step @ total @ step) < tolerance**2
        for halvings in range(_MOST_HALVINGS):
            share = 0.5**halvings
            vector = np.clip(estimate.vector + share * step, problem.lower, problem.upper)
            trial = Estimate(vector, estimate.nuisances + share * nuisances)
            if not np.isfinite(problem.cost(vector[None])[0]):
                small = False
                continue
            chi2 = fit.chi2(trial, weightings, deviations)
            if chi2 <= linear.chi2 * (1 + 1e-12):
                break
        else:  # of a small step it is the kinks of the recorded path that lead nowhere
            return Descent(estimate, linear, small)
        estimate = trial
        if small and linear.chi2 - chi2 < max(tolerance, _NO_GAIN * linear.chi2):
            return Descent(estimate, linear, True)
    return Descent(estimate, linear, False)


def bounded_step(problem: CalibrationProblem, vector: Array, information: Array, score: Array) -> Array:
    """The step (n,) within the box that minimises d'A d / 2 + g'd; none along directions that A does not know."""
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
        room = 1e-9  # of the box: lsq_linear wants some, and the vector is clipped
        bounds = (np.minimum(low, 0.0) - room, np.maximum(high, 0.0) + room)
        inner = lsq_linear(roots[:, None] * directions.T, target, bounds=bounds, tol=1e-12).x
    step[free] = inner * unit
    return step
