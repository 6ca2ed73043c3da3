"""The traces that figures are made of, in the style of a legend's items; a robot from above; single figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.numbers import fixed, plain
from omnibench.report.style import INK, PALETTE, QUIET, THEORETICAL, plan, text
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


def motion_system(robot: Robot) -> tuple[Figure, list[LegendItem]]:
    """Wheels with their rolling directions, the frame, and how a motion command (v, α, ω) is meant; the legend."""
    size = _size(robot)
    traces = [_outlines(DESIGN, robot)]
    traces += arrows(_FRAME, np.zeros((2, 2)), _up(0.55 * size * np.eye(2)), ["X_R, front", "Y_R, left"])
    middles = np.array([wheel.position for wheel in robot.measured])
    ways = np.array([_unit_vector(wheel.rolling) for wheel in robot.measured])
    starts = middles + 0.22 * size * np.array([_unit_vector(wheel.outward) for wheel in robot.measured])
    words = [f"V_{wheel.name}: rate times radius" for wheel in robot.measured]
    traces += arrows(_ROLLING, _up(starts - 0.18 * size * ways), _up(starts + 0.18 * size * ways), words)
    direction = math.radians(_DIRECTION)
    tip = 0.62 * size * _unit_vector(direction)[None]
    traces += arrows(_COMMAND, np.zeros((1, 2)), _up(tip), [f"α = {_DIRECTION}°"])
    turning = _arc(0.3 * size, direction, direction + math.radians(80))
    traces.append(line(_COMMAND, 1.6, *_up(turning).T))
    traces += arrows(_COMMAND, _up(turning[-2:-1]), _up(turning[-1:]), ["ω"])
    labels = [
        _label(size * np.array([0.56, -0.12]), "X<sub>R</sub>", INK),
        _label(size * np.array([0.13, 0.56]), "Y<sub>R</sub>", INK),
        _label(1.22 * tip[0], "v, α", _COMMAND.colour),
        _label(turning[-1] * 1.3, "ω", _COMMAND.colour),
    ]
    for wheel, start, way in zip(robot.measured, starts, ways, strict=True):
        labels.append(_label(start + 0.36 * size * way, f"V<sub>{text(wheel.name)}</sub>", _ROLLING.colour))
    for wheel in robot.wheels:
        behind = (wheel.radius + 0.1 * size) * _unit_vector(
            wheel.rolling
        )  # beside the rectangle, which names would cross
        labels.append(_label(np.array(wheel.position) - behind, text(wheel.name), INK))
    figure = _seen_from_above(traces, labels, size)
    names = ", ".join(wheel.name for wheel in robot.wheels)
    description = f"{robot.name} from above: wheels {names}, frame, directions of rolling"
    return Figure("The motion system", figure, description, 460), [DESIGN, _FRAME, _ROLLING, _COMMAND]


def parameters(robot: Robot, fitted: Sequence[tuple[LegendItem, Robot]] = ()) -> Figure:
    """Radius and place of every wheel as designed; fitted: robots whose wheels are drawn over these."""
    size = _size(robot)
    traces, labels = [_outlines(DESIGN, robot, filled=True)], []
    traces += [_outlines(item, of_fit) for item, of_fit in fitted]
    traces += arrows(_FRAME, np.zeros((1, 2)), _up(np.array([[0.4 * size, 0.0]])), ["X_R, front"])
    for number, wheel in enumerate(robot.wheels):
        place, name = np.array(wheel.position), text(wheel.name)
        traces.append(line(_FRAME, 1.2, *_up(np.array([[0.0, 0.0], place])).T, line_dash="dot"))
        if wheel.distance is not None:
            angle = wheel.axle % (2 * math.pi)
            reach, before = (0.2 + 0.1 * number) * size, angle - 0.35  # rad before the arc's end: beside that line
            traces.append(line(_FRAME, 1.0, *_up(_arc(reach, 0.0, angle)).T))
            labels.append(_label((reach + 0.08 * size) * _unit_vector(before), f"δ<sub>{name}</sub>", QUIET))
            labels.append(_label(0.6 * place + 0.1 * size * _unit_vector(wheel.rolling), f"R<sub>{name}</sub>", INK))
            values, apart = (
                f"r {wheel.radius:g} m<br>R {wheel.distance:g} m<br>δ {fixed(math.degrees(angle), 1)}°",
                0.65,
            )
        else:
            x, y = map(plain, wheel.position)
            values, apart = f"r {wheel.radius:g} m<br>x {x} m<br>y {y} m", 0.5  # wheels to the sides: within the plot
        labels.append(
            _label(place + apart * size * _unit_vector(wheel.outward), f"<b>{name}</b> {values}", DESIGN.colour)
        )
    description = f"Radius and place of each wheel of {robot.name}"
    return Figure("Its parameters", _seen_from_above(traces, labels, size), description, 460)


def _unit_vector(angle: float) -> Array:
    """Unit vector at an angle from the front, rad."""
    return np.array([math.cos(angle), math.sin(angle)])


def _size(robot: Robot) -> float:
    """Distance of the farthest wheel, m."""
    return max(math.hypot(*wheel.position) for wheel in robot.wheels)


def _outlines(item: LegendItem, robot: Robot, filled: bool = False) -> go.Scatter:
    """The wheels as rectangles: their diameter along the direction of rolling; those that steer straight ahead."""
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]])
    rectangles = []
    for wheel in robot.wheels:
        sides = wheel.radius * np.array([_unit_vector(wheel.rolling), _WIDTH * _unit_vector(wheel.axle)])
        rectangles.append(_up(np.array(wheel.position) + corners @ sides))
    looks: dict[str, Any] = {"fill": "toself", "fillcolor": "rgba(0,135,95,0.12)"} if filled else {}
    return line(item, 2.0, *joined(rectangles).T, **looks)


def _arc(radius: float, first: float, last: float) -> Array:
    """Points (n, 2) of an arc about the centre between two angles, rad."""
    angles = np.linspace(first, last, 40)
    return radius * np.column_stack([np.cos(angles), np.sin(angles)])


def _up(points: Array) -> Array:
    """Points (..., 2) of the robot's frame in the picture: x upwards, y to the left."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _label(point: Array, words: str, colour: str) -> dict[str, Any]:
    x, y = _up(point)
    return {"x": x, "y": y, "text": words, "showarrow": False, "font": {"color": colour, "size": 13}}


def _seen_from_above(traces: Sequence[go.Scatter], labels: list[dict[str, Any]], size: float) -> go.Figure:
    window = _REACH * size * np.array([[-1.0, 1.0]] * 2)
    figure = plan(*traces, window=window, x_title="y, to the left (m)", y_title="x, forward (m)")
    step = 10.0 ** math.floor(math.log10(size))
    ticks = step * np.arange(-math.floor(_REACH * size / step), math.floor(_REACH * size / step) + 1)
    axis = {
        "tickvals": ticks.tolist(),
        "ticktext": [fixed(-float(tick), max(0, -round(math.log10(step)))) for tick in ticks],
    }
    figure.update_layout(annotations=labels, xaxis=axis, yaxis_tickvals=ticks.tolist())
    return figure


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
