"""The report's tables of costs, errors and outcomes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.compare.report.view import (
    SPLIT_NAMES,
    THEORETICAL_LOOK,
    THEORETICAL_NAME,
    DatasetView,
    is_bounded,
)
from omnibench.compare.report.wording import (
    cost,
    cost_decimals,
    difference_in_words,
    improvement_in_words,
    level_in_words,
    position_unit,
)
from omnibench.compare.result import BoxCertificate, EntryStatistics, Interval, RunRecord
from omnibench.data.dataset import Split
from omnibench.fit.evaluate import positions_and_headings
from omnibench.registry import costs
from omnibench.report.blocks import Cell, Column, Row, Table
from omnibench.report.numbers import (
    NOTHING,
    count,
    decimals_for,
    fixed,
    listing,
    percent,
    plural,
    seconds,
    significant,
    span,
)
from omnibench.robot.kinematics import Array


def cost_table(view: DatasetView, split: Split) -> Table:
    """Table 2 (training) or 3 (validation) of the paper, with intervals."""
    theoretical = view.theoretical_cost(split)
    decimals = cost_decimals(view)
    before = fixed(theoretical, decimals)
    ours = None if view.theoretical is None else cost(view.theoretical, split)
    first = Row((entry_cell(view, None), Cell(before, _span(ours, decimals)), Cell(NOTHING), Cell(NOTHING)))
    rows = [first]
    searched = [entry for entry in view.statistics if entry.calibrator != THEORETICAL_NAME]
    rows += [_cost_row(view, entry, split, before) for entry in searched]
    rows += _published_rows(view, split)
    number = len(view.dataset.split(split))
    return Table(
        caption=f"Cost of {plural(number, 'trajectory')}, {SPLIT_NAMES[split]}",
        columns=(
            Column("M⁻¹", numeric=False),
            Column("CF theoretical"),
            Column(f"CF {SPLIT_NAMES[split]}"),
            Column("Improvement"),
        ),
        rows=tuple(rows),
        note=f"As Table {2 if split == 'train' else 3} of the paper. CF is the cost {cost_in_words(view)} "
        "Small print: 95 % bootstrap intervals over trajectories, of the run with the median training cost.",
    )


def cost_in_words(view: DatasetView) -> str:
    """The cost's name and what it is."""
    return f"{view.config.cost.name}: {costs.entry(view.config.cost.name).summary.rstrip('.')}."


def final_error_table(view: DatasetView, split: Split) -> Table:
    """Mean and worst final errors in position and heading, design values first."""
    errors: list[tuple[EntryStatistics | None, Array]] = [(None, view.design_errors[split])]
    for entry, run in view.calibrated:
        found = view.errors(run, split)
        if found is not None:
            errors.append((entry, found))
    factor, unit, decimals = position_unit(*(float(positions_and_headings(e)[0].mean()) for _, e in errors))
    rows = []
    for entry_or_none, found in errors:
        positions, headings = positions_and_headings(found)
        cells = (
            entry_cell(view, entry_or_none),
            Cell(fixed(factor * positions.mean(), decimals)),
            Cell(fixed(factor * positions.max(), decimals)),
            Cell(fixed(np.degrees(headings.mean()), 2)),
            Cell(fixed(np.degrees(headings.max()), 2)),
        )
        rows.append(Row(cells, "best" if entry_or_none and entry_or_none.is_best else "plain"))
    return Table(
        caption=f"Error of the final pose, {SPLIT_NAMES[split]}",
        columns=(
            Column("M⁻¹", numeric=False),
            Column("position, mean", unit),
            Column("position, worst", unit),
            Column("heading, mean", "°"),
            Column("heading, worst", "°"),
        ),
        rows=tuple(rows),
    )


