"""The section on where the plain model fails: covariates that the residuals depend on, and their figures.

Figures of the error of the motion over heading, wheel rate, wheel angle, acceleration, order of runs and stamps; of the
mean residuals over the time in a run; and over the floor, as arrows and as maps. The motors' figures are of measured
wheel rates minus their targets, before and after the actuator effects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.discover.report import residuals as residual
from omnibench.discover.report.evidence_figures import command_blocks
from omnibench.discover.report.tables import dependence_table
from omnibench.discover.result import Discovery, NamedEffect
from omnibench.registry import effects
from omnibench.report.blocks import Block, Details, Figure, FigureGrid, LegendItem, Paragraph, Section
from omnibench.report.figures import arrows, coordinates
from omnibench.report.numbers import fixed, listing, round_down
from omnibench.report.style import plan
from omnibench.robot.effects.effect import ActuatorEffect
from omnibench.robot.kinematics import Array, interpolated, rotated
from omnibench.words import plural

_BINS = 12  # bins along an axis; only the drawing hangs on it
_LEAST = 0.002  # share of the samples; a bin with fewer, 2 % of its even part, is left out of the drawing
_STILL = 1e-3  # rad/s, m/s; slower counts as standing
# Harmonics per turn, as in the bases of covariate dependence: by halves, then whole ones up to 16.
_HARMONICS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, *map(float, range(4, 17)))
# A figure over a covariate; None where the recordings do not show it.
CovariateFigure = Callable[[residual.Residuals, Sequence[residual.ModelStyle]], FigureGrid | None]
# Modes of the error of the motion: name, factor from SI, unit.
MODES = (
    ("along the way", 100.0, "% of the way"),
    ("across the way, to the left", 100.0, "% of the way"),
    ("in turning, to the left", math.degrees(1.0), "°/s"),
)


def motion_panels(
    residuals: residual.Residuals,
    styles: Sequence[residual.ModelStyle],
    bins: Array,
    x: Array,
    x_title: str,
    over: str,
    words: tuple[str, ...] = (),
    ticks: float | None = None,
) -> list[residual.Panel]:
    """Three panels: the error along the path, across it and in turning, constant in each bin.

    bins (F, B): the share of each sample in each bin. x (B,): the position at which a bin is drawn.
    """
    paths = residuals.paths
    twists = paths.signals.twists
    nothing = np.zeros(len(twists))
    moving = (np.abs(paths.signals.rates) > _STILL).any(axis=1).astype(float)
    directions = (
        np.column_stack([twists[:, :2], nothing]),
        np.column_stack([-twists[:, 1], twists[:, 0], nothing]),
        np.column_stack([nothing, nothing, moving]),
    )
    parts = []
    for direction, (name, factor, unit) in zip(directions, MODES, strict=True):
        title, y_title = f"Error {name}, over {over}", f"error ({unit})"
        panel = residual.Panel(title, x, (), x_title, y_title, unit, words=words, ticks=ticks)
        parts.append((paths.of_twist(paths.tracked(direction), bins), factor, panel))
    return residual.fitted_panels(residuals, styles, parts)


def heading_grid(residuals: residual.Residuals, styles: Sequence[residual.ModelStyle]) -> FigureGrid | None:
    """The error over the robot's heading and over its direction of travel, both in the frame of the reference."""
    paths = residuals.paths
    heading = paths.middle[:, 2]
    twists = paths.signals.twists
    moving = np.hypot(twists[:, 0], twists[:, 1]) > _STILL
    course = heading + np.arctan2(twists[:, 1], twists[:, 0])
    panels = []
    for angle, chosen, over, title in (
        (heading, np.ones_like(moving), "heading", "heading in the world (°)"),
        (course, moving, "course", "direction of travel in the world (°)"),
    ):
        wrapped = (np.degrees(angle) + 180) % 360 - 180
        edges = np.linspace(-180, 180, _BINS + 1)
        bins = _binned(wrapped, edges, chosen)
        if bins is not None:
            panels += motion_panels(residuals, styles, bins, _middles(edges), title, over, ticks=90)
    return residual.grid(panels, styles, "Heading and direction of travel are those of the reference's frame.")


