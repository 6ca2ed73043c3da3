"""Figures of the motors: measured wheel rates minus their targets, before and after the actuator effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.report.before_after import AFTER, BEFORE, Curve, ModelStyle, Panel
from omnibench.discover.report.motion_figures import grid
from omnibench.discover.report.residuals import NORMAL_95, shares
from omnibench.discover.result import Discovery, NamedEffect
from omnibench.registry import effects
from omnibench.report.blocks import FigureGrid
from omnibench.robot.effects.effect import ActuatorEffect
from omnibench.robot.kinematics import Array

_BINS = 12  # bins along an axis; only the drawing hangs on it
_START = 2.0  # s from the start of a run that are drawn: ten time constants of a motor of 0.2 s
_MEASURED = ModelStyle("before", "measured − target", BEFORE)
_EXPECTED = ModelStyle("after", "measured − expected with the effects", AFTER, index=1)


def motor_grid(discovery: Discovery, runs: Sequence[Trajectory]) -> FigureGrid | None:
    """Errors of the wheel rates over the target rate and at the start of the runs; None without targets."""
    driven = [(run, run.targets) for run in runs if run.targets is not None]
    before: list[Array] = [run.rates - targets for run, targets in driven]
    if not driven or max(float(np.abs(each).max()) for each in before) == 0:
        return None
    motor_effects = [effect for effect in discovery.effects if effect.stage == "actuator"]
    errors: list[tuple[ModelStyle, list[Array]]] = [(_MEASURED, before)]
    if motor_effects:
        changes = [_changes(run, targets, motor_effects) for run, targets in driven]
        errors.append((_EXPECTED, [own - change for own, change in zip(before, changes, strict=True)]))
    targets = [each for _, each in driven]
    top = max(float(np.quantile(np.abs(each), 0.999)) for each in targets)
    edges = np.linspace(-top, top, _BINS + 1) * (1 + 1e-9)
    panels = []
    for index, wheel in enumerate(discovery.dataset.robot.measured):
        bins = [shares(each[:, index], edges) * (each[:, [index]] != 0) for each in targets]
        curves = tuple(_curve(style, bins, [each[:, index] for each in own]) for style, own in errors)
        panels.append(_panel(f"Wheel {wheel.name}, over its target", edges, curves, "target rate (rad/s)"))
    edges = np.linspace(0.0, min(_START, max(float(run.times[-1]) for run, _ in driven)), _BINS + 1)
    bins = [shares(run.times, edges) for run, _ in driven]
    curves = tuple(
        _curve(style, bins, [100 * _share(e, t) for e, t in zip(own, targets, strict=True)]) for style, own in errors
    )
    panels.append(
        _panel("All wheels, at the start of the runs", edges, curves, "time since the start (s)", "% of the target")
    )
    return grid(
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


def _curve(style: ModelStyle, bins: Sequence[Array], errors: Sequence[Array]) -> Curve:
    """Mean over the runs of each run's mean in a bin, with the scatter of the runs."""
    counts = np.array([each.sum(axis=0) for each in bins])
    sums = np.array([each.T @ own for each, own in zip(bins, errors, strict=True)])
    means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    runs = (counts > 0).sum(axis=0)
    enough = runs > 1
    value, spread = np.full(len(runs), np.nan), np.full(len(runs), np.nan)
    value[enough] = np.nanmean(means[:, enough], axis=0)
    spread[enough] = np.nanstd(means[:, enough], axis=0, ddof=1) / np.sqrt(runs[enough])
    return Curve(style, value, NORMAL_95 * spread)


def _share(errors: Array, targets: Array) -> Array:
    """Errors (F, N) projected on the targets, as shares (F,) of these."""
    size = np.abs(targets).mean(axis=1)
    share: Array = (np.sign(targets) * errors).mean(axis=1) / np.where(size > 0, size, np.inf)
    return share


def _panel(title: str, edges: Array, curves: tuple[Curve, ...], x_title: str, unit: str = "rad/s") -> Panel:
    return Panel(title, (edges[1:] + edges[:-1]) / 2, curves, x_title, f"difference ({unit})", unit)
