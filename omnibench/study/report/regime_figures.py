"""Regimes and learning curves: how a method's error grows when its training runs are worse, or fewer."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go

from omnibench.report.blocks import Block, Cell, Choice, Column, Figure, FigureGrid, Row, Section, Table
from omnibench.report.numbers import NOTHING, fixed
from omnibench.report.style import logarithmic, plot
from omnibench.report.traces import line, marks
from omnibench.study.cells import StudyCell
from omnibench.study.report.cell_tables import StudyView, cell_words
from omnibench.study.study_result import mean_ratio
from omnibench.study.trainings import AS_RECORDED
from omnibench.words import plural

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
        if any(_answers(cell, name) for points in drawn.values() for cell in points.values())
    ]
    grid = FigureGrid(
        figures, tuple(view.styles[name] for name in shown), 2,
        "Runs of each command that train, against the mean final error, Eq. (6), of runs that never train.", "curves",
    )  # fmt: skip
    return (Section("curves", "Learning curves", (grid,), about="How many runs a method needs."),)


def _answers(cell: StudyCell, method: str) -> bool:
    return method in cell.methods and cell.methods[method].errors is not None


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
