"""Residuals of plain and extended model, by command and over a covariate of the motion, for the figures.

Over a covariate, residuals are not averaged, because the error of a pose accumulates all errors before it. Drawn is the
change of the motion (along the path, across it, in turning, or of a wheel's rate) that is constant in each bin of the
covariate and explains the residuals best, by generalised least squares under the noise model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.discover.regressors.paths import Paths, make_paths
from omnibench.discover.result import Discovery
from omnibench.fit.noise import Whitener, grouped
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.figures import area, joined, marks
from omnibench.report.numbers import listing
from omnibench.report.style import QUIET, plot, text
from omnibench.robot.kinematics import Array, relative, rotation

# Standard deviations that hold 95 % of a normal distribution, on a line and in the plane.
NORMAL_95 = 1.96  # standard deviations within which 95 % of a normal number lie
CIRCLE_95 = 2.448  # sqrt(-2 ln 0.05), standard deviations within which 95 % of a pair of normal numbers lie
_STAMPS = 15_000  # reference poses drawn of all runs, at most, so that a report takes seconds
# Share of the largest eigenvalue of the information, below which a direction is left open: its standard error is 100
# times that of the best known one, wider than any figure.
_DETERMINED = 1e-4
_COMMANDS = 8  # with fewer, the signs of whole commands flip in less than 2^7 ways, too few for the band of 95 %


@dataclass(frozen=True, eq=False)
class Fitted:
    """Fitted values (n, 2), before and after, with their standard errors (n, 2) by chance; NaN: not determined."""

    values: Array
    errors: Array


@dataclass(frozen=True, eq=False)
class CommandResidual:
    """Final residuals of one command: means over its runs, in the frame of the start pose (x forward).

    end (3,): final pose; means (2, 3): before and after, m, m, rad; error (3,): their standard error by the noise.
    """

    name: str
    run: Trajectory
    runs: int
    end: Array
    means: Array
    error: Array


class Residuals:
    """The training runs with their residuals, in the order in which they were driven.

    runs: sorted by session and time. each: for both models the residuals (K, 3) of each run, reference minus
    odometry, m, m, rad. spread: ratio of the remaining residuals to the noise model, at least 1; it multiplies all
    standard errors.
    """

    def __init__(self, discovery: Discovery) -> None:
        trajectories = {run.id: run for run in discovery.dataset.trajectories}
        runs = [trajectories[name] for name in discovery.trajectories]
        order = sorted(range(len(runs)), key=lambda i: (str(runs[i].session), runs[i].started_at or 0.0))
        self.runs = tuple(runs[index] for index in order)
        self.each = tuple(tuple(own[index] for index in order) for own in (discovery.before, discovery.after))
        self.noise = discovery.noise.noise
        white = np.concatenate([each.ravel() for each in discovery.whitened_after])
        self.spread = max(1.0, math.sqrt(float(np.square(white).mean())))
        self._calibration = discovery.plain

    def deviations(self, times: Array) -> Array:
        """Standard deviations (n, 3) of single poses' errors at times (n,), m, m, rad."""
        noise = self.noise
        position = np.sqrt(noise.pose_position**2 + noise.walk_position**2 * times + noise.bias_position**2)
        heading = np.sqrt(noise.pose_heading**2 + noise.walk_heading**2 * times + noise.bias_heading**2)
        return self.spread * np.column_stack([position, position, heading])

    @cached_property
    def commands(self) -> tuple[CommandResidual, ...]:
        """Final residuals by command; a run without a command counts as a command of its own."""
        residuals = []
        for members in grouped([(run.command, run.id if run.command is None else None) for run in self.runs]):
            first = self.runs[members[0]]
            ends, finals, variances = [], [], []
            for index in members:
                run = self.runs[index]
                ends.append(relative(run.start, run.final_pose))
                finals.append([rotation(-run.start[2]) @ own[index][-1] for own in self.each])
                variances.append(self.deviations(run.pose_times[-1:])[0] ** 2)
            error: Array = np.sqrt(np.sum(variances, axis=0)) / len(members)
            end: Array = np.mean(ends, axis=0)
            means: Array = np.mean(finals, axis=0)
            residuals.append(CommandResidual(first.command or first.id, first, len(members), end, means, error))
        return tuple(residuals)

    @cached_property
    def paths(self) -> Paths:
        """The paths of the runs by the plain matrix, at the thinned stamps."""
        logs = [replace(run.reference_log, stamps=run.pose_times[1:][chosen]) for run, chosen in self._thinned]
        return make_paths(
            self._calibration.robot, self._calibration.matrix_array, logs, self._calibration.sample_period
        )

    @cached_property
    def stamp_numbers(self) -> NDArray[np.intp]:
        """The number (S,) of each of the paths' stamps within its run, from 0 on."""
        return np.concatenate([chosen for _, chosen in self._thinned])

    @cached_property
    def _thinned(self) -> list[tuple[Trajectory, NDArray[np.intp]]]:
        """The runs with the numbers of their stamps that are fitted: at most 15,000 in all."""
        stride = max(1, math.ceil(sum(map(len, self.each[0])) / _STAMPS))
        return [(run, np.arange(len(own))[(len(own) - 1) % stride :: stride])
                for run, own in zip(self.runs, self.each[0], strict=True)]  # fmt: skip

    @cached_property
    def _white(self) -> list[tuple[Whitener, Array]]:
        """Whitener of each run, and its whitened residuals (3 K, 2), before and after."""
        whiteners: dict[bytes, Whitener] = {}
        found = []
        for (run, chosen), before, after in zip(self._thinned, *self.each, strict=True):
            stamps = run.pose_times[1:][chosen]
            whitener = whiteners.setdefault(stamps.tobytes(), Whitener(self.noise, stamps))
            both = whitener(np.stack([before[chosen], after[chosen]], axis=-1))
            found.append((whitener, both.reshape(-1, 2)))
        return found

    def fit(self, columns: Array) -> Fitted:
        """Fit the changes of the motion that explain the residuals best; columns (S, 3, n): their slopes at the stamps.

        Standard errors are the larger of two: by the noise model, and by random signs of the residuals of whole
        commands (of runs, where commands are few).
        """
        size = columns.shape[2]
        information, scores = np.zeros((size, size)), np.empty((len(self.runs), size, 2))
        for row, (part, (whitener, residuals)) in enumerate(zip(self.paths.parts, self._white, strict=True)):
            white = whitener(columns[part]).reshape(-1, size)
            information += white.T @ white
            scores[row] = white.T @ residuals
        scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        scale[np.diag(information) < 1e-12 * np.diag(information).max(initial=0.0)] = 0.0
        correlation = information * np.outer(scale, scale)
        inverse = np.linalg.pinv(correlation, rcond=_DETERMINED, hermitian=True) * np.outer(scale, scale)
        # Parameters that take no part in a direction that the data leave open.
        sizes, vectors = np.linalg.eigh(correlation)
        open_ones = vectors[:, sizes < _DETERMINED * max(float(sizes.max(initial=0.0)), 1e-300)]
        determined = (scale > 0) & (np.square(open_ones).sum(axis=1) < 0.01)
        noise = self.spread * np.sqrt(np.maximum(np.diag(inverse), 0.0))
        cluster_scores = np.stack([scores[list(members)].sum(axis=0) for members in self._clusters])
        flipped = np.sqrt(np.square(np.einsum("ij,cjm->cim", inverse, cluster_scores)).sum(axis=0))
        values = inverse @ scores.sum(axis=0)
        errors = np.maximum(noise[:, None], flipped)
        return Fitted(np.where(determined[:, None], values, np.nan), np.where(determined[:, None], errors, np.nan))

    def fit_runs(self, columns: Array) -> Fitted:
        """Fit one change of the motion (S, 3, 1) to each run by itself: values (Z, 2), errors by the noise model."""
        values, errors = np.full((len(self.runs), 2), np.nan), np.full((len(self.runs), 2), np.nan)
        for row, (part, (whitener, residuals)) in enumerate(zip(self.paths.parts, self._white, strict=True)):
            white = whitener(columns[part]).reshape(-1)
            if (information := float(white @ white)) > 0:
                values[row] = white @ residuals / information
                errors[row] = self.spread / math.sqrt(information)
        return Fitted(values, errors)

    @cached_property
    def _clusters(self) -> list[tuple[int, ...]]:
        """The runs of each command, or each run by itself where commands are few."""
        commands = grouped([(run.command, run.id if run.command is None else None) for run in self.runs])
        return commands if len(commands) >= _COMMANDS else [(index,) for index in range(len(self.runs))]


