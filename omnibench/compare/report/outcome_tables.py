"""The section on outcomes: entries over their seeds, proven bounds, every run."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.compare.report.view import SPLIT_NAMES, DatasetView
from omnibench.compare.report.wording import difference_in_words, entry_cell, interval_basis, on_bounds, rivals_in_words
from omnibench.compare.result import BoxCertificate, EntryStatistics, RunRecord
from omnibench.registry import calibrators
from omnibench.report.blocks import Block, Cell, Column, Details, Row, Section, Table
from omnibench.report.numbers import (
    NOTHING,
    count,
    decimals_for,
    fixed,
    listing,
    percent,
    seconds,
    significant,
)

_FOLDED_ABOVE = 20  # runs: a longer table of runs is folded away (chosen)


def outcome_section(view: DatasetView) -> Section:
    """The section "Outcomes": tables of the entries, of the proven bounds if there are any, and of all runs."""
    proofs = (certificate_table(view.certificates),) if view.certificates else ()
    runs: Block = run_table(view)
    if len(view.runs) > _FOLDED_ABOVE:
        runs = Details(f"Every run ({len(view.runs)})", (runs,))
    about = "Every entry over its seeds, beside the best; what no optimiser can beat; every run."
    return Section("outcomes", "Outcomes", (entry_table(view), *proofs, runs), about=about, folded=True)


def entry_table(view: DatasetView) -> Table:
    """A table of the entries: costs over their seeds, and the difference from the best."""
    rows = []
    for entry in view.statistics:
        digits = decimals_for(entry.train_median, 5)
        rows.append(
            Row.of(
                entry_cell(view, entry),
                f"{entry.answers} of {entry.runs}",
                Cell(fixed(entry.train_median, digits), _spread(entry)),
                Cell(gap(entry.gap_median), proven(entry.proven_gap_median)),
                Cell(
                    count(entry.evaluations_median),
                    view.time_in_words(entry.seconds_median, entry.reference_evaluations_median),
                ),
                _difference(entry),
                _verdict(view, entry),
                role="best" if entry.is_best else "plain" if entry.answers else "failed",
            )
        )
    return Table(
        caption="Entries over their seeds",
        columns=(
            Column("Entry", numeric=False),
            Column("Answers of runs", priority=1),
            Column("Cost, training, median"),
            Column(gap_title(view), "relative", priority=2),
            Column("Evaluations and time, median", priority=3),
            Column(f"Difference from the best in {SPLIT_NAMES[view.scored]} cost"),
            Column("Verdict", numeric=False),
        ),
        rows=tuple(rows),
        note="Spread: interquartile range over seeds. Gap: training cost relative to that of closed_form in the same "
        f"box, minus one; {NOTHING} where it has no answer or leaves no error. Proven: what share of the "
        "cost any optimiser could still save in that box, at most. "
        f"Difference: paired by {view.units[view.scored].name}, with its 95 % interval, "
        f"{interval_basis(view, view.scored)}. Not told apart: that interval contains zero, "
        "or the difference is below a tenth of the standard error of the best entry's cost; undecided: there is no "
        "interval. Best: the lowest training cost of the entries that are not known to differ from the one of lowest "
        f"{SPLIT_NAMES[view.scored]} cost.{_held_in_words(view)}{_time_in_words(view)}",
    )


def gap_title(view: DatasetView) -> str:
    """Heading of gaps above closed_form, with how near the optimum that is, if this is proven for all boxes."""
    exact = [run.record for entry, run in view.calibrated if calibrators.entry(entry.calibrator).cls.exact]
    proofs = [record.proven_gap for record in exact if record.proven_gap is not None]
    if not proofs or len(proofs) < len(exact):
        return "Gap above closed_form, not proven optimal"
    return f"Gap above closed_form, proven within {percent(max(*proofs, 0.0), 2)} of the optimum"


def run_table(view: DatasetView, typical: bool = False) -> Table:
    """A table of every run, or of each entry's ``typical`` one, including those without an answer."""
    runs = view.typical_runs if typical else view.runs
    return Table(
        caption="The run of each entry with the median training cost" if typical else "Every run",
        columns=(
            Column("Entry", numeric=False),
            Column("Seed", priority=2),
            Column("Outcome", numeric=False),
            Column("Cost, training"),
            Column("Cost, held-out"),
            Column("Gap", priority=1),
            Column("Evaluations and time", priority=2),
            Column("On a bound", numeric=False, priority=3),
        ),
        rows=tuple(_run_row(view, run.record) for run in runs),
    )


