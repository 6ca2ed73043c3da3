"""Least squares in the box by one convex program: no iteration, no start.

With the headings of the reference the pose errors are linear in the rows m1, m2, m3 of the matrix. In the terms of
Eq. (L1) and (L2) of fit/linear_fit.py, with G_s = sum_k a_k exp(i theta(k)) and z = x + iy,

    e_s = (G_s.(m1 + i m2) - (z_s - z_0),  C_s.m3 - (theta_s - theta_0)),                        (1)

and the matrix is the minimiser over the box of the quadratic program

    sum_s p_s |W e_s|^2,                                                                         (2)

with the shares p_s and the weights W of the cost, whose norms |W e_s| it squares. Two things set it apart from the
minimum of the cost: squares give the worst runs more weight, and positions are not charged for errors of row 3.

With a robust loss the squares of Eq. (2) get the weights of fit/loss.py, Eq. (5), at the errors of the matrix
before, until it stays (iteratively reweighted least squares; Holland and Welsch, Comm. Stat. A 6:813, 1977): Huber's
from the least squares on, since its minimum is the only one, and Student's t from Huber's. Headings of poses that come
out far off are left out of G_s, and the rest is done again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.linear_fit import bounded_step, linear_system, minimum_in_turn
from omnibench.fit.loss import Loss, RobustCost, beginning_with_huber, norms_of
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch

_MOST_FITS = 200  # reweighted fits of one loss; Huber's take about 20
_STILL = 1e-7  # share of the box: a smaller change of every number ends them
_SMALL = 1e-9  # m or rad per rad: a smaller last Gauss-Newton step ends the fit to references that are no poses
_MOST_ROUNDS = 5  # choices of the headings that are used; two or three settle


@calibrators.register("least_squares")
class LeastSquares(Calibrator):
    """Linear least squares of the cost's pose errors, with the reference's headings: one solve (cvxpy)."""

    stochastic = False

    def __init__(self, options: Options) -> None:
        super().__init__(options)
        import omnibench.fit.sum_of_norms  # noqa: F401 (importing cvxpy takes a second: before time is measured)

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Minimise Eq. (2). ConfigError for another parameterisation or a cost that is no sum of norms."""
        self.needs_matrix(problem)
        base = norms_of(problem.objective)
        if base is None:
            raise ConfigError(f"least_squares squares the norms of a sum, which {problem.objective.name} is not")
        # Huber's loss is begun with the squares, and Student's t with Huber's.
        costs = beginning_with_huber(problem.objective) if isinstance(problem.objective, RobustCost) else []
        if not isinstance(problem.odometry, OdometryBatch):
            # References that are no poses do not have the headings that Eq. (1) needs: the squares have a minimum all
            # the same, from which a robust loss goes on.
            return minimum_in_turn(problem, [RobustCost(base, Loss(3)), *costs], problem.start, _SMALL, "Gauss-Newton")
        near = np.ones(len(problem.odometry.trajectory), dtype=bool)
        errors = _LinearErrors(problem, problem.odometry, base, near)
        vector, fits, settled = errors.minimum(), 0, True
        losses = [cost.loss for cost in costs]
        for _ in range(_MOST_ROUNDS if losses else 0):
            for loss in losses:
                vector, count, settled = _reweighted(errors, loss, vector)
                fits += count
            losses, before = losses[-1:], near
            near = losses[-1].is_near(errors.norms(vector), errors.shares)
            if np.array_equal(before, near):
                break
            errors = _LinearErrors(problem, problem.odometry, base, near)
        vector = problem.settled(vector)
        problem.cost(vector[None])
        return Solution(vector, f"{fits} reweighted fits" if losses else "one quadratic program", settled)


class _LinearErrors:
    """The weighted errors W e_s of Eq. (1) of a problem, whose cost is a sum of norms.

    near: True (S,) for the stamps of poses whose headings are used. Where most of a run's are not, its start is off,
    and all its headings are used: such a start is off by a shift or turn alone.
    """

    def __init__(
        self, problem: CalibrationProblem, odometry: OdometryBatch, objective: SumOfNorms, near: NDArray[np.bool_]
    ) -> None:
        self._problem = problem
        used = [np.ones(len(run.pose_times), dtype=bool) for run in problem.trajectories]
        for index, of_poses in enumerate(used):
            of_run = near[odometry.trajectory == index]
            if of_run.mean() > 1 / 2:
                of_poses[len(of_poses) - len(of_run) :] = of_run
        moved, columns = linear_system(odometry, problem.trajectories, problem.reference, used)
        none = np.zeros(columns.shape)
        rows = np.stack(  # (S, 3, 3N): Eq. (1), real and imaginary part of the position, then the heading
            [
                np.hstack([columns.real, -columns.imag, none]),
                np.hstack([columns.imag, columns.real, none]),
                np.hstack([none, none, odometry.driven]),
            ],
            axis=1,
        )
        self.shares = objective.shares(odometry.trajectory)
        self._rows, self._weights = rows, np.array(objective.weights)
        self._missing = moved - rows @ problem.matrix(problem.start).ravel()
        # In units of the box the program is well scaled.
        self.unit = np.where(problem.free, (problem.upper - problem.lower) / 2, 1.0)
        self._slopes = problem.parameterisation.slopes(problem.start)

    def norms(self, vector: Array) -> Array:
        """Norms (S,) of W e_s at a vector (n,)."""
        moved = self._rows @ (self._slopes @ (vector - self._problem.start))
        return np.linalg.norm((moved - self._missing) * self._weights, axis=1)

    def _system(self, weights: Array, slopes: Array) -> tuple[Array, Array]:
        """Columns (3S, n) by slopes (3N, n) of the elements, and right side (3S,), of Eq. (2) with weights (S,)."""
        factors = np.sqrt(weights)[:, None] * self._weights
        missing = (factors * self._missing).ravel()
        return (factors[..., None] * self._rows).reshape(len(missing), -1) @ slopes, missing

    def reweighted(self, weights: Array) -> Array:
        """The vector (n,) of the box that minimises Eq. (2), its terms times weights (S,)."""
        columns, missing = self._system(self.shares * weights, self._slopes)
        start = self._problem.start
        return start + bounded_step(self._problem, start, columns.T @ columns, -columns.T @ missing)

    def minimum(self) -> Array:
        """The vector (n,) of the box that minimises Eq. (2)."""
        import cvxpy as cp

        from omnibench.fit.sum_of_norms import solve_program

        problem, unit = self._problem, self.unit
        columns, missing = self._system(self.shares, self._slopes * unit)
        step = cp.Variable(problem.size)
        errors = columns @ step - missing
        scale = max(float(np.abs(missing).max()), np.finfo(float).tiny)
        within = [step >= (problem.lower - problem.start) / unit, step <= (problem.upper - problem.start) / unit]
        solve_program(cp.Problem(cp.Minimize(cp.sum_squares(errors / scale)), within))
        return np.asarray(problem.start + unit * step.value)


def _reweighted(errors: _LinearErrors, loss: Loss, vector: Array) -> tuple[Array, int, bool]:
    """The vector (n,) that its own weights lead back to, from another one, after how many fits, and True if it does."""
    for count in range(1, _MOST_FITS + 1):
        norms = errors.norms(vector)
        weights = loss.weights(norms / loss.scales(norms[None], errors.shares)[0])
        before, vector = vector, errors.reweighted(weights)
        if (np.abs(vector - before) < _STILL * errors.unit).all():
            return vector, count, True
    return vector, _MOST_FITS, False
