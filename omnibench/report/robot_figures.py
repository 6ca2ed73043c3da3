"""The robot seen from above, its front upwards: wheels, frame and parameters, after Fig. 2 and 3 of the paper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from omnibench.report.blocks import Figure, LegendItem
from omnibench.report.numbers import fixed, plain
from omnibench.report.style import INK, PALETTE, QUIET, THEORETICAL, plan, text
from omnibench.report.traces import arrows, joined, line
from omnibench.robot.kinematics import Array, Robot, Wheel

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
    ways = np.array([_along(wheel.rolling) for wheel in robot.measured])
    starts = middles + 0.22 * size * np.array([_along(wheel.outward) for wheel in robot.measured])
    words = [f"V_{wheel.name}: rate times radius" for wheel in robot.measured]
    traces += arrows(_ROLLING, _up(starts - 0.18 * size * ways), _up(starts + 0.18 * size * ways), words)
    direction = math.radians(_DIRECTION)
    tip = 0.62 * size * _along(direction)[None]
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
        behind = (wheel.radius + 0.1 * size) * _along(wheel.rolling)  # beside the rectangle, which names would cross
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
            labels.append(_label((reach + 0.08 * size) * _along(before), f"δ<sub>{name}</sub>", QUIET))
            labels.append(_label(0.6 * place + 0.1 * size * _along(wheel.rolling), f"R<sub>{name}</sub>", INK))
            values, apart = (
                f"r {wheel.radius:g} m<br>R {wheel.distance:g} m<br>δ {fixed(math.degrees(angle), 1)}°",
                0.65,
            )
        else:
            x, y = map(plain, wheel.position)
            values, apart = f"r {wheel.radius:g} m<br>x {x} m<br>y {y} m", 0.5  # wheels to the sides: within the plot
        labels.append(_label(place + apart * size * _along(wheel.outward), f"<b>{name}</b> {values}", DESIGN.colour))
    description = f"Radius and place of each wheel of {robot.name}"
    return Figure("Its parameters", _seen_from_above(traces, labels, size), description, 460)


def _along(angle: float) -> Array:
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
        sides = wheel.radius * np.array([_along(wheel.rolling), _WIDTH * _along(wheel.axle)])
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
