"""Figures of the error of the motion over heading, wheel rate, wheel angle and acceleration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from omnibench.discover.report.before_after import Curve, ModelStyle, Panel, drawn, legend
from omnibench.discover.report.residuals import CIRCLE_95, NORMAL_95, Fitted, Residuals, shares
from omnibench.report.blocks import Figure, FigureGrid
from omnibench.robot.kinematics import Array

_BINS = 12
_HEIGHT = 270  # px
_LEAST = 0.002  # share of the samples; a bin with fewer is left out (chosen)
_STILL = 1e-3  # rad/s, m/s; slower counts as standing
# Harmonics per turn, as in the bases of covariate dependence: by halves, then whole ones up to 16.
_HARMONICS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, *map(float, range(4, 17)))
# A figure over a covariate; None where the recordings do not show it.
CovariateFigure = Callable[[Residuals, Sequence[ModelStyle]], FigureGrid | None]
# Modes of the error of the motion: name, factor from SI, unit.
MODES = (
    ("along the way", 100.0, "% of the way"),
    ("across the way, to the left", 100.0, "% of the way"),
    ("in turning, to the left", math.degrees(1.0), "°/s"),
)


def fit_modes(residuals: Residuals, bins: Array) -> Fitted:
    """Fit of the error along the path, across it and in turning, constant in each bin: 3 B values, mode by mode.

    bins (F, B): the share of each sample in each bin.
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
    return residuals.fit(np.concatenate([paths.of_twist(each, bins) for each in directions], axis=2))


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
    """Three panels: the error along the path, across it and in turning, in each bin.

    bins (F, B): the share of each sample in each bin. x (B,): the position at which a bin is drawn.
    """
    count = bins.shape[1]
    fitted = fit_modes(residuals, bins)
    panels = []
    for index, (name, factor, unit) in enumerate(MODES):
        part = slice(index * count, (index + 1) * count)
        panel = _panel(fitted, part, factor, styles, x, f"Error {name}, over {over}", x_title, f"error ({unit})", unit)
        if not panel.empty:
            panels.append(replace(panel, words=words, ticks=ticks))
    return panels


def grid(panels: Sequence[Panel], styles: Sequence[ModelStyle], caption: str = "") -> FigureGrid | None:
    """Panels side by side, those of the same unit with the same scale; None without panels."""
    figures: list[Figure | None] = [None] * len(panels)
    for unit in dict.fromkeys(panel.unit for panel in panels):
        own = [index for index, panel in enumerate(panels) if panel.unit == unit]
        for index, figure in zip(own, drawn([panels[index] for index in own]), strict=True):
            panel = panels[index]
            words = f"{panel.title}: {panel.y_title} against {panel.x_title}"
            figures[index] = Figure(panel.title, figure, words, _HEIGHT)
    found = tuple(figure for figure in figures if figure is not None)
    columns: Literal[2, 3] = 2 if len(found) % 3 and len(found) % 2 == 0 else 3
    return FigureGrid(found, legend(styles, all(panel.shared for panel in panels)), columns, caption) if found else None


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
        bins = _filled(shares(wrapped, edges) * chosen[:, None])
        if bins.any(axis=0).sum() >= 3:
            panels += motion_panels(residuals, styles, bins, _middles(edges), title, over, ticks=90)
    return grid(panels, styles, "Heading and direction of travel are those of the reference's frame.")


def wheel_rate_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
    """The error of each wheel's rim speed over its rate."""
    paths = residuals.paths
    rates = paths.signals.rates
    columns, centres, names = [], [], []
    for wheel in range(rates.shape[1]):
        own = rates[:, wheel]
        top = float(np.quantile(np.abs(own), 0.998))
        if top < _STILL:
            continue
        edges = np.linspace(-top * 1.001, top * 1.001, _BINS + 1)
        bins = _filled(shares(own, edges) * (np.abs(own) > _STILL)[:, None])
        if bins.any(axis=0).sum() >= 3:
            columns.append(paths.of_wheel(wheel, bins))
            centres.append(_middles(edges))
            names.append(wheel)
    if not columns:
        return None
    fitted = residuals.fit(np.concatenate(columns, axis=2))
    panels, first = [], 0
    for wheel, middles in zip(names, centres, strict=True):
        part = slice(first, first + len(middles))
        first += len(middles)
        factor = 1e3 * paths.robot.wheels[wheel].radius
        title = f"Wheel {paths.robot.wheels[wheel].name}"
        panel = _panel(
            fitted, part, factor, styles, middles, title, "wheel rate (rad/s)", "error (mm/s at the rim)", "mm/s"
        )
        panels.append(panel)
    return grid([each for each in panels if not each.empty], styles)


