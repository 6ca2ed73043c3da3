"""The report of a study: one HTML file that opens offline.

The answer, the reference method beside the best published one cell by cell; every cell, as a picture of all ratios to
the design values and a table; figures by regime; ranks of methods with their critical difference, and performance
profiles.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from omnibench.compare import result as results
from omnibench.compare.config import AS_RECORDED
from omnibench.compare.report.view import interval_in_words
from omnibench.compare.statistics import profiles, ranking
from omnibench.report import blocks as page
from omnibench.report.figures import joined, line, marks
from omnibench.report.numbers import NOTHING, count, fixed, listing, seconds, significant
from omnibench.report.render import reproduction_section
from omnibench.report.style import INK, PALETTE, QUIET, THEORETICAL, colours, logarithmic, plot, text, wrapped
from omnibench.robot.kinematics import Robot
from omnibench.words import plural

_FAMILIES = {"ours": "omnibench", "published": "published", "baseline": "baseline", "other": ""}


@dataclass(frozen=True, eq=False)
class StudyView:
    """styles: of each method, the same in the whole report. methods: their names, in the config's order."""

    result: results.ComparisonResult
    methods: tuple[str, ...]
    styles: Mapping[str, page.LegendItem]

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots that were read."""
        return tuple(robot.name for robot in self.result.robots)

    def design(self, name: str) -> Robot:
        """The robot called ``name`` as it was drawn."""
        return next(robot.dataset.robot for robot in self.result.robots if robot.name == name)

    def judged(self, robot: str | None = None) -> tuple[results.Cell, ...]:
        """The cells that verdicts rest on, of one robot or of all."""
        return tuple(cell for cell in self.result.judged_cells if robot in (None, cell.key.robot))

    def plain(self, robot: str) -> tuple[results.Cell, ...]:
        """The cells of a robot as recorded: judged ones, then training errors."""
        keys = [(cell, cell.key) for cell in self.result.cells]
        mine = [cell for cell, key in keys if key.robot == robot and key.regime == AS_RECORDED]
        return tuple(sorted(mine, key=lambda cell: cell.key.fitted))

    def family(self, method: str) -> str:
        """A method's family in a word."""
        families = {choice.shown: choice.family for choice in self.result.config.entries}
        return _FAMILIES[families[method]]


def cell_words(cell: results.Cell) -> str:
    """A cell within its robot: ``circular → square``."""
    return f"{cell.key.training} → {cell.key.judged}"


_COLUMNS = (
    page.Column("Method", numeric=False),
    page.Column("Position", "mm"),
    page.Column("Heading", "°"),
    page.Column("Eq. (6) / design"),
    page.Column("Verdict", numeric=False),
    page.Column("Time", priority=1),
    page.Column("What it found", numeric=False, priority=2),
)
# Blue where the design values' error falls, white where it stays, red where it grows: log2 of the ratio, cut at an
# eighth and eight times (chosen).
_SCALE = [[0.0, "#7fb2dc"], [0.5, "#ffffff"], [1.0, "#f0919d"]]
_CUT = 3.0
_LEAST_SHARE = 0.05  # %: smaller changes of an element are rounded away
_LABELS, _COLUMN = 320, 62  # px that the names of cells and each method need


def robot_cells(view: StudyView, robot: str) -> page.Section:
    """All cells of one robot."""
    cells = view.plain(robot)
    judged = len(view.result.judged_cells)
    tables: dict[str, tuple[page.Block, ...]] = {_column(cell): (cell_table(cell, view, judged),) for cell in cells}
    return page.Section(
        f"cells-{robot}",
        robot,
        (heat_map(view, robot), page.Choice("Cell", tables)),
        about="Method by cell, against the design.",
    )


