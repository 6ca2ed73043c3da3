"""The blocks that a report is built from; the terminal shows the tables, too. Their texts are plain text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

if TYPE_CHECKING:  # a terminal shows tables and needs no plots
    import plotly.graph_objects as go

Tone = Literal["plain", "good", "warning", "bad"]
Dash = Literal["solid", "dash", "dot", "dashdot"]


@dataclass(frozen=True)
class Badge:
    """A few words that must not be missed, such as ``SIMULATED DATA``."""

    text: str
    tone: Tone = "plain"


def simulated_badge(*simulated: bool) -> tuple[Badge, ...]:
    """The badge of simulated data sets, one or several; nothing for recorded ones."""
    words = "SIMULATED DATA" if all(simulated) else "SIMULATED AND REAL DATA"
    return (Badge(words, "warning"),) if any(simulated) else ()


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
    """A named value with a remark in smaller type."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Facts:
    """Facts as a list, or as large ``tiles`` where the figures are the message."""

    kind: ClassVar[str] = "facts"
    items: tuple[Fact, ...]
    role: Literal["list", "tiles"] = "list"


@dataclass(frozen=True)
class Column:
    """The head of a table column; numeric columns are aligned right, and their cells never wrap.

    priority: where a terminal is too narrow for the table, columns of the highest number are left out first.
    """

    title: str
    unit: str = ""
    numeric: bool = True
    priority: int = 0


def columns(first: str | Column, *others: str | Column) -> tuple[Column, ...]:
    """Columns by their headings, a unit in brackets: names in the first, numbers in the others, unless one is given."""
    found = [Column(first, numeric=False) if isinstance(first, str) else first]
    for other in others:
        title, _, unit = other.partition(" (") if isinstance(other, str) else ("", "", "")
        found.append(Column(title, unit.rstrip(")")) if isinstance(other, str) else other)
    return tuple(found)


@dataclass(frozen=True)
class Cell:
    """A table cell: a value, a ``note`` below it in small print, and a swatch of ``colour`` before it."""

    text: str
    note: str = ""
    colour: str = ""


RowRole = Literal["plain", "best", "failed", "muted", "group"]


@dataclass(frozen=True)
class Row:
    """A table row. A ``group`` row has one cell that spans the table."""

    cells: tuple[Cell, ...]
    role: RowRole = "plain"

    @classmethod
    def of(cls, *cells: Cell | str, role: RowRole = "plain") -> Row:
        """A row of cells, of which those given as text have no note."""
        return cls(tuple(cell if isinstance(cell, Cell) else Cell(cell) for cell in cells), role)


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
    """One line of a legend; ``key`` is the ``legendgroup`` of the traces that it switches on and off.

    symbol: of the marks of these traces, by Plotly's name.
    """

    key: str
    label: str
    colour: str
    dash: Dash = "solid"
    symbol: str = "circle"


@dataclass(frozen=True, eq=False)
class Figure:
    """A plot under its own title.

    description: the picture in words, for readers who cannot see it. least_width: px; on narrower pages it scrolls.
    """

    title: str
    plot: go.Figure
    description: str
    height: int = 380  # px
    least_width: int = 0


@dataclass(frozen=True, eq=False)
class FigureGrid:
    """Plots side by side where the page is wide enough, with one legend for all.

    name: of the file that ``--figures`` writes, without its ending; empty: made of the section's or figure's title.
    """

    kind: ClassVar[str] = "figures"
    figures: tuple[Figure, ...]
    legend: tuple[LegendItem, ...] = ()
    columns: Literal[1, 2, 3] = 2
    caption: str = ""
    name: str = ""


@dataclass(frozen=True)
class Code:
    """Preformatted text that can be copied."""

    kind: ClassVar[str] = "code"
    text: str
    title: str = ""


@dataclass(frozen=True, eq=False)
class Details:
    """Blocks that are folded away until the reader opens them."""

    kind: ClassVar[str] = "details"
    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True, eq=False)
class Choice:
    """Alternatives, one shown at a time: a menu called ``label`` chooses. Without JavaScript all are shown."""

    kind: ClassVar[str] = "choice"
    label: str
    options: Mapping[str, tuple[Block, ...]]


@dataclass(frozen=True, eq=False)
class Player:
    """A player that shows runs of a robot step by step.

    runs: for each name the JSON document that player.js reads. description: the picture in words, for readers who
    cannot see it.
    """

    kind: ClassVar[str] = "player"
    runs: Mapping[str, Any]
    description: str
    caption: str = ""


Block = Paragraph | Callout | Facts | Table | FigureGrid | Code | Details | Choice | Player


@dataclass(frozen=True, eq=False)
class Section:
    """A part of the report with its line in the table of contents. ``key`` is unique in the document.

    about: its content in a line under the title. folded: only title and line are shown until the reader opens it.
    """

    key: str
    title: str
    blocks: tuple[Block, ...] = ()
    sections: tuple[Section, ...] = ()
    badges: tuple[Badge, ...] = ()
    about: str = ""
    folded: bool = False


def answer_section(sentence: str, tiles: Sequence[Fact], *more: Block | None, title: str = "Answer") -> Section:
    """The section that a report begins with: the answer in a sentence, a few numbers, a picture, then the rest."""
    shown = (block for block in more if block is not None)
    return Section("answer", title, (Paragraph(sentence, "lead"), Facts(tuple(tiles), "tiles"), *shown))


@dataclass(frozen=True, eq=False)
class Document:
    """A whole report."""

    title: str
    subtitle: str
    sections: tuple[Section, ...]
    badges: tuple[Badge, ...] = ()
