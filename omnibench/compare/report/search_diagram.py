"""How a search runs, as a diagram after Fig. 4 of the paper."""

from __future__ import annotations

from typing import Any

import plotly.graph_objects as go

from omnibench.compare.report.view import DatasetView
from omnibench.compare.report.wording import cost_in_words
from omnibench.report.blocks import Figure, FigureGrid
from omnibench.report.numbers import count
from omnibench.report.style import AXIS, INK, plot
from omnibench.words import plural

# Middles of the boxes, and arrows from one to the next, in units of the picture.
_ROW, _BELOW = 1.0, 0.0
_COLUMNS = (0.0, 1.0, 2.0, 3.0)
_HALF = 0.4  # of a box's width


def search_diagram(view: DatasetView) -> FigureGrid:
    """From the design values over candidates and their costs to the answer, as every search here runs."""
    config, runs = view.config, len(view.dataset.split("train"))
    euler = "Euler steps, Eq. (1)" if config.integration == "euler" else "exact arcs"
    is_paper = config.cost.name == "final_pose"
    start, candidates, odometry, cost = _COLUMNS
    boxes = [
        _box(start, _ROW, "<b>Start</b><br>the design values"),
        _box(candidates, _ROW, "<b>Candidates</b><br>elements or geometry,<br>within their bounds"),
        _box(odometry, _ROW, f"<b>Odometry</b><br>{plural(runs, 'training run')},<br>{euler}"),
        _box(cost, _ROW, f"<b>Cost</b><br>{config.objective}" + (",<br>Eq. (6)" if is_paper else "")),
        _box(odometry, _BELOW, "<b>Next candidates</b><br>by the search's own rule"),
        _box(
            cost,
            _BELOW,
            f"<b>Stop?</b><br>by its own rule, or after<br>{count(config.budget.evaluations)} evaluations",
        ),
    ]
    arrows = [
        _arrow((start + _HALF, _ROW), (candidates - _HALF, _ROW)),
        _arrow((candidates + _HALF, _ROW), (odometry - _HALF, _ROW)),
        _arrow((odometry + _HALF, _ROW), (cost - _HALF, _ROW)),
        _arrow((cost, _ROW - 0.3), (cost, _BELOW + 0.3)),
        _arrow((cost - _HALF, _BELOW), (odometry + _HALF, _BELOW)),
        _arrow((odometry - _HALF, _BELOW), (candidates, _ROW - 0.3)),
    ]
    figure = plot(go.Scatter(x=[-0.5, 3.5], y=[-0.5, 1.5], mode="markers", marker_opacity=0, hoverinfo="skip"))
    hidden = {"visible": False}
    figure.update_layout(annotations=[*boxes, *arrows], xaxis=hidden, yaxis=hidden, margin_l=10, margin_b=10)
    words = "Start, candidates, odometry, cost; then stop, or the next candidates"
    paper = "As Fig. 4 of the paper, for every search here. " if view.of_the_paper else ""
    caption = f"{paper}The cost is {cost_in_words(view)}"
    return FigureGrid((Figure("How a search runs", figure, words, 240),), (), 1, caption)


def _box(x: float, y: float, words: str) -> dict[str, Any]:
    looks = {"bordercolor": AXIS, "borderwidth": 1, "borderpad": 6, "bgcolor": "white", "font": {"size": 12}}
    return {"x": x, "y": y, "text": words, "showarrow": False, "width": 150, **looks}


def _arrow(tail: tuple[float, float], tip: tuple[float, float]) -> dict[str, Any]:
    ends = {"x": tip[0], "y": tip[1], "ax": tail[0], "ay": tail[1]}
    frames = {"xref": "x", "yref": "y", "axref": "x", "ayref": "y"}
    return {**ends, **frames, "text": "", "showarrow": True, "arrowhead": 2, "arrowwidth": 1.4, "arrowcolor": INK}
