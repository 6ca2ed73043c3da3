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
from omnibench.registry import PluginFailure, calibrators, costs
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
    assert result.vector is not None
    problem = make_problem(RUNS)
    assert result.cost == problem.values(result.vector[None])[0]
    np.testing.assert_array_equal(result.matrix, problem.matrix(result.vector))


def test_one_number_of_degrees_of_freedom_is_that_of_every_variance() -> None:
    result = run(lambda problem: Solution(problem.start, "done", covariance=np.eye(problem.size), degrees_of_freedom=7))
    np.testing.assert_array_equal(result.degrees_of_freedom, np.full(make_problem(RUNS).size, 7.0))


def test_degrees_of_freedom_of_another_size_fail_the_run() -> None:
    result = run(lambda problem: Solution(problem.start, "done", degrees_of_freedom=np.ones(problem.size + 1)))
    assert result.outcome is Outcome.FAILED
    assert result.vector is None


@pytest.mark.parametrize("freedom", [np.nan, 0.0, -3.0])
def test_variances_without_degrees_of_freedom_make_an_answer_invalid(freedom: float) -> None:
    result = run(lambda problem: Solution(problem.start, "done", degrees_of_freedom=freedom))
    assert result.outcome is Outcome.INVALID
    assert result.reason == f"degrees_of_freedom of the answer's variances must be above 0, found {freedom:g}"
    assert (result.vector, result.degrees_of_freedom) == (None, None)


def test_an_answer_at_a_limit_of_the_calibrators_own_has_not_converged() -> None:
    result = run(lambda problem: Solution(problem.start, "5 rounds", converged=False))
    assert (result.outcome, result.reason) == (Outcome.BUDGET, "5 rounds")
    assert result.cost is not None


def test_a_spent_budget_gives_the_best_candidate_so_far() -> None:
    result = run(for_ever, evaluations=40)
    assert (result.outcome, result.reason) == (Outcome.BUDGET, "budget of 40 evaluations spent")
    assert result.evaluations == 40
    assert result.cost == pytest.approx(result.history[-1].cost, rel=1e-12)
    assert result.matrix is not None


def test_spent_time_gives_the_best_candidate_so_far() -> None:
    result = run(for_ever, seconds=0.05)
    assert (result.outcome, result.reason) == (Outcome.TIME, "time budget of 0.05 s spent")
    assert 0.05 <= result.seconds < 5
    assert result.cost == pytest.approx(result.history[-1].cost, rel=1e-12)


def test_a_budget_spent_without_a_finite_cost_is_invalid() -> None:
    def only_nan(problem: CalibrationProblem) -> Solution:
        while True:
            problem.cost(np.full((5, 9), np.nan))

    result = run(only_nan, evaluations=20)
    assert (result.outcome, result.vector, result.cost) == (Outcome.INVALID, None, None)
    assert result.reason == "budget of 20 evaluations spent, and no candidate in the box had a finite cost"


def test_a_budget_spent_outside_the_box_is_invalid() -> None:
    def outside(problem: CalibrationProblem) -> Solution:
        while True:
            problem.cost(problem.upper + 1e-3)

    assert run(outside, evaluations=20).outcome is Outcome.INVALID


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ValueError("a bad\nday"), "ValueError: a bad day"),
        (ZeroDivisionError("division by zero"), "ZeroDivisionError: division by zero"),
        (ConfigError("cannot be solved this way"), "cannot be solved this way"),
        (SystemExit(3), "SystemExit: 3"),
        (MemoryError(), "MemoryError"),
        (RecursionError("too deep"), "RecursionError: too deep"),
        (np.linalg.LinAlgError("singular"), "LinAlgError: singular"),
    ],
)
def test_whatever_a_calibrator_raises_its_run_has_failed_with_the_reason(error: BaseException, reason: str) -> None:
    result = run(raising(error))
    assert (result.outcome, result.reason) == (Outcome.FAILED, reason)
    assert (result.vector, result.matrix, result.cost) == (None, None, None)
    assert result.evaluations == 1


def test_an_error_whose_own_text_raises_is_still_told() -> None:
    class NastyError(Exception):
        def __str__(self) -> str:
            raise RuntimeError("not even this works")

    assert run(raising(NastyError())).reason == "NastyError"


def test_ctrl_c_is_not_taken_for_a_failure() -> None:
    with pytest.raises(KeyboardInterrupt):
        run(raising(KeyboardInterrupt()))


INVALID: dict[str, tuple[Callable[[CalibrationProblem], Any], str]] = {
    "NaN": (lambda problem: problem.start * np.nan, "the answer holds NaN or infinity"),
    "infinity": (lambda _: np.full(9, np.inf), "the answer holds NaN or infinity"),
    "one NaN": (lambda problem: np.append(problem.start[:8], np.nan), "the answer holds NaN or infinity"),
    "too short": (lambda problem: problem.start[:8], "the answer has shape (8,), expected (9,)"),
    "a matrix": (lambda problem: problem.start.reshape(3, 3), "the answer has shape (3, 3), expected (9,)"),
    "a population": (lambda problem: problem.start[None], "the answer has shape (1, 9), expected (9,)"),
    "a number": (lambda _: 1.0, "the answer has shape (), expected (9,)"),
    "nothing": (lambda _: None, "the answer has shape (), expected (9,)"),
    "text": (lambda _: "none found", "the answer is not a vector of numbers"),
    "a mapping": (lambda _: {"m11": 1.0}, "the answer is not a vector of numbers"),
    "ragged": (lambda _: [[1.0], [1.0, 2.0]], "the answer is not a vector of numbers"),
    "outside": (
        lambda problem: problem.start + np.isin(problem.names, ["m21", "m33"]),
        "the answer is outside the box (m21, m33)",
    ),
}


