"""Figures of the evidence: candidates of each step, errors after each step, gaps, effects that may still hide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import plotly.graph_objects as go

from omnibench.discover.report import residuals as fits
from omnibench.discover.report import tables
from omnibench.discover.result import Discovery, Gap, Hidden, Step
from omnibench.report import numbers
from omnibench.report.blocks import Block, Figure, FigureGrid, LegendItem, Paragraph
from omnibench.report.figures import ORIGIN, area, arrows, coordinates, joined, line, marks
from omnibench.report.style import INK, QUIET, logarithmic, plan, plot, text, wrapped
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_NAME = 20  # characters of a line of an effect's name
_CANDIDATES = 8  # shown of each step, at most; only the drawing hangs on it
_CHOSEN, _UNCHOSEN = LegendItem("chosen", "added", fits.AFTER), LegendItem("other", "not added", "#b9c0c8")
_FLOOR = LegendItem("floor", "floor", fits.FLOOR)
_FLOOR_LINE = LegendItem("floor", "floor", fits.FLOOR, "dash")
_GAINED = LegendItem("down", "gained by an effect", "#7fb8d8")
_LOST = LegendItem("up", "lost by an effect", "#e3a3a3")
_RESULT = LegendItem("after", "extended model", fits.AFTER)
_LIMIT = LegendItem("limit", "dot: could be this large (95 %)", fits.AFTER)
_DETECTABLE = LegendItem("detectable", "diamond: found nearly always from here on", INK, symbol="diamond-open")


def candidate_grid(discovery: Discovery) -> FigureGrid | None:
    """The chi-square difference of every effect that was tried, for each step."""
    found = {effect.name for effect in discovery.effects}
    figures = []
    for number, tried in enumerate(discovery.candidates, 1):
        shown = sorted((each for each in tried if each.chi_square > 0), key=lambda each: -each.chi_square)[:_CANDIDATES]
        if not shown:
            continue
        step = tables.added(discovery.steps[number]) if number < len(discovery.steps) else None
        chosen = next((each.name for each in shown if each.name in found and each.name == step), None)
        title = f"Step {number}: {f'{chosen} is added' if chosen else 'nothing is added'}"
        bars = [
            _Bar(
                wrapped(each.name, _NAME),
                0.0,
                each.chi_square,
                f"{tables.weight_in_words(each.weight)}, {each.degrees_of_freedom} df",
                _CHOSEN if each.name == chosen else _UNCHOSEN,
            )
            for each in shown
        ]
        figures.append(
            Figure(
                title,
                _bars(bars, "gain in whitened χ²", 1.55),
                "Fall of the whitened chi2 with each candidate: "
                + ", ".join(
                    f"{each.name} {each.chi_square:.3g}, weight {tables.weight_in_words(each.weight)}" for each in shown
                ),
                80 + 34 * len(shown),
            )
        )
    if not figures:
        return None
    return FigureGrid(
        tuple(figures),
        (_CHOSEN, _UNCHOSEN),
        2 if len(figures) > 1 else 1,
        "By how much each candidate would lower the whitened χ² of the training runs, the "
        f"{_CANDIDATES} largest; at the bars, the weight of the name and the degrees of freedom.",
    )


@dataclass(frozen=True)
class _Bar:
    """A horizontal bar from low to high with its label, and its item of the legend."""

    name: str
    low: float
    high: float
    label: str
    item: LegendItem


def _bars(bars: Sequence[_Bar], x_title: str, room: float) -> go.Figure:
    """A plot of bars from the top down. room: width of the plot as a multiple of the longest bar, for the labels."""
    traces = []
    for item in dict.fromkeys(bar.item for bar in bars):
        own = [bar for bar in bars if bar.item == item]
        traces.append(
            go.Bar(
                y=[text(bar.name) for bar in own],
                x=coordinates([bar.high - bar.low for bar in own]),
                base=coordinates([bar.low for bar in own]),
                orientation="h",
                marker={"color": item.colour},
                text=[bar.label for bar in own],
                textposition="outside",
                cliponaxis=False,
                textfont={"size": 12, "color": INK},
                legendgroup=item.key,
                hovertemplate="%{y}: %{text}<extra></extra>",
            )
        )
    figure = plot(*traces, barmode="overlay", x_title=x_title)
    figure.update_xaxes(range=[0, room * max(bar.high for bar in bars)])
    figure.update_yaxes(
        ticks="", tickfont_color=INK, categoryorder="array", categoryarray=[text(bar.name) for bar in reversed(bars)]
    )
    return figure


def waterfall_grid(discovery: Discovery) -> FigureGrid | None:
    """The error after each step, down to the noise floor."""
    steps = discovery.steps
    if len(steps) < 2:
        return None
    held = tables.decisive(discovery)
    unseen = held is not None and all(step.eq6_held_out is not None and step.held_out is not None for step in steps)
    if unseen and held is not None:
        where = tables.held_out_in_words(discovery, held)
        after_each = [(step.eq6_held_out, step.held_out) for step in steps]
        floors: list[float | None] = [held.eq6.floor, held.chi2.floor]
    else:
        where, gap = "training runs", discovery.gap
        after_each = [(step.eq6_train, step.train) for step in steps]
        floors = [gap.floor if gap.metric == metric and not discovery.held_out else None for metric in tables.METRICS]
    values = [[value for value in own if value is not None] for own in zip(*after_each, strict=True)]
    figures = tuple(
        Figure(
            f"{title}, {where}",
            _waterfall(steps, own, floor, title),
            f"{title} of the plain matrix and after each effect that was added, {where}",
            110 + 44 * (len(steps) + 1),
        )
        for title, own, floor in zip(tables.METRICS.values(), values, floors, strict=True)
    )
    lost = (_LOST,) if any(after > before for own in values for before, after in pairwise(own)) else ()
    line = (_FLOOR_LINE,) if any(floor is not None for floor in floors) else ()
    return FigureGrid(figures, (fits.ALONE, _GAINED, *lost, _RESULT, *line), 2)


def _waterfall(steps: Sequence[Step], values: Sequence[float], floor: float | None, title: str) -> go.Figure:
    decimals = max(2, min(6, numbers.decimals_for(min(value for value in values if value > 0))))
    bars = [_Bar("plain matrix", 0.0, values[0], numbers.fixed(values[0], decimals), fits.ALONE)]
    for step, (before, after) in zip(steps[1:], pairwise(values), strict=True):
        item = _GAINED if after <= before else _LOST
        label = numbers.fixed(after - before, decimals, signed=True)
        bars.append(
            _Bar(wrapped(f"+ {tables.added(step)}", _NAME), min(before, after), max(before, after), label, item)
        )
    bars.append(_Bar("extended model", 0.0, values[-1], numbers.fixed(values[-1], decimals), _RESULT))
    figure = _bars(bars, title, 1.25)
    if floor is not None:
        figure.add_vline(x=floor, line={"color": fits.FLOOR, "width": 2, "dash": "dash"})
    return figure


def gap_grid(discovery: Discovery) -> FigureGrid:
    """Errors before and after and the noise floor, on the training runs and on the held-out runs."""
    gaps: list[tuple[str, Gap]] = []
    for held in discovery.held_out:
        where = tables.held_out_in_words(discovery, held)
        gaps += [(where, held.eq6), (where, held.chi2)]
    figures = []
    for name, gap in gaps or [("training runs", discovery.gap)]:
        metric, values = tables.METRICS[gap.metric], _gap_values(gap, discovery.extends)
        decimals = tables.gap_decimals(gap)
        bars = [_Bar(bar, 0.0, value, numbers.fixed(value, decimals), item) for bar, value, item in values]
        closed = f": {tables.closed_in_words(gap)}{'' if gap.closed is None else ' closed'}"
        title = f"{metric}, {name}{closed if discovery.extends else ''}"
        words = f"{metric} on {name}: " + ", ".join(f"{bar} {value:.4g}" for bar, value, _ in values)
        figures.append(Figure(title, _bars(bars, metric, 1.25), words, 190 if discovery.extends else 150))
    line = (_FLOOR,) if any(gap.floor is not None for _, gap in gaps or [("", discovery.gap)]) else ()
    return FigureGrid(
        tuple(figures),
        (*((fits.PLAIN, fits.EXTENDED) if discovery.extends else (fits.ALONE,)), *line),
        2 if len(figures) > 1 else 1,
        tables.floor_in_words(discovery),
    )


def _gap_values(gap: Gap, extends: bool) -> tuple[tuple[str, float, LegendItem], ...]:
    """Names, values and legend of the bars: the plain matrix alone and the floor where nothing was added."""
    floor = () if gap.floor is None else (("floor", gap.floor, _FLOOR),)
    if not extends:
        return ("plain matrix", gap.before, fits.ALONE), *floor
    return ("before", gap.before, fits.PLAIN), ("after", gap.after, fits.EXTENDED), *floor


def hidden_grid(hidden: Sequence[Hidden]) -> FigureGrid | None:
    """The largest size at which each effect could stay unseen, as a share of its plausible size."""
    shown = [each for each in reversed(tables.worst_of_each(hidden)) if each.plausible > 0 and each.limit > 0]
    if not shown:
        return None
    names = [wrapped(f"{each.name}: {each.parameter}") for each in shown]
    traces = []
    for item, values, words in (
        (_LIMIT, [each.limit for each in shown], "at most"),
        (_DETECTABLE, [each.detectable for each in shown], "found nearly always from"),
    ):
        shares = [100 * value / each.plausible for value, each in zip(values, shown, strict=True)]
        sizes = [
            f"{words} ±{tables.reading(each.unit).words(value, 2)}" for value, each in zip(values, shown, strict=True)
        ]
        traces.append(marks(item, 9, shares, names, hover="%{y}<br>%{text}", words=sizes, marker_line_width=1.5))
    figure = plot(*traces, x_title="% of the plausible range")
    shares = [100 * value / each.plausible for each in shown for value in (each.limit, each.detectable)]
    logarithmic(figure, "x", min([*shares, 50.0]), max([*shares, 200.0]))
    figure.add_vline(x=100, line={"color": QUIET, "width": 1.2, "dash": "dot"})
    figure.update_yaxes(ticks="", tickfont_color=INK, showgrid=True)
    return FigureGrid(
        (
            Figure(
                "What could still hide, as a share of what is plausible",
                figure,
                "For each effect that was not found, how large it could be unseen in per cent of its plausible range",
                90 + 34 * len(shown),
            ),
        ),
        (_LIMIT, _DETECTABLE),
        1,
        "Each effect is shown by the parameter that could be largest. The dotted line is the end of the plausible "
        "range, 100 %. Of an effect whose dot is left of it, the data tell more than what is plausible anyway; an "
        "effect whose dot is right of it could hide at a plausible size.",
    )


def command_maps(commands: Sequence[fits.CommandResidual], styles: Sequence[fits.ModelStyle]) -> FigureGrid:
    """The residual of each command as an arrow at its end, enlarged."""
    reach = float(np.median([np.hypot(*each.end[:2]) for each in commands]))
    sizes = [np.hypot(*each.means[style.index][:2]) for each in commands for style in styles]
    circle = fits.CIRCLE_95 * float(np.median([each.error[0] for each in commands]))
    # A step of 1, 2 or 5: the longest arrow is about a third of the way to the ends.
    factor = numbers.round_down(0.35 * reach / max(float(np.quantile(sizes, 0.95)), circle, 1e-6))
    tips = [each.end[:2] + factor * each.means[style.index][:2] for each in commands for style in styles]
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
    return FigureGrid(figures, fits.legend(styles), 2, caption)


def _map(commands: Sequence[fits.CommandResidual], style: fits.ModelStyle, factor: float, window: Array) -> go.Figure:
    turn = np.linspace(0, 2 * np.pi, 33)
    circle = fits.CIRCLE_95 * factor * np.column_stack([np.cos(turn), np.sin(turn)])
    circles = joined([each.end[:2] + each.error[0] * circle for each in commands])
    residuals = [each.means[style.index] for each in commands]
    words = [
        f"{command_in_words(each)}\n"
        + f"{1e3 * math.hypot(x, y):.1f} mm, {math.degrees(turned):.2f}°".replace("-", "−")
        + f"\n{plural(each.runs, 'run')}"
        for each, (x, y, turned) in zip(commands, residuals, strict=True)
    ]
    ends = np.array([each.end[:2] for each in commands])
    shafts, heads = arrows(style, ends, ends + factor * np.array(residuals)[:, :2], words)
    return plan(
        area(fits.NOISE.key, fits.BAND, *circles.T),
        shafts,
        marks(LegendItem("", "end", QUIET), 3, *ends.T, hover="%{text}", words=words),
        heads,
        marks(ORIGIN, 7, [0], [0], hover="start"),
        window=window,
    )


def command_in_words(each: fits.CommandResidual) -> str:
    """A command described by speed, direction and rate of turn; by its name if these are unknown."""
    return numbers.motion_in_words(each.name, each.run.v, each.run.alpha, each.run.omega)


_ROWS = 16  # commands listed, at most; only the drawing hangs on it
_ON_MAP = 200  # commands on the map, at most: beyond them circles hide each other; only the drawing hangs on it


def command_blocks(residuals: fits.Residuals, styles: Sequence[fits.ModelStyle]) -> tuple[Block, ...]:
    """Final residuals of every command, before and after."""
    commands = residuals.commands
    if _is_flower(commands):
        moving = [each for each in commands if math.hypot(*each.end[:2]) > 0.05]
        return (command_maps(moving, styles), *_headings_by_direction(commands, styles))
    return (_rows(commands, styles),)


def _is_flower(commands: Sequence[fits.CommandResidual]) -> bool:
    """True if the ends of the commands lie so far apart that residuals can be drawn at them."""
    if not 3 <= len(commands) <= _ON_MAP:
        return False
    ends = np.array([each.end[:2] for each in commands])
    apart = np.linalg.norm(ends[:, None] - ends[None], axis=2) + np.diag([np.inf] * len(ends))
    residual = np.median([np.hypot(*each.means[0, :2]) for each in commands])
    return bool(np.quantile(apart.min(axis=1), 0.2) > max(float(residual), 0.02))


def _headings_by_direction(
    commands: Sequence[fits.CommandResidual], styles: Sequence[fits.ModelStyle]
) -> tuple[Block, ...]:
    """Mean final heading residuals over the commanded direction, a colour for each rate of turn."""
    known = [each for each in commands if each.run.alpha is not None and each.run.omega is not None]
    moving = sorted(
        (each for each in known if numbers.moves(each.run)), key=lambda each: numbers.direction_of(each.run)
    )
    still = [each for each in known if each.run.v == 0]
    motions = sorted({numbers.motion_of(each.run) for each in moving})
    distinct = {(numbers.direction_of(each.run), *numbers.motion_of(each.run)) for each in moving}
    directions = {direction for direction, *_ in distinct}
    if len(motions) > numbers.MOST_MOTIONS or len(distinct) < len(moving) or len(directions) < 3:
        return (_rows(commands, styles),)
    items = numbers.motion_items(motions)
    curves = [
        (item, [each for each in moving if numbers.motion_of(each.run) == motion])
        for motion, item in zip(motions, items, strict=True)
    ]
    half = math.degrees(fits.NORMAL_95 * float(np.median([each.error[2] for each in moving])))
    low, high = min(directions) - 10, max(directions) + 10
    panels, reach = [], 1.4 * half
    for style in styles:
        traces = [area(fits.NOISE.key, fits.BAND, [low, high, high, low], [half, half, -half, -half])]
        for item, own in curves:
            values = np.degrees([each.means[style.index][2] for each in own])
            reach = max(reach, 1.1 * float(np.abs(values).max()))
            x, words = [numbers.direction_of(each.run) for each in own], [command_in_words(each) for each in own]
            traces.append(line(item, 2.0, x, values, hover="%{text}<br>%{y:.3f}°", words=words, mode="lines+markers"))
        panels.append(plot(*traces, x_title="commanded direction α (°)", y_title="heading residual (°)"))
    figures = []
    for style, figure in zip(styles, panels, strict=True):
        figure.update_xaxes(range=[low, high], dtick=60)
        figure.add_hline(y=0, line={"color": QUIET, "width": 1})
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
        tuple(figures), (*items, fits.NOISE), 2,
        "Mean over the runs of each command; the band holds 95 % of what noise alone would do.",
    )  # fmt: skip
    if not still:
        return (grid,)
    parts = []
    for each in sorted(still, key=lambda each: numbers.motion_of(each.run)):
        turns = " → ".join(
            f"{numbers.fixed(math.degrees(each.means[style.index][2]), 2, signed=True)}°" for style in styles
        )
        noise = numbers.fixed(math.degrees(fits.NORMAL_95 * each.error[2]), 2)
        parts.append(f"{command_in_words(each)}: {turns} (noise ±{noise}°)")
    return grid, Paragraph(f"Turns on the spot, mean heading residual: {'; '.join(parts)}.", "note")


def _rows(commands: Sequence[fits.CommandResidual], styles: Sequence[fits.ModelStyle]) -> FigureGrid:
    """One row for each command; if there are many, the 16 with the largest residuals."""
    shown = sorted(commands, key=lambda each: -float(np.abs(each.means[0] / each.error).max()))[:_ROWS]
    shown = [each for each in commands if each in shown]
    figures = []
    for axis, (name, factor, unit) in enumerate(
        (("forward", 1e3, "mm"), ("to the left", 1e3, "mm"), ("heading", math.degrees(1.0), "°"))
    ):
        names = [wrapped(each.name) for each in shown]
        half = fits.NORMAL_95 * factor * np.array([each.error[axis] for each in shown])
        traces: list[go.Bar | go.Scatter] = [
            go.Bar(
                y=[text(name) for name in names],
                x=coordinates(2 * half),
                base=coordinates(-half),
                orientation="h",
                marker={"color": "#d9dde2", "line": {"width": 0}},
                width=0.6,
                legendgroup=fits.NOISE.key,
                hovertemplate="noise ±%{customdata:.3g} " + unit + "<extra></extra>",
                customdata=coordinates(half),
            )
        ]
        for style in styles:
            values = factor * np.array([each.means[style.index][axis] for each in shown])
            traces.append(marks(style, 9, values, names, hover=f"{text(style.label)}: %{{x:.3g}} {unit}"))
        figure = plot(*traces, x_title=f"residual ({unit})")
        figure.update_yaxes(autorange="reversed", ticks="", tickfont_color=INK)
        figure.add_vline(x=0, line={"color": QUIET, "width": 1})
        figures.append(
            Figure(
                f"Final residual {name}" if axis < 2 else "Final heading residual",
                figure,
                f"Mean final residual of each command, {name}, in {unit}",
                90 + 30 * len(shown),
            )
        )
    words = f"The {len(shown)} commands of {len(commands)} with the largest residuals for their noise. "
    caption = (
        f"{words if len(shown) < len(commands) else ''}Mean over the runs of each command, seen from its start pose; "
        "grey bars hold 95 % of what noise alone would do to that mean."
    )
    return FigureGrid(
        tuple(figures), fits.legend(styles), 3 if max(len(each.name) for each in shown) < 14 else 1, caption
    )
