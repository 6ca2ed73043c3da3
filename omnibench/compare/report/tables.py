"""Tables of a data set's results: the answer in brief, costs, final errors, entries, runs, matrices."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator

import numpy as np

from omnibench.compare.config import THEORETICAL_NAME
from omnibench.compare.report import view as views
from omnibench.compare.result import EntryStatistics, RunRecord
from omnibench.data.dataset import Split
from omnibench.fit.evaluate import positions_and_headings
from omnibench.fit.span import driven_span
from omnibench.registry import costs
from omnibench.report.blocks import Block, Cell, Code, Column, Row, RowRole, Table
from omnibench.report.numbers import NOTHING, count, decimals_for, fixed, listing, percent, seconds, significant
from omnibench.robot.kinematics import Array, relative_deviations
from omnibench.robot.physical import PhysicalParameter
from omnibench.words import plural


def answer_table(view: views.DatasetView) -> Table:
    """Every entry on the runs that are scored, in a line each: cost, improvement, final errors, verdict."""
    split, decimals = view.scored, view.cost_decimals
    rows = []
    for entry in sorted(view.statistics, key=lambda entry: (cost := entry.cost(split)) is None or cost.value):
        reached, run = entry.cost(split), entry.typical
        errors = None if run is None else view.errors(run, split)
        position, heading = (np.nan, np.nan) if errors is None else map(_mean, positions_and_headings(errors))
        rows.append(
            Row.of(
                entry.label,
                fixed(None if reached is None else reached.value, decimals),
                views.interval_cell(reached, decimals),
                views.improvement_cells(entry, split, 1)[0],
                fixed(1e3 * position, 1),
                fixed(math.degrees(heading), 2),
                _verdict(view, entry).text,
                role="best" if entry.is_best else "plain" if entry.answers else "failed",
            )
        )
    number = plural(len(view.dataset.split(split)), f"{views.SPLIT_NAMES[split]} run")
    return Table(
        f"{view.name}{' (simulated)' if view.dataset.simulated else ''}: {number}, cost {view.config.objective}",
        (
            Column("Entry", numeric=False),
            Column("Cost"),
            Column("95 % interval", priority=4),
            Column("Improvement", priority=1),
            Column("Position", "mm", priority=2),
            Column("Heading", "°", priority=3),
            Column("Verdict", numeric=False),
        ),
        tuple(rows),
    )


def _mean(values: Array) -> float:
    return views.mean_and_worst(values)[0]


def cost_words(view: views.DatasetView) -> str:
    """The cost's name and its summary, and the loss, if it is a robust one."""
    words = f"{view.config.cost_name}: {costs.entry(view.config.cost_name).summary.rstrip('.')}."
    if view.config.loss == "squares":
        return words
    return f"{words} It was fitted with the loss {view.config.loss}; figures here are without it."


def cost_table(view: views.DatasetView, split: Split) -> Table:
    """Table 2 (training) or 3 (validation) of the paper, with intervals."""
    decimals = view.cost_decimals
    before = fixed(view.theoretical_cost(split), decimals)
    design = Cell(before, views.interval_cell(view.design_costs.get(split), decimals))
    rows = [Row.of(view.entry_cell(None), design, NOTHING, NOTHING)]
    for entry in view.statistics:
        reached = entry.cost(split)
        if entry.calibrator == THEORETICAL_NAME:
            continue
        if reached is None:
            outcome = next(run.record.outcome.value for run in view.runs if run.record.label == entry.label)
            cells = (before, Cell("no answer", outcome), NOTHING)
            rows.append(Row.of(view.entry_cell(entry), *cells, role="failed"))
            continue
        cost = Cell(fixed(reached.value, decimals), views.interval_cell(reached, decimals))
        improvement = Cell(*views.improvement_cells(entry, split, 2))
        role: RowRole = "best" if entry.is_best else "plain"
        rows.append(Row.of(view.entry_cell(entry), before, cost, improvement, role=role))
    published = [(result, ends) for result in view.config.published_results if (ends := result.costs(split))]
    if published:
        rows.append(Row.of("Published, on other data: not comparable row by row", role="group"))
    for result, (theirs, after) in published:
        shown = (fixed(theirs, 4), fixed(after, 4), percent(result.improvement(split), 2))
        rows.append(Row.of(Cell(result.label, result.source), *shown, role="muted"))
    number = plural(len(view.dataset.split(split)), f"{views.SPLIT_NAMES[split]} run")
    paper = f"As Table {2 if split == 'train' else 3} of the paper. " if view.of_the_paper else ""
    return Table(
        f"Cost of {number}",
        (
            Column("Entry", numeric=False),
            Column("Cost, design values", priority=1),
            Column(f"Cost, {views.SPLIT_NAMES[split]}"),
            Column("Improvement"),
        ),
        tuple(rows),
        f"{paper}The cost is {cost_words(view)} Small print: 95 % intervals, {view.units(split).ratio_words}, of the "
        "run with the median training cost.",
    )


