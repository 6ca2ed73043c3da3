"""Gauss-Newton steps within the box of a calibration problem: of a trajectory fit, and to a robust cost's minimum.

The latter reweights: at the weights w of fit/loss.py, Eq. (5), of the present errors e_i, a step d minimises

    sum_i p_i w_i |e_i + J_i d|^2,                                                                        (1)

which for linear poses lowers the cost with every step (iteratively reweighted least squares: its squares lie above the
loss and touch it; Lange, Hunter and Yang, J. Comput. Graph. Stat. 9:1, 2000). It is halved where curved poses do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.calibrator import Solution
from omnibench.fit.loss import RobustCost
from omnibench.fit.noise import roots_of
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.reference_fit import ReferenceFit, with_references
from omnibench.fit.trajectory_fit import Nuisances, TrajectoryFit, Weighting, Whitened
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel

# Estimates of four recordings are the same with half of each of these numbers and with twice, except that shares of
# (0.5, 0.15, 0), without the whole step, move one with clocks by 0.15 of its standard deviation and a stated deviation
# by 14 %, and (2, 0.6, 0) by 0.008 and 0.5 % (tests/studies/constants_fit.py).
_MOST_STEPS = 25  # Gauss-Newton steps
_MOST_HALVINGS = 8  # lengths of one step that are tried, each half the one before
_SHARES = (1.0, 0.3, 0.0)  # parts of the nuisances' step that every run tries
# Decrease of chi2 that ends the steps with free nuisances: absolute, and as a share of chi2.
_NO_GAIN, _NO_SHARE = 1e-2, 1e-5
_ROUNDING = 1e-12  # share of chi2: an increase that is no increase
_ROOM = 1e-9  # share of the box: lsq_linear needs an interior, and the vector is clipped afterwards
_MOST_REWEIGHTED_STEPS = 300  # steps; 20 to 60 are usual
_MOST_REWEIGHTED_HALVINGS = 30  # lengths of one step that are tried, each half the one before: down to a billionth


@dataclass(frozen=True, eq=False)
class BoxedFit:
    """The fit of one vector (n,) of a calibration problem to the problem's runs.

    trajectories: at the poses of the runs that have some. references: at the references other than poses, if any.
    """

    problem: CalibrationProblem
    vector: Array
    trajectories: TrajectoryFit
    references: ReferenceFit | None = None

    @property
    def runs(self) -> tuple[Trajectory, ...]:
        """The runs that are fitted."""
        if self.references is None:
            return self.trajectories.runs
        fitted = {run.id for run in (*self.trajectories.runs, *self.references.runs)}
        return tuple(run for run in self.problem.trajectories if run.id in fitted)

    def moved(self, vector: Array, values: Array) -> BoxedFit:
        """The fit of another vector, with other values (Z, 3) of the nuisances."""
        fit = self.trajectories
        model = replace(fit.model, matrix=self.problem.matrix(vector))
        moved = replace(fit, model=model, nuisances=replace(fit.nuisances, values=values))
        return replace(self, vector=vector, trajectories=moved)

    def with_nuisances(self, nuisances: Nuisances) -> BoxedFit:
        """The fit with other nuisances."""
        return replace(self, trajectories=replace(self.trajectories, nuisances=nuisances))

    @property
    def columns(self) -> list[Array]:
        """Derivatives (K, 3, n) of every run's poses by the vector."""
        if not self.trajectories.runs:
            return []
        slopes = self.problem.parameterisation.slopes(self.vector)
        return [of_run @ slopes for of_run in self.trajectories.matrix_jacobian()]

    def linearised(self, weightings: Sequence[Weighting]) -> Whitened:
        """The fit's columns and residuals, weighted, the nuisances eliminated."""
        return self.joined(self.trajectories.linearised(self.columns, weightings) if self.trajectories.runs else None)

    def joined(self, by_poses: Whitened | None) -> Whitened:
        """The whitened poses with the references, whitened by their own uncertainty."""
        if self.references is None:
            assert by_poses is not None  # there are poses or references
            return by_poses
        matrix = self.problem.matrix(self.vector)
        white = self.references.whitened(matrix, self.problem.parameterisation.slopes(self.vector))
        return with_references(self.runs, self.trajectories.runs, by_poses, self.references.runs, white)

    def with_walk(self) -> BoxedFit:
        """The fit with the likeliest walk of the odometry beside its references other than poses, if there are any."""
        if self.references is None:
            return self
        slopes = self.problem.parameterisation.slopes(self.vector)
        return replace(self, references=self.references.with_walk(self.problem.matrix(self.vector), slopes))

    @property
    def freedom_of_walk(self) -> Callable[[Array], Array] | None:
        """Degrees of freedom (n,) of a covariance (n, n) that the walk of the odometry leaves; None without one."""
        references = self.references
        if references is None:
            return None
        matrix, slopes = self.problem.matrix(self.vector), self.problem.parameterisation.slopes(self.vector)
        return lambda covariance: references.freedom(matrix, slopes, covariance)

    @property
    def chi_square_of_references(self) -> float:
        """Sum of squares of the references' residuals in their standard deviations; 0 where there are none."""
        return 0.0 if self.references is None else self.references.chi_square(self.problem.matrix(self.vector))


