"""A table of a data set, Parquet or CSV; every flaw is reported with its file and row."""

from __future__ import annotations

import glob
import os
import shlex
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import polars as pl
from numpy.typing import NDArray

from omnibench.config import LONGEST_NAME
from omnibench.data.delimited import missing_column
from omnibench.data.run_checks import LARGEST, Flaw, wheel_times_flaw
from omnibench.data.stored_rows import read_parquet, readable
from omnibench.errors import DataError, nearest
from omnibench.files import MOST_TEXT, check_file, unquoted_formulas
from omnibench.robot.kinematics import Array, Robot

# Names may consist of digits: 007 is not 7.
_TEXTS = dict.fromkeys(("trajectory", "command", "split", "session"), pl.String)


class Table:
    """A table and the file it came from. Rows of messages count from 1, the first after the header.

    rows_before: rows of the file that stand before those of the frame.
    """

    def __init__(self, file: Path, frame: pl.DataFrame, rows_before: int = 0) -> None:
        self.file = file
        self.frame = frame
        self.rows_before = rows_before

    def fail(self, row: int, what: str) -> DataError:
        """The error to raise for ``row``, counted from 0."""
        return DataError(f"{self.file}, row {self.rows_before + row + 1}: {what}")

    def refuse(self, faulty: NDArray[np.bool_] | pl.Series, words: Callable[[int], str]) -> None:
        """DataError for the first row that is ``faulty`` (rows,). words: what is wrong in that row, counted from 0."""
        for row in np.flatnonzero(faulty)[:1]:
            raise self.fail(int(row), words(int(row)))

    def floats(self, column: str) -> pl.Series:
        """A column as floats, null where a cell is empty. DataError for text and other things."""
        series = self.frame[column]
        if series.dtype != pl.String:
            if not series.dtype.is_numeric() and series.null_count() < len(series):
                raise DataError(f"{self.file}: column {column!r} holds {series.dtype}, expected numbers")
            return series.cast(pl.Float64)
        values = series.str.strip_chars().cast(pl.Float64, strict=False)  # one odd cell makes a CSV column text
        odd = values.is_null() & series.is_not_null()
        self.refuse(odd, lambda row: f"{column} is {series[row]!r}, expected a number")
        return values

    def numbers(self, column: str) -> Array:
        """A column as finite floats (rows,). DataError names the first value that is missing or not finite."""
        series = self.floats(column)
        values = series.fill_null(np.nan).to_numpy()
        self.refuse(
            ~np.isfinite(values),
            lambda row: f"{column} is {'missing' if series[row] is None else series[row]}; remove or repair the row",
        )
        huge = np.abs(values) > LARGEST
        way = "count the time from the start of its run" if column == "t" else "check the units"
        self.refuse(huge, lambda row: f"{column} is {values[row]:g}, which no robot can reach; {way}")
        return values

    def name_trajectories(self) -> None:
        """Make the trajectories' ids texts. DataError: one is missing, or no name or number, or a name is too long."""
        ids = self.frame["trajectory"]
        if ids.dtype.is_nested():
            raise DataError(f"{self.file}: column 'trajectory' holds {ids.dtype}, expected names or numbers")
        self.refuse(ids.is_null(), lambda _: "trajectory is missing")
        self.frame = self.frame.with_columns(ids.cast(pl.String))
        for column in _TEXTS:
            if column in self.frame.columns and (names := self.frame[column]).dtype == pl.String:
                for row in (names.str.len_chars() > LONGEST_NAME).fill_null(value=False).arg_true()[:1]:
                    raise self.fail(row, f"{column} has more than {LONGEST_NAME} characters; shorten it")

    def stack(self, columns: Sequence[str]) -> Array | None:
        """Optional columns as (rows, n), or None when none is there. DataError when only some are."""
        missing = [column for column in columns if column not in self.frame.columns]
        if len(missing) == len(columns):
            return None
        if missing:
            raise DataError(f"{self.file}: column {missing[0]!r} is missing; give all of {', '.join(columns)} or none")
        return np.column_stack([self.numbers(column) for column in columns])


