"""The matrix that closed_form answers a problem with: what calibrators begin with that add effects to a matrix."""

from __future__ import annotations

import numpy as np

from omnibench.fit.calibrator import Calibrator, Outcome, RunResult
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.shrinkage.shrinkage import shrunk
from omnibench.registry import calibrators


def closed_form_result(problem: CalibrationProblem) -> RunResult:
    """The result of closed_form on a problem, not shrunk to the design yet; its evaluations count against the budget.

    BudgetSpent passes through. ConfigError: closed_form cannot solve the problem, which its message says why.
    """
    calibrator: Calibrator = calibrators.create("closed_form")
    solution = calibrator.calibrate(problem)
    vector = np.array(solution.vector, dtype=float)
    return RunResult(
        outcome=Outcome.CONVERGED if solution.converged else Outcome.BUDGET,
        reason=solution.reason,
        vector=vector,
        matrix=problem.matrix(vector),
        cost=problem.best_cost if not problem.shrinks else float(problem.values(vector[None])[0]),
        evaluations=problem.evaluations,
        seconds=problem.seconds,
        history=tuple(problem.history),
        at_bounds=problem.at_bounds(vector),
        held=problem.held,
    )


def shrunk_closed_form(problem: CalibrationProblem) -> tuple[RunResult, RunResult]:
    """The result of ``closed_form_result`` as it is, and shrunk to the design where the problem ``shrinks``."""
    plain = closed_form_result(problem)
    return plain, shrunk(problem, plain)