def final_error_table(view: views.DatasetView, split: Split) -> Table:
    """Mean and worst final errors in position and heading, design values first."""
    errors: list[tuple[EntryStatistics | None, Array]] = [(None, view.design_errors[split])]
    errors += [(entry, after) for entry, run in view.calibrated if (after := view.errors(run, split)) is not None]
    factor, unit, decimals = views.position_unit(*(_mean(positions_and_headings(rows)[0]) for _, rows in errors))
    rows = []
    for entry, of_entry in errors:
        positions, headings = positions_and_headings(of_entry)
        cells = [fixed(factor * value, decimals) for value in views.mean_and_worst(positions)]
        cells += [fixed(np.degrees(value), 2) for value in views.mean_and_worst(headings)]
        role: RowRole = "best" if entry is not None and entry.is_best else "plain"
        rows.append(Row.of(view.entry_cell(entry), *cells, role=role))
    places = (Column("position, mean", unit), Column("position, worst", unit))
    columns = (Column("Entry", numeric=False), *places, Column("heading, mean", "°"), Column("heading, worst", "°"))
    return Table(f"Error of the final pose, {views.SPLIT_NAMES[split]} runs", columns, tuple(rows))


def entry_table(view: views.DatasetView) -> Table:
    """The entries: costs over their seeds, and the difference from the best."""
    split = view.scored
    rows = []
    for entry in view.statistics:
        spread = "" if entry.train_spread is None else f"spread {significant(entry.train_spread, 2)}"
        spread = "one seed" if entry.answers == 1 else spread
        difference = Cell(NOTHING)
        if entry.difference is not None and not entry.is_best:
            difference = Cell(*views.difference_cells(entry.difference))
        time = view.time_in_words(entry.seconds_median, entry.reference_evaluations_median)
        rows.append(
            Row.of(
                view.entry_cell(entry),
                f"{entry.answers} of {entry.runs}",
                Cell(fixed(entry.train_median, decimals_for(entry.train_median, 5)), spread),
                Cell(_gap(entry.gap_median), _proven(entry.proven_gap_median)),
                Cell(count(entry.evaluations_median), time),
                difference,
                _verdict(view, entry),
                role="best" if entry.is_best else "plain" if entry.answers else "failed",
            )
        )
    untimed = "" if view.config.timing else " The runs were not timed."
    if view.config.timing and not view.times_compare:
        untimed = " Runs were made on machines of different speed: times are in evaluations of the start's cost there."
    return Table(
        "Entries over their seeds",
        (
            Column("Entry", numeric=False),
            Column("Answers of runs", priority=1),
            Column("Cost, training, median"),
            Column("Gap above closed_form", "relative", priority=2),
            Column("Evaluations and time, median", priority=3),
            Column(f"Difference from the best in {views.SPLIT_NAMES[split]} cost"),
            Column("Verdict", numeric=False),
        ),
        tuple(rows),
        f"Spread: interquartile range over seeds. Gap: of the same box; {NOTHING} where closed_form has no answer or "
        "leaves no error. Proven: the share of the cost that any optimiser could still save in that box, at most. "
        f"Difference: paired by {view.units(split).name}, with its 95 % interval, {view.units(split).ratio_words}. Not "
        "told apart: it contains zero, or the difference is below a tenth of the standard error of the best entry's "
        "cost. Best: the lowest training cost of the entries that are not known to differ from the one of lowest "
        f"{views.SPLIT_NAMES[split]} cost.{_held(view)}{untimed}",
    )


def _verdict(view: views.DatasetView, entry: EntryStatistics) -> Cell:
    if entry.typical is None:
        return Cell("no answer")
    if entry.is_best:
        return Cell("lowest training cost" if view.undecided else "best", views.rivals_cell(view))
    if entry.practically_equal is None or entry.difference is None:
        return Cell("undecided", view.units(view.scored).ratio_words)
    if entry in view.rivals:
        return Cell("not told apart")
    if entry.practically_equal:  # the design values, as the headline has them
        return Cell("worse", "by its share of the cost")
    return Cell("worse") if entry.difference.value > 0 else Cell("lower cost here", "higher training cost")


