"""A discovery on a terminal: the answer in a screenful of 80 columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from omnibench.cli.terminal.console import print_ending
from omnibench.cli.terminal.tables import in_brief, print_table
from omnibench.discover.report import tables
from omnibench.discover.result import CALIBRATION_FILES, Discovery, experiment_file
from omnibench.report.blocks import Table
from omnibench.report.numbers import listing
from omnibench.words import plural

# So much is shown that the answer fits into a screen; the report has the rest.
_WIDTH = 80  # columns
_HIDDEN = 4  # lines of effects that could still hide
_MOST_DEPENDENCES = 4  # lines of covariates that the residuals depend on
_PARAMETERS = 9  # lines for an effect
_LINES = 3  # notes, and as many warnings


def print_discovery(console: Console, discovery: Discovery, folder: Path) -> None:
    """Print verdict, effects, what the residuals depend on, the gap, what could still hide, and the files' paths."""
    width = min(console.width, _WIDTH)
    console.print(tables.data_in_words(discovery), soft_wrap=True)
    console.print(f"verdict: {discovery.verdict} ({tables.verdict_in_words(discovery)})", style="bold", width=width)
    console.print(discovery.headline, width=width)
    for table in _tables(discovery):
        console.print()
        print_table(console, in_brief(table))
    for line in _remarks(discovery):
        console.print(line, width=width)
    calibration = f"extended calibration: {folder / 'model.yaml'}"
    if not discovery.extends:
        calibration = f"plain calibration, as nothing was added: {folder / 'plain.yaml'}"
    console.print(calibration, soft_wrap=True)
    for number, experiment in enumerate(discovery.experiments, 1):
        if experiment.config:
            console.print(f"the runs to drive, as a config: {folder / experiment_file(number)}", soft_wrap=True)
    console.print(f"report: {folder / 'report.html'}", soft_wrap=True)
    # Run the extended model, drive what separates look-alikes, or keep the plain matrix.
    if any(experiment.runs for experiment in discovery.experiments):
        drive = "drive the runs above, import them with --set train=*, join both recordings and discover again"
        join = ("omnibench", "import", "dataset", "RECORDED", "--set", "join=NEW", "-o", "BOTH")
        print_ending("more than one effect explains these data", drive, *join)
    elif discovery.extends:
        use = ("omnibench", "export", folder / CALIBRATION_FILES["extended"], "--to", "c_header")
        print_ending("the extended calibration holds what the matrix lacked", "use it on the robot", *use)
    else:
        use = ("omnibench", "export", folder / CALIBRATION_FILES["plain"], "--to", "ros2_controllers")
        print_ending("nothing was added to the matrix", "use the plain calibration", *use)


def _tables(discovery: Discovery) -> Iterator[Table]:
    if discovery.effects:
        effects = [replace(effect, parameters=effect.parameters[:_PARAMETERS]) for effect in discovery.effects]
        yield tables.parameter_table(effects, discovery.dataset)
    if discovery.where:
        strongest = {found.covariate: found for found in reversed(discovery.where)}  # the first of each covariate
        shown = [found for found in discovery.where if strongest[found.covariate] is found][:_MOST_DEPENDENCES]
        yield tables.dependence_table(shown, "Where the plain matrix fails")
    yield tables.held_out_table(discovery) if discovery.held_out else tables.gap_table(discovery)
    if discovery.hidden:
        yield tables.hidden_table(tables.worst_of_each(discovery.hidden)[:_HIDDEN])
    yield from (tables.experiment_table(each) for each in discovery.experiments if each.commands)


def _remarks(discovery: Discovery) -> Iterator[str]:
    yield ""
    for experiment in discovery.experiments:
        yield experiment.description
    for effect in discovery.effects:
        if len(effect.parameters) > _PARAMETERS:
            yield f"{effect.name}: {plural(len(effect.parameters) - _PARAMETERS, 'more parameter')} in the report"
    if (more := len(tables.worst_of_each(discovery.hidden)) - _HIDDEN) > 0:
        yield f"Of what could still hide, the largest are shown; {plural(more, 'more effect')} in the report."
    if discovery.left:
        first = {dependence.covariate: dependence for dependence in reversed(discovery.left)}
        left = listing(
            [f"{p.covariate} ({tables.chance(p.p_value)})" for p in discovery.left if first[p.covariate] is p]
        )
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
        tables.extrapolations_in_words(discovery.extrapolations), "warning: not driven in training: ", "such warning"
    )
    yield from _first(discovery.notes, "- ", "note")


def _first(lines: Sequence[str], head: str, kind: str) -> Iterator[str]:
    """The first lines, with ``head`` before each, and how many more there are."""
    yield from (f"{head}{line}" for line in lines[:_LINES])
    if len(lines) > _LINES:
        yield f"{plural(len(lines) - _LINES, f'more {kind}')} in the report"
