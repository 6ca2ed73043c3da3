"""Every step of a lower bound holds by itself: duals, sums over samples, what rounding and quadrature may add."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from fit_samples import box_between, make_problem, noisy_trajectories

from omnibench.data.dataset import Trajectory
from omnibench.fit.certify import LowerBounds, StampSums, into_unit_ball, least_sum_of_norms, prove
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.evaluator import ElementBox
from omnibench.fit.parameterisation import Box
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration
from omnibench.testing.synthetic import synthetic_robot


def box_about_the_design(*widths: tuple[int, int, float]) -> Box:
    """The design's elements, but for some (row, column, half-width) that may vary."""
    lower, upper = (synthetic_robot().inverse_kinematic_matrix.copy() for _ in range(2))
    for row, column, width in widths:
        lower[row, column] -= width
        upper[row, column] += width
    return box_between(lower, upper)


def best_of_a_grid(problem: CalibrationProblem, points: int) -> float:
    """The least cost at a grid over the free elements."""
    axes = np.linspace(0.0, 1.0, points)
    return float(problem.values(problem.from_unit(np.array(list(product(axes, repeat=int(problem.free.sum())))))).min())


@pytest.mark.parametrize("cost", ["final_pose", "final_position", "final_heading", "trajectory"])
def test_the_bound_is_just_below_the_least_cost_of_a_grid_over_three_elements(cost: str) -> None:
    box = box_about_the_design((0, 0, 0.01), (1, 1, 0.01), (2, 1, 0.05))
    problem = make_problem(noisy_trajectories(noise=0.03)[1:7], cost=cost, box=box)
    proof = prove(problem, problem.start, gap=1e-3, seconds=np.inf, parts=500)
    least = best_of_a_grid(problem, 17)
    assert proof.finished
    assert 0.97 * least <= proof.lower_bound <= least


@pytest.mark.parametrize("corner", list(product((-1, 1), repeat=3)))
@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_a_box_that_holds_the_true_matrix_in_any_corner_is_bounded_by_no_cost_above_zero(
    corner: tuple[int, int, int], integration: Integration
) -> None:
    """Poses without noise: positions bend with row 3, and a bound by slopes in the middle alone exceeds 0."""
    robot, width = synthetic_robot(), 0.06
    truth = robot.inverse_kinematic_matrix + width * np.outer([0.0, 0.0, 1.0], corner)
    runs = []
    for run in noisy_trajectories(noise=0.0)[1:7]:
        (poses,) = OdometryModel(robot, truth, integration).poses([run.reference_log])
        runs.append(replace(run, poses=np.vstack([run.start, poses])))
    box = box_about_the_design(*((2, column, width) for column in range(3)))
    problem = make_problem(runs, cost="final_position", box=box, integration=integration)
    assert float(problem.values(truth.ravel()[None])[0]) < 1e-12
    assert LowerBounds(problem).root(problem.start).bound < 1e-12


