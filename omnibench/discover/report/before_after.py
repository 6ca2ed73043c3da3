"""Figures that compare the plain with the extended model: their styles, the noise band, panels on a common scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from omnibench.report.blocks import LegendItem
from omnibench.report.style import QUIET, plot, text
from omnibench.report.traces import area, joined, marks
from omnibench.robot.kinematics import Array

BEFORE, AFTER, FLOOR = "#d97706", "#0072b2", "#8a8f98"
BAND = "rgba(102,114,127,0.20)"
_NOISE = "#c3c9d0"
_VAGUE = 3.0  # usual half-widths of the band: a value within a wider one says nothing; only the drawing hangs on it
# A line across the plot at y = 0, as part of the layout: adding it to a figure is much slower.
ZERO = {"type": "line", "xref": "x domain", "x0": 0, "x1": 1, "y0": 0, "y1": 0, "line": {"color": QUIET, "width": 1}}


@dataclass(frozen=True)
class ModelStyle(LegendItem):
    """The style in which one of the two models is drawn. index: 0 before, 1 after."""

    index: int = 0


PLAIN = ModelStyle("before", "plain matrix (before)", BEFORE)
ALONE = ModelStyle("before", "plain matrix", BEFORE)
EXTENDED = ModelStyle("after", "extended model (after)", AFTER, index=1)
NOISE = LegendItem("noise", "noise alone, 95 %", _NOISE)


@dataclass(frozen=True, eq=False)
class Curve:
    """One model's values (n,) over x (n,), NaN where unknown. half_width (n,): the 95 % band of chance."""

    style: ModelStyle
    values: Array
    half_width: Array


@dataclass(frozen=True, eq=False)
class Panel:
    """The content of one plot: curves over x (n,) and the titles of its axes.

    amplitude: values are never below 0. shared: all curves have the band of the noise alone. ticks: distance between
    ticks of x. words: a text for each point, shown on hovering.
    """

    title: str
    x: Array
    curves: tuple[Curve, ...]
    x_title: str
    y_title: str
    unit: str
    lines: bool = True
    amplitude: bool = False
    shared: bool = False
    ticks: float | None = None
    words: tuple[str, ...] = ()

    @property
    def empty(self) -> bool:
        return not any(np.isfinite(curve.half_width).any() for curve in self.curves)


def legend(styles: Sequence[ModelStyle], noise: bool = True) -> tuple[LegendItem, ...]:
    """The legend of the models and, if ``noise``, of the noise band."""
    return (*styles, NOISE) if noise else tuple(styles)


def drawn(panels: Sequence[Panel]) -> list[go.Figure]:
    """The panels as plots, all with the same scale of y."""
    limits = [_reach(panel) for panel in panels]
    reach = 1.1 * max(limits, default=1.0) or 1.0
    return [_plot(panel, reach) for panel in panels]


def _reach(panel: Panel) -> float:
    """The largest value to be shown: a bin with few samples, with its wide band, must not flatten all curves."""
    reach = [0.0]
    for curve in panel.curves:
        if np.isfinite(curve.half_width).any():
            usual, size = np.nanquantile(curve.half_width, 0.75), np.abs(curve.values)
            vague = (curve.half_width > _VAGUE * usual) & (size <= curve.half_width)
            reach += [float(1.3 * usual), float(np.nanmax(size[~vague], initial=0.0))]
    return max(reach)


def _plot(panel: Panel, reach: float) -> go.Figure:
    bands = panel.curves[:1] if panel.shared else panel.curves
    traces = [_band(panel, curve) for curve in bands]
    words = panel.words or ("",) * len(panel.x)
    for curve in panel.curves:
        hover = f"{text(curve.style.label)}<br>%{{text}} %{{y:.3g}} {panel.unit}"
        if panel.lines:
            looks = {"mode": "lines+markers", "line_color": curve.style.colour, "line_width": 2}
            traces.append(marks(curve.style, 6, panel.x, curve.values, hover=hover, words=words, **looks))
        else:
            traces.append(marks(curve.style, 5, panel.x, curve.values, hover=hover, words=words, opacity=0.75))
    return plot(
        *traces,
        xaxis={"title": {"text": panel.x_title}, "dtick": panel.ticks},
        yaxis={"title": {"text": panel.y_title}, "range": [0 if panel.amplitude else -reach, reach]},
        shapes=[ZERO],
    )


def _band(panel: Panel, curve: Curve) -> go.Scatter:
    """The band of chance about zero, in a pale shade of the curve's colour or in that of the noise."""
    outlines = []
    known = np.isfinite(curve.half_width)
    pieces = np.split(np.arange(len(known)), np.flatnonzero(np.diff(known.astype(int))) + 1)
    margin = 0.015 * float(np.ptp(panel.x))
    for piece in pieces:
        if known[piece[0]]:
            at, half = panel.x[piece], curve.half_width[piece]
            if len(piece) == 1:  # a bin between empty ones
                at, half = at + np.array([-margin, margin]), np.repeat(half, 2)
            low = 0 * half if panel.amplitude else -half
            outlines.append(np.column_stack([np.append(at, at[::-1]), np.append(half, low[::-1])]))
    key, colour = (NOISE.key, BAND) if panel.shared else (curve.style.key, _pale(curve.style.colour))
    return area(key, colour, *joined(outlines).T)


def _pale(colour: str) -> str:
    red, green, blue = (int(colour[index : index + 2], 16) for index in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.16)"
