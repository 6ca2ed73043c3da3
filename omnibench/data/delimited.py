"""Tables of numbers from delimited text, read by polars, or from Parquet; a flaw is told with its file and row."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from omnibench.errors import DataError, nearest
from omnibench.files import check_file, read_text
from omnibench.robot.kinematics import Array

AUTO = "auto"  # as a separator: the one that the header holds
BLANK = ("", "nan", "na", "n/a", "null", "none", "-")  # cells without a value, in any case
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+")
_COMMAS = " (decimal commas? --set decimal=comma with --set separator)"
_HEAD = 1 << 16  # characters in which the header and the first rows stand; chosen
_FIRST = 30  # rows among which those of numbers begin; chosen
_MOST_BYTES = 1 << 34  # of a table; chosen
# Not with leading zeros, as in names of runs.
_NUMBER = re.compile(r"\s*[-+]?(?:(?:0|[1-9]\d*)(?:\.\d*)?|\.\d+)(?:e[-+]?\d+)?\s*", re.IGNORECASE)
_UNIT = re.compile(r"[\[(<].*[\])>]|-|[a-zµ°%][a-zµ°%/^0-9·*. -]*", re.IGNORECASE)
# Of times that are dates, ISO 8601 and its usual variants.
_DATES = (
    "%Y-%m-%dT%H:%M:%S%.f%#z",
    "%Y-%m-%d %H:%M:%S%.f%#z",
    "%Y-%m-%dT%H:%M:%S%.f",
    "%Y-%m-%d %H:%M:%S%.f",
    "%Y/%m/%d %H:%M:%S%.f",
)


Lines = Sequence[int] | NDArray[np.intp]
"""Numbers of lines of a file, from 1."""


class ColumnError(DataError):
    """A table has not the columns that are expected of it."""


class NoRowsError(DataError):
    """A table has a header at most."""


@dataclass(frozen=True, eq=False)
class Table:
    """A table as it stands in its file: columns of numbers, and of texts where not all cells are numbers or blank.

    names: of the columns, numbers from 1 where there is no header. frame: the columns in their order. lines (rows,): of
    the file that a row came from. units: those of a row below the header. headed: the names come from a header.
    """

    file: Path
    names: tuple[str, ...]
    frame: pl.DataFrame
    lines: Lines
    units: tuple[str, ...] = ()
    headed: bool = True

    def __len__(self) -> int:
        return len(self.frame)

    def __contains__(self, name: str) -> bool:
        """True if a column has the name, or that number, from 1."""
        return name in self.names or _is_number(name, self.names)

    def in_lower_case(self) -> Table:
        """The table with the names of its columns in lower case, for tables whose names are given."""
        return replace(self, names=tuple(name.lower() for name in self.names))

    def only(self, rows: NDArray[np.intp]) -> Table:
        """The table of some of the rows, by their indices."""
        lines = self.lines[0] + rows if isinstance(self.lines, range) else np.asarray(self.lines)[rows]
        at_once = len(rows) == 1 + rows[-1] - rows[0] if len(rows) else False
        return replace(self, frame=self.frame[rows[0] : rows[-1] + 1] if at_once else self.frame[rows], lines=lines)

    def lines_above(self) -> int:
        """Number of the file's lines above its first row of numbers, where texts stand between it and the header."""
        for row, cells in enumerate(self.frame.head(_FIRST).iter_rows()):
            if 2 * sum(cell is not None and _is_float(str(cell)) for cell in cells) >= len(cells):
                return int(self.lines[row]) - 1 if row else 0
        return 0

    def unit_of(self, name: str) -> str:
        """The unit that stands below a column's name; empty without one."""
        return self.units[_place(self.file, name, self.names)] if self.units else ""

    def fail(self, row: int, what: str) -> DataError:
        """The error of one row (0 is the first)."""
        return row_error(self.file, row, int(self.lines[row]), what)

    def texts(self, name: str) -> list[str]:
        """One column as texts; whole numbers without a decimal point."""
        column = self._column(name)
        if column.dtype != pl.String:
            return [f"{value:.15g}" if value is not None and np.isfinite(value) else "" for value in column.to_list()]
        return column.fill_null("").str.strip_chars().to_list()

    def numbers(self, names: Sequence[str]) -> Array:
        """Columns as numbers (rows, n), NaN where a cell is blank. DataError: a cell holds something else."""
        numbers = np.empty((len(self), len(names)))
        for place, name in enumerate(names):
            column = self._column(name)
            numbers[:, place] = self._parsed(name, column) if column.dtype == pl.String else _floats(column)
        return numbers

    def columns(self, names: Sequence[str]) -> Array:
        """Columns of finite numbers (rows, n). DataError names the first cell that is not one."""
        numbers = self.numbers(names)
        for row, place in np.argwhere(~np.isfinite(numbers))[:1].tolist():
            cell = self._column(names[place])[row]
            flaw = f"is {str(cell).strip()}; remove or repair the row" if cell not in (None, "") else "is missing"
            raise self.fail(row, f"{names[place]} {flaw}")
        return numbers

    def column(self, name: str) -> Array:
        """One column of finite numbers (rows,)."""
        return self.columns([name])[:, 0]

    def increasing(self, name: str) -> Array:
        """One column (rows,), which must increase; DataError names the first row that does not."""
        values = self.column(name)
        flaw = not_increasing(values)
        if flaw is not None:
            raise self.fail(flaw[0], f"{name} {flaw[1]}")
        return values

    def _parsed(self, name: str, column: pl.Series) -> Array:
        """Texts as numbers; dates become seconds since 1970."""
        cells = column.fill_null("").str.strip_chars()
        numbers = cells.cast(pl.Float64, strict=False)
        wrong = numbers.is_null() & ~cells.str.to_lowercase().is_in(BLANK)
        if not wrong.any():
            return _floats(numbers)
        for form in _DATES if wrong.sum() * 2 > len(wrong) else ():
            zone = "UTC" if "z" in form else None
            with_zone = cells.str.replace("Z$", "+00:00")
            dates = with_zone.str.to_datetime(form, time_unit="ns", time_zone=zone, strict=False)
            if not (dates.is_null() & wrong).any():
                return _floats(_seconds(dates))
        row = int(wrong.arg_true()[0])
        text = cells[row]
        hint = "; of decimal commas say --set decimal=comma" if DECIMAL_COMMA.fullmatch(text) else ""
        raise self.fail(row, f"{name} is {text!r}, expected a number{hint}")

    def _column(self, name: str) -> pl.Series:
        return self.frame.to_series(_place(self.file, name, self.names))