def shares(values: Array, edges: Sequence[float] | Array) -> Array:
    """Membership (F, B) of values (F,) in bins: 1 in its bin and 0 elsewhere; all 0 outside the edges."""
    bins = np.searchsorted(np.asarray(edges), values, side="right") - 1
    bins = np.where(values == edges[-1], len(edges) - 2, bins)
    found: Array = (bins[:, None] == np.arange(len(edges) - 1)).astype(float)
    return found


BEFORE, AFTER, FLOOR = "#d97706", "#0072b2", "#8a8f98"
BAND = "rgba(102,114,127,0.20)"
_NOISE = "#c3c9d0"
_VAGUE = 3.0  # usual half-widths of the band: a value within a wider one says nothing; only the drawing hangs on it
_HEIGHT = 270  # px
_BY_CHANCE = 0.05  # share of the values that leave bands of 95 % by chance
# Why a test may find what no value of a figure shows.
_WITHIN = (
    "The test in the table above, of all values together and against noise alone, may still find a dependence: the "
    "band also holds what depends on other covariates, so that what is missing need not depend on this one."
)
# A line across the plot at y = 0, as part of the layout: adding it to a figure is much slower.
ZERO = {"type": "line", "xref": "x domain", "x0": 0, "x1": 1, "y0": 0, "y1": 0, "line": {"color": QUIET, "width": 1}}


