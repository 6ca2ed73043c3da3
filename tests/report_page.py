"""A report and a table on a terminal as their readers see them, for the tests."""

import re
from collections.abc import Callable
from html.parser import HTMLParser
from io import StringIO
from typing import Any

from rich.console import Console

NUMBER = re.compile(r"\b[0-9a-f]{16,}\b|[-+−]?\d+([.,]\d+)*(e[-+]?\d+)?")


class Page(HTMLParser):
    """The visible text of a report, its sections, its tables by caption and its plots."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html = html
        self.text = ""
        self.tables: dict[str, list[list[str]]] = {}
        self.plots = 0
        self.sections: list[str] = []
        self._caption, self._in, self._cell = "", [], None
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag in ("script", "style", "figcaption"):
            self._in.append(tag)
        if tag == "figcaption":
            self._caption = ""
        if tag == "section":
            self.sections.append(given.get("id") or "")
        self.plots += "data-source" in given
        if tag == "table":
            self.tables.setdefault(self._caption.strip(), [])
        if tag == "tr":
            self.tables[self._caption.strip()].append([])
        if tag in ("td", "th"):
            self._cell = ""
        if tag == "small" and self._cell is not None:
            self._cell += " | "

    def handle_endtag(self, tag: str) -> None:
        if tag in ("script", "style", "figcaption"):
            self._in.pop()
        if tag in ("td", "th") and self._cell is not None:
            self.tables[self._caption.strip()][-1].append(self._cell.strip())
            self._cell = None

    def handle_data(self, data: str) -> None:
        if self._in and self._in[-1] == "figcaption":
            self._caption += data
        if not {"script", "style"} & set(self._in):
            self.text += data
            if self._cell is not None:
                self._cell += data

    def row(self, caption: str, name: str) -> list[str]:
        """The row of a table whose first cell begins with ``name``."""
        return next(row for row in self.tables[caption] if row[0].split(" | ")[0] == name)

    def words(self) -> str:
        """The visible text by lines down to the machine and the config, numbers and hashes masked.

        Two machines' digits may differ by rounding.
        """
        text = self.text.rsplit("How to reproduce", 1)[0]
        lines = (" ".join(line.split()) for line in text.splitlines())
        return "\n".join(NUMBER.sub("#", line) for line in lines if line)


def on_terminal(write: Callable[..., object], *shown: Any, width: int = 80, **options: Any) -> str:
    """What a function prints of something on a terminal of so many columns."""
    console = Console(file=StringIO(), width=width, markup=False, emoji=False, highlight=False)
    write(console, *shown, **options)
    return console.file.getvalue()
