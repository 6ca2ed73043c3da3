"""Values that are numbers, and absurd, are refused in one line and not computed with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from commands import flower

from omnibench.config import validate
from omnibench.data.dataset import make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset


@pytest.mark.parametrize(
    "changes",
    [
        {"sample_period": 1e-9},
        {"pose_period": 1e-9},
        {"repetitions": 10**9},
        {"train": {"seed": 1, "distance": 1e9}},
        {"commands": {"speeds": [1e-300], "directions_deg": [0], "turn_rates": [0.0]}},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_a_simulation_beyond_all_measure_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="wheel samples and poses, more than 1e"):
        validate(FlowerConfig, flower(**changes), "config")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    dataset = simulate_dataset(validate(FlowerConfig, flower(), "config")).dataset
    save_dataset(dataset, tmp_path / "data")
    return tmp_path / "data"


def test_a_pose_that_no_robot_can_reach_is_refused_with_its_row(folder: Path) -> None:
    table = pl.read_parquet(folder / "poses.parquet")
    moved = pl.when(pl.int_range(pl.len()) == 1).then(1e200).otherwise(pl.col("x")).alias("x")
    table.with_columns(moved).write_parquet(folder / "poses.parquet")
    with pytest.raises(DataError, match=r"poses.parquet, row 2: x is 1e\+200, which no robot can reach"):
        load_dataset(folder)


def test_a_table_in_both_formats_is_refused(folder: Path) -> None:
    pl.read_parquet(folder / "poses.parquet").write_csv(folder / "poses.csv")
    with pytest.raises(DataError, match=r"both poses.parquet and poses.csv are there; remove the one"):
        load_dataset(folder)


def test_a_column_of_lists_is_refused(folder: Path) -> None:
    table = pl.read_parquet(folder / "wheels.parquet")
    table.with_columns(pl.concat_list("trajectory").alias("trajectory")).write_parquet(folder / "wheels.parquet")
    with pytest.raises(DataError, match=r"wheels.parquet: column 'trajectory' holds List"):
        load_dataset(folder)


def test_a_csv_column_that_is_there_twice_is_refused(folder: Path) -> None:
    save_dataset(load_dataset(folder), folder, "csv")
    lines = (folder / "poses.csv").read_text().splitlines()
    doubled = [f"{line},{line.split(',')[2]}" for line in lines]
    (folder / "poses.csv").write_text("\n".join(doubled) + "\n")
    with pytest.raises(DataError, match=r"poses.csv: column 'x' is there twice"):
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
