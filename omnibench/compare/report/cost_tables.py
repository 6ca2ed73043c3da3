"""The section on costs: Tables 2 and 3 of the paper with intervals, and published results beside them."""

from __future__ import annotations

from omnibench.compare.report.published_tables import published_blocks
from omnibench.compare.report.view import SPLIT_NAMES, DatasetView
from omnibench.compare.report.wording import (
    cost_decimals,
    cost_in_words,
    entry_cell,
    improvement_in_words,
    interval_basis,
    interval_in_words,
)
from omnibench.compare.result import THEORETICAL_NAME, EntryStatistics
from omnibench.data.dataset import Split
from omnibench.report.blocks import Cell, Column, Details, Row, Section, Table
from omnibench.report.numbers import NOTHING, fixed, percent
from omnibench.words import plural


def cost_section(view: DatasetView) -> Section:
    """A table of costs for each split, then what is like the published results and what is not."""
    scored = cost_table(view, view.scored)
    others = (
        Details(f"Costs of the {SPLIT_NAMES[split]} runs", (cost_table(view, split),))
        for split in view.splits
        if split != view.scored
    )
    published = published_blocks(view)
    beside = (Details("Beside the published figures", published),) if published else ()
    about = "Every entry's cost, and how far it lies below that of the design values."
    return Section("costs", "Costs", (scored, *others, *beside), about=about, folded=True)


def cost_table(view: DatasetView, split: Split) -> Table:
    """Table 2 (training) or 3 (validation) of the paper, with intervals."""
    theoretical = view.theoretical_cost(split)
    decimals = cost_decimals(view)
    before = fixed(theoretical, decimals)
    design = Cell(before, interval_in_words(view.design_costs.get(split), decimals))
    rows = [Row.of(entry_cell(view, None), design, NOTHING, NOTHING)]
    searched = [entry for entry in view.statistics if entry.calibrator != THEORETICAL_NAME]
    rows += [_cost_row(view, entry, split, before) for entry in searched]
    rows += _published_rows(view, split)
    number = len(view.dataset.split(split))
    paper = f"As Table {2 if split == 'train' else 3} of the paper. " if view.of_the_paper else ""
    return Table(
        caption=f"Cost of {plural(number, f'{SPLIT_NAMES[split]} run')}",
        columns=(
            Column("Entry", numeric=False),
            Column("Cost, design values", priority=1),
            Column(f"Cost, {SPLIT_NAMES[split]}"),
            Column("Improvement"),
        ),
        rows=tuple(rows),
        note=f"{paper}The cost is {cost_in_words(view)} "
        f"Small print: 95 % intervals, {interval_basis(view, split)}, of the run with the median training cost.",
    )


def _cost_row(view: DatasetView, entry: EntryStatistics, split: Split, before: str) -> Row:
    reached = entry.cost(split)
    if reached is None:
        failed = [run.record for run in view.runs if run.record.label == entry.label]
        outcome = failed[0].outcome.value if failed else "no run"
        return Row.of(entry_cell(view, entry), before, Cell("no answer", outcome), NOTHING, role="failed")
    return Row.of(
        entry_cell(view, entry),
        before,
        Cell(fixed(reached.value, cost_decimals(view)), interval_in_words(reached, cost_decimals(view))),
        Cell(*improvement_in_words(entry, split, 2)),
        role="best" if entry.is_best else "plain",
    )


def _published_rows(view: DatasetView, split: Split) -> list[Row]:
    rows = []
    for result in view.config.published_results:
        published = result.costs(split)
        if published is None:
            continue
        before, after = published
        costs = (fixed(before, 4), fixed(after, 4), percent(result.improvement(split), 2))
        rows.append(Row.of(Cell(result.label, result.source), *costs, role="muted"))
    if rows:
        rows.insert(0, Row.of("Published, on other data: not comparable row by row", role="group"))
    return rows
