"""A discovery on a terminal: the answer in a screenful of 80 columns."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from omnibench.cli.terminal.tables import folding_table
from omnibench.discover.report.wording import (
    VERDICTS,
    chance,
    closed_in_words,
    data_in_words,
    extrapolations_in_words,
    gap_decimals,
    held_out_in_words,
    reading,
    value_and_interval,
    weight_in_words,
    with_unit,
    worst_of_each,
)
from omnibench.discover.result import Discovery, Gap, NamedEffect, experiment_file
from omnibench.report.numbers import fixed, listing
from omnibench.words import plural

# So much is shown that the answer fits into a screen; the report has the rest.
_WIDTH = 80  # columns
_HIDDEN = 4  # lines of effects that could still hide
_MOST_DEPENDENCES = 4  # lines of covariates that the residuals depend on
_PARAMETERS = 9  # lines for an effect
_LINES = 3  # notes, and as many warnings

_INTERVAL = "95 % interval"


def print_discovery(console: Console, discovery: Discovery, folder: Path) -> None:
    """Print verdict, effects, what the residuals depend on, the gap, what could still hide, and the files' paths."""
    width = min(console.width, _WIDTH)
    console.print(data_in_words(discovery), soft_wrap=True)
    console.print(f"verdict: {discovery.verdict} ({VERDICTS[discovery.verdict]})", style="bold", width=width)
    console.print(discovery.headline, width=width)
    for effect in discovery.effects:
        console.print("", width=width)
        console.print(_effect_title(effect), style="bold", width=width)
        console.print(_effect_table(effect), width=width)
    for table in _tables(discovery):
        console.print("", table, width=width)
    for line in _remarks(discovery):
        console.print(line, width=width)
    _print_files(console, discovery, folder)


def _tables(discovery: Discovery) -> Iterator[Table]:
    if discovery.where:
        yield _dependence_table(discovery)
    yield _gap_table(discovery)
    if discovery.hidden:
        yield _hidden_table(discovery)


def _effect_title(effect: NamedEffect) -> str:
    others = [name for name in effect.confusable_with if name != effect.name]
    alike = f", or {' or '.join(others)}" if others else ""
    return f"added: {effect.name}{alike} (stage {effect.stage}), weight {weight_in_words(effect.weight)}"


def _effect_table(effect: NamedEffect) -> Table:
    table = _discovery_table(None, ("parameter",), ("value", _INTERVAL))
    for parameter in effect.parameters[:_PARAMETERS]:
        value, interval, unit = value_and_interval(parameter)
        table.add_row(parameter.name, with_unit(value, unit), "chosen" if parameter.shape else interval)
    if len(effect.parameters) > _PARAMETERS:
        table.caption = f"{len(effect.parameters) - _PARAMETERS} more in the report"
        table.caption_justify = "left"
    return table


def _dependence_table(discovery: Discovery) -> Table:
    table = _discovery_table("where the plain matrix fails", ("residual over", "in words"), ("chance",))
    strongest = {found.covariate: found for found in reversed(discovery.where)}  # the first of each covariate
    shown = [found for found in discovery.where if strongest[found.covariate] is found][:_MOST_DEPENDENCES]
    for dependence in shown:
        table.add_row(dependence.covariate, dependence.description, chance(dependence.p_value))
    return table


def _gap_table(discovery: Discovery) -> Table:
    table = _discovery_table("the gap", ("data", "measure"), ("before", "after", "floor", "closed"))
    for held in discovery.held_out:
        where = f"{held_out_in_words(discovery, held)}, {plural(held.runs, 'run')}"
        table.add_row(where, *_gap_cells(held.eq6))
        table.add_row("", *_gap_cells(held.chi2))
        before, after = (f"{1000 * value:.1f} mm" for value in held.position_m)
        table.add_row("", "position", before, after, "", "")
        before, after = (f"{math.degrees(value):.2f}°" for value in held.heading_rad)
        table.add_row("", "heading", before, after, "", "")
    if not discovery.held_out:
        table.add_row("training runs", *_gap_cells(discovery.gap))
    return table


def _gap_cells(gap: Gap) -> tuple[str, ...]:
    decimals = gap_decimals(gap)
    measure = "Eq. (6)" if gap.metric == "eq6" else "whitened χ²"
    values = (fixed(value, decimals) for value in (gap.before, gap.after, gap.floor))
    return (measure, *values, closed_in_words(gap))


def _hidden_table(discovery: Discovery) -> Table:
    """The effects whose bound is largest, compared with what is plausible for them."""
    table = _discovery_table("what could still hide", ("effect", "parameter"), ("at most ±", "plausible ±"))
    worst = worst_of_each(discovery.hidden)
    for effect in worst[:_HIDDEN]:
        shown = reading(effect.unit)
        table.add_row(effect.name, effect.parameter, shown.words(effect.limit, 2), shown.words(effect.plausible, 2))
    if len(worst) > _HIDDEN:
        table.caption = f"the largest for their kind; {plural(len(worst) - _HIDDEN, 'more effect')} in the report"
        table.caption_justify = "left"
    return table


def _remarks(discovery: Discovery) -> Iterator[str]:
    yield ""
    if discovery.left:
        first = {dependence.covariate: dependence for dependence in reversed(discovery.left)}
        left = listing([f"{p.covariate} ({chance(p.p_value)})" for p in discovery.left if first[p.covariate] is p])
        yield f"Left over: the residuals still depend on {left}."
    for effect in discovery.effects:
        if effect.in_doubt:
            yield f"In doubt: {effect.name}: {effect.in_doubt}."
    if discovery.classes:
        yield f"These data cannot tell apart: {'; '.join(' or '.join(names) for names in discovery.classes)}."
    if discovery.absorbed:
        absorbed = listing(list(discovery.absorbed), 12)
        yield f"Absorbed by any matrix, and so never named: {absorbed}."
    yield from _first(
        extrapolations_in_words(discovery.extrapolations), "warning: not driven in training: ", "such warning"
    )
    yield from _first(discovery.notes, "- ", "note")


def _first(lines: Sequence[str], head: str, kind: str) -> Iterator[str]:
    """The first lines, with ``head`` before each, and how many more there are."""
    yield from (f"{head}{line}" for line in lines[:_LINES])
    if len(lines) > _LINES:
        yield f"{plural(len(lines) - _LINES, f'more {kind}')} in the report"


def _print_files(console: Console, discovery: Discovery, folder: Path) -> None:
    console.print(f"extended calibration: {folder / 'model.yaml'}", soft_wrap=True)
    for number, experiment in enumerate(discovery.experiments, 1):
        file = folder / experiment_file(number)
        console.print(f"to separate {listing(list(experiment.separates))}:\n{file}", soft_wrap=True)
    console.print(f"report: {folder / 'report.html'}", soft_wrap=True)


def _discovery_table(title: str | None, words: Sequence[str], numbers: Sequence[str]) -> Table:
    """A table in which only words and intervals fold."""
    table = folding_table(title, words, numbers)
    for column in table.columns[len(words) :]:
        column.no_wrap = column.header != _INTERVAL
    return table
