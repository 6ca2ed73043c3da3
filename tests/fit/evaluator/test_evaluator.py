"""The fast evaluator gives what direct integration gives, wherever it answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fit_samples import make_problem, noisy_trajectories
from hypothesis import given, settings
from hypothesis import strategies as st

from omnibench.data.dataset import Trajectory
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
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
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
