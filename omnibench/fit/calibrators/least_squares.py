"""Least squares in the box by one convex program: no iteration, no start.

With the headings of the reference the pose errors are linear in the rows m1, m2, m3 of the matrix. In the terms of
Eq. (L1) and (L2) of fit/linear_fit.py, with G_s = sum_k a_k exp(i theta(k)) and z = x + iy,

    e_s = (G_s.(m1 + i m2) - (z_s - z_0),  C_s.m3 - (theta_s - theta_0)),                        (1)

and the matrix is the minimiser over the box of the quadratic program

    sum_s p_s |W e_s|^2,                                                                         (2)

with the shares p_s and the weights W of the cost, whose norms |W e_s| it squares. Two things set it apart from the
minimum of the cost: squares give the worst runs more weight, and positions are not charged for errors of row 3.
"""

from __future__ import annotations

import numpy as np

from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.linear_fit import linear_system
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array


@calibrators.register("least_squares")
class LeastSquares(Calibrator):
    """Linear least squares of the cost's pose errors, with the reference's headings: one solve (cvxpy)."""

    stochastic = False

    def __init__(self, options: Options) -> None:
        super().__init__(options)
        import omnibench.fit.sum_of_norms  # noqa: F401 (importing cvxpy takes a second: do it before time is measured)

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Minimise Eq. (2). ConfigError for another parameterisation or a cost that is no sum of norms."""
        if not isinstance(problem.parameterisation, MatrixElements):
            raise ConfigError("least_squares works on the matrix parameterisation; search the geometry with another")
        if not isinstance(problem.objective, SumOfNorms):
            raise ConfigError(f"least_squares squares the norms of a sum, which {problem.objective.name} is not")
        vector = problem.settled(_minimum(problem, problem.objective))
        problem.cost(vector[None])
        return Solution(vector, "one quadratic program")


def _minimum(problem: CalibrationProblem, objective: SumOfNorms) -> Array:
    """The vector (n,) of the box that minimises Eq. (2)."""
    import cvxpy as cp

    from omnibench.fit.sum_of_norms import solve_program

    moved, columns = linear_system(problem.odometry, problem.trajectories, problem.reference)
    none = np.zeros(columns.shape)
    rows = np.stack(  # (S, 3, 3N): Eq. (1), real and imaginary part of the position, then the heading
        [
            np.hstack([columns.real, -columns.imag, none]),
            np.hstack([columns.imag, columns.real, none]),
            np.hstack([none, none, problem.odometry.driven]),
        ],
        axis=1,
    )
    factors = np.sqrt(objective.shares(problem.odometry.trajectory))[:, None] * np.array(objective.weights)
    missing = (factors * (moved - rows @ problem.matrix(problem.start).ravel())).ravel()
    # In units of the box the program is well scaled.
    unit = np.where(problem.free, (problem.upper - problem.lower) / 2, 1.0)
    slopes = problem.parameterisation.slopes(problem.start) * unit
    step = cp.Variable(problem.size)
    errors = (factors[..., None] * rows).reshape(len(missing), -1) @ slopes @ step - missing
    scale = max(float(np.abs(missing).max()), np.finfo(float).tiny)
    within = [step >= (problem.lower - problem.start) / unit, step <= (problem.upper - problem.start) / unit]
    solve_program(cp.Problem(cp.Minimize(cp.sum_squares(errors / scale)), within))
    vector: Array = problem.start + unit * step.value
    return vector
