"""Data sets on disk: what is read comes back, and everything that cannot be right is refused in one line."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl
import pytest
import yaml

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.robot.kinematics import Robot, Wheel, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

Format = Literal["parquet", "csv"]
FORMATS: tuple[Format, ...] = ("parquet", "csv")
ROBOT = Robot(
    name="APR-02",
    wheels=tuple(
        Wheel(name=name, radius=0.148, distance=0.195, angle=math.radians(angle))
        for name, angle in zip("abc", (60, 180, 300), strict=True)
    ),
)


def a_trajectory(identity: str, turn: float, **known: Any) -> Trajectory:
    """Four samples of 0.1 s as the design drives them; poses at 0, 0.2 and 0.4 s."""
    times = 0.1 * np.arange(1, 5)
    rates = np.tile(wheel_equations(ROBOT.wheels) @ [0.2, 0.1, turn], (4, 1))
    stamps = np.array([0.0, 0.2, 0.4])
    start = np.array([1 / 3, -0.2, 1.0])
    (poses,) = OdometryModel.of_design(ROBOT, "arc").poses([WheelLog(times, rates, start, stamps)])
    defaults: dict[str, Any] = {"split": "train"}
    return Trajectory(identity, times=times, rates=rates, pose_times=stamps, poses=poses, **(defaults | known))


def everything_known() -> Dataset:
    """Two runs of which nothing is unknown; the second validates."""
    runs = []
    for number, (identity, turn) in enumerate((("run-1", 0.5), ("run-2", -0.3)), 1):
        run = a_trajectory(identity, turn)
        covariance = np.random.default_rng(number).normal(size=(3, 3, 3))
        runs.append(
            replace(
                run,
                split="train" if number == 1 else "validation",
                command=f"w{turn}",
                repetition=number,
                session="morning",
                started_at=12.5 * number,
                v=0.2,
                alpha=math.radians(30),
                omega=turn,
                duration=0.4,
                distance=0.08,
                angles=np.cumsum(run.rates * 0.1, axis=0),
                targets=run.rates + 0.01,
                pose_covariances=covariance @ np.swapaxes(covariance, 1, 2),
            )
        )
    return make_dataset(
        "two runs",
        ROBOT,
        0.1,
        runs,
        description="as designed; with commas, 'quotes' and ü",
        source="a test",
        licence="MIT",
        simulated=True,
    )


def table_file(folder: Path, name: str) -> Path:
    return next(file for file in folder.iterdir() if file.stem == name)


def read_frame(folder: Path, name: str) -> pl.DataFrame:
    file = table_file(folder, name)
    return pl.read_csv(file) if file.suffix == ".csv" else pl.read_parquet(file)


def write_frame(folder: Path, name: str, frame: pl.DataFrame) -> None:
    file = table_file(folder, name)
    frame.write_csv(file) if file.suffix == ".csv" else frame.write_parquet(file)


Change = Callable[[Path], object]


def set_cell(name: str, row: int, column: str, value: Any) -> Change:
    """Overwrite a cell; rows count from 1, as messages do."""

    def change(folder: Path) -> None:
        frame = read_frame(folder, name)
        values = frame[column].to_list()
        values[row - 1] = value
        typed = pl.Series(column, [str(v) for v in values] if isinstance(value, str) else values)
        write_frame(folder, name, frame.with_columns(typed))

    return change


def with_frame(name: str, edit: Callable[[pl.DataFrame], pl.DataFrame]) -> Change:
    return lambda folder: write_frame(folder, name, edit(read_frame(folder, name)))


def drop_column(name: str, column: str) -> Change:
    return with_frame(name, lambda frame: frame.drop(column))


def drop_rows(name: str, *rows: int) -> Change:
    return with_frame(name, lambda frame: frame[[i for i in range(len(frame)) if i + 1 not in rows]])


def rename(name: str, old: str, new: str) -> Change:
    return with_frame(name, lambda frame: frame.rename({old: new}))


def remove_file(name: str) -> Change:
    return lambda folder: table_file(folder, name).unlink()


def overwrite(name: str, content: bytes) -> Change:
    return lambda folder: table_file(folder, name).write_bytes(content)


def header(key: str, value: Any) -> Change:
    def change(folder: Path) -> None:
        content = yaml.safe_load((folder / "dataset.yaml").read_text())
        content = {**content, key: value} if value is not None else {k: v for k, v in content.items() if k != key}
        (folder / "dataset.yaml").write_text(yaml.safe_dump(content))

    return change


# In wheels, rows 1 to 4 are run-1's and 5 to 8 are run-2's; in poses 1 to 3 and 4 to 6.
# What is done, the file and perhaps the row that the message must name, and what it must say.
REFUSED: dict[str, tuple[Change, str, str]] = {
    "a wheel column is missing": (
        rename("wheels", "omega_b", "omega_bb"),
        "wheels.{x}: ",
        "column 'omega_b' is missing; did you mean 'omega_bb'? found: trajectory, t, omega_a",
    ),
    "a time column is missing": (drop_column("wheels", "t"), "wheels.{x}: ", "column 't' is missing"),
    "a pose column is missing": (rename("poses", "theta", "thetaa"), "poses.{x}: ", "did you mean 'thetaa'?"),
    "the ids are missing": (drop_column("poses", "trajectory"), "poses.{x}: ", "column 'trajectory' is missing"),
    "the split is missing": (drop_column("trajectories", "split"), "trajectories.{x}: ", "column 'split' is missing"),
    "one of the wheel angles is missing": (
        drop_column("wheels", "phi_b"),
        "wheels.{x}: ",
        "column 'phi_b' is missing; give all of phi_a, phi_b, phi_c or none",
    ),
    "one of the covariances is missing": (drop_column("poses", "cov_yy"), "poses.{x}: ", "column 'cov_yy' is missing"),
    "a rate is NaN": (set_cell("wheels", 6, "omega_c", math.nan), "wheels.{x}, row 6: ", "omega_c is nan"),
    "a rate is infinite": (set_cell("wheels", 2, "omega_a", math.inf), "wheels.{x}, row 2: ", "omega_a is inf"),
    "a rate is empty": (set_cell("wheels", 3, "omega_b", None), "wheels.{x}, row 3: ", "omega_b is missing"),
    "a wheel angle is NaN": (set_cell("wheels", 1, "phi_a", math.nan), "wheels.{x}, row 1: ", "phi_a is nan"),
    "a target is infinite": (set_cell("wheels", 8, "target_c", -math.inf), "wheels.{x}, row 8: ", "target_c is -inf"),
    "a time is NaN": (set_cell("wheels", 4, "t", math.nan), "wheels.{x}, row 4: ", "t is nan"),
    "a pose is NaN": (set_cell("poses", 5, "theta", math.nan), "poses.{x}, row 5: ", "theta is nan"),
    "a pose is infinite": (set_cell("poses", 1, "x", -math.inf), "poses.{x}, row 1: ", "x is -inf"),
    "a covariance is NaN": (set_cell("poses", 2, "cov_xy", math.nan), "poses.{x}, row 2: ", "cov_xy is nan"),
    "a pose's time is infinite": (set_cell("poses", 6, "t", math.inf), "poses.{x}, row 6: ", "t is inf"),
    "a commanded speed is infinite": (
        set_cell("trajectories", 2, "v", math.inf),
        "trajectories.{x}, row 2: ",
        "v is inf; leave it empty",
    ),
    "a start time is NaN": (set_cell("trajectories", 1, "started_at", math.nan), "trajectories.{x}, row 1: ", "is nan"),
    "half a repetition": (
        set_cell("trajectories", 1, "repetition", 1.5),
        "trajectories.{x}, row 1: ",
        "repetition is 1.5",
    ),
    "time goes backwards": (
        set_cell("wheels", 7, "t", 0.15),
        "wheels.{x}, row 7: ",
        "t goes backwards: 0.15 after 0.2",
    ),
    "a time is repeated": (set_cell("wheels", 2, "t", 0.1), "wheels.{x}, row 2: ", "t is repeated: 0.1 after 0.1"),
    "a pose's time goes backwards": (set_cell("poses", 6, "t", 0.1), "poses.{x}, row 6: ", "t goes backwards"),
    "a pose's time is repeated": (set_cell("poses", 3, "t", 0.2), "poses.{x}, row 3: ", "t is repeated"),
    "a wheel row at t = 0": (set_cell("wheels", 1, "t", 0.0), "wheels.{x}, row 1: ", "wheel samples start after t = 0"),
    "a wheel row before t = 0": (set_cell("wheels", 5, "t", -0.1), "wheels.{x}, row 5: ", "t is -0.1"),
    "a pose before t = 0": (set_cell("poses", 4, "t", -0.1), "poses.{x}, row 4: ", "t is -0.1"),
    "no pose at t = 0": (set_cell("poses", 4, "t", 0.05), "poses.{x}, row 4: ", "run-2 has no reference pose at t = 0"),
    "no pose after t = 0": (
        drop_rows("poses", 5, 6),
        "poses.{x}, row 4: ",
        "run-2 has no reference pose after its start",
    ),
    "a run without poses": (
        drop_rows("poses", 4, 5, 6),
        "poses.{x}: ",
        "trajectory run-2 (trajectories.{x}, row 2) has no reference poses",
    ),
    "a run without wheels": (
        drop_rows("wheels", 1, 2, 3, 4),
        "wheels.{x}: ",
        "trajectory run-1 (trajectories.{x}, row 1) has no wheel samples",
    ),
    "an id twice": (
        set_cell("trajectories", 2, "trajectory", "run-1"),
        "trajectories.{x}, row 2: ",
        "trajectory run-1 is there twice",
    ),
    "an empty id": (set_cell("poses", 2, "trajectory", None), "poses.{x}, row 2: ", "trajectory is missing"),
    "an unknown split": (
        set_cell("trajectories", 2, "split", "validate"),
        "trajectories.{x}, row 2: ",
        "split is 'validate'; did you mean 'validation'?",
    ),
    "an empty split": (set_cell("trajectories", 1, "split", None), "trajectories.{x}, row 1: ", "split is None"),
    "wheels of an unknown run": (
        set_cell("wheels", 5, "trajectory", "run-3"),
        "wheels.{x}, row 5: ",
        "trajectory run-3 is not in trajectories.{x}",
    ),
    "poses of an unknown run": (
        set_cell("poses", 3, "trajectory", "x"),
        "poses.{x}, row 3: ",
        "trajectory x is not in",
    ),
    "text among rates": (
        set_cell("wheels", 6, "omega_b", "fast"),
        "wheels.{x}, row 6: ",
        "omega_b is 'fast', expected a number",
    ),
    "text among poses": (set_cell("poses", 2, "x", "1,5"), "poses.{x}, row 2: ", "x is '1,5', expected a number"),
    "text among commands": (
        set_cell("trajectories", 2, "omega", "left"),
        "trajectories.{x}, row 2: ",
        "omega is 'left', expected a number",
    ),
    "no wheels table": (remove_file("wheels"), ": ", "wheels.parquet (or wheels.csv) is missing"),
    "no poses table": (remove_file("poses"), ": ", "poses.parquet (or poses.csv) is missing"),
    "no trajectories table": (
        remove_file("trajectories"),
        ": ",
        "trajectories.parquet (or trajectories.csv) is missing",
    ),
    "an empty wheels table": (with_frame("wheels", lambda frame: frame.clear()), "wheels.{x}: ", "it has no rows"),
    "an empty table of runs": (
        with_frame("trajectories", lambda frame: frame.clear()),
        "trajectories.{x}: ",
        "it has no rows",
    ),
    "a file of nothing": (overwrite("poses", b""), "poses.{x}: ", "cannot be read"),
    "a file that is no table": (overwrite("poses", b"\x89PNG\xff\xfe\x00"), "poses.{x}: ", ""),
    "no header": (lambda folder: (folder / "dataset.yaml").unlink(), "dataset.yaml: ", "no such file"),
    "a header that is no YAML": (
        lambda folder: (folder / "dataset.yaml").write_text("a: [1"),
        "dataset.yaml: ",
        "YAML",
    ),
    "another format": (
        header("format", "omnibench-dataset/9"),
        "dataset.yaml: ",
        "format is 'omnibench-dataset/9', expected 'omnibench-dataset/1'",
    ),
    "no format": (header("format", None), "dataset.yaml: ", "format is None"),
    "no robot": (header("robot", None), "dataset.yaml: ", "key 'robot' is missing"),
    "a misspelt key": (header("sample_perod", 0.1), "dataset.yaml: ", "did you mean 'sample_period'?"),
    "a period of zero": (header("sample_period", 0), "dataset.yaml: ", "sample_period"),
    "other wheels than the robot's": (
        header("wheels", ["a", "b", "d"]),
        "dataset.yaml: ",
        "wheels are a, b, d, but robot.wheels are a, b, c",
    ),
    "wheels in another order": (header("wheels", ["c", "b", "a"]), "dataset.yaml: ", "the same order"),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[Format, Path]:
    """A sound data set in both formats."""
    folders = {fmt: tmp_path_factory.mktemp(fmt) / "dataset" for fmt in FORMATS}
    for fmt, folder in folders.items():
        save_dataset(everything_known(), folder, fmt)
    return folders


@pytest.mark.parametrize("fmt", FORMATS)
@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line_that_names_file_row_and_reason(
    good: dict[Format, Path], tmp_path: Path, case: str, fmt: Format
) -> None:
    change, place, reason = REFUSED[case]
    folder = tmp_path / "dataset"
    shutil.copytree(good[fmt], folder)
    change(folder)
    with pytest.raises(DataError) as refusal:
        load_dataset(folder)
    message = str(refusal.value)
    separator = "" if place.startswith(":") else "/"
    assert message.startswith(f"{folder}{separator}{place.format(x=fmt)}")
    assert reason.format(x=fmt) in message
    assert "\n" not in message


@pytest.mark.parametrize("fmt", FORMATS)
def test_a_data_set_comes_back_as_it_was(good: dict[Format, Path], fmt: Format) -> None:
    written, found = everything_known(), load_dataset(good[fmt])
    for item in fields(Dataset):
        if item.name != "trajectories":
            assert getattr(found, item.name) == getattr(written, item.name), item.name
    for before, after in zip(written.trajectories, found.trajectories, strict=True):
        for item in fields(Trajectory):
            np.testing.assert_array_equal(getattr(after, item.name), getattr(before, item.name), item.name)


def test_parquet_and_csv_have_the_hash_of_what_was_written(good: dict[Format, Path]) -> None:
    assert {load_dataset(folder).hash for folder in good.values()} == {everything_known().hash}


@pytest.mark.parametrize("fmt", FORMATS)
def test_names_made_of_digits_stay_as_they_are(tmp_path: Path, fmt: Format) -> None:
    run = a_trajectory("007", 0.4, command="0010", session="20221220")
    save_dataset(make_dataset("digits", ROBOT, 0.1, [run]), tmp_path / "d", fmt)
    (found,) = load_dataset(tmp_path / "d").trajectories
    assert (found.id, found.command, found.session) == ("007", "0010", "20221220")


@pytest.mark.parametrize("fmt", FORMATS)
def test_headings_of_many_turns_come_back_to_the_bit(tmp_path: Path, fmt: Format) -> None:
    times = 0.1 * np.arange(1, 400)
    rates = np.tile(wheel_equations(ROBOT.wheels) @ [0.2, 0.1, 1.7], (len(times), 1))
    stamps = np.arange(0.0, 39.0, 0.3)
    (poses,) = OdometryModel.of_design(ROBOT, "arc").poses([WheelLog(times, rates, np.array([0, 0, 0.1]), stamps)])
    wrapped = poses.copy()
    wrapped[:, 2] = np.arctan2(np.sin(poses[:, 2]), np.cos(poses[:, 2]))
    dataset = make_dataset("turns", ROBOT, 0.1, [Trajectory("a", "train", times, rates, stamps, wrapped)])
    save_dataset(dataset, tmp_path / "d", fmt)
    assert load_dataset(tmp_path / "d").hash == dataset.hash


def test_the_hash_ignores_the_data_sets_name() -> None:
    dataset = everything_known()
    assert replace(dataset, name="another", description="x").hash == dataset.hash


@pytest.mark.parametrize("item", ["rates", "poses", "times", "v", "split", "targets"])
def test_the_hash_depends_on_the_recordings(item: str) -> None:
    dataset = everything_known()
    first = dataset.trajectories[0]
    other: Any = "validation" if item == "split" else getattr(first, item) * (1 + 1e-15)
    changed = replace(dataset, trajectories=(replace(first, **{item: other}), *dataset.trajectories[1:]))
    assert changed.hash != dataset.hash


@pytest.mark.parametrize("fmt", FORMATS)
def test_only_trajectory_and_split_are_needed(good: dict[Format, Path], tmp_path: Path, fmt: Format) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(good[fmt], folder)
    for name, kept in (
        ("trajectories", ["trajectory", "split"]),
        ("wheels", ["trajectory", "t", "omega_a", "omega_b", "omega_c"]),
        ("poses", ["trajectory", "t", "x", "y", "theta"]),
    ):
        with_frame(name, lambda frame, kept=kept: frame.select(kept))(folder)  # type: ignore[misc]
    run = load_dataset(folder).trajectories[0]
    unknown = {item.name for item in fields(run) if getattr(run, item.name) is None}
    assert unknown == {
        *("command", "repetition", "session", "started_at", "v", "alpha", "omega", "duration", "distance"),
        *("angles", "targets", "pose_covariances"),
    }


@pytest.mark.parametrize("fmt", FORMATS)
@pytest.mark.parametrize(
    "column", ["command", "repetition", "session", "started_at", "v", "alpha", "omega", "distance"]
)
def test_what_is_unknown_of_one_run_may_stay_empty(
    good: dict[Format, Path], tmp_path: Path, fmt: Format, column: str
) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(good[fmt], folder)
    set_cell("trajectories", 2, column, None)(folder)
    known, unknown = (getattr(run, column) for run in load_dataset(folder).trajectories)
    assert known == getattr(everything_known().trajectories[0], column)
    assert unknown is None


@pytest.mark.parametrize("fmt", FORMATS)
def test_rows_of_several_runs_may_be_mixed(good: dict[Format, Path], tmp_path: Path, fmt: Format) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(good[fmt], folder)
    with_frame("wheels", lambda frame: frame[[0, 4, 1, 5, 2, 6, 3, 7]])(folder)
    with_frame("poses", lambda frame: frame[[3, 4, 5, 0, 1, 2]])(folder)
    assert load_dataset(folder).hash == everything_known().hash


@pytest.mark.parametrize("fmt", FORMATS)
def test_numbers_of_a_csv_may_have_spaces_and_integers(good: dict[Format, Path], tmp_path: Path, fmt: Format) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(good[fmt], folder)
    set_cell("trajectories", 1, "v", " 1 ")(folder)
    assert load_dataset(folder).trajectories[0].v == 1.0


@pytest.mark.parametrize("fmt", FORMATS)
def test_arrays_that_only_some_runs_have_are_left_out(tmp_path: Path, fmt: Format) -> None:
    first, second = everything_known().trajectories
    poorer = replace(second, angles=None, pose_covariances=None)
    save_dataset(make_dataset("mixed", ROBOT, 0.1, [first, poorer]), tmp_path / "d", fmt)
    found = load_dataset(tmp_path / "d").trajectories
    assert [(run.angles is None, run.targets is None, run.pose_covariances is None) for run in found] == [
        (True, False, True)
    ] * 2


@pytest.mark.parametrize("fmt", FORMATS)
def test_a_data_set_is_replaced_by_one_in_either_format(good: dict[Format, Path], tmp_path: Path, fmt: Format) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(good[fmt], folder)
    other: Format = "csv" if fmt == "parquet" else "parquet"
    save_dataset(make_dataset("new", ROBOT, 0.1, [a_trajectory("new", 0.1)]), folder, other)
    assert [run.id for run in load_dataset(folder).trajectories] == ["new"]
    assert {file.suffix for file in folder.iterdir()} == {f".{other}", ".yaml"}


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere: no such folder"):
        load_dataset(tmp_path / "nowhere")


def test_a_folder_with_other_files_is_not_written_into(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(DataError, match="holds other files"):
        save_dataset(everything_known(), tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "dataset").write_text("")
    with pytest.raises(DataError, match="dataset: is a file"):
        save_dataset(everything_known(), tmp_path / "dataset")


def test_a_folder_that_cannot_be_made_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot be written") as refusal:
        save_dataset(everything_known(), tmp_path / "file" / "dataset")
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("fmt", FORMATS)
def test_a_folder_without_permission_is_refused_in_one_line(
    good: dict[Format, Path], tmp_path: Path, fmt: Format
) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(good["csv"], folder)
    folder.chmod(0o555)
    if os.access(folder, os.W_OK):
        pytest.skip("whoever runs the tests may write anywhere")
    with pytest.raises(DataError, match="cannot be written"):
        save_dataset(everything_known(), folder, fmt)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here, a disk that is always full")
@pytest.mark.parametrize("old", FORMATS)
@pytest.mark.parametrize("new", FORMATS)
@pytest.mark.parametrize("file", ["trajectories", "wheels", "poses", "dataset"])
def test_a_full_disk_is_told_in_one_line_and_leaves_the_old_data_set(
    good: dict[Format, Path], tmp_path: Path, old: Format, new: Format, file: str
) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(good[old], folder)
    name = "dataset.yaml" if file == "dataset" else f"{file}.{new}"
    (folder / f".{name}.{os.getpid()}.partial").symlink_to("/dev/full")
    with pytest.raises(DataError, match=f"{name}: cannot be written: No space left on device"):
        save_dataset(make_dataset("new", ROBOT, 0.1, [a_trajectory("new", 0.1)]), folder, new)
    assert load_dataset(folder).hash == everything_known().hash
    assert sorted(folder.iterdir()) == sorted(folder / source.name for source in good[old].iterdir())


def test_two_runs_with_one_id_are_refused_in_memory_too() -> None:
    with pytest.raises(DataError, match="data set twice: trajectory a is there twice"):
        make_dataset("twice", ROBOT, 0.1, [a_trajectory("a", 0.1), a_trajectory("a", 0.2)])


def test_a_data_set_without_runs_is_refused_in_memory_too() -> None:
    with pytest.raises(DataError, match="data set none: it has no trajectory"):
        make_dataset("none", ROBOT, 0.1, [])


def test_poses_after_the_last_wheel_sample_are_warned_of() -> None:
    run = a_trajectory("late", 0.3)
    late = replace(run, pose_times=np.array([0.0, 0.2, 1.0]))
    (warning,) = make_dataset("late", ROBOT, 0.1, [run, late][1:]).warnings[-1:]
    assert warning == "1 trajectory has reference poses after its last wheel sample, e.g. late"