def wheel_rate_grid(residuals: residual.Residuals, styles: Sequence[residual.ModelStyle]) -> FigureGrid | None:
    """The error of each wheel's rim speed over its rate."""
    paths = residuals.paths
    parts = []
    for index, wheel in enumerate(paths.robot.measured):
        rates = np.abs(paths.signals.rates[:, index])
        top = float(np.quantile(rates, 0.998))
        if top < _STILL:
            continue
        edges = np.linspace(-top * 1.001, top * 1.001, _BINS + 1)
        bins = _binned(paths.signals.rates[:, index], edges, rates > _STILL)
        if bins is not None:
            title = f"Wheel {wheel.name}"
            panel = residual.Panel(title, _middles(edges), (), "wheel rate (rad/s)", "error (mm/s at the rim)", "mm/s")
            parts.append((paths.of_wheel(index, bins), 1e3 * wheel.radius, panel))
    return residual.grid(residual.fitted_panels(residuals, styles, parts), styles)


def wheel_angle_grid(residuals: residual.Residuals, styles: Sequence[residual.ModelStyle]) -> FigureGrid | None:
    """The error over the angle of each wheel: amplitudes by harmonic, and its course over the strongest harmonic."""
    paths = residuals.paths
    angles, rates = paths.signals.wheel_angles, paths.signals.rates
    if angles is None or np.abs(rates).max() < _STILL:
        return None
    spectrum = _spectrum_panels(residuals, styles, angles)
    # The harmonic that stands out most in the plain model, over all wheels; 1 if none does
    ratios = np.array([np.nan_to_num(panel.curves[0].values / panel.curves[0].half_width) for panel in spectrum])
    together = np.square(ratios).mean(axis=0)
    strongest = float(_HARMONICS[int(together.argmax())]) if together.max() > 1 else 1.0
    times = "" if strongest == 1 else f"{strongest:g} × "
    edges = np.linspace(0, 360, _BINS + 1)
    parts = []
    for index, wheel in enumerate(paths.robot.measured):
        turned = np.degrees(strongest * angles[:, index]) % 360
        title, x_title = f"Wheel {wheel.name}, over its angle", f"{times}wheel angle (°)"
        panel = residual.Panel(title, _middles(edges), (), x_title, "error of the rate (%)", "%", ticks=90)
        parts.append((paths.of_wheel(index, residual.shares(turned, edges) * rates[:, [index]]), 100.0, panel))
    over = "the angle itself" if strongest == 1 else f"{strongest:g} times the angle, the harmonic that stands out most"
    caption = f"Top: the amplitude of each harmonic, fitted alone. Below: over {over}."
    return residual.grid([*spectrum, *residual.fitted_panels(residuals, styles, parts)], styles, caption)


def acceleration_grid(residuals: residual.Residuals, styles: Sequence[residual.ModelStyle]) -> FigureGrid | None:
    """The error of each component of the twist over its own acceleration."""
    paths = residuals.paths
    degrees = math.degrees(1.0)
    parts = []
    for axis, (title, factor, unit, x_factor, x_unit) in enumerate(
        (
            ("Forward", 1e3, "mm/s", 1.0, "m/s²"),
            ("To the left", 1e3, "mm/s", 1.0, "m/s²"),
            ("In turning", degrees, "°/s", degrees, "°/s²"),
        )
    ):
        accelerations = paths.signals.accelerations[:, axis]
        top = float(np.quantile(np.abs(accelerations), 0.995))
        if top < 1e-3:
            continue
        edges = np.linspace(-top, top, 10)
        bins = _binned(accelerations, edges, least=5e-4)
        if bins is not None:
            x_title, y_title = f"acceleration ({x_unit})", f"error ({unit})"
            panel = residual.Panel(title, x_factor * _middles(edges), (), x_title, y_title, unit)
            parts.append((paths.of_twist(np.tile(np.eye(3)[axis], (len(accelerations), 1)), bins), factor, panel))
    return residual.grid(residual.fitted_panels(residuals, styles, parts), styles)


def _spectrum_panels(
    residuals: residual.Residuals, styles: Sequence[residual.ModelStyle], angles: Array
) -> list[residual.Panel]:
    """The amplitude of every harmonic for each wheel; each harmonic is fitted by itself, for all wheels together."""
    paths = residuals.paths
    rates = paths.signals.rates
    wheels = rates.shape[1]
    amplitudes, noise = np.full((2, 2, wheels, len(_HARMONICS)), np.nan)
    for index, harmonic in enumerate(_HARMONICS):
        waves = (np.cos(harmonic * angles), np.sin(harmonic * angles))
        columns = [
            paths.of_wheel(wheel, np.column_stack([rates[:, wheel] * wave[:, wheel] for wave in waves]))
            for wheel in range(wheels)
        ]
        fitted = residuals.fit(np.concatenate(columns, axis=2))
        amplitudes[:, :, index] = np.hypot(*np.moveaxis(fitted.values.reshape(wheels, 2, 2), (1, 2), (0, 1)))
        noise[:, :, index] = np.sqrt(np.square(fitted.errors.reshape(wheels, 2, 2)).mean(axis=1)).T
    return [
        residual.Panel(
            f"Wheel {paths.robot.wheel_names[wheel]}, amplitudes",
            np.array(_HARMONICS),
            tuple(
                residual.Curve(
                    style, 100 * amplitudes[style.index][wheel], 100 * residual.CIRCLE_95 * noise[style.index][wheel]
                )
                for style in styles
            ),
            "periods in a turn of the wheel",
            "amplitude (% of the rate)",
            "% of the rate",
            lines=False,
            amplitude=True,
        )
        for wheel in range(wheels)
    ]


