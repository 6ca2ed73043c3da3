"""The answer of a comparison on several robots: the reference method beside the best published one, cell by cell.

Every cell as a picture of all ratios to the design values and a table; regimes and learning curves; ranks of methods
with their critical difference, and performance profiles.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import plotly.graph_objects as go

from omnibench.compare import result as results
from omnibench.compare.config import AS_RECORDED
from omnibench.compare.report.view import interval_cell
from omnibench.compare.statistics import profiles, ranking
from omnibench.report import blocks as page
from omnibench.report.figures import joined, line, marks
from omnibench.report.numbers import NOTHING, count, fixed, listing, seconds, significant
from omnibench.report.style import INK, PALETTE, QUIET, THEORETICAL, colours, logarithmic, plot, text, wrapped
from omnibench.words import plural

_VERDICTS = (
    page.LegendItem("better", "less error than the best published method", PALETTE[0]),
    page.LegendItem("undecided", "chance could explain the difference", QUIET),
    page.LegendItem("worse", "more error", "#c8102e"),
)
# Blue where the design values' error falls, white where it stays, red where it grows: log2 of the ratio, cut at an
# eighth and eight times (chosen).
_SCALE = [[0.0, "#7fb2dc"], [0.5, "#ffffff"], [1.0, "#f0919d"]]
_CUT = 3.0
_BROKEN = 1.5  # times the method's own error as recorded, from which on it counts as broken; chosen
_CURVE = re.compile(r"^(?P<kind>.+), (?P<count>\d+) runs? a command$")
_FACTORS = np.geomspace(1.0, 8.0, 80)  # multiples of the best error at which profiles are drawn; chosen
_BAR = page.LegendItem("alike", "not told apart", QUIET)


@dataclass(frozen=True, eq=False)
class RobotsView:
    """The cells of a comparison on several robots."""

    result: results.ComparisonResult

    @cached_property
    def styles(self) -> Mapping[str, page.LegendItem]:
        """A colour and line for each method, the same in the whole report."""
        entries = self.result.config.entries
        drawn = colours({each.shown: THEORETICAL if each.name == "theoretical" else None for each in entries})
        return {name: page.LegendItem(f"method-{i}", name, *drawn[name]) for i, name in enumerate(drawn)}

    @property
    def methods(self) -> tuple[str, ...]:
        """Their names, in the config's order."""
        return tuple(self.styles)

    def cells(self, robot: str) -> tuple[results.Cell, ...]:
        """The cells of a robot as recorded: judged ones, then training errors."""
        mine = [c for c in self.result.cells if c.key.robot == robot and c.key.regime == AS_RECORDED]
        return tuple(sorted(mine, key=lambda cell: cell.key.fitted))


def cell_words(cell: results.Cell) -> str:
    """A cell within its robot: ``circular → square``."""
    return f"{cell.key.training} → {cell.key.judged}{' (training errors)' if cell.key.fitted else ''}"


def robots_sentence(result: results.ComparisonResult) -> str:
    """The answer in a sentence."""
    worse = sum(each.ratio.verdict == "worse" for each in result.against_best)
    if result.geometric_mean is None:
        cells, robots = plural(len(result.judged_cells), "cell"), plural(len(result.robots), "robot")
        return f"{plural(len(result.config.entries), 'method')} judged in {cells} of {robots}, by runs not seen before."
    return (
        f"The error of {result.config.reference} is {fixed(result.geometric_mean, 2)} times that of the best published "
        f"method of each cell (geometric mean of {plural(len(result.against_best), 'cell')}); it is worse beyond "
        f"chance in {worse or 'none'}."
    )


