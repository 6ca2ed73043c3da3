"""What is certified holds for every matrix of the box, and so does every step of a lower bound by itself."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from commands import CONFIGS
from fit_samples import box_between, make_problem, noisy_trajectories
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from scipy.optimize import minimize

from omnibench.cli.terminal.calibration_tables import print_certificate
from omnibench.compare.config import read_compare_config
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.certify import LowerBounds, StampSums, certify_optimum, into_unit_ball, least_sum_of_norms, prove
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.evaluator import ElementBox
from omnibench.fit.parameterisation import Box
from omnibench.fit.problem import CalibrationProblem
from omnibench.progress import Progress
from omnibench.registry import Options, calibrators
from omnibench.robot.calibration import Calibration, EffectTerm, matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration
from omnibench.testing.synthetic import PERIOD, synthetic_dataset, synthetic_robot, synthetic_trajectories, true_robot

COSTS = ("final_pose", "final_position", "final_heading", "trajectory")


def random_box(wheels: int, rng: np.random.Generator) -> Box:
    """A box about the design, of random widths, some of them none."""
    matrix = synthetic_robot(4 if wheels == 4 else 3).inverse_kinematic_matrix
    size = np.abs(matrix).max(axis=1, keepdims=True)
    below, above = (rng.uniform(0, 0.3, matrix.shape) * size * (rng.random(matrix.shape) > 0.15) for _ in range(2))
    return box_between(matrix - below, matrix + above)


def random_problem(seed: int, cost: str, integration: Integration, wheels: int) -> CalibrationProblem:
    """Few noisy runs, some of them alone, in a random box."""
    rng = np.random.default_rng(seed)
    runs = noisy_trajectories(
        4 if wheels == 4 else 3, noise=float(10 ** rng.uniform(-4, -1)), seed=seed, integration=integration
    )
    chosen = rng.permutation(len(runs))[: rng.integers(1, 8)]
    return make_problem(
        [runs[index] for index in chosen],
        wheels=4 if wheels == 4 else 3,
        cost=cost,
        integration=integration,
        box=random_box(wheels, rng),
        evaluations=10**6,
    )


def best_found(problem: CalibrationProblem, rng: np.random.Generator) -> float:
    """The lowest cost that random search, the exact minimiser and a local search find: what a bound must stay below."""
    free = int(problem.free.sum())
    candidates = [problem.from_unit(rng.uniform(size=(500, free))), problem.start[None]]
    truth = true_robot(problem.robot).inverse_kinematic_matrix.ravel()
    candidates.append(np.clip(truth, problem.lower, problem.upper)[None])
    exact = calibrators.create("closed_form").calibrate(problem).vector
    candidates.append(exact[None])
    if free:
        near = minimize(
            lambda point: float(problem.values(problem.from_unit(point))[0]),
            problem.to_unit(exact)[0],
            method="Nelder-Mead",
            options={"maxfev": 200},
            bounds=[(0, 1)] * free,
        )
        candidates.append(problem.from_unit(near.x))
    return float(problem.values(np.concatenate(candidates)).min())


@settings(max_examples=24, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    cost=st.sampled_from(COSTS),
    integration=st.sampled_from(["euler", "arc"]),
    wheels=st.sampled_from([3, 4]),
    stopped=st.booleans(),
)
def test_no_matrix_beats_the_bound(seed: int, cost: str, integration: Integration, wheels: int, stopped: bool) -> None:
    problem = random_problem(seed, cost, integration, wheels)
    proof = prove(problem, problem.start, gap=1e-2, seconds=np.inf, parts=1 if stopped else 15)
    assert 0 <= proof.lower_bound <= best_found(problem, np.random.default_rng(seed))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), cost=st.sampled_from(COSTS), integration=st.sampled_from(["euler", "arc"]))
def test_each_part_of_the_box_bounds_the_matrices_in_it(seed: int, cost: str, integration: Integration) -> None:
    problem = random_problem(seed, cost, integration, 3)
    bounds = LowerBounds(problem)
    rng = np.random.default_rng(seed)
    part = bounds.root(problem.start)
    for _ in range(12):
        deviations = rng.uniform(part.lower, part.upper, size=(200, *part.lower.shape))
        vectors = np.array([bounds.vector(one) for one in deviations])
        assert part.bound <= problem.values(vectors).min()
        part = bounds.split(part)[int(rng.integers(2))]


@pytest.fixture(scope="module")
def flower() -> Dataset:
    config = read_compare_config(CONFIGS / "apr02.yaml")
    ((name, source),) = config.datasets.items()
    return source.load(name)


@pytest.mark.parametrize("box", ["paper", "row"])
def test_on_the_papers_flower_closed_form_is_proven_to_a_tenth_of_a_per_cent(flower: Dataset, box: Box) -> None:
    found = calibrate(flower, box=box, integration="euler").calibration
    certified = certify_optimum(found, flower, box=box, seconds=np.inf, parts=2000)
    assert certified.proof.finished
    assert certified.inside
    assert 0 <= certified.certificate.gap <= 1e-3
    assert certified.certificate.box == box


def test_the_design_values_are_told_how_much_could_be_gained(flower: Dataset) -> None:
    certified = certify_optimum(design_of(flower), flower, gap=0.05, seconds=np.inf, parts=2000)
    assert 0.80 < certified.certificate.gap < 0.86  # the paper's 82 %


def design_of(dataset: Dataset, integration: Integration = "euler") -> Calibration:
    robot = dataset.robot
    return Calibration(
        name="design",
        robot=robot,
        sample_period=dataset.sample_period,
        matrix=matrix_rows(robot.inverse_kinematic_matrix),
        integration=integration,
    )


def test_a_box_without_width_is_bounded_by_its_only_cost() -> None:
    matrix = synthetic_robot().inverse_kinematic_matrix
    problem = make_problem(box=box_between(matrix, matrix))
    proof = prove(problem, problem.start)
    cost = float(problem.values(problem.start[None])[0])
    assert proof.finished
    assert cost - 2e-9 <= proof.lower_bound <= cost  # arcs are summed to 1e-9 m


def test_a_better_matrix_is_found_on_the_way_and_a_proof_that_is_stopped_says_so_and_still_holds() -> None:
    problem = make_problem()
    exact = calibrators.create("closed_form").calibrate(problem).vector
    least = problem.values(exact[None])[0]
    assert prove(problem, problem.start, gap=1e-2, seconds=np.inf, parts=2000).best_cost <= least * 1.01
    stopped = prove(problem, problem.start, gap=1e-9, seconds=np.inf, parts=3)
    assert not stopped.finished
    assert stopped.lower_bound <= least


def test_the_proof_tells_how_it_gets_on() -> None:
    seen: list[Progress] = []
    problem = make_problem()
    proof = prove(problem, problem.start, gap=1e-2, seconds=np.inf, parts=2000, watch=seen.append)
    assert len(seen) > 3
    assert [event.done for event in seen] == sorted(event.done for event in seen)
    bounds = [float(event.note.removeprefix("bound ")) for event in seen]
    assert bounds == sorted(bounds)
    assert (seen[-1].done, seen[-1].best, bounds[-1]) == (proof.boxes, proof.best_cost, round(proof.lower_bound, 6))


def test_about_how_long_a_proof_takes_is_said_after_its_first_parts() -> None:
    seen: list[Progress] = []
    dataset = synthetic_dataset()
    certified = certify_optimum(
        design_of(dataset, "arc"), dataset, gap=0.01, seconds=1e9, parts=2000, watch=seen.append
    )
    (place,) = [index for index, event in enumerate(seen) if event.task == "duration"]
    assert seen[place - 1].done == 3
    fewest, most = (int(number) for number in re.search(r"(\d+) to (\d+) parts", seen[place].result).groups())
    assert fewest <= certified.proof.boxes <= most


def test_a_proof_without_a_gap_goes_on_to_its_limit_and_foretells_nothing() -> None:
    seen: list[Progress] = []
    dataset = make_dataset("noisy", synthetic_robot(), PERIOD, list(noisy_trajectories()), simulated=True)
    certified = certify_optimum(calibrate(dataset).calibration, dataset, gap=0.0, parts=20, watch=seen.append)
    assert 20 <= certified.proof.boxes <= 21
    assert [event for event in seen if event.task == "duration"] == []


def test_where_nothing_is_left_but_rounding_there_is_nothing_to_gain() -> None:
    runs = synthetic_trajectories(synthetic_robot(), "arc")[:2]
    dataset = make_dataset("exact", synthetic_robot(), 0.2, runs, simulated=True)
    run = calibrate(dataset)
    assert run.result.cost < 1e-9
    certified = certify_optimum(run.calibration, dataset, parts=5)
    assert certified.certificate.gap == 0.0
    console = Console(file=io.StringIO(), width=120)
    print_certificate(console, certified)
    told = console.file.getvalue()
    assert "There is nothing to gain: what is left is rounding" in told
    assert "to gain on this calibration" not in told


def test_a_calibration_outside_the_box_is_said_to_be_outside() -> None:
    dataset = synthetic_dataset()
    outside = design_of(dataset, "arc").model_copy(
        update={"matrix": matrix_rows(1.5 * dataset.robot.inverse_kinematic_matrix)}
    )
    assert not certify_optimum(outside, dataset, parts=1).inside


class Worst(Cost):
    """The largest error."""

    name = "worst"

    def combine(self, errors: Array, trajectory: Array) -> Array:  # noqa: ARG002
        return np.asarray(np.linalg.norm(errors, axis=-1).max(axis=-1))


def test_what_no_bound_is_proven_of_is_refused() -> None:
    problem, dataset = make_problem(), synthetic_dataset()
    problem.objective = Worst(Options())
    with pytest.raises(ConfigError, match="sum of norms"):
        LowerBounds(problem)
    with pytest.raises(ConfigError, match="matrix parameterisation"):
        LowerBounds(make_problem(parameterisation="geometry"))
    with pytest.raises(DataError, match="wheels fl, fr, rl, rr"):
        certify_optimum(design_of(synthetic_dataset(4), "arc"), dataset)
    drift = EffectTerm(name="heading_drift", parameters={"b": 0.001})
    with pytest.raises(DataError, match=r"'design' has effects \(heading_drift\)"):
        certify_optimum(design_of(dataset, "arc").model_copy(update={"effects": (drift,)}), dataset)
    runs = [replace(run, split="validation") for run in noisy_trajectories()]
    with pytest.raises(DataError, match="training split is empty"):
        certify_optimum(design_of(dataset, "arc"), make_dataset("none", synthetic_robot(), PERIOD, runs))


def box_about_the_design(*widths: tuple[int, int, float]) -> Box:
    """The design's elements, but for some (row, column, half-width) that may vary."""
    lower, upper = (synthetic_robot().inverse_kinematic_matrix.copy() for _ in range(2))
    for row, column, width in widths:
        lower[row, column] -= width
        upper[row, column] += width
    return box_between(lower, upper)


