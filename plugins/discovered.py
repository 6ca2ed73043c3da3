"""A matrix with the effects that ``omnibench discover`` finds in the training runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnibench.data.dataset import make_dataset
from omnibench.errors import NotApplicableError
from omnibench.fit.calibrator import Calibrator, Outcome, Solution, run_calibrator
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.problem import BudgetSpent, CalibrationProblem
from omnibench.progress import Progress
from omnibench.registry import calibrators
from omnibench.robot.calibration import ModelExtension

_STEPS = 7  # of a discovery that takes them all


@calibrators.register("discovered")
class Discovered(Calibrator):
    """The matrix of closed_form or, where discover finds effects in the runs, its matrix with these."""

    bounded = False
    stochastic = False
    extends = True
    uses = ("discover", "fit/calibrators/closed_form.py")

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """The matrix with effects. NotApplicableError: Euler steps, a searched geometry, or no reference poses.

        Time is looked at between the steps of the discovery only. When it is spent, the answer is the matrix alone.
        """
        from omnibench.discover.discover import discover_effects  # loads slowly; every command loads this plug-in

        if problem.integration != "arc":
            raise NotApplicableError(
                "discover integrates arcs, since Euler steps look like slip; set integration to arc"
            )
        if not isinstance(problem.parameterisation, MatrixElements):
            raise NotApplicableError("effects are found beside a matrix; leave the parameterisation at matrix")
        if not all(run.has_poses for run in problem.trajectories):
            raise NotApplicableError("discover needs reference poses along the path of every run")

        plain = run_calibrator(calibrators.create("closed_form"), problem)  # from now on the best vector of the problem
        steps = set[str]()

        def watch(event: Progress) -> None:
            steps.add(event.task)
            if problem.seconds_left <= 0:
                raise BudgetSpent("time", f"{problem.budget.seconds:g} s spent while {event.task}")
            problem.report(len(steps), max(len(steps), _STEPS), "step")

        runs = [replace(run, split="train") for run in problem.trajectories]
        dataset = make_dataset("training", problem.robot, problem.sample_period, runs)
        discovery = discover_effects(dataset, watch=watch)
        extended = discovery.extended
        assert plain.vector is not None  # closed_form has answered
        if not extended.effects:
            reason = f"{plain.reason}; the matrix alone: discover names no effect ({discovery.verdict})"
            return Solution(plain.vector, reason, plain.outcome is Outcome.CONVERGED)
        return Solution(
            np.array(extended.matrix).ravel(),
            f"discover ({discovery.verdict}): {extended.effects_in_words}",
            noise=extended.noise,
            extension=ModelExtension(
                effects=extended.effects,
                driven=extended.driven,
                plain=extended.plain,
                covariance=extended.covariance,
            ),
        )
