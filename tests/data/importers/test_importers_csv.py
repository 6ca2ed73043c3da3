"""The csv importer: rates, angles and ticks, poses as CSV or TUM, in any units and epoch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from omnibench.data.dataset import Dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.slam.import_dataset import import_dataset

ROBOT: dict[str, Any] = {
    "name": "square",
    "wheels": [{"name": f"w{i}", "radius": 0.05, "distance": 0.2, "angle_deg": 90 * i} for i in range(4)],
}
NAMES = [wheel["name"] for wheel in ROBOT["wheels"]]
MODEL = OdometryModel.of_design(
    Robot.model_validate(
        {
            "name": "square",
            "wheels": [{"name": f"w{i}", "radius": 0.05, "distance": 0.2, "angle": math.pi / 2 * i} for i in range(4)],
        }
    ),
    "arc",
)
PERIOD = 0.02


@dataclass(frozen=True)
class Recording:
    """What a robot without any error would record: samples end at ``times``, poses at ``pose_times`` from 0 on."""

    times: Array
    rates: Array
    pose_times: Array
    poses: Array


@pytest.fixture
def recording() -> Recording:
    rng = np.random.default_rng(3)
    times = PERIOD * np.arange(1, 101)
    twists = np.cumsum(rng.normal(0, (0.02, 0.02, 0.1), (100, 3)), axis=0)
    rates = twists @ np.linalg.pinv(MODEL.matrix).T
    pose_times = 0.1 * np.arange(0, 21)
    start = np.array([1.0, -2.0, 3.0])
    (poses,) = MODEL.poses([WheelLog(times, rates, start, pose_times)])
    return Recording(times, rates, pose_times, poses)


def write_csv(file: Path, names: list[str], *columns: Array, separator: str = ",") -> None:
    table = np.column_stack(columns)
    rows = [separator.join(f"{value:.12f}" for value in row) for row in table]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join([separator.join(names), *rows]) + "\n")


def write_poses(file: Path, recording: Recording, offset: float = 0.0) -> None:
    poses = recording.poses.copy()
    poses[:, 2] = (poses[:, 2] + math.pi) % (2 * math.pi) - math.pi
    write_csv(file, ["t", "x", "y", "theta"], recording.pose_times + offset, poses)


def write_run(folder: Path, recording: Recording, name: str = "run1", offset: float = 0.0) -> None:
    names = ["t", *(f"omega_{wheel}" for wheel in NAMES)]
    write_csv(folder / f"{name}_wheels.csv", names, recording.times + offset, recording.rates)
    write_poses(folder / f"{name}_poses.csv", recording, offset)


def read(folder: Path, **options: Any) -> Dataset:
    return import_dataset("csv", folder, {"robot": ROBOT} | options)


def odometry_error(data: Dataset) -> float:
    """Largest difference of the design's odometry from the reference at any pose."""
    errors = [
        poses - run.poses[1:]
        for run, poses in zip(
            data.trajectories, MODEL.poses([run.reference_log for run in data.trajectories]), strict=True
        )
    ]
    return max(float(np.abs(error).max()) for error in errors)


def test_rates_and_poses_in_si_need_nothing_but_a_robot(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path, recording)
    data = read(tmp_path)
    assert odometry_error(data) < 1e-9
    assert data.sample_period == PERIOD
    assert data.trajectories[0].id == "run1"


def test_unix_times_of_both_files_are_zeroed_together(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path, recording, offset=1_700_000_000.25)
    data = read(tmp_path)
    run = data.trajectories[0]
    assert (run.pose_times[0], len(run.times), len(run.pose_times)) == (0.0, 100, 21)
    assert odometry_error(data) < 1e-6


def test_poses_that_begin_earlier_are_interpolated_at_the_wheels_begin(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path, recording)
    still = recording.poses[0] - [0.02, -0.01, 0.03]  # 0.05 s before: half way back at -0.025
    poses = np.vstack([still, recording.poses[0] + (recording.poses[0] - still), recording.poses[1:]])
    times = np.concatenate([[-0.05, 0.05], recording.pose_times[1:]])
    write_csv(tmp_path / "run1_poses.csv", ["t", "x", "y", "theta"], times, poses)
    run = read(tmp_path).trajectories[0]
    assert run.pose_times[:2].tolist() == pytest.approx([0.0, 0.05])
    np.testing.assert_allclose(run.start, recording.poses[0], atol=1e-9)