@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_for_any_directions_the_bound_is_just_below_their_least_sum_at_the_corners(integration: Integration) -> None:
    """Eq. (B2) and (B7): phi is linear in each row nearly, and the bound lies below its least value for any u_s."""
    design = synthetic_robot().inverse_kinematic_matrix
    box = box_between(design - 0.001, design + 0.003)
    problem = make_problem(noisy_trajectories(noise=0.03), box=box, integration=integration)
    bounds = LowerBounds(problem)
    part = bounds.root(problem.start)
    corners = problem.from_unit(np.array(list(product((0.0, 1.0), repeat=9)))).reshape(-1, 3, 3)
    errors = problem.odometry.poses(corners) - problem.reference
    for seed in range(5):
        directions = np.random.default_rng(seed).standard_normal((len(problem.reference), 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        phi = (errors * directions).sum(axis=2).mean(axis=1)
        bound, _ = bounds._dual_bound(part, *bounds._stamps.at(part.centre[2]), directions)
        assert phi.min() - 0.02 * np.ptp(phi) <= bound <= phi.min() + 1e-12


def test_a_box_too_wide_for_positions_is_bounded_by_headings_from_its_first_part_on() -> None:
    widths = [(row, column, 0.1 if row < 2 else 0.2) for row, column in product(range(3), repeat=2)]
    problem = make_problem(noisy_trajectories(noise=0.03), cost="trajectory", box=box_about_the_design(*widths))
    assert prove(problem, problem.start, gap=1e-3, seconds=np.inf, parts=1).lower_bound > 0.02


def test_of_one_straight_run_the_bound_is_the_distance_to_the_nearest_end_of_the_box() -> None:
    """Wheel b alone turns by 2 rad in Euler steps without a heading: x = 2 m12, which the box holds below 0.1 m."""
    times = np.array([1.0, 2.0])
    poses = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    run = Trajectory("1", "train", times, np.array([[0.0, 1.0, 0.0]] * 2), np.array([0.0, 2.0]), poses)
    design = synthetic_robot().inverse_kinematic_matrix
    lower, upper = design.copy(), design.copy()
    lower[0, 1], upper[0, 1] = design[0, 1] - 0.05, design[0, 1] + 0.05
    problem = make_problem([run], cost="final_position", integration="euler", box=box_between(lower, upper))
    x, y = 1 + np.exp(1j * design[2, 1]), 1j * (1 + np.exp(1j * design[2, 1]))
    reached = [x * element + y * design[1, 1] for element in np.linspace(lower[0, 1], upper[0, 1], 4001)]
    nearest = min(abs(place - 0.5) for place in reached)
    proof = prove(problem, problem.start, gap=1e-6, seconds=np.inf, parts=500)
    assert proof.finished
    assert proof.lower_bound == pytest.approx(nearest, rel=2e-6)


def test_the_dual_of_a_sum_of_distances_to_points_is_that_of_their_median() -> None:
    residuals = np.array([-3.0, -1.0, 0.0, 0.5, 4.0])[:, None]
    found = least_sum_of_norms(
        residuals, np.ones((5, 1, 1)), np.full(5, 0.2), np.array([-9.0]), np.array([9.0]), np.array([2.0])
    )
    assert found.point == pytest.approx([0.0], abs=2e-3)
    assert found.directions[[0, 1, 3, 4], 0] == pytest.approx([-1, -1, 1, 1], abs=1e-3)
    assert found.directions.sum() == pytest.approx(0.0, abs=1e-8)


def test_a_minimiser_at_the_end_of_the_box_has_directions_that_point_out_of_it() -> None:
    found = least_sum_of_norms(
        np.full((4, 1), 2.0), np.ones((4, 1, 1)), np.full(4, 0.25), np.array([-1.0]), np.array([1.0]), np.zeros(1)
    )
    assert found.point == pytest.approx([-1.0])
    assert found.directions[:, 0] == pytest.approx(np.ones(4), abs=1e-3)


def test_scaled_directions_lie_in_the_unit_ball_to_the_last_digit() -> None:
    directions = np.random.default_rng(1).standard_normal((10_000, 3))
    for scaled in into_unit_ball(directions):
        assert np.linalg.norm(scaled.astype(np.longdouble), axis=1).max() <= 1


@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_sums_differ_from_their_first_order_expansion_by_no_more_than_their_curvature(integration: str) -> None:
    problem = make_problem(noisy_trajectories(noise=0.03), cost="trajectory", integration=integration)
    wide = 2 * np.abs(problem.upper).reshape(3, 3)
    sums = StampSums(problem, np.eye(3), ElementBox(-wide, wide))
    rng = np.random.default_rng(0)
    value, slope = sums.at(np.zeros(3))
    for reach in (0.001, 0.01, 0.1):
        delta = reach * rng.uniform(-1, 1, 3)
        apart = np.abs(sums.at(delta)[0] - value - slope @ delta)
        allowed = np.einsum("l,sjlm,m->sj", np.abs(delta), sums.curvature, np.abs(delta)) / 2
        assert (apart <= allowed + 1e-12).all()
        assert apart.max() > 0.3 * allowed[apart.argmax() // 4, apart.argmax() % 4]


class Decimetres(SumOfNorms):
    """Final poses with positions that count ten times."""

    name = "decimetres"
    weights = (10.0, 10.0, 1.0)


def test_the_error_of_arcs_counts_with_the_weight_of_positions() -> None:
    problem = make_problem(box=box_about_the_design())
    problem.objective = Decimetres(Options())
    cost = float(problem.values(problem.start[None])[0])
    proof = prove(problem, problem.start)
    assert cost - 2e-8 <= proof.lower_bound <= cost - 1e-8


def test_no_matrix_of_the_box_has_larger_elements_than_the_sums_allow_for() -> None:
    """Removing a direction that only slips can move an element that the box itself holds at its start."""
    robot = synthetic_robot(4)
    width = np.where(np.arange(4) == 0, 0.0, 0.02) * np.ones((3, 1))
    matrix = robot.inverse_kinematic_matrix
    problem = make_problem(wheels=4, box=box_between(matrix - width, matrix + width))
    vectors = np.random.default_rng(0).uniform(problem.lower, problem.upper, (2000, problem.size))
    moved = np.abs(problem.parameterisation.matrices(vectors)).max(axis=0)
    assert (moved[:, 0] > np.abs(matrix[:, 0]) + 1e-3).any()
    assert (moved <= ElementBox.of(problem.parameterisation, problem.lower, problem.upper).largest).all()


def with_later_poses(run: Trajectory, *stamps: float) -> Trajectory:
    """The run with its last pose repeated at later stamps."""
    poses = np.vstack([run.poses, *[run.poses[-1:]] * len(stamps)])
    return replace(run, pose_times=np.append(run.pose_times, stamps), poses=poses)


def only_started(run: Trajectory) -> Trajectory:
    """The run with its start pose alone."""
    return replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1])


@pytest.mark.parametrize(
    ("cost", "runs"),
    [
        ("trajectory", [with_later_poses(run, 4.1, 4.2) for run in noisy_trajectories(noise=0.02)]),
        ("final_pose", [only_started(run) if run.id == "04" else run for run in noisy_trajectories(noise=0.02)]),
    ],
)
def test_poses_after_the_last_wheel_sample_or_at_the_start_alone_do_not_stop_a_proof(
    cost: str, runs: Sequence[Trajectory]
) -> None:
    problem = make_problem(runs, cost=cost)
    proof = prove(problem, problem.start, gap=0.1, seconds=np.inf, parts=500)
    vectors: Array = np.random.default_rng(0).uniform(problem.lower, problem.upper, (500, problem.size))
    assert proof.finished
    assert 0 < proof.lower_bound <= problem.values(vectors).min()


def test_a_proof_with_row_3_fixed_goes_on_until_its_gap_is_reached() -> None:
    box = box_about_the_design(*((row, column, 0.02) for row in (0, 1) for column in range(3)))
    problem = make_problem(noisy_trajectories(noise=0.03), box=box)
    proof = prove(problem, problem.start, gap=2e-6, seconds=np.inf, parts=500)
    assert proof.finished
    assert proof.lower_bound >= (1 - 2e-6) * proof.best_cost
