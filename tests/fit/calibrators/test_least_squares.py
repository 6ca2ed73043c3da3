"""Linear least squares with the headings of the reference, where searches begin: the minimum in the box."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from fit_samples import box_between, make_problem, noisy_trajectories
from motions import RING, TURNS, driven
from numpy.testing import assert_array_equal
from sample_robots import APR02
from scipy.optimize import lsq_linear

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.calibrators.trajectory_ml import TrajectoryML, TrajectoryMLOptions
from omnibench.fit.cost import Cost
from omnibench.fit.linear_fit import linear_fit
from omnibench.fit.parameterisation import Box
from omnibench.fit.problem import Budget, CalibrationProblem
from omnibench.fit.trajectory_fit import TURN
from omnibench.registry import calibrators, costs
from omnibench.robot.kinematics import Array, published_matrix
from omnibench.robot.odometry import OdometryBatch
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset
from omnibench.testing.synthetic import synthetic_robot, synthetic_trajectories, true_robot

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


# The exact minimiser: it finds the hidden matrix, and nothing in the same box is better.

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
    runs = synthetic_trajectories(robot, integration)
    problem = make_problem(runs, wheels=wheels, cost=cost, integration=integration)
    result = closed_form(problem)
    assert result.outcome is Outcome.CONVERGED
    null = problem.parameterisation.null
    assert null.shape == (wheels - 3, wheels)
    error = result.matrix - true_robot(robot).inverse_kinematic_matrix
    np.testing.assert_allclose(error - error @ null.T @ null, 0, atol=1e-10)
    np.testing.assert_allclose(result.matrix @ null.T, robot.inverse_kinematic_matrix @ null.T, atol=1e-14)
    np.testing.assert_allclose(result.vector, result.matrix.ravel(), atol=1e-15)


@pytest.mark.parametrize(("calibrator", "rounding"), [("least_squares", 1e-12), ("closed_form", 1e-14)])
def test_straight_runs_keep_the_design_along_what_was_not_driven(calibrator: str, rounding: float) -> None:
    straight = [run for index, run in enumerate(noisy_trajectories(3, noise=1e-4)) if index % 3 == 1]
    problem = make_problem(straight)
    (null,) = problem.parameterisation.null
    result = run_calibrator(calibrators.create(calibrator), problem)
    np.testing.assert_allclose(np.abs(null), np.sqrt(1 / 3), atol=0.02)
    np.testing.assert_allclose(result.matrix @ null, DESIGNS[3] @ null, atol=rounding)


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


# trajectory_ml finds the matrix from all reference poses, and start poses and clocks do not lead it astray.

EQ_8 = published_matrix("palacin2023_eq8")


def flower(seed: int = 1, distance: float = 1.1, **noise: float) -> CalibrationProblem:
    """A small simulated flower of the APR-02 robot, as a problem."""
    config = FlowerConfig.model_validate(
        {
            "robot": APR02,
            "sample_period": 0.05,
            "commands": {"directions_deg": [0, 90, 180, 270], "turn_rates": [-0.35, 0.0, 0.35]},
            "repetitions": 3,
            "truth": {"published": "palacin2023_eq8"},
            "noise": noise or {"pose_position": 0.005, "pose_heading": 0.005, "walk_position": 0.003},
            "train": {"seed": seed, "distance": distance},
        }
    )
    return make_problem(simulate_dataset(config).dataset.trajectories, robot=config.robot)


def with_poses(problem: CalibrationProblem, change: Callable[[Trajectory], Array]) -> CalibrationProblem:
    """The problem with other reference poses."""
    return changed(problem, [replace(run, poses=change(run)) for run in problem.trajectories])


def changed(problem: CalibrationProblem, runs: list[Trajectory]) -> CalibrationProblem:
    """The same problem on other runs."""
    return CalibrationProblem(
        problem.robot, runs, problem.objective, problem.parameterisation, integration="arc", budget=Budget(), seed=0
    )


def solved(problem: CalibrationProblem, **options: object) -> RunResult:
    result = run_calibrator(calibrators.create("trajectory_ml", options), problem)
    assert result.outcome is Outcome.CONVERGED, result.reason
    return result


def misses(result: RunResult) -> Array:
    """How far the elements (9,) are off the hidden matrix, in their own standard deviations."""
    found: Array = (result.matrix - EQ_8).ravel() / np.sqrt(np.diag(result.covariance))
    return found


@pytest.mark.slow
def test_its_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    inside = np.concatenate([np.abs(misses(solved(flower(seed)))) < 1.96 for seed in range(12)])
    # 108 intervals in 12 independent sets: three standard deviations of the mean, were each set's all alike.
    assert inside.mean() > 0.95 - 3 * np.sqrt(0.95 * 0.05 / 12)


def test_noise_and_covariance_come_with_the_answer() -> None:
    result = solved(flower(pose_position=0.006, pose_heading=0.004))
    assert result.noise.pose_position == pytest.approx(0.006, rel=0.1)
    assert np.linalg.eigvalsh(result.covariance).min() > 0


@pytest.mark.parametrize("clock", ["offset", "offset_and_slope"])
def test_a_shifted_clock_of_the_reference_does_not_spoil_the_matrix(clock: str) -> None:
    problem = flower(distance=2.2, pose_position=0.001, pose_heading=0.001)
    rng = np.random.default_rng(5)

    def seen_late(run: Trajectory) -> Array:
        late = rng.normal(0, 0.1)
        moving = np.stack([np.interp(run.pose_times + late, run.pose_times, column) for column in run.poses.T], axis=1)
        return np.vstack([run.poses[:1], moving[1:]])

    shifted = with_poses(problem, seen_late)
    without, with_clock = solved(shifted), solved(shifted, clock=clock)
    assert np.abs(with_clock.matrix - EQ_8).max() < 0.7 * np.abs(without.matrix - EQ_8).max()


def with_starts_off(problem: CalibrationProblem, deviations: Sequence[float], seed: int) -> CalibrationProblem:
    rng = np.random.default_rng(seed)
    return with_poses(problem, lambda run: np.vstack([run.start + deviations * rng.standard_normal(3), run.poses[1:]]))


def test_start_poses_that_are_off_are_taken_for_nuisances() -> None:
    assert np.abs(misses(solved(with_starts_off(flower(), [0.03, 0.03, 0.03], 3)))).max() < 4


def test_how_far_start_headings_are_off_is_measured() -> None:
    problem = flower(pose_position=0.002, pose_heading=0.002)

    def start_heading(problem: CalibrationProblem) -> float:
        return float(TrajectoryML(TrajectoryMLOptions()).estimate(problem).nuisances.deviations[TURN])

    # Three standard deviations with 24 differences.
    assert start_heading(with_starts_off(problem, [0.0, 0.0, 0.03], 4)) == pytest.approx(0.03, rel=0.45)
    assert start_heading(problem) < 0.003


def bent(problem: CalibrationProblem) -> CalibrationProblem:
    """The problem with references that no matrix explains: commands to the left and the right differ in length."""
    return with_poses(problem, lambda run: run.poses * ([1 + 0.05 * np.sin(3 * run.alpha + 1)] * 2 + [1.0]))


def test_where_no_matrix_fits_the_cost_weighs_and_the_intervals_are_those_of_the_scatter() -> None:
    problem = bent(flower())
    found, by_noise = solved(problem), solved(problem, weights="noise", covariance="model")
    assert "weighted by the cost" in found.reason
    assert "the noise model" in by_noise.reason
    assert found.cost < by_noise.cost
    assert np.trace(found.covariance) > 2 * np.trace(by_noise.covariance)


@pytest.mark.parametrize("noise", [{}, {"pose_position": 0.0}])
def test_where_a_matrix_fits_the_noise_weighs(noise: dict[str, float]) -> None:
    assert "the noise model" in solved(flower(**noise)).reason


def test_intervals_of_the_scatter_can_be_asked_for() -> None:
    problem = flower()
    scatter, model = solved(problem, covariance="robust"), solved(problem)
    assert "36 runs of 12 commands" in scatter.reason
    assert scatter.vector == pytest.approx(model.vector)
    # The same variances but for chance; each is known from 24 differences.
    ratios = np.diag(scatter.covariance) / np.diag(model.covariance)
    assert np.exp(np.abs(np.log(ratios)).max()) < 3


def test_without_repetitions_the_scatter_of_the_runs_states_the_intervals() -> None:
    problem = flower()
    once = changed(problem, [run for run in problem.trajectories if run.repetition == 1])
    asked, by_itself = solved(once, covariance="robust"), solved(once)
    assert_array_equal(by_itself.covariance, asked.covariance)
    assert "12 runs: no command is repeated" in by_itself.reason


def test_intervals_of_as_few_runs_as_the_numbers_take_are_wide_or_refused() -> None:
    problem = flower()
    result = solved(changed(problem, [problem.trajectories[index] for index in (0, 15, 30)]))
    assert_array_equal(result.degrees_of_freedom, 1.0)
    one_command = changed(problem, problem.trajectories[:3])
    refused = run_calibrator(calibrators.create("trajectory_ml", {"covariance": "robust"}), one_command)
    assert refused.outcome is Outcome.FAILED
    assert "use covariance: model" in refused.reason


@pytest.mark.parametrize(
    ("options", "named"), [({"covariance": "model", "weights": "cost"}, "robust"), ({"clock": "offse"}, "clock")]
)
def test_options_that_do_not_go_together_or_are_unknown_are_refused(options: dict[str, str], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        calibrators.create("trajectory_ml", options)


def test_the_box_and_the_design_along_directions_that_are_not_driven_are_kept() -> None:
    boxed = make_problem(box="paper")
    assert boxed.inside(solved(boxed).vector[None])[0]
    problem = make_problem(noisy_trajectories(4), wheels=4)
    (null,) = problem.parameterisation.null
    assert np.abs((solved(problem).matrix - problem.robot.inverse_kinematic_matrix) @ null).max() < 1e-9