def first_fit(problem: CalibrationProblem) -> BoxedFit:
    """The problem's start at the runs that have a reference after theirs, nuisances 0. DataError without any."""
    runs = tuple(run for run in problem.trajectories if run.has_poses)
    references = ReferenceFit.of(problem.trajectories, problem.matrix(problem.start), problem.integration)
    if not runs and references is None:
        raise DataError("no trajectory has a reference pose after its start; nothing can be fitted")
    model = OdometryModel(problem.robot, problem.matrix(problem.start), problem.integration)
    nuisances = Nuisances(np.zeros((len(runs), 3)), np.zeros(3))
    return BoxedFit(problem, problem.start, TrajectoryFit(model, runs, nuisances), references)


@dataclass(frozen=True, eq=False)
class Descent:
    """Result of a descent: the fit, its linearisation, and settled: True if it has converged."""

    fit: BoxedFit
    data: Whitened
    settled: bool


def descend(fit: BoxedFit, weightings: Sequence[Weighting], tolerance: float) -> Descent:
    """Gauss-Newton steps within the box until a step of the vector is below ``tolerance`` standard errors.

    The recorded path has a kink at every sample, and so has the objective as a function of a clock's offset. Every run
    therefore takes the part of its nuisances' step that lowers chi2 most; when that lowers chi2 no more, the vector
    converges with the nuisances held.

    ``problem.cost`` counts every vector that is tried; a vector whose cost is not finite is rejected.
    """
    deviations = fit.trajectories.nuisances.deviations
    if deviations.any():
        after = float(fit.trajectories.chi_square(weightings).sum())
        for _ in range(_MOST_STEPS):
            before = after
            lower, size = _step(fit, weightings)
            if lower is None:
                break
            fit = lower
            after = float(fit.trajectories.chi_square(weightings).sum())
            if size < tolerance or before - after < _NO_GAIN + _NO_SHARE * after:
                break
    fit = fit.with_nuisances(fit.trajectories.nuisances.held())
    settled = False
    for _ in range(_MOST_STEPS):
        lower, size = _step(fit, weightings)
        settled = size < tolerance and lower is not None
        if lower is None:
            finite = bool(np.isfinite(fit.problem.cost(fit.vector[None])[0]))
            settled = size < 10 * tolerance and finite  # rounding hides the decrease
            break
        fit = lower
        if settled:
            break
    fit = fit.with_nuisances(replace(fit.trajectories.nuisances, deviations=deviations))
    return Descent(fit, fit.linearised(weightings), settled)


