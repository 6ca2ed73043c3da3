"""Scans on disk: ``scans.parquet`` (or CSV) of a data set, read and written a trajectory at a time."""

from __future__ import annotations

import errno
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray
from polars.io.plugins import register_io_source

from omnibench.data.delimited import missing_column, not_increasing
from omnibench.data.scans import Ranges, Scanner, Scans, TrajectoryScans
from omnibench.data.stored_rows import count_rows, file_state, readable
from omnibench.data.tables.table import Table
from omnibench.errors import DataError, nearest
from omnibench.files import TableFormat, check_file, quoted_formulas, unquoted_formulas
from omnibench.robot.kinematics import Array

_COLUMNS = ("trajectory", "t", "ranges")
_SCHEMA = {"trajectory": pl.String(), "t": pl.Float64(), "ranges": pl.List(pl.Float32)}
_ROW_GROUP = 256  # rows of a Parquet row group; about 1 MB
_MOST_ROWS = 4096  # rows of a Parquet file that are read at a time; about 20 MB
_ROWS_OF_CSV = 65536  # rows of a CSV file read at a time: more, since every reading begins at its first line

Rows = NDArray[np.intp]


class ScansOnDisk(Scans):
    """A table of scans. Stamps and names are checked at once, ranges when a trajectory's scans are read.

    DataError in one line names the file, the row (1 is the first) and what is wrong.
    """

    def __init__(self, file: Path, scanner: Scanner, trajectories: Iterable[str]) -> None:
        self.file, self.scanner = file, scanner
        self._state = file_state(self.file)
        self._index = self._read_index(set(trajectories))

    @property
    def trajectories(self) -> tuple[str, ...]:
        return tuple(self._index)

    def times(self, trajectory: str) -> Array:
        return self._indexed(trajectory)[1]

    def of(self, trajectory: str) -> TrajectoryScans:
        rows, times = self._indexed(trajectory)
        if file_state(self.file) != self._state:
            raise DataError(
                f"{self.file}: the file has changed since it was opened; load it, or run the command, again"
            )
        ranges = np.empty((len(rows), self.scanner.rays), np.float32)
        for part in _parts(rows, _MOST_ROWS if self.file.suffix == ".parquet" else _ROWS_OF_CSV):
            ranges[part] = self._read(rows[part], f"trajectory {trajectory}", times[part])
        return TrajectoryScans(times, ranges)

    def _indexed(self, trajectory: str) -> tuple[Rows, Array]:
        if trajectory not in self._index:
            raise DataError(f"{self.file}: trajectory {trajectory} has no scans")
        return self._index[trajectory]

    def _collect(self, table: pl.LazyFrame) -> pl.DataFrame:
        with readable(self.file):
            return table.collect()

    def _lazy(self) -> pl.LazyFrame:
        if self.file.suffix == ".parquet":
            return pl.scan_parquet(self.file, glob=False)
        # Cells are read as text, so that one that is no number is reported with its row.
        return pl.scan_csv(self.file, infer_schema=False, glob=False)

    def _read(self, rows: Rows, whose: str, times: Array) -> Ranges:
        """The checked ranges (n, R) of some rows."""
        first, last = int(rows[0]), int(rows[-1])
        column = self._collect(self._lazy().select("ranges").slice(first, last - first + 1))["ranges"]
        column = self._numbers(column[rows - first] if len(rows) < len(column) else column, rows)
        lengths = column.list.len().fill_null(0).to_numpy()
        for index in np.flatnonzero(lengths != self.scanner.rays)[:1]:
            problem = f"the scan has {lengths[index]} ranges, but scanner.rays is {self.scanner.rays}"
            raise self._fail(int(rows[index]), problem)
        ranges = column.explode().cast(pl.Float32).fill_null(np.nan).to_numpy().reshape(len(rows), -1)
        for index in np.flatnonzero(np.isnan(ranges).any(axis=1))[:1]:
            raise self._fail(int(rows[index]), "a range is missing or NaN; write inf where nothing was seen")
        for index in np.flatnonzero(~self.scanner.valid(ranges).any(axis=1))[:1]:
            seen = ranges[index][np.isfinite(ranges[index])]
            in_millimetres = len(seen) > 0 and self.scanner.valid(seen / 1000).mean() > 0.5
            raise self._fail(
                int(rows[index]),
                f"the scan of {whose} at {times[index]:g} s is empty: no range from "
                f"{self.scanner.range_min:g} to {self.scanner.range_max:g} m; "
                + ("they look like mm, give m" if in_millimetres else "remove the row"),
            )
        return ranges

    def _numbers(self, column: pl.Series, rows: Rows) -> pl.Series:
        """The column of ranges as lists of numbers; in CSV a cell is text with blanks between the numbers."""
        if isinstance(column.dtype, pl.Array):
            column = column.arr.to_list()
        if column.dtype == pl.String:
            texts = column.str.strip_chars().str.split(" ")
            values = texts.list.eval(pl.element().cast(pl.Float32, strict=False))
            broken = texts.list.len() != values.list.drop_nulls().list.len()
            for index in broken.arg_true()[:1]:
                raise self._fail(int(rows[index]), "ranges must be numbers, in CSV with a blank between them")
            return values
        if not isinstance(column.dtype, pl.List) or not column.dtype.inner.is_numeric():
            raise DataError(f"{self.file}: column 'ranges' holds {column.dtype}, expected lists of numbers")
        return column

    def _read_index(self, known: set[str]) -> dict[str, tuple[Rows, Array]]:
        """Rows and stamps of every trajectory, in its order."""
        table = self._names_and_stamps()
        times = table.numbers("t")
        table.refuse(times < 0, lambda row: f"t is {times[row]:g}; it must not be negative")
        index = {}
        grouped = table.frame.with_row_index("row").group_by("trajectory", maintain_order=True).agg(pl.col("row"))
        for trajectory, rows in zip(grouped["trajectory"], grouped["row"], strict=True):
            run_rows: Rows = rows.to_numpy().astype(np.intp)
            if trajectory not in known:
                problem = f"trajectory {trajectory} is not in the table of trajectories; {nearest(trajectory, known)}"
                raise table.fail(int(run_rows[0]), problem.rstrip("; "))
            stamps = times[run_rows]
            flaw = not_increasing(stamps)
            if flaw is not None:
                raise table.fail(int(run_rows[flaw[0]]), f"t {flaw[1]}")
            index[str(trajectory)] = run_rows, stamps
        return index

    def _names_and_stamps(self) -> Table:
        """The checked columns of trajectories and stamps."""
        if self.file.suffix == ".parquet":
            count_rows(self.file)
        else:
            check_file(self.file, text=True)
        with readable(self.file):
            schema = self._lazy().collect_schema()
        for column in _COLUMNS:
            if column not in schema:
                raise missing_column(self.file, column, schema)
        frame = self._collect(self._lazy().select("trajectory", "t"))
        if frame.is_empty():
            raise DataError(f"{self.file}: it has no rows; remove it, or record scans")
        table = Table(self.file, frame if self.file.suffix == ".parquet" else unquoted_formulas(frame))
        table.name_trajectories()
        return table

    def _fail(self, row: int, what: str) -> DataError:
        return DataError(f"{self.file}, row {row + 1}: {what}")