def entry_table(view: DatasetView) -> Table:
    """How each entry did over its seeds and against the best."""
    rows = []
    for entry in view.statistics:
        digits = decimals_for(entry.train_median, 5)
        rows.append(
            Row(
                (
                    entry_cell(view, entry),
                    Cell(f"{entry.answers} of {entry.runs}"),
                    Cell(fixed(entry.train_median, digits), _spread(entry)),
                    Cell(gap(entry.gap_median), proven(entry.proven_gap_median)),
                    Cell(count(entry.evaluations_median), seconds(entry.seconds_median)),
                    _difference(entry),
                    _verdict(view, entry),
                ),
                "best" if entry.is_best else "plain" if entry.answers else "failed",
            )
        )
    return Table(
        caption="Entries over their seeds",
        columns=(
            Column("Entry", numeric=False),
            Column("Answers of runs"),
            Column("CF training, median"),
            Column("Gap above exact optimum", "relative"),
            Column("Evaluations and time, median"),
            Column(f"Difference from the best in CF {SPLIT_NAMES[view.scored]}"),
            Column("Verdict", numeric=False),
        ),
        rows=tuple(rows),
        note="Spread: interquartile range over seeds. Gap: training cost relative to the exact optimum in the same box "
        f"(closed_form), minus one; {NOTHING} where that is not known. Proven: what share of the "
        "cost any optimiser could still save in that box, at most. Difference: paired over trajectories, with its "
        "95 % bootstrap interval. Practically equal: that interval contains zero, or the difference is below a tenth "
        "of the standard error of the best entry's cost. Best: the lowest training cost of the entries that are "
        f"practically equal to the one of lowest {SPLIT_NAMES[view.scored]} cost.{_held_in_words(view)}",
    )


def run_table(view: DatasetView) -> Table:
    """Every run, those without an answer too."""
    return Table(
        caption="Every run",
        columns=(
            Column("Entry", numeric=False),
            Column("Seed"),
            Column("Outcome", numeric=False),
            Column("CF training"),
            Column("CF validation"),
            Column("Gap"),
            Column("Evaluations and time"),
            Column("On a bound", numeric=False),
        ),
        rows=tuple(_run_row(view, run.record) for run in view.runs),
    )


def entry_cell(view: DatasetView, entry: EntryStatistics | None) -> Cell:
    """An entry's name with its colour; None stands for the design values."""
    if entry is None:
        return Cell(THEORETICAL_NAME, "design values", THEORETICAL_LOOK.colour)
    if entry.calibrator == THEORETICAL_NAME:
        note = "design values"
    elif not is_bounded(entry.calibrator):
        note = f"{entry.parameterisation}, as given"
    else:
        note = "geometry within limits" if entry.parameterisation == "geometry" else f"matrix, box {entry.box}"
    return Cell(entry.label, note, view.looks[entry.label].colour)


def on_bounds(record: RunRecord) -> list[str]:
    """Elements that the search moved to a bound; not those that the box holds, which had nowhere to go."""
    return [name for name in record.at_bounds if name not in record.held]


def gap(value: float | None) -> str:
    """A relative gap; below what arithmetic can tell it is zero."""
    if value is not None and abs(value) < 5e-13:
        return "0"
    return significant(value, 2)


def proven(value: float | None) -> str:
    """What share of a cost could be saved at most, as a note; nothing where nothing is proven."""
    return "" if value is None else f"proven: ≤ {percent(max(value, 0.0), 2)}"


def certificate_table(certificates: Sequence[BoxCertificate]) -> Table:
    """The boxes whose optimum is bounded by proof."""
    rows = [
        Row(
            (
                Cell(certificate.box),
                Cell(significant(certificate.best_cost, 6)),
                Cell(significant(certificate.lower_bound, 6)),
                Cell(percent(certificate.gap, 2), "" if certificate.finished else "time was up"),
                Cell(count(certificate.parts), seconds(certificate.seconds)),
            )
        )
        for certificate in certificates
    ]
    return Table(
        caption="What no optimiser can beat",
        columns=(
            Column("Box", numeric=False),
            Column("Lowest CF training found"),
            Column("No matrix of the box is below"),
            Column("Left to gain, at most"),
            Column("Parts of the box, time"),
        ),
        rows=tuple(rows),
        note="Proven by branch and bound on row 3 of the matrix, with rounding counted in: whichever search is used, "
        "and however long it runs, the training cost cannot fall below the bound while the matrix stays in the box.",
    )


