"""Data sets on disk: what is read comes back, whatever the format, and nothing of others is written over."""

from __future__ import annotations

import os
import shutil
from dataclasses import fields, replace
from operator import methodcaller
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_robots import APR_02
from storage_samples import (
    FORMATS,
    Format,
    a_trajectory,
    everything_known,
    set_cell,
    with_frame,
)

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.robot.kinematics import wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog


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
    save_dataset(make_dataset("digits", APR_02, 0.1, [run]), tmp_path / "d", fmt)
    (found,) = load_dataset(tmp_path / "d").trajectories
    assert (found.id, found.command, found.session) == ("007", "0010", "20221220")


@pytest.mark.parametrize("fmt", FORMATS)
def test_headings_of_many_turns_come_back_to_the_bit(tmp_path: Path, fmt: Format) -> None:
    times = 0.1 * np.arange(1, 400)
    rates = np.tile(wheel_equations(APR_02.wheels) @ [0.2, 0.1, 1.7], (len(times), 1))
    stamps = np.arange(0.0, 39.0, 0.3)
    (poses,) = OdometryModel.of_design(APR_02, "arc").poses([WheelLog(times, rates, np.array([0, 0, 0.1]), stamps)])
    wrapped = poses.copy()
    wrapped[:, 2] = np.arctan2(np.sin(poses[:, 2]), np.cos(poses[:, 2]))
    dataset = make_dataset("turns", APR_02, 0.1, [Trajectory("a", "train", times, rates, stamps, wrapped)])
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
        with_frame(name, methodcaller("select", kept))(folder)
    run = load_dataset(folder).trajectories[0]
    unknown = {item.name for item in fields(run) if getattr(run, item.name) is None}
    assert unknown == {
        *("command", "repetition", "session", "started_at", "v", "alpha", "omega", "duration", "distance"),
        *("angles", "targets", "pose_covariances", "steering", "drive", "references", "odometry", "sent"),
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
    save_dataset(make_dataset("mixed", APR_02, 0.1, [first, poorer]), tmp_path / "d", fmt)
    found = load_dataset(tmp_path / "d").trajectories
    assert [(run.angles is None, run.targets is None, run.pose_covariances is None) for run in found] == [
        (True, False, True)
    ] * 2


@pytest.mark.parametrize("fmt", FORMATS)
def test_a_data_set_is_replaced_by_one_in_either_format(good: dict[Format, Path], tmp_path: Path, fmt: Format) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(good[fmt], folder)
    other: Format = "csv" if fmt == "parquet" else "parquet"
    save_dataset(make_dataset("new", APR_02, 0.1, [a_trajectory("new", 0.1)]), folder, other, overwrite=True)
    assert [run.id for run in load_dataset(folder).trajectories] == ["new"]
    assert {file.suffix for file in folder.iterdir()} == {f".{other}", ".yaml"}


def test_another_data_set_is_not_replaced_unless_asked(good: dict[Format, Path], tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(good["csv"], folder)
    known = everything_known()
    for other in (replace(known, name="other"), replace(known, simulated=not known.simulated)):
        with pytest.raises(DataError, match=f"holds the .*data set '{known.name}'; name another folder"):
            save_dataset(other, folder)
    assert {file.suffix for file in folder.iterdir()} == {".csv", ".yaml"}
    save_dataset(known, folder)
    assert {file.suffix for file in folder.iterdir()} == {".parquet", ".yaml"}


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
        save_dataset(make_dataset("new", APR_02, 0.1, [a_trajectory("new", 0.1)]), folder, new, overwrite=True)
    assert load_dataset(folder).hash == everything_known().hash
    assert sorted(folder.iterdir()) == sorted(folder / source.name for source in good[old].iterdir())


def test_two_runs_with_one_id_are_refused_in_memory_too() -> None:
    with pytest.raises(DataError, match="data set twice: trajectory a is there twice"):
        make_dataset("twice", APR_02, 0.1, [a_trajectory("a", 0.1), a_trajectory("a", 0.2)])


def test_a_data_set_without_runs_is_refused_in_memory_too() -> None:
    with pytest.raises(DataError, match="data set none: it has no trajectory"):
        make_dataset("none", APR_02, 0.1, [])


def test_poses_after_the_last_wheel_sample_are_warned_of() -> None:
    run = a_trajectory("late", 0.3)
    late = replace(run, pose_times=np.array([0.0, 0.2, 1.0]))
    (warning,) = make_dataset("late", APR_02, 0.1, [run, late][1:]).warnings[-1:]
    assert warning == "1 trajectory has reference poses after its last wheel sample, e.g. late"
