"""However a calibrator ends, its run is a row with an outcome and a reason."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fit_samples import Scripted, make_problem, noisy_trajectories

from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Calibrator, Outcome, RunResult, Solution, run_calibrator, unloadable
from omnibench.fit.cost import Cost
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import PluginFailure, costs
from omnibench.robot.kinematics import Array

RUNS = noisy_trajectories()


def run(script: Callable[[CalibrationProblem], Any], **changes: Any) -> RunResult:
    return run_calibrator(Scripted(script), make_problem(RUNS, **changes))


def answering(vector: Callable[[CalibrationProblem], Any]) -> Callable[[CalibrationProblem], Solution]:
    return lambda problem: Solution(vector(problem), "done")


def for_ever(problem: CalibrationProblem) -> Solution:
    while True:
        problem.cost(problem.from_unit(problem.rng.uniform(size=(7, int(problem.free.sum())))))


def raising(error: BaseException) -> Callable[[CalibrationProblem], Solution]:
    def script(problem: CalibrationProblem) -> Solution:
        problem.cost(problem.start)
        raise error

    return script


def test_an_answer_by_the_calibrators_own_rule_has_converged() -> None:
    result = run(answering(lambda problem: problem.start * 1.01))
    assert (result.outcome, result.reason) == (Outcome.CONVERGED, "done")
    problem = make_problem(RUNS)
    assert result.cost == problem.values(result.vector[None])[0]
    np.testing.assert_array_equal(result.matrix, problem.matrix(result.vector))


def test_one_number_of_degrees_of_freedom_is_that_of_every_variance() -> None:
    result = run(lambda problem: Solution(problem.start, "done", covariance=np.eye(problem.size), degrees_of_freedom=7))
    np.testing.assert_array_equal(result.degrees_of_freedom, np.full(9, 7.0))


@pytest.mark.parametrize(
    ("freedom", "outcome"),
    [(np.ones(10), Outcome.FAILED), *((value, Outcome.INVALID) for value in (np.nan, 0.0, -3.0))],
)
def test_degrees_of_freedom_of_another_size_or_not_above_0_are_no_answer(freedom: Any, outcome: Outcome) -> None:
    result = run(lambda problem: Solution(problem.start, "done", degrees_of_freedom=freedom))
    assert (result.outcome, result.vector, result.degrees_of_freedom) == (outcome, None, None)
    assert "degrees_of_freedom" in result.reason or outcome is Outcome.FAILED


def test_an_answer_at_a_limit_of_the_calibrators_own_has_not_converged() -> None:
    result = run(lambda problem: Solution(problem.start, "5 rounds", converged=False))
    assert (result.outcome, result.reason) == (Outcome.BUDGET, "5 rounds")
    assert result.cost is not None


@pytest.mark.parametrize(
    ("limit", "outcome"), [({"evaluations": 40}, Outcome.BUDGET), ({"seconds": 0.05}, Outcome.TIME)]
)
def test_a_spent_budget_gives_the_best_candidate_so_far(limit: dict[str, Any], outcome: Outcome) -> None:
    result = run(for_ever, **limit)
    assert result.outcome is outcome
    assert "spent" in result.reason
    assert result.evaluations == 40 or 0.05 <= result.seconds < 5
    assert result.cost == pytest.approx(result.history[-1].cost, rel=1e-12)
    assert result.matrix is not None


@pytest.mark.parametrize("candidate", [np.nan, 1e-3])
def test_a_budget_spent_without_a_finite_cost_in_the_box_is_invalid(candidate: float) -> None:
    def outside(problem: CalibrationProblem) -> Solution:
        while True:
            problem.cost(np.tile(problem.upper + candidate, (5, 1)))

    result = run(outside, evaluations=20)
    assert (result.outcome, result.vector, result.cost) == (Outcome.INVALID, None, None)
    assert "no candidate" in result.reason


class NastyError(Exception):
    """An error whose own text raises."""

    def __str__(self) -> str:
        raise RuntimeError("not even this works")


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ValueError("a bad\nday"), "ValueError: a bad day"),
        (ConfigError("cannot be solved this way"), "cannot be solved this way"),
        (SystemExit(3), "SystemExit: 3"),
        (MemoryError(), "MemoryError"),
        (np.linalg.LinAlgError("singular"), "LinAlgError: singular"),
        (NastyError(), "NastyError"),
    ],
)
def test_whatever_a_calibrator_raises_its_run_has_failed_with_the_reason(error: BaseException, reason: str) -> None:
    result = run(raising(error))
    assert (result.outcome, result.reason) == (Outcome.FAILED, reason)
    assert (result.vector, result.matrix, result.cost) == (None, None, None)
    assert result.evaluations == 1


def test_ctrl_c_is_not_taken_for_a_failure() -> None:
    with pytest.raises(KeyboardInterrupt):
        run(raising(KeyboardInterrupt()))


INVALID: dict[str, tuple[Callable[[CalibrationProblem], Any], str]] = {
    "infinity": (lambda _: np.full(9, np.inf), "NaN or infinity"),
    "one NaN": (lambda problem: np.append(problem.start[:8], np.nan), "NaN or infinity"),
    "too short": (lambda problem: problem.start[:8], "shape (8,)"),
    "a population": (lambda problem: problem.start[None], "shape (1, 9)"),
    "nothing": (lambda _: None, "shape ()"),
    "text": (lambda _: "none found", "not a vector of numbers"),
    "ragged": (lambda _: [[1.0], [1.0, 2.0]], "not a vector of numbers"),
    "outside": (lambda problem: problem.start + np.isin(problem.names, ["m21", "m33"]), "(m21, m33)"),
}


@pytest.mark.parametrize("case", INVALID)
def test_an_answer_that_is_no_calibration_is_invalid(case: str) -> None:
    answer, reason = INVALID[case]
    result = run(answering(answer))
    assert (result.outcome, result.vector, result.matrix, result.cost) == (Outcome.INVALID, None, None, None)
    assert reason in result.reason


def test_an_answer_in_a_box_without_width_must_match_it() -> None:
    result = run(answering(lambda problem: problem.start + 1e-9 * np.isin(problem.names, ["m12"])), box="paper")
    assert result.outcome is Outcome.INVALID
    assert "(m12)" in result.reason


class Unbounded(Scripted):
    bounded = False


def test_a_calibrator_without_bounds_may_answer_outside_the_box_but_not_with_a_matrix_of_zeros() -> None:
    beyond = run_calibrator(Unbounded(answering(lambda problem: problem.upper + 1e-3)), make_problem(RUNS))
    assert (beyond.outcome, beyond.at_bounds) == (Outcome.CONVERGED, ())
    zeros = run_calibrator(Unbounded(answering(lambda problem: 0 * problem.start)), make_problem(RUNS))
    assert zeros.outcome is Outcome.INVALID
    assert "zeros" in zeros.reason


def test_rounding_on_the_boxs_surface_is_forgiven_and_an_answer_on_a_bound_is_flagged() -> None:
    rounded = run(answering(lambda problem: problem.upper * (1 + 1e-15 * np.sign(problem.upper))))
    assert rounded.outcome is Outcome.CONVERGED
    result = run(answering(lambda problem: np.append(problem.start[:8], problem.lower[8])))
    assert result.at_bounds == ("m33",)


def test_an_answer_whose_cost_is_not_finite_is_invalid_and_a_cost_that_raises_fails_the_run() -> None:
    @costs.register("undefined")
    class Undefined(Cost):
        """NaN everywhere."""

        def combine(self, errors: Array, trajectory: Any) -> Array:  # noqa: ARG002
            return np.full(len(errors), np.nan)

    @costs.register("broken")
    class Broken(Cost):
        """Raises."""

        def combine(self, errors: Array, trajectory: Any) -> Array:  # noqa: ARG002
            raise RuntimeError("no cost today")

    result = run(answering(lambda problem: problem.start), cost="undefined")
    assert (result.outcome, result.cost) == (Outcome.INVALID, None)
    for script in (answering(lambda problem: problem.start), for_ever):
        result = run(script, cost="broken")
        assert (result.outcome, result.reason) == (Outcome.FAILED, "RuntimeError: no cost today")


@pytest.mark.parametrize("answer", [None, np.zeros(9), (1, 2)])
def test_something_else_than_a_solution_is_a_failure_that_says_what_it_was(answer: Any) -> None:
    result = run(lambda _: answer)
    assert result.outcome is Outcome.FAILED
    assert type(answer).__name__ in result.reason


def test_the_answer_is_a_copy() -> None:
    kept: list[Array] = []

    def script(problem: CalibrationProblem) -> Solution:
        kept.append(problem.start * 1.01)
        return Solution(kept[0], "done")

    result = run(script)
    before = kept[0].copy()
    kept[0][:] = 0.0
    np.testing.assert_array_equal(result.vector, before)


def test_a_reason_of_several_lines_becomes_one() -> None:
    assert run(lambda problem: Solution(problem.start, "first\nsecond")).reason == "first second"


def test_a_plugin_that_cannot_be_imported_fails_with_its_error() -> None:
    stand_in: type[Calibrator] = unloadable(PluginFailure("plugins/mine.py", "SyntaxError: invalid syntax"))
    result = run_calibrator(stand_in(stand_in.Options(anything=1)), make_problem(RUNS))
    assert result.outcome is Outcome.FAILED
    assert "plugins/mine.py" in result.reason
    assert "SyntaxError" in result.reason
