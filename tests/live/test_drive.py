"""Chained recordings: which can be replayed, composed poses, continuous wheel angles, the truth behind them."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from recordings import MODEL, PERIOD, ROBOT, homogeneous, random_dataset, random_run, simulated_recording
from timing import processor_time

from omnibench.config import to_yaml
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.storage import save_dataset
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.live.drive import (
    Recording,
    concatenate_recording,
    concatenate_runs,
    concatenated_truth,
    load_recording,
    true_start_poses,
)
from omnibench.robot.calibration import EffectTerm
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.simulate.commands import Commands
from omnibench.simulate.config import EncoderNoise, FlowerConfig, Session, Truth
from omnibench.simulate.source import simulate_dataset

seeds = st.integers(0, 2**32 - 1)
pauses = st.sampled_from([0.0, 0.1, 1.0])
HIDDEN = (
    EffectTerm(name="floor_drift", parameters={"dx": 0.02, "dy": 0.01}),
    EffectTerm(name="motor_lag", parameters={"tau": 0.1}),
    EffectTerm(name="wheel_eccentricity", parameters={"a_b": 0.02, "b_c": 0.02}),
    EffectTerm(name="thermal_radius_drift", parameters={"k": 1e-4}),
)


def composed_by_hand(runs: tuple[Trajectory, ...]) -> list[Array]:
    """Matrices (K, 3, 3) of the reference poses of each run, the runs one after another."""
    at, concatenated = homogeneous(runs[0].start), []
    for run in runs:
        since_start = np.linalg.inv(homogeneous(run.start)) @ np.array([homogeneous(pose) for pose in run.poses])
        concatenated.append(at @ since_start)
        at = concatenated[-1][-1]
    return concatenated


def motions(poses: Array) -> Array:
    """What (K, 3) poses have moved since the first of them, seen from there: (K, 3, 3)."""
    return np.linalg.inv(homogeneous(poses[0])) @ np.array([homogeneous(pose) for pose in poses])


# Poses


@given(seeds, st.integers(1, 5), pauses)
def test_reference_poses_are_those_composed_by_hand(seed: int, count: int, pause: float) -> None:
    dataset = random_dataset(seed, count)
    drive = concatenate_runs(dataset, pause=pause)
    by_hand = composed_by_hand(dataset.trajectories)
    np.testing.assert_allclose([homogeneous(at) for at in drive.start_poses], [each[0] for each in by_hand], atol=1e-9)
    measured = [by_hand[0], *(each[1:] for each in by_hand[1:])]
    found = [homogeneous(pose) for pose in drive.slam_poses]
    np.testing.assert_allclose(found, np.concatenate(measured), atol=1e-9)


@given(seeds)
def test_times_of_reference_poses_are_those_of_the_runs_after_the_runs_begin(seed: int) -> None:
    dataset = random_dataset(seed)
    drive = concatenate_runs(dataset)
    first, *others = dataset.trajectories
    expected = [drive.start_times[0] + first.pose_times]
    expected += [begin + run.pose_times[1:] for begin, run in zip(drive.start_times[1:], others, strict=True)]
    np.testing.assert_allclose(drive.slam_times, np.concatenate(expected), atol=1e-12)
    assert (np.diff(drive.slam_times) > 0).all()


@given(seeds)
def test_headings_turn_on_without_a_leap(seed: int) -> None:
    rng = np.random.default_rng(seed)
    runs = [random_run(f"{n}", rng) for n in range(4)]
    times, rates = runs[0].times, np.full_like(runs[0].rates, 8.0)  # a turn on the spot, of more than half a turn
    (poses,) = MODEL.poses([WheelLog(times, rates, runs[0].start, runs[0].pose_times)])
    wrapped = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    spun = replace(runs[0], rates=rates, poses=np.column_stack([poses[:, :2], wrapped]))
    dataset = make_dataset("spun", ROBOT, PERIOD, [spun, *runs[1:]])
    drive = concatenate_runs(dataset)
    turned = np.concatenate([np.diff(run.poses[:, 2]) for run in dataset.trajectories])
    np.testing.assert_allclose(np.diff(drive.slam_poses[:, 2]), turned, atol=1e-9)


def test_covariances_turn_with_their_runs_and_are_none_where_one_run_has_none() -> None:
    rng = np.random.default_rng(1)
    plain = [random_run(f"{n}", rng) for n in range(3)]
    halves = [rng.normal(size=(len(run.poses), 3, 3)) for run in plain]
    runs = [replace(run, pose_covariances=h @ np.swapaxes(h, 1, 2)) for run, h in zip(plain, halves, strict=True)]
    drive = concatenate_runs(make_dataset("covariances", ROBOT, PERIOD, runs))
    last = runs[2]
    turn = homogeneous(np.array([0.0, 0.0, drive.start_poses[2, 2] - last.poses[0, 2]]))
    expected = turn @ last.pose_covariances[1:] @ turn.T
    np.testing.assert_allclose(drive.slam_covariances[drive.slam_run == 2], expected, atol=1e-12)
    mixed = make_dataset("mixed", ROBOT, PERIOD, [*runs[:2], plain[2]])
    assert concatenate_runs(mixed).slam_covariances is None


@given(seeds)
def test_start_poses_can_be_given(seed: int) -> None:
    dataset = random_dataset(seed)
    start_poses = np.random.default_rng(seed).normal(0.0, 3.0, (3, 3))
    drive = concatenate_runs(dataset, start_poses=start_poses)
    for index, run in enumerate(dataset.trajectories):
        np.testing.assert_allclose(homogeneous(drive.start_poses[index]), homogeneous(start_poses[index]), atol=1e-9)
        poses = np.vstack([drive.start_poses[index], drive.slam_poses[drive.slam_run == index][-len(run.poses) + 1 :]])
        np.testing.assert_allclose(motions(poses), motions(run.poses), atol=1e-9)


def test_wrapped_headings_of_start_poses_are_unwrapped() -> None:
    dataset = random_dataset(3, 5)
    start_poses = concatenate_runs(dataset).start_poses
    wrapped = start_poses + 2 * np.pi * np.array([0, 3, -2, 0, 1])[:, None] * [0, 0, 1]
    np.testing.assert_allclose(concatenate_runs(dataset, start_poses=wrapped).start_poses, start_poses, atol=1e-12)


# Wheels


@given(seeds, pauses)
def test_angles_go_on_from_run_to_run_wherever_the_counters_stood(seed: int, pause: float) -> None:
    rng = np.random.default_rng(seed)
    runs = []
    for run in random_dataset(seed).trajectories:
        driven = np.cumsum(run.rates * np.diff(run.times, prepend=0.0)[:, None], axis=0)
        runs.append(replace(run, angles=driven + rng.normal(0.0, 100.0, 3)))
    drive = concatenate_runs(make_dataset("counters", ROBOT, PERIOD, runs), pause=pause)
    durations = np.diff(drive.wheel_times)[:, None]
    np.testing.assert_allclose(np.diff(drive.angles, axis=0), drive.rates[1:] * durations, atol=1e-10)


def test_recorded_angles_are_kept_where_they_differ_from_the_rates() -> None:
    tick = 0.01
    runs = []
    for run in random_dataset(2, 2).trajectories:
        driven = np.cumsum(run.rates * np.diff(run.times, prepend=0.0)[:, None], axis=0)
        runs.append(replace(run, angles=5.0 + tick * np.round(driven / tick)))
    drive = concatenate_runs(make_dataset("ticks", ROBOT, PERIOD, runs), pause=0.0)
    for index, run in enumerate(runs):
        found = drive.angles[drive.run == index][-len(run.times) :]
        np.testing.assert_allclose(np.diff(found, axis=0), np.diff(run.angles, axis=0), atol=1e-12)


def test_angles_are_integrated_rates_where_none_are_recorded() -> None:
    dataset = random_dataset(4)
    drive = concatenate_runs(dataset)
    np.testing.assert_array_equal(drive.angles[0], np.zeros(3))
    driven = [run.rates.T @ np.diff(run.times, prepend=0.0) for run in dataset.trajectories]
    np.testing.assert_allclose(drive.angles[-1], np.sum(driven, axis=0), atol=1e-10)


@given(seeds, st.integers(1, 5), pauses)
def test_odometry_of_the_drive_is_that_of_the_runs_composed(seed: int, count: int, pause: float) -> None:
    dataset = random_dataset(seed, count)
    drive = concatenate_runs(dataset, pause=pause)
    at = homogeneous(drive.start_poses[0])
    ends = MODEL.poses([run.final_log for run in dataset.trajectories])
    for run, odometry in zip(dataset.trajectories, ends, strict=True):
        at = at @ np.linalg.inv(homogeneous(run.start)) @ homogeneous(odometry[0])
    (poses,) = MODEL.poses([drive.log()])
    np.testing.assert_allclose(homogeneous(poses[-1]), at, atol=1e-9)
    np.testing.assert_array_equal(poses[0], drive.start_poses[0])


def test_the_robot_rests_between_runs_at_the_sample_period_and_not_after_the_last() -> None:
    drive = concatenate_runs(random_dataset(5, 2), pause=0.5)
    between = (drive.wheel_times > 0.8 + 1e-9) & (drive.wheel_times <= drive.start_times[1] + 1e-9)
    assert np.count_nonzero(between) == 25
    assert drive.start_times[1] == pytest.approx(0.8 + 0.5)
    assert (drive.rates[between] == 0).all()
    assert (np.ptp(drive.angles[between], axis=0) == 0).all()
    assert (drive.run[between] == 0).all()
    np.testing.assert_allclose(np.diff(drive.wheel_times), PERIOD, atol=1e-9)
    assert drive.wheel_times[-1] == pytest.approx(0.8 + 0.5 + 0.8)
    assert drive.rates[-1].any()


@given(seeds, st.integers(1, 24).map(lambda eighths: eighths / 8) | st.just(1 + 1e-5))
def test_what_wheels_do_after_the_last_reference_pose_is_left_out(seed: int, late: float) -> None:
    rng = np.random.default_rng(seed)
    runs = [random_run(f"{n}", rng, tail=5) for n in range(2)]
    moved = [np.append(run.pose_times[:-1], run.pose_times[-1] + late * PERIOD) for run in runs]
    runs = [replace(run, pose_times=times) for run, times in zip(runs, moved, strict=True)]
    driven = [np.cumsum(run.rates * PERIOD, axis=0) for run in runs]
    runs = [replace(run, angles=angles) for run, angles in zip(runs, driven, strict=True)]
    dataset = make_dataset("tail", ROBOT, PERIOD, runs)
    drive = concatenate_runs(dataset, pause=0.0)
    assert drive.start_times[1] == pytest.approx(runs[0].pose_times[-1])
    at = homogeneous(drive.start_poses[0])
    for run, odometry in zip(runs, MODEL.poses([run.final_log for run in runs]), strict=True):
        at = at @ np.linalg.inv(homogeneous(run.start)) @ homogeneous(odometry[0])
    (poses,) = MODEL.poses([drive.log()])
    np.testing.assert_allclose(homogeneous(poses[-1]), at, atol=1e-9)
    durations = np.diff(drive.wheel_times)[:, None]
    np.testing.assert_allclose(np.diff(drive.angles, axis=0), drive.rates[1:] * durations, atol=1e-10)


def test_wheels_rest_until_a_last_reference_pose_that_is_later() -> None:
    rng = np.random.default_rng(7)
    run = random_run("late", rng)
    late = replace(run, pose_times=np.append(run.pose_times[:-1], 0.85))
    drive = concatenate_runs(make_dataset("late", ROBOT, PERIOD, [late, random_run("next", rng)]), pause=0.0)
    assert drive.start_times[1] == pytest.approx(0.86)
    assert (np.diff(drive.slam_times) > 0).all()


def test_ten_times_as_many_runs_take_about_ten_times_as_long() -> None:
    rng = np.random.default_rng(8)
    runs = [random_run(f"{n}", rng, samples=500) for n in range(400)]
    few, many = (make_dataset("long", ROBOT, PERIOD, runs[:count]) for count in (40, 400))
    assert processor_time(lambda: concatenate_runs(many, pause=0.1)) < 20 * processor_time(
        lambda: concatenate_runs(few, pause=0.1)
    )


# Order


def ids(*runs: Trajectory, split: str | None = None) -> tuple[str, ...]:
    return concatenate_runs(make_dataset("order", ROBOT, PERIOD, runs), split=split).ids


def run(name: str, **known: object) -> Trajectory:
    return random_run(name, np.random.default_rng(ord(name)), **known)


def test_runs_go_by_session_and_then_by_when_they_started() -> None:
    runs = [("a", "two", 50.0), ("b", "one", 9.0), ("c", "two", 10.0), ("d", "one", 3.0)]
    made = [run(name, session=session, started_at=at) for name, session, at in runs]
    assert ids(*made) == ("c", "a", "d", "b")


def test_a_session_without_all_its_times_stays_in_the_order_of_the_data_set() -> None:
    made = [run("a", started_at=9.0), run("b"), run("c", started_at=1.0)]
    assert ids(*made) == ("a", "b", "c")


def test_one_split_can_be_chosen() -> None:
    made = [run("a"), replace(run("b"), split="validation"), run("c")]
    assert ids(*made, split="train") == ("a", "c")
    assert ids(*made, split="validation") == ("b",)


# Truth


@pytest.mark.parametrize("hidden", [(), HIDDEN], ids=["plain", "with hidden effects"])
def test_without_noise_the_reference_is_the_truth(hidden: tuple[EffectTerm, ...]) -> None:
    recording = simulated_recording(effects=hidden)
    drive = concatenate_runs(recording.dataset)
    truth = concatenated_truth(drive, recording)
    at = np.searchsorted(drive.wheel_times, drive.slam_times - 1e-6)
    np.testing.assert_allclose(drive.slam_poses, truth[at], atol=1e-9)
    np.testing.assert_allclose(true_start_poses(recording), drive.start_poses, atol=1e-9)


def test_with_true_start_poses_the_truth_is_what_the_robots_own_matrix_drives() -> None:
    recording = simulated_recording(EncoderNoise(bias_position=0.1, bias_heading=0.1))
    drive = concatenate_recording(recording)  # without noise of the encoders their rates are the targets
    model = OdometryModel(ROBOT, np.array(recording.truth.matrix), recording.truth.integration)
    (poses,) = model.poses([drive.log()])
    np.testing.assert_allclose(concatenated_truth(drive, recording), poses, atol=1e-9)


def test_with_true_start_poses_the_reference_errs_as_the_noise_says_and_does_not_drift() -> None:
    noise = EncoderNoise(pose_position=0.02, pose_heading=0.01, bias_position=0.03)
    recording = simulated_recording(noise, repetitions=60)
    drive = concatenate_recording(recording)
    truth = concatenated_truth(drive, recording)
    error = (drive.slam_poses - truth[np.searchsorted(drive.wheel_times, drive.slam_times - 1e-6)])[1:]
    assert np.sqrt((error[:, :2] ** 2).mean()) == pytest.approx(np.hypot(0.02, 0.03), rel=0.1)
    assert np.sqrt((error[:, 2] ** 2).mean()) == pytest.approx(0.01, rel=0.1)
    third = len(error) // 3
    assert np.abs(error[-third:, :2]).mean() < 1.3 * np.abs(error[:third, :2]).mean()


def test_without_true_start_poses_each_run_of_the_truth_starts_where_the_drive_puts_it() -> None:
    recording = simulated_recording(EncoderNoise(bias_position=0.1, bias_heading=0.1))
    drive = concatenate_runs(recording.dataset, pause=0.0)
    truth = concatenated_truth(drive, recording)
    model = OdometryModel(ROBOT, np.array(recording.truth.matrix), recording.truth.integration)
    for index, run in enumerate(recording.dataset.trajectories):
        log = WheelLog(run.times, run.targets, drive.start_poses[index], run.times)
        found = truth[drive.run == index][-len(run.times) :]
        np.testing.assert_allclose(found, model.poses([log])[0], atol=1e-9)


def test_a_split_has_its_own_truth() -> None:
    recording = simulated_recording()
    first, *others = recording.dataset.trajectories
    mixed = make_dataset("mixed", ROBOT, 0.01, [replace(first, split="validation"), *others])
    drive = concatenate_recording(Recording(mixed, recording.truth), split="train")
    assert len(drive.start_poses) == len(others)
    assert len(concatenated_truth(drive, Recording(mixed, recording.truth))) == len(drive.wheel_times)


def test_a_recording_whose_truth_is_not_known_says_so() -> None:
    recording = Recording(random_dataset(1))
    with pytest.raises(DataError, match="data set random: it has no truth"):
        true_start_poses(recording)
    with pytest.raises(DataError, match="it has no truth"):
        concatenated_truth(concatenate_recording(recording), recording)


def lonely() -> Dataset:
    """A data set of a run with a single pose."""
    run = random_run("lonely", np.random.default_rng(1))
    return Dataset("one pose", ROBOT, PERIOD, (replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1]),))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"split": "validation"}, "'validation'"),
        ({"dataset": lonely()}, "data set one pose: run lonely"),
        *(({"start_poses": poses}, r"\(3, 3\)") for poses in (np.zeros((2, 3)), np.zeros(3), np.full((3, 3), np.nan))),
        *(({"pause": pause}, "pause") for pause in (-1.0, np.nan, np.inf, 1e9)),
    ],
)
def test_what_cannot_be_chained_is_named(options: dict[str, Any], named: str) -> None:
    with pytest.raises((DataError, ConfigError), match=named):
        concatenate_runs(options.pop("dataset", random_dataset(1)), **options)


def test_all_runs_of_real_recordings_are_concatenated_session_by_session(omni3: Dataset) -> None:
    drive, known = concatenate_runs(omni3), {run.id: run for run in omni3.trajectories}
    runs = tuple(known[each] for each in drive.ids)
    assert len(runs) == 67
    assert sum(one.session != other.session for one, other in pairwise(runs)) == len({run.session for run in runs}) - 1
    driven = drive.rates[1:] * np.diff(drive.wheel_times)[:, None]
    np.testing.assert_allclose(np.diff(drive.angles, axis=0), driven, atol=1e-9)
    assert (np.diff(drive.wheel_times) > 0).all()
    np.testing.assert_allclose(homogeneous(drive.slam_poses[-1]), composed_by_hand(runs)[-1][-1], atol=1e-8)


FLOWER = FlowerConfig(
    robot=ROBOT,
    commands=Commands(directions_deg=(0, 90), turn_rates=(0.1,)),
    repetitions=1,
    truth=Truth(published="palacin2023_eq8"),
    train=Session(seed=1, distance=0.1),
)


def config_with(tmp_path: Path, **datasets: object) -> Path:
    """A comparison's config_with with these data sets."""
    path = tmp_path / "compare.yaml"
    path.write_text(to_yaml({"name": "mine", "description": "Two runs.", "datasets": datasets, "calibrators": ["crs"]}))
    return path