def test_wheel_samples_before_the_first_pose_are_left_out(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path, recording)
    late = Recording(recording.times, recording.rates, recording.pose_times[3:], recording.poses[3:])
    write_poses(tmp_path / "run1_poses.csv", late)
    data = read(tmp_path)
    assert len(data.trajectories[0].times) == 85
    assert odometry_error(data) < 1e-9


def test_a_pose_within_a_sample_starts_there(tmp_path: Path, recording: Recording) -> None:
    (poses,) = MODEL.poses(
        [WheelLog(recording.times, recording.rates, recording.poses[0], recording.pose_times[:-1] + 0.007)]
    )
    write_run(tmp_path, recording)
    write_poses(
        tmp_path / "run1_poses.csv",
        Recording(recording.times, recording.rates, recording.pose_times[:-1] + 0.007, poses),
    )
    data = read(tmp_path)
    assert data.trajectories[0].times[0] == pytest.approx(0.013)
    assert odometry_error(data) < 1e-9


def test_poses_after_the_wheels_are_left_out(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path, recording)
    with (tmp_path / "run1_poses.csv").open("a") as file:
        file.write("5,0,0,0\n")
    data = read(tmp_path)
    assert data.trajectories[0].pose_times[-1] == pytest.approx(2.0)
    assert not any("left out" in warning for warning in data.warnings)


@pytest.mark.parametrize(("unit", "factor"), [("rpm", 30 / math.pi), ("deg/s", 180 / math.pi)])
def test_rates_have_other_units(tmp_path: Path, recording: Recording, unit: str, factor: float) -> None:
    scaled = Recording(recording.times, recording.rates * factor, recording.pose_times, recording.poses)
    write_run(tmp_path, scaled)
    assert odometry_error(read(tmp_path, wheel_unit=unit)) < 1e-9


def angles_with_start(recording: Recording) -> tuple[Array, Array]:
    """Times (F + 1,) from 0 on and absolute angles (F + 1, 4), rad."""
    angles = np.vstack([np.zeros(4), np.cumsum(recording.rates * PERIOD, axis=0)]) + 0.3
    return np.concatenate([[0.0], recording.times]), angles


@pytest.mark.parametrize(
    ("unit", "per_radian", "prefix", "options"),
    [
        ("rad", 1.0, "phi", {}),
        ("deg", 180 / math.pi, "phi", {}),
        ("ticks", 4096 / (2 * math.pi), "ticks", {"ticks_per_turn": 4096}),
    ],
)
def test_absolute_angles_become_rates_and_are_kept(
    tmp_path: Path, recording: Recording, unit: str, per_radian: float, prefix: str, options: dict[str, Any]
) -> None:
    times, angles = angles_with_start(recording)
    names = ["t", *(f"{prefix}_{wheel}" for wheel in NAMES)]
    write_csv(tmp_path / "run1_wheels.csv", names, times, angles * per_radian)
    write_poses(tmp_path / "run1_poses.csv", recording)
    data = read(tmp_path, wheel_unit=unit, **options)
    assert odometry_error(data) < 1e-8
    kept = data.trajectories[0].angles
    assert kept is not None
    np.testing.assert_allclose(kept, angles[1:], atol=1e-9)


def test_angles_that_start_again_are_unwrapped(tmp_path: Path, recording: Recording) -> None:
    times, angles = angles_with_start(recording)
    names = ["t", *(f"phi_{wheel}" for wheel in NAMES)]
    wrapped = np.degrees(angles) % 360
    assert np.abs(np.diff(wrapped, axis=0)).max() > 350
    write_csv(tmp_path / "run1_wheels.csv", names, times, wrapped)
    write_poses(tmp_path / "run1_poses.csv", recording)
    assert odometry_error(read(tmp_path, wheel_unit="deg", wraps_at=360)) < 1e-8


def test_ticks_of_each_sample_can_be_given(tmp_path: Path, recording: Recording) -> None:
    ticks = np.vstack([np.zeros(4), recording.rates * PERIOD]) * 4096 / (2 * math.pi)
    names = ["t", *(f"ticks_{wheel}" for wheel in NAMES)]
    write_csv(tmp_path / "run1_wheels.csv", names, np.concatenate([[0.0], recording.times]), ticks)
    write_poses(tmp_path / "run1_poses.csv", recording)
    assert odometry_error(read(tmp_path, wheel_unit="ticks/sample", ticks_per_turn=4096)) < 1e-8


