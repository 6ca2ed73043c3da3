"""Verdicts in words, numbers in the units of their readers, and the tables of a discovery."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

from omnibench.data.dataset import Dataset
from omnibench.discover import result
from omnibench.discover.result import SURE
from omnibench.registry import effects
from omnibench.report.blocks import Cell, Column, Row, Table
from omnibench.report.numbers import NOTHING, count, decimals_for, fixed, percent, significant, span, with_unit
from omnibench.robot.effects.effect import Stage
from omnibench.words import plural

VERDICTS: Mapping[result.Verdict, str] = {
    "none": "nothing is missing",
    "named": "found and named",
    "class": "found; which of a class is open",
    "incomplete": "found and named, but something is left",
    "unknown": "something is missing that has no name",
}
STAGES: Mapping[Stage, str] = {
    "actuator": "target to wheel rate",
    "wheel": "wheel rate to motion of the wheel",
    "steering": "measured to true steering angle",
    "clock": "stamps of the wheel samples",
    "body": "wheels to twist",
    "world": "twist to pose",
    "reference": "pose to reported pose",
}
METRICS: Mapping[Literal["eq6", "chi2"], str] = {"eq6": "Eq. (6), final poses", "chi2": "whitened χ² per residual"}

# Share of the error before, below which a gap was there, even if nobody knows how small errors could be (chosen).
_BETTER = 0.95
# Times the plain matrix's bound: a larger one of the extended model, which its training says nothing of, is no figure
# to go by. Words alone hang on it (chosen; on omni3's squares the bounds are 50 to 2,000 times as large).
_UNBOUNDED = 10.0
_DIMENSIONLESS = ("", "1")  # how effects write the unit of a parameter without a dimension
# Units that people read in place of SI units: factor and unit.
_READ_AS: Mapping[str, tuple[float, str]] = {
    **dict.fromkeys(_DIMENSIONLESS, (100.0, "%")),
    "m": (1e3, "mm"),
    "m/s": (1e3, "mm/s"),
    "s": (1e3, "ms"),
    "rad": (math.degrees(1.0), "°"),
    "rad/s": (math.degrees(1.0), "°/s"),
    "1/s": (3.6e5, "%/h"),
    "s/s": (1e6, "µs/s"),
}


def reading(unit: str) -> tuple[float, str]:
    """The factor by which a quantity in an SI unit is multiplied for its readers, and the unit that it then has."""
    return _READ_AS.get(unit, (1.0, unit.replace("s2", "s²")))


def value_and_interval(parameter: result.EstimatedParameter) -> tuple[str, str, str]:
    """A parameter's value, 95 % interval (empty if it has none) and unit, with the same decimals."""
    is_number = parameter.shape and parameter.unit in _DIMENSIONLESS
    factor, unit = (1.0, "") if is_number else reading(parameter.unit)
    value, low, high = factor * parameter.value, factor * parameter.low, factor * parameter.high
    if parameter.shape or not (math.isfinite(low) and math.isfinite(high)):
        return f"{value:.4g}".replace("-", "−"), "", unit
    decimals = decimals_for(max((high - low) / 2, 1e-4 * abs(value)), 2)
    return fixed(value, decimals, signed=True), span(low, high, decimals, signed=True), unit


def weight_in_words(weight: float) -> str:
    """A weight as per cent, rounded neither up to 100 % nor down to 0."""
    if weight > 0.999:
        return "> 99.9 %"
    return "< 0.1 %" if weight < 0.001 else percent(weight)


def chance(p_value: float) -> str:
    """A p-value, of two significant digits where it is not small."""
    return "< 10⁻⁹⁹" if p_value < 1e-99 else significant(p_value, 2 if p_value >= 1e-3 else 1)


def verdict_in_words(discovery: result.Discovery) -> str:
    """The verdict; where nothing was found, what speaks against that nothing is missing."""
    if discovery.verdict != "none":
        return VERDICTS[discovery.verdict]
    if discovery.sessions.differences:
        return "nothing is missing in the training runs, but the sessions differ"
    if discovery.sessions.other_commands is not None:
        return "nothing is missing in the training runs, but the held-out runs, of other commands, deviate"
    if discovery.few:
        return "nothing was found, but so few runs can show hardly anything"
    if discovery.sessions.doubts:
        return "nothing was found in the training runs, but whether the sessions differ cannot be said"
    return VERDICTS["none"]