def simulated(**changes: object) -> dict[str, object]:
    return {"simulate": FLOWER.model_dump(mode="json", exclude_none=True) | changes}


def test_a_folder_is_a_recording_without_a_truth(tmp_path: Path) -> None:
    dataset = random_dataset(1)
    save_dataset(dataset, tmp_path / "random")
    recording = load_recording(tmp_path / "random")
    assert recording.dataset.hash == dataset.hash
    assert recording.truth is None


def test_a_simulated_data_set_of_a_config_comes_with_its_truth(tmp_path: Path) -> None:
    recording = load_recording(config_with(tmp_path, flower=simulated()))
    expected = simulate_dataset(FLOWER, "flower", "Two runs.")
    assert recording.dataset.hash == expected.dataset.hash
    assert (recording.dataset.name, recording.dataset.description) == ("flower", "Two runs.")
    assert recording.truth == expected.truth


@pytest.mark.parametrize(
    ("datasets", "chosen", "named"),
    [
        ({"one": simulated(), "two": simulated()}, None, "--dataset: one, two"),
        ({"flower": simulated(), "table": simulated()}, "flowr", "'flowr'; did you mean 'flower'"),
        ({"flower": simulated(pose_perod=0.1)}, None, r"'datasets\.flower\.simulate\.pose_perod'.*'pose_period'"),
        ({"flower": {"simulat": {}}}, None, r"'datasets\.flower\.simulat'.*'simulate'"),
        ({"real": {"path": "recordings"}, "flower": simulated()}, "real", "'real' is not simulated"),
        ({"real": {"path": "recordings"}}, None, "no simulated data set"),
    ],
)
def test_other_data_sets_are_named(tmp_path: Path, datasets: dict[str, Any], chosen: str | None, named: str) -> None:
    with pytest.raises(OmnibenchError, match=named):
        load_recording(config_with(tmp_path, **datasets), chosen)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (None, "other.yaml: no such file or folder"),
        *((content, "no data sets in it") for content in ("", "12", "[1, 2]", yaml.dump({"wheels": 3}))),
        ("datasets: [", "other.yaml: not valid YAML"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, content: str | None, named: str) -> None:
    if content is not None:
        (tmp_path / "other.yaml").write_text(content)
    with pytest.raises(OmnibenchError, match=named):
        load_recording(tmp_path / "other.yaml")
    with pytest.raises(OmnibenchError, match="--dataset"):
        load_recording(tmp_path, "flower")  # a folder has no data sets to choose from