def _cost_row(view: DatasetView, entry: EntryStatistics, split: Split, before: str) -> Row:
    reached = cost(entry, split)
    if reached is None:
        failed = [run.record for run in view.runs if run.record.label == entry.label]
        outcome = failed[0].outcome.value if failed else "no run"
        return Row((entry_cell(view, entry), Cell(before), Cell("no answer", outcome), Cell(NOTHING)), "failed")
    cells = (
        entry_cell(view, entry),
        Cell(before),
        Cell(fixed(reached.value, cost_decimals(view)), _span(reached, cost_decimals(view))),
        Cell(*improvement_in_words(entry, split, 2)),
    )
    return Row(cells, "best" if entry.is_best else "plain")


def _published_rows(view: DatasetView, split: Split) -> list[Row]:
    rows = []
    for result in view.config.published_results:
        before = result.theoretical_train_cost if split == "train" else result.theoretical_validation_cost
        after = result.train_cost if split == "train" else result.validation_cost
        if before is None or after is None:
            continue
        cells = (
            Cell(result.label, result.source),
            Cell(fixed(before, 4)),
            Cell(fixed(after, 4)),
            Cell(percent(1 - after / before, 2)),
        )
        rows.append(Row(cells, "muted"))
    if rows:
        rows.insert(0, Row((Cell("Published, on other data: not comparable row by row"),), "group"))
    return rows


def _span(interval: Interval | None, decimals: int) -> str:
    return "" if interval is None else span(interval.low, interval.high, decimals)


def _spread(entry: EntryStatistics) -> str:
    if entry.train_spread is None or entry.answers < 2:
        return "one seed" if entry.answers == 1 else ""
    return f"spread {significant(entry.train_spread, 2)}"


def _difference(entry: EntryStatistics) -> Cell:
    if entry.difference is None or entry.is_best:
        return Cell(NOTHING)
    return Cell(*difference_in_words(entry.difference))


def _verdict(view: DatasetView, entry: EntryStatistics) -> Cell:
    if entry.typical is None:
        return Cell("no answer")
    if entry.is_best:
        return Cell("best", level_in_words(view))
    if entry.practically_equal is None or entry.difference is None:
        return Cell(NOTHING)
    if entry.practically_equal:
        return Cell("practically equal")
    if entry.difference.value > 0:
        return Cell("worse")
    return Cell("lower cost here", "higher training cost")


def _held_in_words(view: DatasetView) -> str:
    """Elements without width, and the entries whose box holds them."""
    held: dict[tuple[str, ...], list[str]] = {}
    for entry, run in view.calibrated:
        if run.record.held:
            held.setdefault(run.record.held, []).append(entry.label)
    told = [f"{listing(list(names), 12)} ({listing(labels, 20)})" for names, labels in held.items()]
    return f" Held at the design value by a box without width there: {'; '.join(told)}." if told else ""


def _run_row(view: DatasetView, record: RunRecord) -> Row:
    answered = record.matrix is not None
    cells = (
        Cell(record.label, colour=view.looks[record.label].colour),
        Cell(str(record.seed)),
        Cell(record.outcome.value, record.reason),
        Cell(fixed(record.train_cost, 6)),
        Cell(fixed(record.validation_cost, 6)),
        Cell(gap(record.gap), proven(record.proven_gap)),
        Cell(count(record.evaluations), seconds(record.seconds)),
        Cell(", ".join(on_bounds(record)) if answered and on_bounds(record) else NOTHING),
    )
    return Row(cells, "plain" if answered else "failed")
