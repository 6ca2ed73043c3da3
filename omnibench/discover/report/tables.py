"""Tables of a discovery's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from omnibench.data.dataset import Dataset
from omnibench.discover.report.wording import (
    METRICS,
    STAGES,
    added,
    chance,
    closed_in_words,
    final_errors_in_words,
    floor_in_words,
    gap_decimals,
    held_out_in_words,
    is_unbounded,
    reading,
    share_of_plausible,
    value_and_interval,
    weight_in_words,
)
from omnibench.discover.result import (
    CovariateDependence,
    Discovery,
    Experiment,
    Extrapolation,
    Gap,
    Hidden,
    NamedEffect,
)
from omnibench.registry import effects
from omnibench.report.blocks import Cell, Column, Row, Table
from omnibench.report.numbers import NOTHING, count, fixed, percent, significant
from omnibench.robot.effects.effect import Effect
from omnibench.words import plural


def dependence_table(dependences: Sequence[CovariateDependence], caption: str) -> Table:
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


def parameter_table(found: Sequence[NamedEffect], dataset: Dataset) -> Table:
    """The parameters of every effect with their intervals."""
    rows: list[Row] = []
    for effect in found:
        meanings = _meanings(effect.name, dataset)
        others = [name for name in effect.confusable_with if name != effect.name]
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


def experiment_table(experiment: Experiment) -> Table:
    """The runs of an experiment."""
    rows = [Row.of(each.motion, fixed(each.seconds, 1), count(each.runs)) for each in experiment.commands]
    return Table(
        f"What to drive to tell {experiment.separates[0]} from its look-alikes",
        (Column("Drive", numeric=False), Column("Each", "s"), Column("Runs")),
        tuple(rows),
    )


def held_out_table(discovery: Discovery) -> Table:
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


def gap_table(discovery: Discovery) -> Table:
    """The gap on the training runs."""
    title = "The gap on the training runs"
    return Table(title, _gap_columns(discovery), (_gap_row(discovery, discovery.gap),), _gap_note(discovery))


def _gap_columns(discovery: Discovery) -> tuple[Column, ...]:
    """Before and after; of the plain matrix alone where nothing was added."""
    columns = [Column("Before"), Column("After"), Column("Floor"), Column("Closed")]
    if not discovery.extends:
        columns = [Column("Plain matrix"), Column("Floor")]
    return Column("Measure", numeric=False), *columns, Column("Std. error of the gap", priority=1)


def _gap_note(discovery: Discovery) -> str:
    if not discovery.extends:
        return f"Nothing was added to the plain matrix. {floor_in_words(discovery)}"
    return (
        f"Before: the plain matrix; after: the extended model. {floor_in_words(discovery)} Closed: the share of "
        "before − floor that is gone, where that is more than two standard errors."
    )


def _gap_row(discovery: Discovery, gap: Gap) -> Row:
    decimals = gap_decimals(gap)
    before, after = fixed(gap.before, decimals), fixed(gap.after, decimals)
    floor = NOTHING if gap.floor is None else fixed(gap.floor, decimals)
    cells = (before, after, floor, closed_in_words(gap)) if discovery.extends else (before, floor)
    return Row.of(METRICS[gap.metric], *cells, significant(gap.standard_error, 2))


def _plain_row(discovery: Discovery, name: str, words: str) -> Row:
    if not discovery.extends:
        return Row.of(name, words, NOTHING, NOTHING)
    before, _, after = words.partition(" → ")
    unit = " mm" if after.endswith(" mm") else ""
    return Row.of(name, f"{before}{unit}", after, NOTHING, NOTHING, NOTHING)


def step_table(discovery: Discovery) -> Table:
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


def hidden_table(hidden: Sequence[Hidden]) -> Table:
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


def absorbed_table(discovery: Discovery) -> Table:
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


def not_looked_for_table(discovery: Discovery) -> Table:
    """Effects that these recordings cannot show."""
    rows = tuple(Row.of(each.name, each.reason) for each in discovery.not_looked_for)
    columns = (Column("Effect", numeric=False), Column("Why", numeric=False))
    return Table("Not looked for", columns, rows)


def _extended_bound(extrapolation: Extrapolation) -> str:
    return "cannot be said" if is_unbounded(extrapolation) else significant(1e3 * extrapolation.after_m, 3)


def extrapolation_table(extrapolations: Sequence[Extrapolation]) -> Table:
    """Motions that no training run had, with the error bounds there."""
    rows = tuple(
        Row.of(each.command, each.description, significant(1e3 * each.before_m, 3), _extended_bound(each))
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