def heat_map(view: StudyView, robot: str) -> page.FigureGrid:
    """Ratio of every method's error to the design values' in every cell of a robot: a row a cell, a column a method."""
    cells = view.plain(robot)
    answered = [name for name in view.methods if any(_ratio(cell, name) is not None for cell in cells)]
    methods = [name for name in answered if view.family(name) != "baseline"]
    values = [[_ratio(cell, name) for name in methods] for cell in cells]
    words = [[NOTHING if value is None else fixed(value, 2) for value in row] for row in values]
    trace = go.Heatmap(
        z=[[_log(value) for value in row] for row in values],
        x=list(range(len(methods))),
        y=list(range(len(cells))),
        text=words,
        texttemplate="%{text}",
        textfont={"size": 12, "color": INK},
        colorscale=_SCALE,
        zmin=-_CUT,
        zmax=_CUT,
        showscale=False,
        xgap=2,
        ygap=2,
        hoverinfo="skip",
    )
    figure = plot(trace)
    names = [text(wrapped(name, 10)) for name in methods]
    figure.update_xaxes(
        tickvals=list(range(len(methods))), ticktext=names, side="top", showgrid=False, ticks="", tickangle=0,
        tickfont={"color": INK, "size": 11},
    )  # fmt: skip
    figure.update_yaxes(
        tickvals=list(range(len(cells))), ticktext=[text(_column(cell)) for cell in cells], autorange="reversed",
        ticks="", showgrid=False, tickfont_color=INK,
    )  # fmt: skip
    title = f"{robot}: error as a share of the design values'"
    described = "; ".join(
        f"{_column(cell)}: " + ", ".join(f"{name} {each}" for name, each in zip(methods, row, strict=True))
        for cell, row in zip(cells, words, strict=True)
    )
    silent = [name for name in view.methods if _is_for_none(cells, name)]
    without = f" Not for this robot or these paths: {', '.join(silent)}." if silent else ""
    caption = (
        "Rows: training → judged kind. Eq. (6); below 1 the design values' error falls. Training errors: the judged "
        f"runs trained. {NOTHING}: no answer, or not asked (see the tables).{without}"
    )
    height, width = 110 + 26 * len(cells), _LABELS + _COLUMN * len(methods)
    return page.FigureGrid((page.Figure(title, figure, described, height, width),), (), 1, caption, f"cells-{robot}")


def cell_table(cell: results.Cell, view: StudyView, judged: int) -> page.Table:
    """Every method in one cell, the least error first, those without an answer last. judged: cells of the family."""
    rows = sorted(cell.methods.values(), key=lambda each: (each.errors is None, each.mean("cost") or 0.0))
    answered = [each for each in rows if each.errors is not None]
    best = answered[0].method if answered else ""
    runs = len(set(cell.pairs.runs.tolist()))
    folds = len(set(cell.pairs.folds.tolist()))
    size = (
        f"{plural(runs, 'run')} of {plural(cell.pairs.sessions, 'session')} judge {plural(folds, 'calibration')} each"
    )
    ratios = [ratio for each in answered if (ratio := cell.against_design(each.method, judged)) is not None]
    unit = f"; intervals by {ratios[0].units}" if ratios else ""
    return page.Table(
        f"{cell.key.robot}: {cell_words(cell)}",
        _COLUMNS,
        tuple(_row(each, cell, view, judged, each.method == best) for each in rows),
        f"Mean final errors; {size}{unit}. Small print under the ratio: 95 % interval of this cell; the verdict "
        f"is that of each method in {plural(judged, 'cell')} together. Under what was found: "
        "changes of the first answer's matrix, column by column, in % of each row's largest element."
        + (" Training errors, on which no verdict rests." if cell.key.fitted else ""),
    )


def _row(each: results.MethodInCell, cell: results.Cell, view: StudyView, judged: int, best: bool) -> page.Row:
    name = page.Cell(each.method, view.family(each.method))
    position, heading = each.mean("position"), each.mean("heading")
    if position is None or heading is None:
        return page.Row.of(name, NOTHING, NOTHING, NOTHING, each.status, NOTHING, each.reason, role="failed")
    ratio = cell.against_design(each.method, judged)
    assert ratio is not None  # it has an answer
    partly = "" if each.answers == each.fits else f"{each.status}; else the design"
    return page.Row.of(
        name,
        fixed(1e3 * position, 1),
        fixed(math.degrees(heading), 2),
        page.Cell(fixed(ratio.value, 3), interval_in_words(ratio.alone, 2)),
        page.Cell("" if cell.key.fitted or ratio.equal else ratio.verdict, partly),
        seconds(each.seconds if view.result.config.timing else None),
        page.Cell(each.numbers, _change(each, view.design(cell.key.robot))),
        role="best" if best else "plain",
    )


def _change(each: results.MethodInCell, robot: Robot) -> str:
    """Change of the elements of each row of the matrix, in % of the row's largest; empty for the design values."""
    if each.matrix is None:
        return ""
    shares = 100 * (each.matrix - robot.inverse_kinematic_matrix) / robot.row_scales[:, None]
    rows = [
        f"{name} {', '.join(f'{share:+.1f}' for share in row)}"
        for name, row in zip(("x", "y", "turn"), shares, strict=True)
        if np.abs(row).max() >= _LEAST_SHARE
    ]
    return f"matrix: {'; '.join(rows)} % of the row" if rows else ""


