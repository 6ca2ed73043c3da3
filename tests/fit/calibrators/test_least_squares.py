"""Linear least squares with the headings of the reference, where searches begin: the minimum in the box."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fit_samples import box_between, make_problem, noisy_trajectories
from motions import RING, TURNS, driven
from scipy.optimize import lsq_linear

from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.linear_fit import linear_fit
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch
from omnibench.testing.synthetic import synthetic_robot, true_robot

DESIGN = synthetic_robot(3).inverse_kinematic_matrix


def least_squares(problem: CalibrationProblem) -> RunResult:
    result = run_calibrator(calibrators.create("least_squares"), problem)
    assert result.outcome is Outcome.CONVERGED
    return result


def matrix_of(problem: CalibrationProblem) -> Array:
    return least_squares(problem).matrix


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


TRUTH = true_robot(synthetic_robot()).inverse_kinematic_matrix


def fitted(directions: Array, noise: float = 0.0) -> tuple[Array, OdometryBatch, Array]:
    """The matrix, the odometry of the runs, and the turns (S,) of their references since the start."""
    runs = driven((*RING, *TURNS), noise=noise)
    odometry = OdometryBatch([run.reference_log for run in runs], "arc")
    reference = np.concatenate([run.poses[1:] for run in runs])
    starts = np.array([run.start[2] for run in runs])[odometry.trajectory]
    return linear_fit(odometry, runs, reference, DESIGN, directions), odometry, reference[:, 2] - starts


def test_runs_without_noise_give_the_hidden_matrix() -> None:
    matrix, *_ = fitted(np.eye(3))
    np.testing.assert_allclose(matrix[2], TRUTH[2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(matrix[:2], TRUTH[:2], rtol=0, atol=1e-5)  # arcs: steps in the heading they begin with


def test_its_residuals_are_orthogonal_to_what_is_fitted() -> None:
    """Row 3 obeys the normal equations of headings on wheel angles: C'(theta - C m3) = 0."""
    matrix, odometry, turned = fitted(np.eye(3), noise=0.01)
    np.testing.assert_allclose(odometry.driven.T @ (turned - odometry.driven @ matrix[2]), 0.0, atol=1e-9)
