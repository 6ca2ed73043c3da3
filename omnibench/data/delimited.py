"""Reading of tables of numbers, from delimited text or Parquet; every flaw is reported with its file and row."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from omnibench.errors import DataError, nearest
from omnibench.files import read_text
from omnibench.robot.kinematics import Array

if TYPE_CHECKING:
    import polars as pl

AUTO = "auto"  # as a separator: the one that the header holds
BLANK = frozenset({"", "nan", "na", "n/a", "null", "none", "-"})  # cells without a value, in any case
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+")
_COMMAS = " (decimal commas? --set decimal=comma with --set separator)"


class ColumnError(DataError):
    """A table has not the columns that are expected of it."""


class NoRowsError(DataError):
    """A table has a header at most."""


@dataclass(frozen=True, eq=False)
class NumberTable:
    """Named columns of finite numbers. values (rows, n). lines (rows,): the line of the file that a row came from."""

    file: Path
    names: tuple[str, ...]
    values: Array
    lines: NDArray[np.intp]

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def column(self, name: str) -> Array:
        """One column (rows,)."""
        column: Array = self.values[:, self.names.index(name)]
        return column

    def columns(self, names: Sequence[str]) -> Array:
        """Several columns (rows, n), in the order asked for."""
        columns: Array = self.values[:, [self.names.index(name) for name in names]]
        return columns

    def increasing(self, name: str) -> Array:
        """One column (rows,), which must increase; DataError names the first row that does not."""
        values = self.column(name)
        flaw = not_increasing(values)
        if flaw is not None:
            raise self.fail(flaw[0], f"{name} {flaw[1]}")
        return values

    def only(self, kept: NDArray[np.bool_]) -> NumberTable:
        """The table of some of the rows."""
        return NumberTable(self.file, self.names, self.values[kept], self.lines[kept])

    def fail(self, row: int, what: str) -> DataError:
        """The error of one row (0 is the first)."""
        return row_error(self.file, row, int(self.lines[row]), what)


@dataclass(frozen=True, eq=False)
class CellTable:
    """A table as it stands in its file: columns of texts, or of numbers where the file is Parquet.

    names: of the columns, numbers from 1 where there is no header. columns: cells (rows,) of each. lines (rows,): the
    line of the file that a row came from. headed: the names come from a header.
    """

    file: Path
    names: tuple[str, ...]
    columns: tuple[Sequence[str] | Array, ...]
    lines: NDArray[np.intp]
    headed: bool = True

    def __len__(self) -> int:
        return len(self.lines)

    def named(self, names: Sequence[str]) -> CellTable:
        """The table with other names of its columns."""
        return replace(self, names=tuple(names))

    def in_lower_case(self) -> CellTable:
        """The table with the names of its columns in lower case, for tables whose names are given."""
        return self.named([name.lower() for name in self.names])

    def only(self, rows: NDArray[np.intp]) -> CellTable:
        """The table of some of the rows, by their indices."""
        columns = tuple(
            column[rows] if isinstance(column, np.ndarray) else [column[row] for row in rows.tolist()]
            for column in self.columns
        )
        return replace(self, columns=columns, lines=self.lines[rows])

    def missing(self, names: Iterable[str]) -> list[str]:
        """The names that no column has, by name or by its number, from 1."""
        return [name for name in names if name not in self.names and not _is_number(name, self.names)]

    def fail(self, row: int, what: str) -> DataError:
        """The error of one row (0 is the first)."""
        return row_error(self.file, row, int(self.lines[row]), what)

    def texts(self, name: str) -> list[str]:
        """One column as texts; whole numbers without a decimal point."""
        column = self.columns[self._index(name)]
        if not isinstance(column, np.ndarray):
            return [cell.strip() for cell in column]
        return [f"{value:.15g}" if np.isfinite(value) else "" for value in column.tolist()]

    def numbers(self, names: Sequence[str]) -> Array:
        """Columns as numbers (rows, n), NaN where a cell is blank. DataError: a cell holds something else."""
        chosen = [self._index(name) for name in names]
        numbers = np.empty((len(self), len(names)))
        for place, index in enumerate(chosen):
            column = self.columns[index]
            try:
                numbers[:, place] = column
            except ValueError:
                numbers[:, place] = [self._number(names[place], row, cell) for row, cell in enumerate(column)]
        return numbers

    def finite(self, names: Sequence[str]) -> NumberTable:
        """Columns of finite numbers. DataError names the first cell that is not one."""
        table = NumberTable(self.file, tuple(names), self.numbers(names), self.lines)
        for row, place in np.argwhere(~np.isfinite(table.values))[:1].tolist():
            cell = str(self.columns[self._index(names[place])][row]).strip()
            flaw = f"is {cell}; remove or repair the row" if cell else "is missing"
            raise table.fail(row, f"{names[place]} {flaw}")
        return table

    def _number(self, name: str, row: int, cell: str) -> float:
        text = str(cell).strip()
        if text.lower() in BLANK:
            return np.nan
        try:
            return float(text)
        except ValueError:
            hint = "; of decimal commas say --set decimal=comma" if DECIMAL_COMMA.fullmatch(text) else ""
            what = f"{name} is {text!r}, expected a number{hint}"
            raise self.fail(row, what) from None

    def _index(self, name: str) -> int:
        return _place(self.file, name, self.names)


def read_cells(
    file: Path,
    required: Sequence[str] = (),
    *,
    separator: str | None = ",",
    header_lines: int = 1,
    decimal_comma: bool = False,
) -> CellTable:
    """The cells of a delimited text file, or of a Parquet file.

    The last of the header lines names the columns; without header lines they are numbered. separator: None for white
    space, with comments from ``#`` on; ``auto``: a semicolon, a tab or a comma, whichever the header holds. Blank lines
    are skipped. DataError: the file cannot be read, a column that is required is missing or named twice (ColumnError),
    it has no rows (NoRowsError), a row has more or fewer fields than columns.
    """
    if file.suffix == ".parquet":
        # Dates become seconds since 1970, durations seconds.
        import polars as pl

        from omnibench.data.stored_rows import read_parquet

        frame = read_parquet(file)
        if frame.is_empty():
            raise NoRowsError(f"{file}: it has no rows")
        cells = [
            column.fill_null("").to_list()
            if column.dtype == pl.String
            else _seconds(column).cast(pl.Float64, strict=False).fill_null(np.nan).to_numpy()
            for column in frame.iter_columns()
        ]
        return CellTable(file, tuple(frame.columns), tuple(cells), np.arange(1, len(frame) + 1))
    text = read_text(file)
    lines = _split_lines(file, text, _separator(text, header_lines) if separator == AUTO else separator)
    rows = lines[header_lines:]
    if header_lines:
        if len(lines) < header_lines:
            raise DataError(f"{file}: it has no header with the names of its columns; repair it, or take it out")
        names = [name.strip() for name in lines[header_lines - 1][1]]
        names[0] = names[0].lstrip("# ")  # as numpy.savetxt writes it
    else:
        names = [str(number) for number in range(1, len(rows[0][1]) + 1)] if rows else []
    for name in required:
        _place(file, name, names)
    if not rows:
        raise NoRowsError(f"{file}: it has no rows")
    for row, (line, fields) in enumerate(rows):
        if len(fields) != len(names):
            what = f"it has {len(fields)} fields, expected {len(names)}; repair the row"
            raise row_error(file, row, line, what + (_COMMAS if len(fields) > len(names) else ""))
    columns: list[Sequence[str]] = [list(column) for column in zip(*(fields for _, fields in rows), strict=True)]
    if decimal_comma:
        columns = [[cell.replace(",", ".") for cell in column] for column in columns]
    return CellTable(file, tuple(names), tuple(columns), np.array([line for line, _ in rows]), bool(header_lines))


def read_numbers(
    file: Path,
    required: Sequence[str],
    *,
    optional: Sequence[str] = (),
    separator: str | None = ",",
    header_lines: int = 1,
) -> NumberTable:
    """The columns ``required``, and those of ``optional`` that are there, of a delimited text file of finite numbers.

    A column that the header does not name may be given by its number, from 1; without header lines all are, or the file
    has exactly the required columns. DataError: as for ``read_cells``; a column is missing or named twice
    (ColumnError), a field is not a finite number.
    """
    try:
        table = read_cells(file, required if header_lines else (), separator=separator, header_lines=header_lines)
    except NoRowsError as error:
        raise DataError(f"{error}" + ("" if header_lines else f"; a row is {' '.join(required)}")) from None
    if not header_lines and not any(name.isdecimal() for name in required):
        if len(table.names) != len(required):
            what = f"it has {len(table.names)} fields, expected {len(required)}: {' '.join(required)}"
            raise ColumnError(str(row_error(file, 0, int(table.lines[0]), what)))
        table = table.named(required)
    return table.finite([*required, *(name for name in optional if name in table.names)])


def not_increasing(values: Array) -> tuple[int, str] | None:
    """The first row (0 is the first) of values (rows,) that is not above the one before, and why; None without one."""
    bad = np.flatnonzero(np.diff(values) <= 0)
    if not len(bad):
        return None
    before, value = values[bad[0]], values[bad[0] + 1]
    what = "is repeated" if value == before else "goes backwards"
    return int(bad[0]) + 1, f"{what}: {value:.10g} after {before:.10g}"


def missing_column(file: Path, column: str, columns: Iterable[str], others: Sequence[str] = ()) -> ColumnError:
    """The error of a table without a column that it must have, and others."""
    known = ", ".join(filter(None, columns))
    if others:
        names = ", ".join(repr(each) for each in (column, *others[:-1]))
        return ColumnError(f"{file}: columns {names} and {others[-1]!r} are missing; found: {known}")
    return ColumnError(f"{file}: column {column!r} is missing; {nearest(column, columns)}found: {known}")


def row_error(file: Path, row: int, line: int, what: str) -> DataError:
    """The error of one row (0 is the first) of a text file, with its line where that is another number."""
    place = f"row {row + 1}" if line == row + 1 else f"row {row + 1} (line {line})"
    return DataError(f"{file}, {place}: {what}")


def _seconds(column: pl.Series) -> pl.Series:
    """A column of dates or durations in seconds; another as it is."""
    import polars as pl

    if column.dtype == pl.Date:
        column = column.cast(pl.Datetime("ns"))
    if column.dtype == pl.Datetime:
        return column.dt.epoch("ns") / 1e9
    return column.dt.total_nanoseconds() / 1e9 if column.dtype == pl.Duration else column


def _separator(text: str, header_lines: int) -> str:
    """The separator that the last header line, or the first row, holds."""
    lines = [line for line in text.splitlines() if line.strip()][: max(header_lines, 1)]
    return next((each for each in ";\t," if lines and each in lines[-1]), ",")


def _split_lines(file: Path, text: str, separator: str | None) -> list[tuple[int, list[str]]]:
    if separator is None:
        rows = (line.split("#", 1)[0].split() for line in text.splitlines())
        return [(line, fields) for line, fields in enumerate(rows, 1) if fields]
    reader = csv.reader(text.splitlines(), delimiter=separator)
    try:
        return [(reader.line_num, fields) for fields in reader if any(field.strip() for field in fields)]
    except csv.Error as error:
        raise DataError(f"{file}, line {reader.line_num}: {error}") from None


def _place(file: Path, name: str, names: Sequence[str]) -> int:
    """Index of the column with a name, or with a number that no column has as its name."""
    count = names.count(name)
    if count == 0 and _is_number(name, names):
        return int(name) - 1
    if count == 0:
        raise missing_column(file, name, names)
    if count > 1:
        raise ColumnError(f"{file}: column {name!r} is there {count} times; name each column once")
    return names.index(name)


def _is_number(name: str, names: Sequence[str]) -> bool:
    return name.isdecimal() and 1 <= int(name) <= len(names)
