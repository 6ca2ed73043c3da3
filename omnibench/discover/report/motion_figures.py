"""Figures of the error of the motion over heading, wheel rate, wheel angle and acceleration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.discover.report.residuals import (
    CIRCLE_95,
    NORMAL_95,
    Curve,
    Fitted,
    ModelStyle,
    Panel,
    Residuals,
    drawn,
    legend,
    shares,
)
from omnibench.report.blocks import Figure, FigureGrid
from omnibench.report.numbers import listing
from omnibench.robot.kinematics import Array

_BINS = 12  # bins along an axis; only the drawing hangs on it
_HEIGHT = 270  # px
_BY_CHANCE = 0.05  # share of the values that leave bands of 95 % by chance
_LEAST = 0.002  # share of the samples; a bin with fewer, 2 % of its even part, is left out of the drawing
_STILL = 1e-3  # rad/s, m/s; slower counts as standing
# Harmonics per turn, as in the bases of covariate dependence: by halves, then whole ones up to 16.
_HARMONICS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, *map(float, range(4, 17)))
# Why a test may find what no value of a figure shows.
_WITHIN = (
    "The test in the table above, of all values together and against noise alone, may still find a dependence: the "
    "band also holds what depends on other covariates, so that what is missing need not depend on this one."
)
# A figure over a covariate; None where the recordings do not show it.
CovariateFigure = Callable[[Residuals, Sequence[ModelStyle]], FigureGrid | None]
# Modes of the error of the motion: name, factor from SI, unit.
MODES = (
    ("along the way", 100.0, "% of the way"),
    ("across the way, to the left", 100.0, "% of the way"),
    ("in turning, to the left", math.degrees(1.0), "°/s"),
)


def motion_panels(
    residuals: Residuals,
    styles: Sequence[ModelStyle],
    bins: Array,
    x: Array,
    x_title: str,
    over: str,
    words: tuple[str, ...] = (),
    ticks: float | None = None,
) -> list[Panel]:
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
        panel = Panel(title, x, (), x_title, y_title, unit, words=words, ticks=ticks)
        parts.append((paths.of_twist(paths.tracked(direction), bins), factor, panel))
    return fitted_panels(residuals, styles, parts)


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
        own = [index for index, panel in enumerate(panels) if panel.unit == unit]
        for index, figure in zip(own, drawn([panels[index] for index in own]), strict=True):
            panel = panels[index]
            words = f"{panel.title}: {panel.y_title} against {panel.x_title}"
            figures[index] = Figure(panel.title, figure, words, _HEIGHT)
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


def heading_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
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
    return grid(panels, styles, "Heading and direction of travel are those of the reference's frame.")


def wheel_rate_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
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
            panel = Panel(title, _middles(edges), (), "wheel rate (rad/s)", "error (mm/s at the rim)", "mm/s")
            parts.append((paths.of_wheel(index, bins), 1e3 * wheel.radius, panel))
    return grid(fitted_panels(residuals, styles, parts), styles)


def wheel_angle_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
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
        panel = Panel(title, _middles(edges), (), x_title, "error of the rate (%)", "%", ticks=90)
        parts.append((paths.of_wheel(index, shares(turned, edges) * rates[:, [index]]), 100.0, panel))
    over = "the angle itself" if strongest == 1 else f"{strongest:g} times the angle, the harmonic that stands out most"
    caption = f"Top: the amplitude of each harmonic, fitted alone. Below: over {over}."
    return grid([*spectrum, *fitted_panels(residuals, styles, parts)], styles, caption)


def acceleration_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
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
            panel = Panel(title, x_factor * _middles(edges), (), x_title, y_title, unit)
            parts.append((paths.of_twist(np.tile(np.eye(3)[axis], (len(accelerations), 1)), bins), factor, panel))
    return grid(fitted_panels(residuals, styles, parts), styles)


def _spectrum_panels(residuals: Residuals, styles: Sequence[ModelStyle], angles: Array) -> list[Panel]:
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
        Panel(
            f"Wheel {paths.robot.wheel_names[wheel]}, amplitudes",
            np.array(_HARMONICS),
            tuple(
                Curve(style, 100 * amplitudes[style.index][wheel], 100 * CIRCLE_95 * noise[style.index][wheel])
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
    bins = shares(values, edges) * (1.0 if chosen is None else chosen[:, None])
    bins = bins * (bins.mean(axis=0) > least)
    return bins if bins.any(axis=0).sum() >= 3 else None


def _middles(edges: Array) -> Array:
    return (edges[1:] + edges[:-1]) / 2


# Figures over each covariate: a figure that is added here is shown.
FIGURES: Mapping[str, tuple[CovariateFigure, ...]] = {
    "heading": (heading_grid,),
    "wheel rate": (wheel_rate_grid,),
    "wheel angle": (wheel_angle_grid,),
    "acceleration": (acceleration_grid,),
}
