"""Runs made ready: stamps, poses that jump, nuisances of each run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import simulated

from omnibench.discover.fitting import fit_matrix
from omnibench.errors import DataError
from omnibench.fit.trajectory_fit import log_of, usable_runs


def fit_of(runs, dataset):
    return fit_matrix(usable_runs(runs), dataset.robot, dataset.sample_period, dataset.robot.inverse_kinematic_matrix)


def test_poses_that_contradict_their_neighbours_are_left_out_and_no_others() -> None:
    dataset = simulated((), repetitions=4)
    rng = np.random.default_rng(4)
    runs, moved = [], set()
    for run in dataset.split("train"):
        poses = run.poses.copy()
        if rng.random() < 0.3:
            at = int(rng.integers(1, len(poses)))
            poses[at, :2] += rng.choice([-0.08, 0.08], 2)
            moved.add((run.id, float(run.pose_times[at])))
        runs.append(replace(run, poses=poses))
    fit = fit_of(runs, dataset)
    kept = {(run.id, float(stamp)) for run in fit.at_inliers.runs for stamp in run.pose_times}
    gone = {(run.id, float(stamp)) for run in runs for stamp in run.pose_times} - kept
    assert gone >= moved
    assert len(gone - moved) <= 1
    assert fit.jumps == len(gone)


def test_dense_references_are_thinned_and_keep_their_ends() -> None:
    run = simulated(()).trajectories[0]
    times = np.linspace(0, run.times[-1], 2000)
    poses = np.column_stack([np.interp(times, run.pose_times, each) for each in run.poses.T])
    dense = replace(run, pose_times=times, poses=poses)
    (thinned,) = usable_runs([dense])
    assert len(thinned.pose_times) <= 151
    assert (thinned.pose_times[0], thinned.pose_times[-1]) == (0.0, times[-1])


def test_runs_without_poses_after_their_start_cannot_be_used() -> None:
    run = simulated(()).trajectories[0]
    with pytest.raises(DataError, match="no trajectory"):
        usable_runs([replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1])])


def test_clocks_that_are_off_run_by_run_are_found_out_and_do_not_move_the_matrix() -> None:
    dataset = simulated((), repetitions=4)
    rng = np.random.default_rng(5)
    exact = fit_of(dataset.split("train"), dataset)
    late = []
    for run in dataset.split("train"):
        offset = 0.15 * rng.standard_normal()
        poses = np.column_stack([np.interp(run.pose_times - offset, run.pose_times, each) for each in run.poses.T])
        poses[0] = run.poses[0]
        late.append(replace(run, poses=poses))
    fit = fit_of(late, dataset)
    assert 0.08 < fit.nuisances.deviations[1] < 0.25
    assert np.abs(fit.model.matrix - exact.model.matrix).max() < 0.01 * np.abs(exact.model.matrix).max()


def test_a_pose_after_the_last_sample_is_reached_by_going_on() -> None:
    run = simulated(()).trajectories[0]
    log = log_of(run, np.array([0.0, -0.5, 0.0]))
    assert log.times[-1] == pytest.approx(run.pose_times[-1] + 0.5)
    assert log.wheel_angles is not None
    assert len(log.wheel_angles) == len(log.times) == len(log.rates)
