"""Minimum of a robust cost by reweighted Gauss-Newton steps within the box.

At the weights w of fit/loss/losses.py, Eq. (5), of the present errors e_i, a step d minimises

    sum_i p_i w_i |e_i + J_i d|^2,                                                                        (1)

which for linear poses lowers the cost with every step (iteratively reweighted least squares: its squares lie above the
loss and touch it; Lange, Hunter and Yang, J. Comput. Graph. Stat. 9:1, 2000). It is halved where curved poses do not.
"""

from __future__ import annotations

import numpy as np

from omnibench.fit.least_squares.gauss_newton import bounded_step
from omnibench.fit.loss.robust_cost import RobustCost
from omnibench.fit.problem import CalibrationProblem
from omnibench.robot.kinematics import Array

_MOST_STEPS = 300  # steps; 20 to 60 are usual
_MOST_HALVINGS = 30  # lengths of one step that are tried, each half the one before: down to a billionth
_ROUNDING = 1e-12  # share of the cost: an increase that is no increase


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
    for count in range(1, _MOST_STEPS + 1):
        matrix = problem.matrix(vector)
        errors = problem.odometry.poses(matrix[None])[0] - problem.reference
        slopes = problem.parameterisation.slopes(vector)
        jacobian = problem.odometry.jacobian(matrix).reshape(len(errors), 3, -1) @ slopes
        roots = np.sqrt(shares * objective.weights(errors, owner))[:, None] * factors
        columns, values = (roots[..., None] * jacobian).reshape(-1, len(vector)), (roots * errors).ravel()
        step = bounded_step(problem, vector, columns.T @ columns, columns.T @ values)  # Eq. (1)
        cost = float(objective.combine(errors[None], owner)[0])
        for halvings in range(_MOST_HALVINGS):
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
    return vector, _MOST_STEPS, False