def robots_answer(result: results.ComparisonResult) -> page.Section:
    """The sentence, tiles, and the reference method beside the best published one in every cell."""
    asked = sum(not run.fit.refusal for run in result.runs)
    size = f"{plural(len(result.config.entries), 'method')}, {plural(len(result.robots), 'robot')}"
    tiles = [page.Fact("Size", size, f"{plural(len(result.judged_cells), 'cell')}, {plural(asked, 'fit')}")]
    if result.geometric_mean is None:
        return page.answer_section(robots_sentence(result), tiles, None, methods_table(result))
    verdicts = Counter(each.ratio.verdict for each in result.against_best)
    counts = ", ".join(str(verdicts[item.key]) for item in _VERDICTS)  # type: ignore[index]
    tiles.append(page.Fact("Ratio of errors, geometric mean", fixed(result.geometric_mean, 2), "below 1: less error"))
    tiles.append(page.Fact("Better, undecided, worse", counts, "cells, family-wise"))
    compared = list(enumerate(result.against_best))
    reference, traces, words = result.config.reference, list[go.Scatter](), list[str]()
    for item in _VERDICTS:
        mine = [(row, each) for row, each in compared if each.ratio.verdict == item.key]
        spans = [np.column_stack([known, [row, row]]) for row, each in mine if (known := each.ratio.in_family.known)]
        hovers = [
            f"{each.cell.key.words}: {reference} {fixed(each.ratio.value, 2)} x {each.best} "
            f"({interval_cell(each.ratio.in_family, 2)}, {each.ratio.units})"
            for _, each in mine
        ]
        traces += [line(item, 2.0, *joined(spans).T, line_dash="solid")] if spans else []
        values, places = [each.ratio.value for _, each in mine], [float(row) for row, _ in mine]
        traces += [marks(item, 9, values, places, hover="%{text}", words=hovers)] if mine else []
        words += hovers
    figure, ratios = plot(*traces, x_title="ratio of errors"), [each.ratio.value for _, each in compared]
    logarithmic(figure, "x", max(min([*ratios, 0.5]) / 2, 0.05), min(max([*ratios, 2.0]) * 2, 20.0))
    figure.add_vline(x=1.0, line_color=INK, line_width=1)
    names = [text(f"{each.cell.key.robot}: {cell_words(each.cell)}  [{each.best}]") for _, each in compared]
    figure.update_yaxes(
        range=[len(compared) - 0.4, -0.6], tickvals=list(range(len(compared))), ticktext=names, ticks="",
        tickfont={"color": INK, "size": 11}, showgrid=False,
    )  # fmt: skip
    title, height = "Beside the best published method, cell by cell", 90 + 20 * len(compared)
    picture = page.Figure(title, figure, "; ".join(words), height)
    caption = (
        f"Ratio of {reference}'s mean error to that of the published method of least error in the cell, in brackets, "
        "which is chosen after the fact: the comparison favours it. Intervals hold for all cells together."
    )
    grid = page.FigureGrid((picture,), _VERDICTS, 1, caption, "against-the-best-published")
    return page.answer_section(robots_sentence(result), tiles, grid)


def methods_table(result: results.ComparisonResult) -> page.Table:
    """Every method on every robot: geometric mean over cells of its error as a share of the design's, or why none."""
    robots, rows = [robot.name for robot in result.robots], []
    for method in (entry.shown for entry in result.config.entries):
        cells: list[page.Cell | str] = []
        for robot in robots:
            mine = [c for c in result.judged_cells if c.key.robot == robot and method in c.methods]
            ratios = [ratio.value for c in mine if (ratio := c.against_design(method, 1)) is not None]
            mean = results.mean_ratio(ratios)
            silent = mine[0].methods[method].status if mine else NOTHING
            cells.append(silent if mean is None else page.Cell(fixed(mean, 2), plural(len(ratios), "cell")))
        rows.append(page.Row.of(method, *cells))
    caption = "Mean error of runs that did not train, Eq. (6), as a share of the design's, geometric mean over cells"
    return page.Table(caption, (page.Column("Method", numeric=False), *map(page.Column, robots)), tuple(rows))