def _is_for_none(cells: Sequence[results.Cell], method: str) -> bool:
    """True if a method was asked in some cells and applicable in none."""
    asked = [cell.methods[method] for cell in cells if method in cell.methods]
    return bool(asked) and all(each.status == "not applicable" for each in asked)


def _ratio(cell: results.Cell, method: str) -> float | None:
    mean, design = cell.mean(method), float(cell.design["cost"].mean())
    return None if mean is None or design == 0 else mean / design


def _log(ratio: float | None) -> float | None:
    return None if ratio is None else float(np.clip(np.log2(max(ratio, 1e-9)), -_CUT, _CUT))


def _column(cell: results.Cell) -> str:
    return f"{cell_words(cell)}{' (training errors)' if cell.key.fitted else ''}"


_CURVE = re.compile(r"^(?P<kind>.+), (?P<count>\d+) runs? a command$")
_BROKEN = 1.5  # times the method's own error as recorded, from which on it counts as broken; chosen


def regime_section(view: StudyView) -> tuple[page.Section, ...]:
    """Which method breaks where; nothing without regimes."""
    regimes = tuple(view.result.config.regimes)
    if not regimes:
        return ()
    tables: dict[str, tuple[page.Block, ...]] = {}
    for robot in view.robots:
        cells = _by_regime(view, robot)
        for place, of_place in cells.items():
            if len(of_place) > 1:
                tables[f"{robot}: {place}"] = (_regime_table(view, f"{robot}: {place}", of_place, regimes),)
    blocks: tuple[page.Block, ...] = (_breaking_table(view, regimes), page.Choice("Cell", tables))
    about = "Fewer runs, noise, outliers and drifting clocks in the training runs; those that judge stay as recorded."
    return (page.Section("regimes", "Which method breaks where", blocks, about=about),)


def _by_regime(view: StudyView, robot: str) -> dict[str, dict[str, results.Cell]]:
    places: dict[str, dict[str, results.Cell]] = {}
    for cell in view.result.cells:
        if cell.key.robot == robot and not cell.key.fitted:
            places.setdefault(cell_words(cell), {})[cell.key.regime] = cell
    return places


def _breaking_table(view: StudyView, regimes: Sequence[str]) -> page.Table:
    """Over all cells: geometric mean of a method's error as a multiple of its own as recorded."""
    rows = []
    for method in view.methods:
        cells = []
        for regime in regimes:
            ratios = [
                ratio
                for robot in view.robots
                for of_place in _by_regime(view, robot).values()
                if (ratio := _growth(of_place, regime, method)) is not None
            ]
            worse = sum(
                _worse_than_design(of_place, regime, method)
                for robot in view.robots
                for of_place in _by_regime(view, robot).values()
            )
            if (mean := results.mean_ratio(ratios)) is None:
                cells.append(page.Cell(NOTHING))
                continue
            broken = sum(ratio > _BROKEN for ratio in ratios)
            note = f"{broken} of {len(ratios)} break; {worse} worse"
            cells.append(page.Cell(fixed(mean, 2), note))
        if any(cell.text != NOTHING for cell in cells):
            rows.append(page.Row.of(method, *cells))
    return page.Table(
        "Error as a multiple of the method's own as recorded",
        (page.Column("Method", numeric=False), *(page.Column(regime) for regime in regimes)),
        tuple(rows),
        f"Eq. (6), geometric mean over cells. Break: cells with more than {_BROKEN:g} times its own error as recorded; "
        "worse: with more error than the design. "
        f"{NOTHING}: no answer.",
    )


def _regime_table(
    view: StudyView, title: str, of_place: Mapping[str, results.Cell], regimes: Sequence[str]
) -> page.Table:
    rows = []
    for method in view.methods:
        if method not in of_place[AS_RECORDED].methods:
            continue
        cells = [_errors(of_place.get(regime), method) for regime in (AS_RECORDED, *regimes)]
        rows.append(page.Row.of(method, *cells))
    columns = (page.Column("Method", numeric=False), *(page.Column(name, "mm") for name in (AS_RECORDED, *regimes)))
    return page.Table(title, columns, tuple(rows), "Mean final position error; small print: heading.")


