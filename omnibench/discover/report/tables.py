"""Tables of a discovery's report, and how its effects, errors and chances are said."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from omnibench.data.dataset import Dataset
from omnibench.discover import result
from omnibench.discover.selection.model_selection import SURE
from omnibench.registry import effects
from omnibench.report.blocks import Cell, Column, Row, Table
from omnibench.report.numbers import NOTHING, count, decimals_for, fixed, listing, percent, significant, span, with_unit
from omnibench.robot.effects.effect import Effect, Stage
from omnibench.words import kind_of_data, plural

VERDICTS: Mapping[result.Verdict, str] = {
    "none": "nothing is missing",
    "named": "found and named",
    "class": "found; which of a class is open",
    "incomplete": "found and named, but something is left",
    "unknown": "something is missing that has no name",
}
VERDICTS_AT_LENGTH: Mapping[result.Verdict, str] = {
    "none": "The residuals of the plain matrix are what the noise leaves: no effect is missing that these data show.",
    "named": "Every effect that was added has a weight of 95 % or more, and the residuals that are left are noise.",
    "class": "An effect is missing, and the data cannot tell the members of its class apart.",
    "incomplete": "What was added is named with a weight of 95 % or more, but the residuals still depend on something.",
    "unknown": "The residuals depend on something, and no effect explains it with a weight of 95 %.",
}
_FEW = "nothing was found, but so few runs can show hardly anything"
_DIFFER = "nothing is missing in the training runs, but the sessions differ"
_OTHER_COMMANDS = "nothing is missing in the training runs, but the held-out runs, of other commands, deviate"
_UNTESTED = "nothing was found in the training runs, but whether the sessions differ cannot be said"
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
_DEGREES = math.degrees(1.0)
# Units that people read in place of SI units: factor and unit.
_READ_AS: Mapping[str, tuple[float, str]] = {
    **dict.fromkeys(_DIMENSIONLESS, (100.0, "%")),
    "m": (1e3, "mm"),
    "m/s": (1e3, "mm/s"),
    "s": (1e3, "ms"),
    "rad": (_DEGREES, "°"),
    "rad/s": (_DEGREES, "°/s"),
    "1/s": (3.6e5, "%/h"),
    "s/s": (1e6, "µs/s"),
}


@dataclass(frozen=True)
class Reading:
    """The way in which a quantity in an SI unit is shown: multiplied by ``factor``, with ``unit``."""

    factor: float
    unit: str

    def number(self, value: float, digits: int = 3) -> str:
        """A value to ``digits`` significant digits, without its unit."""
        return significant(self.factor * value, digits)

    def words(self, value: float, digits: int = 3) -> str:
        """A value to ``digits`` significant digits, with its unit."""
        return with_unit(self.number(value, digits), self.unit)


def reading(unit: str) -> Reading:
    """The way in which a parameter in an SI unit is shown."""
    return Reading(*_READ_AS.get(unit, (1.0, unit.replace("s2", "s²"))))


def value_and_interval(parameter: result.EstimatedParameter) -> tuple[str, str, str]:
    """A parameter's value, 95 % interval (empty if it has none) and unit, with the same decimals."""
    shown = Reading(1.0, "") if parameter.shape and parameter.unit in _DIMENSIONLESS else reading(parameter.unit)
    value = shown.factor * parameter.value
    low, high = shown.factor * parameter.low, shown.factor * parameter.high
    if parameter.shape or not (math.isfinite(low) and math.isfinite(high)):
        return f"{value:.4g}".replace("-", "−"), "", shown.unit
    decimals = decimals_for(max((high - low) / 2, 1e-4 * abs(value)), 2)
    return fixed(value, decimals, signed=True), span(low, high, decimals, signed=True), shown.unit


def effect_in_words(effect: result.NamedEffect) -> str:
    """An effect's name with those that it cannot be told apart from."""
    others = effect.confusable_with
    return f"{effect.name}, or {' or '.join(others)}" if others else effect.name


def verdict_in_words(discovery: result.Discovery) -> str:
    """The verdict; where nothing was found, what speaks against that nothing is missing."""
    if discovery.verdict != "none":
        return VERDICTS[discovery.verdict]
    if discovery.sessions.differences:
        return _DIFFER
    if discovery.sessions.other_commands is not None:
        return _OTHER_COMMANDS
    if discovery.few:
        return _FEW
    return _UNTESTED if discovery.sessions.doubts else VERDICTS["none"]


def verdict_at_length(discovery: result.Discovery) -> str:
    """The verdict in a sentence."""
    words = verdict_in_words(discovery)
    if words == VERDICTS[discovery.verdict]:
        return VERDICTS_AT_LENGTH[discovery.verdict]
    return f"{words[0].upper()}{words[1:]}: no effect of the catalogue was added."