def _binned(
    values: Array, edges: Array, chosen: NDArray[np.bool_] | None = None, least: float = _LEAST
) -> Array | None:
    """Membership (F, B) of the chosen values (F,) in bins; None unless three or more bins hold some.

    least: share of the samples; a bin with fewer stays empty, so that nothing is fitted there.
    """
    bins = residual.shares(values, edges) * (1.0 if chosen is None else chosen[:, None])
    bins = bins * (bins.mean(axis=0) > least)
    return bins if bins.any(axis=0).sum() >= 3 else None


def _middles(edges: Array) -> Array:
    return (edges[1:] + edges[:-1]) / 2


_TIMES = 14  # times at which the mean residual is drawn; only the drawing hangs on it
_BLOCKS = 12  # blocks of runs, at most; only the drawing hangs on it
_RUNS = 3  # runs in a block, at least: the fewest that have a scatter with more than one degree of freedom
_STAMPS = 30  # bins of the stamps of a run; only the drawing hangs on it
_MOVING = 0.01  # m/s; slower counts as standing, and has no direction to be drawn along
_TURNING = math.radians(2.0)  # rad/s; slower counts as straight: a turn of 20 deg in 10 s; only the drawing hangs on it
_QUANTITIES = (("along the way", 1e3, "mm"), ("across, to the left", 1e3, "mm"), ("heading", math.degrees(1.0), "°"))


def elapsed_grid(residuals: residual.Residuals, styles: Sequence[residual.ModelStyle]) -> FigureGrid | None:
    """Mean residuals over the time of a run, for runs that turn left, right or not."""
    groups: dict[str, list[int]] = {}
    for index, run in enumerate(residuals.runs):
        groups.setdefault(_turning(run), []).append(index)
    panels = []
    for name in sorted(groups):
        members = groups[name]
        # Times until which at least half of the runs last
        stamps = [residuals.runs[index].pose_times for index in members]
        end = float(np.median([each[-1] for each in stamps]))
        times = np.linspace(min(float(np.median([each[1] for each in stamps])), end), end, _TIMES)
        means = {style.key: _means(residuals, members, style, times) for style in styles}
        half = residual.NORMAL_95 * residuals.deviations(times) / np.sqrt(_running(residuals, members, times))[:, None]
        for axis, (quantity, factor, unit) in enumerate(_QUANTITIES):
            band = factor * half[:, axis]
            curves = tuple(residual.Curve(style, factor * means[style.key][:, axis], band) for style in styles)
            panels.append(
                residual.Panel(
                    f"{name} ({plural(len(members), 'run')}): {quantity}",
                    times,
                    curves,
                    "time since the start of the run (s)",
                    f"mean residual ({unit})",
                    unit,
                    shared=True,
                )
            )
    return residual.grid(
        panels,
        styles,
        "Mean over runs of the pose residuals (reference minus odometry), along and across the direction of travel at "
        "that time; the band holds 95 % of what noise alone would do to the mean.",
    )


def order_grid(residuals: residual.Residuals, styles: Sequence[residual.ModelStyle]) -> FigureGrid | None:
    """The error of the motion over the runs in the order in which they were driven, in blocks of runs."""
    runs = residuals.runs
    if any(run.started_at is None for run in runs) and len({run.session for run in runs}) < 2:
        return None
    blocks = _blocks(runs)
    if len(blocks) < 2:
        return None
    paths = residuals.paths
    number = np.repeat(np.arange(len(blocks)), [len(block) for block in blocks])  # block of each run
    bins = (number[paths.owner][:, None] == np.arange(len(blocks))).astype(float)
    centres = np.array([np.mean(block) + 1 for block in blocks])
    words = tuple(_block_in_words([runs[index] for index in block]) for block in blocks)
    panels = motion_panels(residuals, styles, bins, centres, "run, in the order driven", "the runs", words)
    sessions = len({run.session for run in runs})
    several = f" The runs are of {sessions} sessions, one after another." if sessions > 1 else ""
    return residual.grid(panels, styles, f"Each point stands for some runs in a row.{several}")


