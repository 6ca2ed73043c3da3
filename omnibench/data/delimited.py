"""Reading of number columns from delimited text; every flaw is reported with its file and row."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omnibench.errors import DataError, nearest
from omnibench.robot.kinematics import Array


class ColumnError(DataError):
    """A table has not the columns that are expected of it."""


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


def read_numbers(
    file: Path,
    required: Sequence[str],
    *,
    optional: Sequence[str] = (),
    separator: str | None = ",",
    header_lines: int = 1,
) -> NumberTable:
    """The columns ``required``, and those of ``optional`` that are there, of a delimited text file.

    The last of the header lines names the columns; a column that it does not name may be given by its number, from 1.
    Without header lines all are, or the file has exactly the required columns. separator: None for white space, with
    comments from ``#`` on. Blank lines are skipped. DataError: the file cannot be read, a column is missing or named
    twice (ColumnError), the file has no rows, a row has more or fewer fields than columns, a field is not a finite
    number.
    """
    lines = _read_lines(file, separator)
    names = [name.strip() for name in _header(file, lines, header_lines)] if header_lines else list(required)
    rows = lines[header_lines:]
    if not header_lines and rows and any(name.isdecimal() for name in required):
        names = [str(number) for number in range(1, len(rows[0][1]) + 1)]
    wanted = [*required, *(name for name in optional if name in names)]
    chosen = [_column(file, name, names) for name in wanted]
    if not rows:
        raise DataError(f"{file}: it has no rows" + ("" if header_lines else f"; a row is {' '.join(required)}"))
    for row, (line, fields) in enumerate(rows):
        if len(fields) != len(names):
            what = f"it has {len(fields)} fields, expected {len(names)}"
            if header_lines or names[0] == "1":
                raise row_error(file, row, line, f"{what}; repair the row")
            raise ColumnError(str(row_error(file, row, line, f"{what}: {' '.join(names)}")))
    try:
        values = np.array([[fields[index] for index in chosen] for _, fields in rows], dtype=float)
    except ValueError:
        values = np.full((len(rows), len(chosen)), np.nan)
    if not np.isfinite(values).all():
        raise _first_flaw(file, rows, wanted, chosen)
    return NumberTable(file, tuple(wanted), values, np.array([line for line, _ in rows]))


def not_increasing(values: Array) -> tuple[int, str] | None:
    """The first row (0 is the first) of values (rows,) that is not above the one before, and why; None without one."""
    bad = np.flatnonzero(np.diff(values) <= 0)
    if not len(bad):
        return None
    before, value = values[bad[0]], values[bad[0] + 1]
    what = "is repeated" if value == before else "goes backwards"
    return int(bad[0]) + 1, f"{what}: {value:.10g} after {before:.10g}"


def missing_column(file: Path, column: str, columns: Iterable[str]) -> ColumnError:
    """The error of a table without a column that it must have."""
    known = ", ".join(filter(None, columns))
    return ColumnError(f"{file}: column {column!r} is missing; {nearest(column, columns)}found: {known}")


def row_error(file: Path, row: int, line: int, what: str) -> DataError:
    """The error of one row (0 is the first) of a text file, with its line where that is another number."""
    place = f"row {row + 1}" if line == row + 1 else f"row {row + 1} (line {line})"
    return DataError(f"{file}, {place}: {what}")


def read_text(file: Path) -> str:
    """The text of a file; DataError when it cannot be read."""
    try:
        return file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise DataError(f"{file}: no such file") from None
    except UnicodeDecodeError:
        raise DataError(f"{file}: is not a text file (UTF-8)") from None
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error.strerror or error}") from None


def _read_lines(file: Path, separator: str | None) -> list[tuple[int, list[str]]]:
    if separator is None:
        rows = (text.split("#", 1)[0].split() for text in read_text(file).splitlines())
        return [(line, fields) for line, fields in enumerate(rows, 1) if fields]
    reader = csv.reader(read_text(file).splitlines(), delimiter=separator)
    try:
        return [(reader.line_num, fields) for fields in reader if any(field.strip() for field in fields)]
    except csv.Error as error:
        raise DataError(f"{file}, line {reader.line_num}: {error}") from None


def _header(file: Path, lines: Sequence[tuple[int, list[str]]], header_lines: int) -> list[str]:
    if len(lines) < header_lines:
        raise DataError(f"{file}: it has no header with the names of its columns")
    return lines[header_lines - 1][1]


def _column(file: Path, name: str, names: Sequence[str]) -> int:
    """Index of the column with a name, or with a number that no column has as its name."""
    count = names.count(name)
    if count == 0 and name.isdecimal() and 1 <= int(name) <= len(names):
        return int(name) - 1
    if count == 0:
        raise missing_column(file, name, names)
    if count > 1:
        raise ColumnError(f"{file}: column {name!r} is there {count} times; name each column once")
    return names.index(name)


def _first_flaw(
    file: Path, rows: Sequence[tuple[int, list[str]]], wanted: Sequence[str], chosen: Sequence[int]
) -> DataError:
    for row, (line, fields) in enumerate(rows):
        for name, index in zip(wanted, chosen, strict=True):
            field = fields[index].strip()
            try:
                flaw = None if np.isfinite(float(field)) else f"{name} is {field}; remove or repair the row"
            except ValueError:
                flaw = f"{name} is {field!r}, expected a number" if field else f"{name} is missing"
            if flaw:
                return row_error(file, row, line, flaw)
    raise AssertionError(f"{file}: no flaw found")
