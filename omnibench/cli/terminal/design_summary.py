"""A design on a terminal: what to drive, how good it is, and what the baseline could have been spared."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from omnibench.cli.terminal.tables import folding_table
from omnibench.design.report.design_wording import (
    UNIT_OF_COST,
    USE_IN_WORDS,
    choice_in_words,
    command_in_words,
    duration_in_words,
    least_in_words,
    origin_in_words,
)
from omnibench.design.result import Design, Precision, SetDesign, Step

_ROWS = 7  # lines, about, of the table against the number of runs; chosen


def print_design(console: Console, design: Design) -> None:
    """Print the chosen commands of every set, their precision against the number of runs, and the baseline's equals."""
    kind = "" if design.recorded and not design.simulated else " (simulated data)" if design.recorded else " (assumed)"
    console.print(f"{design.name}{kind}: robot {design.robot}, D-optimal per {design.per}, {USE_IN_WORDS[design.use]}")
    console.print(origin_in_words(design))
    for set_design in design.sets:
        console.print("", _chosen_table(design, set_design), choice_in_words(design, set_design), "")
        console.print(_precision_table(design, set_design))
    console.print("", _equal_table(design))
    for note in design.notes:
        console.print(f"- {note}")


def _chosen_table(design: Design, set_design: SetDesign) -> Table:
    table = folding_table(f"{set_design.name}: what to drive", ("command",), ("duration", "distance", "runs"))
    for choice in set_design.chosen:
        candidate = design.candidate(choice.command)
        table.add_row(
            command_in_words(candidate),
            f"{candidate.duration_s:.3g} s",
            f"{candidate.distance_m:.3g} m",
            str(choice.runs),
        )
    return table


def _precision_table(design: Design, set_design: SetDesign) -> Table:
    deviations = ("row 1", "row 2", "row 3", "radius", "distance", "angle")
    table = folding_table(
        f"{set_design.name}: standard deviations against the number of runs",
        (),
        ("runs", "time", "efficiency", *deviations[: 3 if set_design.step.physical is None else 6], "vs baseline"),
    )
    for step in _worth_a_row(set_design):
        style = "bold" if step.effort.runs == set_design.step.effort.runs else None
        table.add_row(*_figures(step, f"{step.efficiency:.2%}"), style=style)
    table.add_row(*_figures(design.baseline.precision, f"{set_design.baseline_efficiency:.2%}"), style="dim")
    table.caption = f"last line: the baseline, {design.baseline.name}; rows: % of the row's largest element"
    table.caption_justify = "left"
    return table


def _figures(precision: Precision, efficiency: str) -> list[str]:
    physical = precision.physical
    cells = [str(precision.effort.runs), duration_in_words(precision.effort.seconds), efficiency]
    cells += [f"{value:.3f} %" for value in precision.row_percent]
    if physical is not None:
        cells += [
            f"{physical.radius_percent:.3f} %",
            f"{physical.distance_percent:.3f} %",
            f"{physical.angle_deg:.3f}°",
        ]
    return [*cells, f"x {precision.relative:.3g}"]


def _worth_a_row(set_design: SetDesign) -> Sequence[Step]:
    """The chosen step and some others, spaced evenly on a logarithmic scale."""
    first, last = set_design.steps[0].effort.runs, set_design.steps[-1].effort.runs
    wanted = [first * (last / first) ** (index / (_ROWS - 1)) for index in range(_ROWS)]
    shown = {min(set_design.steps, key=lambda step: abs(step.effort.runs - runs)).effort.runs for runs in wanted}
    return [step for step in set_design.steps if step.effort.runs in shown | {set_design.step.effort.runs}]


def _equal_table(design: Design) -> Table:
    table = folding_table(
        f"as good as the baseline ({design.baseline.name})",
        ("set", "calibrated from"),
        ("runs", "time", "distance", f"bound ({UNIT_OF_COST[design.per]})"),
    )
    for set_design in design.sets:
        for equal in set_design.equivalents:
            effort = equal.effort
            cells = ("none", "", "")
            if effort is not None:
                cells = (str(effort.runs), duration_in_words(effort.seconds), f"{effort.metres:.4g} m")
            table.add_row(set_design.name, USE_IN_WORDS[equal.use], *cells, _bound(equal.least))
    return table


def _bound(least: float | None) -> str:
    return "cannot tell all" if least is None else f"> {least_in_words(least)}"
