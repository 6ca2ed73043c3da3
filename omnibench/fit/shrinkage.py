"""Shrinkage: what data say of a matrix, weighed against how well its design is known (empirical Bayes).

A calibrator's answer k has the covariance S, by the data. The matrices of robots of one class have the covariance
P = R R' about their designs k0 (prior.py). For normal errors the posterior covariance and mean are

    C = R (1 + R' S^+ R)^-1 R',    k0 + C S^+ (k - k0)                                                (1)

(Lindley and Smith, J. R. Stat. Soc. B 34:1, 1972). Along what the data tell well J is large, and k stands; along what
they hardly tell it is small, and the design does. S is estimated from the same data, which makes it empirical Bayes
(Efron and Morris, J. Am. Stat. Assoc. 70:311, 1975). Directions that only slip may have driven keep the design, as
without shrinkage: S tells of the scatter of the runs, and slip may be the same in all of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnibench.fit.calibrator import Calibrator, Outcome, RunResult, Shrinkage
from omnibench.fit.loss import loss_of
from omnibench.fit.noise import GIVEN
from omnibench.fit.open_combinations import information_of_references
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.trajectory_fit import information_of_runs, noise_of_matrix
from omnibench.robot.physical import MANY
from omnibench.fit.uncertainty import NoCovarianceError, covariance_of_answer, runs_without_heading
from omnibench.registry import calibrators
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

_ROUNDING = 1e-10  # share of the largest variance: a smaller one is rounding of a direction that was not fitted


def shrunk(problem: CalibrationProblem, result: RunResult, *, fitted: bool = True) -> RunResult:
    """A calibrator's result, shrunk to the design where the problem ``shrinks``; otherwise, or unanswered, as it is.

    fitted: False for an answer that was not fitted to the runs, which is not shrunk; neither is one with effects beside
    the matrix, whose calibrator shrinks the matrix before it fits these (shrinkage.py). Covariance and degrees of
    freedom of the result are the posterior's; an answer without its own that runs without a start heading mislead has
    none. Elements that lay on a bound before are said to, since it bent the others.
    """
    if not (problem.shrinks and fitted) or result.extension or result.vector is None or result.cost is None:
        return result
    information, known_freedom, noise, words = _knowledge(problem, result)
    root = problem.parameterisation.prior_root * problem.free[:, None]
    # eigh bears information of any size: data without noise have so much that 1 + S is singular to rounding
    strengths, directions = np.linalg.eigh(root.T @ information @ root)
    posterior = root @ directions @ np.diag(1 / (1 + np.maximum(strengths, 0.0))) @ directions.T @ root.T
    deviation = problem.parameterisation.projection @ (result.vector - problem.start)
    vector = problem.settled(problem.start + posterior @ information @ deviation)
    cost = float(problem.values(vector[None])[0])
    # The change of the cost: as a share of it, or in its unit where it is rounding alone.
    change = f"{cost - result.cost:+.2g}"
    if result.cost > problem.objective.rounding:
        change = f"{100 * (cost / result.cost - 1):+.2g} %"
    # The posterior variances are C S^+ C from the data and else from the prior, whose part is exact: their degrees of
    # freedom are those of the data over the square of its share (Satterthwaite 1946).
    shares = np.diag(posterior @ information @ posterior) / np.maximum(np.diag(posterior), 1e-300)
    freedom: Array = np.minimum(known_freedom / np.square(np.clip(shares, 1e-9, 1.0)), MANY)
    misled = result.covariance is None and bool(runs_without_heading(problem))
    return replace(
        result,
        vector=vector,
        matrix=problem.matrix(vector),
        cost=cost,
        covariance=None if misled else posterior,
        degrees_of_freedom=freedom,
        noise=noise,
        shrinkage=Shrinkage(result.cost, f"the design's tolerance and {words}"),
        reason=f"{result.reason}; shrunk to the design, which changes the cost by {change}",
    )


def _knowledge(problem: CalibrationProblem, result: RunResult) -> tuple[Array, Array, Noise | None, str]:
    """The data's information S^+ (n, n), the degrees of freedom (n,) of its estimate, the noise, and its source.

    The information is that of the answer's covariance, or of the noise of the poses where the answer has none or lies
    on a bound. Both are of the part of the matrix that the data drive, in units of its rows' largest elements.
    """
    assert result.matrix is not None and result.vector is not None  # noqa: PT018 (there is an answer)
    robot, matrix = problem.robot, result.matrix
    unit = np.repeat(robot.row_scales, len(robot.drive.names))
    driven = MatrixElements(robot, "row", problem.unidentified, known_mount=False).projection
    slopes = driven @ problem.parameterisation.slopes(result.vector) / unit[:, None]
    if not result.at_bounds:
        try:
            answer = covariance_of_answer(problem, result)
        except NoCovarianceError:
            pass
        else:
            covariance = slopes @ answer.steadied @ slopes.T
            information = slopes.T @ np.linalg.pinv(covariance, rcond=_ROUNDING, hermitian=True) @ slopes
            freedom = np.broadcast_to(answer.of_vector.degrees_of_freedom, problem.size)
            return information, np.array(freedom), answer.noise, answer.source
    # Information (3M, 3M) about the elements by the noise of poses and references.
    total: Array = np.zeros((matrix.size, matrix.size))
    noise, words = None, GIVEN.description
    if posed := [run for run in problem.trajectories if run.has_poses]:
        estimate = noise_of_matrix(posed, matrix, problem.integration, loss_of(problem.objective))
        total = information_of_runs(posed, matrix, problem.integration, estimate.noise).sum(axis=0)
        noise, words = estimate.noise, f"the poses' noise ({estimate.description})"
    if measured := [run for run in problem.trajectories if run.references is not None]:
        total = total + information_of_references(robot, measured, problem.integration, poses=False)
    columns = unit[:, None] * slopes
    return columns.T @ total @ columns, np.full(problem.size, MANY), noise, words


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
