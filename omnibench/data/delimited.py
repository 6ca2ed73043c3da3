"""Tables of numbers from delimited text or Parquet, whose rows polars reads; a flaw is told with its file and row.

Opening a table reads its header. A text with more than ``LARGE`` bytes goes through a temporary Parquet file, of which
the columns and rows that are asked for are read.
"""

from __future__ import annotations

import csv
import re
from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from io import BytesIO, TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from omnibench.data.parquet import readable, scan_table, seconds
from omnibench.data.scratch import temporary_file
from omnibench.errors import DataError, nearest
from omnibench.files import check_file, read_text
from omnibench.robot.kinematics import Array

AUTO = "auto"  # as a separator: the one that the header holds
BLANK = ("", "nan", "na", "n/a", "null", "none", "-")  # cells without a value, in any case
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+")
LARGE = 1 << 26  # bytes of a text whose numbers are not held in memory together, where they take six times as much
_COMMAS = " (decimal commas? --set decimal=comma with --set separator)"
_HEAD = 1 << 16  # characters in which the header and the first rows stand; chosen
_HEADED = 1000  # lines that tell the types of the columns; chosen
_MOST_BYTES = 1 << 34  # of a table; chosen
_AT_ONCE = 1_000_000  # rows of which several columns are read at a time; chosen
_ROW_GROUP = 1 << 16  # rows of a temporary Parquet file that are read together; chosen
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

    names: of the columns, numbers from 1 where there is no header. read: gives the columns in their order, when rows
    are asked for. lines (rows,): of the file that a row came from, and perhaps further ones. units: those of a row
    below the header. headed: the names come from a header. lines_above: number of the file's lines above its first row
    of numbers, where texts stand between it and the header.
    """

    file: Path
    names: tuple[str, ...]
    read: Callable[[], pl.LazyFrame]
    lines: Lines
    units: tuple[str, ...] = ()
    headed: bool = True
    lines_above: int = 0

    @cached_property
    def frame(self) -> pl.LazyFrame:
        """The columns in their order. DataError: they cannot be read, or a row has too many fields."""
        return self.read()

    @cached_property
    def height(self) -> int:
        """Number of rows."""
        return int(self._selected(pl.len()).item())

    def __len__(self) -> int:
        return self.height

    def __contains__(self, name: str) -> bool:
        """True if a column has the name, or that number, from 1."""
        return name in self.names or _is_number(name, self.names)

    def in_lower_case(self) -> Table:
        """The table with the names of its columns in lower case, for tables whose names are given."""
        return replace(self, names=tuple(name.lower() for name in self.names))

    def by_text(self, name: str) -> dict[str, Table]:
        """The rows that have the same text in a column, in their order, by that text, the first first."""
        stretches = self._column(name).rle().struct.unnest()
        parts: dict[str, list[NDArray[np.intp]]] = {}
        end = 0
        for text, length in zip(_texts(stretches["value"]), stretches["len"], strict=True):
            parts.setdefault(text, []).append(np.arange(end, end + length))
            end += length
        return {text: self.only(np.concatenate(rows)) for text, rows in parts.items()}

    def only(self, rows: NDArray[np.intp]) -> Table:
        """The table of some of the rows, by their indices, which increase."""
        first, count = int(rows[0]), len(rows)
        together = int(rows[-1]) - first + 1 == count
        lines = self.lines[first : first + count] if together else np.asarray(self.lines[: rows[-1] + 1])[rows]

        def chosen() -> pl.LazyFrame:
            return self.frame.slice(first, count) if together else self.frame.select(pl.all().gather(rows))

        return replace(self, read=chosen, lines=lines)

    def unit_of(self, name: str) -> str:
        """The unit that stands below a column's name; empty without one."""
        return self.units[_place(self.file, name, self.names)] if self.units else ""

    def fail(self, row: int, what: str) -> DataError:
        """The error of one row (0 is the first)."""
        return row_error(self.file, row, int(self.lines[row]), what)

    def texts(self, name: str) -> list[str]:
        """One column as texts; whole numbers without a decimal point."""
        return _texts(self._column(name))

    def numbers(self, names: Sequence[str]) -> Array:
        """Columns as numbers (rows, n), NaN where a cell is blank. DataError: a cell holds something else."""
        numbers = np.empty((len(self), len(names)))
        step = len(names) if len(self) <= _AT_ONCE else 1
        for first in range(0, len(names), step):
            chosen = names[first : first + step]
            places = [_place(self.file, name, self.names) for name in chosen]
            columns = self._selected(*(pl.nth(place).alias(str(index)) for index, place in enumerate(places)))
            for index, (name, column) in enumerate(zip(chosen, columns.iter_columns(), strict=True), first):
                numbers[:, index] = self._parsed(name, column)
        return numbers

    def check_finite(self, numbers: Array, names: Sequence[str], rows: NDArray[np.intp] | None = None) -> None:
        """DataError names the first cell among numbers (n, columns) that is none. rows (n,): of the table; or all."""
        for index, place in np.argwhere(~np.isfinite(numbers))[:1].tolist():
            row = index if rows is None else int(rows[index])
            cell = self._column(names[place])[row]
            flaw = f"is {str(cell).strip()}; remove or repair the row" if cell not in (None, "") else "is missing"
            raise self.fail(row, f"{names[place]} {flaw}")

    def columns(self, names: Sequence[str]) -> Array:
        """Columns of finite numbers (rows, n). DataError names the first cell that is not one."""
        numbers = self.numbers(names)
        self.check_finite(numbers, names)
        return numbers

    def column(self, name: str) -> Array:
        """One column of finite numbers (rows,)."""
        return self.columns([name])[:, 0]

    def increasing(self, name: str) -> Array:
        """One column (rows,), which must increase; DataError names the first row that does not."""
        values = self.column(name)
        if (flaw := not_increasing(values)) is not None:
            raise self.fail(flaw[0], f"{name} {flaw[1]}")
        return values

    def _parsed(self, name: str, column: pl.Series) -> Array:
        """Numbers, or texts as such; dates become seconds since 1970."""
        if column.dtype != pl.String:
            with readable(self.file):
                numbers, wrong = column.cast(pl.Float64), pl.Series([False])
        else:
            cells = column.fill_null("").str.strip_chars()
            numbers = cells.cast(pl.Float64, strict=False)
            wrong = numbers.is_null() & ~cells.str.to_lowercase().is_in(BLANK)
        for form in _DATES if wrong.sum() * 2 > len(wrong) else ():
            zone = "UTC" if "z" in form else None
            with_zone = cells.str.replace("Z$", "+00:00")
            dates = with_zone.str.to_datetime(form, time_unit="ns", time_zone=zone, strict=False)
            if not (dates.is_null() & wrong).any():
                numbers, wrong = dates.dt.epoch("ns") / 1e9, wrong.clear()
                break
        if wrong.any():
            row = int(wrong.arg_true()[0])
            hint = "; of decimal commas say --set decimal=comma" if DECIMAL_COMMA.fullmatch(cells[row]) else ""
            raise self.fail(row, f"{name} is {cells[row]!r}, expected a number{hint}")
        return np.asarray(numbers.fill_null(np.nan).to_numpy())

    def _column(self, name: str) -> pl.Series:
        return self._selected(pl.nth(_place(self.file, name, self.names))).to_series()

    def _selected(self, *columns: pl.Expr) -> pl.DataFrame:
        with readable(self.file):
            return self.frame.select(columns).collect()


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
        rows, frame = scan_table(file)
        if not rows:
            raise NoRowsError(f"{file}: it has no rows")
        frame = frame.select(map(seconds, range(1 << 16), frame.collect_schema().dtypes()))
        large = file.stat().st_size > LARGE
        names = tuple(frame.collect_schema())
        return Table(file, names, lambda: frame if large else frame.collect().lazy(), range(1, rows + 1))
    str(file).encode()  # polars takes no other names: UnicodeEncodeError, which is told in one line
    source, head, lines = _source_of(file, separator)
    # Blank lines within the header, which are left out, count as its lines.
    header_lines = sum(int(number < lines[0] + header_lines) for number in lines[:header_lines])
    if separator == AUTO:
        separator = next((sign for sign in ";\t," if head and sign in head[: max(header_lines, 1)][-1]), ",")
    text = _Text(file, source, separator or "\t", lines, decimal_comma)
    first = list(csv.reader(head, delimiter=text.separator, skipinitialspace=True))
    if header_lines > len(first):
        raise DataError(f"{file}: it has no header with the names of its columns; repair it, or take it out")
    if header_lines:
        names = tuple(name.strip() for name in first[header_lines - 1])
        names = (names[0].lstrip("# "), *names[1:])  # as numpy.savetxt writes it
    else:
        names = tuple(str(number) for number in range(1, len(first[0]) + 1)) if first else ()
    for name in required:
        _place(file, name, names)
    body = first[header_lines:]
    units = tuple(cell.strip() for cell in body[0]) if header_lines and len(body) > 1 and _are_units(*body[:2]) else ()
    skipped = header_lines + bool(units)
    if len(first) <= skipped:
        raise NoRowsError(f"{file}: it has no rows")
    begun = next((row for row, cells in enumerate(first) if 2 * sum(map(_is_float, cells)) >= len(cells) > 1), 0)
    above = int(lines[begun]) - 1 if begun > skipped else 0
    if len(first[skipped]) != len(names):
        way = f"; are there {above} lines above the rows? --set header_lines={above}" if above else ""
        raise DataError(f"{text.ragged(first[skipped], names, skipped, 0)}{way}")
    # Columns that hold numbers in the first rows are read as numbers.
    whole = [row for row in first[skipped:] if len(row) == len(names)]
    numeric = [
        any(cells) and all(not cell or _NUMBER.fullmatch(cell) for cell in cells) for cells in zip(*whole, strict=True)
    ]
    scratch = temporary_file(".parquet") if file.stat().st_size > LARGE else None
    return Table(
        file, names, lambda: text.rows(skipped, numeric, scratch), lines[skipped:], units, bool(header_lines), above
    )


