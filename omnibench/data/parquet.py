"""Parquet files of recordings: what is unreadable, packed too tightly or no name or number is refused in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import polars as pl

from omnibench.errors import DataError
from omnibench.files import check_file

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


def file_state(file: Path) -> tuple[int, int]:
    """Time of change, ns, and size of a file, bytes. DataError: it cannot be read."""
    with readable(file):
        return file.stat().st_mtime_ns, file.stat().st_size


def check_unchanged(file: Path, state: tuple[int, int]) -> None:
    """DataError: a file is not in the state any more in which it was opened."""
    if file_state(file) != state:
        raise DataError(f"{file}: the file has changed since it was opened; load it, or run the command, again")


def parquet_shape(file: Path) -> tuple[int, pl.Schema]:
    """Number of rows, and types of the columns by name. DataError: unreadable, or packed as no recording can be."""
    check_file(file)
    with readable(file):
        scanned = pl.scan_parquet(file, glob=False)
        rows, schema = int(scanned.select(pl.len()).collect().item()), scanned.collect_schema()
        size, packed = rows * len(schema) * 8, file.stat().st_size
    if size > _LARGE and size > _PACKED * packed:
        raise DataError(
            f"{file}: its {packed / 1e6:.3g} MB would unpack to {size / 1e9:.3g} GB ({rows:,} rows), as no recording "
            "does; write it anew, or leave it out"
        )
    return rows, schema


def read_parquet(file: Path) -> pl.DataFrame:
    """A whole Parquet file. DataError as for parquet_shape; a column holds lists, or a text that is no name."""
    for column, kind in parquet_shape(file)[1].items():
        if kind.is_nested():
            raise DataError(f"{file}: column {column!r} holds {kind}, expected names or numbers")
    with readable(file):
        frame = pl.read_parquet(file, glob=False)
    for longest in frame.select(pl.col(pl.String).str.len_chars().max()).iter_columns():
        if (longest[0] or 0) > _LONGEST_CELL:
            text = f"a text of {longest[0]:,} characters"
            raise DataError(f"{file}: column {longest.name!r} has {text}, expected names or numbers")
    return frame
