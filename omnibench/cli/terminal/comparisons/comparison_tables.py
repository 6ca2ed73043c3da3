"""A comparison's results on a terminal: the tables of its report on costs, errors and outcomes."""

from __future__ import annotations

from rich.console import Console

from omnibench.cli.terminal.calibration_tables import how_to_use
from omnibench.cli.terminal.console import print_ending
from omnibench.cli.terminal.tables import print_table
from omnibench.compare.output import calibration_file
from omnibench.compare.report.cost_tables import cost_table
from omnibench.compare.report.error_figures import final_error_table
from omnibench.compare.report.outcome_tables import entry_table, run_table
from omnibench.compare.report.view import views
from omnibench.compare.result import ComparisonResult
from omnibench.robot.calibration import read_calibration
from omnibench.words import plural


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


def print_comparison_ending(result: ComparisonResult) -> None:
    """Print the last sentence of ``compare``: which entry is best, and how to use or to check its calibration."""
    compared = f"{plural(len({run.record.label for run in result.runs}), 'entry')} compared"
    name, best = next(iter(result.held_out.items()), ("", None))
    file = None if best is None else calibration_file(result, name, best.label)
    if best is None or file is None:
        print_ending(f"{compared} in {result.output}", "read report.html in that folder")
    elif best.verdict.verdict == "better":
        outcome = f"{compared}; the best on {name}, {best.label}, beats the design on runs held out"
        print_ending(outcome, *how_to_use(read_calibration(file), file))
    else:
        unsure = f"{compared}; that the best on {name}, {best.label}, beats the design was not shown by runs held out"
        print_ending(unsure, f"read {result.output / 'report.html'} and record more runs for validation")
