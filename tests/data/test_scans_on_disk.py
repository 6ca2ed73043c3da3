"""Scans on disk: what is read comes back, a trajectory at a time, and a broken table is refused in one line."""

import math
import random
import weakref
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import yaml
from commands import refused
from storage_samples import (
    FORMATS,
    Change,
    Format,
    everything_known,
    read_frame,
    rename,
    set_cell,
    table_file,
    with_frame,
    write_frame,
)

from omnibench.data.dataset import Dataset
from omnibench.data.scans import Mount, Scanner, ScansInMemory, ScansOnDisk, TrajectoryScans
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError, OmnibenchError

SCANNER = Scanner(
    name="hokuyo",
    rays=7,
    angle_min=-1.5,
    angle_increment=0.5,
    time_increment=1e-4,
    range_min=0.1,
    range_max=30.0,
    mount=Mount(x=0.12, y=-0.01, yaw=0.02),
)


def some_scans(count: int, seed: int, start: float = 0.0) -> TrajectoryScans:
    """Ranges of every magnitude, among them nothing seen, too near and too far."""
    ranges = np.random.default_rng(seed).uniform(0.1, 30.0, (count, SCANNER.rays)).astype(np.float32)
    ranges[0, :3] = np.inf, 0.0, 31.0
    return TrajectoryScans(start + 0.1 * np.arange(count), ranges)


def scanned() -> Dataset:
    return replace(
        everything_known(), scans=ScansInMemory(SCANNER, {"run-1": some_scans(4, 1), "run-2": some_scans(3, 2, 0.05)})
    )


