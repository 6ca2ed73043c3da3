"""Uncertainty of a calibration: covariance of the matrix elements, and of the physical parameters that they mean.

Under a robust loss the sandwich takes these score vectors of the runs. With the ratios x = r / s of the norms r_i of
weighted errors e_i to their scale s, psi(x) = x w(x) and u = e / |e|, a run's share of the loss sum_i p_i s^2 rho(x_i)
has, with the derivatives J_i of e_i by the fitted numbers, the score and the Hessian

    sum_i p_i w(x_i) J_i'e_i,   sum_i p_i J_i' (w(x_i) (1 - u_i u_i') + psi'(x_i) u_i u_i') J_i.               (1)

The scale counts as known: for errors whose distribution is even it is not correlated with what is fitted (Huber 1981,
section 6.4). A fit of p numbers to n errors makes the mean of psi' too large; its curvature is less by

    1 + p/n var(psi') / mean(psi')^2                                                                          (2)

(Huber 1981, section 7.6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.bootstrap import ElementIntervals
from omnibench.fit.calibrator import RunResult
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.loss import RobustCost, loss_of, norms_of
from omnibench.fit.noise import GIVEN, covariance_of_sums, roots_of
from omnibench.fit.open_combinations import elements_open
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.ratio_intervals import units_of
from omnibench.fit.reference_rows import ReferenceBatch
from omnibench.fit.sandwich import Sandwich, Scores, covariance_of_rows, sandwich, scores_of_references, scores_of_runs
from omnibench.fit.trajectory_fit import EstimatedCovariance, depending, noise_of_matrix
from omnibench.robot.calibration import EffectTerm, Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch
from omnibench.robot.physical import PhysicalReading, read_matrix
from omnibench.views import Brief
from omnibench.words import plural

# The check that an answer is a minimum says the same with half of _MOST_STEPS and _NO_GAIN and with twice
# (tests/studies/constants_fit.py).
_MOST_STEPS = 20  # steps
_NO_GAIN = 1e-4  # relative decrease of the cost that ends the steps
# Least share 1 - p/n of the errors' numbers beyond those fitted by which the curvature is corrected: first order in p/n
# says nothing below it. Four runs, the fewest for the nine elements of three wheels, leave just as much. With half of
# it nothing changes; with twice, deviations from four runs are 29 % smaller, and of the 95 % intervals from four and
# five runs 99.5 % hold the truth in the place of 99.8 %, in 60 sets each (tests/studies/constants_fit.py).
_LEAST_LEFT = 0.25

Basis = Literal["likelihood", "scatter", "posterior"]


def robust_scores(
    objective: RobustCost,
    odometry: OdometryBatch | ReferenceBatch,
    errors: Array,
    jacobian: Array,
    trajectories: Sequence[Trajectory],
    noise: Noise,
) -> Scores:
    """Score vectors and Hessians of the runs, Eq. (1).

    errors (S, 3): odometry minus reference at the cost's stamps. jacobian (S, 3, n): their derivatives by the searched
    numbers; second derivatives of the poses are neglected.
    """
    base, loss = objective.base, objective.loss
    factors = np.array(base.weights)
    used = np.flatnonzero(factors)
    errors, slopes = errors[:, used] * factors[used], jacobian[:, used] * factors[used, None]
    owner, shares = odometry.trajectory, base.shares(odometry.trajectory)
    norms = np.linalg.norm(errors, axis=1)
    ratios = norms / loss.scales(norms[None], shares)[0]
    weights = loss.weights(ratios)
    units = errors / np.maximum(norms, np.finfo(float).tiny)[:, None]
    bent = loss.slopes(ratios)[:, None, None] * units[:, :, None] * units[:, None, :]  # psi' - w = x w'
    curvatures = shares[:, None, None] * (weights[:, None, None] * np.eye(len(used)) + bent)  # (S, k, k)
    curved = curvatures @ slopes
    pulls = np.einsum("ski,sk->si", slopes, (shares * weights)[:, None] * errors)
    runs = range(len(trajectories))
    hessians = np.array([np.einsum("ski,skj->ij", slopes[owner == run], curved[owner == run]) for run in runs])
    correction = _correction(weights + loss.slopes(ratios), shares, len(trajectories) * len(used), hessians)
    by_errors = curved * factors[used][:, None]
    if isinstance(odometry, ReferenceBatch):
        whole = np.zeros((len(by_errors), 3, by_errors.shape[2]))
        whole[:, used] = by_errors
        working = [covariance_of_rows(odometry, run, whole[owner == run], noise) for run in runs]
    else:
        stamps = [log.stamps for log in objective.logs(trajectories)]
        working = [covariance_of_sums(noise, stamps[run], by_errors[owner == run], used.tolist()) for run in runs]
    scores = np.array([pulls[owner == run].sum(axis=0) for run in runs])
    roots = roots_of(np.einsum("s,ski,skj->ij", shares * weights, slopes, slopes))
    step = -roots @ roots.T @ scores.sum(axis=0)
    return Scores(scores, hessians / correction, trajectories, step, np.array(working))


def _correction(curvatures: Array, shares: Array, numbers: int, hessians: Array) -> float:
    """Eq. (2) for psi' (S,) with shares (S,), of a fit to so many numbers."""
    fitted = np.linalg.matrix_rank(hessians.sum(axis=0), hermitian=True)
    mean = float(curvatures @ shares)
    spread = float(np.square(curvatures - mean) @ shares)
    return 1 + float(fitted) / numbers * spread / mean**2 if mean > 0 else 1.0