def test_columns_signs_units_and_separator_can_be_named(tmp_path: Path, recording: Recording) -> None:
    columns = ["front", "left", "back", "right"]
    signs = np.array([-1, 1, 1, -1])
    wheels = (recording.times * 1000, recording.rates * signs, np.zeros(100))
    write_csv(tmp_path / "a.rates", ["stamp", *columns, "spare"], *wheels, separator=";")
    poses = recording.poses * (100, 100, 180 / math.pi)
    write_csv(tmp_path / "a.slam", ["when", "px", "py", "yaw"], recording.pose_times * 1e6, poses, separator=";")
    data = read(
        tmp_path,
        wheel_suffix=".rates",
        pose_suffix=".slam",
        separator=";",
        wheel_time_column="stamp",
        wheel_time_unit="ms",
        wheel_columns=columns,
        wheel_signs=signs.tolist(),
        pose_time_column="when",
        pose_time_unit="us",
        pose_columns=["px", "py", "yaw"],
        position_unit="cm",
        heading_unit="deg",
    )
    assert odometry_error(data) < 1e-8


def test_poses_can_be_in_tum_format(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path, recording, offset=1e9)
    (tmp_path / "run1_poses.csv").unlink()
    half = recording.poses[:, 2] / 2
    zero = np.zeros_like(half)
    table = np.column_stack(
        [recording.pose_times + 1e9, recording.poses[:, :2], zero, zero, zero, np.sin(half), np.cos(half)]
    )
    np.savetxt(tmp_path / "run1_poses.tum", table, fmt="%.12f", header="timestamp tx ty tz qx qy qz qw")
    assert odometry_error(read(tmp_path)) < 1e-6


def test_the_robot_can_be_a_yaml_file_by_itself_or_inside_another(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path / "runs", recording)
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(ROBOT))
    alone = read(tmp_path / "runs", robot=str(tmp_path / "robot.yaml"))
    save_dataset(alone, tmp_path / "data")
    inside = read(tmp_path / "runs", robot=str(tmp_path / "data" / "dataset.yaml"))
    assert alone.robot == inside.robot == MODEL.robot


def test_runs_share_commands_by_a_pattern(tmp_path: Path, recording: Recording) -> None:
    for name in ("east_1", "east_2", "north_1"):
        write_run(tmp_path, recording, name)
    data = read(tmp_path, command_pattern="^(.*)_")
    assert [(run.command, run.repetition, run.split) for run in data.trajectories] == [
        ("east", 1, "train"),
        ("east", 2, "validation"),
        ("north", 1, "train"),
    ]


def test_every_second_run_validates_by_default(tmp_path: Path, recording: Recording) -> None:
    for name in ("a", "b", "c"):
        write_run(tmp_path, recording, name)
    assert [run.split for run in read(tmp_path).trajectories] == ["train", "validation", "train"]


def test_patterns_split_runs_of_subfolders(tmp_path: Path, recording: Recording) -> None:
    for name in ("a", "b"):
        write_run(tmp_path / "day1", recording, name)
        write_run(tmp_path / "day2", recording, name)
    data = read(tmp_path, train="day1/*", validation=["day2/b"])
    assert {run.id: run.split for run in data.trajectories} == {
        "day1/a": "train",
        "day1/b": "train",
        "day2/b": "validation",
    }


def test_the_data_set_survives_its_way_over_the_disk(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path / "runs", recording)
    data = read(tmp_path / "runs", description="d", source="s", licence="l")
    save_dataset(data, tmp_path / "data")
    again = load_dataset(tmp_path / "data")
    assert (again.hash, again.description, again.source, again.licence) == (data.hash, "d", "s", "l")


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("wheels", "0.060000000000,", "0.03,", r"run1_wheels\.csv, row 3 \(line 4\): t goes backwards: 0\.03 after 0"),
        ("wheels", "0.060000000000,", "soon,", r"run1_wheels\.csv, row 3 \(line 4\): t is 'soon', expected a number"),
        ("wheels", "0.060000000000,", "inf,", r"run1_wheels\.csv, row 3 \(line 4\): t is inf; remove or repair"),
        ("wheels", "0.060000000000,", ",", r"run1_wheels\.csv, row 3 \(line 4\): t is missing"),
        ("wheels", "0.060000000000,", "1,2,", r"run1_wheels\.csv, row 3 \(line 4\): it has 6 fields, expected 5"),
        ("wheels", "omega_w2", "omega_v2", r"run1_wheels\.csv: column 'omega_w2' is missing; .*did you mean --set"),
        ("poses", "theta", "th_deg", r"run1_poses\.csv: column 'theta' is missing; found: t, x, y, th_deg; did you"),
        ("poses", "1.000000000000", "nan", r"run1_poses\.csv, row 1 \(line 2\): x is nan"),
    ],
)
def test_a_malformed_row_is_named(
    tmp_path: Path, recording: Recording, file: str, old: str, new: str, message: str
) -> None:
    write_run(tmp_path, recording)
    path = tmp_path / f"run1_{file}.csv"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(DataError, match=message) as caught:
        read(tmp_path)
    assert "\n" not in str(caught.value)


