"""The fast evaluator, costs and robust losses, and lower bounds that are proven."""

import math
import re
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from commands import CONFIGS
from fit_samples import Worst, box_between, design_of, make_problem, noisy_trajectories
from hypothesis import given, settings
from hypothesis import strategies as st
from report_page import on_terminal
from scipy.integrate import quad
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import chi

from omnibench.compare.config import read_compare_config
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.certify import LowerBounds, certify_optimum, into_unit_ball, prove
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.evaluator import ElementBox, PoseEvaluator, make_evaluator
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.loss import CORNERS, DEGREES_OF_FREEDOM, LEAST_SCALE, Huber, Loss, StudentT, with_ends_from_others
from omnibench.fit.parameterisation import Box
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.sum_of_norms import SolverError, least_step
from omnibench.progress import Progress
from omnibench.registry import Options, calibrators, costs
from omnibench.report.certificate import CertificateResult
from omnibench.report.terminal import print_result
from omnibench.robot.calibration import matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog
from omnibench.testing.synthetic import PERIOD, synthetic_dataset, synthetic_robot, synthetic_trajectories, true_robot

COSTS = ("final_pose", "final_position", "final_heading", "trajectory")


def random_log(rng: np.random.Generator, wheels: int, samples: int, stamps: int, rate: float = 2.0) -> WheelLog:
    """Samples of uneven length, and stamps wherever they fall, the last past the end."""
    times = np.cumsum(rng.uniform(0.002, 0.03, samples))
    wanted = np.sort(np.append(rng.uniform(1e-4, times[-1], stamps - 1), 1.1 * times[-1]))
    return WheelLog(times, rate * rng.standard_normal((samples, wheels)), rng.standard_normal(3), wanted)


def design_box(wheels: int, width: float) -> ElementBox:
    """All matrices within a share of the design's largest elements."""
    matrix = synthetic_robot(wheels).inverse_kinematic_matrix
    reach = width * np.abs(matrix).max(axis=1, keepdims=True)
    return ElementBox(matrix - reach, matrix + reach)


def drawn(box: ElementBox, rng: np.random.Generator, count: int) -> Array:
    """Matrices of a box, its two extreme corners among them."""
    inside = rng.uniform(box.lower, box.upper, size=(count, *box.lower.shape))
    return np.concatenate([inside, box.lower[None], box.upper[None]])


def long_runs(wheels: int = 3) -> list[Trajectory]:
    """The noisy runs, sampled as densely as recordings are."""
    finer = 40
    return [
        replace(
            run,
            times=run.times[0] / finer * np.arange(1, finer * len(run.times) + 1),
            rates=np.repeat(run.rates, finer, axis=0),
        )
        for run in noisy_trajectories(wheels)
    ]


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    wheels=st.sampled_from([3, 4]),
    integration=st.sampled_from(["euler", "arc"]),
    width=st.sampled_from([0.02, 0.1, 0.3]),
    stamps=st.integers(1, 4),
)
def test_poses_are_those_of_direct_integration_within_the_stated_bound(
    seed: int, wheels: int, integration: Integration, width: float, stamps: int
) -> None:
    rng = np.random.default_rng(seed)
    logs = [random_log(rng, wheels, int(rng.integers(300, 600)), stamps) for _ in range(3)]
    box = design_box(wheels, width)
    evaluator = make_evaluator(OdometryBatch(logs, integration), logs, integration, box)
    matrices = drawn(box, rng, 5)
    difference = np.abs(evaluator.poses(matrices) - OdometryBatch(logs, integration).poses(matrices)).max()
    assert evaluator.error_bound < 1e-10
    assert difference <= evaluator.error_bound + 1e-12


@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_a_long_recording_is_cut_into_segments_and_agrees(integration: Integration) -> None:
    rng = np.random.default_rng(3)
    times = 0.01 * np.arange(1, 30_001)
    turning = WheelLog(times, 1.5 + 0.3 * rng.standard_normal((30_000, 3)), np.zeros(3), np.array([170.0, 300.0]))
    box = design_box(3, 0.25)
    evaluator = make_evaluator(OdometryBatch([turning], integration), [turning], integration, box)
    matrices = drawn(box, rng, 3)
    assert evaluator.segments > 10
    direct = OdometryBatch([turning], integration).poses(matrices)
    assert np.abs(evaluator.poses(matrices) - direct).max() <= evaluator.error_bound + 1e-10