def stamps_grid(residuals: residual.Residuals, styles: Sequence[residual.ModelStyle]) -> FigureGrid | None:
    """The time by which reference poses seem to be taken earlier than their stamps say."""
    paths = residuals.paths
    # Velocities (S, 3) of the poses at the paths' stamps, over 100 ms, m/s and rad/s
    found = []
    for log, path in zip(paths.logs, paths.ends, strict=True):
        times = np.concatenate([[0.0], log.times])
        late, early = (interpolated(log.stamps + shift, times, path) for shift in (0.05, -0.05))
        found.append((late - early) / 0.1)
    velocity = np.concatenate(found)
    if np.abs(velocity).max() < 1e-6:
        return None
    stamp_numbers = residuals.stamp_numbers
    width = max(1, math.ceil((int(stamp_numbers.max()) + 1) / _STAMPS))
    bins = (stamp_numbers // width)[:, None] == np.arange(int(stamp_numbers.max()) // width + 1)
    bins = bins[:, bins.mean(axis=0) > 1e-3]
    x = np.array([paths.stamps[chosen].mean() for chosen in bins.T])
    panels = []
    for name, part in (("pose", [1.0, 1.0, 1.0]), ("heading alone", [0.0, 0.0, 1.0])):
        title = f"Delay of the reference's {name}, over the stamps of a run"
        panel = residual.Panel(title, x, (), "stamp (s)", "apparent delay (ms)", "ms")
        columns = -(velocity * part)[:, :, None] * bins[:, None, :]
        panels += residual.fitted_panels(residuals, styles, [(columns, 1e3, panel)])
    panels.append(
        residual.Panel(
            "Delay of the reference's pose, run by run",
            np.arange(1.0, len(residuals.runs) + 1),
            residual.fitted_curves(residuals.fit_runs(-velocity[:, :, None]), styles, 1e3),
            "run, in the order driven",
            "apparent delay (ms)",
            "ms",
            lines=False,
            words=tuple(run.id for run in residuals.runs),
        )
    )
    return residual.grid(
        panels,
        styles,
        "By how much earlier than its stamp a pose would have to be taken to explain the residuals best.",
    )


def _turning(run: Trajectory) -> str:
    """The side to which a run turns, by its reference poses."""
    turned = run.poses[-1, 2] - run.poses[0, 2]
    if abs(turned) < max(_TURNING * float(run.pose_times[-1]), math.radians(3.0)):
        return "Runs that do not turn"
    return "Runs that turn left" if turned > 0 else "Runs that turn right"


def _running(residuals: residual.Residuals, members: Sequence[int], times: Array) -> Array:
    """The number of runs that have poses up to each time, at least 1."""
    ends = np.array([residuals.runs[index].pose_times[-1] for index in members])
    return np.maximum((ends[:, None] >= times - 1e-6).sum(axis=0), 1)


def _means(residuals: residual.Residuals, members: Sequence[int], style: residual.ModelStyle, times: Array) -> Array:
    """Mean residuals (T, 3) along the path, across it and of the heading, at the stamps nearest to each time."""
    total = np.zeros((len(times), 3))
    for index in members:
        run = residuals.runs[index]
        stamps = run.pose_times[1:]
        own = residuals.each[style.index][index]
        turned = np.column_stack([rotated(own, -_courses(run)), own[:, 2]])
        nearest = np.abs(stamps[:, None] - times).argmin(axis=0)
        total += np.where((stamps[-1] >= times - 1e-6)[:, None], turned[nearest], 0.0)
    return total / _running(residuals, members, times)[:, None]


def _courses(run: Trajectory) -> Array:
    """Direction of travel (K,) at the stamps after the start, rad; the heading while the robot stays in its place."""
    times, poses = run.pose_times, run.poses
    window = max(1, round(0.5 / max(float(np.median(np.diff(times))), 1e-6)))
    low = np.maximum(np.arange(1, len(times)) - window, 0)
    high = np.minimum(np.arange(1, len(times)) + window, len(times) - 1)
    moved = poses[high, :2] - poses[low, :2]
    speed = np.hypot(moved[:, 0], moved[:, 1]) / (times[high] - times[low])
    usual = float(np.median(speed))
    if usual < _MOVING:
        return poses[1:, 2]
    course = np.arctan2(moved[:, 1], moved[:, 0])
    return np.where(speed > 0.3 * usual, course, poses[1:, 2])


def _blocks(runs: Sequence[Trajectory]) -> list[range]:
    """Blocks of successive runs, each within one session."""
    sessions: list[range] = []
    for index, run in enumerate(runs):
        if sessions and runs[sessions[-1].start].session == run.session:
            sessions[-1] = range(sessions[-1].start, index + 1)
        else:
            sessions.append(range(index, index + 1))
    size = max(_RUNS, math.ceil(len(runs) / _BLOCKS))
    blocks = []
    for session in sessions:
        count = max(1, round(len(session) / size))
        edges = np.linspace(session.start, session.stop, count + 1).round().astype(int)
        blocks += [range(int(low), int(high)) for low, high in pairwise(edges)]
    return blocks


def _block_in_words(runs: Sequence[Trajectory]) -> str:
    times = [run.started_at for run in runs if run.started_at is not None]
    session = f"session {runs[0].session}, " if runs[0].session else ""
    if not times:
        return f"{session}{plural(len(runs), 'run')}:"
    return f"{session}{fixed(min(times) / 60, 1)} to {fixed(max(times) / 60, 1)} min:"


_CELLS = 8  # cells along the longer side; only the drawing hangs on it
_LEAST_IN_CELL = 0.003  # share of the samples; a cell with fewer, a fifth of the mean of 64 cells, is left out
_INSIDE = LegendItem("inside", "within the noise", "#c3c9d0")
_SCALE = 6.0  # standard errors at the ends of the colour scale; only the drawing hangs on it

# By cell: mean residual (3,) in m, m, rad, standard error of its x and y (m), number of runs.
_Means = dict[int, tuple[Array, float, int]]


@dataclass(frozen=True, eq=False)
class _Cells:
    """A grid over the floor. edges: the cells' borders in x and in y, m."""

    edges: tuple[Array, Array]

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.edges[0]) - 1, len(self.edges[1]) - 1

    @property
    def size(self) -> float:
        return float(self.edges[0][1] - self.edges[0][0])

    def number(self, points: Array) -> Array:
        """The number (n,) of the cell that each of the points (n, 2), m, lies in."""
        column, row = (
            np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
            for edges, values in zip(self.edges, points.T, strict=True)
        )
        return column * self.shape[1] + row

    def centre(self, number: int) -> Array:
        """The middle (2,) of a cell, m."""
        place = divmod(number, self.shape[1])
        return np.array([(edges[i] + edges[i + 1]) / 2 for edges, i in zip(self.edges, place, strict=True)])


