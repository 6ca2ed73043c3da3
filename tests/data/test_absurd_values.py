"""Values that are numbers, and absurd, are refused in one line and not computed with."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest
import yaml
from commands import flower

from omnibench.config import validate
from omnibench.data.dataset import Trajectory, make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.fit.calibrate import calibrate
from omnibench.live.replay.concatenated_drive import concatenate_runs
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sample_period": 1e-9}, "more than 1e"),
        ({"pose_period": 1e-9}, "more than 1e"),
        ({"repetitions": 10**9}, "more than 1e"),
        ({"train": {"seed": 1, "distance": 1e9}}, "more than 1e"),
        ({"commands": {"speeds": [1e-300], "directions_deg": [0], "turn_rates": [0.0]}}, "more than 1e"),
        ({"noise": {"encoder": 1e300}}, "encoder: .* less than or equal to"),
        ({"train": {"seed": 1, "distance": 1.0, "noise_scale": 1e300}}, "noise_scale: .* less than or equal to"),
        ({"noise": {"pose_position": 1e300}}, "pose_position: .* less than or equal to"),
        (
            {
                "commands": {"speeds": [0.2], "directions_deg": list(range(100_001)), "turn_rates": [0.0]},
                "train": {"seed": 1, "distance": 0.1},
                "validation": None,
            },
            "100001 runs, more than 100000",
        ),
    ],
)
def test_a_simulation_beyond_all_measure_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        validate(FlowerConfig, flower(**changes), "config")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    dataset = simulate_dataset(validate(FlowerConfig, flower(), "config")).dataset
    save_dataset(dataset, tmp_path / "data")
    return tmp_path / "data"


@pytest.mark.parametrize(
    ("far", "message"),
    [(1e200, r"poses.parquet, row 2: x is 1e\+200"), *((far, "the pose at .* m from") for far in (1e9, 1e6, 1e5))],
)
def test_a_pose_beyond_all_reach_or_what_the_wheels_rolled_is_refused(folder: Path, far: float, message: str) -> None:
    table = pl.read_parquet(folder / "poses.parquet")
    moved = pl.when(pl.int_range(pl.len()) == 1).then(far).otherwise(pl.col("x")).alias("x")
    table.with_columns(moved).write_parquet(folder / "poses.parquet")
    with pytest.raises(DataError, match=message):
        load_dataset(folder)


@pytest.mark.parametrize("period", [1e-300, 1e-9, 1e9])
def test_a_sample_period_far_from_that_of_the_stamps_is_refused(folder: Path, period: float) -> None:
    header = yaml.safe_load((folder / "dataset.yaml").read_text())
    (folder / "dataset.yaml").write_text(yaml.safe_dump(header | {"sample_period": period}))
    with pytest.raises(DataError, match=r"sample_period is .* s, but"):
        load_dataset(folder)


@pytest.mark.parametrize("factor", [1e-7, 1e6])
def test_a_sample_period_that_no_calibration_file_takes_is_refused(folder: Path, factor: float) -> None:
    dataset = load_dataset(folder)
    runs = [
        replace(run, times=factor * run.times, rates=run.rates / factor, pose_times=factor * run.pose_times)
        for run in dataset.trajectories
    ]
    with pytest.raises(DataError, match=r"expected 1e-06 to 3600 s"):
        make_dataset("x", dataset.robot, factor * dataset.sample_period, runs)


def test_standstill_between_runs_is_bounded(folder: Path) -> None:
    dataset = load_dataset(folder)
    short = replace(dataset, sample_period=dataset.sample_period / 1000)  # within what is only warned of
    drive = concatenate_runs(short, pause=10.0)
    assert len(drive.wheel_times) < 3 * len(concatenate_runs(dataset, pause=10.0).wheel_times)
    runs = [replace(run, id=str(number)) for number, run in enumerate(dataset.trajectories * 40)]
    with pytest.raises(ConfigError, match=r"more than 10000000"):
        concatenate_runs(replace(dataset, trajectories=tuple(runs)), pause=3600.0)


@pytest.mark.parametrize("shift", [10.0, *(pytest.param(far, marks=pytest.mark.slow) for far in (1e3, 1e4))])
@pytest.mark.parametrize("calibrator", ["closed_form", "trajectory_ml"])
def test_a_pose_that_is_just_believed_gives_an_answer_or_one_line(folder: Path, shift: float, calibrator: str) -> None:
    dataset = load_dataset(folder)
    first, *others = dataset.trajectories
    poses = first.poses.copy()
    poses[-1, 0] += shift
    spoiled = replace(dataset, trajectories=(replace(first, poses=poses), *others))
    with suppress(OmnibenchError):
        calibrate(spoiled, calibrator)


def test_a_run_with_its_start_pose_alone_is_not_written_as_it_could_not_be_read(folder: Path, tmp_path: Path) -> None:
    dataset = load_dataset(folder)
    first, *others = dataset.trajectories
    short = replace(first, pose_times=first.pose_times[:1], poses=first.poses[:1])
    made = make_dataset("d", dataset.robot, dataset.sample_period, [short, *others])
    with pytest.raises(DataError, match=f"trajectory {first.id} has no reference pose after its start"):
        save_dataset(made, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def changed(run: Trajectory, name: str, row: int, value: float) -> Trajectory:
    array = getattr(run, name).copy()
    array[row] = value
    return replace(run, **{name: array})


@pytest.mark.parametrize(
    ("name", "row", "value", "message"),
    [
        ("times", 0, 0.0, "t is 0; wheel samples start after t = 0"),
        ("times", 2, 0.001, "goes backwards: 0.001 after"),
        ("times", 1, float("nan"), "it holds nan"),
        ("rates", 3, float("inf"), "it holds inf"),
        ("rates", 3, 1e10, "it holds 1e+10, which no robot can reach"),
        ("pose_times", 0, 0.01, "has no reference pose at t = 0"),
        ("poses", 1, float("nan"), "it holds nan"),
    ],
)
def test_what_reading_refuses_making_refuses_too(folder: Path, name: str, row: int, value: float, message: str) -> None:
    dataset = load_dataset(folder)
    first, *others = dataset.trajectories
    with pytest.raises(DataError, match=f"trajectory {first.id}.*{re.escape(message)}"):
        make_dataset("d", dataset.robot, dataset.sample_period, [changed(first, name, row, value), *others])


def test_tables_that_can_be_read_in_two_ways_are_refused(folder: Path, tmp_path: Path) -> None:
    save_dataset(load_dataset(folder), tmp_path / "csv", "csv")
    lines = (tmp_path / "csv" / "poses.csv").read_text().splitlines()
    (tmp_path / "csv" / "poses.csv").write_text("".join(f"{line},{line.split(',')[2]}\n" for line in lines))
    with pytest.raises(DataError, match=r"poses.csv: column 'x' is there twice"):
        load_dataset(tmp_path / "csv")
    table = pl.read_parquet(folder / "wheels.parquet")
    table.with_columns(pl.concat_list("trajectory").alias("trajectory")).write_parquet(folder / "wheels.parquet")
    with pytest.raises(DataError, match=r"wheels.parquet: column 'trajectory' holds List"):
        load_dataset(folder)
    pl.read_parquet(folder / "poses.parquet").write_csv(folder / "poses.csv")
    with pytest.raises(DataError, match=r"both poses.parquet and poses.csv are there"):
        load_dataset(folder)


def test_a_sample_period_that_the_stamps_contradict_is_told(folder: Path) -> None:
    dataset = load_dataset(folder)
    assert dataset.warnings == ()
    again = make_dataset("d", dataset.robot, 100 * dataset.sample_period, dataset.trajectories)
    assert any(warning.startswith("sample_period is") for warning in again.warnings)


@pytest.mark.parametrize("item", ["rates", "poses", "targets", "times"])
def test_an_array_of_another_shape_is_refused_with_its_trajectory(folder: Path, item: str) -> None:
    dataset = load_dataset(folder)
    first, *others = dataset.trajectories
    spoiled = replace(first, **{item: getattr(first, item)[:, None]})
    with pytest.raises(DataError, match=f"trajectory {first.id}: .* has shape .*, expected"):
        make_dataset("d", dataset.robot, dataset.sample_period, [spoiled, *others])