def added(step: result.Step) -> str:
    """The name of the effect that a step added."""
    return step.name.removeprefix("+ ")


def answer_in_words(discovery: result.Discovery) -> str:
    """The cause in plain words and what was gained on held-out runs; without a cause, the headline."""
    if not discovery.effects or not discovery.extends:
        return discovery.headline
    causes = " Also: ".join(f"{_cause_in_words(effect)}." for effect in discovery.effects)
    held = decisive(discovery)
    if held is None:
        return f"{causes} No run was held out to show what that gains."
    before, after = (
        f"{1e3 * position:.0f} mm and {math.degrees(heading):.1f}°"
        for position, heading in zip(held.position_m, held.heading_rad, strict=True)
    )
    return f"{causes} With it in the model, the held-out error goes from {before} to {after}."


def _cause_in_words(effect: result.NamedEffect) -> str:
    """What an effect does to the robot, its name, and the names that the data cannot tell from it."""
    entry = effects.entry(effect.name)
    what = entry.summary.partition(":")[0].rstrip(".") if entry.cls.in_catalogue else "Something that has no name"
    others = [name.replace("_", " ") for name in effect.confusable_with]
    alike = f"; it may as well be {listing(others, 3)}" if others else ""
    doubt = "" if effect.class_weight >= SURE else "Likeliest, but not sure: "
    return f"{doubt}{what} ({effect.name.replace('_', ' ')}{alike})"


def weight_in_words(weight: float) -> str:
    """A weight as per cent, rounded neither up to 100 % nor down to 0."""
    if weight > 0.999:
        return "> 99.9 %"
    return "< 0.1 %" if weight < 0.001 else percent(weight)


def worst_of_each(hidden: Sequence[result.Hidden]) -> tuple[result.Hidden, ...]:
    """The parameter of each effect that could be largest as a share of its plausible size; the largest share first."""
    ordered = sorted(hidden, key=share_of_plausible, reverse=True)
    first: dict[str, result.Hidden] = {}
    for each in ordered:
        first.setdefault(each.name, each)
    return tuple(first.values())


def share_of_plausible(hidden: result.Hidden) -> float:
    """The largest size that it could have, as a share of its plausible size."""
    return hidden.limit / hidden.plausible if hidden.plausible else math.inf


def chance(p_value: float) -> str:
    """A p-value in words."""
    if p_value < 1e-99:
        return "< 10⁻⁹⁹"
    return significant(p_value, 2) if p_value >= 1e-3 else significant(p_value, 1)


def closed_in_words(gap: result.Gap) -> str:
    """The share of a gap that is closed, or that there is no gap, or none that is known."""
    if gap.closed is None:
        return "no share known" if gap.after < _BETTER * gap.before else "no gap to close"
    return percent(gap.closed)


def gap_decimals(*gaps: result.Gap) -> int:
    """The decimals that show before, after and floor of these gaps to three significant digits."""
    values = [value for gap in gaps for value in (gap.before, gap.after, gap.floor or 0.0)]
    smallest = min((value for value in values if value > 0), default=0.0)
    return min(6, max(2, decimals_for(smallest, 3)))


def gap_in_words(gap: result.Gap) -> str:
    """``0.0412 → 0.0213 (floor 0.0205), 96.1 %``."""
    decimals = gap_decimals(gap)
    floor = "" if gap.floor is None else f" (floor {fixed(gap.floor, decimals)})"
    return f"{fixed(gap.before, decimals)} → {fixed(gap.after, decimals)}{floor}, {closed_in_words(gap)}"


def final_errors_in_words(discovery: result.Discovery, held: result.HeldOut) -> tuple[str, str]:
    """Mean final position and heading error, before and after; alone where nothing was added."""
    before, after = held.position_m
    turned, turned_after = (math.degrees(value) for value in held.heading_rad)
    if not discovery.extends:
        return f"{fixed(1e3 * before, 1)} mm", f"{fixed(turned, 2)}°"
    position = f"{fixed(1e3 * before, 1)} → {fixed(1e3 * after, 1)} mm"
    return position, f"{fixed(turned, 2)}° → {fixed(turned_after, 2)}°"


def held_out_in_words(discovery: result.Discovery, held: result.HeldOut) -> str:
    """The kind of held-out runs, such as ``held-out repetitions``; a session only where sessions are known."""
    if held.data == "session":
        return "held-out session" if discovery.has_other_session else "held-out runs"
    if discovery.noise.source == "repetitions":
        return "held-out repetitions"
    several = len(discovery.held_out) > 1 and not discovery.has_other_session
    return "training runs, held out in turn" if several else "held-out runs"


