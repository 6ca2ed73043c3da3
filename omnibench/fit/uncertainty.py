"""Uncertainty of a calibration: covariance of the matrix elements, and of the physical parameters that they mean.

It is the calibrator's own, or the jackknife (intervals.py) of an estimate that minimises a sum of norms p_i |e_i|, or
such a sum under a robust loss. With the direction u_i = e_i / |e_i| of a weighted error and its derivatives J_i by
the fitted numbers, such a sum has the slope and the Hessian (second derivatives of the poses are neglected)

    sum_i p_i w_i J_i' e_i,    sum_i p_i J_i' (w_i (1 - u_i u_i') + (w_i + b_i) u_i u_i') J_i.                (1)

Of a norm, smoothed to sqrt(|e|^2 + h^2) with h small against the errors, w = (|e|^2 + h^2)^(-1/2) and b = -|e|^2 w^3.
Of a robust loss w(x) and x w'(x) at x = |e| / s, the scale s counting as known (Huber, Robust Statistics, 1981, section
6.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.errors import DataError
from omnibench.fit.calibrator import RunResult
from omnibench.fit.cost import Cost
from omnibench.fit.intervals import Clusters, depending, jackknife
from omnibench.fit.loss import RobustCost, loss_of, norms_of
from omnibench.fit.noise import GIVEN, roots_of
from omnibench.fit.open_combinations import elements_open
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.reference_rows import ReferenceBatch
from omnibench.fit.trajectory_fit import noise_of_matrix
from omnibench.robot.calibration import EffectTerm, Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.physical import EstimatedCovariance, PhysicalReading, read_matrix
from omnibench.views import Brief
from omnibench.words import plural

# The check that an answer is a minimum says the same with half of _MOST_STEPS and _NO_GAIN and with twice
# (tests/studies/constants_fit.py).
_MOST_STEPS = 20  # steps
_NO_GAIN = 1e-4  # relative decrease of the cost that ends the steps
_INTERPOLATED = 1e-6  # share of the median error: smaller ones were made zero by the fit, up to rounding
# Width of the kernel, in medians of the errors times the number of runs to the power -1/5 (the rate of density
# estimates: Silverman, Density Estimation, 1986, section 3.3). Stated deviations of medians then are 0.78 to 1.19 times
# the true ones in the median, for four distributions and 12 to 144 runs (tests/studies/kernel_width.py).
_KERNEL = 0.7
_FEWEST = 2  # runs: one says nothing of how an estimate scatters

Basis = Literal["likelihood", "scatter", "posterior"]


class NoCovarianceError(DataError):
    """A calibration has no covariance; the message says why, in one line."""


@dataclass(frozen=True, eq=False)
class ElementIntervals:
    """95 % intervals (3, N) of the matrix elements; nan where there is none."""

    low: Array
    high: Array


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty(Brief):
    """Uncertainty of a calibration, given that the values it kept are right.

    covariance (3N, 3N): the elements' covariance, row by row, m and rad per rad of wheel. Rows and columns of elements
    that are held at their start are zero, with scatter as the basis also those on a bound, and so is the variance along
    directions of wheel rates that were kept at the design values. standard_deviations (3, N). intervals: 95 %, by
    Student's t; nan where an element depends on a number that the box holds or that lies on a bound of it, about which
    the answers of other recordings do not scatter evenly, or on a combination that references other than poses leave
    open. degrees_of_freedom (3N,): of the elements' variances. noise: the reference poses'. basis: likelihood (the
    calibrator's own covariance), scatter of the runs, or posterior of the runs and the design. source: the data behind
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

    An element that depends on a number that the box holds, or that lies on a bound of it, has no interval.
    NoCovarianceError, with the reason, when there is no answer, the cost is no sum of norms, the answer is no minimum
    (a published matrix, a search that stopped too early), has effects beside the matrix, or the runs are too few.
    """
    if result.matrix is None or result.vector is None:
        raise NoCovarianceError(f"no covariance without an answer: {result.reason}")
    if result.extension is not None and result.covariance is None:
        names = ", ".join(dict.fromkeys(term.name for term in result.extension.effects))
        raise NoCovarianceError(f"no intervals: those of a matrix do not hold beside {names}, by which it is corrected")
    clusters = Clusters.of(problem.trajectories)
    basis: Basis = "scatter"
    if result.covariance is None:
        of_vector = _by_scatter(problem, result, clusters)
    else:
        basis = "posterior" if result.covariance_source else "likelihood"
        freedom = np.inf if result.degrees_of_freedom is None else result.degrees_of_freedom
        of_vector = EstimatedCovariance(result.covariance, freedom)
    posed = any(run.has_poses for run in problem.trajectories)
    noise = result.noise if posed else GIVEN.noise
    if noise is None:
        loss = loss_of(problem.objective)
        noise = noise_of_matrix(problem.trajectories, result.matrix, problem.integration, loss).noise
    slopes = problem.parameterisation.slopes(result.vector)
    of_elements = of_vector.of(slopes)
    held = np.isin(problem.names, (*result.at_bounds, *result.held))  # the fit could not move these both ways
    untold = depending(slopes, held) | elements_open(problem.parameterisation)
    reach = np.where(untold, np.nan, of_elements.reach).reshape(result.matrix.shape)
    return Uncertainty(
        covariance=of_elements.matrix,
        standard_deviations=of_elements.standard_deviations.reshape(result.matrix.shape),
        intervals=ElementIntervals(result.matrix - reach, result.matrix + reach),
        degrees_of_freedom=np.broadcast_to(of_elements.degrees_of_freedom, untold.shape),
        noise=noise,
        basis=basis,
        source={"likelihood": "the calibrator's own (see its reason)", "posterior": result.covariance_source}.get(
            basis, clusters.words
        ),
    )


def _by_scatter(problem: CalibrationProblem, result: RunResult, clusters: Clusters) -> EstimatedCovariance:
    """Jackknife covariance (n, n) of the vector of a minimum."""
    objective = problem.objective
    assert result.vector is not None  # uncertainty_of has checked
    if norms_of(objective) is None:
        raise NoCovarianceError(f"no covariance: the cost {objective.name} is no sum of norms")
    # Positions of runs that do not tell their start heading count as they are. The heading is then fitted to noise,
    # which makes lengths wrong by more than the runs scatter: with 8 of 28 runs turning on the spot 74 % of the 95 %
    # intervals hold the truth, without them 97 %, 40 and 24 sets (tests/studies/reference_coverage.py --robots diff
    # --kinds position --calibrator closed_form).
    rows = problem.odometry.rows if isinstance(problem.odometry, ReferenceBatch) else None
    if rows is not None and rows.tells_no_heading.any():
        runs = sorted({rows.runs[index].id for index in rows.trajectory[rows.tells_no_heading].tolist()})
        shown = ", ".join(runs[:3]) + ", ..." * (len(runs) > 3)
        raise NoCovarianceError(
            f"no covariance: the positions of {plural(len(runs), 'run')} ({shown}) do not tell which way the robot "
            "looked at the start, and the cost counts them all the same; map does not, and has intervals"
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
    count, size = len(problem.trajectories), int(free.sum())
    if count < max(_FEWEST, -(-size // 3) + 1):  # a run has three numbers
        raise NoCovarianceError(
            f"no covariance: runs are too few ({count}) for the scatter of {plural(size, 'fitted number')}"
        )
    slope, hessian = _of_runs(problem, result.vector, free)
    answer = jackknife(hessian, slope, clusters)
    _check_minimum(problem, result.vector, free, clusters)
    covariance, freedom = np.zeros((problem.size, problem.size)), np.ones(problem.size)
    covariance[np.ix_(free, free)], freedom[free] = answer.matrix, answer.degrees_of_freedom
    return EstimatedCovariance(covariance, freedom)


def _of_runs(
    problem: CalibrationProblem, vector: Array, free: NDArray[np.bool_], *, bent: bool = True
) -> tuple[Array, Array]:
    """Slopes (Z, n) and Hessians (Z, n, n) of the runs' parts of the cost by the free numbers, Eq. (1)."""
    odometry, matrix = problem.odometry, problem.matrix(vector)
    columns = problem.parameterisation.slopes(vector)[:, free]
    errors = odometry.poses(matrix[None])[0] - problem.reference
    slopes = odometry.jacobian(matrix).reshape(len(errors), 3, -1) @ columns
    return sum_of_norms(problem.objective, odometry.trajectory, errors, slopes, bent=bent)


def sum_of_norms(
    objective: Cost, run: NDArray[np.intp], errors: Array, slopes: Array, *, bent: bool = True
) -> tuple[Array, Array]:
    """Slopes (Z, n) and Hessians (Z, n, n) of the runs' parts of a cost that is a sum of norms, Eq. (1).

    run (S,): of each row of errors (S, 3), m and rad, with the derivatives slopes (S, 3, n). bent: False: without b,
    the Hessians of squares that lie above the cost and touch it, whose minimum never costs more.
    """
    base = norms_of(objective)
    assert base is not None  # _by_scatter has checked
    factors, count = np.array(base.weights), int(run.max()) + 1
    errors, slopes = errors * factors, slopes * factors[:, None]
    shares, norms = base.shares(run), np.linalg.norm(errors, axis=1)
    if isinstance(objective, RobustCost):
        ratios = norms / objective.loss.scales(norms[None], shares)[0]
        weights, bends = objective.loss.weights(ratios), objective.loss.slopes(ratios)
    else:
        # Rows of one number, of which the fit makes n exactly zero, need a kernel's width; others hardly change
        measured = np.abs(slopes).max(axis=2) > 0
        widths = np.zeros(len(norms))
        for numbers in np.unique(measured.sum(axis=1)).tolist():
            alike = measured.sum(axis=1) == numbers
            middle = float(np.median(norms[alike]))
            if numbers and middle <= _INTERPOLATED * norms[alike].max():
                raise NoCovarianceError(
                    "no covariance: the answer passes exactly through half of the poses, and the others are too few"
                )
            apart = norms[alike] > _INTERPOLATED * middle
            width = _KERNEL * count**-0.2 if numbers == 1 else count**-0.5
            widths[alike] = width * float(np.median(norms[alike][apart])) if apart.any() else 1.0
        weights = 1 / np.hypot(norms, widths)
        bends = -np.square(norms) * weights**3
    units = errors / np.maximum(norms, np.finfo(float).tiny)[:, None]
    along = np.einsum("sci,sc->si", slopes, units)
    by_row = (shares * weights)[:, None, None] * np.einsum("sci,scj->sij", slopes, slopes)
    by_row += bent * (shares * bends)[:, None, None] * along[:, :, None] * along[:, None, :]
    slope, hessian = np.zeros((count, slopes.shape[2])), np.zeros((count, *by_row.shape[1:]))
    np.add.at(slope, run, (shares * weights * norms)[:, None] * along)
    np.add.at(hessian, run, by_row)
    return slope, hessian


def _check_minimum(problem: CalibrationProblem, vector: Array, free: NDArray[np.bool_], clusters: Clusters) -> None:
    """NoCovarianceError: steps of reweighted least squares lead farther than a standard deviation to a lower cost."""
    better, cost = vector, problem.answer_cost(vector)
    for _ in range(_MOST_STEPS):
        slope, hessian = _of_runs(problem, better, free, bent=False)
        roots = roots_of(hessian.sum(axis=0))
        moved = better.copy()
        moved[free] -= roots @ roots.T @ slope.sum(axis=0)
        value = problem.answer_cost(moved)
        if not value < cost * (1 - _NO_GAIN):
            break
        better, cost = moved, value
    away = np.abs(better - vector)[free]
    if not away.any():
        return
    slope, hessian = _of_runs(problem, better, free)
    deviations = np.sqrt(np.maximum(np.diag(jackknife(hessian, slope, clusters).matrix), 0.0))
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
    if result.extension is not None and result.extension.covariance is not None:
        covariance = np.array(result.extension.covariance)
        of_elements = np.broadcast_to(freedom, result.matrix.size)  # effects scatter at least as freely as these
        freedom = np.append(of_elements, np.full(len(covariance) - len(of_elements), of_elements.min()))
    held = np.isin(problem.names, (*result.at_bounds, *result.held))
    unknown, weighed = [problem.parameterisation.slopes(result.vector)[:, held].T], bool(result.covariance_source)
    if not weighed:  # otherwise the design tells of them, too
        unknown.append(np.kron(np.eye(3), problem.unidentified))
    if problem.left_open is not None and not weighed:
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
