"""Every cell of a study: a picture of all ratios to the design values, a table for each, and figures by regime."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.report.view import interval_in_words
from omnibench.report.blocks import Block, Cell, Choice, Column, Figure, FigureGrid, LegendItem, Row, Section, Table
from omnibench.report.figures import line, marks
from omnibench.report.numbers import NOTHING, fixed, seconds
from omnibench.report.style import INK, THEORETICAL, colours, logarithmic, plot, text, wrapped
from omnibench.robot.kinematics import Robot
from omnibench.study.cells import MethodInCell, StudyCell
from omnibench.study.study_result import StudyResult, mean_ratio
from omnibench.study.trainings import AS_RECORDED
from omnibench.words import plural

_FAMILIES = {"ours": "omnibench", "published": "published", "baseline": "baseline", "other": ""}


@dataclass(frozen=True, eq=False)
class StudyView:
    """styles: of each method, the same in the whole report. methods: their names, in the config's order."""

    result: StudyResult
    methods: tuple[str, ...]
    styles: Mapping[str, LegendItem]

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots that were read."""
        return tuple(robot.name for robot in self.result.robots)

    def design(self, name: str) -> Robot:
        """The robot called ``name`` as it was drawn."""
        return next(robot.dataset.robot for robot in self.result.robots if robot.name == name)

    def judged(self, robot: str | None = None) -> tuple[StudyCell, ...]:
        """The cells that verdicts rest on, of one robot or of all."""
        return tuple(cell for cell in self.result.judged_cells if robot in (None, cell.key.robot))

    def plain(self, robot: str) -> tuple[StudyCell, ...]:
        """The cells of a robot as recorded: judged ones, then training errors."""
        keys = [(cell, cell.key) for cell in self.result.cells]
        mine = [cell for cell, key in keys if key.robot == robot and key.regime == AS_RECORDED]
        return tuple(sorted(mine, key=lambda cell: cell.key.fitted))

    def family(self, method: str) -> str:
        """A method's family in a word."""
        families = {choice.shown: choice.family for choice in self.result.config.methods}
        return _FAMILIES[families[method]]


def study_view(result: StudyResult) -> StudyView:
    """The view of a result."""
    wanted = {choice.shown: THEORETICAL if choice.name == "theoretical" else None for choice in result.config.methods}
    drawn = colours(wanted)
    styles = {name: LegendItem(f"method-{i}", name, *drawn[name]) for i, name in enumerate(wanted)}
    return StudyView(result, tuple(wanted), styles)


def cell_words(cell: StudyCell) -> str:
    """A cell within its robot: ``circular → square``."""
    return f"{cell.key.training} → {cell.key.judged}"


_COLUMNS = (
    Column("Method", numeric=False),
    Column("Position", "mm"),
    Column("Heading", "°"),
    Column("Eq. (6) / design"),
    Column("Verdict", numeric=False),
    Column("Time", priority=1),
    Column("What it found", numeric=False, priority=2),
)
# Blue where the design values' error falls, white where it stays, red where it grows: log2 of the ratio, cut at an
# eighth and eight times (chosen).
_SCALE = [[0.0, "#7fb2dc"], [0.5, "#ffffff"], [1.0, "#f0919d"]]
_CUT = 3.0
_LEAST_SHARE = 0.05  # %: smaller changes of an element are rounded away
_LABELS, _COLUMN = 320, 62  # px that the names of cells and each method need


def robot_cells(view: StudyView, robot: str) -> Section:
    """All cells of one robot."""
    cells = view.plain(robot)
    judged = len(view.result.judged_cells)
    tables: dict[str, tuple[Block, ...]] = {_column(cell): (cell_table(cell, view, judged),) for cell in cells}
    return Section(
        f"cells-{robot}",
        robot,
        (heat_map(view, robot), Choice("Cell", tables)),
        about="Method by cell, against the design.",
    )


def heat_map(view: StudyView, robot: str) -> FigureGrid:
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
    return FigureGrid((Figure(title, figure, described, height, width),), (), 1, caption, f"cells-{robot}")


