"""Tables on a terminal: words wrap at spaces, numbers stay whole, lesser columns give way where there is no room."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from textwrap import wrap
from typing import Final, Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.table import Table as Lines
from rich.text import Text

from omnibench.report.blocks import Cell, Column, Table

_UNBROKEN: Final = 30  # columns; a longer word, such as a path, may be broken
_READABLE: Final = 18  # columns of text; lesser columns are left out before text is squeezed into fewer; chosen
_STYLES: Final[Mapping[str, str]] = {"best": "bold", "failed": "yellow", "muted": "dim"}
_SMALL: Final = "dim"  # style of small print
_NO_BREAK: Final = "\u00a0"
# Spaces within a number: after a sign or relation, before a power of ten, and before a unit.
_WITHIN_NUMBERS: Final = re.compile(r"(?<=[×≤≥<>=±]) (?=[\d.])|(?<=\d) (?=×|[%°µ]|[a-zA-Z]{1,3}(?:/\w+)?(?!\w))")
Place = Literal["beside", "below"]  # where a cell's note stands


def print_table(console: Console, table: Table) -> None:
    """Print a table in the width of the console."""
    console.print(render_table(table, console.width))


def render_table(table: Table, width: int) -> RenderableType:
    """A table in at most ``width`` columns of the terminal.

    Notes stand beside their cells if there is room, else below. Where even so the table is too wide, columns are left
    out, those of the highest priority number first, and a line names them and the width that shows all.
    """
    layout = _layout(table, width)
    lines = _lines(table, layout, heading=True)
    parts: list[RenderableType] = [Text(table.caption, style="bold"), lines] if table.caption else [lines]
    for row in table.rows:
        if row.role == "group":
            lines = _lines(table, layout, heading=False)
            parts += [Text(row.cells[0].text, style="bold dim"), lines]
            continue
        cells = []
        for index, room in layout.widths.items():
            cell = row.cells[index]
            text = Text("\n".join(_wrapped(part, room) for part in _parts(cell, layout.notes)))
            if cell.note:
                text.stylize(_SMALL, len(_wrapped(cell.text, room)))
            cells.append(text)
        lines.add_row(*cells, style=_STYLES.get(row.role))
    if left_out := [_heading(column) for index, column in enumerate(table.columns) if index not in layout.widths]:
        words = f"left out for want of room: {', '.join(left_out)}; {layout.needed} columns show all"
        parts.append(Text(words, style=_SMALL))
    if table.note:
        parts.append(Text(table.note, style=_SMALL))
    return Group(*parts)


def in_brief(table: Table) -> Table:
    """A table without notes and lesser columns, for a summary of what a report has in full."""
    shown = [index for index, column in enumerate(table.columns) if column.priority == 0]
    rows = (
        row if row.role == "group" else replace(row, cells=tuple(Cell(row.cells[index].text) for index in shown))
        for row in table.rows
    )
    return Table(table.caption, tuple(table.columns[index] for index in shown), tuple(rows))


@dataclass(frozen=True)
class _Layout:
    """Widths of the columns that are shown, by index, the gap between them, and the place of notes.

    needed: width of a terminal that shows every column.
    """

    widths: Mapping[int, int]
    gap: int
    notes: Place
    needed: int


@dataclass(frozen=True)
class _Extent:
    """Width of a column: ``natural`` for a heading of two lines, ``cells`` for cells of one, ``least`` for words.

    readable: for words that do not stand one below the other.
    """

    natural: int
    cells: int
    readable: int
    least: int


def _layout(table: Table, width: int) -> _Layout:
    """The most comfortable layout that fits: notes beside, notes below, narrow gaps, and at last fewer columns."""
    beside = [_extent(table, index, "beside").natural for index in range(len(table.columns))]
    below = {index: _extent(table, index, "below") for index in range(len(table.columns))}
    needed = _width(_floors(table, below), 1)
    if sum(beside) + 2 * (len(beside) - 1) <= width:
        return _Layout(dict(enumerate(beside)), 2, "beside", needed)
    while len(below) > 1 and _width(_floors(table, below), 1) > width:
        del below[max(list(below)[1:], key=lambda index: (table.columns[index].priority, index))]
    floors = _floors(table, below)
    gap = 2 if _width(floors, 2) <= width else 1
    widths = {index: extent.natural for index, extent in below.items()}
    for _ in range(sum(widths.values()) + gap * (len(widths) - 1) - width):
        wide = [index for index in widths if widths[index] > below[index].cells]  # headings wrap first
        wide = wide or [index for index in widths if widths[index] > floors[index]]
        if wide:  # else one column is left, with a word that is longer than the terminal is wide
            widths[max(wide, key=lambda index: widths[index])] -= 1
    return _Layout(widths, gap, "below", needed)


def _floors(table: Table, extents: Mapping[int, _Extent]) -> Mapping[int, int]:
    """Least widths of columns: text stays readable as long as there are lesser columns to leave out."""
    lesser = any(table.columns[index].priority for index in extents)
    return {index: extent.readable if lesser else extent.least for index, extent in extents.items()}


def _width(columns: Mapping[int, int], gap: int) -> int:
    """The width of columns side by side."""
    return sum(columns.values()) + gap * (len(columns) - 1)


def _extent(table: Table, index: int, notes: Place) -> _Extent:
    column = table.columns[index]
    cells = [row.cells[index] for row in table.rows if row.role != "group"]
    lines = [line for cell in cells for line in _parts(cell, notes)]
    heading = _heading(column)
    words = [word for text in (heading, *lines) for word in _tied(text).split(" ") if len(word) <= _UNBROKEN]
    numbers = [cell.text for cell in cells] if column.numeric else []
    least = max(map(len, (*words, *numbers)), default=1)
    of_cells = max((least, *map(len, lines)))
    readable = least if column.numeric else max(least, min(of_cells, _READABLE))
    return _Extent(max(of_cells, (len(heading) + 1) // 2), of_cells, readable, least)


def _heading(column: Column) -> str:
    return f"{column.title} ({column.unit})" if column.unit else column.title


def _parts(cell: Cell, notes: Place) -> list[str]:
    """The lines of a cell before they are wrapped: its note stands beside it, in brackets, or in a line below."""
    if notes == "beside" and cell.text and cell.note:
        return [f"{cell.text} ({cell.note})"]
    return [part for part in (cell.text, cell.note) if part]


def _wrapped(text: str, width: int) -> str:
    """A text in lines; a path that is longer than a line breaks behind a slash."""
    tied = re.sub(rf"\S{{{width + 1},}}", lambda path: path[0].replace("/", "/\v"), _tied(text))
    lines = wrap(tied, width, break_on_hyphens=False, replace_whitespace=False)
    return "\n".join(lines).replace("\v", "").replace(_NO_BREAK, " ")


def _tied(text: str) -> str:
    """A text whose numbers are tied to their signs, powers of ten and units, so that no line ends within one."""
    return _WITHIN_NUMBERS.sub(_NO_BREAK, text)


def _lines(table: Table, layout: _Layout, heading: bool) -> Lines:
    """A table of Rich without rows."""
    padding = (0, layout.gap - 1, 0, 0)
    lines = Lines(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=padding, show_header=heading)
    for index, width in layout.widths.items():
        column = table.columns[index]
        title = _wrapped(_heading(column), width) if heading else ""
        lines.add_column(title, justify="right" if column.numeric else "left", width=width, overflow="fold")
    return lines