def _errors(cell: results.Cell | None, method: str) -> page.Cell:
    each = None if cell is None else cell.methods.get(method)
    position, heading = (None, None) if each is None else (each.mean("position"), each.mean("heading"))
    if each is None or position is None or heading is None:
        return page.Cell(NOTHING, "" if each is None else each.status)
    return page.Cell(fixed(1e3 * position, 1), f"{fixed(np.degrees(heading), 2)}°")


def _growth(of_place: Mapping[str, results.Cell], regime: str, method: str) -> float | None:
    before, after = (of_place[name].mean(method) if name in of_place else None for name in (AS_RECORDED, regime))
    return None if not before or not after else after / before


def _worse_than_design(of_place: Mapping[str, results.Cell], regime: str, method: str) -> bool:
    cell = of_place.get(regime)
    mean = None if cell is None else cell.mean(method)
    return cell is not None and mean is not None and mean > float(cell.design["cost"].mean()) * (1 + 1e-9)


def curve_section(view: StudyView) -> tuple[page.Section, ...]:
    """Learning curves; nothing where no training is on one."""
    curves: dict[str, dict[int, results.Cell]] = {}
    for cell in view.judged():
        if match := _CURVE.match(cell.key.training):
            name = f"{cell.key.robot}: {match['kind']} → {cell.key.judged}"
            curves.setdefault(name, {})[int(match["count"])] = cell
    drawn = {name: points for name, points in curves.items() if len(points) > 1}
    if not drawn:
        return ()
    figures = tuple(_curve(view, name, points) for name, points in drawn.items())
    cells = [cell for points in drawn.values() for cell in points.values()]
    shown = [name for name in view.methods if any(cell.mean(name) is not None for cell in cells)]
    grid = page.FigureGrid(
        figures, tuple(view.styles[name] for name in shown), 2,
        "Runs of each command that train, against the mean final error, Eq. (6), of runs that never train.", "curves",
    )  # fmt: skip
    return (page.Section("curves", "Learning curves", (grid,), about="How many runs a method needs."),)


def _curve(view: StudyView, name: str, points: Mapping[int, results.Cell]) -> page.Figure:
    counts = sorted(points)
    traces: list[go.Scatter] = []
    least, most = [], []
    for method in view.methods:
        pairs = [(count, mean) for count in counts if (mean := points[count].mean(method)) is not None]
        if not pairs:
            continue
        x, y = [float(count) for count, _ in pairs], [mean for _, mean in pairs]
        words = [f"{method}: {plural(count, 'run')} a command, {fixed(mean, 4)}" for count, mean in pairs]
        traces += [
            line(view.styles[method], 2.0, x, y),
            marks(view.styles[method], 7, x, y, hover="%{text}", words=words),
        ]
        least.append(min(y))
        most.append(max(y))
    figure = plot(*traces, x_title="runs of a command", y_title="Eq. (6)")
    if least:
        logarithmic(figure, "y", 0.9 * min(least), 1.1 * max(most))
    figure.update_xaxes(tickvals=counts)
    return page.Figure(name, figure, f"{name}: error against {', '.join(map(str, counts))} runs of a command", 340)


_VERDICTS = ("better", "undecided", "worse")
_STYLES = {
    "better": page.LegendItem("better", "less error than the best published method", PALETTE[0]),
    "undecided": page.LegendItem("undecided", "chance could explain the difference", QUIET),
    "worse": page.LegendItem("worse", "more error", "#c8102e"),
}
_ROW = 20  # px of a cell


def study_answer(view: StudyView) -> page.Section:
    """The section that the report begins with."""
    result, reference = view.result, view.result.config.reference
    compared = result.against_best
    cells, robots = len(view.judged()), len(view.robots)
    size = f"{plural(len(view.methods), 'method')}, {plural(robots, 'robot')}, {plural(cells, 'cell')}"
    asked = sum(not run.fit.refusal for run in result.runs)
    tiles = [page.Fact("Size", size, f"a cell: robot, training runs, judged kind; {plural(asked, 'fit')}")]
    if not compared or result.geometric_mean is None:
        words = f"{size}: every method was fitted to the same runs, and judged on runs that it had not seen."
        return page.answer_section(words, tiles, None)
    verdicts = [each.ratio.verdict for each in compared]
    counts = [sum(one == verdict for one in verdicts) for verdict in _VERDICTS]
    worse = str(counts[-1] or "none")
    words = (
        f"The error of {reference} is {fixed(result.geometric_mean, 2)} times that of the best published method of "
        f"each cell (geometric mean of {plural(len(compared), 'cell')}); it is worse beyond chance in {worse}."
    )
    tiles += [
        page.Fact("Ratio of errors, geometric mean", fixed(result.geometric_mean, 2), "below 1: less error"),
        page.Fact("Better, undecided, worse", ", ".join(str(count) for count in counts), "cells, family-wise"),
    ]
    note = (
        "The best published method is chosen after the fact in every cell, which no user could: the comparison favours "
        "it. Errors are Eq. (6), of runs that did not train."
    )
    return page.answer_section(words, tiles, _chart(compared, reference or ""), page.Paragraph(note, "note"))


