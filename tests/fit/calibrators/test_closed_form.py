"""The exact minimiser: it finds the hidden matrix, and nothing in the same box is better."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from fit_samples import box_between, make_problem, noisy_trajectories

from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.cost import Cost
from omnibench.fit.parameterisation import Box
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators, costs
from omnibench.robot.kinematics import Array
from omnibench.testing.synthetic import synthetic_robot, synthetic_trajectories, true_robot

BOTH: list[Any] = ["euler", "arc"]
DESIGNS: dict[Any, Array] = {wheels: synthetic_robot(wheels).inverse_kinematic_matrix for wheels in (3, 4)}


def closed_form(problem: CalibrationProblem, **options: Any) -> RunResult:
    return run_calibrator(calibrators.create("closed_form", options), problem)


def tight(wheels: Any, share: float) -> Box:
    """A box that the optimum does not fit into."""
    width = share * np.abs(DESIGNS[wheels])
    return box_between(DESIGNS[wheels] - width, DESIGNS[wheels] + width)


def lopsided(wheels: Any) -> Box:
    """A box with room for one wheel only, and almost none for the others."""
    width = np.abs(DESIGNS[wheels]).max(axis=1, keepdims=True) * np.full(DESIGNS[wheels].shape, 0.001)
    lower, upper = DESIGNS[wheels] - width, DESIGNS[wheels] + width
    lower[:, 0] -= 100 * width[:, 0]
    upper[:, 0] += 100 * width[:, 0]
    return box_between(lower, upper)


BOXES: dict[str, Callable[[Any], Box]] = {
    "row": lambda _: "row",
    "paper": lambda _: "paper",
    "tight": lambda wheels: tight(wheels, 0.02),
    "lopsided": lopsided,
}


@pytest.mark.parametrize("integration", BOTH)
@pytest.mark.parametrize("cost", ["final_pose", "trajectory"])
@pytest.mark.parametrize("wheels", [3, 4])
def test_runs_without_noise_give_a_hidden_matrix_on_the_driven_span(wheels: Any, cost: str, integration: Any) -> None:
    robot = synthetic_robot(wheels)
    problem = make_problem(
        synthetic_trajectories(robot, integration), wheels=wheels, cost=cost, integration=integration
    )
    result = closed_form(problem)
    assert result.outcome is Outcome.CONVERGED
    null = problem.parameterisation.null
    assert null.shape == (wheels - 3, wheels)
    error = result.matrix - true_robot(robot).inverse_kinematic_matrix
    np.testing.assert_allclose(error - error @ null.T @ null, 0, atol=1e-10)
    np.testing.assert_allclose(result.matrix @ null.T, robot.inverse_kinematic_matrix @ null.T, atol=1e-14)
    np.testing.assert_allclose(result.vector, result.matrix.ravel(), atol=1e-15)


def test_three_wheels_on_straight_runs_keep_the_design_along_what_was_not_driven() -> None:
    straight = [run for index, run in enumerate(noisy_trajectories(3, noise=1e-4)) if index % 3 == 1]
    problem = make_problem(straight)
    (null,) = problem.parameterisation.null
    result = closed_form(problem)
    np.testing.assert_allclose(np.abs(null), np.sqrt(1 / 3), atol=0.02)
    np.testing.assert_allclose(result.matrix @ null, DESIGNS[3] @ null, atol=1e-14)


def local_rivals(problem: CalibrationProblem, vector: Array, count: int) -> Array:
    """Random vectors in the box: some anywhere, others ever nearer to ``vector``, in all or in single elements."""
    rng = np.random.default_rng(3)
    shape = (count, problem.size)
    steps = (problem.upper - problem.lower) * rng.standard_normal(shape) * 10 ** rng.uniform(-7, 0, (count, 1))
    single = rng.random((count, 1)) < 0.5
    steps = np.where(single, steps * (rng.random(shape) < 1.5 / problem.size), steps)
    return np.clip(vector + steps, problem.lower, problem.upper)


def assert_optimal(problem: CalibrationProblem, rivals: int) -> RunResult:
    """The answer, which no change within the box improves."""
    result = closed_form(problem)
    assert result.outcome is Outcome.CONVERGED
    assert problem.inside(result.vector)
    assert problem.values(local_rivals(problem, result.vector, rivals)).min() > result.cost - 1e-9
    return result


@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize("cost", ["final_pose", "final_position", "final_heading", "trajectory"])
@pytest.mark.parametrize("wheels", [3, 4])
def test_no_change_within_the_box_lowers_the_cost(wheels: Any, cost: str, box: str) -> None:
    problem = make_problem(wheels=wheels, cost=cost, box=BOXES[box](wheels))
    result = assert_optimal(problem, 400)
    assert result.at_bounds == problem.at_bounds(result.vector)
    if cost == "final_pose":
        assert (len(result.at_bounds) >= 2) == (box in ("tight", "lopsided"))
    if box == "paper":
        assert result.matrix[0, 1] == DESIGNS[wheels][0, 1] or wheels == 4


def test_steps_that_overshoot_are_shortened() -> None:
    # Errors of two metres bend the paths so much that full steps lead nowhere.
    assert_optimal(make_problem(noisy_trajectories(noise=2.0, seed=3)[:6], cost="final_position"), 2_000)


def test_a_box_without_any_width_gives_the_design() -> None:
    result = closed_form(make_problem(box=box_between(DESIGNS[3], DESIGNS[3])))
    assert result.outcome is Outcome.CONVERGED
    np.testing.assert_array_equal(result.matrix, DESIGNS[3])


def test_one_run_is_enough_to_converge() -> None:
    result = closed_form(make_problem(noisy_trajectories()[:1]))
    assert result.outcome is Outcome.CONVERGED
    assert result.cost == pytest.approx(0.0, abs=1e-9)


def test_the_reason_says_newton_steps_where_no_cone_program_was_solved() -> None:
    runs = noisy_trajectories()
    stamps = sum(len(run.pose_times) - 1 for run in runs)
    many = [replace(run, id=f"{run.id}-{copy}") for copy in range(-(-1000 // stamps)) for run in runs]
    assert re.search(r"after \d+ Newton steps", closed_form(make_problem(many, cost="trajectory")).reason)


def test_too_few_programs_or_evaluations_are_not_called_converged() -> None:
    result = closed_form(make_problem(), programs=1)
    assert result.outcome is Outcome.BUDGET
    assert "after 1 cone program" in result.reason
    problem = make_problem(evaluations=1)
    result = closed_form(problem)
    assert result.outcome is Outcome.BUDGET
    np.testing.assert_array_equal(result.vector, problem.start)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [({"parameterisation": "geometry"}, "matrix parameterisation"), ({"cost": "largest"}, "largest")],
)
def test_a_geometry_or_a_cost_that_is_no_sum_of_norms_is_refused_in_words(changes: Any, reason: str) -> None:
    @costs.register("largest")
    class Largest(Cost):
        """The largest error."""

        def combine(self, errors: Array, trajectory: Any) -> Array:  # noqa: ARG002
            return np.abs(errors).max(axis=(1, 2))

    result = closed_form(make_problem(**changes))
    assert (result.outcome, result.vector) == (Outcome.FAILED, None)
    assert reason in result.reason


def test_five_runs_that_hardly_scatter_have_an_answer_and_say_why_the_solver_stopped() -> None:
    runs = synthetic_trajectories(synthetic_robot(3), "arc")
    reasons = []
    for scatter, seed in product((1e-5, 1e-6, 3e-7), range(12)):  # where rounding stops it depends on the processor
        rng = np.random.default_rng(seed)
        few = [
            replace(
                run, poses=run.poses + np.vstack([np.zeros(3), scatter * rng.standard_normal((len(run.poses) - 1, 3))])
            )
            for run in (runs[index] for index in rng.choice(len(runs), 5, replace=False))
        ]
        result = closed_form(make_problem(few, cost="final_position"))
        assert result.matrix is not None
        reasons += [] if result.outcome is Outcome.CONVERGED else [result.reason]
    assert all("10 errors for 9 numbers are met almost exactly, record more runs" in reason for reason in reasons)
    assert reasons, "no seed stops the solver any more: take one that does"
