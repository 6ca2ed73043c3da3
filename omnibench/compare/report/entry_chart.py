"""The chart of all entries: the cost of each as a dot with its 95 % interval, beside that of the design values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.report.view import SPLIT_NAMES, THEORETICAL_STYLE, DatasetView
from omnibench.compare.report.wording import cost_decimals, interval_basis, interval_in_words
from omnibench.compare.result import THEORETICAL_NAME
from omnibench.fit.ratio_intervals import Interval
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.numbers import fixed
from omnibench.report.style import INK, PALETTE, QUIET, plot, text, wrapped
from omnibench.report.traces import joined, line, marks

_ROW, _LINE = 11, 14  # px of an entry, and of each line of its label
_BEST = LegendItem("best", "best", PALETTE[0])
_OTHER = LegendItem("other", "differs by more than chance", PALETTE[1])
_OPEN = LegendItem("open", "not told apart", QUIET)


@dataclass(frozen=True)
class _Line:
    label: str
    cost: Interval
    item: LegendItem


def entry_chart(view: DatasetView) -> FigureGrid | None:
    """Every entry's cost on the scored split, the lowest on top; None where no entry was calibrated."""
    lines = _lines(view)
    if not lines:
        return None
    design = view.design_costs.get(view.scored)
    if design is not None:
        lines.append(_Line("design values", design, THEORETICAL_STYLE))
    decimals = cost_decimals(view)
    items = [item for item in (_BEST, _OTHER, _OPEN, THEORETICAL_STYLE) if any(each.item is item for each in lines)]
    traces = [trace for item in items for trace in _traces(item, lines, decimals)]
    split = SPLIT_NAMES[view.scored]
    figure = plot(*traces, x_title=f"cost of the {split} runs")
    reach = max(max(each.cost.known or (each.cost.value,)) for each in lines)
    figure.update_xaxes(range=[0.0, 1.04 * reach])
    names = [text(wrapped(each.label)) for each in lines]
    height = 70 + (_ROW + _LINE * max(1 + name.count("<br>") for name in names)) * len(lines)
    ends = {"range": [len(lines) - 0.4, -0.6], "tickvals": list(range(len(lines))), "ticktext": names}
    figure.update_yaxes(**ends, ticks="", tickfont_color=INK, showgrid=False)
    words = ", ".join(f"{each.label} {fixed(each.cost.value, decimals)}" for each in lines)
    title = f"All entries: cost of the {split} runs, with 95 % intervals"
    caption = (
        f"The lower, the better. Lines: 95 % intervals, {interval_basis(view, view.scored)}; whether entries differ is "
        "judged from paired differences, which is finer. An entry stands with its run of median training cost."
        + _without(view)
    )
    return FigureGrid((Figure(title, figure, f"{title}: {words}", height),), tuple(items), 1, caption, "all-entries")


def _lines(view: DatasetView) -> list[_Line]:
    lines = []
    for entry, _ in view.calibrated:
        cost = entry.cost(view.scored)
        if cost is not None:
            best = entry.is_best and not view.undecided
            item = _BEST if best else _OTHER if entry.practically_equal is False else _OPEN
            lines.append(_Line(entry.label, cost, item))
    return sorted(lines, key=lambda each: each.cost.value)


def _traces(item: LegendItem, lines: Sequence[_Line], decimals: int) -> list[go.Scatter]:
    rows = [(row, each) for row, each in enumerate(lines) if each.item is item]
    spans = [np.column_stack([each.cost.known, [row, row]]) for row, each in rows if each.cost.known is not None]
    words = [
        f"{each.label}: {fixed(each.cost.value, decimals)} ({interval_in_words(each.cost, decimals)})"
        for _, each in rows
    ]
    values, places = [each.cost.value for _, each in rows], [float(row) for row, _ in rows]
    dots = marks(item, 10, values, places, hover="%{text}", words=words)
    return [*([line(item, 2.5, *joined(spans).T, line_dash="solid")] if spans else []), dots]


def _without(view: DatasetView) -> str:
    silent = [entry.label for entry in view.statistics if not entry.answers and entry.calibrator != THEORETICAL_NAME]
    return f" Without an answer: {', '.join(silent)}." if silent else ""
