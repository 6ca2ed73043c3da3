"""A result that shows itself: what it says, and its renderers for a terminal, a page, a notebook and a prompt.

A command makes a result and hands it to the renderer of ``omnibench.report.terminal``; the public objects of Python
find theirs through ``omnibench.views``. All of them show the same tables and figures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from shlex import join
from typing import TYPE_CHECKING, Any

import polars as pl

from omnibench.report.blocks import Block, Code, Column, Document, FigureGrid, Paragraph, Row, Table, Tone

if TYPE_CHECKING:
    import plotly.graph_objects as go
    from pydantic import BaseModel

_ROWS = 8  # of a table at a prompt and in a notebook


@dataclass(frozen=True)
class NextStep:
    """What came out, without a full stop; what to do next, as an imperative; the words to type for it."""

    outcome: str
    then: str = ""
    command: tuple[object, ...] = ()


@dataclass(frozen=True)
class Remark:
    """A line below the tables. tone: its colour on a terminal."""

    text: str
    tone: Tone = "plain"


class Result:
    """What a result says. A subclass gives what it has; what is left out is not shown.

    title: what it is. warnings: of the data, which commands print on standard error, each once.
    """

    title: str = ""
    warnings: Sequence[str] = ()

    def sentence(self) -> str:
        """What came out, in one sentence."""
        return ""

    def next_step(self) -> NextStep:
        """What came out, and what to do next."""
        raise NotImplementedError

    def opening(self) -> Sequence[Remark]:
        """Lines above the tables of a terminal, which a page says in its answer."""
        return ()

    def tables(self) -> Sequence[Table]:
        """The tables of the answer, the most important first."""
        return ()

    def remarks(self) -> Sequence[Remark]:
        """Lines below the tables."""
        return ()

    def figures(self) -> Sequence[FigureGrid]:
        """The pictures of the answer, two at most."""
        return ()

    def document(self) -> Document:
        """The whole report, without what to do next."""
        raise NotImplementedError

    def page(self) -> Document:
        """The whole report; its answer says what to do next."""
        return with_next_step(self.document(), self.next_step())

    def json(self) -> Mapping[str, Any] | BaseModel:
        """The document of ``--json``."""
        raise NotImplementedError

    def frames(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        """Data frames in SI units by name; the first is the one that is taken where none is named."""
        return {}

    def figure(self) -> go.Figure:
        """The picture as one figure of Plotly; options are its parameters."""
        from omnibench.report.figures import drawn

        return drawn(self.figures()[0])


def with_next_step(document: Document, step: NextStep) -> Document:
    """A report whose first section says, below its sentence, what to do next."""
    answer, *others = document.sections
    first, *rest = answer.blocks
    following: list[Block] = [Paragraph(f"Next, {step.then}.")] if step.then else []
    if step.command:
        following = [Code(join(map(str, step.command)), f"Next, {step.then}:")]
    return replace(document, sections=(replace(answer, blocks=(first, *following, *rest)), *others))


def frame_table(frame: pl.DataFrame) -> Table:
    """The head of a data frame as a table."""
    columns = tuple(Column(name, numeric=dtype.is_numeric()) for name, dtype in frame.schema.items())
    rows = tuple(
        Row.of(*("" if each is None else f"{each:.6g}" if isinstance(each, float) else str(each) for each in row))
        for row in frame.head(_ROWS).iter_rows()
    )
    return Table("", columns, rows, f"the first {_ROWS} of {len(frame):,} rows" if len(frame) > _ROWS else "")