def _cells(residuals: residual.Residuals) -> _Cells | None:
    """A grid over the floor that the robot drove on; None if it stays in its place."""
    points = residuals.paths.middle[:, :2]
    low, high = points.min(axis=0), points.max(axis=0)
    side = float((high - low).max()) / _CELLS
    if side < 0.02:
        return None
    counts = np.maximum(np.ceil((high - low) / side - 1e-9).astype(int), 1)
    margin = (counts * side - (high - low)) / 2
    edges = [low[axis] - margin[axis] + side * np.arange(counts[axis] + 1) for axis in range(2)]
    return _Cells((edges[0], edges[1]))


def arrow_grid(residuals: residual.Residuals, styles: Sequence[residual.ModelStyle]) -> FigureGrid | None:
    """Arrows of the mean pose residuals in each cell of the floor; None if the robot stays in its place."""
    cells = _cells(residuals)
    if cells is None:
        return None
    means = {style.key: _cell_means(residuals, style, cells) for style in styles}
    sizes = [float(np.hypot(*mean[:2])) for each in means.values() for mean, _, _ in each.values()]
    if not sizes:
        return None
    factor = round_down(1.2 * cells.size / max(float(np.quantile(sizes, 0.9)), 1e-6))
    points = np.array(
        [
            cells.centre(number) + share * mean[:2]
            for each in means.values()
            for number, (mean, _, _) in each.items()
            for share in (0.0, factor)
        ]
    )
    window = np.column_stack([points.min(axis=0) - cells.size / 2, points.max(axis=0) + cells.size / 2])
    figures = tuple(
        Figure(
            f"Mean position residuals, {style.label}",
            _arrows(means[style.key], style, cells, factor, window),
            f"Mean position residual in each cell of the floor, enlarged {factor:g} times, {style.label}",
            420,
        )
        for style in styles
    )
    return FigureGrid(
        figures,
        (*styles, _INSIDE),
        2,
        f"Mean pose residual of the runs that cross a cell, enlarged {factor:g} times, in the frame of the reference; "
        "grey where noise alone would do as much once in 20 times.",
    )