def answer(discovery: result.Discovery) -> str:
    """What each effect does to the robot and what was gained on held-out runs; without an effect, the headline."""
    if not discovery.effects or not discovery.extends:
        return discovery.headline
    doubt = "" if all(effect.class_weight >= SURE for effect in discovery.effects) else "Likeliest, but not sure: "
    causes = []
    for effect in discovery.effects:
        entry = effects.entry(effect.name)
        what = entry.summary.partition(":")[0].rstrip(".") if entry.cls.in_catalogue else "Something that has no name"
        alike = f"; it may as well be {' or '.join(effect.confusable_with)}" if effect.confusable_with else ""
        causes.append(f"{what} ({effect.name}{alike}).".replace("_", " "))
    gain = "No run was held out to show what that gains."
    if (held := decisive(discovery)) is not None:
        before, after = (
            f"{1e3 * position:.0f} mm and {math.degrees(heading):.1f}°"
            for position, heading in zip(held.position_m, held.heading_rad, strict=True)
        )
        gain = f"With it in the model, the held-out error goes from {before} to {after}."
    return f"{doubt}{' '.join(causes)} {gain}"


def decisive(discovery: result.Discovery) -> result.HeldOut | None:
    """The held-out data that are the hardest test: another session if there is one, else repetitions."""
    return max(discovery.held_out, key=lambda held: held.data == "session", default=None)


def held_out_runs(discovery: result.Discovery, held: result.HeldOut) -> str:
    """Kind and number of held-out runs: ``held-out repetitions: 36 runs``; a session only where sessions are known."""
    if held.data == "session":
        kind = "held-out session" if discovery.has_other_session else "held-out runs"
    elif discovery.noise.source == "repetitions":
        kind = "held-out repetitions"
    else:
        several = len(discovery.held_out) > 1 and not discovery.has_other_session
        kind = "training runs, held out in turn" if several else "held-out runs"
    return f"{kind}: {plural(held.runs, 'run')}"


def final_errors(held: result.HeldOut) -> tuple[tuple[str, ...], ...]:
    """Name and mean, before and after, of the final position's and of the final heading's error."""
    position = (with_unit(fixed(1e3 * error, 1), "mm") for error in held.position_m)
    heading = (with_unit(fixed(math.degrees(error), 2), "°") for error in held.heading_rad)
    return ("Final position error, mean", *position), ("Final heading error, mean", *heading)


def closed_share(gap: result.Gap) -> str:
    """The share of a gap that is closed, or that there is no gap, or none that is known."""
    if gap.closed is None:
        return "no share known" if gap.after < _BETTER * gap.before else "no gap to close"
    return percent(gap.closed)


def gap_values(gap: result.Gap) -> tuple[str, str, str]:
    """Before, after and floor of a gap, with decimals that show each to three significant digits."""
    values = (gap.before, gap.after, gap.floor or 0.0)
    decimals = min(6, max(2, decimals_for(min((value for value in values if value > 0), default=0.0), 3)))
    return fixed(gap.before, decimals), fixed(gap.after, decimals), fixed(gap.floor, decimals)


def gap_table(discovery: result.Discovery) -> Table:
    """Both gaps and the final errors on every kind of held-out runs; the gap on the training runs if none are."""
    columns = [Column("Before"), Column("After"), Column("Floor"), Column("Closed")]
    shown = (0, 1, 2, 3) if discovery.extends else (0, 2)
    if not discovery.extends:
        columns[0] = Column("Plain matrix")

    def row(name: str, values: Sequence[str], error: float | None = None) -> Row:
        return Row.of(name, *(values[index] for index in shown), significant(error, 2))

    def of_gap(gap: result.Gap) -> Row:
        return row(METRICS[gap.metric], (*gap_values(gap), closed_share(gap)), gap.standard_error)

    rows = [] if discovery.held_out else [of_gap(discovery.gap)]
    for held in discovery.held_out:
        rows += [Row.of(held_out_runs(discovery, held), role="group"), of_gap(held.eq6), of_gap(held.chi2)]
        rows += [row(name, (before, after, NOTHING, NOTHING)) for name, before, after in final_errors(held)]
    return Table(
        "On held-out runs" if discovery.held_out else "The gap on the training runs",
        (
            Column("Measure", numeric=False),
            *(columns[index] for index in shown),
            Column("Std. error of the gap", priority=1),
        ),
        tuple(rows),
        "Before: the plain matrix; after: the extended model. Floor: what the scatter between repetitions of a command "
        "leaves to any model; none where no command is repeated, or where a model errs less. Closed: the share of "
        "before − floor that is gone, where that is more than two standard errors.",
    )


def dependence_table(dependences: Sequence[result.CovariateDependence], caption: str) -> Table:
    """The covariates that the residual depends on, with their significance."""
    rows = tuple(
        Row.of(
            Cell(each.covariate, f"{each.stage}: {STAGES[each.stage]}"),
            each.description,
            chance(each.p_value),
            weight_in_words(each.weight),
            significant(each.excess, 3),
            count(each.degrees_of_freedom),
        )
        for each in dependences
    )
    return Table(
        caption,
        (
            Column("Residual over", numeric=False),
            Column("In words", numeric=False),
            Column("Chance"),
            Column("It is this", priority=1),
            Column("Excess", "χ²", priority=1),
            Column("Degrees of freedom", priority=2),
        ),
        rows,
        "Chance: how often noise alone would give as much in any of the covariates that were tried. It is this: "
        "probability that what is missing depends on this covariate rather than on another. Excess: whitened χ² beyond "
        "the degrees of freedom.",
    )