@pytest.mark.parametrize("corner", list(product((-1, 1), repeat=3)))
@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_a_box_with_the_truth_has_no_bound_above_zero(corner: tuple[int, int, int], integration: Integration) -> None:
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


def test_the_dual_of_a_sum_of_distances_to_points_is_that_of_their_median_or_points_out_of_the_box() -> None:
    residuals, sides = np.array([-3.0, -1.0, 0.0, 0.5, 4.0])[:, None], (np.array([-9.0]), np.array([9.0]))
    found = least_sum_of_norms(residuals, np.ones((5, 1, 1)), np.full(5, 0.2), *sides, np.array([2.0]))
    assert found.point == pytest.approx([0.0], abs=2e-3)
    assert found.directions[[0, 1, 3, 4], 0] == pytest.approx([-1, -1, 1, 1], abs=1e-3)
    assert found.directions.sum() == pytest.approx(0.0, abs=1e-8)
    narrow = (np.array([-1.0]), np.array([1.0]))
    found = least_sum_of_norms(np.full((4, 1), 2.0), np.ones((4, 1, 1)), np.full(4, 0.25), *narrow, np.zeros(1))
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
def test_poses_after_the_wheels_or_at_the_start_alone_stop_no_proof(cost: str, runs: Sequence[Trajectory]) -> None:
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
