"""What a report is made of. Texts are plain: the template escapes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import plotly.graph_objects as go

Tone = Literal["plain", "good", "warning"]
Dash = Literal["solid", "dash", "dot", "dashdot"]


@dataclass(frozen=True)
class Badge:
    """A few words that must not be missed, such as ``SIMULATED DATA``."""

    text: str
    tone: Tone = "plain"


@dataclass(frozen=True)
class Paragraph:
    """Running text. ``lead`` is set larger, ``note`` smaller."""

    kind: ClassVar[str] = "paragraph"
    text: str
    role: Literal["plain", "lead", "note"] = "plain"


@dataclass(frozen=True)
class Callout:
    """A box of remarks; empty without items."""

    kind: ClassVar[str] = "callout"
    title: str
    items: tuple[str, ...]
    tone: Tone = "plain"


@dataclass(frozen=True)
class Fact:
    """A name and a value, with a smaller remark."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Facts:
    """Facts as a list, or as ``tiles`` where they are the message."""

    kind: ClassVar[str] = "facts"
    items: tuple[Fact, ...]
    role: Literal["list", "tiles"] = "list"


@dataclass(frozen=True)
class Column:
    """Head of a table's column; numeric columns are set flush right."""

    title: str
    unit: str = ""
    numeric: bool = True


@dataclass(frozen=True)
class Cell:
    """A value with what stands below it in small print; ``colour`` draws a swatch before it."""

    text: str
    note: str = ""
    colour: str = ""


@dataclass(frozen=True)
class Row:
    """A table's row. ``group`` rows have one cell, which spans the table."""

    cells: tuple[Cell, ...]
    role: Literal["plain", "best", "failed", "muted", "group"] = "plain"


@dataclass(frozen=True)
class Table:
    """A table with a caption above and a note below."""

    kind: ClassVar[str] = "table"
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    note: str = ""


@dataclass(frozen=True)
class LegendItem:
    """One line of a legend; ``key`` is the ``legendgroup`` of the traces that it switches on and off."""

    key: str
    label: str
    colour: str
    dash: Dash = "solid"


@dataclass(frozen=True, eq=False)
class Figure:
    """A plot under its own title. ``description`` says in words what is drawn, for readers who cannot see it."""

    title: str
    plot: go.Figure
    description: str
    height: int = 380  # px


@dataclass(frozen=True, eq=False)
class FigureGrid:
    """Plots side by side where the page is wide enough, with one legend for all."""

    kind: ClassVar[str] = "figures"
    figures: tuple[Figure, ...]
    legend: tuple[LegendItem, ...] = ()
    columns: Literal[1, 2, 3] = 2
    caption: str = ""


@dataclass(frozen=True)
class Code:
    """Text that is set as it stands and can be copied."""

    kind: ClassVar[str] = "code"
    text: str
    title: str = ""


@dataclass(frozen=True, eq=False)
class Details:
    """Blocks that are folded away."""

    kind: ClassVar[str] = "details"
    title: str
    blocks: tuple[Block, ...]
    open: bool = False


@dataclass(frozen=True, eq=False)
class Choice:
    """Blocks of which one option's are shown; a menu called ``label`` chooses. Without JavaScript all are."""

    kind: ClassVar[str] = "choice"
    label: str
    options: Mapping[str, tuple[Block, ...]]


@dataclass(frozen=True, eq=False)
class Player:
    """Runs of a robot to be gone through step by step. ``runs``: by name, JSON as player.js reads it.

    ``description`` says in words what is drawn, for readers who cannot see it.
    """

    kind: ClassVar[str] = "player"
    runs: Mapping[str, Any]
    description: str
    caption: str = ""


Block = Paragraph | Callout | Facts | Table | FigureGrid | Code | Details | Choice | Player


@dataclass(frozen=True, eq=False)
class Section:
    """A part of the report with its line in the table of contents. ``key`` is unique in the document."""

    key: str
    title: str
    blocks: tuple[Block, ...] = ()
    sections: tuple[Section, ...] = ()
    badges: tuple[Badge, ...] = ()


@dataclass(frozen=True, eq=False)
class Document:
    """A whole report."""

    title: str
    subtitle: str
    sections: tuple[Section, ...]
    badges: tuple[Badge, ...] = ()
    footer: str = ""
