"""Figures of the errors of reference poses against the truth: over time and distance, at the end, and their NEES."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import plotly.graph_objects as go

from omnibench.data.dataset import Dataset
from omnibench.data.true_poses import TruePath
from omnibench.report.blocks import Block, Figure, FigureGrid, LegendItem
from omnibench.report.numbers import count, significant
from omnibench.report.recording.scan_points import evenly
from omnibench.report.style import INK, PALETTE, QUIET, plot
from omnibench.report.traces import coordinates, joined, line
from omnibench.robot.kinematics import Array
from omnibench.slam.accuracy import RunErrors, run_errors
from omnibench.words import plural

_RUNS = 150  # runs drawn as thin lines (chosen)
_BINS = 16  # bins of time or distance (chosen)
_LEAST = 5  # poses; a bin with fewer shows no mean (chosen)

_RUN = LegendItem("run", "a run", "#c3c9d0")
_MEAN = LegendItem("mean", "mean", PALETTE[0])
_HIGH = LegendItem("high", "95th percentile", PALETTE[2], "dash")
_EXPECTED = LegendItem("", "expected", INK)


def error_figures(dataset: Dataset, truth: Mapping[str, TruePath]) -> tuple[Block, ...]:
    """Figures of the errors of the reference poses; the true path of every run must be known."""
    errors = [run_errors(run, truth[run.id]) for run in dataset.trajectories]
    figures = [
        _curves(errors, lambda e: e.times, lambda e: 1e3 * e.position, "t (s)", "position error (mm)"),
        _curves(errors, lambda e: e.times, lambda e: np.degrees(e.heading), "t (s)", "heading error (°)"),
        _curves(errors, lambda e: e.driven, lambda e: 1e3 * e.position, "distance (m)", "position error (mm)"),
        _curves(errors, lambda e: e.driven, lambda e: np.degrees(e.heading), "distance (m)", "heading error (°)"),
        _histogram([1e3 * e.position[-1] for e in errors], "mm", "Final position errors"),
        _histogram([float(np.degrees(e.heading[-1])) for e in errors], "°", "Final heading errors"),
    ]
    drawn = f", of which {count(_RUNS)} are drawn as thin lines" if len(errors) > _RUNS else ""
    caption = (
        f"{plural(len(errors), 'run')}{drawn}; mean and percentile in bins of time or distance. Errors are "
        "magnitudes at the stamps of the reference poses, without the start."
    )
    curves = FigureGrid(tuple(figures), (_RUN, _MEAN, _HIGH), 2, caption)
    return (curves, *_nees_figures(errors))


def _nees_figures(errors: Sequence[RunErrors]) -> tuple[Block, ...]:
    """The normalised estimation error squared (NEES): its distribution and its course over time."""
    known = [run.of(np.isfinite(run.nees)) for run in errors if run.nees is not None]
    if not sum(len(run.times) for run in known):
        return ()
    values = np.concatenate([_squares(run) for run in known])
    limit = max(12.0, 1.2 * float(np.quantile(values, 0.98)))
    edges = np.linspace(0.0, limit, 40)
    heights, _ = np.histogram(values, edges)
    share = heights / len(values) / np.diff(edges)
    x = np.linspace(0.0, limit, 200)
    bars = _bars(edges, share, 0.6, "%{y:.3f} at %{x:.1f}")
    density = np.sqrt(x / (2 * np.pi)) * np.exp(-x / 2)  # chi-squared with three degrees of freedom
    distribution = Figure(
        f"NEES of all poses: mean {significant(float(values.mean()), 3)}",
        plot(bars, line(_EXPECTED, 2.0, x, density), x_title="NEES", y_title="density"),
        "Histogram of the normalised squared errors with the density that right covariances give",
        340,
    )
    time = _curves(known, lambda e: e.times, _squares, "t (s)", "NEES", level=3.0)
    caption = (
        "NEES: the squared error weighted by the inverse covariance. Its mean is 3 (line) where covariances are right, "
        f"and larger where they are too small. {_beyond(values, limit)}"
    )
    return (FigureGrid((distribution, time), (_RUN, _MEAN, _HIGH), 2, caption.strip()),)


def _beyond(values: Array, limit: float) -> str:
    beyond = int((values > limit).sum())
    return f"{count(beyond)} of {count(len(values))} lie beyond the histogram." if beyond else ""


def _squares(errors: RunErrors) -> Array:
    assert errors.nees is not None  # runs without covariances are left out before
    return errors.nees


def _curves(
    errors: Sequence[RunErrors],
    along: Callable[[RunErrors], Array],
    value: Callable[[RunErrors], Array],
    x_title: str,
    y_title: str,
    level: float | None = None,
) -> Figure:
    """The errors of runs as thin lines, with mean and 95th percentile in bins."""
    drawn = [errors[index] for index in evenly(len(errors), _RUNS)]
    lines = joined([np.column_stack([along(run), value(run)]) for run in drawn])
    x, y = (np.concatenate([quantity(run) for run in errors]) for quantity in (along, value))
    edges = np.linspace(0.0, float(x.max()) * (1 + 1e-9) or 1.0, _BINS + 1)
    bin_of = np.digitize(x, edges) - 1
    bins = [index for index in range(_BINS) if (bin_of == index).sum() >= _LEAST]
    middles = np.array([float(x[bin_of == index].mean()) for index in bins])
    traces = [line(_RUN, 0.8, *lines.T, opacity=0.6)]
    for item, statistic in ((_MEAN, np.mean), (_HIGH, lambda v: np.quantile(v, 0.95))):
        level_of = np.array([float(statistic(y[bin_of == index])) for index in bins])
        traces.append(line(item, 2.4, middles, level_of, hover=f"{item.label} %{{y:.3g}} at %{{x:.2f}}"))
    figure = plot(*traces, x_title=x_title, y_title=y_title)
    figure.update_yaxes(rangemode="tozero")
    if level is not None:
        figure.add_hline(level, line={"color": QUIET, "width": 1})
    name, by = y_title.split(" (")[0], "time" if x_title.startswith("t ") else "distance driven"
    title = f"{name[:1].upper()}{name[1:]} over {by}"
    return Figure(title, figure, f"{title} of every run, with its mean and 95th percentile", 340)


def _histogram(values: Sequence[float], unit: str, title: str) -> Figure:
    heights, edges = np.histogram(values, bins=min(40, max(8, len(values) // 8)))
    bars = _bars(edges, heights, 0.75, f"%{{y}} runs about %{{x:.3g}} {unit}")
    mean, high = float(np.mean(values)), float(np.quantile(values, 0.95))
    gap = "" if unit == "°" else " "
    headline = f"{title}: mean {significant(mean, 2)}{gap}{unit}, 95 % below {significant(high, 2)}{gap}{unit}"
    figure = plot(bars, x_title=f"error ({unit})", y_title="runs", bargap=0)
    return Figure(headline, figure, f"Histogram of {title.lower()} in {unit}", 320)


def _bars(edges: Array, heights: Array, opacity: float, hover: str) -> go.Bar:
    return go.Bar(
        x=coordinates((edges[:-1] + edges[1:]) / 2),
        y=coordinates(heights),
        width=float(edges[1] - edges[0]),
        marker={"color": PALETTE[0], "opacity": opacity},
        hovertemplate=f"{hover}<extra></extra>",
    )
