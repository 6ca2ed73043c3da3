"""Residuals over the floor: mean pose residuals of each cell as arrows, and where the motion goes wrong as a map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from omnibench.discover.report.before_after import Look, numbers, round_down
from omnibench.discover.report.motion_figures import MODES, fit_modes
from omnibench.discover.report.residuals import CIRCLE_95, Residuals
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.numbers import plural
from omnibench.report.style import equal_aspect, plot, text
from omnibench.robot.kinematics import Array

_CELLS = 8  # along the longer side
_LEAST = 0.003  # share of the samples that a cell needs
_INSIDE = "#c3c9d0"
_SCALE = 6.0  # standard errors at the ends of the colours

# Of each cell the mean residual (3,), the standard error of its x and y (m), and the number of runs.
_Means = dict[int, tuple[Array, float, int]]


@dataclass(frozen=True, eq=False)
class _Cells:
    """A grid over the floor. edges: of x and of y, m."""

    edges: tuple[Array, Array]

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.edges[0]) - 1, len(self.edges[1]) - 1

    @property
    def size(self) -> float:
        return float(self.edges[0][1] - self.edges[0][0])

    def number(self, points: Array) -> Array:
        """The cell (n,) of points (n, 2)."""
        column, row = (
            np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
            for edges, values in zip(self.edges, points.T, strict=True)
        )
        return column * self.shape[1] + row

    def centre(self, number: int) -> Array:
        """The middle (2,) of a cell."""
        place = divmod(number, self.shape[1])
        return np.array([(edges[i] + edges[i + 1]) / 2 for edges, i in zip(self.edges, place, strict=True)])


def floor_grids(residuals: Residuals, looks: Sequence[Look]) -> tuple[FigureGrid, ...]:
    """Arrows of the mean pose residuals, and maps of the error of the motion; none where nothing was driven."""
    cells = _cells(residuals)
    if cells is None:
        return ()
    found = [_arrow_grid(residuals, looks, cells), _motion_grid(residuals, looks, cells)]
    return tuple(each for each in found if each is not None)


def _cells(residuals: Residuals) -> _Cells | None:
    points = residuals.paths.middle[:, :2]
    low, high = points.min(axis=0), points.max(axis=0)
    side = float((high - low).max()) / _CELLS
    if side < 0.02:
        return None
    counts = np.maximum(np.ceil((high - low) / side - 1e-9).astype(int), 1)
    margin = (counts * side - (high - low)) / 2
    edges = [low[axis] - margin[axis] + side * np.arange(counts[axis] + 1) for axis in range(2)]
    return _Cells((edges[0], edges[1]))


def _arrow_grid(residuals: Residuals, looks: Sequence[Look], cells: _Cells) -> FigureGrid | None:
    means = {look.key: _cell_means(residuals, look, cells) for look in looks}
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
            f"Mean position residuals, {look.label}",
            _arrows(means[look.key], look, cells, factor, window),
            f"Mean position residual in each cell of the floor, enlarged {factor:g} times, {look.label}",
            420,
        )
        for look in looks
    )
    return FigureGrid(
        figures,
        (*(look.legend for look in looks), LegendItem("inside", "within the noise", _INSIDE)),
        2,
        f"Mean pose residual of the runs that cross a cell, enlarged {factor:g} times, in the frame of the reference; "
        "grey where noise alone would do as much once in 20 times.",
    )


def _cell_means(residuals: Residuals, look: Look, cells: _Cells) -> _Means:
    """Of each cell with poses: mean residual (3,), standard error of its x and y (m), and the number of runs."""
    gathered: dict[int, list[tuple[Array, float]]] = {}
    values = residuals.each[look.index]
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


def _arrows(means: _Means, look: Look, cells: _Cells, factor: float, window: Array) -> go.Figure:
    traces = []
    for outside in (False, True):
        chosen = [
            (cells.centre(number), mean, runs)
            for number, (mean, error, runs) in means.items()
            if bool(np.hypot(*mean[:2]) > CIRCLE_95 * error) == outside
        ]
        if not chosen:
            continue
        colour, key = (look.colour, look.key) if outside else (_INSIDE, "inside")
        starts = np.array([centre for centre, _, _ in chosen])
        tips = starts + factor * np.array([mean[:2] for _, mean, _ in chosen])
        gaps = np.full(len(chosen), np.nan)
        words = [
            f"{1e3 * np.hypot(*mean[:2]):.1f} mm, {math.degrees(mean[2]):.2f}°, {plural(runs, 'run')}".replace("-", "−")
            for _, mean, runs in chosen
        ]
        traces.append(
            go.Scatter(
                x=numbers(np.column_stack([starts[:, 0], tips[:, 0], gaps]).ravel()),
                y=numbers(np.column_stack([starts[:, 1], tips[:, 1], gaps]).ravel()),
                mode="lines",
                line={"color": colour, "width": 2},
                legendgroup=key,
                hoverinfo="skip",
            )
        )
        pointing = 90.0 - np.degrees(np.arctan2(*(tips - starts).T[::-1]))
        traces.append(
            go.Scatter(
                x=numbers(tips[:, 0]),
                y=numbers(tips[:, 1]),
                mode="markers",
                marker={"color": colour, "size": 9, "symbol": "triangle-up", "angle": numbers(pointing)},
                legendgroup=key,
                text=[text(each) for each in words],
                hovertemplate="%{text}<extra></extra>",
            )
        )
    figure = plot(*traces, xaxis_title_text="x (m)", yaxis_title_text="y (m)")
    figure.update_xaxes(range=numbers(window[0]))
    figure.update_yaxes(range=numbers(window[1]))
    equal_aspect(figure)
    return figure


def _motion_grid(residuals: Residuals, looks: Sequence[Look], cells: _Cells) -> FigureGrid | None:
    paths = residuals.paths
    where = cells.number(paths.middle[:, :2])
    counts = np.bincount(where.astype(int), minlength=cells.shape[0] * cells.shape[1])
    chosen = np.flatnonzero(counts > _LEAST * len(where))
    if len(chosen) < 3:
        return None
    bins = (where[:, None] == chosen).astype(float)
    fitted = fit_modes(residuals, bins)
    figures = []
    for look in looks:
        values, errors = fitted.values[:, look.index], fitted.errors[:, look.index]
        for index, (name, factor, unit) in enumerate(MODES):
            part = slice(index * len(chosen), (index + 1) * len(chosen))
            if np.isfinite(errors[part]).any():
                figures.append(
                    Figure(
                        f"Error {name}, {look.label}",
                        _map(cells, chosen, factor * values[part], factor * errors[part], unit),
                        f"Error {name} of the motion in each cell of the floor, in standard errors, {look.label}",
                        270,
                    )
                )
    caption = (
        "Colours in standard errors of what comes out by chance, which exceeds ±2 once in 20 times. Cells that the "
        "data say nothing of are white."
    )
    return FigureGrid(tuple(figures), (), 3, caption) if figures else None


def _map(cells: _Cells, chosen: NDArray[np.intp], values: Array, errors: Array, unit: str) -> go.Figure:
    columns, rows = cells.shape
    scores = np.full(columns * rows, np.nan)
    scores[chosen] = values / errors
    words = np.full(columns * rows, "", dtype=object)
    words[chosen] = [
        f"{value:.3g} ± {1.96 * error:.2g} {unit}".replace("-", "−")
        for value, error in zip(values, errors, strict=True)
    ]
    table = [[numbers(np.array([scores[c * rows + r]]))[0] for c in range(columns)] for r in range(rows)]
    middles = [(edges[1:] + edges[:-1]) / 2 for edges in cells.edges]
    figure = plot(
        go.Heatmap(
            x=numbers(middles[0]),
            y=numbers(middles[1]),
            z=table,
            zmin=-_SCALE,
            zmax=_SCALE,
            colorscale=[[0.0, "#0072b2"], [0.5, "#f3f4f6"], [1.0, "#d97706"]],
            colorbar={"thickness": 10, "tickvals": [-6, -4, -2, 0, 2, 4, 6], "outlinewidth": 0, "x": 1.01, "len": 0.8},
            text=[[str(words[c * rows + r]) for c in range(columns)] for r in range(rows)],
            hovertemplate="%{text}<extra></extra>",
            hoverongaps=False,
        ),
        xaxis_title_text="x (m)",
        yaxis_title_text="y (m)",
    )
    equal_aspect(figure)
    figure.update_xaxes(constrain="domain")
    figure.update_yaxes(constrain="domain")
    return figure