class NoCovarianceError(DataError):
    """A calibration has no covariance; the message says why, in one line."""


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty(Brief):
    """Uncertainty of a calibration, given that the values it kept are right.

    covariance (3N, 3N): the elements' covariance, row by row, m and rad per rad of wheel. Rows and columns of elements
    that are held at their start are zero, with scatter as the basis also those on a bound, and so is the variance
    along directions of wheel rates that were kept at the design values. standard_deviations (3, N). intervals: 95 %, by
    Student's t; nan where an element depends on a number that the box holds or that lies on a bound of it, about which
    the answers of other recordings do not scatter evenly, or on a combination that references other than poses leave
    open. degrees_of_freedom (3N,): of the elements' variances. noise: the reference poses'. basis: likelihood (the
    calibrator's own covariance), scatter of the runs, or posterior of either and the design. source: the data behind
    it, in words.
    """

    covariance: Array
    standard_deviations: Array
    intervals: ElementIntervals
    degrees_of_freedom: Array
    noise: Noise
    basis: Basis
    source: str


def uncertainty_of(problem: CalibrationProblem, result: RunResult) -> Uncertainty:
    """The uncertainty of a calibrator's answer.

    The covariance is the calibrator's own if it gives one (trajectory_ml), otherwise the sandwich of an estimate that
    minimises a sum of norms. An element that depends on a number that the box holds, or that lies on a
    bound of it, has no interval.

    NoCovarianceError, with the reason, when there is no answer, the cost is no sum of norms, the answer is no minimum
    (a published matrix, a search that stopped too early), has effects beside the matrix, or the runs are too few.
    """
    if result.matrix is None or result.vector is None:
        raise NoCovarianceError(f"no covariance without an answer: {result.reason}")
    if result.extension is not None:
        names = ", ".join(dict.fromkeys(term.name for term in result.extension.effects))
        raise NoCovarianceError(f"no intervals: those of a matrix do not hold beside {names}, by which it is corrected")
    answer = covariance_of_answer(problem, result)
    of_vector = answer.of_vector
    slopes = problem.parameterisation.slopes(result.vector)
    of_elements = of_vector.of(slopes)
    bounded = depending(slopes, problem.without_interval(result.at_bounds))
    untold = bounded | elements_open(problem.parameterisation)
    reach = np.where(untold, np.nan, of_elements.reach).reshape(result.matrix.shape)
    return Uncertainty(
        covariance=of_elements.matrix,
        standard_deviations=of_elements.standard_deviations.reshape(result.matrix.shape),
        intervals=ElementIntervals(result.matrix - reach, result.matrix + reach),
        degrees_of_freedom=np.broadcast_to(of_elements.degrees_of_freedom, bounded.shape),
        noise=answer.noise,
        basis=answer.basis,
        source=answer.source,
    )


