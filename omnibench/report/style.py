"""The style of all plots: quiet axes, units on every axis, colours that colour-blind readers can tell apart."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import plotly.graph_objects as go

from omnibench.report.blocks import Dash
from omnibench.report.numbers import fixed, power_of_ten
from omnibench.robot.kinematics import Array

FONT = 'system-ui, -apple-system, "Segoe UI", "Helvetica Neue", "Liberation Sans", Arial, sans-serif'
INK = "#1f2933"
QUIET = "#66727f"
GRID = "#e6e9ed"
AXIS = "#9aa5b1"

# The colours of the paper's figures: red for the reference, green for the theoretical matrix.
REFERENCE = "#c8102e"
THEORETICAL = "#00875f"

# Palettes of Okabe and Ito and of Tol for colour-blind readers, without the red and the green above.
PALETTE = (
    *("#0072b2", "#e69f00", "#aa3377", "#4fb0e8", "#7b4b2a", "#332288"),
    *("#8f8f1f", "#8a8f98", "#cc79a7", "#111111", "#9970ab", "#b8977e"),
)
DASHES: tuple[Dash, ...] = ("solid", "dot", "dashdot")
_SHAPES = ("circle", "square", "diamond", "triangle-up", "triangle-down", "pentagon", "star", "hexagon", "cross", "x")
SYMBOLS = tuple(f"{shape}-open" for shape in _SHAPES)

# Spans that a middle is away from 0 before its axis begins elsewhere: a tick then has three digits more than one near
# 0 (chosen).
_FAR = 1000.0


def colours(wanted: Mapping[str, str | None]) -> dict[str, tuple[str, Dash]]:
    """A colour and a dash for each key: its wanted colour while that is free, else the next of the palette."""
    styles: dict[str, tuple[str, Dash]] = {}
    taken: set[tuple[str, Dash]] = set()
    reserved = {colour for colour in wanted.values() if colour}
    # Colours that no key wants come first, so that wanted ones stay free for their keys.
    order = sorted(PALETTE, key=lambda colour: colour in reserved)
    pool = [(colour, dash) for dash in DASHES for colour in order]
    for key, colour in wanted.items():
        if colour and (colour, DASHES[0]) not in taken:
            styles[key] = (colour, DASHES[0])
            taken.add(styles[key])
    for key in wanted:
        if key not in styles:
            free = [style for style in pool if style not in taken]
            styles[key] = free[0] if free else pool[len(styles) % len(pool)]
            taken.add(styles[key])
    return {key: styles[key] for key in wanted}


def text(words: str) -> str:
    """Words escaped for a plot, since Plotly interprets some HTML; lines stay lines."""
    return html.escape(words, quote=False).replace("\n", "<br>")


def wrapped(words: str, most: int = 24) -> str:
    """A label in lines of at most ``most`` characters, so that it leaves the plot its width."""
    lines = [""]
    for part in re.findall(rf"[^\s_/-]{{0,{most - 1}}}[\s_/-]|[^\s_/-]{{1,{most}}}", words):
        if len(lines[-1]) + len(part.rstrip()) > most:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.rstrip() for line in lines)


def plot(*traces: go.Scatter, x_title: str | None = None, y_title: str | None = None, **layout: Any) -> go.Figure:
    """A figure of these traces in the common style, without a legend of its own."""
    common = {
        "template": _TEMPLATE,
        "showlegend": False,
        "hovermode": "closest",
        "margin": {"l": 62, "r": 18, "t": 12, "b": 50},
    }
    titles = {"xaxis_title_text": x_title, "yaxis_title_text": y_title}
    given = {name: title for name, title in titles.items() if title is not None}
    # Updating a figure's layout would take four times as long.
    return go.Figure(data=list(traces), layout=common | layout | given)


def plan(*traces: go.Scatter, window: Array | None = None, x_title: str = "x (m)", y_title: str = "y (m)") -> go.Figure:
    """A figure with the same scale in x and y. window (2, 2): least and greatest x, then y; default: all is shown.

    Where a coordinate is far from 0, as in a map's frame, it is drawn from a round value that the axis names.
    """
    origins = [_round_origin(traces, "x"), _round_origin(traces, "y")]
    titles = [x_title, y_title]
    for row, (axis, origin) in enumerate(zip("xy", origins, strict=True)):
        if origin:
            named = f"{axis} − {fixed(origin, 0)}"
            titles[row] = titles[row].replace(axis, named, 1)
            traces = tuple(_moved(trace, axis, origin, named) for trace in traces)
    if window is not None:
        window = window - np.array(origins)[:, None]
    figure = plot(*traces, x_title=titles[0], y_title=titles[1], yaxis={"scaleanchor": "x", "scaleratio": 1})
    if window is not None:
        figure.update_layout(xaxis_range=window[0].tolist(), yaxis_range=window[1].tolist())
    return figure


def _moved(trace: go.Scatter, axis: str, origin: float, named: str) -> go.Scatter:
    """A copy of a trace with one coordinate less its origin, which its hover text names."""
    copy = go.Scatter(trace)
    copy[axis] = [None if value is None else value - origin for value in trace[axis]]
    if copy.hovertemplate:
        copy.hovertemplate = copy.hovertemplate.replace(f"{axis} %{{", f"{named} = %{{")
    return copy


def _round_origin(traces: Sequence[go.Scatter], axis: Literal["x", "y"]) -> float:
    """A round value near the coordinates of traces that are far from 0; 0 for others."""
    values = np.array([value for trace in traces for value in trace[axis] if value is not None], dtype=float)
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0
    span, middle = max(float(np.ptp(values)), 1.0), float(values.mean())
    if abs(middle) < _FAR * span:
        return 0.0
    step = 10.0 ** (1 + math.ceil(math.log10(span)))
    return step * round(middle / step)


def logarithmic(figure: go.Figure, axis: Literal["x", "y"], low: float, high: float) -> None:
    """Make an axis logarithmic over ``low`` to ``high``, with labels that fit: at 1, 2, 5 or at powers of ten."""
    low, high = min(low, high / 1.05), max(high, low * 1.05)
    decades = math.log10(high / low)
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    if decades < 2:
        steps = (1, 1.5, 2, 3, 4, 6, 8) if decades < 1 else (1, 2, 5)
        ticks = [step * 10.0**exponent for exponent in exponents for step in steps]
        labels = [f"{tick:.6g}" for tick in ticks]
    else:
        stride = math.ceil(decades / 7)
        ticks = [10.0**exponent for exponent in exponents if exponent % stride == 0]
        labels = [power_of_ten(exponent) for exponent in exponents if exponent % stride == 0]
    margin = 0.04 * decades
    figure.update_layout(
        {
            f"{axis}axis": {
                "type": "log",
                "range": [math.log10(low) - margin, math.log10(high) + margin],
                "tickvals": ticks,
                "ticktext": labels,
            }
        }
    )


_AXIS_STYLE = {
    "showline": True,
    "linecolor": AXIS,
    "gridcolor": GRID,
    "zeroline": False,
    "ticks": "outside",
    "ticklen": 4,
    "tickcolor": AXIS,
    "tickfont": {"size": 12, "color": QUIET},
    "title": {"font": {"size": 13, "color": INK}, "standoff": 8},
    "automargin": True,
}
_TEMPLATE = go.layout.Template(
    layout={
        "font": {"family": FONT, "size": 13, "color": INK},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "colorway": list(PALETTE),
        "xaxis": _AXIS_STYLE,
        "yaxis": _AXIS_STYLE,
        "hoverlabel": {"bgcolor": "white", "bordercolor": AXIS, "font": {"family": FONT, "size": 12, "color": INK}},
        "modebar": {"bgcolor": "rgba(255,255,255,0.85)", "color": AXIS, "activecolor": INK},
    }
)
