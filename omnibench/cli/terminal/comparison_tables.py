"""A comparison's results on a terminal: the paper's Tables 2 and 3, final errors, and how each matrix was found."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table

from omnibench.cli.terminal.tables import folding_table
from omnibench.compare.result import ComparisonResult, EntryStatistics, Interval
from omnibench.data.dataset import SPLITS, Split
from omnibench.words import plural

_TITLES: dict[Split, str] = {"train": "Training", "validation": "Validation"}
_MATRIX = "M^-1"  # heading of the column with the entries' labels, as in the paper's tables


def print_result(console: Console, result: ComparisonResult) -> None:
    """Print the tables of every data set, how each matrix was found, and the runs without an answer."""
    for name, dataset in result.datasets.items():
        entries = [entry for entry in result.statistics if entry.dataset == name]
        where = f"{name}{' (simulated data)' if dataset.simulated else ''}"
        for split in SPLITS:
            if count := len(dataset.split(split)):
                title = f"{_TITLES[split]}: {where}, {plural(count, 'trajectory')}, cost {result.config.cost.name}"
                console.print(_cost_table(title, entries, split), "")
        console.print(_error_table(f"Final errors: {where}", entries), "")
    console.print(_search_table(result), "")
    for record in (run.record for run in result.runs):
        if record.matrix is None:
            title = f"{record.dataset} {record.label} seed {record.seed}"
            console.print(f"no answer: {title}: {record.outcome}: {record.reason}", soft_wrap=True)
    console.print(
        "intervals: 95 % bootstrap over trajectories;  = : practically equal to the best;  gap: relative to the exact "
        "optimum in the same box;  proven: what any optimiser could still save of the cost there, at most",
        soft_wrap=True,
    )


def _entries_table(title: str, words: Sequence[str], numbers: Sequence[str]) -> Table:
    """A table in which the names of the usual calibrators do not fold."""
    table = folding_table(title, words, numbers)
    table.columns[words.index(_MATRIX)].min_width = len("closed_form")
    return table


def _cost_table(title: str, entries: Iterable[EntryStatistics], split: Split) -> Table:
    """The paper's Table 2 (training) or 3 (validation), with intervals."""
    calibrated = f"CF {_TITLES[split].lower()}"
    headings = ("CF theoretical", calibrated, "95 % interval", "Improvement", "95 % interval")
    table = _entries_table(title, [_MATRIX], headings)
    for entry in entries:
        if entry.typical is None:
            table.add_row(entry.label, "", "no answer")
            continue
        cells = [f"{entry.typical.design[split].cost:.4f}"]
        cells += _interval(entry.cost(split), "{:.4f}") + _interval(entry.improvement(split), "{:.2%}")
        table.add_row(entry.label, *cells, style="bold" if entry.is_best else None)
    return table


def _error_table(title: str, entries: Iterable[EntryStatistics]) -> Table:
    """Mean errors of the final pose on both splits, and how the entries compare."""
    errors = ("training: position", "heading", "validation: position", "heading")
    table = _entries_table(title, [_MATRIX], [*errors, "cost against best", "95 % interval"])
    for entry in entries:
        if entry.typical is None:
            table.add_row(entry.label, "no answer")
            continue
        record = entry.typical.record
        cells = (
            *_error_cells(record.train_position_m, record.train_heading_rad),
            *_error_cells(record.validation_position_m, record.validation_heading_rad),
            *_against_best(entry),
        )
        table.add_row(entry.label, *cells, style="bold" if entry.is_best else None)
    return table


def _error_cells(position: float | None, heading: float | None) -> tuple[str, str]:
    if position is None or heading is None:
        return "", ""
    return f"{1000 * position:.1f} mm", f"{math.degrees(heading):.2f} deg"


def _search_table(result: ComparisonResult) -> Table:
    headings = ("runs", "evaluations", "time", "gap", "proven", "on a bound")
    several = len(result.datasets) > 1
    table = _entries_table("How each was found", [*(["data set"] * several), _MATRIX, "box", "outcome"], headings)
    for entry in result.statistics:
        records = [run.record for run in result.runs]
        of_entry = [record for record in records if (record.dataset, record.label) == (entry.dataset, entry.label)]
        table.add_row(
            *([entry.dataset] * several),
            entry.label,
            entry.box,
            ", ".join(dict.fromkeys(str(record.outcome) for record in of_entry)),
            f"{entry.answers}/{entry.runs}",
            f"{entry.evaluations_median:.0f}" if entry.evaluations_median is not None else "",
            f"{entry.seconds_median:.2f} s" if entry.seconds_median is not None else "",
            f"{entry.gap_median:.1e}" if entry.gap_median is not None else "",
            f"{max(entry.proven_gap_median, 0.0):.2%}" if entry.proven_gap_median is not None else "",
            _on_bounds(entry),
        )
    return table


def _on_bounds(entry: EntryStatistics) -> str:
    if entry.typical is None:
        return ""
    record = entry.typical.record
    return ", ".join([*record.at_bounds, *(f"{name} (held)" for name in record.held)])


def _against_best(entry: EntryStatistics) -> list[str]:
    if entry.is_best:
        return ["best", ""]
    difference, interval = _interval(entry.difference, "{:+.5f}")
    return [f"{'= ' if entry.practically_equal else ''}{difference}", interval]


def _interval(interval: Interval | None, form: str) -> list[str]:
    if interval is None:
        return ["", ""]
    return [form.format(interval.value), f"{form.format(interval.low)} .. {form.format(interval.high)}"]