def _chart(compared: tuple[results.AgainstBest, ...], reference: str) -> page.FigureGrid:
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
    return page.FigureGrid(
        (page.Figure(title, figure, picture, height),), items, 1, caption, "against-the-best-published"
    )


def _hover(each: results.AgainstBest, reference: str) -> str:
    interval = interval_in_words(each.ratio.in_family, 2)
    return (
        f"{each.cell.key.words}: {reference} {fixed(each.ratio.value, 2)} x {each.best} "
        f"({interval}, {each.ratio.units})"
    )


_ALL = "all robots"
_ASKED = "cells in which every method was asked"
_FACTORS = np.geomspace(1.0, 8.0, 80)  # multiples of the best error at which profiles are drawn; chosen
_BAR = page.LegendItem("alike", "not told apart", QUIET)


def rank_section(view: StudyView) -> page.Section:
    """Ranks and profiles over all cells, and robot by robot."""
    choices: dict[str, tuple[page.Block, ...]] = {}
    asked = tuple(cell for cell in view.judged() if all(name in cell.methods for name in view.methods))
    parts = {_ALL: view.judged(), _ASKED: asked, **{name: view.judged(name) for name in view.robots}}
    if len(view.robots) == 1:
        del parts[_ALL]
    if not asked or len(asked) == len(view.judged()):
        del parts[_ASKED]
    for name, cells in parts.items():
        if drawn := (*_diagram(view, cells, name), *_profiles(view, cells, name)):
            choices[name] = drawn
    blocks: tuple[page.Block, ...] = (page.Choice("Robots", choices),)
    if not choices:
        blocks = (page.Paragraph("There is no cell that a method has answered.", "note"),)
    about = "Which method is best over many cells, and how often each is near the best."
    return page.Section("ranks", "Ranks and profiles", blocks, about=about)