@dataclass(frozen=True)
class ModelStyle(LegendItem):
    """The style in which one of the two models is drawn. index: 0 before, 1 after."""

    index: int = 0


PLAIN = ModelStyle("before", "plain matrix (before)", BEFORE)
ALONE = ModelStyle("before", "plain matrix", BEFORE)
EXTENDED = ModelStyle("after", "extended model (after)", AFTER, index=1)
NOISE = LegendItem("noise", "noise alone, 95 %", _NOISE)


@dataclass(frozen=True, eq=False)
class Curve:
    """One model's values (n,) over x (n,), NaN where unknown. half_width (n,): the 95 % band of chance."""

    style: ModelStyle
    values: Array
    half_width: Array


@dataclass(frozen=True, eq=False)
class Panel:
    """The content of one plot: curves over x (n,) and the titles of its axes.

    amplitude: values are never below 0. shared: all curves have the band of the noise alone. ticks: distance between
    ticks of x. words: a text for each point, shown on hovering.
    """

    title: str
    x: Array
    curves: tuple[Curve, ...]
    x_title: str
    y_title: str
    unit: str
    lines: bool = True
    amplitude: bool = False
    shared: bool = False
    ticks: float | None = None
    words: tuple[str, ...] = ()

    @property
    def empty(self) -> bool:
        return not any(np.isfinite(curve.half_width).any() for curve in self.curves)


def legend(styles: Sequence[ModelStyle], noise: bool = True) -> tuple[LegendItem, ...]:
    """The legend of the models and, if ``noise``, of the noise band."""
    return (*styles, NOISE) if noise else tuple(styles)


def fitted_panels(
    residuals: Residuals, styles: Sequence[ModelStyle], parts: Sequence[tuple[Array, float, Panel]]
) -> list[Panel]:
    """Panels with the curves of one fit.

    parts: for each panel its columns (S, 3, B), as for ``Residuals.fit``, the factor from SI to its unit, and the panel
    without curves.
    """
    if not parts:
        return []
    fitted = residuals.fit(np.concatenate([columns for columns, _, _ in parts], axis=2))
    panels, first = [], 0
    for columns, factor, panel in parts:
        part = slice(first, first + columns.shape[2])
        panels.append(replace(panel, curves=fitted_curves(fitted, styles, factor, part)))
        first = part.stop
    return panels


