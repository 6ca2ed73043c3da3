"""Figures of a discovery: the evidence as bars, residuals by command, the error of the motion over each covariate.

The error of the motion, constant in each bin of a covariate, is fitted to the residuals (``Residuals.fit``). Motors
have measured wheel rates minus their targets instead, before and after the actuator effects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.discover.paths import slopes_by_delay
from omnibench.discover.report import tables
from omnibench.discover.report.residuals import NORMAL_95, Residuals, shares
from omnibench.discover.result import Discovery, Gap
from omnibench.fit.noise import grouped
from omnibench.registry import effects
from omnibench.report.blocks import Block, Choice, Figure, FigureGrid, LegendItem
from omnibench.report.figures import area, coordinates, joined, marks
from omnibench.report.numbers import direction_of, motion_in_words, motion_of, significant
from omnibench.report.style import INK, QUIET, plan, plot, text, wrapped
from omnibench.robot.effects.effect import ActuatorEffect
from omnibench.robot.kinematics import Array

PLAIN = LegendItem("before", "plain matrix (before)", "#d97706")
ALONE = LegendItem("before", "plain matrix", PLAIN.colour)
EXTENDED = LegendItem("after", "extended model (after)", "#0072b2")
_FLOOR = LegendItem("floor", "floor", "#8a8f98")
_CHOSEN, _UNCHOSEN = LegendItem("chosen", "added", EXTENDED.colour), LegendItem("other", "not added", "#b9c0c8")
_MEASURED = replace(PLAIN, label="measured − target")
_EXPECTED = replace(EXTENDED, label="measured − expected with the effects")
_CANDIDATES = 8  # shown of each step, at most; only the drawing hangs on it
_BINS = 12  # bins along an axis, and blocks of runs at most; only the drawing hangs on it
_LEAST = 0.002  # share of the samples; a bin with fewer, 2 % of its even part, is left out of the drawing
_STILL = 1e-3  # rad/s, m/s; slower counts as standing
_RUNS = 3  # runs in a block, at least: the fewest that have a scatter with more than one degree of freedom
_NAMED = 12  # commands, at most, that the caption names (chosen)
_START = 2.0  # s from the start of a run that are drawn: ten time constants of a motor of 0.2 s
_CELLS = 8  # cells of the floor along its longer side; only the drawing hangs on it
_VAGUE = 3.0  # usual half-widths of the band: a value within a wider one says nothing; only the drawing hangs on it
_HEIGHT = 270  # px
_SCALE = 6.0  # standard errors at the ends of a map's colours; only the drawing hangs on it
# Harmonics per turn, as in the bases of covariate dependence: by halves, then whole ones up to 16.
_HARMONICS = np.array((0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, *map(float, range(4, 17))))
_CIRCLE_95 = 2.448  # sqrt(-2 ln 0.05), standard deviations within which 95 % of a pair of normal numbers lie
_DEGREES = math.degrees(1.0)
_WAY = "% of the way"


@dataclass(frozen=True, eq=False)
class Curve:
    """One model's values (n,) over x (n,), NaN where unknown. half_width (n,): the 95 % band of chance."""

    style: LegendItem
    values: Array
    half_width: Array


@dataclass(frozen=True, eq=False)
class Panel:
    """The content of one plot: a quantity in a unit over x (n,).

    names: of the points, shown on hovering; no line joins these. ticks: distance between ticks of x. amplitude: values
    are never below 0.
    """

    title: str
    x: Array
    x_title: str
    unit: str
    curves: tuple[Curve, ...] = ()
    quantity: str = "error"
    names: tuple[str, ...] = ()
    ticks: float | None = None
    amplitude: bool = False


Styles = Sequence[LegendItem]  # of the plain matrix and of the extended model, or of the former alone
Part = tuple[Array, float, Panel]  # columns (S, 3, B) of a fit, factor from SI to the panel's unit, panel


