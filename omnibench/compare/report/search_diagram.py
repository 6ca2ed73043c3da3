"""How a search runs, as a diagram after Fig. 4 of the paper."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import plotly.graph_objects as go

from omnibench.compare.report.view import DatasetView
from omnibench.compare.report.wording import cost_in_words
from omnibench.fit.calibrators.genetic import GeneticOptions
from omnibench.report.blocks import Figure, FigureGrid
from omnibench.report.numbers import count, percent
from omnibench.report.style import AXIS, INK, plot
from omnibench.words import plural

# Middles of the boxes in units of the picture: two columns, which a phone and half a sheet of paper can hold.
_START, _CANDIDATES, _ODOMETRY, _COST = (1.0, 3.0), (1.0, 2.0), (1.0, 1.0), (1.0, 0.0)
_STOP, _SELECTION, _NEXT = (0.0, 0.0), (0.0, 1.0), (0.0, 2.0)
_WIDTH = 156  # px of a box
_TO_SIDE, _TO_TOP = 87, 38  # px from a box's middle to its edges


def search_diagram(view: DatasetView) -> FigureGrid:
    """From the design values over candidates and their costs to the answer: Fig. 4 of the paper, or any search."""
    config, runs = view.config, len(view.dataset.split("train"))
    euler = "Euler steps, Eq. (1)" if config.integration == "euler" else "exact arcs"
    is_paper = config.cost.name == "final_pose"
    stop = f"{count(config.budget.evaluations)} evaluations"
    genetic = next((run.record for _, entry, run in view.published_entries if entry.calibrator == "genetic"), None)
    if genetic is None:
        own = {
            _START: "<b>Start</b><br>the design values",
            _CANDIDATES: "<b>Candidates</b><br>elements or geometry,<br>within their bounds",
            _STOP: f"<b>Stop?</b><br>by its own rule, or<br>after {stop}",
            _NEXT: "<b>Next candidates</b><br>by the search's own rule",
        }
    else:
        options = GeneticOptions.model_validate(genetic.options)
        population = options.size(3 * len(view.dataset.robot.drive.names) - len(genetic.held))
        bounds = "±10 % of V" if genetic.box == "paper" else f"box {genetic.box}"
        own = {
            _START: f"<b>Initial population</b><br>V, the design values,<br>and {population - 1} random ones",
            _CANDIDATES: f"<b>Population of {population}</b><br>V<sub>LB</sub>, V<sub>UB</sub>: {bounds}",
            _STOP: f"<b>Stop?</b> best changes<br>≤ {options.tolerance:g} on average of<br>"
            f"{options.stall_generations} generations, or<br>{stop}",
            _SELECTION: f"<b>Selection</b><br>elite {percent(options.elite, 0)} unchanged,<br>parents by rank",
            _NEXT: f"<b>Crossover</b> of {percent(options.crossover, 0)}<br><b>Mutation</b> of the others<br>"
            f"({options.mutation.replace('_', ' ')})",
        }
    boxes = own | {
        _ODOMETRY: f"<b>Odometry</b><br>{plural(runs, 'training run')},<br>{euler}",
        _COST: f"<b>Cost</b><br>{config.objective}" + (",<br>Eq. (6)" if is_paper else ""),
    }
    loop = (_CANDIDATES, _ODOMETRY, _COST, _STOP, _SELECTION, _NEXT, _CANDIDATES)
    arrows = [_arrow(tail, tip) for tail, tip in pairwise([_START, *(place for place in loop if place in boxes)])]
    figure = plot(go.Scatter(x=[-0.5, 1.5], y=[-0.5, 3.5], mode="markers", marker_opacity=0, hoverinfo="skip"))
    notes = [*(_box(place, words) for place, words in boxes.items()), *arrows]
    hidden = {"visible": False}
    figure.update_layout(annotations=notes, xaxis=hidden, yaxis=hidden, margin_l=10, margin_b=10)
    words = "Start, candidates, odometry, cost; then stop, or the next candidates"
    title, paper = "How a search runs", ""
    if genetic is not None:
        title, paper = "How the genetic search runs", f"Fig. 4 of the paper, with the settings of {genetic.label}. "
    return FigureGrid((Figure(title, figure, words, 500),), (), 1, f"{paper}The cost is {cost_in_words(view)}")


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