def wheel_angle_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
    """The error over the angle of each wheel: amplitudes by harmonic, and its course over the strongest harmonic."""
    paths = residuals.paths
    angles, rates = paths.signals.wheel_angles, paths.signals.rates
    if angles is None or np.abs(rates).max() < _STILL:
        return None
    spectrum = _spectrum_panels(residuals, styles, angles)
    strongest = _strongest(spectrum)
    columns = []
    edges = np.linspace(0, 360, _BINS + 1)
    for wheel in range(rates.shape[1]):
        turned = np.degrees(strongest * angles[:, wheel]) % 360
        columns.append(paths.of_wheel(wheel, shares(turned, edges) * rates[:, [wheel]]))
    fitted = residuals.fit(np.concatenate(columns, axis=2))
    times = "" if strongest == 1 else f"{strongest:g} × "
    panels = []
    for wheel, each in enumerate(paths.robot.wheels):
        panel = _panel(
            fitted, slice(wheel * _BINS, (wheel + 1) * _BINS), 100.0, styles, _middles(edges),
            f"Wheel {each.name}, over its angle", f"{times}wheel angle (°)", "error of the rate (%)", "%",
        )  # fmt: skip
        panels.append(replace(panel, ticks=90))
    panels = [each for each in [*spectrum, *panels] if not each.empty]
    over = "the angle itself" if strongest == 1 else f"{strongest:g} times the angle, the harmonic that stands out most"
    caption = f"Top: the amplitude of each harmonic, fitted alone. Below: over {over}."
    return grid(panels, styles, caption)


def acceleration_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
    """The error of each component of the twist over its own acceleration."""
    paths = residuals.paths
    accelerations = paths.signals.accelerations
    columns, centres, kinds = [], [], []
    for axis in range(3):
        own = accelerations[:, axis]
        top = float(np.quantile(np.abs(own), 0.995))
        if top < 1e-3:
            continue
        edges = np.linspace(-top, top, 10)
        bins = _filled(shares(own, edges), 5e-4)
        if bins.any(axis=0).sum() >= 3:
            columns.append(paths.of_twist(np.tile(np.eye(3)[axis], (len(own), 1)), bins))
            centres.append(_middles(edges))
            kinds.append(axis)
    if not columns:
        return None
    fitted = residuals.fit(np.concatenate(columns, axis=2))
    panels, first = [], 0
    for axis, middles in zip(kinds, centres, strict=True):
        part = slice(first, first + len(middles))
        first += len(middles)
        name = ("Forward", "To the left", "In turning")[axis]
        factor, unit, x_factor, x_unit = (
            (1e3, "mm/s", 1.0, "m/s²") if axis < 2 else (math.degrees(1.0), "°/s", math.degrees(1.0), "°/s²")
        )
        panel = _panel(
            fitted, part, factor, styles, x_factor * middles, name, f"acceleration ({x_unit})", f"error ({unit})", unit
        )
        panels.append(panel)
    return grid([each for each in panels if not each.empty], styles)


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
            f"Wheel {paths.robot.wheels[wheel].name}, amplitudes",
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


def _strongest(spectrum: Sequence[Panel]) -> float:
    """The harmonic that stands out most in the plain model, over all wheels; 1 if none does."""
    ratios = np.array([np.nan_to_num(panel.curves[0].values / panel.curves[0].half_width) for panel in spectrum])
    together = np.square(ratios).mean(axis=0)
    return float(_HARMONICS[int(together.argmax())]) if together.max() > 1 else 1.0


def _panel(
    fitted: Fitted, part: slice, factor: float, styles: Sequence[ModelStyle], x: Array, title: str, x_title: str,
    y_title: str, unit: str,
) -> Panel:  # fmt: skip
    curves = tuple(
        Curve(style, factor * fitted.values[part, style.index], NORMAL_95 * factor * fitted.errors[part, style.index])
        for style in styles
    )
    return Panel(title, x, curves, x_title, y_title, unit)


def _filled(bins: Array, least: float = _LEAST) -> Array:
    """Bins (F, B) with those set to 0 that hold hardly any samples: nothing is fitted there."""
    return bins * (bins.mean(axis=0) > least)


def _middles(edges: Array) -> Array:
    return (edges[1:] + edges[:-1]) / 2


# Figures over each covariate: a figure that is added here is shown.
FIGURES: Mapping[str, tuple[CovariateFigure, ...]] = {
    "heading": (heading_grid,),
    "wheel rate": (wheel_rate_grid,),
    "wheel angle": (wheel_angle_grid,),
    "acceleration": (acceleration_grid,),
}