def candidate_grid(discovery: Discovery) -> FigureGrid | None:
    """The chi-square difference of every effect that was tried, for each step."""
    added = [step.name.removeprefix("+ ") for step in discovery.steps[1:]]
    figures = []
    for number, tried in enumerate(discovery.candidates):
        shown = sorted((each for each in tried if each.chi_square > 0), key=lambda each: -each.chi_square)[:_CANDIDATES]
        chosen = next((each.name for each in shown if added[number : number + 1] == [each.name]), None)
        bars = [
            (
                each.name,
                each.chi_square,
                f"{tables.weight_in_words(each.weight)}, {each.degrees_of_freedom} df",
                _CHOSEN if each.name == chosen else _UNCHOSEN,
            )
            for each in shown
        ]
        if bars:
            title = f"Step {number + 1}: {chosen or 'nothing'} is added"
            figures.append(_bars(title, bars, "gain in whitened χ²", 1.55))
    caption = (
        f"By how much each candidate would lower the whitened χ² of the training runs, the {_CANDIDATES} largest; at "
        "the bars, the weight of the name and the degrees of freedom."
    )
    return FigureGrid(tuple(figures), (_CHOSEN, _UNCHOSEN), 2, caption) if figures else None


def error_grid(discovery: Discovery) -> FigureGrid:
    """Errors by the plain matrix, after each effect that was added, and their floor.

    On the held-out runs that are the hardest test, or on the training runs where none are held out.
    """
    held, steps = tables.decisive(discovery), discovery.steps[1:]
    gaps: tuple[Gap, ...] = (discovery.gap,)
    where = "training runs"
    if held is not None:
        gaps, where = (held.eq6, held.chi2), tables.held_out_runs(discovery, held)
    figures = []
    for gap in gaps:
        errors = [("plain matrix", gap.before, PLAIN if discovery.extends else ALONE)]
        for step in steps[:-1]:
            error = step.eq6_held_out if gap.metric == "eq6" else step.held_out
            if error is not None:  # else these runs are not those of the validation split
                errors.append((step.name, error, EXTENDED))
        errors += [("extended model", gap.after, EXTENDED)] if discovery.extends else []
        errors += [] if gap.floor is None else [("floor", gap.floor, _FLOOR)]
        bars = [(name, error, significant(error), item) for name, error, item in errors]
        title = tables.METRICS[gap.metric]
        figures.append(_bars(f"{title}, {where}", bars, title, 1.3))
    legend = (PLAIN, EXTENDED, _FLOOR) if discovery.extends else (ALONE, _FLOOR)
    return FigureGrid(tuple(figures), legend, 2, "The floor is what repetitions leave to any model.")


def _bars(title: str, bars: Sequence[tuple[str, float, str, LegendItem]], x_title: str, room: float) -> Figure:
    """Horizontal bars from the top down: name, length, label and item of the legend.

    room: width of the plot as a multiple of the longest bar, for the labels.
    """
    names = [text(wrapped(name, 20)) for name, *_ in bars]
    traces = [
        go.Bar(
            y=[name],
            x=coordinates([length]),
            orientation="h",
            marker={"color": item.colour},
            text=[label],
            textposition="outside",
            cliponaxis=False,
            textfont={"size": 12, "color": INK},
            legendgroup=item.key,
            hovertemplate="%{y}: %{text}<extra></extra>",
        )
        for name, (_, length, label, item) in zip(names, bars, strict=True)
    ]
    figure = plot(*traces, barmode="overlay", x_title=x_title)
    figure.update_xaxes(range=[0, room * max(length for _, length, *_ in bars)])
    figure.update_yaxes(ticks="", tickfont_color=INK, categoryorder="array", categoryarray=names[::-1])
    words = ", ".join(f"{name} {length:.4g} ({label})" for name, length, label, _ in bars)
    return Figure(title, figure, f"{title}, {x_title}: {words}", 80 + 34 * len(bars))


def residual_blocks(discovery: Discovery) -> Iterator[Block]:
    """Final residuals by command, and a choice of covariates, those that the residuals depend on first."""
    residuals = Residuals(discovery)
    pairs = zip(discovery.before, discovery.after, strict=True)
    styles = (ALONE,) if all(np.array_equal(*pair) for pair in pairs) else (PLAIN, EXTENDED)
    yield from filter(None, [_command_grid(residuals, styles)])
    drawn = {
        name: grid([panel for parts in made(residuals) for panel in fitted_panels(residuals, styles, parts)], styles)
        for name, made in _PARTS.items()
    }
    drawn |= {"place": _place_grid(residuals, styles), "wheel angle": _angle_grid(residuals, styles)}
    drawn["motors"] = motor_grid(discovery, residuals.runs)
    found = ("motors" if each.stage == "actuator" else each.covariate for each in discovery.where)
    options = {name: shown for name in dict.fromkeys((*found, *drawn)) if (shown := drawn.get(name)) is not None}
    if options:
        yield Choice("Residuals over", {name: (shown,) for name, shown in options.items()})


