"""Scans on disk: ``scans.parquet`` (or CSV) of a data set, read one trajectory at a time."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import polars as pl

from omnibench.data.scans import Scanner, Scans, TrajectoryScans
from omnibench.errors import DataError, nearest
from omnibench.files import TableFormat, encode_table

_COLUMNS = ("trajectory", "t", "ranges")
_ROW_GROUP = 256  # rows that are read at once; about 1 MB


def scans_file(folder: Path) -> Path | None:
    """The table of scans in a data set's folder, if there is one. DataError when there are two."""
    files = [file for file in (folder / "scans.parquet", folder / "scans.csv") if file.is_file()]
    if len(files) > 1:
        raise DataError(f"{folder}: both scans.parquet and scans.csv are there; remove the one that is not meant")
    return files[0] if files else None


class ScansOnDisk(Scans):
    """A table of scans. Making it checks stamps and names; ranges are checked when a trajectory's scans are read.

    DataError in one line names the file, the row (1 is the first) and what is wrong.
    """

    def __init__(self, file: Path, scanner: Scanner, trajectories: Iterable[str]) -> None:
        self.file, self.scanner = file, scanner
        self._index = self._read_index(set(trajectories))

    @property
    def trajectories(self) -> tuple[str, ...]:
        return tuple(self._index)

    def of(self, trajectory: str) -> TrajectoryScans:
        if trajectory not in self._index:
            raise DataError(f"{self.file}: trajectory {trajectory} has no scans")
        rows = self._index[trajectory]
        try:
            chosen = self._lazy().filter(pl.col("trajectory").cast(pl.String) == trajectory).collect()
        except pl.exceptions.PolarsError as error:
            raise DataError(f"{self.file}: cannot be read: {error}") from None
        column = self._numbers(chosen["ranges"], rows)
        lengths = column.list.len().fill_null(0).to_numpy()
        for row in np.flatnonzero(lengths != self.scanner.rays)[:1]:
            raise self._fail(
                int(rows[row]), f"the scan has {lengths[row]} ranges, but scanner.rays is {self.scanner.rays}"
            )
        values = column.explode().cast(pl.Float32).fill_null(np.nan).to_numpy()
        ranges = values.reshape(len(rows), self.scanner.rays)
        for row in np.flatnonzero(np.isnan(ranges).any(axis=1))[:1]:
            raise self._fail(int(rows[row]), "a range is missing or NaN; inf says that nothing was seen")
        for row in np.flatnonzero(~self.scanner.valid(ranges).any(axis=1))[:1]:
            raise self._fail(
                int(rows[row]),
                f"the scan of trajectory {trajectory} at {chosen['t'][int(row)]:g} s is empty: no range from "
                f"{self.scanner.range_min:g} to {self.scanner.range_max:g} m; remove the row",
            )
        return TrajectoryScans(chosen["t"].cast(pl.Float64).to_numpy(), ranges)

    def _lazy(self) -> pl.LazyFrame:
        if self.file.suffix == ".parquet":
            return pl.scan_parquet(self.file)
        return pl.scan_csv(self.file, schema_overrides={"trajectory": pl.String, "ranges": pl.String})

    def _read_index(self, known: set[str]) -> dict[str, np.ndarray]:
        """Rows of every trajectory, in its order."""
        try:
            columns = self._lazy().collect_schema().names()
            for column in _COLUMNS:
                if column not in columns:
                    raise DataError(
                        f"{self.file}: column {column!r} is missing; {nearest(column, columns)}"
                        f"found: {', '.join(columns)}"
                    )
            frame = self._lazy().select(pl.col("trajectory").cast(pl.String), pl.col("t")).collect()
        except (pl.exceptions.PolarsError, OSError) as error:
            raise DataError(f"{self.file}: cannot be read: {error}") from None
        if frame.is_empty():
            raise DataError(f"{self.file}: it has no rows; remove it, or record scans")
        if not frame["t"].dtype.is_numeric():
            raise DataError(f"{self.file}: column 't' holds {frame['t'].dtype}, expected numbers")
        times = frame["t"].cast(pl.Float64).fill_null(np.nan).to_numpy()
        for row in np.flatnonzero(~np.isfinite(times))[:1]:
            raise self._fail(int(row), f"t is {frame['t'][int(row)]}; remove or repair the row")
        index = {}
        grouped = frame.with_row_index("row").group_by("trajectory", maintain_order=True).agg(pl.col("row"))
        for trajectory, rows in grouped.iter_rows():
            if trajectory not in known:
                raise self._fail(rows[0], f"trajectory {trajectory} is not in the table of trajectories")
            found = np.array(rows)
            for bad in np.flatnonzero(np.diff(times[found]) <= 0)[:1]:
                row, before = int(found[bad + 1]), int(found[bad])
                raise self._fail(row, f"t goes backwards or is repeated: {times[row]:g} after {times[before]:g}")
            index[trajectory] = found
        return index

    def _numbers(self, column: pl.Series, rows: np.ndarray) -> pl.Series:
        """The ranges as lists of numbers; in CSV they are a text with blanks between them."""
        if isinstance(column.dtype, pl.Array):
            column = column.arr.to_list()
        if column.dtype == pl.String:
            texts = column.str.strip_chars().str.split(" ")
            values = texts.list.eval(pl.element().cast(pl.Float32, strict=False))
            broken = texts.list.eval(pl.element().is_not_null()).list.sum() != values.list.drop_nulls().list.len()
            for row in broken.arg_true()[:1]:
                raise self._fail(int(rows[row]), "ranges must be numbers with a blank between them")
            return values
        if not isinstance(column.dtype, pl.List) or not column.dtype.inner.is_numeric():
            raise DataError(f"{self.file}: column 'ranges' holds {column.dtype}, expected lists of numbers")
        return column

    def _fail(self, row: int, what: str) -> DataError:
        return DataError(f"{self.file}, row {row + 1}: {what}")


def encode_scans(scans: Scans, table_format: TableFormat) -> bytes:
    """The content of the table's file, every range to the scanner's float precision."""
    frames = [
        pl.DataFrame(
            {"trajectory": [trajectory] * len(found.times), "t": found.times, "ranges": found.ranges},
            schema={"trajectory": pl.String, "t": pl.Float64, "ranges": pl.Array(pl.Float32, scans.scanner.rays)},
        ).with_columns(pl.col("ranges").arr.to_list())
        for trajectory, found in scans
    ]
    table = pl.concat(frames)
    if table_format == "csv":
        table = table.with_columns(pl.col("ranges").cast(pl.List(pl.String)).list.join(" "))
        return encode_table(table, "csv")
    return encode_table(table, "parquet", _ROW_GROUP)