@pytest.mark.parametrize("integration", ["euler", "arc"])
@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("wheels", [3, 4])
def test_costs_are_the_same_either_way(cost: str, integration: Integration, wheels: int) -> None:
    problem = make_problem(long_runs(wheels), wheels=wheels, cost=cost, integration=integration)
    assert problem.build_evaluator() is not None
    candidates = problem.from_unit(np.random.default_rng(1).uniform(size=(20, int(problem.free.sum()))))
    assert np.abs(problem.cost(candidates) - problem.values(candidates)).max() <= 1e-11


def test_costs_are_the_same_either_way_for_wheel_geometries_and_outside_the_box() -> None:
    geometry = make_problem(long_runs(), parameterisation="geometry", limits=GeometryLimits())
    candidates = geometry.from_unit(np.random.default_rng(1).uniform(size=(50, int(geometry.free.sum()))))
    assert geometry.build_evaluator().covers(geometry.parameterisation.matrices(candidates)).mean() > 0.9
    assert np.abs(geometry.cost(candidates) - geometry.values(candidates)).max() <= 1e-11
    problem = make_problem(long_runs())
    candidates = np.stack([problem.start, problem.start * 3, problem.upper * 1.5])
    covered = problem.build_evaluator().covers(problem.parameterisation.matrices(candidates))
    assert covered.tolist() == [True, False, False]
    assert np.abs(problem.cost(candidates) - problem.values(candidates)).max() <= 1e-11


def test_a_search_builds_the_evaluator_and_few_evaluations_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    build, built_for = CalibrationProblem.build_evaluator, []

    def noted(problem: CalibrationProblem) -> PoseEvaluator | None:
        built_for.append(problem)
        return build(problem)

    monkeypatch.setattr(CalibrationProblem, "build_evaluator", noted)
    few, many = make_problem(long_runs()), make_problem(long_runs())
    calibrators.create("closed_form").calibrate(few)
    calibrators.create("random_search", {"candidates": 300}).calibrate(many)
    assert built_for == [many]


def test_recordings_that_moments_would_slow_down_or_do_not_express_are_integrated_directly() -> None:
    sparse = [replace(run, times=run.times[::5], rates=run.rates[::5]) for run in noisy_trajectories()]
    assert make_problem(sparse, cost="trajectory").build_evaluator() is None
    problem = make_problem(long_runs(), integration="arc")
    logs = problem.objective.logs(problem.trajectories)
    box = ElementBox.of(problem.parameterisation, problem.lower, problem.upper)
    assert make_evaluator(problem.odometry, logs, "arc", box) is not None
    assert make_evaluator(problem.odometry, logs, "euler", box) is None


def test_nothing_that_is_kept_grows_with_the_sampling_rate() -> None:
    box = design_box(3, 0.1)
    sizes = []
    for samples in (400, 4000):
        times = np.arange(1, samples + 1) * 4 / samples
        rates = np.array([1.0, -0.5, 0.2]) + np.sin(np.outer(times, [1.0, 2.0, 3.0]))
        logs = [WheelLog(times, rates * scale, np.zeros(3), times[-1:]) for scale in np.linspace(-1, 1, 20)]
        sizes.append(make_evaluator(OdometryBatch(logs, "euler"), logs, "euler", box).size)
    assert sizes[1] < 1.2 * sizes[0]


# Eq. (6) and the other costs, robust losses, the cone programs of sums of norms, and ends that have jumped.

MATRIX = synthetic_robot().inverse_kinematic_matrix
NAMES = ["final_pose", "final_position", "final_heading", "trajectory"]


def cost_of(name: str, runs: tuple[Trajectory, ...]) -> float:
    """The cost of the design matrix through the code under test."""
    cost: Cost = costs.create(name)
    batch = cost.batch(runs, "euler")
    errors = batch.poses(MATRIX[None]) - cost.reference(runs)
    return float(cost.combine(errors, batch.trajectory)[0])


