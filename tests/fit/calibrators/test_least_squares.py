"""Linear least squares: the minimum of the squares in the box, by one evaluation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fit_samples import box_between, make_problem, noisy_trajectories
from scipy.optimize import lsq_linear

from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.linear_fit import linear_fit
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array
from omnibench.testing.synthetic import synthetic_robot

DESIGN = synthetic_robot(3).inverse_kinematic_matrix


def least_squares(problem: CalibrationProblem) -> RunResult:
    result = run_calibrator(calibrators.create("least_squares"), problem)
    assert result.outcome is Outcome.CONVERGED
    return result


def matrix_of(problem: CalibrationProblem) -> Array:
    result = least_squares(problem)
    assert result.matrix is not None
    return result.matrix


@pytest.mark.parametrize("integration", ["euler", "arc"])
@pytest.mark.parametrize("cost", ["final_pose", "trajectory"])
def test_in_a_wide_box_it_is_the_unbounded_solution(cost: str, integration: Any) -> None:
    problem = make_problem(cost=cost, integration=integration)
    unbounded = linear_fit(problem.odometry, problem.trajectories, problem.reference, DESIGN, np.eye(3))
    np.testing.assert_allclose(matrix_of(problem), unbounded, rtol=0, atol=1e-8)


def test_on_a_bound_it_is_the_minimum_in_the_box() -> None:
    problem = make_problem(box=box_between(DESIGN - 0.005, DESIGN + 0.005))
    found = matrix_of(problem)
    assert least_squares(problem).at_bounds
    turned = problem.reference[:, 2] - np.array([run.start[2] for run in problem.trajectories])
    expected = lsq_linear(problem.odometry.driven, turned, (DESIGN[2] - 0.005, DESIGN[2] + 0.005)).x
    np.testing.assert_allclose(found[2], expected, rtol=0, atol=1e-8)


def test_it_is_near_the_optimum_with_one_evaluation() -> None:
    found = least_squares(make_problem())
    best = run_calibrator(calibrators.create("closed_form"), make_problem()).cost
    assert found.cost is not None
    assert best is not None
    assert best <= found.cost < 1.05 * best
    assert found.evaluations == 1


def test_elements_that_the_box_holds_stay() -> None:
    width = np.abs(DESIGN) * 0.1
    width[0] = 0.0
    found = matrix_of(make_problem(box=box_between(DESIGN - width, DESIGN + width)))
    np.testing.assert_array_equal(found[0], DESIGN[0])


def test_straight_runs_keep_the_design_along_what_was_not_driven() -> None:
    straight = [run for index, run in enumerate(noisy_trajectories(3, noise=1e-4)) if index % 3 == 1]
    problem = make_problem(straight)
    assert isinstance(problem.parameterisation, MatrixElements)
    (null,) = problem.parameterisation.null
    np.testing.assert_allclose(matrix_of(problem) @ null, DESIGN @ null, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "told"),
    [({"parameterisation": "geometry"}, "matrix parameterisation"), ({"cost": "final_heading"}, None)],
)
def test_other_problems_are_solved_or_refused_in_words(changes: dict[str, Any], told: str | None) -> None:
    result = run_calibrator(calibrators.create("least_squares"), make_problem(**changes))
    assert result.outcome is (Outcome.FAILED if told else Outcome.CONVERGED)
    assert told is None or told in result.reason
