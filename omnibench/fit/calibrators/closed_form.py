"""Least squares with known headings, then second-order cone programs to the minimum of a sum of norms.

For a given row 3 of the matrix positions are linear in rows 1 and 2, and headings are linear in row 3. With the
headings of the reference poses the first fit is therefore two linear least squares problems. Then the poses are
linearised about the present matrix, which makes the minimisation of a sum of norms a second-order cone program. Its
steps are so small that a few programs converge, to a local minimum: that no other is lower is proven afterwards, and
only to a gap (certify.py).

A robust loss has no cone program: its minimum is found by reweighted least squares (fit/gauss_newton.py), from
the linear fit to Huber's loss and, where that is asked for, from there to Student's t.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.gauss_newton import minimum_in_turn, reweighted_minimum
from omnibench.fit.linear_fit import linear_fit
from omnibench.fit.loss import RobustCost, Squares, beginning_with_huber, norms_of
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch
from omnibench.words import plural

if TYPE_CHECKING:
    from omnibench.fit.sum_of_norms import SumOfNormsProgram

# The matrices of closed_form are the same with half of each of these numbers and with twice
# (tests/studies/constants_fit.py).
_MOST_HALVINGS = 30  # lengths of one step that are tried, each half the one before: down to a billionth
_FLAT = 1e-6  # share of the matrix's range: a smaller step that does not lower the cost is rounding of the solver
_STILL = 1e-9  # m or rad per rad: a smaller last step ends the least squares that references are begun with
_NO_STEP = 1e-12  # m or rad per rad of wheel: a shorter step is rounding of the solver


class ClosedFormOptions(Options):
    """Stopping rule."""

    tolerance: float = Field(1e-9, gt=0, description="largest change of an element in the last step, m or rad per rad")
    programs: int = Field(50, gt=0, description="most second-order cone programs")


@calibrators.register("closed_form")
class ClosedForm(Calibrator):
    """Minimum in the box by least squares and second-order cone programs (cvxpy); certify proves how near it is."""

    Options = ClosedFormOptions
    options: ClosedFormOptions
    stochastic = False
    exact = True

    def __init__(self, options: ClosedFormOptions) -> None:
        super().__init__(options)
        import omnibench.fit.sum_of_norms  # noqa: F401 (importing cvxpy takes a second: do it before time is measured)

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """The optimum in the box. ConfigError for another parameterisation or a cost that is no sum of norms."""
        from omnibench.fit.sum_of_norms import SolverError

        if not isinstance(problem.parameterisation, MatrixElements):
            raise ConfigError("closed_form works on the matrix parameterisation; search the geometry with another")
        if isinstance(problem.objective, RobustCost):
            vector = self._better(problem, problem.start, linear_start(problem))
            costs = beginning_with_huber(problem.objective)
            return minimum_in_turn(problem, costs, vector, self.options.tolerance, "reweighted")
        if not isinstance(problem.objective, SumOfNorms):
            raise ConfigError(f"closed_form needs a cost that is a sum of norms, which {problem.objective.name} is not")
        vector = self._better(problem, problem.start, linear_start(problem))
        cost = float(problem.cost(vector[None])[0])
        shares = problem.objective.shares(problem.odometry.trajectory)
        newton_steps = cone_programs = 0
        work = "the linear fit"
        for _ in range(self.options.programs):
            if cost <= problem.objective.rounding:  # a program would find no direction
                return Solution(vector, f"no error is left after {work}")
            program = cone_program(problem, problem.objective, vector)
            try:
                step = program.step(shares)
            except SolverError as error:
                reason = f"{error} at a cost of {cost:.1e} in a cone program"
                errors = len(problem.reference) * sum(map(bool, problem.objective.weights))
                fitted = int(problem.free.sum())
                if errors < 2 * fitted:  # usually errors are as few as the numbers fitted
                    reason += f": {errors} errors for {fitted} numbers are met almost exactly, record more runs"
                return Solution(vector, reason, converged=False)
            newton_steps, cone_programs = newton_steps + program.newton_steps, cone_programs + program.cone_programs
            counts = ((newton_steps, "Newton step"), (cone_programs, "cone program"))
            work = " and ".join(plural(count, name) for count, name in counts if count)
            before = problem.matrix(vector)
            vector, cost, descended = _descend(problem, vector, cost, step)
            if not descended:
                length = float(np.abs(step).max())
                reason = f"no part of the last step ({length:.1e}) lowers the cost after {work}"
                return Solution(vector, reason, converged=length < _FLAT * float(np.ptp(problem.matrix(vector))))
            moved = float(np.abs(problem.matrix(vector) - before).max())
            if moved < self.options.tolerance:
                return Solution(vector, f"step below {self.options.tolerance:g} after {work}")
        reason = f"step still {moved:.1e} after {work}"
        return Solution(vector, reason, converged=False)

    @staticmethod
    def _better(problem: CalibrationProblem, *vectors: Array) -> Array:
        """The vector of lowest cost."""
        costs = problem.cost(np.array(vectors))
        return vectors[int(np.nanargmin(np.where(np.isfinite(costs), costs, np.inf)))]


def linear_start(problem: CalibrationProblem) -> Array:
    """Vector (n,) in the box by linear least squares; by Gauss-Newton steps where references are no poses."""
    if not isinstance(problem.odometry, OdometryBatch):
        base = norms_of(problem.objective)
        assert base is not None  # closed_form has refused other costs
        return reweighted_minimum(problem, RobustCost(base, Squares(3)), problem.start, _STILL)[0]
    design, identity = problem.matrix(problem.start), np.eye(len(problem.robot.drive.names))
    matrix = linear_fit(problem.odometry, problem.trajectories, problem.reference, design, identity)
    return problem.settled(matrix.ravel())


def cone_program(problem: CalibrationProblem, objective: SumOfNorms, vector: Array) -> SumOfNormsProgram:
    """A program for the best step from ``vector``: the cost with the poses linearised there."""
    from omnibench.fit.sum_of_norms import SumOfNormsProgram

    return SumOfNormsProgram(*program_data(problem, objective, vector))


def program_data(
    problem: CalibrationProblem, objective: SumOfNorms, vector: Array
) -> tuple[Array, Array, Array, Array]:
    """Residuals (S, k), jacobian (S, k, n) and bounds (n,) of the step, of which a SumOfNormsProgram is made."""
    matrix = problem.matrix(vector)
    used = np.flatnonzero(objective.weights)
    scale = np.array(objective.weights)[used]
    residuals = (problem.odometry.poses(matrix[None])[0] - problem.reference)[:, used] * scale
    jacobian = (problem.odometry.jacobian(matrix)[:, used] * scale[:, None, None]).reshape(*residuals.shape, -1)
    jacobian = jacobian @ problem.parameterisation.slopes(vector)
    return residuals, jacobian, problem.lower - vector, problem.upper - vector


def _descend(problem: CalibrationProblem, vector: Array, cost: float, step: Array) -> tuple[Array, float, bool]:
    """The vector and cost after the step, halved until the cost does not rise; False if no part of it lowers it."""
    trial = problem.settled(vector + step)
    for _ in range(_MOST_HALVINGS):
        trial_cost = float(problem.cost(trial[None])[0])
        if trial_cost <= cost:
            return trial, trial_cost, True
        if np.abs(trial - vector).max() < _NO_STEP:
            break
        trial = (trial + vector) / 2
    return vector, cost, False