def pose_at(run: Trajectory, stamp: float) -> Array:
    """Eq. (1) and (2) up to ``stamp``, at constant twist within the sample that contains it."""
    x, y, theta = run.start
    before = 0.0
    for time, rates in zip(run.times, run.rates, strict=True):
        dt = min(time, stamp) - before
        vx, vy, w = MATRIX @ rates
        x, y = (
            x + dt * (math.cos(theta) * vx - math.sin(theta) * vy),
            y + dt * (math.sin(theta) * vx + math.cos(theta) * vy),
        )
        theta += dt * w
        if time >= stamp:
            break
        before = time
    return np.array([x, y, theta])


@pytest.mark.parametrize("scale", [1.0, 0.93])  # stamps at the ends of samples and within them
@pytest.mark.parametrize(
    ("name", "counted"),
    [
        ("final_pose", slice(0, 3)),
        ("final_position", slice(0, 2)),
        ("final_heading", slice(2, 3)),
        ("trajectory", slice(0, 3)),
    ],
)
def test_costs_are_eq_6_as_written_each_run_counting_the_same(name: str, counted: slice, scale: float) -> None:
    first, *others = (replace(run, pose_times=scale * run.pose_times) for run in noisy_trajectories())
    runs = (replace(first, pose_times=first.pose_times[:3], poses=first.poses[:3]), *others)
    used = slice(1, None) if name == "trajectory" else slice(-1, None)
    by_run = [
        np.mean(
            [
                math.dist(pose_at(run, stamp)[counted], pose[counted])
                for stamp, pose in zip(run.pose_times[used], run.poses[used], strict=True)
            ]
        )
        for run in runs
    ]
    assert cost_of(name, runs) == pytest.approx(np.mean(by_run), abs=1e-13)


def test_metres_and_radians_count_alike_and_headings_are_never_wrapped() -> None:
    errors = [[0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.3], [0.0, 0.3, 0.4], [0.0, 0.0, 2 * math.pi]]
    costs_of_errors = costs.create("final_pose").combine(np.array(errors)[:, None], np.array([0]))
    np.testing.assert_allclose(costs_of_errors, [0.3, 0.3, 0.3, 0.5, 2 * math.pi])


@pytest.mark.parametrize("name", NAMES)
def test_the_costs_of_the_trajectories_have_the_cost_as_their_mean(name: str) -> None:
    runs = noisy_trajectories()
    cost: Cost = costs.create(name)
    batch = cost.batch(runs, "arc")
    errors = batch.poses(MATRIX[None])[0] - cost.reference(runs)
    of_each = cost.of_each(errors, batch.trajectory)
    assert of_each.shape == (len(runs),)
    assert of_each.mean() == pytest.approx(cost.combine(errors[None], batch.trajectory)[0], rel=1e-13)


def test_a_run_without_a_pose_after_its_start_is_refused_by_name_where_the_cost_needs_one() -> None:
    run = noisy_trajectories()[0]
    short = replace(run, id="short", pose_times=run.pose_times[:1], poses=run.poses[:1])
    with pytest.raises(DataError, match="trajectory short"):
        costs.create("trajectory").batch([run, short], "arc")


def test_weights_multiply_the_errors_before_the_norm_is_taken() -> None:
    class Weighted(SumOfNorms):
        weights = (3.0, 0.0, 0.5)

    cost = Weighted(costs.entry("final_pose").cls.Options())
    errors = np.array([[[2.0, 7.0, 16.0], [-1.0, 9.0, 0.0]]])  # norms (6, 8) -> 10 and (3, 0) -> 3
    assert cost.combine(errors, np.array([0, 1])) == pytest.approx([6.5])


KINDS = [Huber, StudentT]


