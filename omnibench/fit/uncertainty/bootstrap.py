"""Bootstrap intervals of an exact optimum: how far it would move on other recordings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omnibench.errors import ConfigError
from omnibench.fit.calibrators.closed_form import cone_program
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.problem import CalibrationProblem
from omnibench.robot.kinematics import Array


@dataclass(frozen=True, eq=False)
class ElementIntervals:
    """95 % intervals (3, N) of the matrix elements."""

    low: Array
    high: Array


def bootstrap_intervals(
    problem: CalibrationProblem, optimum: Array, *, resamples: int = 400, rng: np.random.Generator
) -> ElementIntervals:
    """Percentile intervals of the matrix elements about closed_form's ``optimum`` (n,).

    Trajectories are drawn with replacement and the optimum is found again, with the poses linearised about
    ``optimum``: the error of that is far below the width of the intervals. ConfigError for another parameterisation or
    a cost that is no sum of norms.
    """
    objective = problem.objective
    if not isinstance(problem.parameterisation, MatrixElements) or not isinstance(objective, SumOfNorms):
        raise ConfigError("bootstrap intervals need the matrix parameterisation and a cost that is a sum of norms")
    program = cone_program(problem, objective, optimum)
    owner = problem.odometry.trajectory
    shares = objective.shares(owner)
    count = len(problem.trajectories)
    drawn = rng.multinomial(count, np.full(count, 1 / count), size=resamples)
    moved = np.array([problem.matrix(optimum + program.step(shares * weights[owner])) for weights in drawn])
    low, high = np.percentile(moved, [2.5, 97.5], axis=0)
    return ElementIntervals(low, high)