def certificate_table(certificates: Sequence[BoxCertificate]) -> Table:
    """Lower bounds on the training cost, one for each box for which one is proven."""
    rows = [
        Row.of(
            certificate.box,
            significant(certificate.best_cost, 6),
            significant(certificate.lower_bound, 6),
            Cell(percent(certificate.gap, 2), "" if certificate.finished else "time or parts ran out"),
            Cell(count(certificate.parts), seconds(certificate.seconds)),
        )
        for certificate in certificates
    ]
    return Table(
        caption="What no optimiser can beat",
        columns=(
            Column("Box", numeric=False),
            Column("Lowest training cost found"),
            Column("No matrix of the box is below"),
            Column("Left to gain, at most"),
            Column("Parts of the box, time"),
        ),
        rows=tuple(rows),
        note="Proven by branch and bound on row 3 of the matrix, with rounding counted in: whichever search is used, "
        "and however long it runs, the training cost cannot fall below the bound while the matrix stays in the box.",
    )


def gap(value: float | None) -> str:
    """A relative gap; 0 where it is smaller than rounding."""
    if value is not None and abs(value) < 5e-13:
        return "0"
    return significant(value, 2)


def proven(value: float | None) -> str:
    """The share of the cost that could be saved at most, as a note; empty where no bound is proven."""
    return "" if value is None else f"proven: ≤ {percent(max(value, 0.0), 2)}"


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
        return Cell("lowest training cost" if view.undecided else "best", rivals_in_words(view))
    if entry.practically_equal is None or entry.difference is None:
        return Cell("undecided", interval_basis(view, view.scored))
    if entry in view.not_told_apart:
        return Cell("not told apart")
    if entry.practically_equal:  # the design values, as the headline has them
        return Cell("worse", "by its share of the cost")
    if entry.difference.value > 0:
        return Cell("worse")
    return Cell("lower cost here", "higher training cost")


def _time_in_words(view: DatasetView) -> str:
    """A sentence on times that are no seconds; empty where they are."""
    if not view.config.timing:
        return " The runs were not timed."
    if view.times_compare:
        return ""
    return (
        " Time: wall time of a run divided by that of one evaluation of the start's cost beside it, since the machines "
        "differ."
    )


def _held_in_words(view: DatasetView) -> str:
    """A sentence on elements that a box holds, and on the entries concerned; empty where there are none."""
    held: dict[tuple[str, ...], list[str]] = {}
    for entry, run in view.calibrated:
        if run.record.held:
            held.setdefault(run.record.held, []).append(entry.label)
    parts = [f"{listing(list(names), 12)} ({listing(labels, 20)})" for names, labels in held.items()]
    return f" Held at the design value by a box without width there: {'; '.join(parts)}." if parts else ""


def _run_row(view: DatasetView, record: RunRecord) -> Row:
    answered = record.matrix is not None
    return Row.of(
        Cell(record.label, colour=view.styles[record.label].colour),
        str(record.seed),
        Cell(record.outcome.value, record.reason),
        fixed(record.train_cost, 6),
        fixed(record.validation_cost, 6),
        Cell(gap(record.gap), proven(record.proven_gap)),
        Cell(
            count(record.evaluations),
            view.time_in_words(
                record.seconds, record.seconds / record.reference_seconds if record.reference_seconds else None
            ),
        ),
        ", ".join(on_bounds(record)) if answered and on_bounds(record) else NOTHING,
        role="plain" if answered else "failed",
    )