def floor_in_words(discovery: result.Discovery) -> str:
    """The meaning of the floor of a gap, in a sentence."""
    if discovery.noise.source != "repetitions":
        return "No command is repeated within a session: there is no floor."
    above = any(gap.floor is None for gap in (discovery.gap, *(g for h in discovery.held_out for g in (h.eq6, h.chi2))))
    return "The floor is what the scatter between repetitions of a command leaves to any model." + (
        " None stands where a model errs less than repetitions scatter." if above else ""
    )


def decisive(discovery: result.Discovery) -> result.HeldOut | None:
    """The held-out data that are the hardest test: another session if there is one, else repetitions."""
    return max(discovery.held_out, key=lambda held: held.data == "session", default=None)


def extrapolations_in_words(extrapolations: tuple[result.Extrapolation, ...]) -> tuple[str, ...]:
    """Motions of held-out runs on which the extended model extrapolates, a sentence each."""
    sentences = []
    for each in extrapolations:
        extended = f"within {_millimetres(each.after_m)} by the extended model (95 %)"
        if is_unbounded(each):
            extended = "by the extended model it cannot be said (95 %)"
        plain = f"Final position within {_millimetres(each.before_m)} by the plain matrix"
        sentences.append(f"{each.command}: {each.description}. {plain}, {extended}.")
    return tuple(sentences)


def is_unbounded(extrapolation: result.Extrapolation) -> bool:
    """True if the models that the data cannot tell apart say nothing of where the run ends."""
    return not extrapolation.after_m <= _UNBOUNDED * extrapolation.before_m


def _millimetres(metres: float) -> str:
    if not math.isfinite(metres):
        return NOTHING
    return f"{significant(1e3 * metres, 3)} mm" if metres < 1 else f"{significant(metres, 3)} m"


def data_in_words(discovery: result.Discovery) -> str:
    """The data in words: ``flower (simulated data): 180 training runs, 4,320 poses``."""
    kind = kind_of_data(discovery.dataset.simulated)
    runs = plural(len(discovery.trajectories), "training run")
    return f"{discovery.dataset.name} ({kind}): {runs}, {plural(discovery.poses, 'reference pose')}"


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
    rows: list[Row] = []
    for effect in found:
        meanings = _meanings(effect.name, dataset)
        others = effect.confusable_with
        alike = f", cannot be told from {' and '.join(others)}" if others else ""
        rows.append(
            Row.of(
                f"{effect.name} ({effect.stage}), weight {weight_in_words(effect.weight)}{alike}; "
                f"{effect.form or 'as in the textbook'}",
                role="group",
            )
        )
        for each in effect.parameters:
            value, interval, unit = value_and_interval(each)
            kept = "chosen among a few" if each.shape else interval or NOTHING
            rows.append(Row.of(Cell(each.name, meanings.get(each.name, "")), value, kept, unit or NOTHING))
    return Table(
        "Parameters of the effects that were added",
        (Column("Parameter", numeric=False), Column("Value"), Column("95 % interval"), Column("Unit", numeric=False)),
        tuple(rows),
    )


def _meanings(name: str, dataset: Dataset) -> Mapping[str, str]:
    """The meaning of an effect's parameters, by name; empty for a term that is no effect of the catalogue."""
    if name not in {entry.name for entry in effects.entries()}:
        return {}
    sessions = tuple(dict.fromkeys(run.session for run in dataset.trajectories if run.session is not None))
    effect: Effect = effects.create(name)
    return {each.name: each.description for each in effect.parameters(dataset.robot, sessions)}


def experiment_table(experiment: result.Experiment) -> Table:
    """The runs of an experiment."""
    rows = [Row.of(each.motion, fixed(each.seconds, 1), count(each.runs)) for each in experiment.commands]
    return Table(
        f"What to drive to tell {experiment.separates[0]} from its look-alikes",
        (Column("Drive", numeric=False), Column("Each", "s"), Column("Runs")),
        tuple(rows),
    )


def held_out_table(discovery: result.Discovery) -> Table:
    """Both gaps and the final errors on the held-out runs."""
    rows: list[Row] = []
    for each in discovery.held_out:
        where = f"{held_out_in_words(discovery, each)}: {plural(each.runs, 'run')}"
        rows += [Row.of(where, role="group"), *(_gap_row(discovery, gap) for gap in (each.eq6, each.chi2))]
        position, heading = final_errors_in_words(discovery, each)
        rows += [
            _plain_row(discovery, "Final position error, mean", position),
            _plain_row(discovery, "Final heading error, mean", heading),
        ]
    return Table("On held-out runs", _gap_columns(discovery), tuple(rows), _gap_note(discovery))


def gap_table(discovery: result.Discovery) -> Table:
    """The gap on the training runs."""
    title = "The gap on the training runs"
    return Table(title, _gap_columns(discovery), (_gap_row(discovery, discovery.gap),), _gap_note(discovery))


