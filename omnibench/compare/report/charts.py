"""Charts of a comparison: values with intervals in lines, shares that grow, ratios by colour, learning curves."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.report.view import styles
from omnibench.compare.result import Cell, ComparisonResult
from omnibench.compare.statistics import profiles, ranking
from omnibench.fit.intervals import Interval
from omnibench.report import blocks as page
from omnibench.report.figures import joined, line, marks
from omnibench.report.numbers import NOTHING, fixed, significant
from omnibench.report.style import INK, QUIET, logarithmic, plot, text, wrapped
from omnibench.robot.kinematics import Array
from omnibench.words import plural

# Blue where the design values' error falls, white where it stays, red where it grows: log2 of the ratio, cut at an
# eighth and eight times (chosen).
_SCALE = [[0.0, "#7fb2dc"], [0.5, "#ffffff"], [1.0, "#f0919d"]]
_CUT = 3.0
_CURVE = re.compile(r"^(?P<kind>.+), (?P<count>\d+) runs? a command$")
_FACTORS = np.geomspace(1.0, 8.0, 80)  # multiples of the best error at which profiles are drawn; chosen
_ALIKE = page.LegendItem("alike", "not told apart", QUIET)


def interval_chart(
    lines: Sequence[tuple[str, Interval, page.LegendItem, str]], title: str, x_title: str, caption: str, name: str
) -> page.FigureGrid:
    """Values as dots with their intervals, one below the other: label, value, item of the legend, words on hovering."""
    traces, items = list[go.Scatter](), list(dict.fromkeys(item for _, _, item, _ in lines))
    for item in items:
        mine = [(row, value, words) for row, (_, value, of_line, words) in enumerate(lines) if of_line is item]
        spans = [np.column_stack([value.known, [row, row]]) for row, value, _ in mine if value.known is not None]
        traces += [line(item, 2.5, *joined(spans).T, line_dash="solid")] if spans else []
        values, places = [value.value for _, value, _ in mine], [float(row) for row, _, _ in mine]
        traces.append(marks(item, 10, values, places, hover="%{text}", words=[words for *_, words in mine]))
    figure = plot(*traces, x_title=x_title)
    names = [text(wrapped(label, 40)) for label, *_ in lines]
    _name_rows(figure, names, len(lines) - 0.4)
    height = 70 + (11 + 14 * max(1 + label.count("<br>") for label in names)) * len(lines)
    picture = page.Figure(title, figure, "; ".join(words for *_, words in lines), height)
    return page.FigureGrid((picture,), tuple(items), 1, caption, name)


def _name_rows(figure: go.Figure, names: Sequence[str], end: float) -> None:
    """Name the rows of a figure, the first on top."""
    ends = {"range": [end, -0.6], "tickvals": list(range(len(names))), "ticktext": list(names)}
    figure.update_yaxes(**ends, ticks="", tickfont={"color": INK, "size": 12}, showgrid=False)


def share_chart(
    curves: Mapping[page.LegendItem, tuple[Array, Array]], title: str, axes: tuple[str, str], caption: str, name: str
) -> page.FigureGrid:
    """Shares (from 0 to 1) that grow in steps with a quantity, from its least to its greatest value."""
    traces = [
        line(item, 2.2, x, 100 * y, hover=f"{text(item.label)}<br>%{{y:.0f}} % by %{{x:.4g}}", line_shape="hv")
        for item, (x, y) in curves.items()
    ]
    figure = plot(*traces, x_title=axes[0], y_title=axes[1])
    along = np.concatenate([x for x, _ in curves.values()])
    logarithmic(figure, "x", float(along.min()), float(along.max()))
    figure.update_yaxes(range=[-1, 104])
    described = "; ".join(f"{item.label}: {100 * y[-1]:.0f} % in the end" for item, (_, y) in curves.items())
    return page.FigureGrid((page.Figure(title, figure, described, 360),), tuple(curves), 1, caption, name)


def heat_map(result: ComparisonResult, robot: str, cells: Sequence[Cell]) -> page.FigureGrid:
    """Every method in every cell of a robot: its error as a share of the design values'."""
    entries = {entry.shown: entry.family for entry in result.config.entries}
    answered = [name for name in entries if any(cell.mean(name) is not None for cell in cells)]
    methods = [name for name in answered if entries[name] != "baseline"]
    ratios = np.array([[cell.share(name) for name in methods] for cell in cells], dtype=float)
    words = [[fixed(value, 2) for value in row] for row in ratios]
    heat = go.Heatmap(
        z=np.clip(np.log2(np.maximum(ratios, 1e-9)), -_CUT, _CUT), text=words, texttemplate="%{text}",
        textfont={"size": 12, "color": INK}, colorscale=_SCALE, zmin=-_CUT, zmax=_CUT, showscale=False, xgap=2, ygap=2,
        hoverinfo="skip",
    )  # fmt: skip
    figure = plot(heat)
    _name_rows(figure, [text(cell.key.within_robot) for cell in cells], len(cells) - 0.4)
    names = [text(wrapped(name, 10)) for name in methods]
    looks = {"tickangle": 0, "tickfont": {"color": INK, "size": 11}}
    figure.update_xaxes(tickvals=list(range(len(methods))), ticktext=names, side="top", showgrid=False, **looks)
    described = "; ".join(f"{cell.key.within_robot}: {', '.join(row)}" for cell, row in zip(cells, words, strict=True))
    title = f"{robot}: error as a share of the design values'"
    silent = [name for name in entries if name not in answered and any(name in cell.methods for cell in cells)]
    picture = page.Figure(title, figure, described, 110 + 26 * len(cells), 320 + 62 * len(methods))
    caption = f"Rows: training → judged kind. Eq. (6). {NOTHING}: no answer, or not asked."
    caption += f" Without an answer here: {', '.join(silent)}." if silent else ""
    return page.FigureGrid((picture,), (), 1, caption, f"cells-{robot}")