def read_table(folder: Path, name: str, required: Sequence[str]) -> Table:
    """The table called ``name`` of a data set. DataError when it, its rows or a required column are missing."""
    file = table_file(folder, name)
    if file is None:
        raise DataError(f"{folder}: {name}.parquet (or {name}.csv) is missing")
    if file.suffix == ".parquet":
        return checked_table(file, read_parquet(file), required)
    check_file(file, MOST_TEXT, text=True)
    with readable(file):
        frame = pl.read_csv(file, infer_schema_length=None, schema_overrides=_TEXTS, glob=False)
    twice = [column for column in frame.columns if "_duplicated_" in column]
    if twice:  # polars' name for the second of two
        raise DataError(f"{file}: column {twice[0].partition('_duplicated_')[0]!r} is there twice; remove one")
    return checked_table(file, unquoted_formulas(frame), required)


def checked_table(file: Path, frame: pl.DataFrame, required: Sequence[str], rows_before: int = 0) -> Table:
    """A frame as a table. DataError when it has no rows, or a required column or a trajectory's name is missing.

    file: where it is from; of a frame in memory its name in messages. rows_before: as in Table.
    """
    check_columns(file, frame.columns, required)
    if frame.is_empty():
        raise DataError(f"{file}: it has no rows")
    table = Table(file, frame, rows_before)
    table.name_trajectories()
    return table


def check_columns(file: Path, columns: Sequence[str], required: Sequence[str]) -> None:
    """DataError names the required columns that are not among those of a file."""
    if missing := [column for column in required if column not in columns]:
        raise missing_column(file, missing[0], columns, missing[1:])


def table_file(folder: Path, name: str) -> Path | None:
    """The file of the table called ``name`` in a data set's folder, if there is one. DataError when there are two."""
    files = [file for file in (folder / f"{name}.parquet", folder / f"{name}.csv") if file.exists()]
    if len(files) > 1:
        raise DataError(f"{folder}: both {name}.parquet and {name}.csv are there; remove the one that is not meant")
    return files[0] if files else None


_MAGIC = "*?["


def dataset_folders(places: Path | str | Sequence[Path | str]) -> list[Path]:
    """The folders that places name: each a data set folder or a glob, whose folders come in the order of their names.

    A folder that is named twice counts once. DataError: a glob matches no data set folder, or one without dataset.yaml
    that has wheel samples; or nothing is named.
    """
    if isinstance(places, Path | str):
        places = [places]
    folders = {folder.resolve(): folder for place in places for folder in _named(Path(place))}
    if not folders:
        raise DataError("no data set folder is named")
    return list(folders.values())


def is_glob(place: Path) -> bool:
    """True for a pattern, which no file or folder has as its name."""
    return any(sign in str(place) for sign in _MAGIC) and not place.exists()


def in_few_words(folders: Sequence[Path]) -> str:
    """The folders as words of a shell: a glob that names just these, where there is one, else one by one."""
    begin = os.path.commonprefix([str(folder) for folder in folders])  # noqa: RUF071 (a glob's begin is no path)
    in_one_folder = len(folders) > 2 and begin.startswith(f"{folders[0].parent}/")
    if in_one_folder and _found(f"{glob.escape(begin)}*") == list(folders):
        return f"{shlex.quote(begin)}*"
    return shlex.join(map(str, folders))


def _named(place: Path) -> list[Path]:
    if not is_glob(place):
        return [place]
    pattern = str(place)
    if not (folders := _found(pattern)):
        matching = sorted(glob.glob(pattern, recursive=True))
        seen = f"; {matching[0]} has no dataset.yaml" if matching else ""
        raise DataError(f"{place}: no data set folder matches{seen}")
    return folders


def _found(pattern: str) -> list[Path]:
    matching = [Path(match) for match in sorted(glob.glob(pattern, recursive=True))]
    for match in matching:
        if table_file(match, "wheels") is not None and not (match / "dataset.yaml").is_file():
            raise DataError(f"{match}: it has wheel samples, but no dataset.yaml; write one there, or name the others")
    return [match for match in matching if (match / "dataset.yaml").is_file()]


Rows = np.ndarray[Any, np.dtype[np.intp]]  # indices of rows of a table