def _command_grid(residuals: Residuals, styles: Styles) -> FigureGrid | None:
    """Mean final residuals of every command, forward, to the left and in heading."""
    commands = sorted(residuals.commands, key=lambda each: (*motion_of(each.run)[::-1], direction_of(each.run)))
    names = tuple(motion_in_words(each.name, each.run.v, each.run.alpha, each.run.omega) for each in commands)
    panels = []
    for axis, (name, factor, unit) in enumerate(
        (("position, forward", 1e3, "mm"), ("position, to the left", 1e3, "mm"), ("heading", _DEGREES, "°"))
    ):
        means = np.array([factor * each.means[:, axis] for each in commands])
        errors = np.array([[factor * each.error[axis]] * 2 for each in commands])
        curves, x = _curves(styles, means, NORMAL_95 * errors), np.arange(1.0, len(commands) + 1)
        panels.append(Panel(f"Final {name}", x, "number of the command", unit, curves, "residual", names))
    listed = "; ".join(f"{number} {name}" for number, name in enumerate(names, 1))
    return grid(
        panels,
        styles,
        "Mean over the runs of each command, reference minus odometry, seen from the start pose; the band holds 95 % "
        "of what noise alone would do to it. Commands are numbered by rate of turn, speed and direction"
        + (f": {listed}." if len(names) <= _NAMED else ", and named where the mouse rests on them."),
    )


def _binned(values: Array, edges: Array, chosen: NDArray[np.bool_] | float = 1.0) -> tuple[Array, Array]:
    """Membership (F, B) of the chosen values (F,) in bins, and the middles (B,) of these.

    A bin with too few samples stays empty, so that nothing is fitted there, and so do all if fewer than three hold any.
    """
    bins = shares(values, edges) * np.reshape(chosen, (-1, 1))
    bins = bins * (bins.mean(axis=0) > _LEAST)
    return bins * (bins.any(axis=0).sum() >= 3), (edges[1:] + edges[:-1]) / 2


def _symmetric(values: Array) -> Array:
    """Edges of bins about zero that hold nearly all values."""
    top = float(np.quantile(np.abs(values), 0.997))
    return np.linspace(-top, top, _BINS + 1)


def _in_modes(residuals: Residuals, bins: Array, x: Array, x_title: str = "", ticks: float | None = None) -> list[Part]:
    """Three parts: the error along the path, across it and in turning, constant in each of the bins (F, B) at x."""
    paths, signals = residuals.paths, residuals.paths.signals
    ahead, left, still = *signals.twists[:, :2].T, np.zeros(len(bins))
    moving = (np.abs(signals.rates) > _STILL).any(axis=1).astype(float)
    return [
        (paths.of_twist(paths.tracked(np.column_stack(direction)), bins), factor, replace(panel, ticks=ticks))
        for direction, factor, panel in (
            ((ahead, left, still), 100.0, Panel("Error along the way", x, x_title, _WAY)),
            ((-left, ahead, still), 100.0, Panel("Error across the way, to the left", x, x_title, _WAY)),
            ((still, still, moving), _DEGREES, Panel("Error in turning, to the left", x, x_title, "°/s")),
        )
    ]


def _elapsed(residuals: Residuals) -> Iterator[list[Part]]:
    elapsed = residuals.paths.signals.elapsed
    bins, x = _binned(elapsed, np.linspace(0.0, float(elapsed.max()), _BINS + 1))
    yield _in_modes(residuals, bins, x, "time since the start of a run (s)")


def _heading(residuals: Residuals) -> Iterator[list[Part]]:
    """Over the robot's heading and over its direction of travel, both in the reference's frame."""
    twists, heading = residuals.paths.signals.twists, residuals.paths.middle[:, 2]
    moving = np.hypot(twists[:, 0], twists[:, 1]) > _STILL
    course = np.where(moving, heading + np.arctan2(twists[:, 1], twists[:, 0]), np.nan)
    for angle, title in ((heading, "heading (°)"), (course, "direction of travel (°)")):
        bins, x = _binned((np.degrees(angle) + 180) % 360 - 180, np.linspace(-180, 180, _BINS + 1))
        yield _in_modes(residuals, bins, x, title, ticks=90)