def fitted_curves(
    fitted: Fitted, styles: Sequence[ModelStyle], factor: float, part: slice = slice(None)
) -> tuple[Curve, ...]:
    """Curves of a part of the fitted values, with their 95 % bands. factor: from SI to the unit that is drawn."""
    return tuple(
        Curve(style, factor * fitted.values[part, style.index], NORMAL_95 * factor * fitted.errors[part, style.index])
        for style in styles
    )


def grid(panels: Sequence[Panel], styles: Sequence[ModelStyle], caption: str = "") -> FigureGrid | None:
    """Panels on which the data say something, side by side, those of the same unit on one scale; None without any."""
    panels = [panel for panel in panels if not panel.empty]
    figures: list[Figure | None] = [None] * len(panels)
    for unit in dict.fromkeys(panel.unit for panel in panels):
        members = [index for index, panel in enumerate(panels) if panel.unit == unit]
        reach = 1.1 * max(_reach(panels[index]) for index in members) or 1.0
        for index in members:
            panel = panels[index]
            words = f"{panel.title}: {panel.y_title} against {panel.x_title}"
            figures[index] = Figure(panel.title, _plot(panel, reach), words, _HEIGHT)
    caption = f"{caption} {_within_bands(panels)}".strip()
    found = tuple(figure for figure in figures if figure is not None)
    columns: Literal[2, 3] = 2 if len(found) % 3 and len(found) % 2 == 0 else 3
    return FigureGrid(found, legend(styles, all(panel.shared for panel in panels)), columns, caption) if found else None


def _within_bands(panels: Sequence[Panel]) -> str:
    """Words on each model of which no more values leave their bands than by chance; empty if there is none."""
    counts: dict[str, tuple[int, int]] = {}
    for curve in (curve for panel in panels for curve in panel.curves):
        outside, known = counts.get(curve.style.label, (0, 0))
        seen = np.isfinite(curve.values) & np.isfinite(curve.half_width)
        left = int((np.abs(curve.values) > curve.half_width)[seen].sum())
        counts[curve.style.label] = (outside + left, known + int(seen.sum()))
    within = [
        f"of the {label} {outside} of {known} values leave their band"
        for label, (outside, known) in counts.items()
        if known and outside <= _BY_CHANCE * known
    ]
    return f"No more than by chance, {listing(within)}. {_WITHIN}" if within else ""


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
    bands = panel.curves[:1] if panel.shared else panel.curves
    traces = [_band(panel, curve) for curve in bands]
    words = panel.words or ("",) * len(panel.x)
    for curve in panel.curves:
        hover = f"{text(curve.style.label)}<br>%{{text}} %{{y:.3g}} {panel.unit}"
        if panel.lines:
            looks = {"mode": "lines+markers", "line_color": curve.style.colour, "line_width": 2}
            traces.append(marks(curve.style, 6, panel.x, curve.values, hover=hover, words=words, **looks))
        else:
            traces.append(marks(curve.style, 5, panel.x, curve.values, hover=hover, words=words, opacity=0.75))
    return plot(
        *traces,
        xaxis={"title": {"text": panel.x_title}, "dtick": panel.ticks},
        yaxis={"title": {"text": panel.y_title}, "range": [0 if panel.amplitude else -reach, reach]},
        shapes=[ZERO],
    )


def _band(panel: Panel, curve: Curve) -> go.Scatter:
    """The band of chance about zero, in a pale shade of the curve's colour or in that of the noise."""
    outlines = []
    known = np.isfinite(curve.half_width)
    pieces = np.split(np.arange(len(known)), np.flatnonzero(np.diff(known.astype(int))) + 1)
    margin = 0.015 * float(np.ptp(panel.x))
    for piece in pieces:
        if known[piece[0]]:
            at, half = panel.x[piece], curve.half_width[piece]
            if len(piece) == 1:  # a bin between empty ones
                at, half = at + np.array([-margin, margin]), np.repeat(half, 2)
            low = 0 * half if panel.amplitude else -half
            outlines.append(np.column_stack([np.append(at, at[::-1]), np.append(half, low[::-1])]))
    if panel.shared:
        return area(NOISE.key, BAND, *joined(outlines).T)
    red, green, blue = (int(curve.style.colour[index : index + 2], 16) for index in (1, 3, 5))
    return area(curve.style.key, f"rgba({red},{green},{blue},0.16)", *joined(outlines).T)
