"""A design on a terminal: what to drive, how good it is, and what the baseline could have been spared."""

from __future__ import annotations

from rich.console import Console

from omnibench.cli.terminal.tables import print_table
from omnibench.design.report import (
    USE_IN_WORDS,
    choice_in_words,
    chosen_table,
    effort_table,
    equal_table,
    motions_in_words,
    origin_in_words,
    plan_in_words,
)
from omnibench.design.result import Design


def print_design(console: Console, design: Design) -> None:
    """Print the chosen commands of every set, their precision against the number of runs, and the baseline's equals."""
    kind = "" if design.recorded and not design.simulated else " (simulated data)" if design.recorded else " (assumed)"
    console.print(f"{design.name}{kind}: robot {design.robot}, D-optimal per {design.per}, {USE_IN_WORDS[design.use]}")
    console.print(origin_in_words(design))
    for of_set in design.sets:
        console.print()
        print_table(console, chosen_table(design, of_set))
        console.print(choice_in_words(design, of_set))
        if not design.recorded:
            console.print("What to drive:")
            for line in plan_in_words(design, of_set):
                console.print(f"  {line}")
        console.print(motions_in_words(of_set))
        console.print()
        print_table(console, effort_table(design, of_set))
    console.print()
    print_table(console, equal_table(design))
    for note in design.notes:
        console.print(f"- {note}")
