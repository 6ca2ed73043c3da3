"""Data sets on disk: what is read comes back, what cannot be right is refused in one line, others stay."""

import math
import os
import shutil
from dataclasses import fields, replace
from inspect import signature
from operator import methodcaller
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from commands import refused
from sample_robots import APR_02, CAR, DIFFERENTIAL, TRICYCLE
from storage_samples import (
    FORMATS,
    Change,
    Format,
    a_trajectory,
    drop_column,
    drop_rows,
    everything_known,
    header,
    overwrite,
    read_frame,
    remove_file,
    rename,
    set_cell,
    with_frame,
)
from wheeled_samples import driven

from omnibench.check.check import check
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.robot.kinematics import wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

RECORDED = signature(Trajectory).parameters.keys() - {"samples"}  # what is given to a run, or found there


@pytest.fixture(params=FORMATS)
def folder(good: dict[Format, Path], tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A copy of the sound data set, in either format."""
    return Path(shutil.copytree(good[request.param], tmp_path / "dataset"))


@pytest.mark.parametrize("fmt", FORMATS)
def test_a_data_set_comes_back_as_it_was(good: dict[Format, Path], fmt: Format) -> None:
    written, found = everything_known(), load_dataset(good[fmt])
    for item in fields(Dataset):
        if item.name != "trajectories":
            assert getattr(found, item.name) == getattr(written, item.name), item.name
    for before, after in zip(written.trajectories, found.trajectories, strict=True):
        for name in RECORDED:
            np.testing.assert_array_equal(getattr(after, name), getattr(before, name), name)


@pytest.mark.parametrize("fmt", FORMATS)
def test_names_made_of_digits_headings_of_many_turns_and_steering_angles_come_back(tmp_path: Path, fmt: Format) -> None:
    times = 0.1 * np.arange(1, 400)
    rates = np.tile(wheel_equations(APR_02.wheels) @ [0.2, 0.1, 1.7], (len(times), 1))
    stamps = np.arange(0.0, 39.0, 0.3)
    (poses,) = OdometryModel.of_design(APR_02, "arc").poses([WheelLog(times, rates, np.array([0, 0, 0.1]), stamps)])
    poses[:, 2] = np.arctan2(np.sin(poses[:, 2]), np.cos(poses[:, 2]))
    turns = Trajectory("007", "train", times, rates, stamps, poses, command="0010", session="20221220")
    for dataset in (
        make_dataset("turns", APR_02, 0.1, [turns]),
        driven(TRICYCLE, runs=2, samples=10),
        driven(CAR, runs=2, samples=10),
    ):
        save_dataset(dataset, tmp_path / dataset.name, fmt)
        found = load_dataset(tmp_path / dataset.name)
        assert found.hash == dataset.hash
        for before, after in zip(dataset.trajectories, found.trajectories, strict=True):
            assert (after.id, after.command, after.session) == (before.id, before.command, before.session)
            np.testing.assert_array_equal(after.signals, before.signals)


def test_the_tables_have_a_column_for_every_measured_rate_and_angle(tmp_path: Path) -> None:
    for robot, columns in (
        (TRICYCLE, ["omega_front", "steer_front"]),
        (CAR, ["omega_left", "omega_right", "steer_front_left", "steer_front_right"]),
        (DIFFERENTIAL, ["omega_left", "omega_right"]),
    ):
        folder = tmp_path / robot.name
        save_dataset(driven(robot, runs=1, samples=5), folder)
        assert read_frame(folder, "wheels").columns == ["trajectory", "t", *columns]
        assert yaml.safe_load((folder / "dataset.yaml").read_text())["wheels"] == list(robot.wheel_names)


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


def test_only_trajectory_and_split_are_needed(folder: Path) -> None:
    for name, kept in (
        ("trajectories", ["trajectory", "split"]),
        ("wheels", ["trajectory", "t", "omega_a", "omega_b", "omega_c"]),
        ("poses", ["trajectory", "t", "x", "y", "theta"]),
    ):
        with_frame(name, methodcaller("select", kept))(folder)
    run = load_dataset(folder).trajectories[0]
    unknown = {name for name in RECORDED if getattr(run, name) is None}
    assert unknown == {
        *("command", "repetition", "session", "started_at", "v", "alpha", "omega", "duration", "distance"),
        *("angles", "targets", "pose_covariances", "steering", "drive", "references", "odometry", "sent"),
    }


@pytest.mark.parametrize(
    "column", ["command", "repetition", "session", "started_at", "v", "alpha", "omega", "distance"]
)
def test_what_is_unknown_of_one_run_may_stay_empty(folder: Path, column: str) -> None:
    set_cell("trajectories", 2, column, None)(folder)
    known, unknown = (getattr(run, column) for run in load_dataset(folder).trajectories)
    assert known == getattr(everything_known().trajectories[0], column)
    assert unknown is None


def test_rows_of_several_runs_may_be_mixed_and_numbers_have_spaces(folder: Path) -> None:
    with_frame("wheels", lambda frame: frame[[0, 4, 1, 5, 2, 6, 3, 7]])(folder)
    with_frame("poses", lambda frame: frame[[3, 4, 5, 0, 1, 2]])(folder)
    assert load_dataset(folder).hash == everything_known().hash
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
def test_a_data_set_is_replaced_by_one_in_either_format(folder: Path, fmt: Format) -> None:
    save_dataset(make_dataset("new", APR_02, 0.1, [a_trajectory("new", 0.1)]), folder, fmt, overwrite=True)
    assert [run.id for run in load_dataset(folder).trajectories] == ["new"]
    assert {file.suffix for file in folder.iterdir()} == {f".{fmt}", ".yaml"}


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


def test_a_place_that_is_no_folder_for_a_data_set_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere: no such folder"):
        load_dataset(tmp_path / "nowhere")
    (tmp_path / "thesis.tex").write_text("years of work")
    for place, words in (
        (tmp_path, "holds other files"),
        (tmp_path / "thesis.tex", "thesis.tex: is a file"),
        (tmp_path / "thesis.tex" / "dataset", "cannot be written"),
    ):
        with refused(DataError, match=words):
            save_dataset(everything_known(), place)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_refused(folder: Path) -> None:
    folder.chmod(0o555)
    with pytest.raises(DataError, match="cannot be written"):
        save_dataset(everything_known(), folder)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here, a disk that is always full")
@pytest.mark.parametrize("new", FORMATS)
@pytest.mark.parametrize("file", ["trajectories", "wheels", "poses", "dataset"])
def test_a_full_disk_is_told_in_one_line_and_leaves_the_old_data_set(folder: Path, new: Format, file: str) -> None:
    before = sorted(folder.iterdir())
    name = "dataset.yaml" if file == "dataset" else f"{file}.{new}"
    (folder / f".{name}.{os.getpid()}.partial").symlink_to("/dev/full")
    with pytest.raises(DataError, match=f"{name}: cannot be written: No space left on device"):
        save_dataset(make_dataset("new", APR_02, 0.1, [a_trajectory("new", 0.1)]), folder, new, overwrite=True)
    assert load_dataset(folder).hash == everything_known().hash
    assert sorted(folder.iterdir()) == before


def test_two_runs_with_one_id_and_no_runs_are_refused_in_memory_too() -> None:
    with pytest.raises(DataError, match="data set twice: trajectory a "):
        make_dataset("twice", APR_02, 0.1, [a_trajectory("a", 0.1), a_trajectory("a", 0.2)])
    with pytest.raises(DataError, match="data set none: it has no trajectory"):
        make_dataset("none", APR_02, 0.1, [])


def test_poses_after_the_last_wheel_sample_are_warned_of() -> None:
    run = a_trajectory("late", 0.3)
    late = replace(run, pose_times=np.array([0.0, 0.2, 1.0]))
    (warning,) = make_dataset("late", APR_02, 0.1, [run, late][1:]).warnings[-1:]
    assert warning == "1 trajectory with reference poses after the last wheel sample: late"


# What is done, the file and perhaps the row that the message must name, and what it must say.
REFUSED: list[tuple[Change, str, str]] = [
    (rename("wheels", "omega_b", "omega_bb"), "wheels.{x}: ", "'omega_b' is missing; did you mean 'omega_bb'"),
    (drop_column("wheels", "t"), "wheels.{x}: ", "column 't' is missing"),
    (drop_column("trajectories", "split"), "trajectories.{x}: ", "column 'split' is missing"),
    (drop_column("wheels", "phi_b"), "wheels.{x}: ", "column 'phi_b' is missing; give all of phi_a, phi_b, phi_c"),
    (drop_column("poses", "cov_yy"), "poses.{x}: ", "column 'cov_yy' is missing"),
    (set_cell("wheels", 6, "omega_c", math.nan), "wheels.{x}, row 6: ", "omega_c is nan"),
    (set_cell("wheels", 3, "omega_b", None), "wheels.{x}, row 3: ", "omega_b is missing"),
    (set_cell("poses", 5, "theta", math.nan), "poses.{x}, row 5: ", "theta is nan"),
    (set_cell("poses", 2, "cov_xy", math.nan), "poses.{x}, row 2: ", "cov_xy is nan"),
    (set_cell("trajectories", 1, "started_at", math.nan), "trajectories.{x}, row 1: ", "is nan"),
    (set_cell("trajectories", 1, "repetition", 1.5), "trajectories.{x}, row 1: ", "repetition is 1.5"),
    (set_cell("wheels", 7, "t", 0.15), "wheels.{x}, row 7: ", "t goes backwards: 0.15 after 0.2"),
    (set_cell("wheels", 2, "t", 0.1), "wheels.{x}, row 2: ", "t is repeated: 0.1 after 0.1"),
    (set_cell("wheels", 1, "t", 0.0), "wheels.{x}, row 1: ", "after t = 0"),
    (set_cell("poses", 4, "t", -0.1), "poses.{x}, row 4: ", "t is -0.1"),
    (set_cell("poses", 4, "t", 0.05), "poses.{x}, row 4: ", "run-2 has no reference pose at t = 0"),
    (drop_rows("poses", 5, 6), "poses.{x}, row 4: ", "run-2 has no reference pose after its start"),
    (drop_rows("poses", 4, 5, 6), "poses.{x}: ", "run-2 (trajectories.{x}, row 2) has no reference poses"),
    (drop_rows("wheels", 1, 2, 3, 4), "wheels.{x}: ", "run-1 (trajectories.{x}, row 1) has no wheel samples"),
    (set_cell("trajectories", 2, "trajectory", "run-1"), "trajectories.{x}, row 2: ", "run-1 is there twice"),
    (set_cell("poses", 2, "trajectory", None), "poses.{x}, row 2: ", "trajectory is missing"),
    (set_cell("trajectories", 2, "split", "validate"), "trajectories.{x}, row 2: ", "did you mean 'validation'?"),
    (set_cell("trajectories", 1, "split", None), "trajectories.{x}, row 1: ", "split is None"),
    (set_cell("wheels", 5, "trajectory", "run-3"), "wheels.{x}, row 5: ", "run-3 is not in trajectories.{x}"),
    (set_cell("wheels", 6, "omega_b", "fast"), "wheels.{x}, row 6: ", "omega_b is 'fast', expected a number"),
    (remove_file("poses"), ": ", "poses.parquet (or poses.csv) is missing"),
    (remove_file("trajectories"), ": ", "trajectories.parquet (or trajectories.csv) is missing"),
    (with_frame("wheels", lambda frame: frame.clear()), "wheels.{x}: ", "it has no rows"),
    (with_frame("trajectories", lambda frame: frame.clear()), "trajectories.{x}: ", "it has no rows"),
    (overwrite("poses", b""), "poses.{x}: ", "cannot be read"),
    (overwrite("poses", b"\x89PNG\xff\xfe\x00"), "poses.{x}: ", ""),
    (remove_file("dataset"), "dataset.yaml: ", "no such file"),
    (overwrite("dataset", b"a: [1"), "dataset.yaml: ", "YAML"),
    (header("format", "omnibench-dataset/9"), "dataset.yaml: ", "omnibench-dataset/1"),
    (header("robot", None), "dataset.yaml: ", "key 'robot' is missing"),
    (header("sample_perod", 0.1), "dataset.yaml: ", "did you mean 'sample_period'?"),
    (header("sample_period", 0), "dataset.yaml: ", "sample_period"),
    (header("wheels", ["a", "b", "d"]), "dataset.yaml: ", "a, b, d"),
    (header("wheels", ["c", "b", "a"]), "dataset.yaml: ", "in this order"),
]
REFUSED_STEERING: list[tuple[Change, str, str]] = [
    (drop_column("wheels", "steer_front"), "wheels.{x}: ", "column 'steer_front'"),
    (set_cell("wheels", 3, "steer_front", math.nan), "wheels.{x}, row 3: ", "steer_front is nan"),
    (header("wheels", ["front", "left", "right"]), "dataset.yaml: ", "front"),
]


def assert_refused(folder: Path, place: str, reason: str, fmt: Format, most_in_memory: int = 100) -> None:
    separator = "" if place.startswith(":") else "/"
    with refused(DataError, reason.format(x=fmt), start=f"{folder}{separator}{place.format(x=fmt)}"):
        load_dataset(folder, most_in_memory=most_in_memory)


@pytest.mark.parametrize(("fmt", "most_in_memory"), [("csv", 100), ("parquet", 100), ("parquet", 0)])
@pytest.mark.parametrize(("change", "place", "reason"), REFUSED)
def test_refused_in_one_line_that_names_file_row_and_reason(
    good: dict[Format, Path], tmp_path: Path, change: Change, place: str, reason: str, fmt: Format, most_in_memory: int
) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(good[fmt], folder)
    change(folder)
    assert_refused(folder, place, reason, fmt, most_in_memory)


@pytest.mark.parametrize("fmt", ["csv", "parquet"])
@pytest.mark.parametrize(("change", "place", "reason"), REFUSED_STEERING)
def test_unreadable_steering_is_refused(tmp_path: Path, change: Change, place: str, reason: str, fmt: Format) -> None:
    save_dataset(driven(TRICYCLE, runs=1, samples=5), tmp_path / "d", fmt)
    change(tmp_path / "d")
    assert_refused(tmp_path / "d", place, reason, fmt)


# Runs without motion capture: references in memory and on disk, and what is refused of them.

ALL_KINDS = (
    Reference("distance", 0.09, 0.002),
    Reference("turn", 0.2, 0.01, t0=0.1),
    Reference("displacement", (0.08, 0.04), (0.002, 0.003)),
    Reference("position", (3.0, 4.0), 0.01, t1=0.2),
    Reference("heading", 1.7, 0.05, t1=0.3),
)


def measured(identity: str = "run-1", *references: Reference, **known: bool) -> Trajectory:
    """A run without poses."""
    run = a_trajectory(identity, 0.5)
    given = References.of(references or ALL_KINDS, run.times[-1], **known)
    return replace(run, pose_times=np.zeros(1), poses=np.zeros((1, 3)), references=given)


def a_set(*runs: Trajectory) -> Dataset:
    return make_dataset("tape", APR_02, 0.1, runs)


@pytest.mark.parametrize("fmt", FORMATS)
def test_references_come_back_from_disk_as_they_were(tmp_path: Path, fmt: Format) -> None:
    turns = measured("run-3", Reference("turn", 0.2, 0.1))
    turns = replace(turns, references=replace(turns.references, rate_sigma=0.01))  # the offset that turns share
    dataset = a_set(measured(), a_trajectory("run-2", 0.1), turns)
    save_dataset(dataset, tmp_path / "tape", fmt)
    again = load_dataset(tmp_path / "tape")
    assert again.hash == dataset.hash
    assert [run.fingerprint for run in again.trajectories] == [run.fingerprint for run in dataset.trajectories]
    assert [run.start_known for run in again.trajectories] == [False, True, False]
    assert again.trajectories[2].references.rate_sigma == 0.01


def test_a_data_set_without_any_pose_has_no_table_of_poses(tmp_path: Path) -> None:
    save_dataset(everything_known(), tmp_path / "tape")
    save_dataset(a_set(measured()), tmp_path / "tape", overwrite=True)
    assert not (tmp_path / "tape" / "poses.parquet").exists()
    (run,) = load_dataset(tmp_path / "tape").trajectories
    assert not run.has_poses
    assert run.start.tolist() == [0.0, 0.0, 0.0]


def test_a_start_pose_alone_makes_the_frame_of_positions_known(tmp_path: Path) -> None:
    run = replace(measured("run-1", start_known=True), poses=np.array([[1.0, 2.0, 0.3]]))
    save_dataset(a_set(run), tmp_path / "gps")
    (again,) = load_dataset(tmp_path / "gps").trajectories
    assert again.start_known
    assert again.start.tolist() == [1.0, 2.0, 0.3]


def test_a_table_may_say_a_sigma_for_both_axes_and_leave_out_the_times_of_the_whole_run(tmp_path: Path) -> None:
    save_dataset(a_set(measured()), tmp_path / "tape")
    rows = {"trajectory": ["run-1"] * 2, "kind": ["displacement", "distance"], "value": [None, 0.09]}
    frame = pl.DataFrame(rows | {"value_x": [0.08, None], "value_y": [0.04, None], "sigma": [0.002, 0.001]})
    frame.write_parquet(tmp_path / "tape" / "references.parquet")
    references = load_dataset(tmp_path / "tape").trajectories[0].references
    assert references.t0.tolist() == [0.0, 0.0]
    assert references.t1.tolist() == [0.4, 0.4]
    np.testing.assert_array_equal(references.sigmas, [[0.002, 0.002], [0.001, np.nan]])


def test_a_data_set_without_references_keeps_hash_and_fingerprint_to_the_bit() -> None:
    rates, poses = np.array([[1.0, 1.0], [2.0, 1.5]]), np.array([[0.0, 0.0, 0.0], [0.0625, 0.0, -0.125]])
    run = Trajectory("run-1", "train", np.array([0.5, 1.0]), rates, np.array([0.0, 1.0]), poses)
    # By the version before there were references.
    assert run.fingerprint == "76cfe729fb32936f"
    assert make_dataset("plain", DIFFERENTIAL, 0.5, [run]).hash.startswith("009e3e0aa644d6a83e59c5d2da3b502c")


REFUSED_REFERENCES = [
    (Reference("distanse", 1.0, 0.1), "kind is 'distanse'; did you mean 'distance'?"),  # type: ignore[arg-type]
    (Reference("turn", 1.0, 0.1, t1=9.0), "t1 is 9"),
    (Reference("turn", 1.0, 0.1, t0=-1.0), "t0 is -1"),
    (Reference("turn", 1.0, 0.1, t0=0.2, t1=0.2), "t0 < t1"),
    (Reference("position", (1, 1), 0.1, t0=0.1, t1=0.2), "a position is that at t1"),
    (Reference("heading", 1.0, 0.1, t0=0.1, t1=0.2), "take kind turn"),
    (Reference("distance", 1.0, math.nan), "sigma is missing"),
    (Reference("displacement", (1.0, 0.0), (0.1, 0.0)), "sigma_y is 0"),
    (Reference("displacement", (1.0, 0.0), (0.1, math.nan)), "sigma_y is missing"),
    (Reference("turn", 1.0, 0.1, t1=math.nan), "t1 is nan"),
    (Reference("turn", 1.0, 0.1, t0=math.nan), "t0 is nan"),
    (Reference("position", (1.0, math.nan), 0.1), "value_y is missing"),
    (Reference("distance", -1.0, 0.1), "not negative"),
    (Reference("turn", 1e12, 0.1), "which no robot can reach"),
]


@pytest.mark.parametrize(("reference", "words"), REFUSED_REFERENCES)
def test_references_that_cannot_be_right_are_refused_in_one_line(reference: Reference, words: str) -> None:
    with refused(DataError, words, start="data set tape: trajectory run-1: references, row 1: "):
        a_set(measured("run-1", reference))


def test_a_refusal_on_reading_names_file_and_row(tmp_path: Path) -> None:
    save_dataset(a_set(measured()), tmp_path / "tape", "csv")
    file = tmp_path / "tape" / "references.csv"
    frame = pl.read_csv(file)
    frame.with_columns(sigma=pl.when(pl.col("kind") == "turn").then(0.0).otherwise("sigma")).write_csv(file)
    with pytest.raises(DataError, match=r"references\.csv, row \d: sigma is 0"):
        load_dataset(tmp_path / "tape")
    frame.with_columns(sigma_rate=-0.01).write_csv(file)
    with pytest.raises(DataError, match=r"sigma_rate is -0\.01"):
        load_dataset(tmp_path / "tape")


def test_a_run_with_neither_poses_nor_references_is_refused(tmp_path: Path) -> None:
    save_dataset(a_set(measured(), measured("run-2")), tmp_path / "tape", "csv")
    file = tmp_path / "tape" / "references.csv"
    pl.read_csv(file).filter(pl.col("trajectory") == "run-1").write_csv(file)
    with pytest.raises(DataError, match=r"row 2: trajectory run-2 has neither references nor, .*poses"):
        load_dataset(tmp_path / "tape")


def test_wrapped_headings_of_a_compass_become_continuous() -> None:
    run = a_trajectory("run-1", 0.5)
    times = 2.0 * np.arange(1, 21)
    rates = np.tile(run.rates[0], (20, 1))
    true = 0.5 * times + 2.0
    wrapped = np.angle(np.exp(1j * true))
    given = [Reference("heading", float(value), 0.1, t1=float(at)) for at, value in zip(times, wrapped, strict=True)]
    still = replace(run, times=times, rates=rates, pose_times=np.zeros(1), poses=np.zeros((1, 3)))
    (read,) = a_set(replace(still, references=References.of(given, 40.0))).trajectories
    np.testing.assert_allclose(np.diff(read.references.values[:, 0]), np.diff(true), atol=1e-9)


@pytest.mark.parametrize(
    ("reference", "unit"),
    [
        (Reference("distance", 90.0, 1.0), "mm"),
        (Reference("displacement", (8.0, 4.0), 0.1), "cm"),
        (Reference("turn", 11.5, 0.1), "degrees"),
    ],
)
def test_references_in_other_units_are_found(reference: Reference, unit: str) -> None:
    (finding, *_) = check(a_set(measured("run-1", reference))).findings
    assert f"as if they were in {unit}" in finding.what


def test_references_of_a_data_set_and_of_a_run_are_tables() -> None:
    dataset = a_set(a_trajectory("run-1", 0.1), measured("run-2"))
    assert dataset.to_frame("references")["trajectory"].to_list() == ["run-2"] * len(ALL_KINDS)
    run = dataset.trajectories[1]
    assert run.to_frame("references")["kind"].to_list() == dataset.to_frame("references")["kind"].to_list()
    assert repr(run).splitlines()[1].endswith(f"{len(ALL_KINDS)} references")
    assert len(repr(run.references).splitlines()) <= 20