def _held(view: views.DatasetView) -> str:
    """A sentence on elements that a box without width holds at the design value."""
    held: dict[str, list[str]] = {}
    for entry, run in view.calibrated:
        if run.record.held and entry.parameterisation == "matrix":
            held.setdefault(", ".join(run.record.held), []).append(entry.label)
    words = "; ".join(f"{names} ({listing(labels)})" for names, labels in held.items())
    return f" Held at the design value by a box without width there: {words}." if words else ""


def run_table(view: views.DatasetView) -> Table:
    """Every run, those without an answer with their reasons."""
    rows = []
    for record in (run.record for run in view.runs):
        digits = decimals_for(record.train_cost, 5)
        failed = record.matrix is None
        marks = [name for name in record.at_bounds if name not in record.held]
        rows.append(
            Row.of(
                Cell(record.label, "" if record.label == record.calibrator else record.calibrator),
                str(record.seed),
                Cell(record.outcome.value.replace("_", " "), record.reason),
                fixed(record.train_cost, digits),
                fixed(record.validation_cost, digits),
                Cell(_gap(record.gap), _proven(record.proven_gap)),
                Cell(count(record.evaluations), view.time_in_words(record.seconds, _references(record))),
                ", ".join(marks) or NOTHING,
                role="failed" if failed else "plain",
            )
        )
    return Table(
        "Every run",
        (
            Column("Entry", numeric=False),
            Column("Seed", priority=2),
            Column("Outcome", numeric=False),
            Column("Cost, training"),
            Column("Cost, held-out"),
            Column("Gap", priority=1),
            Column("Evaluations and time", priority=2),
            Column("On a bound", numeric=False, priority=3),
        ),
        tuple(rows),
    )


def _references(record: RunRecord) -> float | None:
    return record.seconds / record.reference_seconds if record.reference_seconds else None


def certificate_table(view: views.DatasetView) -> Iterator[Table]:
    """Lower bounds on the training cost, one for each box for which one is proven."""
    rows = [
        Row.of(
            each.box,
            significant(each.best_cost, 6),
            significant(each.lower_bound, 6),
            Cell(percent(each.gap, 2), "" if each.finished else "time or parts ran out"),
            Cell(count(each.parts), seconds(each.seconds)),
        )
        for each in view.certificates
    ]
    titles = ("Lowest training cost found", "No matrix of the box is below", "Left to gain, at most")
    columns = (Column("Box", numeric=False), *map(Column, titles), Column("Parts of the box, time"))
    note = "Proven by branch and bound on row 3 of the matrix, with rounding counted in, whichever search is used."
    if rows:
        yield Table("What no optimiser can beat", columns, tuple(rows), note)


def _gap(value: float | None) -> str:
    """A relative gap; 0 where it is smaller than rounding."""
    return "0" if value is not None and abs(value) < 5e-13 else significant(value, 2)


def _proven(value: float | None) -> str:
    return "" if value is None else f"proven: ≤ {percent(max(value, 0.0), 2)}"


def matrix_blocks(view: views.DatasetView) -> Iterator[Block]:
    """Matrices, their differences from the design values and from the reference entry, parameters, all digits."""
    names = [f"m{row}{column}" for row in (1, 2, 3) for column in range(1, len(view.dataset.robot.drive.names) + 1)]
    rows = [Row.of(view.entry_cell(None), *(fixed(float(v), 6) for v in view.design_matrix.ravel()))]
    for entry, run in view.calibrated:
        if run.matrix is not None:
            marks = _marks(run.record) if entry.parameterisation == "matrix" else {}
            values = zip(names, run.matrix.ravel(), strict=True)
            cells = [fixed(float(value), 6) + marks.get(name, "") for name, value in values]
            rows.append(Row.of(view.entry_cell(entry), *cells, role="best" if entry.is_best else "plain"))
    units = ["rad/rad" if name.startswith("m3") else "m/rad" for name in names]
    yield Table(
        "Inverse kinematic matrices M⁻¹",
        (Column("Entry", numeric=False), *map(Column, names, units)),
        tuple(rows),
        f"Columns of each row: {', '.join(view.dataset.robot.drive.names)}. † on a bound of its box; ‡ held by the "
        "box, which has no width there.",
    )
    reference, labels = view.reference_entry, [entry.label for entry, _ in view.calibrated]
    yield difference_table(view, None, labels)
    if reference is not None and len(labels) > 1:
        yield difference_table(view, reference.label, [label for label in labels if label != reference.label])
    of_paper = {entry.parameterisation: entry.label for _, entry, _ in view.published_entries}
    if {"geometry", "matrix"} <= of_paper.keys():
        yield difference_table(view, of_paper["matrix"], [of_paper["geometry"]])
    if any(run.record.parameters for _, run in view.calibrated):
        yield parameter_table(view)
    # So many digits that reading them gives exactly the same numbers
    named = [("theoretical", view.design_matrix)]
    named += [(entry.label, run.matrix) for entry, run in view.calibrated if run.matrix is not None]
    parts = []
    for label, matrix in named:
        lines = ",\n  ".join(f"[{', '.join(repr(float(value)) for value in row)}]" for row in matrix)
        parts.append(f"{json.dumps(label)}: [\n  {lines}]")
    yield Code("\n".join(parts), "Matrices with all digits (YAML): rows x and y in m/rad, heading in rad/rad")