def norms_and_shares(seed: int, jumps: float, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    norms = np.linalg.norm(rng.standard_normal((2, count, 3)), axis=2)
    norms[:, rng.random(count) < jumps] += 100.0
    shares = rng.uniform(0.5, 1.5, count)
    return norms, shares / shares.sum()


@cache
def mean_square(size: int) -> float:
    """E min(R, c)^2 of Eq. (1)."""
    corner = CORNERS[size]
    inside = quad(lambda r: r**2 * chi(size).pdf(r), 0, corner)[0]
    return float(inside + corner**2 * chi(size).sf(corner))


def cost_at(loss: Loss, scale: float, norms: np.ndarray, shares: np.ndarray) -> float:
    """Eq. (1), or the exponential of Eq. (3), written out."""
    ratios, size = norms / scale, loss.coordinates
    if isinstance(loss, Huber):
        corner = CORNERS[size]
        mean = mean_square(size)
        rho = np.where(ratios <= corner, ratios**2 / 2, corner * ratios - corner**2 / 2)
        return float(scale * (shares @ rho + mean / 2))
    power = (DEGREES_OF_FREEDOM + size) / (2 * size)
    return float(np.exp(np.log(scale) + power * shares @ np.log1p(ratios**2 / DEGREES_OF_FREEDOM)))


@pytest.mark.parametrize("size", [1, 2, 3])
def test_hubers_corner_leaves_95_percent_of_the_efficiency_and_its_scale_is_sigma_for_normal_errors(size: int) -> None:
    corner, pdf = CORNERS[size], chi(size).pdf
    slope = size * quad(pdf, 0, corner)[0] + (size - 1) * quad(lambda r: corner / r * pdf(r), corner, 50)[0]
    square = quad(lambda r: r * r * pdf(r), 0, corner)[0] + corner**2 * chi(size).sf(corner)
    assert (slope / size) ** 2 / (square / size) == pytest.approx(0.95, abs=1e-4)
    errors = 0.02 * np.random.default_rng(0).standard_normal((1, 200_000, size))
    norms = np.linalg.norm(errors, axis=2)
    assert Huber(size).scales(norms, np.full(200_000, 5e-6))[0] == pytest.approx(0.02, rel=0.01)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10**6), jumps=st.sampled_from([0.0, 0.05, 0.2]))
def test_the_cost_is_the_minimum_over_all_scales(kind: type[Loss], seed: int, jumps: float) -> None:
    norms, shares = norms_and_shares(seed, jumps)
    loss = kind(3)
    scales, costs = loss.scales(norms, shares), loss.costs(norms, shares)
    for of_one, scale, cost in zip(norms, scales, costs, strict=True):
        best = minimize_scalar(
            lambda logarithm, of_one=of_one: cost_at(loss, np.exp(logarithm), of_one, shares),
            bounds=np.log([1e-2, 1e2]), method="bounded", options={"xatol": 1e-9},
        )  # fmt: skip
        assert cost == pytest.approx(float(best.fun), rel=1e-7)
        assert scale == pytest.approx(float(np.exp(best.x)), rel=1e-3)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10**6))