def _gap_columns(discovery: result.Discovery) -> tuple[Column, ...]:
    """Before and after; of the plain matrix alone where nothing was added."""
    columns = [Column("Before"), Column("After"), Column("Floor"), Column("Closed")]
    if not discovery.extends:
        columns = [Column("Plain matrix"), Column("Floor")]
    return Column("Measure", numeric=False), *columns, Column("Std. error of the gap", priority=1)


def _gap_note(discovery: result.Discovery) -> str:
    if not discovery.extends:
        return f"Nothing was added to the plain matrix. {floor_in_words(discovery)}"
    return (
        f"Before: the plain matrix; after: the extended model. {floor_in_words(discovery)} Closed: the share of "
        "before − floor that is gone, where that is more than two standard errors."
    )


def _gap_row(discovery: result.Discovery, gap: result.Gap) -> Row:
    decimals = gap_decimals(gap)
    before, after = fixed(gap.before, decimals), fixed(gap.after, decimals)
    floor = NOTHING if gap.floor is None else fixed(gap.floor, decimals)
    cells = (before, after, floor, closed_in_words(gap)) if discovery.extends else (before, floor)
    return Row.of(METRICS[gap.metric], *cells, significant(gap.standard_error, 2))


def _plain_row(discovery: result.Discovery, name: str, words: str) -> Row:
    if not discovery.extends:
        return Row.of(name, words, NOTHING, NOTHING)
    before, _, after = words.partition(" → ")
    unit = " mm" if after.endswith(" mm") else ""
    return Row.of(name, f"{before}{unit}", after, NOTHING, NOTHING, NOTHING)


def step_table(discovery: result.Discovery) -> Table:
    """The error after each step."""
    rows = []
    for index, step in enumerate(discovery.steps):
        values = (step.eq6_train, step.eq6_held_out, step.train, step.held_out)
        name = step.name if index == 0 else f"+ {added(step)}"
        rows.append(Row.of(name, *(significant(value, 4) for value in values)))
    return Table(
        "Step by step",
        (
            Column("Model", numeric=False),
            Column("Eq. (6)", "training"),
            Column("Eq. (6)", "held out"),
            Column("χ² per residual", "training"),
            Column("χ² per residual", "held out"),
        ),
        tuple(rows),
    )


def hidden_table(hidden: Sequence[result.Hidden]) -> Table:
    """The largest size that every effect could still have, the largest share of its plausible size first."""
    rows = []
    for each in sorted(hidden, key=share_of_plausible, reverse=True):
        shown, share = reading(each.unit), share_of_plausible(each)
        rows.append(
            Row.of(
                each.name,
                each.parameter,
                f"±{shown.number(each.limit, 2)}",
                f"±{shown.number(each.detectable, 2)}",
                f"±{shown.number(each.plausible, 2)}",
                shown.unit or NOTHING,
                percent(share, 0) if share < 100 else "> 10,000 %",
            )
        )
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
        "At most: its parameter lies within ± this with 95 %, given what was added.",
    )


def absorbed_table(discovery: result.Discovery) -> Table:
    """Effects that a matrix reproduces, and the measurement that would show them."""
    rows = tuple(
        Row.of(each.name, Cell(each.stage, STAGES[each.stage]), each.measurement or NOTHING)
        for each in discovery.measurements
    )
    return Table(
        "Absorbed: any of these may be there, and no odometry run would show it",
        (Column("Effect", numeric=False), Column("Stage", numeric=False), Column("What would tell", numeric=False)),
        rows,
        "A free matrix reproduces them on these data exactly, or to far below the noise. They are never named.",
    )


def not_looked_for_table(discovery: result.Discovery) -> Table:
    """Effects that these recordings cannot show."""
    rows = tuple(Row.of(each.name, each.reason) for each in discovery.not_looked_for)
    columns = (Column("Effect", numeric=False), Column("Why", numeric=False))
    return Table("Not looked for", columns, rows)


def extrapolation_table(extrapolations: Sequence[result.Extrapolation]) -> Table:
    """Motions that no training run had, with the error bounds there."""
    rows = tuple(
        Row.of(
            each.command,
            each.description,
            significant(1e3 * each.before_m, 3),
            "cannot be said" if is_unbounded(each) else significant(1e3 * each.after_m, 3),
        )
        for each in extrapolations
    )
    return Table(
        "Motions of the held-out runs that no training run drives",
        (
            Column("Command", numeric=False),
            Column("What is new", numeric=False),
            Column("Plain matrix", "mm"),
            Column("Extended model", "mm"),
        ),
        rows,
        "Bounds (95 %) of the final position error by each model.",
    )