def _blocks(runs: Sequence[Trajectory]) -> tuple[Array, Array]:
    """Membership (Z, B) of the runs in blocks of successive ones of a session, and the middles (B,) of these."""
    blocks: list[Array] = []
    for session in grouped([run.session for run in runs]):
        number = min(len(session) // _RUNS, math.ceil(_BINS * len(session) / len(runs)))
        blocks += np.array_split(np.array(session, dtype=float), max(1, number))
    members = np.array([np.isin(np.arange(len(runs)), block) for block in blocks], dtype=float)
    return members.T, np.array([block.mean() + 1 for block in blocks])


def _order(residuals: Residuals) -> Iterator[list[Part]]:
    members, x = _blocks(residuals.runs)
    known = all(run.started_at is not None for run in residuals.runs)
    if len(x) > 1 and (known or len({run.session for run in residuals.runs}) > 1):
        yield _in_modes(residuals, members[residuals.paths.owner], x, "run, in the order driven")


def _rate(residuals: Residuals) -> Iterator[list[Part]]:
    """The error of each wheel's rim speed over its rate."""
    paths, parts = residuals.paths, list[Part]()
    for index, wheel in enumerate(paths.robot.measured):
        rates = paths.signals.rates[:, index]
        bins, x = _binned(rates, _symmetric(rates), np.abs(rates) > _STILL)
        panel = Panel(f"Wheel {wheel.name}", x, "wheel rate (rad/s)", "mm/s at the rim")
        parts.append((paths.of_wheel(index, bins), 1e3 * wheel.radius, panel))
    yield parts


def _acceleration(residuals: Residuals) -> Iterator[list[Part]]:
    """The error of each component of the twist over its own acceleration."""
    paths, parts = residuals.paths, list[Part]()
    for axis, title in enumerate(("Forward", "To the left", "In turning")):
        factor, unit = (_DEGREES, "°/s") if axis == 2 else (1e3, "mm/s")
        accelerations = factor * paths.signals.accelerations[:, axis]
        bins, x = _binned(accelerations, _symmetric(accelerations), np.abs(accelerations) > factor * _STILL)
        columns = paths.of_twist(np.tile(np.eye(3)[axis], (len(bins), 1)), bins)
        parts.append((columns, factor, Panel(title, x, f"acceleration ({unit}²)", unit)))
    yield parts


def _stamps(residuals: Residuals) -> Iterator[list[Part]]:
    """By how much earlier than its stamp a pose would have to be taken, over the time of a run and over the runs."""
    paths, slopes = residuals.paths, slopes_by_delay(residuals.paths)
    if np.abs(slopes).max() > 1e-6:  # else nothing moves
        members, middles = _blocks(residuals.runs)
        over_time = *_binned(paths.stamps, np.linspace(0.0, float(paths.stamps.max()), 2 * _BINS + 1)), "stamp (s)"
        for bins, x, x_title in (over_time, (members[paths.run], middles, "run, in the order driven")):
            panel = Panel("Delay of the reference", x, x_title, "ms", quantity="delay")
            yield [(slopes * bins[:, None, :], 1e3, panel)]


# What is fitted over each covariate, each list by itself: one that is added here is drawn.
_PARTS: Mapping[str, Callable[[Residuals], Iterator[list[Part]]]] = {
    "elapsed time": _elapsed,
    "heading": _heading,
    "order of runs": _order,
    "wheel rate": _rate,
    "acceleration": _acceleration,
    "stamps": _stamps,
}


def _angle_grid(residuals: Residuals, styles: Styles) -> FigureGrid | None:
    """The amplitude of every harmonic of each wheel's angle; each is fitted by itself, for all wheels together."""
    paths = residuals.paths
    angles, rates = paths.signals.wheel_angles, paths.signals.rates
    if angles is None or np.abs(rates).max() < _STILL:
        return None
    wheels = rates.shape[1]
    amplitudes, noise = np.full((2, wheels, len(_HARMONICS), 2), np.nan)
    for index, harmonic in enumerate(_HARMONICS):
        waves = np.stack([np.cos(harmonic * angles), np.sin(harmonic * angles)], axis=2) * rates[:, :, None]
        fitted = residuals.fit(np.concatenate([paths.of_wheel(n, waves[:, n]) for n in range(wheels)], axis=2))
        amplitudes[:, index] = 100 * np.hypot(*np.moveaxis(fitted.values.reshape(wheels, 2, 2), 1, 0))
        noise[:, index] = 100 * np.sqrt(np.square(fitted.errors.reshape(wheels, 2, 2)).mean(axis=1))
    looks = Panel("", _HARMONICS, "periods in a turn of the wheel", "% of the rate", (), "amplitude", amplitude=True)
    panels = [
        replace(looks, title=f"Wheel {name}", curves=_curves(styles, size, _CIRCLE_95 * error))
        for name, size, error in zip(paths.robot.wheel_names, amplitudes, noise, strict=True)
    ]
    return grid(panels, styles)


def _place_grid(residuals: Residuals, styles: Styles) -> FigureGrid | None:
    """Maps of the error of the motion over the floor; None where too little of it was driven on."""
    points = residuals.paths.middle[:, :2]
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    side = max(float(extent.max()) / _CELLS, 1e-9)
    cells = np.minimum((points - low) / side, np.maximum(np.ceil(extent / side - 1e-9) - 1, 0)).astype(int)
    shape = cells.max(axis=0) + 1
    bins, numbers = _binned((cells @ [shape[1], 1]).astype(float), np.arange(np.prod(shape) + 1.0))
    x, y = (coordinates(start + side * (np.arange(n) + 0.5)) for start, n in zip(low, shape, strict=True))
    figures = []
    for panel in fitted_panels(residuals, styles, _in_modes(residuals, bins, numbers)):
        for curve in panel.curves:
            scores = NORMAL_95 * curve.values / curve.half_width
            if np.isnan(scores).all():
                return None
            sizes = zip(curve.values, curve.half_width, strict=True)
            words = np.array([f"{value:.3g} ± {half:.2g} {panel.unit}" for value, half in sizes])
            heat = go.Heatmap(
                x=x,
                y=y,
                z=[coordinates(row) for row in scores.reshape(shape).T],
                zmin=-_SCALE,
                zmax=_SCALE,
                colorscale=[[0.0, EXTENDED.colour], [0.5, "#f3f4f6"], [1.0, PLAIN.colour]],
                colorbar={"thickness": 10, "outlinewidth": 0, "len": 0.8},
                text=words.reshape(shape).T.tolist(),
                hovertemplate="%{text}<extra></extra>",
                hoverongaps=False,
            )
            drawn = plan(heat).update_layout(xaxis_constrain="domain", yaxis_constrain="domain")
            title = f"{panel.title}, {curve.style.label}"
            figures.append(Figure(title, drawn, f"{title}, over the floor", _HEIGHT))
    caption = "In standard errors of what comes out by chance, which exceeds ±2 once in 20 times; white: not known."
    return FigureGrid(tuple(figures), (), 2 if len(styles) == 2 else 3, caption)


def motor_grid(discovery: Discovery, runs: Sequence[Trajectory]) -> FigureGrid | None:
    """Errors of the wheel rates over the target rate and at the start of the runs; None without targets."""
    driven = [(run, run.targets) for run in runs if run.targets is not None]
    before: list[Array] = [run.rates - targets for run, targets in driven]
    if not any(np.abs(each).max() > 0 for each in before):
        return None
    styles, after = [_MEASURED], [each.copy() for each in before]
    for named in (each for each in discovery.effects if each.stage == "actuator"):
        effect, values = effects.create(named.name), {each.name: each.value for each in named.parameters}
        assert isinstance(effect, ActuatorEffect)
        styles[1:] = [_EXPECTED]
        for own, (run, targets) in zip(after, driven, strict=True):  # changes by several add up
            own -= effect.driven(np.diff(run.times, prepend=0.0), targets, values) - targets
    top = _symmetric(np.concatenate([targets.ravel() for _, targets in driven]))
    duration = min(_START, max(float(run.times[-1]) for run, _ in driven))
    panels = []
    for edges, x_title, unit in (
        (top, "target rate (rad/s)", "rad/s"),
        (np.linspace(0.0, duration, _BINS + 1), "time since the start (s)", "% of the target"),
    ):
        for index, wheel in enumerate(discovery.dataset.robot.measured):
            # Means (2, Z, B) by model, run and bin; over the time in the direction of the targets, as shares of these
            means = np.full((2, len(driven), _BINS), np.nan)
            for row, (run, targets) in enumerate(driven):
                target = targets[:, index]
                moving = np.abs(target) > _STILL
                bins = shares(target if edges is top else run.times, edges) * moving[:, None]
                size, sign = (moving, 1.0) if edges is top else (np.abs(target) / 100, np.sign(target))
                for number, errors in enumerate((before[row], after[row])):
                    sums, sizes = bins.T @ (sign * errors[:, index]), bins.T @ size
                    np.divide(sums, sizes, out=means[number, row], where=sizes > 0)
            known = np.ma.masked_invalid(means)
            spread = known.std(axis=1, ddof=1).filled(np.nan) / np.sqrt(np.maximum(known.count(axis=1), 1))
            curves = _curves(styles, known.mean(axis=1).filled(np.nan).T, NORMAL_95 * spread.T)
            middles = (edges[1:] + edges[:-1]) / 2
            panels.append(Panel(f"Wheel {wheel.name}", middles, x_title, unit, curves, "difference"))
    return grid(panels, styles, "Mean over the runs, with bands for 95 % of what their scatter does to it.")


def _curves(styles: Styles, values: Array, half_widths: Array) -> tuple[Curve, ...]:
    """Curves of the models of these styles. values, half_widths (n, 2): before and after."""
    return tuple(map(Curve, styles, values.T, half_widths.T))


def fitted_panels(residuals: Residuals, styles: Styles, parts: Sequence[Part]) -> list[Panel]:
    """Panels with the curves of one fit of all their columns together."""
    fitted = residuals.fit(np.concatenate([columns for columns, _, _ in parts], axis=2))
    panels, first = [], 0
    for columns, factor, panel in parts:
        part = slice(first, first + columns.shape[2])
        curves = _curves(styles, factor * fitted.values[part], NORMAL_95 * factor * fitted.errors[part])
        panels.append(replace(panel, curves=curves))
        first = part.stop
    return panels


def grid(panels: Sequence[Panel], styles: Styles, caption: str = "") -> FigureGrid | None:
    """Panels on which the data say something, side by side, those of the same unit on one scale; None without any."""
    shown = [panel for panel in panels if any(np.isfinite(curve.half_width).any() for curve in panel.curves)]
    reaches: dict[str, float] = {}
    for panel in shown:
        reaches[panel.unit] = max(reaches.get(panel.unit, 0.0), 1.1 * _reach(panel))
    figures = []
    for panel in shown:
        words = f"{panel.title}: {panel.quantity} in {panel.unit} against {panel.x_title}"
        figures.append(Figure(panel.title, _plot(panel, reaches[panel.unit] or 1.0), words, _HEIGHT))
    if not figures:
        return None
    return FigureGrid(tuple(figures), tuple(styles), 2 if len(figures) in (1, 2, 4, 8) else 3, caption)


def _reach(panel: Panel) -> float:
    """The largest value to be shown: a bin with few samples, with its wide band, must not flatten all curves."""
    reach = [0.0]
    for curve in panel.curves:
        if np.isfinite(curve.half_width).any():
            usual, size = np.nanquantile(curve.half_width, 0.75), np.abs(curve.values)
            vague = (curve.half_width > _VAGUE * usual) & (size <= curve.half_width)
            reach += [float(1.3 * usual), float(np.nanmax(size[~vague], initial=0.0))]
    return max(reach)


def _plot(panel: Panel, reach: float) -> go.Figure:
    traces = [_band(panel, curve) for curve in panel.curves]
    for curve in panel.curves:
        hover = f"{text(curve.style.label)}<br>%{{text}} %{{y:.3g}} {panel.unit}"
        looks = {"mode": "lines+markers", "line_color": curve.style.colour, "line_width": 2}
        looks = {} if panel.names or panel.amplitude else looks
        names = panel.names or ("",) * len(panel.x)
        traces.append(marks(curve.style, 6, panel.x, curve.values, hover=hover, words=names, **looks))
    y_axis = {"range": [0 if panel.amplitude else -reach, reach], "zeroline": True, "zerolinecolor": QUIET}
    figure = plot(*traces, x_title=panel.x_title, y_title=f"{panel.quantity} ({panel.unit})", yaxis=y_axis)
    return figure.update_layout(xaxis_dtick=panel.ticks)


def _band(panel: Panel, curve: Curve) -> go.Scatter:
    """The band of chance about zero, in a pale shade of the curve's colour."""
    outlines = []
    known = np.isfinite(curve.half_width)
    margin = 0.015 * float(np.ptp(panel.x))
    for piece in np.split(np.arange(len(known)), np.flatnonzero(np.diff(known.astype(int))) + 1):
        if known[piece[0]]:
            at, half = panel.x[piece], curve.half_width[piece]
            if len(piece) == 1:  # a bin between empty ones
                at, half = at + np.array([-margin, margin]), np.repeat(half, 2)
            low = 0 * half if panel.amplitude else -half
            outlines.append(np.column_stack([np.append(at, at[::-1]), np.append(half, low[::-1])]))
    red, green, blue = (int(curve.style.colour[index : index + 2], 16) for index in (1, 3, 5))
    return area(curve.style.key, f"rgba({red},{green},{blue},0.16)", *joined(outlines).T)