@pytest.fixture(params=FORMATS)
def folder(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A data set with scans, as Parquet and as CSV."""
    save_dataset(scanned(), tmp_path / "data", request.param)
    return tmp_path / "data"


def scans_of(folder: Path) -> ScansOnDisk:
    scans = load_dataset(folder).scans
    assert isinstance(scans, ScansOnDisk)
    return scans


def assert_same(found: TrajectoryScans, expected: TrajectoryScans) -> None:
    np.testing.assert_array_equal(found.times, expected.times)
    np.testing.assert_array_equal(found.ranges, expected.ranges)
    assert (found.times.dtype, found.ranges.dtype) == (np.float64, np.float32)


def test_scans_come_back_to_the_bit_with_their_scanner(folder: Path) -> None:
    made, found = scanned().scans, scans_of(folder)
    assert found.scanner == SCANNER
    assert found.trajectories == ("run-1", "run-2")
    for trajectory in found.trajectories:
        assert_same(found.of(trajectory), made.of(trajectory))
        np.testing.assert_array_equal(found.times(trajectory), made.of(trajectory).times)


def test_scans_of_trajectories_in_turns_are_told_apart_and_a_trajectory_may_have_none(folder: Path) -> None:
    made = dict(scans_of(folder))
    frame = read_frame(folder, "scans")
    write_frame(folder, "scans", frame[[4, 0, 5, 1, 2, 6, 3]])
    for trajectory, expected in made.items():
        assert_same(scans_of(folder).of(trajectory), expected)
    write_frame(folder, "scans", frame.filter(pl.col("trajectory") == "run-2"))
    assert scans_of(folder).trajectories == ("run-2",)
    with pytest.raises(DataError, match=r"scans\.\w+: trajectory run-1 has no scans"):
        scans_of(folder).of("run-1")


def test_scans_that_are_many_row_groups_long_come_back(tmp_path: Path) -> None:
    long = {"run-1": some_scans(9_000, 1), "run-2": some_scans(700, 2)}
    save_dataset(replace(everything_known(), scans=ScansInMemory(SCANNER, long)), tmp_path / "data")
    for trajectory, expected in long.items():
        assert_same(scans_of(tmp_path / "data").of(trajectory), expected)


def test_one_trajectory_is_in_memory_at_a_time_while_scans_are_saved(tmp_path: Path) -> None:
    given: list[weakref.ref[TrajectoryScans]] = []
    alive: list[int] = []

    class Counted(ScansInMemory):
        def of(self, trajectory: str) -> TrajectoryScans:
            alive.append(sum(earlier() is not None for earlier in given))
            found = replace(super().of(trajectory))
            given.append(weakref.ref(found))
            return found

    scans = Counted(SCANNER, {"run-1": some_scans(4, 1), "run-2": some_scans(3, 2)})
    save_dataset(replace(everything_known(), scans=scans), tmp_path / "data")
    assert alive == [0, 0]


def test_a_part_is_saved_with_its_own_scans_and_without_scans_without_a_scanner(folder: Path, tmp_path: Path) -> None:
    data = load_dataset(folder)
    save_dataset(replace(data, trajectories=data.trajectories[1:]), tmp_path / "part")
    assert scans_of(tmp_path / "part").trajectories == ("run-2",)
    part = load_dataset(tmp_path / "part")
    save_dataset(replace(data, trajectories=data.trajectories[:1], scans=part.scans), tmp_path / "none")
    assert load_dataset(tmp_path / "none").scans is None
    assert yaml.safe_load((tmp_path / "none" / "dataset.yaml").read_text())["scanner"] is None


@pytest.mark.parametrize("table_format", FORMATS)
def test_a_data_set_is_saved_over_itself(folder: Path, table_format: Format) -> None:
    before = dict(scans_of(folder))
    save_dataset(load_dataset(folder), folder, table_format)
    assert [file.name for file in folder.iterdir() if file.stem == "scans"] == [f"scans.{table_format}"]
    for trajectory, expected in before.items():
        assert_same(scans_of(folder).of(trajectory), expected)


def test_a_file_that_changes_under_an_open_data_set_is_refused(folder: Path) -> None:
    scans = scans_of(folder)
    write_frame(folder, "scans", read_frame(folder, "scans")[1:])
    with pytest.raises(DataError, match="the file has changed since it was opened; load it, or run the command, again"):
        scans.of("run-1")
    table_file(folder, "scans").unlink()
    with pytest.raises(DataError, match="cannot be read: No such file"):
        scans.of("run-1")


class Broken(ScansInMemory):
    """Ctrl-C comes while the second run is read."""

    def of(self, trajectory: str) -> TrajectoryScans:
        if trajectory == "run-2":
            raise KeyboardInterrupt
        return super().of(trajectory)


def test_a_save_that_breaks_off_leaves_the_folder_as_it_was_and_no_new_one(folder: Path, tmp_path: Path) -> None:
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    made = scanned()
    broken = replace(made, scans=Broken(SCANNER, dict(made.scans)))
    for place in (folder, tmp_path / "a" / "b"):
        with pytest.raises(KeyboardInterrupt):
            save_dataset(broken, place)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    assert list(tmp_path.iterdir()) == [folder]


def test_a_full_disk_is_told_in_one_line(tmp_path: Path) -> None:
    save_dataset(scanned(), tmp_path / "data")
    (tmp_path / "data" / "scans.parquet").unlink()
    (tmp_path / "data" / "scans.parquet").symlink_to("/dev/full")
    with refused(DataError, match=r"cannot be written: .*No space left on device"):
        save_dataset(scanned(), tmp_path / "data")


RANGES = [1.0] * 7
with_cell, edited = partial(set_cell, "scans"), partial(with_frame, "scans")
BROKEN: list[tuple[Change, str]] = [
    (rename("scans", "ranges", "range"), r"column 'ranges' is missing; did you mean 'range'"),
    (edited(lambda frame: frame.clear()), "it has no rows"),
    (with_cell(2, "t", None), "row 2: t is missing"),
    (with_cell(2, "t", math.nan), "row 2: t is (nan|NaN)"),
    (with_cell(2, "t", "soon"), "row 2: t is 'soon'"),
    (with_cell(4, "t", 1.7e18), r"row 4: t is 1\.7e\+18"),
    (with_cell(1, "t", -0.5), r"row 1: t is -0\.5"),
    (with_cell(3, "t", 0.1), r"row 3: t is repeated: 0\.1 after 0\.1"),
    (with_cell(3, "t", 0.05), r"row 3: t goes backwards: 0\.05 after 0\.1"),
    (with_cell(2, "trajectory", None), "row 2: trajectory is missing"),
    (with_cell(5, "trajectory", "run-3"), "row 5: trajectory run-3 is not in .*; did you mean"),
    (with_cell(6, "ranges", RANGES[1:]), r"row 6: the scan has 6 ranges, but scanner\.rays is 7"),
    (with_cell(2, "ranges", [*RANGES, 1.0]), "row 2: the scan has 8 ranges"),
    (with_cell(7, "ranges", None), "row 7: the scan has 0 ranges"),
    (with_cell(6, "ranges", [*RANGES[1:], math.nan]), "row 6: a range is missing or NaN"),
    (with_cell(6, "ranges", [math.inf] * 6 + [0.01]), r"row 6: the scan of trajectory run-2 at 0\.15 s is empty"),
    (with_cell(6, "ranges", [1234.0] * 6 + [math.inf]), r"row 6: .* is empty: .*; they look like mm"),
]
BROKEN_PARQUET: list[tuple[Callable[[pl.DataFrame], pl.DataFrame], str]] = [
    (lambda frame: frame.with_columns(ranges=pl.lit("1 2 3 4 five 6 7")), "row 1: ranges must be numbers"),
    (lambda frame: frame.with_columns(ranges=pl.lit(3.0)), "column 'ranges' holds Float64, expected lists"),
    (lambda frame: frame.with_columns(ranges=pl.col("ranges").cast(pl.List(pl.String))), "column 'ranges' holds"),
    (lambda frame: frame.with_columns(ranges=pl.concat_list([pl.struct("t")] * 7)), "column 'ranges' holds"),
    (lambda frame: frame.with_columns(t=pl.lit(True)), "column 't' holds Boolean, expected numbers"),
    (lambda frame: frame.with_columns(trajectory=pl.col("ranges")), "column 'trajectory' holds List"),
    (lambda frame: frame.with_columns(ranges=pl.lit([None, *RANGES[1:]], pl.List(pl.Float64))), "row 1: a range is"),
]


@pytest.mark.parametrize(
    ("fmt", "change", "message"),
    [
        *((fmt, *case) for case in BROKEN for fmt in FORMATS),
        *(("parquet", edited(edit), words) for edit, words in BROKEN_PARQUET),
    ],
)
def test_a_broken_table_is_refused_in_one_line(tmp_path: Path, fmt: Format, change: Change, message: str) -> None:
    save_dataset(scanned(), tmp_path, fmt)
    change(tmp_path)
    with refused(DataError, match=rf"scans\.\w+[:,] {message}"):
        list(scans_of(tmp_path))


@pytest.mark.parametrize(
    "dtype", [pl.List(pl.Float64), pl.List(pl.Int16), pl.Array(pl.Float32, 7), pl.Array(pl.UInt8, 7)]
)
def test_lists_and_arrays_of_any_numbers_are_read(tmp_path: Path, dtype: pl.DataType) -> None:
    save_dataset(scanned(), tmp_path)
    whole = read_frame(tmp_path, "scans").with_columns(
        ranges=pl.lit([1, 2, 3, 4, 5, 6, 7], pl.List(pl.Int64)).cast(dtype)
    )
    write_frame(tmp_path, "scans", whole)
    np.testing.assert_array_equal(scans_of(tmp_path).of("run-2").ranges, np.tile(np.arange(1.0, 8.0), (3, 1)))


def test_names_that_are_numbers_or_formulas_stay_names(tmp_path: Path) -> None:
    data = everything_known()
    runs = [replace(run, id=name) for run, name in zip(data.trajectories, ("007", "=7"), strict=True)]
    scans = ScansInMemory(SCANNER, {"007": some_scans(2, 1), "=7": some_scans(3, 2)})
    for table_format in FORMATS:
        save_dataset(replace(data, trajectories=tuple(runs), scans=scans), tmp_path, table_format)
        assert {name: len(found.times) for name, found in scans_of(tmp_path)} == {"007": 2, "=7": 3}
    assert "\n=" not in (tmp_path / "scans.csv").read_text()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (None, r"dataset\.yaml: scanner is missing, which scans\.\w+ needs"),
        ({"rays": 0}, r"scanner\.rays: .*greater than 0 \(given: 0\)"),
        ({"range_max": 0.05}, r"scanner: range_min 0\.1 m .* range_max 0\.05 m"),
        ({"angle_increment": 0.0}, "scanner: angle_increment is 0"),
        ({"angle_increment": 30.0}, r"scanner: 7 rays, 30 rad apart"),
        ({"angle_minimum": -1.0}, r"'scanner\.angle_minimum'; did you mean 'angle_min'"),
    ],
)
def test_a_scanner_that_cannot_be_is_refused(tmp_path: Path, changes: dict[str, float] | None, message: str) -> None:
    save_dataset(scanned(), tmp_path)
    header = yaml.safe_load((tmp_path / "dataset.yaml").read_text())
    header["scanner"] = None if changes is None else header["scanner"] | changes
    (tmp_path / "dataset.yaml").write_text(yaml.safe_dump(header))
    with pytest.raises(DataError, match=message):
        load_dataset(tmp_path)


def test_two_tables_of_scans_are_refused(tmp_path: Path) -> None:
    save_dataset(scanned(), tmp_path)
    (tmp_path / "scans.csv").write_text("trajectory,t,ranges\n")
    with pytest.raises(DataError, match=r"both scans\.parquet and scans\.csv are there"):
        load_dataset(tmp_path)


def test_damage_never_shows_as_a_traceback(folder: Path) -> None:
    file = table_file(folder, "scans")
    content, rng = file.read_bytes(), random.Random(3)
    damages = [content[:length] for length in (0, 4, len(content) // 2, len(content) - 3)]
    for _ in range(30):
        damaged = bytearray(content)
        for _ in range(3):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        damages.append(bytes(damaged))
    told = 0
    for damage in damages:
        file.write_bytes(damage)
        try:
            list(scans_of(folder))
        except OmnibenchError:
            told += 1
    assert told > 5