def write_scans(scans: Scans, table_format: TableFormat, trajectories: Iterable[str], file: Path) -> None:
    """Write the scans of ``trajectories``, of those that have some; one trajectory's are in memory at a time.

    Ranges are written in single precision. DataError: scans cannot be read. OSError: the disk refuses.
    """
    recorded = set(scans.trajectories)
    chosen = [trajectory for trajectory in trajectories if trajectory in recorded]
    as_text = table_format == "csv"

    def frames(*_: Any) -> Iterator[pl.DataFrame]:
        for trajectory in chosen:
            yield from _frames(trajectory, scans.of(trajectory), as_text)

    table = register_io_source(frames, schema=_SCHEMA | ({"ranges": pl.String()} if as_text else {}))
    try:
        if as_text:
            table.sink_csv(file, maintain_order=True)
        else:
            table.sink_parquet(file, row_group_size=_ROW_GROUP, maintain_order=True)
    except pl.exceptions.PolarsError as error:
        raise OSError(errno.EIO, str(error)) from None


def _frames(trajectory: str, scans: TrajectoryScans, as_text: bool) -> Iterator[pl.DataFrame]:
    rays = scans.ranges.shape[1]
    for first in range(0, len(scans.times), _ROW_GROUP):
        part = slice(first, first + _ROW_GROUP)
        times, ranges = scans.times[part], np.asarray(scans.ranges[part], dtype=np.float32)
        frame = pl.DataFrame(
            {"trajectory": [trajectory] * len(times), "t": times, "ranges": ranges},
            schema={"trajectory": pl.String, "t": pl.Float64, "ranges": pl.Array(pl.Float32, rays)},
        ).with_columns(pl.col("ranges").arr.to_list())
        if as_text:
            joined = pl.col("ranges").cast(pl.List(pl.String)).list.join(" ")
            frame = quoted_formulas(frame.with_columns(joined))
        yield frame


def _parts(rows: Rows, most: int) -> Iterator[slice]:
    """Slices of increasing row numbers, each of which spans at most ``most`` rows of the file."""
    begin = 0
    while begin < len(rows):
        end = int(np.searchsorted(rows, rows[begin] + most))
        yield slice(begin, end)
        begin = end