def _cell_means(residuals: residual.Residuals, style: residual.ModelStyle, cells: _Cells) -> _Means:
    """Cells with poses: mean residual (3,), standard error of its x and y (m), number of runs."""
    gathered: dict[int, list[tuple[Array, float]]] = {}
    values = residuals.each[style.index]
    noise = residuals.noise
    for run, own in zip(residuals.runs, values, strict=True):
        where = cells.number(run.poses[1:, :2])
        for number in np.unique(where):
            inside = where == number
            shared = noise.walk_position**2 * float(run.pose_times[1:][inside].mean()) + noise.bias_position**2
            variance = noise.pose_position**2 / int(inside.sum()) + shared
            gathered.setdefault(int(number), []).append((own[inside].mean(axis=0), variance))
    found = {}
    for number, each in gathered.items():
        if len(each) >= max(1, 0.01 * len(residuals.runs)):
            error = residuals.spread * math.sqrt(sum(variance for _, variance in each)) / len(each)
            found[number] = (np.mean([mean for mean, _ in each], axis=0), error, len(each))
    return found


def _arrows(means: _Means, style: residual.ModelStyle, cells: _Cells, factor: float, window: Array) -> go.Figure:
    traces = []
    for outside in (False, True):
        chosen = [
            (cells.centre(number), mean, runs)
            for number, (mean, error, runs) in means.items()
            if bool(np.hypot(*mean[:2]) > residual.CIRCLE_95 * error) == outside
        ]
        if not chosen:
            continue
        starts = np.array([centre for centre, _, _ in chosen])
        tips = starts + factor * np.array([mean[:2] for _, mean, _ in chosen])
        words = [
            f"{1e3 * np.hypot(*mean[:2]):.1f} mm, {math.degrees(mean[2]):.2f}°, {plural(runs, 'run')}".replace("-", "−")
            for _, mean, runs in chosen
        ]
        traces += arrows(style if outside else _INSIDE, starts, tips, words)
    return plan(*traces, window=window)


def motion_grid(residuals: residual.Residuals, styles: Sequence[residual.ModelStyle]) -> FigureGrid | None:
    """Maps of the error of the motion over the floor; None if the robot stays in its place."""
    cells = _cells(residuals)
    if cells is None:
        return None
    paths = residuals.paths
    where = cells.number(paths.middle[:, :2])
    counts = np.bincount(where.astype(int), minlength=cells.shape[0] * cells.shape[1])
    chosen = np.flatnonzero(counts > _LEAST_IN_CELL * len(where))
    if len(chosen) < 3:
        return None
    bins = (where[:, None] == chosen).astype(float)
    panels = motion_panels(residuals, styles, bins, chosen.astype(float), "", "the floor")
    figures = []
    for index, style in enumerate(styles):
        for panel, (name, _, unit) in zip(panels, MODES, strict=True):
            curve = panel.curves[index]
            if np.isfinite(curve.half_width).any():
                figures.append(
                    Figure(
                        f"Error {name}, {style.label}",
                        _map(cells, chosen, curve, unit),
                        f"Error {name} of the motion in each cell of the floor, in standard errors, {style.label}",
                        270,
                    )
                )
    caption = (
        "Colours in standard errors of what comes out by chance, which exceeds ±2 once in 20 times. Cells that the "
        "data say nothing of are white."
    )
    return FigureGrid(tuple(figures), (), 3, caption) if figures else None


def _map(cells: _Cells, chosen: NDArray[np.intp], curve: residual.Curve, unit: str) -> go.Figure:
    scores = np.full(cells.shape, np.nan)
    scores.flat[chosen] = curve.values / (curve.half_width / residual.NORMAL_95)
    words = np.full(cells.shape, "", dtype=object)
    words.flat[chosen] = [
        f"{value:.3g} ± {half:.2g} {unit}".replace("-", "−")
        for value, half in zip(curve.values, curve.half_width, strict=True)
    ]
    x, y = ((edges[1:] + edges[:-1]) / 2 for edges in cells.edges)
    figure = plan(
        go.Heatmap(
            x=coordinates(x),
            y=coordinates(y),
            z=[coordinates(row) for row in scores.T],
            zmin=-_SCALE,
            zmax=_SCALE,
            colorscale=[[0.0, "#0072b2"], [0.5, "#f3f4f6"], [1.0, "#d97706"]],
            colorbar={"thickness": 10, "tickvals": [-6, -4, -2, 0, 2, 4, 6], "outlinewidth": 0, "x": 1.01, "len": 0.8},
            text=words.T.tolist(),
            hovertemplate="%{text}<extra></extra>",
            hoverongaps=False,
        )
    )
    return figure.update_layout(xaxis_constrain="domain", yaxis_constrain="domain")


