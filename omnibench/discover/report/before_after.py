"""Figures that compare the plain with the extended model: their styles, the noise band, panels on a common scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from omnibench.report.blocks import LegendItem
from omnibench.report.style import QUIET, plot, text
from omnibench.robot.kinematics import Array

BEFORE, AFTER, FLOOR = "#d97706", "#0072b2", "#8a8f98"
BAND = "rgba(102,114,127,0.20)"
_NOISE = "#c3c9d0"
# A line across the plot at y = 0, as part of the layout: adding it to a figure is much slower.
ZERO = {"type": "line", "xref": "x domain", "x0": 0, "x1": 1, "y0": 0, "y1": 0, "line": {"color": QUIET, "width": 1}}


@dataclass(frozen=True)
class ModelStyle:
    """The style in which one of the two models is drawn. index: 0 before, 1 after."""

    index: int
    key: str
    label: str
    colour: str

    @property
    def legend(self) -> LegendItem:
        return LegendItem(self.key, self.label, self.colour)


PLAIN = ModelStyle(0, "before", "plain matrix (before)", BEFORE)
ALONE = ModelStyle(0, "before", "plain matrix", BEFORE)
EXTENDED = ModelStyle(1, "after", "extended model (after)", AFTER)
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
    models = tuple(style.legend for style in styles)
    return (*models, NOISE) if noise else models


def drawn(panels: Sequence[Panel]) -> list[go.Figure]:
    """The panels as plots, all with the same scale of y."""
    limits = [_reach(panel) for panel in panels]
    reach = 1.1 * max(limits, default=1.0) or 1.0
    return [_plot(panel, reach) for panel in panels]


def numbers(values: Array) -> list[float | None]:
    """Values rounded to five digits, None for NaN."""
    return [None if np.isnan(value) else float(f"{value:.5g}") for value in np.asarray(values, dtype=float)]


def round_down(value: float) -> float:
    """The largest of 1, 2, 5, 10, 20, ... and of 0.5, 0.2, ... that does not exceed ``value``, which is > 0."""
    decade = 10.0 ** math.floor(math.log10(value))
    return max(step * decade for step in (1, 2, 5) if step * decade <= value * (1 + 1e-9))


def _reach(panel: Panel) -> float:
    widest = np.nanmax(np.concatenate([np.abs(curve.values) for curve in panel.curves]), initial=0.0)
    # The wide band of a bin with few samples must not flatten all curves.
    usual = [np.nanquantile(curve.half_width, 0.75) for curve in panel.curves if np.isfinite(curve.half_width).any()]
    return float(max(widest, 1.3 * max(usual, default=0.0)))


def _plot(panel: Panel, reach: float) -> go.Figure:
    bands = panel.curves[:1] if panel.shared else panel.curves
    traces = [_band(panel, curve) for curve in bands]
    words = panel.words or ("",) * len(panel.x)
    traces += [
        go.Scatter(
            x=numbers(panel.x),
            y=numbers(curve.values),
            mode="lines+markers" if panel.lines else "markers",
            line={"color": curve.style.colour, "width": 2},
            marker={"color": curve.style.colour, "size": 6 if panel.lines else 5},
            opacity=1.0 if panel.lines else 0.75,
            legendgroup=curve.style.key,
            text=[text(each) for each in words],
            hovertemplate=f"{text(curve.style.label)}<br>%{{text}} %{{y:.3g}} {panel.unit}<extra></extra>",
        )
        for curve in panel.curves
    ]
    return plot(
        *traces,
        xaxis={"title": {"text": panel.x_title}, "dtick": panel.ticks},
        yaxis={"title": {"text": panel.y_title}, "range": [0 if panel.amplitude else -reach, reach]},
        shapes=[ZERO],
    )


def _band(panel: Panel, curve: Curve) -> go.Scatter:
    """The band of chance about zero, in a pale shade of the curve's colour or in that of the noise."""
    x: list[float | None] = []
    y: list[float | None] = []
    known = np.isfinite(curve.half_width)
    pieces = np.split(np.arange(len(known)), np.flatnonzero(np.diff(known.astype(int))) + 1)
    margin = 0.015 * float(np.ptp(panel.x))
    for piece in pieces:
        if known[piece[0]]:
            at, half = panel.x[piece], curve.half_width[piece]
            if len(piece) == 1:  # a bin between empty ones
                at, half = at + np.array([-margin, margin]), np.repeat(half, 2)
            low = 0 * half if panel.amplitude else -half
            x += [*numbers(np.concatenate([at, at[::-1]])), None]
            y += [*numbers(np.concatenate([half, low[::-1]])), None]
    colour = BAND if panel.shared else _pale(curve.style.colour)
    return go.Scatter(
        x=x,
        y=y,
        fill="toself",
        mode="none",
        fillcolor=colour,
        legendgroup=NOISE.key if panel.shared else curve.style.key,
        hoverinfo="skip",
    )


def _pale(colour: str) -> str:
    red, green, blue = (int(colour[index : index + 2], 16) for index in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.16)"