def learning_curves(result: ComparisonResult) -> page.FigureGrid | None:
    """Errors against the number of runs that train; None where no training is on a curve."""
    curves: dict[str, dict[int, Cell]] = {}
    for cell in result.judged_cells:
        if match := _CURVE.match(cell.key.training):
            curves.setdefault(f"{cell.key.robot}: {match['kind']} → {cell.key.judged}", {})[int(match["count"])] = cell
    figures, shown = [], dict[page.LegendItem, None]()
    for name, points in curves.items():
        traces, seen = list[go.Scatter](), list[float]()
        for method, style in styles(result).items():
            known = {runs: mean for runs in sorted(points) if (mean := points[runs].mean(method)) is not None}
            if known and len(points) > 1:
                words = [f"{method}: {plural(runs, 'run')} a command, {fixed(mean, 4)}" for runs, mean in known.items()]
                x, y = list(map(float, known)), list(known.values())
                traces += [line(style, 2.0, x, y), marks(style, 7, x, y, hover="%{text}", words=words)]
                seen, shown = seen + y, shown | {style: None}
        if seen:
            figure = plot(*traces, x_title="runs of a command", y_title="Eq. (6)")
            logarithmic(figure, "y", 0.9 * min(seen), 1.1 * max(seen))
            figure.update_xaxes(tickvals=sorted(points))
            figures.append(page.Figure(name, figure, f"{name}: error against the number of runs that train", 340))
    caption = "Runs of each command that train, against the mean final error, Eq. (6), of runs that never train."
    return page.FigureGrid(tuple(figures), tuple(shown), 2, caption, "curves") if figures else None


def rank_blocks(result: ComparisonResult, cells: Sequence[Cell]) -> Iterator[page.Block]:
    """The critical-difference diagram of the methods that answered in all of some cells, and performance profiles."""
    drawn = styles(result)
    ranked = ranking(cells, tuple(drawn))
    if ranked is None:
        few = "Fewer than three methods answered in all of these cells, or there is one cell: no ranks."
        yield page.Paragraph(few, "note")
    else:
        rows, means = len(ranked.methods), [float(rank) for rank in ranked.ranks]
        words = [f"{method}: mean rank {fixed(rank, 2)}" for method, rank in zip(ranked.methods, means, strict=True)]
        traces = [
            marks(drawn[method], 11, [means[row]], [float(row)], hover="%{text}", words=words[row : row + 1])
            for row, method in enumerate(ranked.methods)
        ]
        for number, (first, last) in enumerate(ranked.groups):
            height = rows - 0.3 + 0.45 * number
            traces.append(line(_ALIKE, 5.0, [means[first] - 0.03, means[last] + 0.03], [height, height]))
        figure = plot(*traces, x_title="mean rank (1: the least error)")
        _name_rows(figure, list(map(text, ranked.methods)), rows - 0.1 + 0.45 * len(ranked.groups))
        figure.update_xaxes(range=[0.8, rows + 0.2])
        caption = (
            f"Methods that answered in all {plural(ranked.cells, 'cell')}. Bars join methods whose mean ranks differ "
            f"by less than the critical difference, {fixed(ranked.critical_difference, 2)} (Nemenyi, 95 %); Friedman's "
            f"p = {significant(ranked.p_value, 2)}. Cells of one robot share runs: the true difference is larger."
        )
        height = 90 + 24 * (rows + len(ranked.groups))
        picture = page.Figure("Mean ranks of methods", figure, "; ".join(words), height)
        yield page.FigureGrid((picture,), (_ALIKE,) if ranked.groups else (), 1, caption, "ranks")
    shares = {drawn[name]: (_FACTORS, share) for name, share in profiles(cells, tuple(drawn), _FACTORS).items()}
    if shares:
        caption = "The higher, the more often a method is near the best one of a cell; at 1: how often it is the best."
        axes = ("error as a multiple of the best in the cell", "share of the cells (%)")
        yield share_chart(shares, "Performance profiles", axes, caption, "profiles")
