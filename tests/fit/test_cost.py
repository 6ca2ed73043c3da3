"""Eq. (6) and the other costs, robust losses, the cone programs of sums of norms, and ends that have jumped."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fit_samples import noisy_trajectories
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.stats import chi

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.loss import CORNERS, DEGREES_OF_FREEDOM, LEAST_SCALE, Huber, Loss, StudentT, with_ends_from_others
from omnibench.fit.sum_of_norms import SolverError, SumOfNormsProgram
from omnibench.registry import costs
from omnibench.robot.kinematics import Array
from omnibench.testing.synthetic import synthetic_robot

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
