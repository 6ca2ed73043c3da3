"""Figures of the final residuals by command: on a map and over the direction for a flower of commands, else in rows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from omnibench.discover.report.before_after import BAND, NOISE, ModelStyle, legend
from omnibench.discover.report.command_map import command_in_words, command_maps, mean_of
from omnibench.discover.report.residuals import NORMAL_95, CommandResidual, Residuals
from omnibench.report.blocks import Block, Figure, FigureGrid, LegendItem, Paragraph
from omnibench.report.motions import MOST_MOTIONS, direction_of, motion_items, motion_of, moves
from omnibench.report.numbers import fixed
from omnibench.report.style import INK, QUIET, plot, text, wrapped
from omnibench.report.traces import area, coordinates, line, marks

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
