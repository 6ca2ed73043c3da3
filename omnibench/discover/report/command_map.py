"""Final position residuals as arrows where the commands end."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from omnibench.discover.report.before_after import BAND, NOISE, ModelStyle, legend
from omnibench.discover.report.residuals import CIRCLE_95, CommandResidual
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.motions import motion_in_words
from omnibench.report.numbers import round_down
from omnibench.report.style import QUIET, plan
from omnibench.report.traces import ORIGIN, area, arrows, joined, marks
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
    turn = np.linspace(0, 2 * np.pi, 33)
    circle = CIRCLE_95 * factor * np.column_stack([np.cos(turn), np.sin(turn)])
    circles = joined([each.end[:2] + each.error[0] * circle for each in commands])
    residuals = [mean_of(each, style) for each in commands]
    words = [
        f"{command_in_words(each)}\n{_in_words(residual)}\n{plural(each.runs, 'run')}"
        for each, residual in zip(commands, residuals, strict=True)
    ]
    ends = np.array([each.end[:2] for each in commands])
    shafts, heads = arrows(style, ends, ends + factor * np.array(residuals)[:, :2], words)
    return plan(
        area(NOISE.key, BAND, *circles.T),
        shafts,
        marks(LegendItem("", "end", QUIET), 3, *ends.T, hover="%{text}", words=words),
        heads,
        marks(ORIGIN, 7, [0], [0], hover="start"),
        window=window,
    )


def mean_of(each: CommandResidual, style: ModelStyle) -> Array:
    """The mean final residual (3,) of one model."""
    mean: Array = each.means[style.index]
    return mean


def command_in_words(each: CommandResidual) -> str:
    """A command described by speed, direction and rate of turn; by its name if these are unknown."""
    return motion_in_words(each.name, each.run.v, each.run.alpha, each.run.omega)


def _in_words(residual: Array) -> str:
    x, y, turned = residual
    return f"{1e3 * math.hypot(x, y):.1f} mm, {math.degrees(turned):.2f}°".replace("-", "−")