_START = 2.0  # s from the start of a run that are drawn: ten time constants of a motor of 0.2 s
_MEASURED = residual.ModelStyle("before", "measured − target", residual.BEFORE)
_EXPECTED = residual.ModelStyle("after", "measured − expected with the effects", residual.AFTER, index=1)


def motor_grid(discovery: Discovery, runs: Sequence[Trajectory]) -> FigureGrid | None:
    """Errors of the wheel rates over the target rate and at the start of the runs; None without targets."""
    driven = [(run, run.targets) for run in runs if run.targets is not None]
    before: list[Array] = [run.rates - targets for run, targets in driven]
    if not driven or max(float(np.abs(each).max()) for each in before) == 0:
        return None
    motor_effects = [effect for effect in discovery.effects if effect.stage == "actuator"]
    errors: list[tuple[residual.ModelStyle, list[Array]]] = [(_MEASURED, before)]
    if motor_effects:
        changes = [_changes(run, targets, motor_effects) for run, targets in driven]
        errors.append((_EXPECTED, [own - change for own, change in zip(before, changes, strict=True)]))
    targets = [each for _, each in driven]
    top = max(float(np.quantile(np.abs(each), 0.999)) for each in targets)
    edges = np.linspace(-top, top, _BINS + 1) * (1 + 1e-9)
    panels = []
    for index, wheel in enumerate(discovery.dataset.robot.measured):
        bins = [residual.shares(each[:, index], edges) * (each[:, [index]] != 0) for each in targets]
        curves = tuple(_curve(style, bins, [each[:, index] for each in own]) for style, own in errors)
        panels.append(_panel(f"Wheel {wheel.name}, over its target", edges, curves, "target rate (rad/s)"))
    edges = np.linspace(0.0, min(_START, max(float(run.times[-1]) for run, _ in driven)), _BINS + 1)
    bins = [residual.shares(run.times, edges) for run, _ in driven]
    curves = tuple(
        _curve(style, bins, [100 * _share(e, t) for e, t in zip(own, targets, strict=True)]) for style, own in errors
    )
    panels.append(
        _panel("All wheels, at the start of the runs", edges, curves, "time since the start (s)", "% of the target")
    )
    return residual.grid(
        panels,
        [style for style, _ in errors],
        "Mean over the runs; the bands hold 95 % of what the scatter of the runs does to the mean.",
    )


def _changes(run: Trajectory, targets: Array, motor_effects: Sequence[NamedEffect]) -> Array:
    """The change (F, N) of the wheel rates by the actuator effects, rad/s; those of several effects add up."""
    durations = np.diff(run.times, prepend=0.0)
    total = np.zeros(targets.shape)
    for named in motor_effects:
        effect = effects.create(named.name)
        assert isinstance(effect, ActuatorEffect)
        values: Mapping[str, float] = {parameter.name: parameter.value for parameter in named.parameters}
        total += effect.driven(durations, targets, values) - targets
    return total


def _curve(style: residual.ModelStyle, bins: Sequence[Array], errors: Sequence[Array]) -> residual.Curve:
    """Mean over the runs of each run's mean in a bin, with the scatter of the runs."""
    counts = np.array([each.sum(axis=0) for each in bins])
    sums = np.array([each.T @ own for each, own in zip(bins, errors, strict=True)])
    means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    runs = (counts > 0).sum(axis=0)
    enough = runs > 1
    value, spread = np.full(len(runs), np.nan), np.full(len(runs), np.nan)
    value[enough] = np.nanmean(means[:, enough], axis=0)
    spread[enough] = np.nanstd(means[:, enough], axis=0, ddof=1) / np.sqrt(runs[enough])
    return residual.Curve(style, value, residual.NORMAL_95 * spread)


def _share(errors: Array, targets: Array) -> Array:
    """Errors (F, N) projected on the targets, as shares (F,) of these."""
    size = np.abs(targets).mean(axis=1)
    share: Array = (np.sign(targets) * errors).mean(axis=1) / np.where(size > 0, size, np.inf)
    return share


def _panel(
    title: str, edges: Array, curves: tuple[residual.Curve, ...], x_title: str, unit: str = "rad/s"
) -> residual.Panel:
    return residual.Panel(title, (edges[1:] + edges[:-1]) / 2, curves, x_title, f"difference ({unit})", unit)


