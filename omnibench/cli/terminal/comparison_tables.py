"""The result of a comparison on a terminal: its answer in a table, and with ``--all`` the tables of its report."""

from __future__ import annotations

from rich.console import Console

from omnibench.cli.terminal.calibration_tables import how_to_use
from omnibench.cli.terminal.console import print_ending
from omnibench.cli.terminal.tables import print_table
from omnibench.compare.output import calibration_file
from omnibench.compare.report.robots import cells_table, methods_table, robots_sentence
from omnibench.compare.report.tables import (
    answer_table,
    certificate_table,
    cost_table,
    entry_table,
    final_error_table,
    run_table,
)
from omnibench.compare.report.view import views
from omnibench.compare.result import ComparisonResult
from omnibench.robot.calibration import read_calibration
from omnibench.words import plural

_SHOWN = 3  # failures that are listed; the others are counted (chosen)


def print_result(console: Console, result: ComparisonResult, *, everything: bool = False) -> None:
    """Print a line for every entry or method, and the first runs without an answer; or all tables and failures."""
    if result.config.robots:
        tables = [*([cells_table(result)] if everything else []), methods_table(result)]
    else:
        tables = []
        for view in views(result):
            tables.append(answer_table(view))
            if everything:
                tables += [make(view, split) for make in (cost_table, final_error_table) for split in view.splits]
                tables += [entry_table(view), *certificate_table(view), run_table(view)]
    for table in tables:
        print_table(console, table)
        console.print()
    for name, reason in result.broken.items():
        console.print(f"cannot be read: {name}: {reason}", soft_wrap=True)
    shown = len(result.failures) if everything else _SHOWN
    for failure in result.failures[:shown]:
        console.print(f"no answer: {failure}", soft_wrap=True)
    if len(result.failures) > shown:
        console.print(f"no answer: {len(result.failures) - shown} more; --all lists them", soft_wrap=True)


def print_comparison_ending(result: ComparisonResult) -> bool:
    """Print the last sentence of ``compare``; False where a recording cannot be read or no calibrator answered."""
    report = f"read {result.output / 'report.html'}"
    if result.nothing_answered:
        first = result.failures[0] if result.failures else "no method is for these robots"
        what = "no method gave an answer" if result.config.robots else "every search failed"
        print_ending(f"{what}, the first: {first}", "mend what its reason names, and run again")
        return False
    if result.broken:
        ending = f"{plural(len(result.broken), 'robot')} left out, whose recordings cannot be read"
        print_ending(ending, "say where they are with --data, or take them out of the config, and run again")
        return False
    if result.config.robots:
        print_ending(robots_sentence(result).rstrip("."), report)
        return True
    compared = f"{plural(len({run.fit.label for run in result.runs}), 'entry')} compared"
    name, best = next(iter(result.held_out.items()), ("", None))
    file = None if best is None else calibration_file(result, name, best.label)
    if best is None or file is None:
        print_ending(f"{compared} in {result.output}", "read report.html in that folder")
    elif best.verdict.verdict == "better":
        outcome = f"{compared}; the best on {name}, {best.label}, beats the design on runs held out"
        print_ending(outcome, *how_to_use(read_calibration(file), file))
    else:
        unsure = f"{compared}; that the best on {name}, {best.label}, beats the design was not shown by runs held out"
        print_ending(unsure, f"{report} and record more runs for validation")
    return True
