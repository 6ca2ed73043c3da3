"""The form of the tables that several commands print."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Table


def folding_table(title: str | None, words: Sequence[str], numbers: Sequence[str]) -> Table:
    """A table without rows that folds long cells in a narrow terminal instead of cutting them.

    words, numbers: headings of the columns, of which those with numbers are aligned to the right.
    """
    table = Table(
        title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0)
    )
    for heading in words:
        table.add_column(heading, overflow="fold")
    for heading in numbers:
        table.add_column(heading, justify="right", overflow="fold")
    return table
