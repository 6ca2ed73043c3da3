"""Figures of the wheels of a run: measured rates, their mean over 100 ms, targets, the difference, steering angles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go

from omnibench.data.dataset import Trajectory
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.numbers import decimals_for, fixed, significant
from omnibench.report.style import INK, PALETTE, plot
from omnibench.report.traces import line
from omnibench.robot.kinematics import Array, Robot

_MEAN_OVER = 0.1  # s; also in the legends
_DRAWN = 2000  # samples drawn at most (chosen: finer than a screen shows)
_ROW = 150  # px, height of a wheel's row
_GAP = 0.05  # space between rows, as a share of the plot

_HOVER = "{}<br>%{{y:.3f}} rad/s at %{{x:.2f}} s"
_MEASURED = LegendItem("measured", "measured", "#a9c9e8")
_MEAN = LegendItem("mean", "measured, mean over 100 ms", PALETTE[0])
_TARGET = LegendItem("target", "target", INK, "dash")
_STEERING = LegendItem("steering", "steering angle", PALETTE[3])
_ERROR = LegendItem("error", "measured − target, mean over 100 ms", PALETTE[2])


@dataclass(frozen=True, eq=False)
class _Series:
    """Piecewise constant values (n, N) between ``edges`` (n + 1,), s."""

    edges: Array
    values: Array

    @property
    def middles(self) -> Array:
        middles: Array = (self.edges[:-1] + self.edges[1:]) / 2
        return middles


def wheel_rates(trajectory: Trajectory, robot: Robot) -> FigureGrid:
    """Measured rates, targets and steering angles over time, a row for each wheel; with targets also the difference."""
    measured = _blocks(trajectory.times, trajectory.rates, max(1, -(-len(trajectory.times) // _DRAWN)))
    period = float(np.median(np.diff(trajectory.times, prepend=0.0)))
    size = max(1, round(_MEAN_OVER / period), -(-len(trajectory.times) // _DRAWN))
    mean = _blocks(trajectory.times, trajectory.rates, size)
    rows = [[_steps(_MEASURED, measured, w, 1.0), _line(_MEAN, mean, w, 1.8)] for w in range(len(robot.wheel_names))]
    items = [_MEASURED, _MEAN]
    words = []
    if len(measured.values) < len(trajectory.times):
        words.append(f"Samples are drawn as means over {significant(1e3 * size * period, 2)} ms.")
    step = rate_step(trajectory)
    if step is not None:
        words.append(
            f"The encoder resolves {significant(step, 3)} rad/s, one tick per sample; a mean over 100 ms is finer."
        )
    titles = [f"{name} (rad/s)" for name in robot.wheel_names]
    end = float(trajectory.times[-1])
    figures = []
    if trajectory.targets is not None:
        target = _blocks(trajectory.times, trajectory.targets, max(1, -(-len(trajectory.times) // _DRAWN)))
        for wheel, row in enumerate(rows):
            row.append(_steps(_TARGET, target, wheel, 1.6))
        error = _blocks(trajectory.times, trajectory.rates - trajectory.targets, size)
        errors = [[_line(_ERROR, error, wheel, 1.6)] for wheel in range(len(rows))]
        items += [_TARGET, _ERROR]
        figures.append(
            Figure(
                f"Measured − target: {_error_in_words(trajectory)}",
                _stacked(errors, titles, end, with_zero=True),
                "Difference of measured wheel rates and targets over time, one row a wheel",
                _ROW * len(rows) + 60,
            )
        )
    with_targets = bool(figures)
    description = "Wheel rates over time, one row a wheel" + (", with their targets" if with_targets else "")
    if trajectory.steering is not None:
        every = slice(None, None, max(1, -(-len(trajectory.times) // _DRAWN)))
        degrees = np.degrees(trajectory.steering[every].T)
        hover = "steering angle<br>%{y:.2f}° at %{x:.2f} s"
        angles = [[line(_STEERING, 1.8, trajectory.times[every], angle, hover=hover)] for angle in degrees]
        items.append(_STEERING)
        figures.append(
            Figure(
                "Steering angles",
                _stacked(angles, [f"{name} (°)" for name in robot.drive.steered], end),
                "Steering angles over time, one row a wheel",
                _ROW * len(angles) + 60,
            )
        )
    rates = Figure("Wheel rates", _stacked(rows, titles, end), description, _ROW * len(rows) + 60)
    return FigureGrid((rates, *figures), tuple(items), 2 if with_targets else 1, " ".join(words))


def rate_step(trajectory: Trajectory) -> float | None:
    """The quantisation step of the measured wheel rates, rad/s; None if they show no encoder ticks."""
    values = np.unique(np.round(trajectory.rates, 7))
    if not 2 <= len(values) <= trajectory.rates.size / 4:
        return None
    step = float(np.diff(values).min())
    multiples = values / step
    # Ticks counted over periods that vary would not be multiples.
    return step if np.abs(multiples - np.round(multiples)).max() < 0.02 else None


def _error_in_words(trajectory: Trajectory) -> str:
    assert trajectory.targets is not None
    error = (trajectory.rates - trajectory.targets).ravel()
    rms = float(np.sqrt((error**2).mean()))
    decimals = decimals_for(rms, 2)
    return f"mean {fixed(float(error.mean()), decimals)}, RMS {fixed(rms, decimals)} rad/s"


def _blocks(times: Array, values: Array, size: int) -> _Series:
    """Means over blocks of ``size`` samples, weighted by their durations; the last block may be shorter."""
    starts = np.arange(0, len(times), size)
    durations = np.diff(times, prepend=0.0)[:, None]
    weights = np.add.reduceat(durations, starts)
    means = np.round(np.add.reduceat(values * durations, starts) / weights, 9)  # an even rate stays even
    ends = times[np.minimum(starts + size, len(times)) - 1]
    return _Series(np.append(0.0, ends), means)


def _steps(item: LegendItem, series: _Series, wheel: int, width: float) -> go.Scatter:
    values = np.append(series.values[:, wheel], series.values[-1, wheel])
    return line(item, width, series.edges, values, hover=_HOVER.format(item.label), line_shape="hv")


def _line(item: LegendItem, series: _Series, wheel: int, width: float) -> go.Scatter:
    return line(item, width, series.middles, series.values[:, wheel], hover=_HOVER.format(item.label))


def _stacked(
    rows: Sequence[Sequence[go.Scatter]], titles: Sequence[str], end: float, with_zero: bool = False
) -> go.Figure:
    """Plots in rows above each other with a common time axis from 0 to ``end`` s."""
    height = (1 + _GAP) / len(rows) - _GAP
    layout: dict[str, Any] = {}
    traces = []
    for index, (row, title) in enumerate(zip(rows, titles, strict=True)):
        number = "" if index == 0 else str(index + 1)
        top = 1 - index * (height + _GAP)
        layout[f"yaxis{number}"] = {
            "domain": [max(0.0, top - height), top],
            "title": {"text": title},
            "zeroline": with_zero,
            "zerolinecolor": INK,
            "zerolinewidth": 1,
        }
        traces += [trace.update(yaxis=f"y{number}") for trace in row]
    last = "y" if len(rows) == 1 else f"y{len(rows)}"
    return plot(*traces, xaxis={"title": {"text": "t (s)"}, "anchor": last, "range": [0.0, end]}, **layout)