def cells_table(result: results.ComparisonResult) -> page.Table:
    """The least error of each cell beside the design's and the reference method's."""
    beside, reference, rows = {id(each.cell): each for each in result.against_best}, result.config.reference, []
    for cell in result.judged_cells:
        answered = [each for each in cell.methods.values() if each.errors is not None]
        least = min(answered, key=lambda each: each.mean("cost") or 0.0, default=None)
        against = beside.get(id(cell))
        rows.append(
            page.Row.of(
                cell.key.robot,
                cell_words(cell),
                fixed(float(cell.design["cost"].mean()), 4),
                NOTHING if least is None else f"{fixed(least.mean('cost'), 4)} {least.method}",
                fixed(None if reference is None else cell.mean(reference), 4),
                NOTHING if against is None else f"{fixed(against.ratio.value, 2)} {against.best}",
                NOTHING if against is None else against.ratio.verdict,
            )
        )
    named = [page.Column(title, numeric=False) for title in ("Robot", "Training → judged")]
    columns = (
        *named,
        page.Column("Design"),
        page.Column("Least", numeric=False),
        page.Column(reference or "Reference"),
    )
    beside_best = (page.Column("Beside the best published", numeric=False), page.Column("Verdict", numeric=False))
    return page.Table("Mean error of runs that did not train, Eq. (6)", (*columns, *beside_best), tuple(rows))


def cell_sections(view: RobotsView) -> Iterator[page.Section]:
    """All cells of each robot: a picture of the ratios of errors to the design values', and a table a cell."""
    judged = len(view.result.judged_cells)
    for robot in view.result.robots:
        cells = view.cells(robot.name)
        tables: dict[str, tuple[page.Block, ...]] = {
            cell_words(cell): (_cell_table(view, cell, judged),) for cell in cells
        }
        blocks = (_heat_map(view, robot.name, cells), page.Choice("Cell", tables))
        yield page.Section(f"cells-{robot.name}", robot.name, blocks, about="Method by cell, against the design.")


def _heat_map(view: RobotsView, robot: str, cells: Sequence[results.Cell]) -> page.FigureGrid:
    families = {entry.shown: entry.family for entry in view.result.config.entries}
    answered = [name for name in view.methods if any(cell.mean(name) is not None for cell in cells)]
    methods = [name for name in answered if families[name] != "baseline"]
    ratios = [
        [
            None if (r := cell.against_design(name, 1)) is None or not math.isfinite(r.value) else r.value
            for name in methods
        ]
        for cell in cells
    ]
    words = [[NOTHING if value is None else fixed(value, 2) for value in row] for row in ratios]
    logs = [[None if v is None else float(np.clip(np.log2(max(v, 1e-9)), -_CUT, _CUT)) for v in row] for row in ratios]
    heat = go.Heatmap(
        z=logs, x=list(range(len(methods))), y=list(range(len(cells))), text=words, texttemplate="%{text}",
        textfont={"size": 12, "color": INK}, colorscale=_SCALE, zmin=-_CUT, zmax=_CUT, showscale=False, xgap=2, ygap=2,
        hoverinfo="skip",
    )  # fmt: skip
    figure = plot(heat)
    figure.update_xaxes(
        tickvals=list(range(len(methods))), ticktext=[text(wrapped(name, 10)) for name in methods], side="top",
        showgrid=False, ticks="", tickangle=0, tickfont={"color": INK, "size": 11},
    )  # fmt: skip
    figure.update_yaxes(
        tickvals=list(range(len(cells))), ticktext=[text(cell_words(cell)) for cell in cells], autorange="reversed",
        ticks="", showgrid=False, tickfont_color=INK,
    )  # fmt: skip
    silent = [name for name in view.methods if name not in answered and any(name in cell.methods for cell in cells)]
    described = "; ".join(f"{cell_words(cell)}: {', '.join(row)}" for cell, row in zip(cells, words, strict=True))
    title = f"{robot}: error as a share of the design values'"
    picture = page.Figure(title, figure, described, 110 + 26 * len(cells), 320 + 62 * len(methods))
    caption = f"Rows: training → judged kind. Eq. (6). {NOTHING}: no answer, or not asked."
    caption += f" Without an answer here: {', '.join(silent)}." if silent else ""
    return page.FigureGrid((picture,), (), 1, caption, f"cells-{robot}")