def rows_by_trajectory(runs: Table, table: Table, others: Collection[str] = ()) -> list[Rows]:
    """The rows of ``table`` that belong to each run, in the file's order; a run among the others may have none."""
    ids = runs.frame["trajectory"].to_list()
    number = {identity: index for index, identity in enumerate(ids)}
    codes = np.array([number.get(identity, -1) for identity in table.frame["trajectory"]])
    refuse_unknown(runs, table, codes < 0)
    order = np.argsort(codes, kind="stable")
    counts = np.bincount(codes, minlength=len(ids))
    for index, count in enumerate(counts):
        if count == 0 and ids[index] not in others:
            raise no_rows(table, runs, index)
    return np.split(order, np.cumsum(counts)[:-1])


def refuse_unknown(runs: Table, table: Table, unknown: NDArray[np.bool_] | pl.Series) -> None:
    """DataError for the first row of ``table`` whose run is ``unknown`` (rows,): not in the table of runs."""
    names = table.frame["trajectory"]
    table.refuse(unknown, lambda row: f"trajectory {names[row]} is not in {runs.file.name}")


def no_rows(table: Table, runs: Table, index: int) -> DataError:
    """The error of a run, by its row in the table of runs, that has no rows in another table."""
    what = "wheel samples" if table.file.stem == "wheels" else "reference poses"
    run = runs.frame["trajectory"][index]
    return DataError(f"{table.file}: trajectory {run} ({runs.file.name}, row {index + 1}) has no {what}")


def check_times(table: Table, groups: Sequence[Rows], find_flaw: Callable[[Array, str], Flaw | None]) -> None:
    """DataError for the first run whose times in ``table`` have a flaw. groups: the rows of each run."""
    times = table.numbers("t")
    for rows in groups:
        if (flaw := find_flaw(times[rows], table.frame["trajectory"][int(rows[0])])) is not None:
            raise table.fail(int(rows[flaw[0]]), flaw[1])


class WheelArrays(NamedTuple):
    """A run's wheel samples, as in Trajectory."""

    times: Array
    rates: Array
    steering: Array | None = None
    angles: Array | None = None
    targets: Array | None = None
    odometry: Array | None = None


class WheelSource(Protocol):
    """A table of wheel samples, in memory or in its file."""

    def of_runs(self, runs: Table, robot: Robot) -> list[WheelArrays]:
        """The samples of each of the runs. DataError names the table, the row and what is wrong."""


def wheel_columns(robot: Robot) -> dict[str, list[str]]:
    """The columns of each of the arrays of WheelArrays; those of no length are not there."""
    wheels, steered = robot.wheel_names, robot.drive.steered
    columns = {
        "times": ["t"],
        "rates": [f"omega_{wheel}" for wheel in wheels],
        "steering": [f"steer_{wheel}" for wheel in steered],
        "angles": [f"phi_{wheel}" for wheel in wheels],
        "targets": [f"target_{wheel}" for wheel in wheels],
        "odometry": ["odom_x", "odom_y", "odom_theta"],
    }
    return {name: names for name, names in columns.items() if names}


def check_steering(file: Path, columns: Sequence[str], robot: Robot) -> None:
    """DataError: there is no column with the steering angles of a wheel."""
    for wheel in robot.drive.steered:
        if (column := f"steer_{wheel}") not in columns:
            hint = nearest(column, [name for name in columns if not name.startswith("omega_")])
            raise DataError(
                f"{file}: column {column!r}, the steering angle of wheel {wheel} (rad, counter-clockwise, at "
                f"the sample's end), is missing; {hint}found: {', '.join(columns)}"
            )


@dataclass(frozen=True, eq=False)
class WheelTable:
    """A table of wheel samples in memory."""

    table: Table

    def of_runs(self, runs: Table, robot: Robot) -> list[WheelArrays]:
        """The samples of each of the runs, see WheelSource."""
        table = self.table
        check_steering(table.file, table.frame.columns, robot)
        rows_of_runs = rows_by_trajectory(runs, table)
        check_times(table, rows_of_runs, wheel_times_flaw)
        times = table.numbers("t")
        stacked = {
            name: values
            for name, columns in wheel_columns(robot).items()
            if name != "times" and (values := table.stack(columns)) is not None
        }
        return [
            WheelArrays(times[rows], **{name: values[rows] for name, values in stacked.items()})
            for rows in rows_of_runs
        ]