def cell_table(cell: StudyCell, view: StudyView, judged: int) -> Table:
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
    return Table(
        f"{cell.key.robot}: {cell_words(cell)}",
        _COLUMNS,
        tuple(_row(each, cell, view, judged, each.method == best) for each in rows),
        f"Mean final errors; {size}{unit}. Small print under the ratio: 95 % interval of this cell; the verdict "
        f"is that of each method in {plural(judged, 'cell')} together. Under what was found: "
        "changes of the first answer's matrix, column by column, in % of each row's largest element."
        + (" Training errors, on which no verdict rests." if cell.key.fitted else ""),
    )


def _row(each: MethodInCell, cell: StudyCell, view: StudyView, judged: int, best: bool) -> Row:
    name = Cell(each.method, view.family(each.method))
    position, heading = each.mean("position"), each.mean("heading")
    if position is None or heading is None:
        return Row.of(name, NOTHING, NOTHING, NOTHING, each.status, NOTHING, each.reason, role="failed")
    ratio = cell.against_design(each.method, judged)
    assert ratio is not None  # it has an answer
    partly = "" if each.answers == each.fits else f"{each.status}; else the design"
    return Row.of(
        name,
        fixed(1e3 * position, 1),
        fixed(math.degrees(heading), 2),
        Cell(fixed(ratio.value, 3), interval_in_words(ratio.alone, 2)),
        Cell("" if cell.key.fitted or ratio.equal else ratio.verdict, partly),
        seconds(each.seconds if view.result.config.timing else None),
        Cell(each.numbers, _change(each, view.design(cell.key.robot))),
        role="best" if best else "plain",
    )


def _change(each: MethodInCell, robot: Robot) -> str:
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


def _is_for_none(cells: Sequence[StudyCell], method: str) -> bool:
    """True if a method was asked in some cells and applicable in none."""
    asked = [cell.methods[method] for cell in cells if method in cell.methods]
    return bool(asked) and all(each.status == "not applicable" for each in asked)


def _ratio(cell: StudyCell, method: str) -> float | None:
    mean = cell.methods[method].mean("cost") if method in cell.methods else None
    design = float(cell.design["cost"].mean())
    return None if mean is None or design == 0 else mean / design


def _log(ratio: float | None) -> float | None:
    return None if ratio is None else float(np.clip(np.log2(max(ratio, 1e-9)), -_CUT, _CUT))


def _column(cell: StudyCell) -> str:
    return f"{cell_words(cell)}{' (training errors)' if cell.key.fitted else ''}"


_CURVE = re.compile(r"^(?P<kind>.+), (?P<count>\d+) runs? a command$")
_BROKEN = 1.5  # times the method's own error as recorded, from which on it counts as broken; chosen


def regime_section(view: StudyView) -> tuple[Section, ...]:
    """Which method breaks where; nothing without regimes."""
    regimes = tuple(view.result.config.regimes)
    if not regimes:
        return ()
    tables: dict[str, tuple[Block, ...]] = {}
    for robot in view.robots:
        cells = _by_regime(view, robot)
        for place, of_place in cells.items():
            if len(of_place) > 1:
                tables[f"{robot}: {place}"] = (_regime_table(view, f"{robot}: {place}", of_place, regimes),)
    blocks: tuple[Block, ...] = (_breaking_table(view, regimes), Choice("Cell", tables))
    about = "Fewer runs, noise, outliers and drifting clocks in the training runs; those that judge stay as recorded."
    return (Section("regimes", "Which method breaks where", blocks, about=about),)


def _by_regime(view: StudyView, robot: str) -> dict[str, dict[str, StudyCell]]:
    places: dict[str, dict[str, StudyCell]] = {}
    for cell in view.result.cells:
        if cell.key.robot == robot and not cell.key.fitted:
            places.setdefault(cell_words(cell), {})[cell.key.regime] = cell
    return places


