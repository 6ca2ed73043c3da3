"""Figures of the residuals over the floor: mean pose residuals as arrows, the error of the motion as maps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from omnibench.discover.report.motion_figures import MODES, CovariateFigure, motion_panels
from omnibench.discover.report.residuals import CIRCLE_95, NORMAL_95, Curve, ModelStyle, Residuals
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.figures import arrows, coordinates
from omnibench.report.numbers import round_down
from omnibench.report.style import plan
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_CELLS = 8  # cells along the longer side; only the drawing hangs on it
_LEAST = 0.003  # share of the samples; a cell with fewer, a fifth of the mean of 64 cells, is left out
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


def _cells(residuals: Residuals) -> _Cells | None:
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


def arrow_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
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


def _cell_means(residuals: Residuals, style: ModelStyle, cells: _Cells) -> _Means:
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


def _arrows(means: _Means, style: ModelStyle, cells: _Cells, factor: float, window: Array) -> go.Figure:
    traces = []
    for outside in (False, True):
        chosen = [
            (cells.centre(number), mean, runs)
            for number, (mean, error, runs) in means.items()
            if bool(np.hypot(*mean[:2]) > CIRCLE_95 * error) == outside
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


def motion_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
    """Maps of the error of the motion over the floor; None if the robot stays in its place."""
    cells = _cells(residuals)
    if cells is None:
        return None
    paths = residuals.paths
    where = cells.number(paths.middle[:, :2])
    counts = np.bincount(where.astype(int), minlength=cells.shape[0] * cells.shape[1])
    chosen = np.flatnonzero(counts > _LEAST * len(where))
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


def _map(cells: _Cells, chosen: NDArray[np.intp], curve: Curve, unit: str) -> go.Figure:
    scores = np.full(cells.shape, np.nan)
    scores.flat[chosen] = curve.values / (curve.half_width / NORMAL_95)
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


# Figures over each covariate: a figure that is added here is shown.
FIGURES: Mapping[str, tuple[CovariateFigure, ...]] = {
    "place": (arrow_grid, motion_grid),
}
