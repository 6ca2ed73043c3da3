"""The traces that figures are made of: lines, marks, arrows and areas, in the style of an item of the legend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from omnibench.report.blocks import LegendItem
from omnibench.report.style import INK, text
from omnibench.robot.kinematics import Array

Values = Sequence[float] | Sequence[str] | Array  # numbers, or the names of categories
START = LegendItem("", "start", INK, symbol="circle-open")
ORIGIN = LegendItem("", "start", INK)  # where several paths start
_DIGITS = 5  # significant digits of coordinates: below a pixel in a figure magnified ten times


def line(
    item: LegendItem, width: float, x: Values, y: Values, *, hover: str = "", words: Sequence[str] = (), **more: Any
) -> go.Scatter:
    """A line through points, broken at NaN.

    width: px. hover: Plotly's template of what a point shows, in which ``%{text}`` is its own of ``words``; empty: it
    shows nothing. more: further properties of the trace, in place of these where they have the same name.
    """
    looks = {"mode": "lines", "line": {"color": item.colour, "width": width, "dash": item.dash}}
    return _trace(item, x, y, hover, words, looks | more)


def marks(
    item: LegendItem, size: float, x: Values, y: Values, *, hover: str = "", words: Sequence[str] = (), **more: Any
) -> go.Scatter:
    """Points with the item's symbol, ``size`` px, if it is open with a line of 2 px; the rest as for :func:`line`."""
    marker = {"color": item.colour, "size": size, "symbol": item.symbol}
    marker |= {"line": {"width": 2}} if item.symbol.endswith("-open") else {}
    return _trace(item, x, y, hover, words, {"mode": "markers", "marker": marker} | more)


def arrows(item: LegendItem, starts: Array, tips: Array, words: Sequence[str]) -> list[go.Scatter]:
    """Arrows from ``starts`` (n, 2) to ``tips`` (n, 2), with words that are shown at the tips."""
    shafts = joined([np.array(ends) for ends in zip(starts, tips, strict=True)])
    clockwise_from_up = 90.0 - np.degrees(np.arctan2(*(tips - starts).T[::-1]))
    heads: dict[str, Any] = {"marker_symbol": "triangle-up", "marker_angle": coordinates(clockwise_from_up)}
    return [line(item, 2.0, *shafts.T), marks(item, 9, *tips.T, hover="%{text}", words=words, **heads)]


def area(key: str, colour: str, x: Values, y: Values) -> go.Scatter:
    """A filled outline, or several that NaN separates. key: of its item in the legend."""
    looks = {"mode": "none", "fill": "toself", "fillcolor": colour}
    return _trace(LegendItem(key, "", colour), x, y, "", (), looks)


def path(item: LegendItem, poses: Array, width: float, **more: Any) -> go.Scatter:
    """A path over the ground; poses (K, 2 or 3), m."""
    hover = f"{text(item.label)}<br>x %{{x:.3f}} m, y %{{y:.3f}} m"
    return line(item, width, poses[:, 0], poses[:, 1], hover=hover, **more)


def joined(paths: Sequence[Array]) -> Array:
    """Paths (K, n) joined into one array, with a row of NaN between them, at which a plotted line breaks."""
    if not paths:
        return np.empty((0, 2))
    gap = np.full((1, paths[0].shape[1]), np.nan)
    return np.vstack([part for each in paths for part in (each, gap)][:-1])


def coordinates(values: Values) -> list[float | None]:
    """Values to five significant digits, of their range where that is smaller; NaN becomes None.

    So a path is as fine far from the origin of its map as near it, and small values stay on logarithmic axes.
    """
    numbers = np.asarray(values, float)
    finite = numbers[np.isfinite(numbers)]
    span = float(np.ptp(finite)) if finite.size else 0.0
    if not 0 < span < np.inf:
        return [None if math.isnan(value) else value for value in numbers.tolist()]
    decimals = _DIGITS - math.floor(math.log10(span))
    return [None if math.isnan(value) else _rounded(value, span, decimals) for value in numbers.tolist()]


def _rounded(value: float, span: float, decimals: int) -> float:
    return round(value, decimals) if abs(value) > span else float(f"{value:.{_DIGITS}g}")


def _trace(
    item: LegendItem, x: Values, y: Values, hover: str, words: Sequence[str], looks: dict[str, Any]
) -> go.Scatter:
    shown: dict[str, Any] = {"hovertemplate": f"{hover}<extra></extra>"} if hover else {"hoverinfo": "skip"}
    shown |= {"text": [text(each) for each in words]} if words else {}
    return go.Scatter(**shown | {"x": _along(x), "y": _along(y), "legendgroup": item.key or None} | looks)


def _along(values: Values) -> list[Any]:
    names = [text(value) for value in values if isinstance(value, str)]
    return names or coordinates(values)
