"""Results and tables on a terminal, by rich, at a prompt and in a notebook."""

from __future__ import annotations

from collections.abc import Sequence
from io import StringIO
from typing import Final, Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.table import Table as Lines
from rich.text import Text

from omnibench.report.blocks import Cell, Paragraph, Table
from omnibench.report.result import Remark, Result, frame_table
from omnibench.views import screenful

_WIDTH: Final = 116  # columns of a text at a prompt
_READABLE: Final = 18  # columns of text; lesser columns are left out before text is squeezed into fewer; chosen
_UNBROKEN: Final = 30  # columns; a longer word, such as a path, may be broken
_STYLES: Final = {"best": "bold", "failed": "yellow", "muted": "dim", "group": "bold dim"}
STYLES: Final = {"plain": "", "good": "bold green", "warning": "bold yellow", "bad": "bold red"}  # by tone


def print_result(console: Console, result: Result) -> None:
    """Print a result's opening, tables and remarks."""

    def lines(remarks: Sequence[Remark]) -> None:
        for remark in remarks:
            console.print(Text(remark.text, STYLES[remark.tone]), soft_wrap=True)

    lines(result.opening())
    for number, table in enumerate(result.tables()):
        if table.caption and (number or result.opening()):
            console.print()
        print_table(console, table)
    lines(result.remarks())


def print_table(console: Console, table: Table) -> None:
    """Print a table in the width of the console."""
    console.print(render_table(table, console.width))


def render_table(table: Table, width: int) -> RenderableType:
    """A table in at most ``width`` columns of the terminal.

    Notes stand beside their cells if there is room, else below. Where even so the table is too wide, columns are left
    out, those of the highest priority number first, and a line names them and the width that shows all.
    """
    shown, between = list(range(len(table.columns))), " "
    extents = [_extent(table, index, between) for index in shown]
    needed = 0
    if sum(natural + 2 for _, natural in extents) - 2 > width:
        between = "\n"
        extents = [_extent(table, index, between) for index in shown]
        needed = sum(least + 1 for least, _ in extents) - 1
    while len(shown) > 1 and sum(extents[index][0] + 1 for index in shown) - 1 > width:
        shown.remove(max(shown[1:], key=lambda index: (table.columns[index].priority, index)))
    gap = 2 if sum(extents[index][0] + 2 for index in shown) - 2 <= width else 1
    widths = {index: extents[index][1] for index in shown}
    for _ in range(sum(widths.values()) + gap * (len(widths) - 1) - width):
        wide = [index for index in widths if widths[index] > extents[index][0]]
        if wide:  # else one column is left, with a word that is longer than the terminal is wide
            widths[max(wide, key=lambda index: widths[index])] -= 1

    def without_rows(heading: bool) -> Lines:
        lines = Lines(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, gap - 1, 0, 0), show_header=heading)
        for index, room in widths.items():
            side: Literal["left", "right"] = "right" if table.columns[index].numeric else "left"
            lines.add_column(_heading(table, index), justify=side, width=room, overflow="fold")
        return lines

    lines = without_rows(heading=True)
    parts: list[RenderableType] = [Text(table.caption, "bold"), lines] if table.caption else [lines]
    for row in table.rows:
        if row.role == "group":
            lines = without_rows(heading=False)
            parts += [Text(row.cells[0].text, _STYLES["group"]), lines]
            continue
        cells = (_text(row.cells[index], between) for index in shown)
        lines.add_row(*cells, style=_STYLES.get(row.role))
    if left_out := [_heading(table, index) for index in range(len(extents)) if index not in shown]:
        words = f"left out for want of room: {', '.join(left_out)}; {needed} columns show all"
        parts.append(Text(words, "dim"))
    return Group(*parts, *([Text(table.note, "dim")] if table.note else []))


def _heading(table: Table, index: int) -> str:
    column = table.columns[index]
    return f"{column.title} ({column.unit})" if column.unit else column.title


def _text(cell: Cell, between: str) -> Text:
    """A cell with its note in small print. between: what stands before the note, a space or a new line."""
    note = f" ({cell.note})" if between == " " and cell.text else f"{between if cell.text else ''}{cell.note}"
    return Text.assemble(cell.text, (note if cell.note else "", "dim"))


def _extent(table: Table, index: int, between: str) -> tuple[int, int]:
    """The least width of a column, in which numbers and words stay whole, and the width in which no cell wraps."""
    column, cells = table.columns[index], [row.cells[index] for row in table.rows if row.role != "group"]
    lines = [line for cell in cells for line in _text(cell, between).plain.split("\n")]
    longest = max(map(len, lines), default=0)
    heading = _heading(table, index)
    words = [len(word) for text in (heading, *lines) for word in text.split() if len(word) <= _UNBROKEN]
    least = max([*words, 1, *(len(cell.text) for cell in cells if column.numeric)])
    if not column.numeric and any(each.priority for each in table.columns):
        least = max(least, min(longest, _READABLE))
    return least, max(least, longest, (len(heading) + 1) // 2)


def as_text(result: Result) -> str:
    """A result at a Python prompt: at most twenty lines of at most 120 characters."""
    console = Console(file=StringIO(), width=_WIDTH, markup=False, emoji=False, highlight=False, color_system=None)
    for table in result.tables():
        console.print(render_table(table, console.width))
    below = [remark.text for remark in result.remarks()]
    tables: str = console.file.getvalue()  # type: ignore[attr-defined]
    lines = [result.sentence(), *tables.splitlines(), *below]
    return "\n".join(screenful([result.title, *(f"  {line}".rstrip() for line in lines if line.strip())]))


def as_html(result: Result) -> str:
    """A result in a notebook: title, sentence, tables and remarks, by the template of the pages."""
    from omnibench.report.render import fragment

    texts = [result.title, result.sentence(), *(remark.text for remark in result.remarks())]
    first, *others = [Paragraph(text) for text in texts if text]
    tables = result.tables() or [frame_table(make()) for make in list(result.frames().values())[:1]]
    return fragment([Paragraph(first.text, "lead"), *tables, *others])
