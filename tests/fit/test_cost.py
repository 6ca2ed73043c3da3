"""Eq. (6) and the other costs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from fit_samples import noisy_trajectories

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError, UnknownNameError
from omnibench.fit.cost import Cost, SumOfNorms
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


def test_final_pose_is_eq_6_as_written() -> None:
    runs = noisy_trajectories()
    total = 0.0
    for run in runs:
        x, y, theta = pose_at(run, run.pose_times[-1])
        x_lidar, y_lidar, theta_lidar = run.poses[-1]
        total += math.sqrt((x_lidar - x) ** 2 + (y_lidar - y) ** 2 + (theta_lidar - theta) ** 2)
    assert cost_of("final_pose", runs) == pytest.approx(total / len(runs), abs=1e-13)


def test_final_position_is_the_mean_distance_of_the_ends() -> None:
    runs = noisy_trajectories()
    distances = [math.dist(pose_at(run, run.pose_times[-1])[:2], run.poses[-1, :2]) for run in runs]
    assert cost_of("final_position", runs) == pytest.approx(np.mean(distances), abs=1e-13)


def test_final_heading_is_the_mean_absolute_error_of_the_last_heading() -> None:
    runs = noisy_trajectories()
    errors = [abs(pose_at(run, run.pose_times[-1])[2] - run.poses[-1, 2]) for run in runs]
    assert cost_of("final_heading", runs) == pytest.approx(np.mean(errors), abs=1e-13)


def test_trajectory_is_the_mean_pose_error_along_the_reference_each_run_counting_the_same() -> None:
    first, second, *_ = noisy_trajectories()
    short = replace(second, pose_times=second.pose_times[:3], poses=second.poses[:3])
    by_run = [
        np.mean([math.dist(pose_at(run, t), pose) for t, pose in zip(run.pose_times[1:], run.poses[1:], strict=True)])
        for run in (first, short)
    ]
    assert cost_of("trajectory", (first, short)) == pytest.approx(np.mean(by_run), abs=1e-13)


@pytest.mark.parametrize("name", NAMES)
def test_odometry_is_evaluated_at_the_references_stamps_within_a_sample(name: str) -> None:
    runs = tuple(replace(run, pose_times=run.pose_times * 0.93, poses=run.poses) for run in noisy_trajectories())
    stamps = [run.pose_times[1:] if name == "trajectory" else run.pose_times[-1:] for run in runs]
    poses = [run.poses[1:] if name == "trajectory" else run.poses[-1:] for run in runs]
    weights = {"final_position": [1, 1, 0], "final_heading": [0, 0, 1]}.get(name, [1, 1, 1])
    expected = np.mean(
        [
            np.mean([np.linalg.norm((pose_at(run, t) - pose) * weights) for t, pose in zip(ts, ps, strict=True)])
            for run, ts, ps in zip(runs, stamps, poses, strict=True)
        ]
    )
    assert cost_of(name, runs) == pytest.approx(expected, abs=1e-13)


def test_headings_are_never_wrapped() -> None:
    errors = np.array([[[0.0, 0.0, 2 * math.pi]]])
    assert costs.create("final_pose").combine(errors, np.array([0]))[0] == pytest.approx(2 * math.pi)


def test_metres_and_radians_count_alike() -> None:
    errors = np.array([[[0.3, 0.0, 0.0]], [[0.0, 0.3, 0.0]], [[0.0, 0.0, 0.3]], [[0.0, 0.3, 0.4]]])
    np.testing.assert_allclose(costs.create("final_pose").combine(errors, np.array([0])), [0.3, 0.3, 0.3, 0.5])


@pytest.mark.parametrize("name", NAMES)
def test_the_costs_of_the_trajectories_have_the_cost_as_their_mean(name: str) -> None:
    runs = noisy_trajectories()
    cost: Cost = costs.create(name)
    batch = cost.batch(runs, "arc")
    errors = batch.poses(MATRIX[None])[0] - cost.reference(runs)
    of_each = cost.of_each(errors, batch.trajectory)
    assert of_each.shape == (len(runs),)
    assert of_each.mean() == pytest.approx(cost.combine(errors[None], batch.trajectory)[0], rel=1e-13)


@pytest.mark.parametrize("name", NAMES)
def test_the_shares_of_the_stamps_sum_to_one(name: str) -> None:
    cost = costs.create(name)
    assert isinstance(cost, SumOfNorms)
    trajectory = np.array([0, 0, 0, 1, 2, 2])
    assert cost.shares(trajectory).sum() == pytest.approx(1.0)
    np.testing.assert_allclose(np.bincount(trajectory, cost.shares(trajectory)), [1 / 3] * 3)


def test_a_run_without_a_pose_after_its_start_is_refused_by_name_where_the_cost_needs_one() -> None:
    run = noisy_trajectories()[0]
    short = replace(run, id="short", pose_times=run.pose_times[:1], poses=run.poses[:1])
    with pytest.raises(DataError, match="trajectory short has no reference pose after its start, which trajectory"):
        costs.create("trajectory").batch([run, short], "arc")


def test_an_unknown_cost_is_answered_with_the_nearest_and_all() -> None:
    known = "did you mean 'final_pose'\\? known: final_heading, final_pose, final_position, trajectory"
    with pytest.raises(UnknownNameError, match=known):
        costs.create("final_poses")


def test_weights_multiply_the_errors_before_the_norm_is_taken() -> None:
    class Weighted(SumOfNorms):
        weights = (3.0, 0.0, 0.5)

    cost = Weighted(costs.entry("final_pose").cls.Options())
    errors = np.array([[[2.0, 7.0, 16.0], [-1.0, 9.0, 0.0]]])  # norms (6, 8) -> 10 and (3, 0) -> 3
    assert cost.combine(errors, np.array([0, 1])) == pytest.approx([6.5])