def test_an_empty_file_is_named(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path, recording)
    (tmp_path / "run1_poses.csv").write_text("t,x,y,theta\n")
    with pytest.raises(DataError, match=r"run1_poses\.csv: it has no rows"):
        read(tmp_path)


def test_a_binary_file_is_named(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path, recording)
    (tmp_path / "run1_poses.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(DataError, match=r"run1_poses\.csv: cannot be read: it is not a text file"):
        read(tmp_path)


def test_wheels_without_poses_are_named(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path, recording)
    (tmp_path / "run1_poses.csv").rename(tmp_path / "run_1_poses.csv")
    with pytest.raises(DataError, match=r"run 'run1' has no run1_poses\.csv or run1_poses\.tum"):
        read(tmp_path)


def test_poses_without_wheels_are_named(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path, recording)
    write_poses(tmp_path / "run2_poses.csv", recording)
    with pytest.raises(DataError, match=r"run 'run2' has no run2_wheels\.csv"):
        read(tmp_path)


def test_clocks_that_do_not_meet_are_named(tmp_path: Path, recording: Recording) -> None:
    write_run(tmp_path, recording)
    write_poses(tmp_path / "run1_poses.csv", recording, offset=1e9)
    with pytest.raises(DataError, match=r"no two poses while the wheels were recorded .*") as refused:
        read(tmp_path)
    offset = str(refused.value).partition("--set pose_time_offset=")[2].split()[0]
    assert read(tmp_path, pose_time_offset=float(offset)).trajectories[0].has_poses


def test_a_folder_without_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no tables below it; .* import csv --template DIR writes tables to fill in"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"wheel_unit": "ticks"}, "wheel_unit ticks needs ticks_per_turn"),
        ({"ticks_per_turn": 100}, "ticks_per_turn is for wheel_unit ticks"),
        ({"wraps_at": 360}, r"wraps_at is for positions \(rad, deg, rev, ticks\), not for wheel_unit rad/s"),
        ({"wraps_at": "nver"}, r"did you mean 'never'\? expected a number such as 65536 or 2\^32, auto or never"),
        ({"wheel_unit": "tics"}, r"wheel_unit: Input should be .* \(given: 'tics'\); did you mean 'ticks'\?"),
        (
            {"wheel_unit": "ticks", "ticks_per_turn": [1, 2]},
            "ticks_per_turn has 2 values, expected 4, one for each wheel",
        ),
        ({"gear_ratio": [1, 2, 3]}, "gear_ratio has 3 values, expected 4, one for each wheel: w0, w1, w2, w3"),
        ({"steering_columns": "a"}, r"steering_columns is for wheels that steer; the robot has none \(type: steered\)"),
        ({"separator": ", "}, "separator: .*expected one character, or blanks"),
        ({"wheel_columns": ["a", "b"]}, "wheel_columns has 2 values, expected 4"),
        ({"wheel_signs": [1, 1, 1]}, "wheel_signs has 3 values, expected 4"),
        ({"pose_columns": ["x", "y"]}, "pose_columns has 2 values, expected 3"),
        ({"command_pattern": "("}, "command_pattern is not a regular expression"),
        ({"command_pattern": "^a"}, "command_pattern needs a group"),
        ({"wheel_unt": "rpm"}, "unknown key 'wheel_unt'; did you mean 'wheel_unit'"),
        ({"robot": "nowhere.yaml"}, "nowhere.yaml: no such file"),
        ({"robot": {"name": "r", "wheels": [{"name": "a", "angle_deg": "east"}]}}, "angle_deg must be a number"),
        ({"robot": {"name": "r", "wheels": [{"name": "a", "angle": 0, "angle_deg": 0}]}}, "are both given; keep one"),
        ({"train": "rum*"}, r"no run matches 'rum\*'; did you mean 'run1'"),
    ],
)
def test_wrong_options_are_refused_in_one_line(
    tmp_path: Path, recording: Recording, options: dict[str, Any], message: str
) -> None:
    write_run(tmp_path, recording)
    with pytest.raises(ConfigError, match=message) as caught:
        read(tmp_path, **options)
    assert "\n" not in str(caught.value)


def test_a_robot_must_be_given(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="importer 'csv': key 'robot' is missing"):
        import_dataset("csv", tmp_path)
