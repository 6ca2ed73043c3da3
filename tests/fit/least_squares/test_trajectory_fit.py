"""Runs made ready, and the steps of a fit: derivatives, nuisances, the box, weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import simulated
from fit_samples import make_problem
from hypothesis import given
from hypothesis import strategies as st

from omnibench.discover.fitting import fit_matrix
from omnibench.fit.gauss_newton import BoxedFit, bounded_step, first_fit
from omnibench.fit.loss import cost_weightings
from omnibench.fit.noise import whiteners
from omnibench.fit.trajectory_fit import OFFSET, SLOPE, TURN, Nuisances, log_of, usable_runs
from omnibench.registry import costs
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

NOISE = Noise(pose_position=0.01, pose_heading=0.01, walk_position=0.005, walk_heading=0.005, bias_position=0.01)
PROBLEM = make_problem()
START = first_fit(PROBLEM)
WEIGHTINGS = whiteners(NOISE, START.trajectories.stamps)
RUNS = len(START.trajectories.runs)


def with_deviations(deviations: Array, values: Array | None = None) -> BoxedFit:
    """The start with nuisances that have these standard deviations."""
    return START.with_nuisances(Nuisances(np.zeros((RUNS, 3)) if values is None else values, deviations))


def chi2(fit: BoxedFit) -> Array:
    return fit.trajectories.chi_square(WEIGHTINGS)


def test_the_scores_are_the_slopes_of_the_objective() -> None:
    data = START.linearised(WEIGHTINGS)
    assert np.square(data.residuals).sum() == pytest.approx(chi2(START).sum())
    for index, step in enumerate(1e-6 * np.eye(PROBLEM.size)):
        after, before = (chi2(START.moved(PROBLEM.start + sign * step, np.zeros((RUNS, 3)))).sum() for sign in (1, -1))
        assert data.scores.sum(axis=0)[index] == pytest.approx(-(after - before) / 4e-6, rel=1e-4)


@pytest.mark.parametrize(
    ("nuisance", "deviation", "kinks"),
    # The recorded path has a kink at every sample, and so has the objective as a function of a clock.
    [(TURN, 0.05, 0.0), (OFFSET, 0.2, 1e-3), (SLOPE, 0.01, 1e-3)],
    ids=["turn", "offset", "slope"],
)
def test_steps_of_a_nuisance_lead_to_where_no_run_can_do_better(nuisance: int, deviation: float, kinks: float) -> None:
    deviations = np.where(np.arange(3) == nuisance, deviation, 0.0)
    values = np.zeros((RUNS, 3))
    for _ in range(4):
        values = with_deviations(deviations, values).trajectories.likeliest_nuisances(WEIGHTINGS)
    assert not np.delete(values, nuisance, axis=1).any()
    there = chi2(with_deviations(deviations, values))
    assert there.sum() < 0.9 * chi2(with_deviations(deviations)).sum()
    for away in (-0.05, 0.05):
        moved = values + away * (np.abs(values) + deviations)
        assert (chi2(with_deviations(deviations, moved)) > (1 - kinks) * there).all()


def test_what_nuisances_take_up_is_no_information() -> None:
    held = START.linearised(WEIGHTINGS).information
    free = with_deviations(np.array([0.05, 0.2, 0.01])).linearised(WEIGHTINGS).information
    assert np.linalg.eigvalsh(held - free).min() >= -1e-9 * np.linalg.eigvalsh(held).max()
    assert np.trace(free) < 0.99 * np.trace(held)


@given(seed=st.integers(0, 2**31), reach=st.floats(0.01, 10.0))
def test_a_step_within_the_box_is_the_best_there_is(seed: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    unit = PROBLEM.upper - PROBLEM.lower
    slopes = rng.standard_normal((20, PROBLEM.size)) / unit
    information, score = slopes.T @ slopes, reach * 20 * rng.standard_normal(PROBLEM.size) / unit
    vector = PROBLEM.lower + rng.uniform(0, 1, PROBLEM.size) * unit
    step = bounded_step(PROBLEM, vector, information, score)
    room = 1e-8 * unit
    assert (vector + step >= PROBLEM.lower - room).all()
    assert (vector + step <= PROBLEM.upper + room).all()
    slope = (information @ step + score) * unit  # of the objective: > 0 only at a lower bound, < 0 only at an upper one
    small = 1e-5 * np.abs(score * unit).max()
    assert (slope[vector + step > PROBLEM.lower + 10 * room] < small).all()
    assert (slope[vector + step < PROBLEM.upper - 10 * room] > -small).all()


@pytest.mark.parametrize("name", ["final_pose", "final_position", "final_heading"])
def test_final_errors_are_weighted_as_the_cost_weighs_them(name: str) -> None:
    cost = costs.create(name)
    residuals = START.trajectories.residuals
    weightings = cost_weightings(cost, START.trajectories.runs, residuals)
    lengths = np.array([np.linalg.norm(weigh(own)) for weigh, own in zip(weightings, residuals, strict=True)])
    of_each = cost.of_each(np.array([own[-1] for own in residuals]), np.arange(len(residuals)))
    assert lengths / lengths.mean() == pytest.approx(of_each / of_each.mean())
    assert np.square(lengths).mean() == pytest.approx(1.0)


def test_errors_along_the_way_count_the_same_for_every_run_whatever_its_number_of_stamps() -> None:
    residuals = START.trajectories.residuals
    weightings = cost_weightings(costs.create("trajectory"), START.trajectories.runs, residuals)
    squares = [np.square(weigh(own)).sum() for weigh, own in zip(weightings, residuals, strict=True)]
    mean_squares = np.array([np.square(own).sum(axis=1).mean() for own in residuals])
    assert squares == pytest.approx(mean_squares / mean_squares.mean())


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
    assert len(log.wheel_angles) == len(log.times) == len(log.rates)
