"""Resampled intervals of closed_form's optimum: how far it would move on other recordings.

The units that are resampled should be commands where runs repeat them, since repetitions share what the model misses
there. With t the 0.975 quantile of Student's t with n - 1 degrees of freedom, n units from ten on are drawn with
replacement. Their spread is smaller by sqrt((n - 1) / n) than what it stands for, and its tails are normal; percentiles
alpha and 1 - alpha make up for both (Hesterberg, Am. Statistician 69:371, 2015):

    alpha = Phi(-sqrt(n / (n - 1)) t).                                                             (1)

Three to nine units are too few to draw from. Of them each is left out in turn, and the optima theta_u without it have
the jackknife's standard error s about their mean (Tukey 1958):

    theta +- t s,   s^2 = (n - 1) / n sum_u (theta_u - mean)^2.                                    (2)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, stdtrit

from omnibench.errors import ConfigError
from omnibench.fit.calibrators.closed_form import program_data
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.ratio_intervals import BOOTSTRAPPED, FEWEST, Units, units_of
from omnibench.fit.jackknife import depending
from omnibench.robot.physical import INTERVAL
from omnibench.jobs.job import Backend, gathered
from omnibench.progress import Reporter
from omnibench.robot.kinematics import Array

_TOGETHER = 25  # resamples of a job, some 0.1 s; fixed, so that every backend solves the same programs


def resampled_steps(part: tuple[tuple[Array, ...], Array], _: Reporter) -> Array:
    """Steps (B, n) from the optimum to those of resamples, each given by its weights of the units.

    With them come the program's data, the stamps' shares and units, and the weights of the first resample of all: the
    solver scales by what it solves first, so that only after the same one all parts have the same steps as the whole.
    """
    from omnibench.fit.sum_of_norms import SumOfNormsProgram

    (residuals, jacobian, lower, upper, shares, of_stamp, first), drawn = part
    program = SumOfNormsProgram(residuals, jacobian, lower, upper)
    if not np.array_equal(first, drawn[0]):
        program.step(shares * first[of_stamp])
    return np.array([program.step(shares * weights[of_stamp]) for weights in drawn])


@dataclass(frozen=True, eq=False)
class ElementIntervals:
    """95 % intervals (3, N) of the matrix elements; nan where there is none, held by the box or on a bound of it."""

    low: Array
    high: Array


def bootstrap_intervals(
    problem: CalibrationProblem,
    optimum: Array,
    *,
    units: Units | None = None,
    resamples: int = 400,
    rng: np.random.Generator,
    backend: Backend | None = None,
) -> ElementIntervals:
    """Intervals of the matrix elements about closed_form's ``optimum`` (n,), from three units or more.

    units: what is resampled; default: the runs. The optimum of every resample is found with the poses linearised about
    ``optimum``: the error of that is far below the width of the intervals. Elements that depend on a number that the
    box holds, on a bound of it or stopped by one in the resamples have none. backend: solves the resamples, which are
    drawn here, as jobs; the intervals are the same to the bit. ConfigError for another parameterisation,
    another cost than a sum of norms, or fewer units.
    """
    objective = problem.objective
    if not isinstance(problem.parameterisation, MatrixElements) or not isinstance(objective, SumOfNorms):
        raise ConfigError("bootstrap intervals need the matrix parameterisation and a cost that is a sum of norms")
    units = units or units_of(problem.trajectories, "run")
    count = units.count
    if count < FEWEST:
        raise ConfigError(f"{units.words}: {FEWEST} are needed")
    owner = problem.odometry.trajectory
    shares, of_stamp = objective.shares(owner), units.of_run[owner]
    few = count < BOOTSTRAPPED
    drawn = 1 - np.eye(count) if few else rng.multinomial(count, np.full(count, 1 / count), size=resamples)
    data = (*program_data(problem, objective, optimum), shares, of_stamp, drawn[0])
    parts = [(data, drawn[first : first + _TOGETHER]) for first in range(0, len(drawn), _TOGETHER)]
    vectors = optimum + np.concatenate(gathered(backend, resampled_steps, parts, shared=(data,)))
    moved = problem.parameterisation.matrices(vectors)
    quantile = float(stdtrit(count - 1, (1 + INTERVAL) / 2))
    if few:
        reach = quantile * np.sqrt((count - 1) * moved.var(axis=0))  # Eq. (2)
        low, high = problem.matrix(optimum) - reach, problem.matrix(optimum) + reach
    else:
        outside = 100 * float(ndtr(-np.sqrt(count / (count - 1)) * quantile))  # Eq. (1)
        low, high = np.percentile(moved, [outside, 100 - outside], axis=0)
    stopped = problem.without_interval(problem.at_bounds(optimum))
    stopped |= problem.on_bounds(vectors).mean(axis=0) > (0.0 if few else outside / 100)  # an end would be the bound
    bounded = depending(problem.parameterisation.slopes(optimum), stopped).reshape(low.shape)
    return ElementIntervals(np.where(bounded, np.nan, low), np.where(bounded, np.nan, high))
