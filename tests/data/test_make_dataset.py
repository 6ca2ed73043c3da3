"""make_dataset on arrays and tables, division into training and validation, and the logs of its runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
import pytest
from storage_samples import a_trajectory
from wheeled_samples import DIFF, TRICYCLE, driven

import omnibench
from omnibench.data.dataset import Trajectory
from omnibench.data.splits import divided, division_in_words
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


class Frame:
    """A data frame as pandas has it: columns, and a column by its name."""

    def __init__(self, columns: dict[str, Any]) -> None:
        self._columns = {name: np.array(values, dtype=object) for name, values in columns.items()}

    @property
    def columns(self) -> list[str]:
        return list(self._columns)

    def __getitem__(self, name: str) -> Any:
        return self._columns[name]


@pytest.mark.parametrize("frame", [pl.DataFrame, Frame])
def test_data_frames_and_dicts_of_columns_give_the_same(frame: Any) -> None:
    ours = omnibench.make_dataset("day1", DIFF, 0.02, wheels=frame(wheels()), poses=frame(poses()))
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
        ({"wheels": {"t": T, "omega_right": T}}, "^wheels: columns 'trajectory' and 'omega_left' are missing"),
        ({"wheels": wheels() | {"omega_left": ["fast"] * 200}}, "^wheels, row 1: omega_left is 'fast'"),
        ({"wheels": wheels(omega_left=np.ones(3))}, "^wheels: column 'omega_left' has 3 rows, 'trajectory' has 200"),
        ({"wheels": wheels(omega_left=np.ones((200, 2)))}, r"^wheels: column 'omega_left' has shape \(200, 2\)"),
        ({"wheels": wheels(t=np.tile(T, 2) + 1.7e9)}, "^wheels, row 1: t is 1.7e.09"),
        ({"wheels": [1, 2]}, "^wheels: .*found list"),
        ({"poses": poses(t=[0.1, 2, 0, 2])}, "^poses, row 1: trajectory r1 has no reference pose at t = 0"),
        ({"poses": poses(trajectory=["r1", "r1", "r3", "r3"])}, "^poses, row 3: trajectory r3 is not in trajectories"),
        ({"trajectories": {"trajectory": ["r1", "r2"], "split": ["train", "val"]}}, "^trajectories, row 2: split is"),
        ({"wheels": None}, "wheels is missing: .* omega_<wheel>"),
        ({"poses": None}, "poses is missing: .*theta; or references"),
        ({"sample_period": "20 ms"}, "sample_period is '20 ms'"),
    ],
)
def test_a_flaw_is_refused_with_its_table_row_and_column(given: dict[str, Any], message: str) -> None:
    tables: dict[str, Any] = {"wheels": wheels(), "poses": poses()} | given
    with pytest.raises(DataError, match=message) as refused:
        omnibench.make_dataset("day1", DIFF, **tables)
    assert "\n" not in str(refused.value)


def test_a_table_in_the_place_of_runs_is_named() -> None:
    runs: Any = [{"times": T}]
    with pytest.raises(DataError, match=r"of type dict; .* wheels= and poses="):
        omnibench.make_dataset("day1", DIFF, 0.02, runs)


def test_units_that_cannot_be_right_are_warned_of_as_those_of_files_are() -> None:
    degrees = poses(theta=[0, 90, 0, 90.0], x=[0, 420.0, 0, 420.0])
    assert omnibench.make_dataset("day1", DIFF, wheels=wheels(), poses=degrees).warnings


def run(name: str, command: str | None) -> Trajectory:
    return Trajectory(name, "train", np.ones(1), np.ones((1, 3)), np.arange(2.0), np.zeros((2, 3)), command=command)


RUNS = [run("a", "left"), run("b", "left"), run("c", "right"), run("d", None)]


def test_every_second_run_of_a_command_validates_and_its_repetitions_are_numbered() -> None:
    runs = divided(RUNS, (), ())
    assert [each.split for each in runs] == ["train", "validation", "train", "train"]
    assert [each.repetition for each in runs] == [1, 2, 1, None]


def test_patterns_of_both_sides_leave_out_the_runs_of_neither() -> None:
    runs = divided(RUNS, ("a",), ("[bc]",))
    assert [(each.id, each.split) for each in runs] == [("a", "train"), ("b", "validation"), ("c", "validation")]


def test_patterns_may_be_of_other_names_and_go_before_the_splits_given() -> None:
    groups = ["x", "x", "y", "y"]
    assert [each.split for each in divided(RUNS, ("y",), (), "group", names=groups)].count("train") == 2
    assert {each.split for each in divided(RUNS, (), (), otherwise=["validation"] * 4)} == {"validation"}
    assert {each.split for each in divided(RUNS, ("*",), (), otherwise=["validation"] * 4)} == {"train"}


def test_a_division_says_how_many_runs_and_commands_each_side_has_and_by_what() -> None:
    words = division_in_words(divided(RUNS, (), ()), {})
    assert words.startswith("training 3 runs of 2 commands, validation 1 run of 1 command, every second run")
    named = division_in_words(divided(RUNS, (), ("b",)), {"validation": "b"})
    assert named == "training 3 runs of 2 commands, validation 1 run of 1 command, by validation=b"
    own = division_in_words(divided(RUNS, (), (), otherwise=["validation"] * 4), {})
    assert own == "training 0 runs, validation 4 runs of 2 commands, by the importer's own rule"


RUN = a_trajectory("1", 0.5, session="morning", started_at=60.0, angles=np.ones((4, 3)))


def test_a_log_has_all_that_effects_need() -> None:
    log = RUN.log([0.15])
    assert log.times is RUN.times
    assert log.rates is RUN.rates
    assert log.wheel_angles is RUN.angles
    assert (log.started_at, log.session) == (60.0, "morning")
    np.testing.assert_array_equal(log.start, RUN.poses[0])
    np.testing.assert_array_equal(log.stamps, [0.15])


def test_logs_up_to_the_reference_have_it_too() -> None:
    for log, stamps in ((RUN.final_log, [0.4]), (RUN.reference_log, [0.2, 0.4])):
        assert log.wheel_angles is RUN.angles
        np.testing.assert_array_equal(log.stamps, stamps)


def test_what_is_not_known_of_a_trajectory_is_not_in_its_log() -> None:
    log = replace(RUN, angles=None, started_at=None, session=None).log([0.1])
    assert (log.wheel_angles, log.started_at, log.session) == (None, None, None)