def test_derivatives_by_the_errors_are_those_of_weighted_squares(kind: type[Loss], seed: int) -> None:
    norms, shares = norms_and_shares(seed, 0.1, count=12)
    loss, step = kind(3), 1e-5
    moved = norms[0] + step * np.vstack([np.eye(12), -np.eye(12)])
    values = loss.costs(moved, shares)
    slopes = (values[:12] - values[12:]) / (2 * step)
    scale = loss.scales(norms[:1], shares)[0]
    expected = shares * loss.weights(norms[0] / scale) * norms[0]
    np.testing.assert_allclose(slopes / slopes.sum(), expected / expected.sum(), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_a_scale_found_from_a_sample_first_is_that_of_all(kind: type[Loss]) -> None:
    rng = np.random.default_rng(0)
    norms = np.abs(rng.standard_cauchy((3, 9000)))
    norms[:, ::4] = 0.0  # the sample takes every fourth: it sees no error at all
    shares = np.full(9000, 1 / 9000)
    pieces = np.concatenate([norms[:, 1:2000], norms[:, 2000:], norms[:, :1]], axis=1)  # the sample is another one
    np.testing.assert_allclose(kind(3).scales(norms, shares), kind(3).scales(pieces, shares), rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_the_derivative_of_the_weights_is_right(kind: type[Loss]) -> None:
    ratios = np.array([0.3, 1.0, 2.0, 7.0])
    step = 1e-6
    slopes = (kind(3).weights(ratios * (1 + step)) - kind(3).weights(ratios * (1 - step))) / (2 * step)
    np.testing.assert_allclose(kind(3).slopes(ratios), slopes, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_no_error_has_the_least_scale_and_what_cannot_be_evaluated_costs_nan(kind: type[Loss]) -> None:
    norms = np.array([[0.0, 0.0], [np.nan, 1.0], [1.0, 1.0]])
    shares = np.full(2, 0.5)
    assert kind(3).scales(norms[:1], shares)[0] == LEAST_SCALE
    with np.errstate(all="ignore"):
        costs = kind(3).costs(norms, shares)
    assert costs[0] < 1e-9
    assert np.isnan(costs).tolist() == [False, True, False]


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1.0, 1e3])
def test_the_step_does_not_depend_on_the_unit_of_the_residuals(scale: float) -> None:
    jacobian = scale * np.tile(np.eye(2), (3, 1, 1))
    triangle = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # isosceles, with an angle of 90 degrees
    step, *_ = least_step(-scale * triangle, jacobian, np.ones(3), np.full(2, -2.0), np.full(2, 2.0))
    np.testing.assert_allclose(step, [0.0, 1 / np.sqrt(3)], atol=1e-8)


def test_a_program_that_cannot_be_solved_says_so() -> None:
    with pytest.raises(SolverError, match="infeasible"):
        least_step(np.ones((2, 2)), np.ones((2, 2, 2)), np.ones(2), np.full(2, 1.0), np.full(2, -1.0))


def test_a_step_of_many_errors_stays_in_the_box() -> None:
    rng = np.random.default_rng(1)
    jacobian = rng.normal(size=(1200, 3, 3))
    residuals = -jacobian @ [0.3, -0.2, 0.1] + 0.01 * rng.normal(size=(1200, 3))
    step, *_ = least_step(residuals, jacobian, np.ones(1200), np.full(3, -0.25), np.full(3, 0.25))
    assert step[0] == pytest.approx(0.25, abs=1e-6)
    assert np.abs(step).max() <= 0.25


def test_a_long_recording_needs_no_memory_that_grows_with_its_square() -> None:
    stamps = 12_000
    rng = np.random.default_rng(1)
    jacobian = rng.normal(size=(stamps, 3, 3))
    residuals = -jacobian @ [0.3, -0.2, 0.1] + 0.01 * rng.normal(size=(stamps, 3))
    tracemalloc.start()
    step, *_ = least_step(residuals, jacobian, np.ones(stamps), np.full(3, -1.0), np.full(3, 1.0))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(step, [0.3, -0.2, 0.1], atol=1e-3)
    assert peak < 200e6


ROBOT = synthetic_robot(3)


def jumped(end: int, index: int = 3) -> tuple[list[Trajectory], list[Trajectory]]:
    """Runs, and the same of which the pose at one end of one run has jumped by 1 m."""
    runs = list(noisy_trajectories(noise=0.002))
    poses = runs[index].poses.copy()
    poses[end, 1] += 1.0
    return runs, [replace(run, poses=poses) if run is runs[index] else run for run in runs]


@pytest.mark.parametrize("end", [0, -1])
def test_an_end_that_has_jumped_comes_back_and_all_other_runs_stay(end: int) -> None:
    runs, moved = jumped(end)
    found, names = with_ends_from_others(moved, ROBOT, "arc", Huber(3), last=True)
    assert names == (runs[3].id,)
    assert np.linalg.norm(found[3].poses[end] - runs[3].poses[end]) < 0.1
    assert [one is other for one, other in zip(found, moved, strict=True)] == [run is not runs[3] for run in runs]


def test_a_pose_beside_an_end_that_has_jumped_too_moves_it_no_farther_the_farther_it_jumped() -> None:
    _, moved = jumped(0)
    ends = []
    for size in (5.0, 500.0):
        poses = moved[3].poses.copy()
        poses[2, :2] += [size, -size]
        runs = [*moved[:3], replace(moved[3], poses=poses), *moved[4:]]
        ends.append(with_ends_from_others(runs, ROBOT, "arc", Huber(3), last=True)[0][3].poses[0])
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-12)


