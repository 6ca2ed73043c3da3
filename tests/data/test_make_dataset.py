"""make_dataset on arrays and tables, division into training and validation, and the logs of its runs."""

import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from commands import flower, refused
from lanes import slow
from sample_robots import APR_02, DIFFERENTIAL, TRICYCLE
from storage_samples import a_trajectory
from wheeled_samples import driven

import omnibench
from omnibench.config import validate
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.recording_options import ReferenceOptions
from omnibench.data.runs import division_in_words
from omnibench.data.splits import divided
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.fit.calibrate import calibrate
from omnibench.live.drive import concatenate_runs
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

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
    dataset = omnibench.make_dataset("day1", DIFFERENTIAL, wheels=wheels(), poses=poses())
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
    ours = omnibench.make_dataset("day1", DIFFERENTIAL, 0.02, wheels=frame(wheels()), poses=frame(poses()))
    assert ours.hash == omnibench.make_dataset("day1", DIFFERENTIAL, 0.02, wheels=wheels(), poses=poses()).hash


def test_a_table_of_runs_says_splits_and_commands() -> None:
    runs = {"trajectory": ["r1", "r2"], "split": ["validation", "train"], "command": ["a", "b"]}
    dataset = omnibench.make_dataset("day1", DIFFERENTIAL, trajectories=runs, wheels=wheels(), poses=poses())
    assert [(run.split, run.command) for run in dataset.trajectories] == [("validation", "a"), ("train", "b")]


def test_tables_of_one_run_need_no_name() -> None:
    one = {name: values[:100] for name, values in wheels().items() if name != "trajectory"}
    pose = {name: values[:2] for name, values in poses().items() if name != "trajectory"}
    (run,) = omnibench.make_dataset("day1", DIFFERENTIAL, wheels=one, poses=pose).trajectories
    assert (run.split, len(run.times)) == ("train", 100)


def test_references_take_the_place_of_poses() -> None:
    tape = {"trajectory": ["r1", "r2"], "kind": ["distance"] * 2, "value": [0.42, 0.41], "sigma": [0.002, 0.002]}
    dataset = omnibench.make_dataset("day1", DIFFERENTIAL, wheels=wheels(), references=tape)
    assert all(run.references is not None for run in dataset.trajectories)


def test_runs_may_hold_lists() -> None:
    run = driven(DIFFERENTIAL).trajectories[0]
    lists = replace(run, times=run.times.tolist(), rates=run.rates.tolist(), poses=run.poses.tolist())
    made = omnibench.make_dataset("day1", DIFFERENTIAL, 0.1, [lists])
    assert made.hash == omnibench.make_dataset("day1", DIFFERENTIAL, 0.1, [run]).hash


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
    with refused(DataError, match=message):
        omnibench.make_dataset("day1", DIFFERENTIAL, **tables)


def test_values_of_wheels_without_their_robot_are_refused_as_it_is_missing() -> None:
    with pytest.raises(ConfigError, match="options: key 'robot' is missing"):
        validate(ReferenceOptions, {"wheels": {"left": {"y": 0.12}}}, "options")


def test_a_table_in_the_place_of_runs_is_named() -> None:
    runs: Any = [{"times": T}]
    with pytest.raises(DataError, match=r"of type dict; .* wheels= and poses="):
        omnibench.make_dataset("day1", DIFFERENTIAL, 0.02, runs)


def test_units_that_cannot_be_right_are_warned_of_as_those_of_files_are() -> None:
    degrees = poses(theta=[0, 90, 0, 90.0], x=[0, 420.0, 0, 420.0])
    assert omnibench.make_dataset("day1", DIFFERENTIAL, wheels=wheels(), poses=degrees).warnings


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
    words = division_in_words(APR_02, divided(RUNS, (), ()), {})
    assert words.startswith("training 3 runs of 2 commands, validation 1 run of 1 command, every second run")
    named = division_in_words(APR_02, divided(RUNS, (), ("b",)), {"validation": "b"})
    assert named == "training 3 runs of 2 commands, validation 1 run of 1 command, by validation=b"
    own = division_in_words(APR_02, divided(RUNS, (), (), otherwise=["validation"] * 4), {})
    assert own == "training 0 runs, validation 4 runs of 2 commands, as the source or its importer says"


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


# Values that are numbers, and absurd, are refused in one line and not computed with.


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
        (
            {"repetitions": 16_667, "train": {"seed": 1, "distance": 0.1}, "validation": None},
            "100002 runs, more than 100000",
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


@pytest.fixture
def dataset(folder: Path) -> Dataset:
    return load_dataset(folder)


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
def test_a_sample_period_that_no_calibration_file_takes_is_refused(factor: float, dataset: Dataset) -> None:
    runs = [
        replace(run, times=factor * run.times, rates=run.rates / factor, pose_times=factor * run.pose_times)
        for run in dataset.trajectories
    ]
    with pytest.raises(DataError, match=r"expected 1e-06 to 3600 s"):
        make_dataset("x", dataset.robot, factor * dataset.sample_period, runs)


def test_standstill_between_runs_is_bounded(dataset: Dataset) -> None:
    short = replace(dataset, sample_period=dataset.sample_period / 1000)  # within what is only warned of
    drive = concatenate_runs(short, pause=10.0)
    assert len(drive.wheel_times) < 3 * len(concatenate_runs(dataset, pause=10.0).wheel_times)
    runs = [replace(run, id=str(number)) for number, run in enumerate(dataset.trajectories * 40)]
    with pytest.raises(ConfigError, match=r"more than 10000000"):
        concatenate_runs(replace(dataset, trajectories=tuple(runs)), pause=3600.0)


@pytest.mark.parametrize("shift", [10.0, *slow(1e3, 1e4)])
@pytest.mark.parametrize("calibrator", ["closed_form", "map"])
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


def test_a_sample_period_that_the_stamps_contradict_is_told(dataset: Dataset) -> None:
    assert dataset.warnings == ()
    again = make_dataset("d", dataset.robot, 100 * dataset.sample_period, dataset.trajectories)
    assert any(warning.startswith("sample_period is") for warning in again.warnings)


@pytest.mark.parametrize("item", ["rates", "poses", "targets", "times"])
def test_an_array_of_another_shape_is_refused_with_its_trajectory(item: str, dataset: Dataset) -> None:
    first, *others = dataset.trajectories
    spoiled = replace(first, **{item: getattr(first, item)[:, None]})
    with pytest.raises(DataError, match=f"trajectory {first.id}: .* has shape .*, expected"):
        make_dataset("d", dataset.robot, dataset.sample_period, [spoiled, *others])
