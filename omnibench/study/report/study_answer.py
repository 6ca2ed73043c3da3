"""The answer of a study: the reference method beside the best published one, cell by cell."""

from __future__ import annotations

import numpy as np

from omnibench.report.blocks import Fact, Figure, FigureGrid, LegendItem, Paragraph, Section, answer_section
from omnibench.report.numbers import fixed
from omnibench.report.style import INK, PALETTE, QUIET, logarithmic, plot, text
from omnibench.report.traces import joined, line, marks
from omnibench.study.report.study_view import StudyView, cell_words
from omnibench.study.study_result import AgainstBest
from omnibench.words import plural

_VERDICTS = ("better", "undecided", "worse")
_STYLES = {
    "better": LegendItem("better", "less error than the best published method", PALETTE[0]),
    "undecided": LegendItem("undecided", "chance could explain the difference", QUIET),
    "worse": LegendItem("worse", "more error", "#c8102e"),
}
_ROW = 20  # px of a cell


def study_answer(view: StudyView) -> Section:
    """The section that the report begins with."""
    result, reference = view.result, view.result.config.reference
    compared = result.against_best
    cells, robots = len(view.judged()), len(view.robots)
    size = f"{plural(len(view.methods), 'method')}, {plural(robots, 'robot')}, {plural(cells, 'cell')}"
    asked = sum(fit.result is not None for fit in result.fits)
    tiles = [Fact("Size", size, f"a cell: robot, training runs, judged kind; {plural(asked, 'fit')}")]
    if not compared or result.geometric_mean is None:
        words = f"{size}: every method was fitted to the same runs, and judged on runs that it had not seen."
        return answer_section(words, tiles, None)
    verdicts = [each.ratio.verdict for each in compared]
    counts = [sum(one == verdict for one in verdicts) for verdict in _VERDICTS]
    worse = str(counts[-1] or "none")
    words = (
        f"The error of {reference} is {fixed(result.geometric_mean, 2)} times that of the best published method of "
        f"each cell (geometric mean of {plural(len(compared), 'cell')}); it is worse beyond chance in {worse}."
    )
    tiles += [
        Fact("Ratio of errors, geometric mean", fixed(result.geometric_mean, 2), "below 1: less error"),
        Fact("Better, undecided, worse", ", ".join(str(count) for count in counts), "cells, family-wise"),
    ]
    note = (
        "The best published method is chosen after the fact in every cell, which no user could: the comparison favours "
        "it. Errors are Eq. (6), of runs that did not train."
    )
    return answer_section(words, tiles, _chart(compared, reference or ""), Paragraph(note, "note"))


def _chart(compared: tuple[AgainstBest, ...], reference: str) -> FigureGrid:
    """Ratios of errors by cell, with the interval of the family."""
    rows = list(reversed(list(enumerate(compared))))
    names = [text(f"{each.cell.key.robot}: {cell_words(each.cell)}  [{each.best}]") for each in compared]
    traces = []
    for verdict in _VERDICTS:
        item = _STYLES[verdict]
        mine = [(row, each) for row, each in rows if each.ratio.verdict == verdict]
        spans = [
            np.column_stack([each.ratio.in_family.known, [row, row]])
            for row, each in mine
            if each.ratio.in_family.known is not None
        ]
        words = [_hover(each, reference) for _, each in mine]
        if spans:
            traces.append(line(item, 2.0, *joined(spans).T, line_dash="solid"))
        if mine:
            values, places = [each.ratio.value for _, each in mine], [float(row) for row, _ in mine]
            traces.append(marks(item, 9, values, places, hover="%{text}", words=words))
    figure = plot(*traces, x_title="ratio of errors")
    ratios = [each.ratio.value for each in compared]
    logarithmic(figure, "x", max(min([*ratios, 0.5]) / 2, 0.05), min(max([*ratios, 2.0]) * 2, 20.0))
    figure.add_vline(x=1.0, line_color=INK, line_width=1, line_dash="dot")
    ends = {"range": [len(compared) - 0.4, -0.6], "tickvals": list(range(len(compared))), "ticktext": names}
    figure.update_yaxes(**ends, ticks="", tickfont_color=INK, showgrid=False)
    items = tuple(_STYLES[verdict] for verdict in _VERDICTS if any(e.ratio.verdict == verdict for e in compared))
    caption = (
        f"The error of {reference} over that of the best published method, which is named in brackets. Left of 1: less "
        "error. Lines: intervals of all cells together (95 %, Bonferroni), by sessions where three or more judge, else "
        "by runs; a cell without a line has too few of either. A line that ends at the frame goes on."
    )
    title = "Beside the best published method, cell by cell"
    picture = "; ".join(_hover(each, reference) for each in compared)
    height = 90 + _ROW * len(compared)
    return FigureGrid((Figure(title, figure, picture, height),), items, 1, caption, "against-the-best-published")


def _hover(each: AgainstBest, reference: str) -> str:
    known = each.ratio.in_family.known
    interval = "no interval" if known is None else f"{fixed(known[0], 2)} to {fixed(known[1], 2)}"
    return (
        f"{each.cell.key.words}: {reference} {fixed(each.ratio.value, 2)} x {each.best} "
        f"({interval}, {each.ratio.units})"
    )
