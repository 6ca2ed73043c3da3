"""The traces that figures are made of, in the style of a legend's items; a robot from above; single figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.numbers import fixed, plain
from omnibench.report.style import INK, PALETTE, THEORETICAL, plan, text
from omnibench.robot.kinematics import Array, Robot, Wheel

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
    return [
        None if math.isnan(value) else round(value, decimals) if abs(value) > span else float(f"{value:.{_DIGITS}g}")
        for value in numbers.tolist()
    ]


def _trace(
    item: LegendItem, x: Values, y: Values, hover: str, words: Sequence[str], looks: dict[str, Any]
) -> go.Scatter:
    shown: dict[str, Any] = {"hovertemplate": f"{hover}<extra></extra>"} if hover else {"hoverinfo": "skip"}
    shown |= {"text": [text(each) for each in words]} if words else {}
    along = ([text(value) for value in values if isinstance(value, str)] or coordinates(values) for values in (x, y))
    return go.Scatter(**shown | dict(zip("xy", along, strict=True)) | {"legendgroup": item.key or None} | looks)


_WIDTH = 0.15  # of a drawn wheel, as a share of its radius (chosen: the data do not hold it)
_REACH = 1.95  # half of the picture, in distances from the centre to the farthest wheel
_DIRECTION = -30  # degrees: of the command that is drawn, between axes and wheels (chosen)
_FRAME = LegendItem("frame", "the robot's frame", INK)
_ROLLING = LegendItem("rolling", "direction of a positive wheel rate", PALETTE[0])
_COMMAND = LegendItem("command", "motion command (v, α, ω)", PALETTE[2])
DESIGN = LegendItem("design", "design values", THEORETICAL)


def is_placed(wheel: Wheel) -> bool:
    """True if it is known where a wheel stands; a mecanum wheel's distance is a lever arm."""
    return wheel.kind != "mecanum" or wheel.x is not None


def is_drawn(robot: Robot) -> bool:
    """True if it is known where every wheel stands."""
    return all(map(is_placed, robot.wheels))


def motion_system(robot: Robot, fitted: Sequence[tuple[LegendItem, Robot]] = ()) -> FigureGrid:
    """A robot from above: wheels with their values and directions of rolling, its frame, a motion command (v, α, ω).

    fitted: robots whose wheels are drawn over these. Fig. 2 and 3 of the paper.
    """
    size = max(math.hypot(*wheel.position) for wheel in robot.wheels)
    traces = [_outlines(DESIGN, robot), *(_outlines(item, of_fit) for item, of_fit in fitted)]
    direction = math.radians(_DIRECTION)
    way, turns = _unit_vector(direction), _unit_vector(direction + np.linspace(0.0, math.radians(80), 40))
    traces += arrows(_FRAME, np.zeros((2, 2)), _up(0.55 * size * np.eye(2)), ["X_R, front", "Y_R, left"])
    traces += arrows(_COMMAND, np.zeros((1, 2)), _up(0.62 * size * way[None]), [f"α = {_DIRECTION}°"])
    traces.append(line(_COMMAND, 1.6, *_up(0.3 * size * turns).T))
    traces += arrows(_COMMAND, _up(0.3 * size * turns[-2:-1]), _up(0.3 * size * turns[-1:]), ["ω"])
    labels = [
        _label(size * np.array([0.56, -0.12]), "X<sub>R</sub>", INK),
        _label(size * np.array([0.13, 0.56]), "Y<sub>R</sub>", INK),
        _label(0.76 * size * way, "v, α", _COMMAND.colour),
        _label(0.39 * size * turns[-1], "ω", _COMMAND.colour),
    ]
    rolling = []
    for wheel in robot.measured:
        way, name = _unit_vector(wheel.rolling), text(wheel.name)
        start = np.array(wheel.position) + 0.22 * size * _unit_vector(wheel.outward)
        rolling.append(_up(start + 0.18 * size * np.array([-way, way])))
        labels.append(_label(start + 0.36 * size * way, f"V<sub>{name}</sub>", _ROLLING.colour))
    begins, ends = np.array(rolling).transpose(1, 0, 2)
    traces += arrows(_ROLLING, begins, ends, [f"V_{wheel.name}: rate times radius" for wheel in robot.measured])
    for wheel in robot.wheels:
        x, y = map(plain, wheel.position)
        values = f"x {x} m<br>y {y} m"
        if wheel.distance is not None:
            degrees = fixed(math.degrees(wheel.axle % math.tau), 1)
            values = f"R {wheel.distance:g} m<br>δ {degrees}°"
        words = f"<b>{text(wheel.name)}</b> r {wheel.radius:g} m<br>{values}"
        ahead, left = wheel.position
        beside = np.sign(left) if abs(left) > 0.1 * size else 0.0  # values stand beside a wheel, or behind it
        place = (ahead, left + 0.5 * size * beside) if beside else (ahead - 0.65 * size, left)
        anchor = {1.0: "right", 0.0: "center", -1.0: "left"}[beside]
        labels.append(_label(np.array(place), words, DESIGN.colour) | {"xanchor": anchor})
    # The axes of the picture: x upwards, y to the left
    window = _REACH * size * np.array([[-1.0, 1.0]] * 2)
    figure = plan(*traces, window=window, x_title="y, to the left (m)", y_title="x, forward (m)")
    step = 10.0 ** math.floor(math.log10(size))
    most = math.floor(_REACH * size / step)
    ticks = step * np.arange(-most, most + 1)
    to_left = [fixed(-float(tick), max(0, -round(math.log10(step)))) for tick in ticks]
    figure.update_layout(annotations=labels, yaxis_tickvals=ticks.tolist())
    figure.update_xaxes(tickvals=ticks.tolist(), ticktext=to_left)
    names = ", ".join(wheel.name for wheel in robot.wheels)
    description = f"{robot.name} from above: wheels {names}, frame, directions of rolling"
    items = (DESIGN, *(item for item, _ in fitted), _FRAME, _ROLLING, _COMMAND)
    return FigureGrid((Figure("The motion system", figure, description, 460),), items, 1, name="robot")


def _unit_vector(angle: float | Array) -> Array:
    """Unit vectors (..., 2) at angles (...) from the front, rad."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _outlines(item: LegendItem, robot: Robot) -> go.Scatter:
    """The wheels as rectangles: their diameter along the direction of rolling; those that steer straight ahead."""
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]])
    rectangles = []
    for wheel in robot.wheels:
        sides = wheel.radius * np.array([_unit_vector(wheel.rolling), _WIDTH * _unit_vector(wheel.axle)])
        rectangles.append(_up(np.array(wheel.position) + corners @ sides))
    return line(item, 2.0, *joined(rectangles).T)


def _up(points: Array) -> Array:
    """Points (..., 2) of the robot's frame in the picture: x upwards, y to the left."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _label(point: Array, words: str, colour: str) -> dict[str, Any]:
    x, y = _up(point)
    return {"x": x, "y": y, "text": words, "showarrow": False, "font": {"color": colour, "size": 13}}


_MARGIN = 60  # px above and below


def drawn(grid: FigureGrid) -> go.Figure:
    """The plots of a grid side by side in one figure, with its legend."""
    if len(grid.figures) == 1:
        (figure,) = grid.figures
        alone = go.Figure(figure.plot)
        alone.update_layout(title_text=text(figure.title), title_x=0.02)
        return _with_legend(alone, grid, figure.height)
    from plotly.subplots import make_subplots  # only a notebook needs it

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