def _breaking_table(view: StudyView, regimes: Sequence[str]) -> Table:
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
            if (mean := mean_ratio(ratios)) is None:
                cells.append(Cell(NOTHING))
                continue
            broken = sum(ratio > _BROKEN for ratio in ratios)
            note = f"{broken} of {len(ratios)} break; {worse} worse"
            cells.append(Cell(fixed(mean, 2), note))
        if any(cell.text != NOTHING for cell in cells):
            rows.append(Row.of(method, *cells))
    return Table(
        "Error as a multiple of the method's own as recorded",
        (Column("Method", numeric=False), *(Column(regime) for regime in regimes)),
        tuple(rows),
        f"Eq. (6), geometric mean over cells. Break: cells with more than {_BROKEN:g} times its own error as recorded; "
        "worse: with more error than the design. "
        f"{NOTHING}: no answer.",
    )


def _regime_table(view: StudyView, title: str, of_place: Mapping[str, StudyCell], regimes: Sequence[str]) -> Table:
    rows = []
    for method in view.methods:
        if method not in of_place[AS_RECORDED].methods:
            continue
        cells = [_errors(of_place.get(regime), method) for regime in (AS_RECORDED, *regimes)]
        rows.append(Row.of(method, *cells))
    columns = (Column("Method", numeric=False), *(Column(name, "mm") for name in (AS_RECORDED, *regimes)))
    return Table(title, columns, tuple(rows), "Mean final position error; small print: heading.")


def _errors(cell: StudyCell | None, method: str) -> Cell:
    each = None if cell is None else cell.methods.get(method)
    position, heading = (None, None) if each is None else (each.mean("position"), each.mean("heading"))
    if each is None or position is None or heading is None:
        return Cell(NOTHING, "" if each is None else each.status)
    return Cell(fixed(1e3 * position, 1), f"{fixed(np.degrees(heading), 2)}°")


def _growth(of_place: Mapping[str, StudyCell], regime: str, method: str) -> float | None:
    means = [
        of_place[name].methods[method].mean("cost") if name in of_place and method in of_place[name].methods else None
        for name in (AS_RECORDED, regime)
    ]
    before, after = means
    return None if not before or not after else after / before


def _worse_than_design(of_place: Mapping[str, StudyCell], regime: str, method: str) -> bool:
    cell = of_place.get(regime)
    mean = None if cell is None or method not in cell.methods else cell.methods[method].mean("cost")
    return cell is not None and mean is not None and mean > float(cell.design["cost"].mean()) * (1 + 1e-9)


def curve_section(view: StudyView) -> tuple[Section, ...]:
    """Learning curves; nothing where no training is on one."""
    curves: dict[str, dict[int, StudyCell]] = {}
    for cell in view.judged():
        if match := _CURVE.match(cell.key.training):
            name = f"{cell.key.robot}: {match['kind']} → {cell.key.judged}"
            curves.setdefault(name, {})[int(match["count"])] = cell
    drawn = {name: points for name, points in curves.items() if len(points) > 1}
    if not drawn:
        return ()
    figures = tuple(_curve(view, name, points) for name, points in drawn.items())
    shown = [
        name
        for name in view.methods
        if any(
            name in cell.methods and cell.methods[name].errors is not None
            for points in drawn.values()
            for cell in points.values()
        )
    ]
    grid = FigureGrid(
        figures, tuple(view.styles[name] for name in shown), 2,
        "Runs of each command that train, against the mean final error, Eq. (6), of runs that never train.", "curves",
    )  # fmt: skip
    return (Section("curves", "Learning curves", (grid,), about="How many runs a method needs."),)


def _curve(view: StudyView, name: str, points: Mapping[int, StudyCell]) -> Figure:
    counts = sorted(points)
    traces: list[go.Scatter] = []
    least, most = [], []
    for method in view.methods:
        pairs = [
            (count, mean)
            for count in counts
            if method in points[count].methods and (mean := points[count].methods[method].mean("cost")) is not None
        ]
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
    return Figure(name, figure, f"{name}: error against {', '.join(map(str, counts))} runs of a command", 340)
