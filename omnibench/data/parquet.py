"""Parquet files of recordings: what is unreadable, packed too tightly or no name or number is refused in one line."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl
from polars.io.plugins import register_io_source

from omnibench.errors import DataError
from omnibench.files import TableFormat, check_file, quoted_formulas

_LARGE = 1 << 27  # bytes in memory up to which a file may be packed as tightly as it likes; chosen
_PACKED = 100  # times smaller than in memory: stamps, which increase, do not pack so tightly; chosen
_LONGEST_CELL = 10_000  # characters of a text in a table, of which names are the longest; chosen


@contextmanager
def readable(file: Path) -> Iterator[None]:
    """Turn what Polars raises while it reads a file into a DataError."""
    try:
        yield
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        raise DataError(f"{file}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


class OpenedTable(NamedTuple):
    """A table's file that is read in parts. state: its time of change, ns, and size, bytes, when it was opened."""

    file: Path
    state: tuple[int, int]

    @classmethod
    def of(cls, file: Path) -> OpenedTable:
        """The file as it is now. DataError: it cannot be read."""
        with readable(file):
            return cls(file, (file.stat().st_mtime_ns, file.stat().st_size))

    def rows(self, columns: Sequence[str], first: int = 0, count: int | None = None) -> pl.DataFrame:
        """Some rows of columns, in CSV as text. DataError: unreadable, or changed since it was opened."""
        if OpenedTable.of(self.file) != self:
            changed = "the file has changed since it was opened; load it, or run the command, again"
            raise DataError(f"{self.file}: {changed}")
        with readable(self.file):
            return self.lazy().select(columns).slice(first, count).collect()

    def lazy(self) -> pl.LazyFrame:
        """The table, unread."""
        if self.file.suffix == ".parquet":
            return pl.scan_parquet(self.file, glob=False)
        return pl.scan_csv(self.file, infer_schema=False, glob=False)


def parquet_shape(file: Path) -> tuple[int, pl.Schema]:
    """Number of rows, and types of the columns by name. DataError: unreadable, or packed as no recording can be."""
    check_file(file)
    with readable(file):
        scanned = pl.scan_parquet(file, glob=False)
        rows, schema = int(scanned.select(pl.len()).collect().item()), scanned.collect_schema()
        size, packed = rows * len(schema) * 8, file.stat().st_size
    if size > _LARGE and size > _PACKED * packed:
        large = f"its {packed / 1e6:.3g} MB would unpack to {size / 1e9:.3g} GB ({rows:,} rows), as no recording does"
        raise DataError(f"{file}: {large}; write it anew, or leave it out")
    return rows, schema


def scan_table(file: Path) -> tuple[int, pl.LazyFrame]:
    """Number of rows of a Parquet file, and its columns, unread.

    DataError as for parquet_shape; a column holds lists, or a text that is no name.
    """
    rows, types = parquet_shape(file)
    for column, kind in types.items():
        if kind.is_nested():
            raise DataError(f"{file}: column {column!r} holds {kind}, expected names or numbers")
    with readable(file):
        frame = pl.scan_parquet(file, glob=False)
        lengths = frame.select(pl.col(pl.String).str.len_chars().max()).collect()
    for longest in lengths.iter_columns():
        if (longest[0] or 0) > _LONGEST_CELL:
            text = f"a text of {longest[0]:,} characters"
            raise DataError(f"{file}: column {longest.name!r} has {text}, expected names or numbers")
    return rows, frame


def seconds(place: int, kind: pl.DataType) -> pl.Expr:
    """A column by its index; one of dates or durations in seconds."""
    column = pl.nth(place)
    if kind == pl.Date:
        column = column.cast(pl.Datetime("ns"))
    if kind in (pl.Date, pl.Datetime):
        return column.dt.epoch("ns") / 1e9
    return column.dt.total_nanoseconds() / 1e9 if kind == pl.Duration else column


def sink_frames(
    frames: Iterable[pl.DataFrame], types: Mapping[str, pl.DataType], table_format: TableFormat, rows: int, file: Path
) -> None:
    """Write frames one after another to a table's file, of which ``rows`` rows are in memory at a time.

    types: of the columns, by name. DataError as the frames raise. OSError: the disk refuses.
    """

    def formatted(*_: Any) -> Iterator[pl.DataFrame]:
        for frame in frames:
            for part in frame.iter_slices(rows):
                yield quoted_formulas(part) if table_format == "csv" else part

    table = register_io_source(formatted, schema=types)
    try:
        with file.open("wb") as opened:  # polars would open it at any time, even after a break has removed it
            if table_format == "csv":
                table.sink_csv(opened, maintain_order=True)
            else:
                table.sink_parquet(opened, row_group_size=rows, maintain_order=True)
    except (pl.exceptions.PolarsError, OSError) as error:
        if number := re.search(r"\(os error (\d+)\)", str(error)):
            raise OSError(int(number[1]), os.strerror(int(number[1]))) from None
        raise (error if isinstance(error, OSError) else OSError(errno.EIO, str(error))) from None