@dataclass(frozen=True, eq=False)
class AnswerCovariance:
    """The covariance of a searched vector, the noise of the reference poses; basis and source as in Uncertainty.

    steadied (n, n): the covariance, where it rests on the scatter of few runs drawn to a working model's.
    """

    of_vector: EstimatedCovariance
    steadied: Array
    noise: Noise
    basis: Basis
    source: str


def covariance_of_answer(problem: CalibrationProblem, result: RunResult) -> AnswerCovariance:
    """The calibrator's own covariance of its answer, or else that of the scatter. NoCovarianceError says why not."""
    assert result.matrix is not None  # callers have checked
    loss = loss_of(problem.objective)
    posed = any(run.has_poses for run in problem.trajectories)
    noise = result.noise if posed else GIVEN.noise
    noise = noise or noise_of_matrix(problem.trajectories, result.matrix, problem.integration, loss).noise
    if result.covariance is None:
        scatter = _by_scatter(problem, result, noise)
        estimated = EstimatedCovariance(scatter.covariance, scatter.effective_freedom)
        return AnswerCovariance(estimated, scatter.steadied, noise, "scatter", scatter.words)
    freedom = np.inf if result.degrees_of_freedom is None else result.degrees_of_freedom
    basis: Basis = "likelihood" if result.shrinkage is None else "posterior"
    source = "the calibrator's own (see its reason)" if result.shrinkage is None else result.shrinkage.source
    estimated = EstimatedCovariance(result.covariance, freedom)
    return AnswerCovariance(estimated, result.covariance, noise, basis, source)


def _by_scatter(problem: CalibrationProblem, result: RunResult, noise: Noise) -> Sandwich:
    """Sandwich covariance (n, n) of the vector."""
    objective = problem.objective
    assert result.vector is not None and result.matrix is not None  # noqa: PT018 (uncertainty_of has checked)
    base = norms_of(objective)
    if base is None:
        raise NoCovarianceError(f"no covariance: the cost {objective.name} is no sum of norms")
    if runs := runs_without_heading(problem):
        shown = ", ".join(runs[:3]) + ", ..." * (len(runs) > 3)
        raise NoCovarianceError(
            f"no covariance: the positions of {plural(len(runs), 'run')} ({shown}) do not tell which way the robot "
            "looked at the start, and the cost counts them all the same; trajectory_ml does not, and has intervals"
        )
    free = problem.free & ~np.isin(problem.names, result.at_bounds)
    if not problem.parameterisation.slopes(result.vector)[:, free].any():
        raise NoCovarianceError(
            "no covariance: no number was free to be fitted; each is kept at its design value or lies on a bound"
        )
    if result.cost is not None and result.cost <= objective.rounding:
        raise NoCovarianceError(
            "no covariance: the answer fits the runs exactly, and their scatter about it is what a covariance rests on"
        )
    try:
        scores = _scores(problem, result.vector, free, noise)
        curved = scores
        if not isinstance(objective, RobustCost) and not isinstance(problem.odometry, ReferenceBatch):
            # A fit of p numbers to n errors shortens them by sqrt(1 - p/n), and the curvature of a norm is the
            # reciprocal of its length: the correction of M-estimates for small samples (Huber 1981, section 7.6), to
            # first order in p/n.
            numbers = len(problem.trajectories) * sum(map(bool, base.weights))
            fitted = np.linalg.matrix_rank(scores.hessians.sum(axis=0), hermitian=True)
            curved = replace(scores, hessians=np.sqrt(max(1 - fitted / numbers, _LEAST_LEFT)) * scores.hessians)
        answer = sandwich(curved)
        _check_minimum(problem, result.vector, free, scores, noise)
    except NoCovarianceError:
        raise
    except DataError as error:
        raise NoCovarianceError(f"no covariance: {error}") from None
    covariance, model = np.zeros((2, problem.size, problem.size))
    freedom = np.ones(problem.size)
    covariance[np.ix_(free, free)], model[np.ix_(free, free)] = answer.covariance, answer.model
    freedom[free] = answer.effective_freedom
    return replace(answer, covariance=covariance, model=model, effective_freedom=freedom)