def read_cells(
    file: Path,
    required: Sequence[str] = (),
    *,
    separator: str | None = ",",
    header_lines: int = 1,
    decimal_comma: bool = False,
) -> Table:
    """The table of a delimited text file, or of a Parquet file, in which dates become seconds since 1970.

    The last of the header lines names the columns, and a row of units may follow; without header lines columns are
    numbered. separator: None for white space, with comments from ``#`` on; ``auto``: a semicolon, a tab or a comma,
    whichever the header holds. Blank lines are skipped. DataError: the file cannot be read, a column that is required
    is missing or named twice (ColumnError), it has no rows (NoRowsError), a row has more fields than columns.
    """
    if file.suffix == ".parquet":
        from omnibench.data.parquet import read_parquet

        frame = read_parquet(file)
        if frame.is_empty():
            raise NoRowsError(f"{file}: it has no rows")
        frame = frame.select(_seconds(column) for column in frame.iter_columns())
        return Table(file, tuple(frame.columns), frame, range(1, len(frame) + 1))
    str(file).encode()  # polars takes no other names: UnicodeEncodeError, which is told in one line
    source, head, lines = _source_of(file, separator)
    # Blank lines within the header, which are left out, count as its lines.
    header_lines = sum(int(number < lines[0] + header_lines) for number in lines[:header_lines])
    if separator == AUTO:
        separator = next((sign for sign in ";\t," if head and sign in head[: max(header_lines, 1)][-1]), ",")
    separator = separator or "\t"
    rows = list(csv.reader(head, delimiter=separator, skipinitialspace=True))
    if header_lines:
        if len(rows) < header_lines:
            raise DataError(f"{file}: it has no header with the names of its columns; repair it, or take it out")
        names = [name.strip() for name in rows[header_lines - 1]]
        names[0] = names[0].lstrip("# ")  # as numpy.savetxt writes it
    else:
        names = [str(number) for number in range(1, len(rows[0]) + 1)] if rows else []
    for name in required:
        _place(file, name, names)
    body = rows[header_lines:]
    units = tuple(cell.strip() for cell in body[0]) if header_lines and len(body) > 1 and _are_units(*body[:2]) else ()
    skipped = header_lines + bool(units)
    if len(rows) <= skipped:
        raise NoRowsError(f"{file}: it has no rows")
    if len(rows[skipped]) != len(names):
        begun = next((row for row, cells in enumerate(rows) if 2 * sum(map(_is_float, cells)) >= len(cells) > 1), 0)
        above = int(lines[begun]) - 1
        way = f"; are there {above} lines above the rows? --set header_lines={above}"
        error = _ragged(file, rows[skipped], names, 0, int(lines[skipped]))
        raise DataError(f"{error}{way if begun > skipped else ''}")
    frame = _frame(file, source, separator, skipped, rows, names, lines)
    if decimal_comma:
        frame = frame.with_columns(pl.col(pl.String).str.replace(",", ".", literal=True))
    return Table(file, tuple(names), frame, lines[skipped : skipped + len(frame)], units, bool(header_lines))