def difference_table(view: views.DatasetView, against: str | None, labels: list[str]) -> Table:
    """Eq. (10), (11): differences of entries from the design values, or from the entry called ``against``."""
    matrices = {entry.label: run.matrix for entry, run in view.calibrated if run.matrix is not None}
    reference, robot = view.design_matrix if against is None else matrices[against], view.dataset.robot
    projector: Array | None = None
    if len(robot.drive.names) > len(robot.motions):  # across the span of what is driven a matrix is not determined
        driven = driven_span(view.dataset.split("train")).driven
        projector = driven.T @ driven
    rows = []
    for entry, _ in view.calibrated:
        if entry.label not in labels or entry.label not in matrices:
            continue
        moved = matrices[entry.label] - reference
        moved = moved if projector is None else moved @ projector
        shares = relative_deviations(reference + moved, reference).ravel()
        cells = []
        for number, (share, change) in enumerate(zip(shares, moved.ravel(), strict=True)):
            unit = "rad/rad" if number >= 2 * moved.shape[1] else "m/rad"
            absolute = Cell("0" if abs(change) < 1e-15 else significant(float(change), 2, signed=True), unit)
            cells.append(absolute if math.isnan(share) else Cell(f"{fixed(100 * float(share), 3, signed=True)} %"))
        rows.append(Row.of(view.entry_cell(entry), *cells))
    names = [f"m{row}{column}" for row in (1, 2, 3) for column in range(1, reference.shape[1] + 1)]
    return Table(
        f"Differences from {'the design values' if against is None else against}",
        (Column("Entry", numeric=False), *map(Column, names)),
        tuple(rows),
        "Element by element, as a share of the value compared with, or the change itself where that is 0."
        + (" Eq. (10) and (11) of the paper." if view.of_the_paper else "")
        + ("" if projector is None else " Compared on the span of drive signals that the data drive."),
    )


def parameter_table(view: views.DatasetView) -> Table:
    """Physical parameters of searched geometries and their deviation from the design values, as in section 4.2."""
    fitted = [(entry, run.record) for entry, run in view.calibrated if run.record.parameters]
    by_entry = [{each.name: each for each in record.parameters or ()} for _, record in fitted]
    rows = []
    for name in dict.fromkeys(name for parameters in by_entry for name in parameters):
        known = next(parameters[name] for parameters in by_entry if name in parameters)
        cells = [
            _parameter_cell(parameters.get(name), _marks(record).get(name, ""))
            for parameters, (_, record) in zip(by_entry, fitted, strict=True)
        ]
        rows.append(Row.of(name, _shown(known.design, known.unit), *cells))
    return Table(
        "Physical parameters and their deviation from the design values",
        (Column("Parameter", numeric=False), Column("design"), *(Column(entry.label) for entry, _ in fitted)),
        tuple(rows),
        ("As section 4.2 of the paper. " if view.of_the_paper else "")
        + "A geometry takes up whatever else is wrong with the model, so that a parameter by itself is no measurement "
        "of the robot. † on a bound of its limits; ‡ held by limits without width.",
    )


def _marks(record: RunRecord) -> dict[str, str]:
    """† for what a search moved to a bound, ‡ for what its box holds."""
    return {**dict.fromkeys(record.at_bounds, "†"), **dict.fromkeys(record.held, "‡")}


def _shown(value: float, unit: str) -> str:
    return f"{fixed(math.degrees(value), 3)}°" if unit == "rad" else f"{fixed(value, 5)} {unit}"


def _parameter_cell(parameter: PhysicalParameter | None, mark: str) -> Cell:
    if parameter is None:
        return Cell(NOTHING)
    share = parameter.deviation_percent
    deviation = "design is 0" if share is None else f"{fixed(share, 2, signed=True)} %"
    if parameter.unit == "rad":  # an angle's zero is a convention, so that no share of it means anything
        deviation = f"{fixed(math.degrees(parameter.deviation), 3, signed=True)}°"
    return Cell(_shown(parameter.value, parameter.unit) + (mark and f" {mark}"), deviation)
