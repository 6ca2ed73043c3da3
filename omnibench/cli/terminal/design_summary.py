"""A design on a terminal: what to drive, how good it is, and what the baseline could have been spared."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

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

_ROWS = 7  # of the table against the number of runs


def print_design(console: Console, design: Design) -> None:
    """Every set's chosen commands, their precision against the number of runs, and the baseline's equals."""
    kind = "" if design.recorded and not design.simulated else " (simulated data)" if design.recorded else " (assumed)"
    console.print(f"{design.name}{kind}: robot {design.robot}, D-optimal per {design.per}, {USE_IN_WORDS[design.use]}")
    console.print(origin_in_words(design))
    for found in design.sets:
        console.print("", _chosen_table(design, found), choice_in_words(design, found), "")
        console.print(_precision_table(design, found))
    console.print("", _equal_table(design))
    for note in design.notes:
        console.print(f"- {note}")


def _chosen_table(design: Design, found: SetDesign) -> Table:
    table = _table(f"{found.name}: what to drive", ("command",), ("duration", "distance", "runs"))
    for each in found.chosen:
        candidate = design.candidate(each.command)
        table.add_row(
            command_in_words(candidate),
            f"{candidate.duration_s:.3g} s",
            f"{candidate.distance_m:.3g} m",
            str(each.runs),
        )
    return table


def _precision_table(design: Design, found: SetDesign) -> Table:
    deviations = ("row 1", "row 2", "row 3", "radius", "distance", "angle")
    table = _table(
        f"{found.name}: standard deviations against the number of runs",
        (),
        ("runs", "time", "efficiency", *deviations[: 3 if found.step.physical is None else 6], "vs baseline"),
    )
    for step in _worth_a_row(found):
        style = "bold" if step.effort.runs == found.step.effort.runs else None
        table.add_row(*_figures(step, f"{step.efficiency:.2%}"), style=style)
    table.add_row(*_figures(design.baseline.precision, f"{found.baseline_efficiency:.2%}"), style="dim")
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


def _worth_a_row(found: SetDesign) -> Sequence[Step]:
    """The chosen step and some others, spaced evenly on a logarithmic scale."""
    first, last = found.steps[0].effort.runs, found.steps[-1].effort.runs
    wanted = [first * (last / first) ** (index / (_ROWS - 1)) for index in range(_ROWS)]
    shown = {min(found.steps, key=lambda step: abs(step.effort.runs - each)).effort.runs for each in wanted}
    return [step for step in found.steps if step.effort.runs in shown | {found.step.effort.runs}]


def _equal_table(design: Design) -> Table:
    table = _table(
        f"as good as the baseline ({design.baseline.name})",
        ("set", "calibrated from"),
        ("runs", "time", "distance", f"bound ({UNIT_OF_COST[design.per]})"),
    )
    for found in design.sets:
        for equal in found.equivalents:
            effort = equal.effort
            cells = ("none", "", "")
            if effort is not None:
                cells = (str(effort.runs), duration_in_words(effort.seconds), f"{effort.metres:.4g} m")
            table.add_row(found.name, USE_IN_WORDS[equal.use], *cells, _bound(equal.least))
    return table


def _bound(least: float | None) -> str:
    return "cannot tell all" if least is None else f"> {least_in_words(least)}"


def _table(title: str, words: Sequence[str], numbers: Sequence[str]) -> Table:
    table = Table(
        title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0)
    )
    for heading in words:
        table.add_column(heading, overflow="fold")
    for heading in numbers:
        table.add_column(heading, justify="right", overflow="fold")
    return table