def test_ends_stay_where_the_cost_uses_other_poses_too_or_runs_or_poses_are_few() -> None:
    _, moved = jumped(-1)
    found, names = with_ends_from_others(moved, ROBOT, "arc", Huber(3), last=False)
    assert names == ()
    assert all(one is other for one, other in zip(found, moved, strict=True))
    _, started = jumped(0, index=1)
    short = [replace(run, pose_times=run.pose_times[[0, -1]], poses=run.poses[[0, -1]]) for run in started]
    for few in (started[:4], short):
        assert with_ends_from_others(few, ROBOT, "arc", Huber(3), last=True)[1] == ()


# What is certified holds for every matrix of the box, and so does every step of a lower bound by itself.


def random_problem(seed: int, cost: str, integration: Integration, wheels: int) -> CalibrationProblem:
    """Few noisy runs, some of them alone, in a box about the design of random widths, some of them none."""
    rng = np.random.default_rng(seed)
    runs = noisy_trajectories(wheels, noise=float(10 ** rng.uniform(-4, -1)), seed=seed, integration=integration)
    chosen = [runs[index] for index in rng.permutation(len(runs))[: rng.integers(1, 8)]]
    matrix = synthetic_robot(wheels).inverse_kinematic_matrix
    size = np.abs(matrix).max(axis=1, keepdims=True)
    below, above = (rng.uniform(0, 0.3, matrix.shape) * size * (rng.random(matrix.shape) > 0.15) for _ in range(2))
    box = box_between(matrix - below, matrix + above)
    return make_problem(chosen, wheels=wheels, cost=cost, integration=integration, box=box, evaluations=10**6)


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


@pytest.mark.parametrize("box", ["paper", pytest.param("row", marks=pytest.mark.slow)])
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
    run = calibrate(dataset, "closed_form")
    assert run.result.cost < 1e-9
    certified = certify_optimum(run.calibration, dataset, parts=5)
    assert certified.certificate.gap == 0.0
    told = on_terminal(print_result, CertificateResult(certified, Path("c.yaml")), width=120)
    assert "There is nothing to gain: what is left is rounding" in told
    assert "to gain on this calibration" not in told


def test_of_a_calibration_with_effects_the_optimum_of_the_matrix_alone_is_certified() -> None:
    dataset = make_dataset("noisy", synthetic_robot(), PERIOD, list(noisy_trajectories()), simulated=True)
    of_map, optimum = (calibrate(dataset, name).calibration for name in ("map", "closed_form"))
    assert of_map.effects
    certified, alone = (certify_optimum(each, dataset, parts=20).certificate for each in (of_map, optimum))
    assert certified.cost == pytest.approx(alone.cost, rel=1e-6)
    assert certified.lower_bound <= certified.cost
    assert certified.shrinking is not None
    assert alone.shrinking is None


def test_a_calibration_outside_the_box_is_said_to_be_outside() -> None:
    dataset = synthetic_dataset()
    outside = design_of(dataset, "arc").model_copy(
        update={"matrix": matrix_rows(1.5 * dataset.robot.inverse_kinematic_matrix)}
    )
    assert not certify_optimum(outside, dataset, parts=1).inside


def test_what_no_bound_is_proven_of_is_refused() -> None:
    problem, dataset = make_problem(), synthetic_dataset()
    problem.objective = Worst(Options())
    with pytest.raises(ConfigError, match="sum of norms"):
        LowerBounds(problem)
    with pytest.raises(ConfigError, match="matrix parameterisation"):
        LowerBounds(make_problem(parameterisation="geometry"))
    with pytest.raises(DataError, match="wheels fl, fr, rl, rr"):
        certify_optimum(design_of(synthetic_dataset(4), "arc"), dataset)
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


def test_scaled_directions_lie_in_the_unit_ball_to_the_last_digit() -> None:
    directions = np.random.default_rng(1).standard_normal((10_000, 3))
    for scaled in into_unit_ball(directions):
        assert np.linalg.norm(scaled.astype(np.longdouble), axis=1).max() <= 1


def test_the_error_of_arcs_counts_with_the_weight_of_positions() -> None:
    problem = make_problem(box=box_about_the_design())
    problem.objective = type("Decimetres", (SumOfNorms,), {"weights": (10.0, 10.0, 1.0)})(Options())
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
