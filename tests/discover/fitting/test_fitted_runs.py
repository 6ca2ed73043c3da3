"""Fitted runs: long drives in windows, jumps left out, poses that come back once the model holds what moved them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import plain_fit, simulated
from extended_samples import FORWARD, run_of
from hypothesis import given
from hypothesis import strategies as st
from outlier_study import EFFECT, TRUTH
from outlier_study import simulated as with_directions

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting import Extended, Fit, InlierWhitener, extend, in_windows, inliers_of, with_noise
from omnibench.discover.regressors.significance import Group
from omnibench.fit.noise import Whitener
from omnibench.registry import effects
from omnibench.robot.calibration import Noise
from omnibench.robot.model import OdometryModel

# Windows

ROBOT_MODEL = simulated(()).robot


def drive(seed: int, seconds: float = 60.0) -> Trajectory:
    """A drive whose poses are those of its own odometry."""
    rng, times = np.random.default_rng(seed), np.arange(1, int(seconds / 0.04) + 1) * 0.04
    rates = np.cumsum(rng.normal(0, 0.05, (len(times), 3)), axis=0)
    stamps = np.append(0.0, times[4::5])
    run = Trajectory("drive", "train", times, rates, stamps, np.zeros((len(stamps), 3)), started_at=7.0)
    (poses,) = OdometryModel.of_design(ROBOT_MODEL, "arc").poses([run.log(stamps[1:])])
    return replace(run, poses=np.vstack([run.start, poses]))


@given(seed=st.integers(0, 2**32 - 1))
def test_the_odometry_of_every_window_ends_where_the_drive_does(seed: int) -> None:
    windows = in_windows([drive(seed)])
    assert len(windows) == 15  # of 4 s
    model = OdometryModel.of_design(ROBOT_MODEL, "arc")
    for window, poses in zip(windows, model.poses([window.reference_log for window in windows]), strict=True):
        np.testing.assert_allclose(poses, window.poses[1:], atol=1e-9)
    assert windows[3].started_at == pytest.approx(7.0 + 12.0, abs=0.2)


def test_repetitions_and_many_runs_are_not_cut() -> None:
    repeated = [replace(drive(seed), id=str(seed), command="c") for seed in (1, 2)]
    assert in_windows(repeated) == tuple(repeated)
    many = [replace(drive(1, 9.0), id=str(number)) for number in range(30)]
    assert in_windows(many) == tuple(many)


# Outliers

UNIT = Noise(pose_position=1.0, pose_heading=1.0)
POSES = 20


def runs_of(*commands: str | None, poses: int = POSES) -> list[Trajectory]:
    """Runs of some commands with reference poses every 0.4 s."""
    run = run_of(FORWARD)
    stamps = 0.4 * np.arange(poses + 1)
    return [
        replace(run, id=f"{index}", command=command, pose_times=stamps, poses=np.zeros((poses + 1, 3)))
        for index, command in enumerate(commands)
    ]


def outliers(runs: list[Trajectory], residuals: np.ndarray | list[np.ndarray], noise: Noise = UNIT) -> list[list[int]]:
    return [np.flatnonzero(~mask).tolist() for mask in inliers_of(runs, list(residuals), noise)]


@pytest.mark.parametrize(("size", "left_out"), [(4.3, []), (4.7, [7])])
def test_a_pose_is_an_outlier_from_four_and_a_half_standard_deviations_on(size: float, left_out: list[int]) -> None:
    residuals = np.zeros((1, POSES, 3))
    residuals[0, 7, 2] = size
    assert outliers(runs_of("go"), residuals) == [left_out]


def test_a_pose_is_compared_with_what_the_others_of_its_run_predict() -> None:
    walked = np.cumsum(np.ones((POSES, 3)), axis=0)  # far off, yet as a walk goes
    jumped = walked.copy()
    jumped[9, 0] += 6.0
    noise = Noise(pose_position=0.2, pose_heading=0.2, walk_position=1.0, walk_heading=1.0)
    assert outliers(runs_of("go", "turn"), [walked, jumped], noise) == [[], [9]]


def test_noise_alone_makes_hardly_any_outlier() -> None:
    runs = runs_of(*(f"c{number}" for number in range(300)), poses=60)
    residuals = np.random.default_rng(3).standard_normal((300, 60, 3))
    assert sum(map(len, outliers(runs, residuals))) <= 3  # 0.4 expected of 18,000


def test_slam_that_jumps_in_one_repetition_is_left_out_there_alone() -> None:
    residuals = np.random.default_rng(1).standard_normal((8, POSES, 3))
    residuals[2, 5:7, :2] += 15.0
    residuals[6, -1, 2] -= 8.0
    assert outliers(runs_of(*"aaaabbbb"), residuals) == [[], [], [5, 6], [], [], [], [POSES - 1], []]


@pytest.mark.parametrize("commands", ["aaaabbbbccccdddd", "aabbccddeeffgghh"])
def test_what_recurs_at_a_stamp_of_a_command_is_signal(commands: str) -> None:
    residuals = np.random.default_rng(1).standard_normal((16, POSES, 3)) / 3
    residuals[[name == "a" for name in commands], 6] += 8.0
    assert not any(outliers(runs_of(*commands), residuals))


def test_a_jump_far_beyond_what_recurs_is_left_out() -> None:
    residuals = np.random.default_rng(1).standard_normal((8, POSES, 3)) / 3
    residuals[:4, 6] += 6.0
    residuals[1, 6] += 60.0
    assert outliers(runs_of(*"aaaabbbb"), residuals) == [[], [6], [], [], [], [], [], []]


def test_what_recurs_at_the_end_of_runs_is_signal_though_no_command_is_repeated_and_they_differ_in_length() -> None:
    runs = [run for count in range(12, 30) for run in runs_of(f"c{count}", poses=count)]
    rng = np.random.default_rng(1)
    residuals = [rng.standard_normal((len(run.pose_times) - 1, 3)) for run in runs]
    for number, of_run in enumerate(residuals):
        of_run[-1, 2] += 9.0 * (-1) ** number
    assert not any(outliers(runs, residuals))


def test_where_more_than_a_twelfth_of_the_poses_stand_out_the_limit_rises() -> None:
    residuals = np.random.default_rng(1).standard_normal((10, POSES, 3))
    for number, of_run in enumerate(residuals):  # nowhere twice at one stamp
        of_run[[number, number + 10], 0] = 5.5
    assert not any(outliers(runs_of(*"abcdefghij"), residuals))


def test_outliers_are_whitened_as_if_they_had_not_been_seen() -> None:
    stamps, residuals = 0.4 * np.arange(1, 9), np.random.default_rng(0).standard_normal((8, 3))
    inliers = np.array([True, False, True, True, False, False, True, False])
    noise = Noise(pose_position=0.4, walk_position=0.3, pose_heading=0.2, bias_heading=0.1)
    whiten, alone = InlierWhitener(noise, stamps, inliers), Whitener(noise, stamps[inliers])
    white = whiten(residuals)
    np.testing.assert_array_equal(white, alone(residuals[inliers]))
    np.testing.assert_allclose(whiten.of_differences(np.diff(residuals, axis=0, prepend=0.0)), white)
    unit = np.eye(24).reshape(8, 3, 24)
    precision = np.einsum("ksi,ksj->ij", whiten(unit), whiten(unit))
    np.testing.assert_allclose(whiten.weighted(white).ravel(), precision @ residuals.ravel(), atol=1e-12)


def extended_by(name: str, plain: Fit) -> Extended:
    effect = effects.create(name)
    linear = tuple(each for each in effect.parameters(plain.model.robot) if not each.choices)
    return extend(plain, [Group("effect", name, (), effect, linear)])


def test_an_effect_that_looks_like_outliers_is_estimated_without_bias() -> None:
    model = extended_by(EFFECT, plain_fit(with_directions(1)))
    assert model.fit.jumps == 0
    assert (np.abs(model.values - TRUTH) < 2 * model.covariance.reach[-3:]).all()


@pytest.mark.slow
def test_poses_come_back_and_jumps_stay_out_once_the_model_holds_the_effect() -> None:
    dataset = with_directions(1)
    thrown = {"0+0.0-0": 5, "7-0.4-2": 11}
    runs = [replace(run, poses=run.poses.copy()) for run in dataset.trajectories]
    for run in runs:
        if run.id in thrown:
            run.poses[1 + thrown[run.id], :2] += 0.2
    model = extended_by(EFFECT, plain_fit(replace(dataset, trajectories=tuple(runs))))
    strict = replace(model.fit, inliers=tuple(np.arange(len(mask)) % 3 > 0 for mask in model.fit.masks))
    again = with_noise(strict)
    assert {run.id: np.flatnonzero(~mask).tolist() for run, mask in zip(again.runs, again.masks, strict=True)} == {
        run.id: [thrown[run.id]] if run.id in thrown else [] for run in again.runs
    }


@pytest.mark.slow
def test_a_heading_that_is_thrown_at_the_end_of_runs_loses_no_final_pose() -> None:
    dataset = with_directions(1)
    commands = sorted({str(run.command) for run in dataset.trajectories})
    runs = [replace(run, poses=run.poses.copy()) for run in dataset.trajectories]
    for run in runs:
        place = commands.index(str(run.command))
        run.poses[-1, 2] += 0.08 * (-1) ** place * (place % 5 > 1)  # three commands of five, either way
    plain = plain_fit(replace(dataset, trajectories=tuple(runs)))
    assert all(mask[-1] for mask in plain.masks)


def test_the_fit_ends_where_neither_outliers_nor_noise_change() -> None:
    dataset = simulated((), repetitions=4)
    rng = np.random.default_rng(4)
    runs = [replace(run, poses=run.poses.copy()) for run in dataset.split("train")]
    for run in runs:
        if rng.random() < 0.3:
            run.poses[int(rng.integers(1, len(run.poses))), :2] += rng.choice([-0.08, 0.08], 2)
    plain = plain_fit(replace(dataset, trajectories=tuple(runs)))
    assert plain.jumps > 10
    np.testing.assert_array_equal(np.concatenate(with_noise(plain).masks), np.concatenate(plain.masks))
