"""Ranks of methods with their critical difference, and performance profiles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.report.blocks import Block, Choice, Figure, FigureGrid, LegendItem, Paragraph, Section
from omnibench.report.numbers import fixed, significant
from omnibench.report.style import INK, QUIET, logarithmic, plot, text
from omnibench.report.traces import line, marks
from omnibench.study.cells import StudyCell
from omnibench.study.ranks import Ranking, profiles, ranking
from omnibench.study.report.study_view import StudyView
from omnibench.words import plural

_ALL = "all robots"
_ASKED = "cells in which every method was asked"
_FACTORS = np.geomspace(1.0, 8.0, 80)  # multiples of the best error at which profiles are drawn; chosen
_BAR = LegendItem("alike", "not told apart", QUIET)


def rank_section(view: StudyView) -> Section:
    """Ranks and profiles over all cells, and robot by robot."""
    choices: dict[str, tuple[Block, ...]] = {}
    asked = tuple(cell for cell in view.judged() if all(name in cell.methods for name in view.methods))
    parts = {_ALL: view.judged(), _ASKED: asked, **{name: view.judged(name) for name in view.robots}}
    if len(view.robots) == 1:
        del parts[_ALL]
    if not asked or len(asked) == len(view.judged()):
        del parts[_ASKED]
    for name, cells in parts.items():
        if drawn := (*_diagram(view, cells, name), *_profiles(view, cells, name)):
            choices[name] = drawn
    blocks: tuple[Block, ...] = (Choice("Robots", choices),)
    if not choices:
        blocks = (Paragraph("There is no cell that a method has answered.", "note"),)
    about = "Which method is best over many cells, and how often each is near the best."
    return Section("ranks", "Ranks and profiles", blocks, about=about)


def _diagram(view: StudyView, cells: Sequence[StudyCell], name: str) -> tuple[Block, ...]:
    """The critical-difference diagram of the methods that answered in every cell."""
    ranked = ranking(cells, view.methods)
    if ranked is None:
        return (
            Paragraph(
                "Fewer than three methods answered in all of these cells, or there is one cell: no ranks.", "note"
            ),
        )
    rows = len(ranked.methods)
    traces = []
    for row, (method, rank) in enumerate(zip(ranked.methods, ranked.ranks, strict=True)):
        hover = f"{method}: mean rank {fixed(rank, 2)}"
        traces.append(marks(view.styles[method], 11, [float(rank)], [float(row)], hover="%{text}", words=[hover]))
    for number, (first, last) in enumerate(ranked.groups):
        place = rows - 0.3 + 0.45 * number
        ends = [float(ranked.ranks[first]) - 0.03, float(ranked.ranks[last]) + 0.03]
        traces.append(line(_BAR, 5.0, ends, [place, place]))
    figure = plot(*traces, x_title="mean rank (1: the least error)")
    bottom = rows - 0.1 + 0.45 * len(ranked.groups)
    figure.update_yaxes(
        range=[bottom, -0.6], tickvals=list(range(rows)), ticktext=[text(each) for each in ranked.methods], ticks="",
        tickfont_color=INK, showgrid=False,
    )  # fmt: skip
    figure.update_xaxes(range=[0.8, rows + 0.2])
    title = f"Mean ranks of methods, {name}"
    words = ", ".join(f"{m} {fixed(r, 2)}" for m, r in zip(ranked.methods, ranked.ranks, strict=True))
    height = 90 + 24 * (rows + len(ranked.groups))
    grid = FigureGrid(
        (Figure(title, figure, words, height),),
        (_BAR,) if ranked.groups else (),
        1,
        _rank_words(ranked),
        f"ranks-{name}",
    )
    return (grid,)


def _rank_words(ranked: Ranking) -> str:
    return (
        f"Methods that answered in all {plural(ranked.cells, 'cell')}. Bars join methods whose mean ranks differ by "
        f"less than the critical difference, {fixed(ranked.critical_difference, 2)} (Nemenyi, 95 %); Friedman's "
        f"test that all are alike: p = {significant(ranked.p_value, 2)}. Cells of one robot share runs, so that the "
        "true critical difference is larger."
    )


def _profiles(view: StudyView, cells: Sequence[StudyCell], name: str) -> tuple[Block, ...]:
    """Performance profiles of all methods with an answer."""
    drawn = profiles(cells, view.methods)
    if not drawn:
        return ()
    traces = []
    for each in drawn:
        shares = [each.share(factor) for factor in _FACTORS]
        hovers = [
            f"{each.method}: {100 * share:.0f} % within {factor:.2f} x"
            for factor, share in zip(_FACTORS, shares, strict=True)
        ]
        traces.append(
            line(view.styles[each.method], 2.0, _FACTORS, shares, hover="%{text}", words=hovers, line_shape="hv")
        )
    figure = plot(*traces, x_title="error as a multiple of the best in the cell", y_title="share of the cells")
    logarithmic(figure, "x", 1.0, 8.0)
    figure.update_yaxes(range=[-0.02, 1.02])
    words = "; ".join(f"{each.method}: best in {100 * each.share(1.0):.0f} %" for each in drawn)
    caption = (
        "The higher, the more often a method is near the best one of a cell; at 1: how often it is the best. A method "
        "that is not for a robot has no answer in its cells, which count; one that was not asked in all of these is "
        "left out."
    )
    grid = FigureGrid(
        (Figure(f"Performance profiles, {name}", figure, words, 380),),
        tuple(view.styles[each.method] for each in drawn),
        1,
        caption,
        f"profiles-{name}",
    )
    return (grid,)
