"""The fast evaluator gives what direct integration gives, wherever it answers."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fit_samples import make_problem, noisy_trajectories
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.stats import chi

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.evaluator import (
    Basis,
    ElementBox,
    PoseEvaluator,
    cut,
    degree_for,
    impulses,
    make_evaluator,
    make_path,
    quadrature,
)
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.loss import CORNERS, DEGREES_OF_FREEDOM, LEAST_SCALE, Huber, Loss, StudentT, with_ends_from_others
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.sum_of_norms import SolverError, SumOfNormsProgram
from omnibench.registry import calibrators, costs
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog
from omnibench.testing.synthetic import synthetic_robot

COSTS = ("final_pose", "final_position", "final_heading", "trajectory")
INTEGRATIONS = st.sampled_from(["euler", "arc"])


def random_log(rng: np.random.Generator, wheels: int, samples: int, stamps: int, rate: float = 2.0) -> WheelLog:
    """Samples of uneven length, and stamps wherever they fall, the last past the end."""
    times = np.cumsum(rng.uniform(0.002, 0.03, samples))
    wanted = np.sort(np.append(rng.uniform(1e-4, times[-1], stamps - 1), 1.1 * times[-1]))
    return WheelLog(times, rate * rng.standard_normal((samples, wheels)), rng.standard_normal(3), wanted)


def design_box(wheels: int, width: float) -> ElementBox:
    """All matrices within a share of the design's largest elements."""
    matrix = synthetic_robot(4 if wheels == 4 else 3).inverse_kinematic_matrix
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
        for run in noisy_trajectories(4 if wheels == 4 else 3)
    ]


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    wheels=st.sampled_from([3, 4]),
    integration=INTEGRATIONS,
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


@given(
    angles=st.lists(st.floats(-1.2, 1.2), min_size=3, max_size=3),
    place=st.lists(st.floats(-1, 1), min_size=3, max_size=3),
    tolerance=st.sampled_from([1e-3, 1e-8, 1e-12]),
)
def test_an_expanded_exponential_keeps_to_the_bound(angles: list[float], place: list[float], tolerance: float) -> None:
    z, d = np.array(angles), np.array(place)
    degree, left_out = degree_for(np.abs(z).sum(keepdims=True), np.ones(1), np.array([0]), tolerance, 3)
    basis = Basis.make(degree, np.ones(3, dtype=bool))
    terms = basis.coefficients(z[None])[:, 0] * basis.values(d[None])[:, 0]
    expanded = (terms * 1j**basis.quarter_turns).sum()
    assert abs(expanded - np.exp(1j * z @ d)) <= left_out + 1e-14 <= tolerance + 1e-14


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), tolerance=st.sampled_from([1e-4, 1e-8, 1e-12]))
def test_arcs_by_quadrature_are_right_to_the_bound(seed: int, tolerance: float) -> None:
    rng = np.random.default_rng(seed)
    log = random_log(rng, 3, 50, 2, rate=float(rng.uniform(1, 20)))
    box = design_box(3, 0.1)
    row = np.abs(box.centre[2]) + box.reach[2]
    path = make_path(log, "arc")
    nodes = quadrature([path], row, box.speed, tolerance, "arc")
    (segment,) = cut(path, box.reach[2], np.inf)
    angles, about = impulses(path, segment, "arc", nodes)
    for matrix in drawn(box, rng, 2):
        steps = (angles @ (matrix[0] + 1j * matrix[1])) * np.exp(1j * (about @ matrix[2] + log.start[2]))
        x, y = OdometryBatch([log], "arc").poses(matrix[None])[0, -1, :2] - log.start[:2]
        assert abs(steps.sum() - (x + 1j * y)) <= tolerance + 1e-13


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
@pytest.mark.parametrize("unit", [1e-4, 1e3])
def test_costs_and_scales_have_the_unit_of_the_errors(kind: type[Loss], unit: float) -> None:
    norms, shares = norms_and_shares(0, 0.1)
    np.testing.assert_allclose(kind(3).costs(unit * norms, shares), unit * kind(3).costs(norms, shares), rtol=1e-12)


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


TRIANGLE = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # isosceles, with an angle of 90 degrees


def step_to(corners: Array, shares: Sequence[float], low: float | Array = -2.0, high: float | Array = 2.0) -> Array:
    """The step (2,) of the least sum of distances to points, in a box."""
    jacobian = np.tile(np.eye(2), (len(corners), 1, 1))
    return SumOfNormsProgram(-corners, jacobian, low + np.zeros(2), high + np.zeros(2)).step(np.array(shares))


@pytest.mark.parametrize(
    ("corners", "shares", "expected"),
    [
        (TRIANGLE, [1.0, 1.0, 1.0], [0.0, 1 / np.sqrt(3)]),  # the point that sees every side under 120 degrees
        (TRIANGLE, [5.0, 1.0, 1.0], TRIANGLE[0]),  # a share above the others
        (np.array([[-1.0, 0.0], [1.0, 0.5], [0.3, 1.0]]), [0.0, 2.0, 1.0], [1.0, 0.5]),  # a point without a share
    ],
)
def test_a_geometric_median_minimises_sums_of_distances(corners: Array, shares: list[float], expected: Array) -> None:
    np.testing.assert_allclose(step_to(corners, shares), expected, atol=1e-9)


def test_steps_stay_in_the_box() -> None:
    step = step_to(np.array([[3.0, 4.0], [3.0, 4.0]]), [1.0, 1.0], np.array([-1.0, 0.0]), np.array([1.0, 0.0]))
    np.testing.assert_allclose(step, [1.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1.0, 1e3])
def test_the_step_does_not_depend_on_the_unit_of_the_residuals(scale: float) -> None:
    jacobian = scale * np.tile(np.eye(2), (3, 1, 1))
    program = SumOfNormsProgram(-scale * TRIANGLE, jacobian, np.full(2, -2.0), np.full(2, 2.0))
    np.testing.assert_allclose(program.step(np.ones(3)), [0.0, 1 / np.sqrt(3)], atol=1e-8)


def test_a_program_that_cannot_be_solved_says_so() -> None:
    empty = SumOfNormsProgram(np.ones((2, 2)), np.ones((2, 2, 2)), np.full(2, 1.0), np.full(2, -1.0))
    with pytest.raises(SolverError, match="infeasible"):
        empty.step(np.ones(2))


def test_a_long_recording_needs_no_memory_that_grows_with_its_square() -> None:
    stamps = 12_000
    rng = np.random.default_rng(1)
    jacobian = rng.normal(size=(stamps, 3, 3))
    residuals = -jacobian @ [0.3, -0.2, 0.1] + 0.01 * rng.normal(size=(stamps, 3))
    tracemalloc.start()
    step = SumOfNormsProgram(residuals, jacobian, np.full(3, -1.0), np.full(3, 1.0)).step(np.ones(stamps))
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