def runs_without_heading(problem: CalibrationProblem) -> list[str]:
    """Ids of the runs whose positions do not tell their start heading, which a cost counts as they are.

    The heading is then fitted to noise, which makes lengths wrong by more than the runs scatter: with 8 of 28 runs
    turning on the spot 74 % of the 95 % intervals hold the truth, without them 97 %, 40 and 24 sets
    (tests/studies/reference_coverage.py --robots diff --kinds position --calibrator closed_form).
    """
    if not isinstance(problem.odometry, ReferenceBatch):
        return []
    rows = problem.odometry.rows
    return sorted({rows.runs[index].id for index in rows.trajectory[rows.tells_no_heading].tolist()})


def _scores(problem: CalibrationProblem, vector: Array, free: NDArray[np.bool_], noise: Noise) -> Scores:
    """Score vectors of the runs in the free numbers, at a vector (n,)."""
    objective = problem.objective
    matrix = problem.matrix(vector)
    errors = problem.odometry.poses(matrix[None])[0] - problem.reference
    slopes = problem.parameterisation.slopes(vector)[:, free]
    jacobian = problem.odometry.jacobian(matrix).reshape(len(errors), 3, -1) @ slopes
    if isinstance(objective, RobustCost):
        return robust_scores(objective, problem.odometry, errors, jacobian, problem.trajectories, noise)
    assert isinstance(objective, SumOfNorms)  # _by_scatter has checked
    odometry = problem.odometry
    if isinstance(odometry, ReferenceBatch):
        return scores_of_references(objective, odometry, errors, jacobian, problem.trajectories, noise)
    return scores_of_runs(objective, odometry, errors, jacobian, problem.trajectories, noise)


def _check_minimum(
    problem: CalibrationProblem, vector: Array, free: NDArray[np.bool_], scores: Scores, noise: Noise
) -> None:
    """Raise NoCovarianceError if steps to a lower cost lead farther than a standard deviation, as estimated there."""
    better, cost = vector, float(problem.values(vector[None])[0])
    for _ in range(_MOST_STEPS):
        moved = better.copy()
        moved[free] += scores.step
        value = float(problem.values(moved[None])[0])
        if not value < cost * (1 - _NO_GAIN):
            break
        better, cost = moved, value
        scores = _scores(problem, better, free, noise)
    deviations = np.sqrt(np.maximum(np.diag(sandwich(scores).covariance), 0.0))
    away = np.abs(better - vector)[free]
    count = float(np.max(away[deviations > 0] / deviations[deviations > 0], initial=0.0))
    if count > 1.0:
        raise NoCovarianceError(
            f"no covariance: the answer does not minimise the cost (a better one is at least {count:.0f} standard "
            "deviations away); search longer or take another calibrator"
        )


def physical_parameters(
    problem: CalibrationProblem,
    result: RunResult,
    uncertainty: Uncertainty | None,
    effects: Sequence[EffectTerm] = (),
    *,
    fitted_mount: bool = False,
) -> PhysicalReading:
    """The physical parameters of a calibrator's answer with its effects.

    Those that need directions of wheel rates which the data do not identify have no interval, whether or not these
    directions were fitted, nor have those that depend on a number that the box holds, or that lies on a bound of it.
    """
    assert result.vector is not None and result.matrix is not None  # noqa: PT018 (callers have checked)
    covariance: Array | None = None
    freedom: Array | float = np.inf
    if uncertainty is not None:
        covariance, freedom = uncertainty.covariance, uncertainty.degrees_of_freedom
    elif result.extension is not None and result.extension.covariance is not None:
        covariance = np.array(result.extension.covariance)
        freedom = max(units_of(problem.trajectories).count - 1, 1)  # it scatters as they do
    held = problem.without_interval(result.at_bounds)
    unknown = [
        np.kron(np.eye(3), problem.unidentified),
        problem.parameterisation.slopes(result.vector)[:, held].T,
    ]
    if problem.left_open is not None:
        unknown.append(problem.left_open * np.repeat(problem.robot.row_scales, result.matrix.shape[1]))
    return read_matrix(
        problem.robot,
        result.matrix,
        covariance,
        freedom,
        effects,
        fitted_mount=fitted_mount,
        unknown=np.concatenate(unknown),
    )