def _source_of(file: Path, separator: str | None) -> tuple[Path | bytes, list[str], Lines]:
    """What polars reads of a file, its first lines, and the numbers of its lines, of which some may be left out."""
    check_file(file, _MOST_BYTES, text=True)
    try:
        with file.open(encoding="utf-8-sig", newline="") as opened:
            head = opened.read(_HEAD)
    except UnicodeDecodeError:
        head = read_text(file)[:_HEAD]  # which says that it is no text
    blank = re.search(r"(?:^|\n)[ \t,;]*\r?\n", head) is not None
    if separator is not None and not blank and ', "' not in head and "\r" not in head.replace("\r\n", ""):
        shown = head.splitlines()
        return file, shown if len(head) < _HEAD else shown[:-1], range(1, _MOST_BYTES)
    kept: list[tuple[int, str]] = []
    for number, line in enumerate(read_text(file).replace(', "', ',"').splitlines(), 1):
        fields = "\t".join(line.split("#", 1)[0].split()) if separator is None else line
        if fields.strip(" \t,;"):
            kept.append((number, fields))
    text = [line for _, line in kept]
    return "\n".join(text).encode(), text[:1000], np.array([number for number, _ in kept])


def _frame(
    file: Path,
    source: Path | bytes,
    separator: str,
    skipped: int,
    first: Sequence[Sequence[str]],
    names: Sequence[str],
    lines: Lines,
) -> pl.DataFrame:
    """The rows of a text below the header. DataError: it cannot be read, or a row has too many fields.

    first: the first rows, the header among them. Columns that hold numbers there are read as numbers, or, where they
    hold a text further down, all as texts.
    """
    reason: Exception | None = None
    texts: list[type[pl.DataType]] = [pl.String] * len(names)
    numbers = [
        pl.Float64 if any(cells) and all(not cell or _NUMBER.fullmatch(cell) for cell in cells) else pl.String
        for cells in zip(*(row for row in first[skipped:] if len(row) == len(names)), strict=True)
    ]
    for types in (numbers, texts):
        try:
            return pl.read_csv(
                BytesIO(source) if isinstance(source, bytes) else source,
                has_header=False, separator=separator, skip_lines=skipped, glob=False,
                schema={str(place): kind for place, kind in enumerate(types)},
            )  # fmt: skip
        except (pl.exceptions.PolarsError, OSError) as error:
            reason = error
    text = source.decode() if isinstance(source, bytes) else read_text(file)
    for row, fields in enumerate(csv.reader(text.splitlines()[skipped:], delimiter=separator)):
        if fields and len(fields) != len(names):
            raise _ragged(file, fields, names, row, int(lines[skipped + row]))
    raise DataError(f"{file}: cannot be read: {reason}")


def _ragged(file: Path, fields: Sequence[str], names: Sequence[str], row: int, line: int) -> DataError:
    what = f"it has {len(fields)} fields, expected {len(names)}; repair the row"
    return row_error(file, row, line, what + (_COMMAS if len(fields) > len(names) else ""))


def _are_units(cells: Sequence[str], following: Sequence[str]) -> bool:
    """True for a row that holds units, or nothing, in every cell (``[rad]``, ``m/s``, ``-``) above a row of numbers."""
    shown = [cell.strip() for cell in cells]
    numbers = sum(_is_float(after) and not _is_float(cell) for cell, after in zip(shown, following, strict=False))
    return 2 * numbers >= len(shown) and all(not cell or _UNIT.fullmatch(cell) for cell in shown)


def _is_float(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def read_numbers(file: Path, required: Sequence[str], *, separator: str | None = ",", header_lines: int = 1) -> Table:
    """The table of a delimited text file whose columns ``required`` hold finite numbers.

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
            raise ColumnError(str(table.fail(0, what)))
        table = replace(table, names=tuple(required))
    table.columns(required)
    return table


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
    if column.dtype == pl.Date:
        column = column.cast(pl.Datetime("ns"))
    if column.dtype == pl.Datetime:
        return column.dt.epoch("ns") / 1e9
    return column.dt.total_nanoseconds() / 1e9 if column.dtype == pl.Duration else column


def _floats(column: pl.Series) -> Array:
    """A column of numbers (rows,), NaN where it has none."""
    floats: Array = column.cast(pl.Float64).fill_null(np.nan).to_numpy()
    return floats


def _place(file: Path, name: str, names: Sequence[str]) -> int:
    """Index of the column with a name, or with a number that no column has as its name."""
    count = names.count(name)
    if count == 0 and _is_number(name, names):
        return int(name) - 1
    if count == 0:
        raise missing_column(file, name, names)
    if count > 1:
        raise ColumnError(
            f"{file}: column {name!r} is there {count} times; name each column once, or give its number, from 1"
        )
    return names.index(name)


def _is_number(name: str, names: Sequence[str]) -> bool:
    return name.isdecimal() and 1 <= int(name) <= len(names)