def parameter_table(found: Sequence[result.NamedEffect], dataset: Dataset) -> Table:
    """The parameters of every effect with their intervals."""
    catalogue = {entry.name for entry in effects.entries()}
    sessions = tuple(dict.fromkeys(run.session for run in dataset.trajectories if run.session is not None))
    rows: list[Row] = []
    for effect in found:
        meanings: dict[str, str] = {}
        if effect.name in catalogue:  # else a term that has no name
            parameters = effects.create(effect.name).parameters(dataset.robot, sessions)
            meanings = {each.name: each.description for each in parameters}
        alike = f", cannot be told from {' or '.join(effect.confusable_with)}" if effect.confusable_with else ""
        words = f"weight {weight_in_words(effect.weight)}{alike}; {effect.form or 'as in the textbook'}"
        rows.append(Row.of(f"{effect.name} ({effect.stage}), {words}", role="group"))
        for each in effect.parameters:
            value, interval, unit = value_and_interval(each)
            kept = "chosen among a few" if each.shape else interval or NOTHING
            rows.append(Row.of(Cell(each.name, meanings.get(each.name, "")), value, kept, unit or NOTHING))
    return Table(
        "Parameters of the effects that were added",
        (Column("Parameter", numeric=False), Column("Value"), Column("95 % interval"), Column("Unit", numeric=False)),
        tuple(rows),
    )


def experiment_table(experiment: result.Experiment) -> Table:
    """The runs of an experiment."""
    rows = [Row.of(each.motion, fixed(each.seconds, 1), count(each.runs)) for each in experiment.commands]
    return Table(
        f"What to drive to tell {experiment.separates[0]} from its look-alikes",
        (Column("Drive", numeric=False), Column("Each", "s"), Column("Runs")),
        tuple(rows),
    )


def hidden_table(hidden: Sequence[result.Hidden], most: int | None = None) -> Table:
    """The size that every effect could still have: its parameter that could be largest as a share of the plausible.

    most: effects that are shown, those with the largest shares; by default all.
    """

    def share(each: result.Hidden) -> float:
        return each.limit / each.plausible if each.plausible else math.inf

    largest: dict[str, result.Hidden] = {}
    for each in sorted(hidden, key=share, reverse=True):
        largest.setdefault(each.name, each)
    rows = []
    for each in list(largest.values())[:most]:
        factor, unit = reading(each.unit)
        sizes = (f"±{significant(factor * size, 2)}" for size in (each.limit, each.detectable, each.plausible))
        of_plausible = percent(share(each), 0) if share(each) < 100 else "> 10,000 %"
        rows.append(Row.of(each.name, each.parameter, *sizes, unit or NOTHING, of_plausible))
    return Table(
        "How large an effect of each kind could still hide",
        (
            Column("Effect", numeric=False),
            Column("Parameter", numeric=False),
            Column("At most (95 %)"),
            Column("Found nearly always above", priority=2),
            Column("Plausible"),
            Column("Unit", numeric=False),
            Column("Of the plausible", priority=1),
        ),
        tuple(rows),
        "At most: its parameter lies within ± this with 95 %, given what was added. All parameters: discovery.json.",
    )


def unseen_table(discovery: result.Discovery) -> Table:
    """Effects that a matrix reproduces, with the measurement that would show them, and those not looked for."""
    rows = [Row.of(each.name, "a matrix absorbs it", each.measurement or NOTHING) for each in discovery.measurements]
    rows += [Row.of(each.name, "not looked for", each.reason) for each in discovery.not_looked_for]
    return Table(
        "Any of these may be there, and these runs would not show it",
        tuple(Column(title, numeric=False) for title in ("Effect", "Why", "What would tell, or what is lacking")),
        tuple(rows),
        "A matrix reproduces what it absorbs to far below the noise on these data; no run of odometry would tell.",
    )


def extrapolation_table(extrapolations: Sequence[result.Extrapolation]) -> Table:
    """Motions that no training run had, with the error bounds there."""
    rows = []
    for each in extrapolations:
        bounded = each.after_m <= _UNBOUNDED * each.before_m  # False for NaN, too
        after = significant(1e3 * each.after_m, 3) if bounded else "cannot be said"
        rows.append(Row.of(each.command, each.description, significant(1e3 * each.before_m, 3), after))
    return Table(
        "Held-out motions that no training run drives: final position within (95 %)",
        (
            Column("Command", numeric=False),
            Column("What is new", numeric=False),
            Column("Plain matrix", "mm"),
            Column("Extended model", "mm"),
        ),
        tuple(rows),
        "There the extended model extrapolates, and its bound may be wider than the plain matrix's.",
    )