# Figures over each covariate: a figure that is added here is shown.
_FIGURES: Mapping[str, tuple[CovariateFigure, ...]] = {
    "elapsed time": (elapsed_grid,),
    "order of runs": (order_grid,),
    "stamps": (stamps_grid,),
    "heading": (heading_grid,),
    "wheel rate": (wheel_rate_grid,),
    "wheel angle": (wheel_angle_grid,),
    "acceleration": (acceleration_grid,),
    "place": (arrow_grid, motion_grid),
}
_HOW = (
    "In the pictures over a covariate a point is the error of the motion that, constant in its bin, explains the "
    "residuals best together with those of the other bins (generalised least squares under the noise model); what the "
    "matrix could take up of it is gone already. The bands, in the colour of each model, hold 95 % of what comes out "
    "by chance: of noise, or of the same residuals with random signs for whole commands or runs, so that what depends "
    "on something else does not stand out."
)
_OVER = {"elapsed time": "the time of a run", "place": "the floor", "order of runs": "the order of the runs"}
# Why a covariate has no figure, in the order in which covariates are shown.
_NOT_DRAWN = {
    "elapsed time": "no run has a pose after its start",
    "heading": "the robot keeps its heading and its direction",
    "place": "the robot stays in its place",
    "order of runs": "when the runs were driven was not recorded",
    "wheel rate": "the wheels hardly change their rates",
    "wheel angle": "the wheels' absolute angles were not recorded",
    "acceleration": "hardly any run accelerates",
    "stamps": "nothing moves",
    "motors": "targets of the wheel rates were not recorded, or are copies of the rates",
}


def where_section(discovery: Discovery) -> Section:
    """The section on where: residuals by command, then over each covariate, the significant ones first."""
    residuals = residual.Residuals(discovery)
    # The styles of both models, or of the plain one alone if nothing was added
    pairs = zip(discovery.before, discovery.after, strict=True)
    styles = (residual.ALONE,) if all(np.array_equal(*pair) for pair in pairs) else (residual.PLAIN, residual.EXTENDED)
    motors = motor_grid(discovery, residuals.runs)
    order = list(_NOT_DRAWN)  # new covariates come last
    figures: dict[str, tuple[Block, ...]] = {
        covariate: tuple(shown for figure in _FIGURES[covariate] if (shown := figure(residuals, styles)) is not None)
        for covariate in sorted(_FIGURES, key=lambda name: order.index(name) if name in order else len(order))
    }
    figures["motors"] = () if motors is None else (motors,)
    covariates = [
        "motors" if dependence.stage == "actuator" else dependence.covariate for dependence in discovery.where
    ]
    named = [name for name in dict.fromkeys(covariates) if name in figures]
    sections = [Section("where-command", "Residuals by command", command_blocks(residuals, styles))]
    for number, name in enumerate(named, 1):
        if figures[name]:
            sections.append(Section(f"where-{number}", _title(name), figures[name]))
    others: list[Block] = [
        Details(_title(name), blocks) for name, blocks in figures.items() if name not in named and blocks
    ]
    not_drawn = [f"{name} ({_NOT_DRAWN.get(name, 'not recorded')})" for name, blocks in figures.items() if not blocks]
    if not_drawn:
        others.append(Paragraph(f"Not drawn: {'; '.join(not_drawn)}.", "note"))
    if others:
        title = "Residuals over other covariates" if named else "Residuals over all covariates"
        sections.append(Section("where-others", title, tuple(others)))
    return Section("where", "Where", (*_dependences(discovery), Paragraph(_HOW, "note")), tuple(sections))


def _title(name: str) -> str:
    return (
        "Measured wheel rates against their targets" if name == "motors" else f"Residuals over {_OVER.get(name, name)}"
    )


def _dependences(discovery: Discovery) -> Iterator[Block]:
    if not discovery.where:
        yield Paragraph(
            "The residuals of the plain matrix depend on nothing that was tried by more than noise explains."
        )
        return
    words = listing(
        list(dict.fromkeys(dependence.covariate for dependence in discovery.where if dependence.stage != "actuator")), 9
    )
    if words:
        yield Paragraph(
            f"The residuals of the plain matrix depend on {words}. What makes them may show in several of these; the "
            "first stands out most."
        )
    if any(dependence.stage == "actuator" for dependence in discovery.where):
        yield Paragraph(
            "The wheels do not follow the targets of their motors. Odometry measures the wheels themselves and is not "
            "worse for it; a simulation from targets is."
        )
    yield dependence_table(discovery.where, "Where the plain matrix fails")