def _cell_table(view: RobotsView, cell: results.Cell, judged: int) -> page.Table:
    """Every method in one cell, the least error first, those without an answer last. judged: cells of the family."""
    timing, robot = view.result.config.timing, view.result.datasets[cell.key.robot].robot
    in_order = sorted(cell.methods.values(), key=lambda each: (each.errors is None, each.mean("cost") or 0.0))
    rows, unit = [], ""
    for number, each in enumerate(in_order):
        name = page.Cell(each.method, "" if each.family == "other" else each.family)
        position, heading, ratio = each.mean("position"), each.mean("heading"), cell.against_design(each.method, judged)
        if position is None or heading is None or ratio is None:
            rows.append(page.Row.of(name, NOTHING, NOTHING, NOTHING, each.status, NOTHING, each.reason, role="failed"))
            continue
        found, unit = "", f"; intervals by {ratio.units}"
        if each.matrix is not None:
            shares = 100 * (each.matrix - robot.inverse_kinematic_matrix) / robot.row_scales[:, None]
            changed = zip(("x", "y", "turn"), shares, strict=True)
            found = "; ".join(f"{row} {', '.join(f'{v:+.1f}' for v in of_row)}" for row, of_row in changed)
        verdict = "" if cell.key.fitted or ratio.equal else ratio.verdict
        partly = "" if each.answers == each.fits else f"{each.status}; else the design"
        rows.append(
            page.Row.of(
                name,
                fixed(1e3 * position, 1),
                fixed(math.degrees(heading), 2),
                page.Cell(fixed(ratio.value, 3), interval_cell(ratio.alone, 2)),
                page.Cell(verdict, partly),
                seconds(each.seconds if timing else None),
                page.Cell(each.numbers, found and f"matrix: {found} % of the row"),
                role="plain" if number else "best",
            )
        )
    runs, folds = (
        plural(len(set(each.tolist())), word)
        for each, word in ((cell.pairs.runs, "run"), (cell.pairs.folds, "calibration"))
    )
    return page.Table(
        f"{cell.key.robot}: {cell_words(cell)}",
        (
            page.Column("Method", numeric=False),
            page.Column("Position", "mm"),
            page.Column("Heading", "°"),
            page.Column("Eq. (6) / design"),
            page.Column("Verdict", numeric=False),
            page.Column("Time", priority=1),
            page.Column("What it found", numeric=False, priority=2),
        ),
        tuple(rows),
        f"Mean final errors; {runs} of {plural(cell.pairs.sessions, 'session')} judge {folds}{unit}. Small print: 95 % "
        f"interval of this cell; the verdict is that of each method in {plural(judged, 'cell')} together.",
    )


def regime_section(view: RobotsView) -> Iterator[page.Section]:
    """Which method breaks where: its error in each regime as a multiple of its own as recorded."""
    regimes = tuple(view.result.config.regimes)
    places: dict[tuple[str, ...], dict[str, results.Cell]] = {}
    for cell in view.result.cells:
        if not cell.key.fitted:
            places.setdefault((cell.key.robot, cell.key.training, cell.key.judged), {})[cell.key.regime] = cell
    rows = []
    for method in view.methods:
        cells = []
        for regime in regimes:
            pairs = [(of[AS_RECORDED], of[regime]) for of in places.values() if {AS_RECORDED, regime} <= of.keys()]
            means = [(a, b, worse) for usual, worse in pairs if (a := usual.mean(method)) and (b := worse.mean(method))]
            mean = results.mean_ratio([b / a for a, b, _ in means])
            broken = sum(b > _BROKEN * a for a, b, _ in means)
            beyond = sum(b > float(cell.design["cost"].mean()) * (1 + 1e-9) for _, b, cell in means)
            note = f"{broken} of {len(means)} break; {beyond} worse"
            cells.append(page.Cell(NOTHING) if mean is None else page.Cell(fixed(mean, 2), note))
        if any(cell.text != NOTHING for cell in cells):
            rows.append(page.Row.of(method, *cells))
    table = page.Table(
        "Error as a multiple of the method's own as recorded",
        (page.Column("Method", numeric=False), *map(page.Column, regimes)),
        tuple(rows),
        f"Eq. (6), geometric mean over cells. Break: cells with more than {_BROKEN:g} times its own error as recorded; "
        "worse: with more error than the design.",
    )
    if regimes:
        about = "Fewer runs, noise, outliers and drifting clocks in the training runs; those that judge stay."
        yield page.Section("regimes", "Which method breaks where", (table,), about=about, folded=True)


