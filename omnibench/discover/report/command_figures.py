"""Figures of the final residuals by command: on a map and over the direction for a flower of commands, else in rows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from omnibench.discover.report.before_after import BAND, NOISE, ModelStyle, legend
from omnibench.discover.report.residuals import CIRCLE_95, NORMAL_95, CommandResidual, Residuals
from omnibench.report.blocks import Block, Figure, FigureGrid, LegendItem, Paragraph
from omnibench.report.numbers import (
    MOST_MOTIONS,
    direction_of,
    fixed,
    motion_in_words,
    motion_items,
    motion_of,
    moves,
    round_down,
)
from omnibench.report.style import INK, QUIET, plan, plot, text, wrapped
from omnibench.report.traces import ORIGIN, area, arrows, coordinates, joined, line, marks
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


_ROWS = 16  # commands listed, at most; only the drawing hangs on it
_ON_MAP = 200  # commands on the map, at most: beyond them circles hide each other; only the drawing hangs on it


def command_blocks(residuals: Residuals, styles: Sequence[ModelStyle]) -> tuple[Block, ...]:
    """Final residuals of every command, before and after."""
    commands = residuals.commands
    if _is_flower(commands):
        moving = [each for each in commands if math.hypot(*each.end[:2]) > 0.05]
        return (command_maps(moving, styles), *_headings_by_direction(commands, styles))
    return (_rows(commands, styles),)


def _is_flower(commands: Sequence[CommandResidual]) -> bool:
    """True if the ends of the commands lie so far apart that residuals can be drawn at them."""
    if not 3 <= len(commands) <= _ON_MAP:
        return False
    ends = np.array([each.end[:2] for each in commands])
    apart = np.linalg.norm(ends[:, None] - ends[None], axis=2) + np.diag([np.inf] * len(ends))
    residual = np.median([np.hypot(*each.means[0, :2]) for each in commands])
    return bool(np.quantile(apart.min(axis=1), 0.2) > max(float(residual), 0.02))


def _headings_by_direction(commands: Sequence[CommandResidual], styles: Sequence[ModelStyle]) -> tuple[Block, ...]:
    """Mean final heading residuals over the commanded direction, a colour for each rate of turn."""
    known = [each for each in commands if each.run.alpha is not None and each.run.omega is not None]
    moving = sorted((each for each in known if moves(each.run)), key=lambda each: direction_of(each.run))
    still = [each for each in known if each.run.v == 0]
    motions = sorted({motion_of(each.run) for each in moving})
    distinct = {(direction_of(each.run), *motion_of(each.run)) for each in moving}
    directions = {direction for direction, *_ in distinct}
    if len(motions) > MOST_MOTIONS or len(distinct) < len(moving) or len(directions) < 3:
        return (_rows(commands, styles),)
    items = motion_items(motions)
    curves = [
        (item, [each for each in moving if motion_of(each.run) == motion])
        for motion, item in zip(motions, items, strict=True)
    ]
    panels = [_heading_plot(curves, style, moving) for style in styles]
    reach = max(panel[1] for panel in panels)
    figures = []
    for style, (figure, _) in zip(styles, panels, strict=True):
        figure.update_yaxes(range=[-reach, reach])
        figures.append(
            Figure(
                f"Final heading residuals, {style.label}",
                figure,
                f"Mean final heading residual in degrees over the commanded direction, {style.label}",
                300,
            )
        )
    grid = FigureGrid(
        tuple(figures), (*items, NOISE), 2,
        "Mean over the runs of each command; the band holds 95 % of what noise alone would do.",
    )  # fmt: skip
    return (grid, *_turns_on_the_spot(still, styles))


def _heading_plot(
    curves: Sequence[tuple[LegendItem, Sequence[CommandResidual]]],
    style: ModelStyle,
    commands: Sequence[CommandResidual],
) -> tuple[go.Figure, float]:
    half = math.degrees(NORMAL_95 * float(np.median([each.error[2] for each in commands])))
    ends = [direction_of(each.run) for each in commands]
    low, high = min(ends) - 10, max(ends) + 10
    traces = [area(NOISE.key, BAND, [low, high, high, low], [half, half, -half, -half])]
    reach = 1.4 * half
    for item, own in curves:
        values = np.degrees([mean_of(each, style)[2] for each in own])
        reach = max(reach, 1.1 * float(np.abs(values).max()))
        x, words = [direction_of(each.run) for each in own], [command_in_words(each) for each in own]
        traces.append(line(item, 2.0, x, values, hover="%{text}<br>%{y:.3f}°", words=words, mode="lines+markers"))
    figure = plot(*traces, x_title="commanded direction α (°)", y_title="heading residual (°)")
    figure.update_xaxes(range=[low, high], dtick=60)
    figure.add_hline(y=0, line={"color": QUIET, "width": 1})
    return figure, reach


def _turns_on_the_spot(still: Sequence[CommandResidual], styles: Sequence[ModelStyle]) -> tuple[Block, ...]:
    if not still:
        return ()
    parts = []
    for each in sorted(still, key=lambda each: motion_of(each.run)):
        values = " → ".join(f"{fixed(math.degrees(mean_of(each, style)[2]), 2, signed=True)}°" for style in styles)
        noise = fixed(math.degrees(NORMAL_95 * each.error[2]), 2)
        parts.append(f"{command_in_words(each)}: {values} (noise ±{noise}°)")
    return (Paragraph(f"Turns on the spot, mean heading residual: {'; '.join(parts)}.", "note"),)


def _rows(commands: Sequence[CommandResidual], styles: Sequence[ModelStyle]) -> FigureGrid:
    """One row for each command; if there are many, the 16 with the largest residuals."""
    shown = sorted(commands, key=lambda each: -float(np.abs(each.means[0] / each.error).max()))[:_ROWS]
    shown = [each for each in commands if each in shown]
    figures = []
    for axis, (name, factor, unit) in enumerate(
        (("forward", 1e3, "mm"), ("to the left", 1e3, "mm"), ("heading", math.degrees(1.0), "°"))
    ):
        figures.append(
            Figure(
                f"Final residual {name}" if axis < 2 else "Final heading residual",
                _row_plot(shown, styles, axis, factor, unit),
                f"Mean final residual of each command, {name}, in {unit}",
                90 + 30 * len(shown),
            )
        )
    words = f"The {len(shown)} commands of {len(commands)} with the largest residuals for their noise. "
    caption = (
        f"{words if len(shown) < len(commands) else ''}Mean over the runs of each command, seen from its start pose; "
        "grey bars hold 95 % of what noise alone would do to that mean."
    )
    return FigureGrid(tuple(figures), legend(styles), 3 if max(len(each.name) for each in shown) < 14 else 1, caption)


def _row_plot(
    commands: Sequence[CommandResidual], styles: Sequence[ModelStyle], axis: int, factor: float, unit: str
) -> go.Figure:
    names = [wrapped(each.name) for each in commands]
    half = NORMAL_95 * factor * np.array([each.error[axis] for each in commands])
    traces: list[go.Bar | go.Scatter] = [
        go.Bar(
            y=[text(name) for name in names],
            x=coordinates(2 * half),
            base=coordinates(-half),
            orientation="h",
            marker={"color": "#d9dde2", "line": {"width": 0}},
            width=0.6,
            legendgroup=NOISE.key,
            hovertemplate="noise ±%{customdata:.3g} " + unit + "<extra></extra>",
            customdata=coordinates(half),
        )
    ]
    for style in styles:
        values = factor * np.array([mean_of(each, style)[axis] for each in commands])
        traces.append(marks(style, 9, values, names, hover=f"{text(style.label)}: %{{x:.3g}} {unit}"))
    figure = plot(*traces, x_title=f"residual ({unit})")
    figure.update_yaxes(autorange="reversed", ticks="", tickfont_color=INK)
    figure.add_vline(x=0, line={"color": QUIET, "width": 1})
    return figure
