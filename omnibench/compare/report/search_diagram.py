"""How a search runs, as a diagram after Fig. 4 of the paper."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import plotly.graph_objects as go

from omnibench.compare.report.view import DatasetView
from omnibench.compare.report.wording import cost_in_words
from omnibench.report.blocks import Figure, FigureGrid
from omnibench.report.numbers import count
from omnibench.report.style import AXIS, INK, plot
from omnibench.words import plural

# Middles of the boxes in units of the picture: two columns, which a phone and half a sheet of paper can hold.
_START, _CANDIDATES, _ODOMETRY, _COST = (1.0, 3.0), (1.0, 2.0), (1.0, 1.0), (1.0, 0.0)
_STOP, _NEXT = (0.0, 0.0), (0.0, 2.0)
_WIDTH = 148  # px of a box
_TO_SIDE, _TO_TOP = 83, 32  # px from a box's middle to its edges


def search_diagram(view: DatasetView) -> FigureGrid:
    """From the design values over candidates and their costs to the answer, as every search here runs."""
    config, runs = view.config, len(view.dataset.split("train"))
    euler = "Euler steps, Eq. (1)" if config.integration == "euler" else "exact arcs"
    is_paper = config.cost.name == "final_pose"
    stop = f"<b>Stop?</b><br>by its own rule, or<br>after {count(config.budget.evaluations)} evaluations"
    boxes = [
        _box(_START, "<b>Start</b><br>the design values"),
        _box(_CANDIDATES, "<b>Candidates</b><br>elements or geometry,<br>within their bounds"),
        _box(_ODOMETRY, f"<b>Odometry</b><br>{plural(runs, 'training run')},<br>{euler}"),
        _box(_COST, f"<b>Cost</b><br>{config.objective}" + (",<br>Eq. (6)" if is_paper else "")),
        _box(_STOP, stop),
        _box(_NEXT, "<b>Next candidates</b><br>by the search's own rule"),
    ]
    way = (_START, _CANDIDATES, _ODOMETRY, _COST, _STOP, _NEXT, _CANDIDATES)
    arrows = [_arrow(tail, tip) for tail, tip in pairwise(way)]
    figure = plot(go.Scatter(x=[-0.5, 1.5], y=[-0.5, 3.5], mode="markers", marker_opacity=0, hoverinfo="skip"))
    hidden = {"visible": False}
    figure.update_layout(annotations=[*boxes, *arrows], xaxis=hidden, yaxis=hidden, margin_l=10, margin_b=10)
    words = "Start, candidates, odometry, cost; then stop, or the next candidates"
    paper = "As Fig. 4 of the paper, for every search here. " if view.of_the_paper else ""
    caption = f"{paper}The cost is {cost_in_words(view)}"
    return FigureGrid((Figure("How a search runs", figure, words, 420),), (), 1, caption)


def _box(middle: tuple[float, float], words: str) -> dict[str, Any]:
    looks = {"bordercolor": AXIS, "borderwidth": 1, "borderpad": 6, "bgcolor": "white", "font": {"size": 12}}
    return {"x": middle[0], "y": middle[1], "text": words, "showarrow": False, "width": _WIDTH, **looks}


def _arrow(tail: tuple[float, float], tip: tuple[float, float]) -> dict[str, Any]:
    """An arrow from the edge of one box to the edge of another."""
    gap = _TO_SIDE if tail[1] == tip[1] else _TO_TOP
    gaps = {"standoff": gap, "startstandoff": gap}
    ends = {"x": tip[0], "y": tip[1], "ax": tail[0], "ay": tail[1]}
    frames = {"xref": "x", "yref": "y", "axref": "x", "ayref": "y"}
    return {
        **ends,
        **gaps,
        **frames,
        "text": "",
        "showarrow": True,
        "arrowhead": 2,
        "arrowwidth": 1.4,
        "arrowcolor": INK,
    }
