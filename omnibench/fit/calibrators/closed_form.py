"""Least squares with known headings, then second-order cone programs to the minimum of a sum of norms.

For a given row 3 of the matrix positions are linear in rows 1 and 2, and headings are linear in row 3. With the
headings of the reference poses the first fit is therefore two linear least squares problems. Then the poses are
linearised about the present matrix, which makes the minimisation of a sum of norms a second-order cone program. Its
steps are so small that a few programs converge, to a local minimum: that no other is lower is proven afterwards, and
only to a gap (certify.py).

A robust loss has no cone program: its minimum is found by reweighted least squares (fit/linear_fit.py), from
the linear fit to Huber's loss and, where that is asked for, from there to Student's t.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Calibrator, RunResult, Solution, run_calibrator
from omnibench.fit.linear_fit import linear_fit, minimum_in_turn, reweighted_minimum
from omnibench.fit.loss import Loss, RobustCost, beginning_with_huber, norms_of
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.odometry import OdometryBatch
from omnibench.words import plural

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
        from omnibench.fit.sum_of_norms import SolverError, least_step

        self.needs_matrix(problem)
        objective, base = problem.objective, norms_of(problem.objective)
        if base is None:
            raise ConfigError(f"closed_form needs a cost that is a sum of norms, which {objective.name} is not")
        # The linear fit or, where references are no poses, Gauss-Newton steps; or the start, where it is better.
        if isinstance(problem.odometry, OdometryBatch):
            design, identity = problem.matrix(problem.start), np.eye(len(problem.robot.drive.names))
            matrix = linear_fit(problem.odometry, problem.trajectories, problem.reference, design, identity)
            linear = problem.settled(matrix.ravel())
        else:
            linear = reweighted_minimum(problem, RobustCost(base, Loss(3)), problem.start, _STILL)[0]
        vectors = np.array([problem.start, linear])
        costs = problem.cost(vectors)
        vector = vectors[int(np.nanargmin(np.where(np.isfinite(costs), costs, np.inf)))]
        if isinstance(objective, RobustCost):
            return minimum_in_turn(
                problem, beginning_with_huber(objective), vector, self.options.tolerance, "reweighted"
            )
        cost = float(problem.cost(vector[None])[0])
        shares, used = base.shares(problem.odometry.trajectory), np.flatnonzero(base.weights)
        scale = np.array(base.weights)[used]
        newton_steps = cone_programs = 0
        work = "the linear fit"
        for _ in range(self.options.programs):
            if cost <= objective.rounding:  # a program would find no direction
                return Solution(vector, f"no error is left after {work}")
            # The best step of the cost with linear poses: residuals (S, k) and their jacobian (S, k, n).
            before = problem.matrix(vector)
            residuals = (problem.odometry.poses(before[None])[0] - problem.reference)[:, used] * scale
            jacobian = (problem.odometry.jacobian(before)[:, used] * scale[:, None, None]).reshape(*residuals.shape, -1)
            jacobian = jacobian @ problem.parameterisation.slopes(vector)
            room = problem.lower - vector, problem.upper - vector
            try:
                step, steps, programs = least_step(residuals, jacobian, shares, *room)
            except SolverError as error:
                reason = f"{error} at a cost of {cost:.1e} in a cone program"
                fitted = int(problem.free.sum())
                if residuals.size < 2 * fitted:  # usually errors are as few as the numbers fitted
                    reason += f": {residuals.size} errors for {fitted} numbers are met almost exactly, record more runs"
                return Solution(vector, reason, converged=False)
            newton_steps, cone_programs = newton_steps + steps, cone_programs + programs
            counts = ((newton_steps, "Newton step"), (cone_programs, "cone program"))
            work = " and ".join(plural(count, name) for count, name in counts if count)
            # The step, halved until the cost does not rise.
            trial = problem.settled(vector + step)
            for _ in range(_MOST_HALVINGS):
                trial_cost = float(problem.cost(trial[None])[0])
                if trial_cost <= cost or np.abs(trial - vector).max() < _NO_STEP:
                    break
                trial = (trial + vector) / 2
            if not trial_cost <= cost:
                length = float(np.abs(step).max())
                reason = f"no part of the last step ({length:.1e}) lowers the cost after {work}"
                return Solution(vector, reason, converged=length < _FLAT * float(np.ptp(before)))
            vector, cost = trial, trial_cost
            moved = float(np.abs(problem.matrix(vector) - before).max())
            if moved < self.options.tolerance:
                return Solution(vector, f"step below {self.options.tolerance:g} after {work}")
        return Solution(vector, f"step still {moved:.1e} after {work}", converged=False)


def closed_form_result(problem: CalibrationProblem) -> RunResult:
    """The result of closed_form on a problem, which plug-ins that add effects to a matrix begin with."""
    return run_calibrator(calibrators.create("closed_form"), problem)


def shrunk_closed_form(problem: CalibrationProblem) -> tuple[RunResult, RunResult]:
    """Twice the result of closed_form, which is no longer shrunk to the design: what earlier plug-ins ask for."""
    result = closed_form_result(problem)
    return result, result
