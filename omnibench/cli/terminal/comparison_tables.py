"""A comparison's results on a terminal: the tables of its report on costs, errors and outcomes."""

from __future__ import annotations

from rich.console import Console

from omnibench.cli.terminal.tables import print_table
from omnibench.compare.report.cost_tables import cost_table
from omnibench.compare.report.error_figures import final_error_table
from omnibench.compare.report.outcome_tables import entry_table, run_table
from omnibench.compare.report.view import views
from omnibench.compare.result import ComparisonResult


def print_result(console: Console, result: ComparisonResult) -> None:
    """Print the tables of every data set, and the runs without an answer."""
    for view in views(result):
        kind = "simulated data" if view.dataset.simulated else "recorded data"
        console.print(f"{view.name} ({kind}), cost {result.config.objective}", soft_wrap=True)
        tables = [cost_table(view, split) for split in view.splits]
        tables += [final_error_table(view, split) for split in view.splits]
        for table in (*tables, entry_table(view), run_table(view, typical=True)):
            console.print()
            print_table(console, table)
        console.print()
    for failure in result.failures:
        console.print(f"no answer: {failure}", soft_wrap=True)
