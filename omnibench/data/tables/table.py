"""A table of a data set, Parquet or CSV; every flaw is reported with its file and row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from omnibench.config import LONGEST_NAME
from omnibench.data.delimited import missing_column
from omnibench.data.run_checks import LARGEST
from omnibench.data.stored.stored_rows import read_parquet, readable
from omnibench.errors import DataError
from omnibench.files import MOST_TEXT, check_file, unquoted_formulas
from omnibench.robot.kinematics import Array

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