def curve_section(view: RobotsView) -> Iterator[page.Section]:
    """Learning curves; nothing where no training is on one."""
    curves: dict[str, dict[int, results.Cell]] = {}
    for cell in view.result.judged_cells:
        if match := _CURVE.match(cell.key.training):
            name = f"{cell.key.robot}: {match['kind']} → {cell.key.judged}"
            curves.setdefault(name, {})[int(match["count"])] = cell
    figures, shown = [], dict[str, page.LegendItem]()
    for name, points in curves.items():
        counts, traces, seen = sorted(points), list[go.Scatter](), list[float]()
        for method, style in view.styles.items():
            pairs = [(count, mean) for count in counts if (mean := points[count].mean(method)) is not None]
            if len(counts) < 2 or not pairs:
                continue
            x, y = [float(number) for number, _ in pairs], [mean for _, mean in pairs]
            words = [f"{method}: {plural(number, 'run')} a command, {fixed(mean, 4)}" for number, mean in pairs]
            traces += [line(style, 2.0, x, y), marks(style, 7, x, y, hover="%{text}", words=words)]
            seen, shown = seen + y, shown | {method: style}
        if seen:
            figure = plot(*traces, x_title="runs of a command", y_title="Eq. (6)")
            logarithmic(figure, "y", 0.9 * min(seen), 1.1 * max(seen))
            figure.update_xaxes(tickvals=counts)
            figures.append(
                page.Figure(name, figure, f"{name}: error against {listing(list(map(str, counts)))} runs", 340)
            )
    if figures:
        caption = "Runs of each command that train, against the mean final error, Eq. (6), of runs that never train."
        grid = page.FigureGrid(tuple(figures), tuple(shown.values()), 2, caption, "curves")
        yield page.Section("curves", "Learning curves", (grid,), about="How many runs a method needs.", folded=True)


def rank_section(view: RobotsView) -> page.Section:
    """Mean ranks with the critical difference, and performance profiles: over all cells, and robot by robot."""
    judged = view.result.judged_cells
    asked = tuple(cell for cell in judged if all(name in cell.methods for name in view.methods))
    parts = {"all robots": judged} if len(view.result.robots) > 1 else {}
    parts |= {"cells in which every method was asked": asked} if 0 < len(asked) < len(judged) else {}
    parts |= {r.name: tuple(c for c in judged if c.key.robot == r.name) for r in view.result.robots}
    choices = {
        name: drawn for name, cells in parts.items() if (drawn := (*_ranks(view, cells), *_profiles(view, cells)))
    }
    blocks: tuple[page.Block, ...] = (page.Choice("Robots", choices),)
    if not choices:
        blocks = (page.Paragraph("There is no cell that a method has answered.", "note"),)
    about = "Which method is best over many cells, and how often each is near the best."
    return page.Section("ranks", "Ranks and profiles", blocks, about=about, folded=True)


def _ranks(view: RobotsView, cells: Sequence[results.Cell]) -> Iterator[page.Block]:
    """The critical-difference diagram of the methods that answered in every cell."""
    ranked = ranking(cells, view.methods)
    if ranked is None:
        words = "Fewer than three methods answered in all of these cells, or there is one cell: no ranks."
        yield page.Paragraph(words, "note")
        return
    rows, traces = len(ranked.methods), list[go.Scatter]()
    named = list(zip(ranked.methods, map(float, ranked.ranks), strict=True))
    for row, (method, rank) in enumerate(named):
        hover = f"{method}: mean rank {fixed(rank, 2)}"
        traces.append(marks(view.styles[method], 11, [rank], [float(row)], hover="%{text}", words=[hover]))
    for number, (first, last) in enumerate(ranked.groups):
        place = rows - 0.3 + 0.45 * number
        ends = [float(ranked.ranks[first]) - 0.03, float(ranked.ranks[last]) + 0.03]
        traces.append(line(_BAR, 5.0, ends, [place, place]))
    figure = plot(*traces, x_title="mean rank (1: the least error)")
    figure.update_yaxes(
        range=[rows - 0.1 + 0.45 * len(ranked.groups), -0.6], tickvals=list(range(rows)), ticks="", showgrid=False,
        ticktext=[text(each) for each in ranked.methods], tickfont_color=INK,
    )  # fmt: skip
    figure.update_xaxes(range=[0.8, rows + 0.2])
    words = ", ".join(f"{method} {fixed(rank, 2)}" for method, rank in named)
    caption = (
        f"Methods that answered in all {plural(ranked.cells, 'cell')}. Bars join methods whose mean ranks differ by "
        f"less than the critical difference, {fixed(ranked.critical_difference, 2)} (Nemenyi, 95 %); Friedman's "
        f"p = {significant(ranked.p_value, 2)}. Cells of one robot share runs: the true critical difference is larger."
    )
    picture = page.Figure("Mean ranks of methods", figure, words, 90 + 24 * (rows + len(ranked.groups)))
    yield page.FigureGrid((picture,), (_BAR,) if ranked.groups else (), 1, caption, "ranks")