def _step(fit: BoxedFit, weightings: Sequence[Weighting]) -> tuple[BoxedFit | None, float]:
    """The fit after one step, None if no part of it lowers chi2, and the step's size in standard errors."""
    problem, runs = fit.problem, fit.trajectories
    columns = fit.columns
    data = fit.joined(runs.linearised(columns, weightings) if runs.runs else None)
    whole = bounded_step(problem, fit.vector, data.information, -data.scores.sum(axis=0))
    size = math.sqrt(max(float(whole @ data.information @ whole), 0.0))
    limit = (float(runs.chi_square(weightings).sum()) + fit.chi_square_of_references) * (1 + _ROUNDING)
    shares = _SHARES if runs.nuisances.estimated.any() else (0.0,)
    free = runs.nuisance_free_residuals if runs.runs else []
    for halvings in range(_MOST_HALVINGS):
        step = 0.5**halvings * whole
        vector = np.clip(fit.vector + step, problem.lower, problem.upper)
        if not np.isfinite(problem.cost(vector[None])[0]):
            continue
        predicted = [residuals - slopes @ step for residuals, slopes in zip(free, columns, strict=True)]
        change = runs.likeliest_nuisances(weightings, predicted) - runs.nuisances.values
        trials = [fit.moved(vector, runs.nuisances.values + share * change) for share in shares]
        values = np.array([trial.trajectories.chi_square(weightings) for trial in trials])
        best = values.argmin(axis=0)
        if values.min(axis=0).sum() + trials[0].chi_square_of_references <= limit:
            nuisances = np.array([trial.trajectories.nuisances.values for trial in trials])
            return fit.moved(vector, nuisances[best, np.arange(len(best))]), size
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
    information = information[np.ix_(free, free)] * np.outer(unit, unit)
    roots = roots_of(information)
    target = -roots.T @ (score[free] * unit)
    inner = roots @ target
    low, high = ((bound - vector)[free] / unit for bound in (problem.lower, problem.upper))
    if ((inner < low) | (inner > high)).any() and roots.size:
        bounds = (np.minimum(low, 0.0) - _ROOM, np.maximum(high, 0.0) + _ROOM)
        inner = scipy.optimize.lsq_linear(roots.T @ information, target, bounds=bounds, tol=1e-12).x
    step[free] = inner * unit
    return step


def reweighted_minimum(
    problem: CalibrationProblem, objective: RobustCost, vector: Array, tolerance: float
) -> tuple[Array, int, bool]:
    """The vector (n,) of least cost near another one, after how many steps, and True if the last was small.

    objective: may have another loss than the problem's. tolerance: largest change of a matrix element in the last step.
    ``problem.cost`` counts every vector that is tried.
    """
    owner = problem.odometry.trajectory
    factors = np.array(objective.base.weights)
    shares = objective.base.shares(owner)
    for count in range(1, _MOST_REWEIGHTED_STEPS + 1):
        matrix = problem.matrix(vector)
        errors = problem.odometry.poses(matrix[None])[0] - problem.reference
        slopes = problem.parameterisation.slopes(vector)
        jacobian = problem.odometry.jacobian(matrix).reshape(len(errors), 3, -1) @ slopes
        roots = np.sqrt(shares * objective.weights(errors, owner))[:, None] * factors
        columns, values = (roots[..., None] * jacobian).reshape(-1, len(vector)), (roots * errors).ravel()
        step = bounded_step(problem, vector, columns.T @ columns, columns.T @ values)  # Eq. (1)
        cost = float(objective.combine(errors[None], owner)[0])
        for halvings in range(_MOST_REWEIGHTED_HALVINGS):
            trial = problem.settled(vector + 0.5**halvings * step)
            if not np.isfinite(problem.cost(trial[None])[0]):
                continue
            poses = problem.odometry.poses(problem.matrix(trial)[None])[0]
            if float(objective.combine((poses - problem.reference)[None], owner)[0]) <= cost * (1 + _ROUNDING):
                break
        else:
            return vector, count, bool(np.abs(slopes @ step).max() < 100 * tolerance)
        moved = np.abs(problem.matrix(trial) - matrix).max()
        vector = trial
        if moved < tolerance:
            return vector, count, True
    return vector, _MOST_REWEIGHTED_STEPS, False


def minimum_in_turn(
    problem: CalibrationProblem, costs: Sequence[RobustCost], vector: Array, tolerance: float, steps_name: str
) -> Solution:
    """The minimum of the last of some costs, each searched from that of the one before, the first from ``vector``."""
    steps, settled = 0, True
    for cost in costs:
        vector, count, settled = reweighted_minimum(problem, cost, vector, tolerance)
        steps += count
    return Solution(vector, f"{'' if settled else 'not '}settled after {steps} {steps_name} steps", settled)
