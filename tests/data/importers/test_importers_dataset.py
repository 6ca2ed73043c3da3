"""The importer of data sets, which mends what is wrong with them, and joining the data sets of one robot."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from drive_samples import DIFF, PERIOD, Drive, dataset, drive, odometry_error, trajectory

from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.splits import joined
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.robot.kinematics import Robot
from omnibench.slam.import_dataset import import_dataset

FITS = 0.03  # m: noise of the start's heading over the way of a drive
Fault = Callable[[Drive], Drive]


def saved(folder: Path, *drives: Drive) -> Path:
    """A data set folder with these drives, as they are."""
    save_dataset(dataset(*(trajectory(f"run{number}", of) for number, of in enumerate(drives, 1))), folder)
    return folder


def again(folder: Path, **options: Any) -> Dataset:
    return import_dataset("dataset", folder, options)


def rates(factor: float | list[float]) -> Fault:
    return lambda of: replace(of, rates=of.rates * factor)


def poses(factor: list[float]) -> Fault:
    return lambda of: replace(of, poses=of.poses * factor)


def test_a_data_set_read_again_without_options_is_the_same(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no dataset\.yaml"):
        again(tmp_path)
    first = saved(tmp_path / "data", drive(1), drive(2))
    assert again(first).hash == load_dataset(first).hash


@pytest.mark.parametrize(
    ("fault", "options"),
    [
        (rates([-1, 1]), {"wheel_signs": [-1, 1]}),
        (lambda of: replace(of, rates=of.rates[:, ::-1]), {"wheel_columns": ["omega_right", "omega_left"]}),
        (lambda of: replace(of, rates=of.rates[:, ::-1]), {"wheel_columns": ["right", "left"]}),
        (rates(60 / (2 * np.pi)), {"wheel_unit": "rpm"}),
        (rates(1000 / (2 * np.pi)), {"wheel_unit": "ticks/s", "ticks_per_turn": 1000}),
        (rates(4), {"gear_ratio": 4}),
        (rates([1, 30]), {"gear_ratio": [1, 30]}),
        (poses([1000, 1000, 1]), {"position_unit": "mm"}),
        (poses([1, -1, -1]), {"pose_signs": [1, -1, -1]}),
        (lambda of: replace(of, poses=of.poses[:, [1, 0, 2]]), {"pose_columns": ["y", "x", "theta"]}),
        (lambda of: replace(of, poses=of.poses + np.array([0, 0, 0.5])), {"heading_offset_deg": -np.degrees(0.5)}),
        (lambda of: replace(of, poses=np.roll(of.poses, 5, axis=0)), {"pose_time_offset": -0.5}),
        (lambda of: replace(of, poses=np.roll(of.poses, 5, axis=0)), {"clocks": "match"}),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_an_option_mends_what_is_wrong(tmp_path: Path, fault: Fault, options: dict[str, Any]) -> None:
    folder = saved(tmp_path / "data", fault(drive(1)), fault(drive(2)))
    assert odometry_error(load_dataset(folder)) > 3 * FITS
    assert odometry_error(again(folder, **options)) < FITS


def test_headings_in_degrees_are_read_as_they_stand_in_the_table(tmp_path: Path) -> None:
    folder = saved(tmp_path / "data", drive(1), drive(2))
    table = pl.read_parquet(folder / "poses.parquet")
    wrapped = (table["theta"].degrees() + 180) % 360 - 180
    table.with_columns(theta=wrapped).write_parquet(folder / "poses.parquet")
    assert odometry_error(again(folder, heading_unit="deg")) < FITS


def in_ms(file: Path) -> None:
    table = pl.read_parquet(file)
    table.with_columns(t=table["t"] * 1000).write_parquet(file)


def test_times_in_ms_are_read_as_such_and_rates_stay(tmp_path: Path) -> None:
    folder = saved(tmp_path / "data", drive(1), drive(2))
    first = load_dataset(folder)
    in_ms(folder / "poses.parquet")
    assert odometry_error(again(folder, pose_time_unit="ms")) < FITS
    in_ms(folder / "wheels.parquet")
    data = again(folder, wheel_time_unit="ms", pose_time_unit="ms", sample_period=first.sample_period)
    for run, old in zip(data.trajectories, first.trajectories, strict=True):
        assert run.times == pytest.approx(old.times)
        assert run.pose_times == pytest.approx(old.pose_times)
        assert run.rates == pytest.approx(old.rates)


def test_matched_clocks_are_said_run_by_run(tmp_path: Path) -> None:
    late = drive(1)
    late = replace(late, poses=np.roll(late.poses, 5, axis=0))
    (note, *_) = again(saved(tmp_path / "data", late, drive(2)), clocks="match").warnings
    assert note.startswith("clocks matched, added to the times of the poses: run1 -0.5")
    assert "run2 " in note


def test_a_run_is_cut_where_the_reference_jumps(tmp_path: Path) -> None:
    whole = drive(1)
    jumped = whole.poses + np.array([[0.4, 0, 0]]) * (whole.pose_times > 10.05)[:, None]
    data = again(saved(tmp_path / "data", replace(whole, poses=jumped), drive(2)), jumps="cut")
    assert [run.id for run in data.trajectories] == ["run1#1", "run1#2", "run2"]
    first, second = data.trajectories[:2]
    assert (first.session, first.started_at) == ("run1", 0.0)
    assert (second.session, second.started_at) == ("run1", pytest.approx(10.1))
    assert odometry_error(data) < FITS


def test_a_run_is_cut_at_long_gaps_of_wheels_and_of_poses(tmp_path: Path) -> None:
    whole = drive(1)
    seen = (whole.pose_times < 5) | (whole.pose_times > 7)
    shown = (whole.times < 12) | (whole.times > 13)
    holed = Drive(whole.times[shown], whole.rates[shown], whole.pose_times[seen], whole.poses[seen])
    data = again(saved(tmp_path / "data", holed), longest_gap=0.5)
    spans = [(round(run.started_at or 0.0, 1), round(run.times[-1], 1)) for run in data.trajectories]
    assert [run.id for run in data.trajectories] == ["run1#1", "run1#2", "run1#3"]
    assert spans[0][1] <= 5.0
    assert spans[1][0] >= 7.0
    assert spans[2][0] >= 13.0
    assert odometry_error(data) < FITS


def test_a_run_begins_at_rest_if_wanted(tmp_path: Path) -> None:
    data = again(saved(tmp_path / "data", drive(1), drive(2)), start_at_rest=True)
    moving = [run.times[np.abs(run.rates).max(axis=1) > 0.05][0] for run in data.trajectories]
    assert all(0.3 < time < 0.7 for time in moving)
    assert odometry_error(data) < FITS
    driving = replace(drive(1), rates=drive(1).rates + 1.0)
    data = again(saved(tmp_path / "driving", driving, drive(2)), start_at_rest=True)
    assert [run.id for run in data.trajectories] == ["run2"]
    assert "1 run left out" in data.warnings[0]


def test_runs_are_left_out_by_patterns(tmp_path: Path) -> None:
    folder = saved(tmp_path / "data", drive(1), drive(2), drive(3))
    assert [run.id for run in again(folder, leave_out="*2").trajectories] == ["run1", "run3"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"wheel_columns": ["a", "b"]}, "no wheel 'a'; found: left, right"),
        ({"wheel_columns": ["left", "left"]}, "wheel_columns names one wheel twice"),
        ({"wheel_unit": "ticks", "ticks_per_turn": 4}, "ticks/s"),
        ({"pose_columns": ["x", "x", "theta"]}, "x, y and theta"),
        ({"pose_signs": [1, -1]}, "pose_signs has 2 values, expected 3"),
        ({"leave_out": "run9"}, "leave_out: .*'run9'; did you mean 'run"),
        ({"leave_out": "run*"}, "leave_out: every run matches"),
    ],
)
def test_wrong_options_are_refused_in_one_line(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        again(saved(tmp_path / "data", drive(1)), **options)


def test_a_data_set_keeps_how_it_was_imported(tmp_path: Path) -> None:
    folder = saved(tmp_path / "data", drive(1))
    save_dataset(again(folder, wheel_signs=[1, -1]), tmp_path / "new")
    loaded = load_dataset(tmp_path / "new")
    how = {"importer": "dataset", "source": str(folder), "options": {"wheel_signs": [1, -1]}}
    assert loaded.imported.model_dump() == how
    assert loaded.hash == replace(loaded, imported=None).hash
    assert load_dataset(folder).imported is None


def recording(seed: int, **changes: str) -> Dataset:
    """A recording of one run, ``run1``."""
    return replace(dataset(replace(trajectory("run1", drive(seed)), **changes)), name=f"day{seed}")


def test_runs_and_sessions_of_the_same_name_stay_apart() -> None:
    both = joined(recording(1, session="s1"), [recording(2, session="s1"), recording(3)])
    assert [run.id for run in both.trajectories] == ["run1", "day2/run1", "day3/run1"]
    assert [run.session for run in both.trajectories] == ["s1", "day2/s1", "day3"]
    assert both.name == "day1"


def test_splits_and_numbers_stay() -> None:
    first, second = recording(1), recording(2, split="validation")
    both = joined(first, [second])
    assert [run.split for run in both.trajectories] == ["train", "validation"]
    assert both.trajectories[1].fingerprint == second.trajectories[0].fingerprint


def test_another_robot_and_other_samples_are_refused() -> None:
    wide = {**DIFF, "wheels": [{**wheel, "y": 1.1 * wheel["y"]} for wheel in DIFF["wheels"]]}
    other = make_dataset("wide", Robot.model_validate(wide), PERIOD, recording(2).trajectories)
    with pytest.raises(DataError, match="its robot is not that of day1"):
        joined(recording(1), [other])
    other = make_dataset("slow", recording(1).robot, 1.5 * PERIOD, recording(2).trajectories)
    with pytest.raises(DataError, match=r"every 0.03 s"):
        joined(recording(1), [other])


def test_data_sets_are_joined_as_one_is_read_again(tmp_path: Path) -> None:
    for seed in (1, 2):
        save_dataset(recording(seed), tmp_path / f"day{seed}")
    both = import_dataset("dataset", tmp_path / "day1", {"name": "both", "join": str(tmp_path / "day2")})
    save_dataset(both, tmp_path / "both")
    assert [run.id for run in load_dataset(tmp_path / "both").trajectories] == ["run1", "day2/run1"]