def _profiles(view: RobotsView, cells: Sequence[results.Cell]) -> Iterator[page.Block]:
    """Performance profiles of all methods with an answer."""
    drawn, traces = profiles(cells, view.methods), list[go.Scatter]()
    for each in drawn:
        shares = [each.share(factor) for factor in _FACTORS]
        hover = f"{text(each.method)}: %{{y:.0%}} within %{{x:.2f}} x"
        traces.append(line(view.styles[each.method], 2.0, _FACTORS, shares, hover=hover, line_shape="hv"))
    if drawn:
        figure = plot(*traces, x_title="error as a multiple of the best in the cell", y_title="share of the cells")
        logarithmic(figure, "x", 1.0, 8.0)
        figure.update_yaxes(range=[-0.02, 1.02])
        words = "; ".join(f"{each.method}: best in {100 * each.share(1.0):.0f} %" for each in drawn)
        caption = "The higher, the more often a method is near the best one of a cell; at 1: how often it is the best."
        items = tuple(view.styles[each.method] for each in drawn)
        yield page.FigureGrid((page.Figure("Performance profiles", figure, words, 380),), items, 1, caption, "profiles")


def method_section(view: RobotsView) -> page.Section:
    """Outcomes, time and first numbers of every method, robot by robot."""
    rows, result = [], view.result
    for robot in result.robots:
        rows.append(page.Row.of(robot.name, role="group"))
        for method in view.methods:
            fits = [each for each in result.runs if each.fit.robot is robot and each.fit.label == method]
            if not fits:
                continue
            outcomes = Counter(str(each.result.outcome) for each in fits)
            answered = [each for each in fits if each.errors is not None]
            spent = sorted(each.result.seconds for each in answered)
            row = page.Row.of(
                method,
                count(len(fits)),
                ", ".join(f"{number} {outcome}" for outcome, number in outcomes.items()),
                seconds(spent[len(spent) // 2] if spent and result.config.timing else None),
                (answered or fits)[0].result.reason,
                role="plain" if answered else "muted",
            )
            rows.append(row)
    columns = (
        page.Column("Method", numeric=False),
        page.Column("Fits"),
        page.Column("Outcomes", numeric=False),
        page.Column("Median time"),
        page.Column("Says of its first answer, or why it has none", numeric=False),
    )
    about = "How each method ended on each robot, what it took and what it found."
    table = page.Table("Outcomes and time", columns, tuple(rows))
    return page.Section("methods", "Methods, time and parameters", (table,), about=about, folded=True)


def robots_table(result: results.ComparisonResult) -> page.Table:
    """The robots with their runs, sessions and trainings, and those whose recordings cannot be read."""
    rows = []
    for robot in result.robots:
        dataset, sessions = robot.dataset, {run.session for run in robot.dataset.trajectories} - {None}
        rows.append(
            page.Row.of(
                page.Cell(robot.name, "simulated" if dataset.simulated else "recorded"),
                count(len(dataset.trajectories)),
                count(len(sessions)) if sessions else "not known",
                listing([training.name for training in robot.trainings], 20),
                page.Cell(dataset.source, dataset.licence),
            )
        )
    for name, reason in result.broken.items():
        rows.append(page.Row.of(name, "", "", page.Cell("cannot be read", reason), "", role="failed"))
    named = (page.Column("Trainings", numeric=False), page.Column("Source", numeric=False))
    columns = (page.Column("Robot", numeric=False), page.Column("Runs"), page.Column("Sessions"), *named)
    return page.Table("Robots", columns, tuple(rows))
