"""Tables on a terminal: numbers and headings stay whole in any width, and what is left out is named."""

from __future__ import annotations

import re
from io import StringIO

import pytest
from report_page import Page
from rich.console import Console

from omnibench.cli.terminal.tables import in_brief, print_table
from omnibench.report.blocks import Cell, Column, Document, Row, Section, Table
from omnibench.report.render import render

NUMBERS = ("0.1387", "0.1301", "0.1465", "0.0387", "0.0301", "0.0465", "72.11 %", "9.3 × 10⁻⁹", "5.58 s")
TABLE = Table(
    "Costs [red]",
    (
        Column("Entry", numeric=False),
        Column("CF theoretical"),
        Column("CF training"),
        Column("Improvement", priority=1),
        Column("Gap above exact optimum", "relative", priority=2),
    ),
    (
        Row.of("theoretical", Cell("0.1387", "0.1301 to 0.1465"), "–", "–", "5.58 s"),
        Row.of(Cell("closed_form", "matrix, box paper"), "0.1387", Cell("0.0387", "0.0301 to 0.0465"), "72.11 %", "0"),
        Row.of("Published elsewhere: not comparable row by row", role="group"),
        Row.of("crs", "0.1387", "0.0387", "72.11 %", Cell("9.3 × 10⁻⁹", "proven: ≤ 0.58 %"), role="muted"),
    ),
    "As Table 2 of the paper.",
)


def printed(table: Table, width: int) -> str:
    stream = StringIO()
    print_table(Console(file=stream, width=width, markup=False, emoji=False, highlight=False), table)
    return stream.getvalue()


@pytest.mark.parametrize("width", [48, 60, 80, 100, 160])
def test_no_number_is_broken_and_no_line_is_too_long(width: int) -> None:
    text = printed(TABLE, width)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    for number in NUMBERS[:6] if width < 80 else NUMBERS:
        assert number in text
    for word in ["Entry", "theoretical", "training", "closed_form"]:
        assert re.search(rf"\b{word}\b", text)
    assert "Costs [red]" in text
    assert "As Table 2 of the paper." in text


def test_notes_stand_beside_their_cells_where_there_is_room() -> None:
    text = printed(TABLE, 160)
    assert re.search(r"^closed_form \(matrix, box paper\) +0\.1387 +0\.0387 \(0\.0301 to 0\.0465\)", text, re.MULTILINE)
    assert "\nPublished elsewhere: not comparable row by row\n" in text


def test_notes_stand_below_where_there_is_less_room_and_all_columns_stay() -> None:
    text = printed(TABLE, 80)
    assert re.search(r"^closed_form .*\n.*0\.0301 to", text, re.MULTILINE)
    assert "left out" not in text


def test_columns_of_the_highest_priority_number_are_left_out_first_and_named_with_the_width_that_shows_them() -> None:
    text = " ".join(printed(TABLE, 60).split())
    match = re.search(r"left out for want of room: Gap above exact optimum \(relative\); (\d+) columns show all", text)
    assert match
    assert "72.11 %" in text
    needed = int(match[1])
    assert "left out" not in printed(TABLE, needed)
    assert "left out" in printed(TABLE, needed - 1)


def test_a_path_may_be_broken_where_it_is_longer_than_a_column_can_be() -> None:
    path = "/home/somebody/robots/plugins/differential_evolution_of_mine.py"
    table = Table("", (Column("name", numeric=False), Column("from", numeric=False)), (Row.of("de", path),))
    assert "".join(printed(table, 40).split()).endswith(f"de{path}")


def test_in_brief_a_table_has_neither_notes_nor_lesser_columns() -> None:
    text = printed(in_brief(TABLE), 160)
    for left_out in ("Improvement", "Gap", "0.0465", "As Table 2", "left out"):
        assert left_out not in text
    assert "Published elsewhere" in text


def test_one_description_gives_the_cells_of_the_report_and_of_the_terminal() -> None:
    page = Page(render(Document("Report", "", (Section("costs", "Costs", (TABLE,)),))))
    shown = [[" ".join(cell.split()) for cell in row] for row in page.tables[TABLE.caption]]
    below_heading = printed(TABLE, 240).split("─\n")[1].splitlines()[:-1]
    assert shown[0] == [column.title + f" ({column.unit})" * bool(column.unit) for column in TABLE.columns]
    assert [re.sub(r" \| (.+)", r" (\1)", cell) for row in shown[1:] for cell in row] == [
        cell for line in below_heading for cell in re.split(r" {2,}", line.strip())
    ]


def test_a_table_without_rows_shows_its_headings() -> None:
    empty = Table("None yet", (Column("Entry", numeric=False), Column("Cost")), ())
    assert "Entry" in printed(empty, 60)


def test_lesser_columns_are_left_out_before_text_is_squeezed_to_a_word_a_line() -> None:
    columns = (Column("Entry", numeric=False), Column("Outcome", numeric=False), Column("Time", priority=1))
    table = Table(
        "", columns, (Row.of("closed_form_of_mine", "step below the tolerance after four programs", "243 ms"),)
    )
    text = printed(table, 40)
    assert "step below the" in text
    assert "left out for want of room: Time; 45 columns show all" in " ".join(text.split())
