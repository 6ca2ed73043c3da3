"""Starts and ends that have jumped are taken from the poses beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fit_samples import noisy_trajectories

from omnibench.data.dataset import Trajectory
from omnibench.fit.loss import Huber, with_ends_from_others
from omnibench.testing.synthetic import synthetic_robot

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


def test_ends_stay_where_the_cost_uses_other_poses_too() -> None:
    _, moved = jumped(-1)
    found, names = with_ends_from_others(moved, ROBOT, "arc", Huber(3), last=False)
    assert names == ()
    assert all(one is other for one, other in zip(found, moved, strict=True))


def test_few_runs_or_poses_stay_as_they_are() -> None:
    _, moved = jumped(0, index=1)
    assert with_ends_from_others(moved[:4], ROBOT, "arc", Huber(3), last=True)[1] == ()
    short = [replace(run, pose_times=run.pose_times[[0, -1]], poses=run.poses[[0, -1]]) for run in moved]
    assert with_ends_from_others(short, ROBOT, "arc", Huber(3), last=True)[1] == ()
