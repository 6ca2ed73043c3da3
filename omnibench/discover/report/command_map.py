"""Final position residuals as arrows where the commands end."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from omnibench.discover.report.before_after import BAND, NOISE, ModelStyle, legend, numbers, round_down
from omnibench.discover.report.residuals import CIRCLE_95, CommandResidual
from omnibench.report.blocks import Figure, FigureGrid
from omnibench.report.numbers import fixed
from omnibench.report.style import INK, QUIET, equal_aspect, plot, text
from omnibench.robot.kinematics import Array
from omnibench.words import plural


def command_maps(commands: Sequence[CommandResidual], styles: Sequence[ModelStyle]) -> FigureGrid:
    """The residual of each command as an arrow at its end, enlarged."""
    reach = float(np.median([np.hypot(*each.end[:2]) for each in commands]))
    sizes = [np.hypot(*mean_of(each, style)[:2]) for each in commands for style in styles]
    circle = CIRCLE_95 * float(np.median([each.error[0] for each in commands]))
    # A step of 1, 2 or 5: the longest arrow is about a third of the way to the ends.
    factor = round_down(0.35 * reach / max(float(np.quantile(sizes, 0.95)), circle, 1e-6))
    tips = [each.end[:2] + factor * mean_of(each, style)[:2] for each in commands for style in styles]
    points = np.array([*tips, *(each.end[:2] for each in commands), np.zeros(2)])
    margin = 0.04 * float(np.ptp(points, axis=0).max()) + factor * circle / 2
    window = np.column_stack([points.min(axis=0) - margin, points.max(axis=0) + margin])
    figures = tuple(
        Figure(
            f"Final position residuals, {style.label}",
            _map(commands, style, factor, window),
            f"Mean final position residual of each command at its end, enlarged {factor:g} times, {style.label}",
            440,
        )
        for style in styles
    )
    caption = (
        f"Mean over the runs of each command, seen from its start pose (x forward). An arrow goes from where a command "
        f"ends by the reference, and is the residual (reference minus odometry) enlarged {factor:g} times; grey "
        "circles hold 95 % of what noise alone would do to that mean, enlarged alike."
    )
    return FigureGrid(figures, legend(styles), 2, caption)


def _map(commands: Sequence[CommandResidual], style: ModelStyle, factor: float, window: Array) -> go.Figure:
    traces = []
    circles_x: list[float | None] = []
    circles_y: list[float | None] = []
    lines_x: list[float | None] = []
    lines_y: list[float | None] = []
    tips, words = [], []
    turn = np.linspace(0, 2 * np.pi, 33)
    for each in commands:
        x, y = each.end[:2]
        radius = factor * CIRCLE_95 * each.error[0]
        circles_x += [*numbers(x + radius * np.cos(turn)), None]
        circles_y += [*numbers(y + radius * np.sin(turn)), None]
        residual = mean_of(each, style)
        tip = each.end[:2] + factor * residual[:2]
        lines_x += [*numbers(np.array([x, tip[0]])), None]
        lines_y += [*numbers(np.array([y, tip[1]])), None]
        tips.append(tip)
        words.append(f"{text(command_in_words(each))}<br>{_in_words(residual)}<br>{plural(each.runs, 'run')}")
    ends = np.array([each.end[:2] for each in commands])
    traces.append(
        go.Scatter(x=circles_x, y=circles_y, mode="none", fill="toself", fillcolor=BAND, legendgroup=NOISE.key,
                   hoverinfo="skip")
    )  # fmt: skip
    traces.append(
        go.Scatter(x=lines_x, y=lines_y, mode="lines", line={"color": style.colour, "width": 2.2},
                   legendgroup=style.key, hoverinfo="skip")
    )  # fmt: skip
    traces.append(_dots(ends, QUIET, 3, words, style))
    traces.append(_dots(np.array(tips), style.colour, 6, words, style, _directions(commands, style)))
    traces.append(_dots(np.zeros((1, 2)), INK, 7, ["start"], style))
    figure = plot(*traces, xaxis_title_text="x (m)", yaxis_title_text="y (m)")
    figure.update_xaxes(range=numbers(window[0]))
    figure.update_yaxes(range=numbers(window[1]))
    equal_aspect(figure)
    return figure


def _directions(commands: Sequence[CommandResidual], style: ModelStyle) -> list[float]:
    """The direction of each arrow, clockwise from up, deg."""
    found = [mean_of(each, style)[:2] for each in commands]
    return [90.0 - math.degrees(math.atan2(residual[1], residual[0])) for residual in found]


def _dots(
    points: Array,
    colour: str,
    size: int,
    words: Sequence[str],
    style: ModelStyle,
    angles: Sequence[float] | None = None,
) -> go.Scatter:
    marker: dict[str, object] = {"color": colour, "size": size}
    if angles is not None:
        marker |= {"symbol": "triangle-up", "angle": [round(each, 1) for each in angles], "size": size + 3}
    return go.Scatter(
        x=numbers(points[:, 0]),
        y=numbers(points[:, 1]),
        mode="markers",
        marker=marker,
        text=list(words),
        hovertemplate="%{text}<extra></extra>",
        legendgroup=style.key if angles is not None else None,
    )


def mean_of(each: CommandResidual, style: ModelStyle) -> Array:
    """The mean final residual (3,) of one model."""
    mean: Array = each.means[style.index]
    return mean


def command_in_words(each: CommandResidual) -> str:
    """A command described by speed, direction and rate of turn; by its name if these are unknown."""
    run = each.run
    if run.alpha is None or run.omega is None or run.v is None:
        return each.name
    if run.v == 0:
        return f"on the spot, {fixed(run.omega, 2)} rad/s"
    return f"{run.v:.3g} m/s at {fixed(math.degrees(run.alpha) % 360, 0)}°, {fixed(run.omega, 2)} rad/s"


def _in_words(residual: Array) -> str:
    x, y, turned = residual
    return f"{1e3 * math.hypot(x, y):.1f} mm, {math.degrees(turned):.2f}°".replace("-", "−")
