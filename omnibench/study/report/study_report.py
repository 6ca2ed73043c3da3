"""The report of a study: one HTML file that opens offline.

The answer of a study: the reference method beside the best published one, cell by cell.

Ranks of methods with their critical difference, and performance profiles.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from omnibench.compare.report.view import interval_in_words
from omnibench.report.blocks import (
    Block,
    Callout,
    Cell,
    Choice,
    Column,
    Document,
    Fact,
    Figure,
    FigureGrid,
    LegendItem,
    Paragraph,
    Row,
    Section,
    Table,
    answer_section,
    simulated_badge,
)
from omnibench.report.figures import joined, line, marks
from omnibench.report.numbers import count, fixed, listing, seconds, significant
from omnibench.report.render import reproduction_section
from omnibench.report.style import INK, PALETTE, QUIET, logarithmic, plot, text
from omnibench.study.cells import StudyCell
from omnibench.study.report.cell_tables import (
    StudyView,
    cell_words,
    curve_section,
    regime_section,
    robot_cells,
    study_view,
)
from omnibench.study.study_result import AgainstBest, StudyResult, profiles, ranking
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
    interval = interval_in_words(each.ratio.in_family, 2)
    return (
        f"{each.cell.key.words}: {reference} {fixed(each.ratio.value, 2)} x {each.best} "
        f"({interval}, {each.ratio.units})"
    )


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
        f"Methods that answered in all {plural(ranked.cells, 'cell')}. Bars join methods whose mean ranks differ by "
        f"less than the critical difference, {fixed(ranked.critical_difference, 2)} (Nemenyi, 95 %); Friedman's "
        f"test that all are alike: p = {significant(ranked.p_value, 2)}. Cells of one robot share runs, so that the "
        "true critical difference is larger.",
        f"ranks-{name}",
    )
    return (grid,)


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


_SHOWN = 12  # failures that are listed; the others are counted


def study_document(result: StudyResult) -> Document:
    """The report as blocks."""
    view = study_view(result)
    return Document(
        title=f"Calibration methods on several robots: {result.config.name}",
        subtitle=result.config.description,
        sections=(
            study_answer(view),
            *_notes(result),
            Section("cells", "Every cell", sections=tuple(robot_cells(view, robot) for robot in view.robots)),
            rank_section(view),
            *curve_section(view),
            *regime_section(view),
            _method_section(view),
            _data_section(result),
            _reproduction(result),
        ),
        badges=simulated_badge(*(robot.dataset.simulated for robot in result.robots)),
    )


def _notes(result: StudyResult) -> tuple[Section, ...]:
    blocks: list[Block] = []
    if result.config.notes:
        blocks.append(Callout("Notes of the config", result.config.notes))
    if result.broken:
        items = tuple(f"{name}: {reason}" for name, reason in result.broken.items())
        blocks.append(Callout("Recordings that cannot be read", items, "warning"))
    if result.failures:
        more = len(result.failures) - _SHOWN
        rest = (f"and {more} more, see study.parquet",) if more > 0 else ()
        blocks.append(Callout("Fits that failed", (*result.failures[:_SHOWN], *rest), "warning"))
    if result.warnings:
        blocks.append(Callout("Warnings", result.warnings, "warning"))
    return (Section("notes", "Before you rely on it", tuple(blocks)),) if blocks else ()


def _method_section(view: StudyView) -> Section:
    """Outcomes, time and first numbers of every method, robot by robot."""
    rows = []
    for robot in view.robots:
        rows.append(Row.of(robot, role="group"))
        rows += [row for method in view.methods if (row := _method_row(view, robot, method)) is not None]
    table = Table(
        "Outcomes and time",
        (
            Column("Method", numeric=False),
            Column("Fits"),
            Column("Outcomes", numeric=False),
            Column("Median time"),
            Column("Says of its first answer, or why it has none", numeric=False),
        ),
        tuple(rows),
        "Not applicable: the method is not for this robot, or not for such paths.",
    )
    about = "How each method ended on each robot, what it took and what it found."
    return Section("methods", "Methods, time and parameters", (table,), about=about, folded=True)


def _method_row(view: StudyView, robot: str, method: str) -> Row | None:
    fits = [each for each in view.result.fits if each.fit.robot.name == robot and each.fit.method.shown == method]
    if not fits:
        return None
    outcomes = Counter(str(each.outcome) for each in fits)
    answered = [each for each in fits if each.answered]
    spent = sorted(each.result.seconds for each in answered if each.result is not None)
    first = answered[0] if answered else fits[0]
    return Row.of(
        Cell(method, view.family(method)),
        count(len(fits)),
        ", ".join(f"{number} {outcome}" for outcome, number in outcomes.items()),
        seconds(spent[len(spent) // 2] if spent and view.result.config.timing else None),
        first.reason,
        role="plain" if answered else "muted",
    )


def _data_section(result: StudyResult) -> Section:
    rows = []
    for robot in result.robots:
        dataset = robot.dataset
        sessions = {run.session for run in dataset.trajectories} - {None}
        rows.append(
            Row.of(
                Cell(robot.name, "simulated" if dataset.simulated else "recorded"),
                count(len(dataset.trajectories)),
                count(len(sessions)) if sessions else "not known",
                listing([training.name for training in robot.trainings], 20),
                Cell(dataset.source, dataset.licence),
            )
        )
    rows += [
        Row.of(name, "", "", Cell("cannot be read", reason), "", role="failed")
        for name, reason in result.broken.items()
    ]
    table = Table(
        "Robots",
        (
            Column("Robot", numeric=False),
            Column("Runs"),
            Column("Sessions"),
            Column("Trainings", numeric=False),
            Column("Source", numeric=False),
        ),
        tuple(rows),
    )
    return Section("data", "Data", (table,), about="Where the recordings come from.", folded=True)


def _reproduction(result: StudyResult) -> Section:
    config = result.config
    settings = (
        Fact("Budget of each fit", f"{plural(config.budget.evaluations, 'evaluation')} or {config.budget.seconds:g} s"),
        Fact("Seeds", listing([str(seed) for seed in config.seeds], 20)),
    )
    return reproduction_section(config, settings, result.environment)
