"""The section on where the plain model fails: covariates that the residuals depend on, and their figures.

The motors' figures are of measured wheel rates minus their targets, before and after the actuator effects.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.report import floor_figures, motion_figures, time_figures
from omnibench.discover.report.evidence_figures import command_blocks
from omnibench.discover.report.motion_figures import grid
from omnibench.discover.report.residuals import (
    AFTER,
    ALONE,
    BEFORE,
    EXTENDED,
    NORMAL_95,
    PLAIN,
    Curve,
    ModelStyle,
    Panel,
    Residuals,
    shares,
)
from omnibench.discover.report.tables import dependence_table
from omnibench.discover.result import Discovery, NamedEffect
from omnibench.registry import effects
from omnibench.report.blocks import Block, Details, FigureGrid, Paragraph, Section
from omnibench.report.numbers import listing
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


_FIGURES = {**time_figures.FIGURES, **motion_figures.FIGURES, **floor_figures.FIGURES}
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
    residuals = Residuals(discovery)
    # The styles of both models, or of the plain one alone if nothing was added
    pairs = zip(discovery.before, discovery.after, strict=True)
    styles = (ALONE,) if all(np.array_equal(*pair) for pair in pairs) else (PLAIN, EXTENDED)
    motors = motor_grid(discovery, residuals.runs)
    order = list(_NOT_DRAWN)  # new covariates come last
    drawn: dict[str, tuple[Block, ...]] = {
        covariate: tuple(grid for figure in _FIGURES[covariate] if (grid := figure(residuals, styles)) is not None)
        for covariate in sorted(_FIGURES, key=lambda name: order.index(name) if name in order else len(order))
    }
    drawn["motors"] = () if motors is None else (motors,)
    covariates = [
        "motors" if dependence.stage == "actuator" else dependence.covariate for dependence in discovery.where
    ]
    named = [name for name in dict.fromkeys(covariates) if name in drawn]
    sections = [Section("where-command", "Residuals by command", command_blocks(residuals, styles))]
    for number, name in enumerate(named, 1):
        if drawn[name]:
            sections.append(Section(f"where-{number}", _title(name), drawn[name]))
    others: list[Block] = [
        Details(_title(name), blocks) for name, blocks in drawn.items() if name not in named and blocks
    ]
    not_drawn = [f"{name} ({_NOT_DRAWN.get(name, 'not recorded')})" for name, blocks in drawn.items() if not blocks]
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