@dataclass(frozen=True, eq=False)
class _Text:
    """A delimited text. source: a file, a text in memory or a temporary file. lines: their numbers in the file."""

    file: Path
    source: Path | bytes | Any
    separator: str
    lines: Lines
    decimal_comma: bool

    def rows(self, skipped: int, numeric: Sequence[bool], scratch: Any) -> pl.LazyFrame:
        """The rows below some skipped ones, in memory or in the file ``scratch``.

        numeric: which columns hold numbers; where they hold a text further down, all are read as texts. DataError: the
        text cannot be read, or a row has too many fields.
        """
        text = self.source if isinstance(self.source, Path | bytes) else Path(self.source.name)
        reason: Exception | None = None
        for numbers in (numeric, [False] * len(numeric)):
            schema = {str(place): pl.Float64 if number else pl.String for place, number in enumerate(numbers)}
            try:
                frame = pl.scan_csv(
                    text, has_header=False, separator=self.separator, skip_lines=skipped, schema=schema, glob=False
                )
                if self.decimal_comma:
                    frame = frame.with_columns(pl.col(pl.String).str.replace(",", ".", literal=True))
                if scratch is None:
                    return frame.collect().lazy()
                frame.sink_parquet(scratch.name, compression="lz4", row_group_size=_ROW_GROUP)
                return pl.scan_parquet(scratch.name, glob=False)
            except (pl.exceptions.PolarsError, OSError) as error:
                reason = error
        opened = BytesIO(text) if isinstance(text, bytes) else text.open("rb")
        try:
            with TextIOWrapper(opened, encoding="utf-8-sig") as decoded:
                rows = csv.reader(islice(decoded, skipped, None), delimiter=self.separator)
                for row, fields in enumerate(rows):
                    if fields and len(fields) != len(numeric):
                        raise self.ragged(fields, numeric, skipped, row)
        except UnicodeDecodeError:
            read_text(self.file)  # raises DataError: the file is no text in UTF-8
        raise DataError(f"{self.file}: cannot be read: {reason}")

    def ragged(self, fields: Sequence[str], names: Sequence[object], skipped: int, row: int) -> DataError:
        """The error of a row with more fields, or fewer, than there are names."""
        commas = _COMMAS if len(fields) > len(names) else ""
        what = f"it has {len(fields)} fields, expected {len(names)}; repair the row{commas}"
        return row_error(self.file, row, int(self.lines[skipped + row]), what)