@pytest.mark.parametrize("case", INVALID)
def test_an_answer_that_is_no_calibration_is_invalid(case: str) -> None:
    answer, reason = INVALID[case]
    result = run(answering(answer))
    assert (result.outcome, result.reason) == (Outcome.INVALID, reason)
    assert (result.vector, result.matrix, result.cost) == (None, None, None)


def test_an_answer_in_a_box_without_width_must_match_it() -> None:
    result = run(answering(lambda problem: problem.start + 1e-9 * np.isin(problem.names, ["m12"])), box="paper")
    assert (result.outcome, result.reason) == (Outcome.INVALID, "the answer is outside the box (m12)")


def test_a_matrix_that_moves_no_robot_is_invalid() -> None:
    class Unbounded(Scripted):
        bounded = False

    result = run_calibrator(Unbounded(answering(lambda problem: 0 * problem.start)), make_problem(RUNS))
    assert result.outcome is Outcome.INVALID
    assert result.reason == "the answer's matrix holds zeros only: no wheel would move the robot"


def test_rounding_on_the_boxs_surface_is_forgiven() -> None:
    result = run(answering(lambda problem: problem.upper * (1 + 1e-15 * np.sign(problem.upper))))
    assert result.outcome is Outcome.CONVERGED


def test_an_answer_whose_cost_is_not_finite_is_invalid() -> None:
    @costs.register("undefined")
    class Undefined(Cost):
        """NaN everywhere."""

        def combine(self, errors: Array, trajectory: Any) -> Array:  # noqa: ARG002
            return np.full(len(errors), np.nan)

    result = run(answering(lambda problem: problem.start), cost="undefined")
    assert (result.outcome, result.reason, result.cost) == (Outcome.INVALID, "the answer's cost is not finite", None)


def test_a_cost_that_raises_fails_the_run_even_of_a_calibrator_that_never_asked() -> None:
    @costs.register("broken")
    class Broken(Cost):
        """Raises."""

        def combine(self, errors: Array, trajectory: Any) -> Array:  # noqa: ARG002
            raise RuntimeError("no cost today")

    for script in (answering(lambda problem: problem.start), for_ever):
        result = run(script, cost="broken")
        assert result.outcome is Outcome.FAILED
        assert result.reason == "RuntimeError: no cost today"


@pytest.mark.parametrize("answer", [None, np.zeros(9), (1, 2)])
def test_something_else_than_a_solution_is_a_failure_that_says_what_it_was(answer: Any) -> None:
    result = run(lambda _: answer)
    assert result.outcome is Outcome.FAILED
    assert result.reason == f"calibrate returned {type(answer).__name__}, expected a Solution"


def test_a_calibrator_without_bounds_may_answer_outside_the_box() -> None:
    class Free(Scripted):
        bounded = False

    problem = make_problem(RUNS)
    result = run_calibrator(Free(answering(lambda given: given.upper + 1e-3)), problem)
    assert result.outcome is Outcome.CONVERGED
    assert result.at_bounds == ()


def test_an_answer_on_a_bound_is_flagged() -> None:
    result = run(answering(lambda problem: np.append(problem.start[:8], problem.lower[8])))
    assert result.at_bounds == ("m33",)


def test_the_answer_is_a_copy() -> None:
    kept: list[Array] = []

    def script(problem: CalibrationProblem) -> Solution:
        kept.append(problem.start * 1.01)
        return Solution(kept[0], "done")

    result = run(script)
    before = kept[0].copy()
    kept[0][:] = 0.0
    np.testing.assert_array_equal(result.vector, before)


def test_the_history_shows_every_improvement() -> None:
    problem = make_problem(RUNS)
    better = problem.start + 0.3 * (closed_form_vector() - problem.start)

    def script(given: CalibrationProblem) -> Solution:
        for candidate in (given.start, given.start, better, given.start, closed_form_vector()):
            given.cost(candidate)
        return Solution(given.best_vector, "done")

    result = run_calibrator(Scripted(script), problem)
    assert [step.evaluations for step in result.history] == [1, 3, 5]
    assert result.evaluations == 5
    assert result.history[-1].cost == pytest.approx(result.cost, rel=1e-12)


def closed_form_vector() -> Array:
    """The optimum of the problem."""
    vector = run_calibrator(calibrators.create("closed_form"), make_problem(RUNS)).vector
    assert vector is not None
    return vector


def test_a_reason_of_several_lines_becomes_one() -> None:
    assert run(lambda problem: Solution(problem.start, "first\nsecond")).reason == "first second"


def test_a_plugin_that_cannot_be_imported_fails_with_its_error() -> None:
    stand_in: type[Calibrator] = unloadable(PluginFailure("plugins/mine.py", "SyntaxError: invalid syntax"))
    result = run_calibrator(stand_in(stand_in.Options(anything=1)), make_problem(RUNS))
    assert result.outcome is Outcome.FAILED
    assert result.reason == "plugins/mine.py cannot be imported: SyntaxError: invalid syntax"
