"""make_dataset on arrays, dicts of columns and data frames: the same checks as for files."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
import pytest
from wheeled_samples import DIFF, TRICYCLE, driven

import omnibench
from omnibench.errors import DataError

T = np.arange(1, 101) * 0.02


def wheels(**changes: Any) -> dict[str, Any]:
    """Two runs of a robot that drives straight on at 0.21 m/s."""
    columns = {"trajectory": np.repeat(["r1", "r2"], 100), "t": np.tile(T, 2)}
    rates = np.r_[np.full(100, 5.0), np.full(100, 5.01)]
    return columns | {f"omega_{wheel}": rates for wheel in ("right", "left")} | changes


def poses(**changes: Any) -> dict[str, Any]:
    columns = {"trajectory": np.array(["r1", "r1", "r2", "r2"]), "t": np.array([0.0, 2, 0, 2])}
    columns |= {"x": np.array([0, 0.42, 0, 0.42]), "y": np.zeros(4), "theta": np.zeros(4)}
    return columns | changes


def test_tables_of_columns_become_runs() -> None:
    dataset = omnibench.make_dataset("day1", DIFF, wheels=wheels(), poses=poses())
    assert [run.id for run in dataset.trajectories] == ["r1", "r2"]
    assert [run.split for run in dataset.trajectories] == ["train", "validation"]
    assert dataset.sample_period == 0.02
    np.testing.assert_array_equal(dataset.trajectories[1].rates, 5.01)
    assert dataset.warnings == ()


def test_data_frames_of_polars_and_dicts_give_the_same() -> None:
    ours = omnibench.make_dataset("day1", DIFF, 0.02, wheels=pl.DataFrame(wheels()), poses=pl.DataFrame(poses()))
    assert ours.hash == omnibench.make_dataset("day1", DIFF, 0.02, wheels=wheels(), poses=poses()).hash


class Frame:
    """A data frame as pandas has it: columns, and a column by its name."""

    def __init__(self, columns: dict[str, Any]) -> None:
        self._columns = {name: np.array(values, dtype=object) for name, values in columns.items()}

    @property
    def columns(self) -> list[str]:
        return list(self._columns)

    def __getitem__(self, name: str) -> Any:
        return self._columns[name]


def test_a_data_frame_that_is_not_polars_is_read_by_its_columns() -> None:
    ours = omnibench.make_dataset("day1", DIFF, 0.02, wheels=Frame(wheels()), poses=Frame(poses()))
    assert ours.hash == omnibench.make_dataset("day1", DIFF, 0.02, wheels=wheels(), poses=poses()).hash


def test_a_table_of_runs_says_splits_and_commands() -> None:
    runs = {"trajectory": ["r1", "r2"], "split": ["validation", "train"], "command": ["a", "b"]}
    dataset = omnibench.make_dataset("day1", DIFF, trajectories=runs, wheels=wheels(), poses=poses())
    assert [(run.split, run.command) for run in dataset.trajectories] == [("validation", "a"), ("train", "b")]


def test_tables_of_one_run_need_no_name() -> None:
    one = {name: values[:100] for name, values in wheels().items() if name != "trajectory"}
    pose = {name: values[:2] for name, values in poses().items() if name != "trajectory"}
    (run,) = omnibench.make_dataset("day1", DIFF, wheels=one, poses=pose).trajectories
    assert (run.split, len(run.times)) == ("train", 100)


def test_references_take_the_place_of_poses() -> None:
    tape = {"trajectory": ["r1", "r2"], "kind": ["distance"] * 2, "value": [0.42, 0.41], "sigma": [0.002, 0.002]}
    dataset = omnibench.make_dataset("day1", DIFF, wheels=wheels(), references=tape)
    assert all(run.references is not None for run in dataset.trajectories)


def test_runs_may_hold_lists() -> None:
    run = driven(DIFF).trajectories[0]
    lists = replace(run, times=run.times.tolist(), rates=run.rates.tolist(), poses=run.poses.tolist())
    made = omnibench.make_dataset("day1", DIFF, 0.1, [lists])
    assert made.hash == omnibench.make_dataset("day1", DIFF, 0.1, [run]).hash


def test_the_angle_of_a_steered_wheel_is_a_column() -> None:
    dataset = driven(TRICYCLE)
    tables = {name: dataset.to_frame(name) for name in ("trajectories", "wheels", "poses")}
    assert omnibench.make_dataset("day1", TRICYCLE, dataset.sample_period, **tables).hash == dataset.hash
    with pytest.raises(DataError, match="wheels: column 'steer_front', the steering angle of wheel front"):
        omnibench.make_dataset("day1", TRICYCLE, wheels=tables["wheels"].drop("steer_front"), poses=tables["poses"])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"wheels": wheels(t=np.full(200, 1.0))}, "^wheels, row 2: t is repeated: 1 after 1"),
        ({"wheels": wheels(omega_left=np.r_[5.0, np.nan, np.full(198, 5.0)])}, "^wheels, row 2: omega_left is nan"),
        (
            {"wheels": {"t": T, "omega_right": T}},
            "^wheels: columns 'trajectory' and 'omega_left' are missing",
        ),
        ({"wheels": wheels() | {"omega_left": ["fast"] * 200}}, "^wheels, row 1: omega_left is 'fast', expected a nu"),
        ({"wheels": wheels(omega_left=np.ones(3))}, "^wheels: column 'omega_left' has 3 rows, 'trajectory' has 200"),
        ({"wheels": wheels(omega_left=np.ones((200, 2)))}, r"^wheels: column 'omega_left' has shape \(200, 2\)"),
        (
            {"wheels": wheels(t=np.tile(T, 2) + 1.7e9)},
            "^wheels, row 1: t is 1.7e.09, .*; count the time from the",
        ),
        ({"wheels": [1, 2]}, "^wheels: expected a data frame or a dict of arrays, found list"),
        ({"poses": poses(t=[0.1, 2, 0, 2])}, "^poses, row 1: trajectory r1 has no reference pose at t = 0"),
        ({"poses": poses(trajectory=["r1", "r1", "r3", "r3"])}, "^poses, row 3: trajectory r3 is not in trajectories"),
        ({"trajectories": {"trajectory": ["r1", "r2"], "split": ["train", "val"]}}, "^trajectories, row 2: split is"),
        ({"wheels": None}, "wheels is missing: a table with the columns t and omega_<wheel>"),
        ({"poses": None}, "poses is missing: a table with the columns t, x, y and theta; or references"),
        ({"sample_period": "20 ms"}, "sample_period is '20 ms', expected a number of seconds"),
    ],
)
def test_a_flaw_is_refused_with_its_table_row_and_column(given: dict[str, Any], message: str) -> None:
    tables: dict[str, Any] = {"wheels": wheels(), "poses": poses()} | given
    with pytest.raises(DataError, match=message) as refused:
        omnibench.make_dataset("day1", DIFF, **tables)
    assert "\n" not in str(refused.value)


def test_a_table_in_the_place_of_runs_is_named() -> None:
    runs: Any = [{"times": T}]
    with pytest.raises(DataError, match="a trajectory is of type dict; of tables give wheels= and poses=, too"):
        omnibench.make_dataset("day1", DIFF, 0.02, runs)


def test_units_that_cannot_be_right_are_warned_of_as_those_of_files_are() -> None:
    degrees = poses(theta=[0, 90, 0, 90.0], x=[0, 420.0, 0, 420.0])
    assert omnibench.make_dataset("day1", DIFF, wheels=wheels(), poses=degrees).warnings