def _source_of(file: Path, separator: str | None) -> tuple[Path | bytes | Any, list[str], Lines]:
    """The source that polars reads of a file, its first lines, and the numbers of the lines that are not left out."""
    check_file(file, _MOST_BYTES, text=True)
    try:
        with file.open(encoding="utf-8-sig", newline="") as opened:
            head = opened.read(_HEAD)
        blank = re.search(r"(?:^|\n)[ \t,;]*\r?\n", head) is not None
        if separator is not None and not blank and ', "' not in head and "\r" not in head.replace("\r\n", ""):
            shown = head.splitlines()
            return file, shown if len(head) < _HEAD else shown[:-1], range(1, _MOST_BYTES)
        large = file.stat().st_size > LARGE
        cleaned, numbers, first = temporary_file(".csv") if large else BytesIO(), array("q"), list[str]()
        with file.open(encoding="utf-8-sig") as opened:
            for number, line in enumerate(opened, 1):
                line = line.rstrip("\n").replace(', "', ',"')
                fields = "\t".join(line.split("#", 1)[0].split()) if separator is None else line
                if fields.strip(" \t,;"):
                    cleaned.write(f"{fields}\n".encode())
                    numbers.append(number)
                    first += [fields] if len(first) < _HEADED else []
    except UnicodeDecodeError:
        read_text(file)  # raises DataError: the file is no text in UTF-8
        raise
    cleaned.flush()
    return cleaned if large else cleaned.getvalue(), first, np.array(numbers)


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


def _texts(column: pl.Series) -> list[str]:
    """A column as texts; whole numbers without a decimal point."""
    if column.dtype != pl.String:
        return [f"{value:.15g}" if value is not None and np.isfinite(value) else "" for value in column.to_list()]
    return column.fill_null("").str.strip_chars().to_list()


def _place(file: Path, name: str, names: Sequence[str]) -> int:
    """Index of the column with a name, or with a number that no column has as its name."""
    count = names.count(name)
    if count == 0 and _is_number(name, names):
        return int(name) - 1
    if count == 0:
        raise missing_column(file, name, names)
    if count > 1:
        raise ColumnError(f"{file}: column {name!r} is there {count} times; name each once, or give its number, from 1")
    return names.index(name)


def _is_number(name: str, names: Sequence[str]) -> bool:
    return name.isdecimal() and 1 <= int(name) <= len(names)
