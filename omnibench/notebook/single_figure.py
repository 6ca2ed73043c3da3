"""Figures of reports as single Plotly figures with a title and a legend."""

from __future__ import annotations

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from omnibench.report.blocks import FigureGrid
from omnibench.report.style import text

_MARGIN = 60  # px above and below


def drawn(grid: FigureGrid) -> go.Figure:
    """The plots of a grid side by side in one figure, with its legend."""
    if len(grid.figures) == 1:
        return _single(grid)
    titles = [text(figure.title) for figure in grid.figures]
    columns = min(grid.columns, len(grid.figures))
    rows = -(-len(grid.figures) // columns)
    whole = make_subplots(rows=rows, cols=columns, subplot_titles=titles)
    for number, figure in enumerate(grid.figures):
        row, column = number // columns + 1, number % columns + 1
        for trace in figure.plot.data:
            whole.add_trace(trace, row=row, col=column)
        axis = "" if number == 0 else str(number + 1)
        for letter in "xy":
            given = figure.plot.layout[f"{letter}axis"].to_plotly_json()
            if given.get("scaleanchor"):
                given["scaleanchor"] = f"x{axis}"
            kept = {key: value for key, value in given.items() if key not in ("anchor", "domain")}
            whole.layout[f"{letter}axis{axis}"].update(kept)
    whole.update_layout(template=grid.figures[0].plot.layout.template)
    return _with_legend(whole, grid, rows * max(figure.height for figure in grid.figures))


def _single(grid: FigureGrid) -> go.Figure:
    (figure,) = grid.figures
    whole = go.Figure(figure.plot)
    whole.update_layout(title_text=text(figure.title), title_x=0.02)
    return _with_legend(whole, grid, figure.height)


def _with_legend(figure: go.Figure, grid: FigureGrid, height: int) -> go.Figure:
    """The figure with a line of the legend for each item, at its first trace."""
    labels = {item.key: item.label for item in grid.legend if item.key}
    for trace in figure.data:
        label = labels.pop(trace.legendgroup, None) if trace.legendgroup else None
        trace.showlegend = label is not None
        if label is not None:
            trace.name = text(label)
    figure.update_layout(
        showlegend=bool(grid.legend),
        legend={"orientation": "h", "y": -0.2},
        margin={"t": _MARGIN, "b": _MARGIN},
        height=height + 2 * _MARGIN,
    )
    return figure
