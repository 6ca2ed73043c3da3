"""A design on a terminal: what to drive, how good it is, and what the baseline could have been spared."""

from __future__ import annotations

from rich.console import Console

from omnibench.cli.terminal.tables import print_table
from omnibench.design import report
from omnibench.design.design import Design


def print_design(console: Console, design: Design) -> None:
    """Print the chosen commands of every set, their precision against the number of runs, and the baseline's equals."""
    kind = "" if design.recorded and not design.simulated else " (simulated data)" if design.recorded else " (assumed)"
    console.print(
        f"{design.name}{kind}: robot {design.robot}, D-optimal per {design.per}, {report.USE_IN_WORDS[design.use]}"
    )
    console.print(report.origin_in_words(design))
    for of_set in design.sets:
        console.print()
        print_table(console, report.chosen_table(design, of_set))
        console.print(report.choice_in_words(design, of_set))
        if not design.recorded:
            console.print("What to drive:")
            for line in report.plan_in_words(design, of_set):
                console.print(f"  {line}")
        console.print(report.motions_in_words(of_set))
        console.print()
        print_table(console, report.effort_table(design, of_set))
    console.print()
    print_table(console, report.equal_table(design))
    for note in design.notes:
        console.print(f"- {note}")