def _diagram(view: StudyView, cells: Sequence[results.Cell], name: str) -> tuple[page.Block, ...]:
    """The critical-difference diagram of the methods that answered in every cell."""
    ranked = ranking(cells, view.methods)
    if ranked is None:
        return (
            page.Paragraph(
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
    grid = page.FigureGrid(
        (page.Figure(title, figure, words, height),),
        (_BAR,) if ranked.groups else (),
        1,
        f"Methods that answered in all {plural(ranked.cells, 'cell')}. Bars join methods whose mean ranks differ by "
        f"less than the critical difference, {fixed(ranked.critical_difference, 2)} (Nemenyi, 95 %); Friedman's "
        f"test that all are alike: p = {significant(ranked.p_value, 2)}. Cells of one robot share runs, so that the "
        "true critical difference is larger.",
        f"ranks-{name}",
    )
    return (grid,)


def _profiles(view: StudyView, cells: Sequence[results.Cell], name: str) -> tuple[page.Block, ...]:
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
    grid = page.FigureGrid(
        (page.Figure(f"Performance profiles, {name}", figure, words, 380),),
        tuple(view.styles[each.method] for each in drawn),
        1,
        caption,
        f"profiles-{name}",
    )
    return (grid,)


_SHOWN = 12  # failures that are listed; the others are counted


def study_document(result: results.ComparisonResult) -> page.Document:
    """The report as blocks."""
    # A method has the same colour and line in the whole report
    wanted = {choice.shown: THEORETICAL if choice.name == "theoretical" else None for choice in result.config.entries}
    drawn = colours(wanted)
    styles = {name: page.LegendItem(f"method-{i}", name, *drawn[name]) for i, name in enumerate(wanted)}
    view = StudyView(result, tuple(wanted), styles)
    return page.Document(
        title=f"Calibration methods on several robots: {result.config.name}",
        subtitle=result.config.description,
        sections=(
            study_answer(view),
            *_notes(result),
            page.Section("cells", "Every cell", sections=tuple(robot_cells(view, robot) for robot in view.robots)),
            rank_section(view),
            *curve_section(view),
            *regime_section(view),
            _method_section(view),
            _data_section(result),
            _reproduction(result),
        ),
        badges=page.simulated_badge(*(robot.dataset.simulated for robot in result.robots)),
    )


def _notes(result: results.ComparisonResult) -> tuple[page.Section, ...]:
    blocks: list[page.Block] = []
    if result.config.notes:
        blocks.append(page.Callout("Notes of the config", result.config.notes))
    if result.broken:
        items = tuple(f"{name}: {reason}" for name, reason in result.broken.items())
        blocks.append(page.Callout("Recordings that cannot be read", items, "warning"))
    if result.failures:
        more = len(result.failures) - _SHOWN
        rest = (f"and {more} more, see study.parquet",) if more > 0 else ()
        blocks.append(page.Callout("Fits that failed", (*result.failures[:_SHOWN], *rest), "warning"))
    if result.warnings:
        blocks.append(page.Callout("Warnings", result.warnings, "warning"))
    return (page.Section("notes", "Before you rely on it", tuple(blocks)),) if blocks else ()


def _method_section(view: StudyView) -> page.Section:
    """Outcomes, time and first numbers of every method, robot by robot."""
    rows = []
    for robot in view.robots:
        rows.append(page.Row.of(robot, role="group"))
        rows += [row for method in view.methods if (row := _method_row(view, robot, method)) is not None]
    table = page.Table(
        "Outcomes and time",
        (
            page.Column("Method", numeric=False),
            page.Column("Fits"),
            page.Column("Outcomes", numeric=False),
            page.Column("Median time"),
            page.Column("Says of its first answer, or why it has none", numeric=False),
        ),
        tuple(rows),
        "Not applicable: the method is not for this robot, or not for such paths.",
    )
    about = "How each method ended on each robot, what it took and what it found."
    return page.Section("methods", "Methods, time and parameters", (table,), about=about, folded=True)


def _method_row(view: StudyView, robot: str, method: str) -> page.Row | None:
    fits = [each for each in view.result.runs if each.fit.robot.name == robot and each.fit.label == method]
    if not fits:
        return None
    outcomes = Counter(str(each.result.outcome) for each in fits)
    answered = [each for each in fits if each.errors is not None]
    spent = sorted(each.result.seconds for each in answered)
    first = answered[0] if answered else fits[0]
    return page.Row.of(
        page.Cell(method, view.family(method)),
        count(len(fits)),
        ", ".join(f"{number} {outcome}" for outcome, number in outcomes.items()),
        seconds(spent[len(spent) // 2] if spent and view.result.config.timing else None),
        first.result.reason,
        role="plain" if answered else "muted",
    )


def _data_section(result: results.ComparisonResult) -> page.Section:
    rows = []
    for robot in result.robots:
        dataset = robot.dataset
        sessions = {run.session for run in dataset.trajectories} - {None}
        rows.append(
            page.Row.of(
                page.Cell(robot.name, "simulated" if dataset.simulated else "recorded"),
                count(len(dataset.trajectories)),
                count(len(sessions)) if sessions else "not known",
                listing([training.name for training in robot.trainings], 20),
                page.Cell(dataset.source, dataset.licence),
            )
        )
    rows += [
        page.Row.of(name, "", "", page.Cell("cannot be read", reason), "", role="failed")
        for name, reason in result.broken.items()
    ]
    table = page.Table(
        "Robots",
        (
            page.Column("Robot", numeric=False),
            page.Column("Runs"),
            page.Column("Sessions"),
            page.Column("Trainings", numeric=False),
            page.Column("Source", numeric=False),
        ),
        tuple(rows),
    )
    return page.Section("data", "Data", (table,), about="Where the recordings come from.", folded=True)


def _reproduction(result: results.ComparisonResult) -> page.Section:
    config = result.config
    settings = (
        page.Fact(
            "Budget of each fit", f"{plural(config.budget.evaluations, 'evaluation')} or {config.budget.seconds:g} s"
        ),
        page.Fact("Seeds", listing([str(seed) for seed in config.seeds], 20)),
    )
    return reproduction_section(config, settings, result.environment)
