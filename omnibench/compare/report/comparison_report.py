"""The report of a comparison: one HTML file that opens offline."""

from __future__ import annotations

from dataclasses import replace

from omnibench.compare.report.cost_tables import cost_section
from omnibench.compare.report.data_section import data_section
from omnibench.compare.report.error_figures import error_section
from omnibench.compare.report.headline import answer_of, path_picture
from omnibench.compare.report.matrices import matrix_section
from omnibench.compare.report.outcome_tables import outcome_section
from omnibench.compare.report.path_figures import path_section
from omnibench.compare.report.robot_section import robot_section
from omnibench.compare.report.search_figures import search_section
from omnibench.compare.report.view import SPLIT_NAMES, DatasetView, views
from omnibench.compare.report.wording import cost_decimals, cost_in_words, improvement_in_words, rivals_in_words
from omnibench.compare.result import ComparisonResult
from omnibench.errors import DataError
from omnibench.report.blocks import (
    Badge,
    Block,
    Callout,
    Cell,
    Column,
    Document,
    Fact,
    Row,
    Section,
    Table,
    answer_section,
    simulated_badge,
)
from omnibench.report.numbers import NOTHING, count, fixed, listing
from omnibench.report.recording.section import has_recording, recording_section
from omnibench.report.reproduction import reproduction_section
from omnibench.words import plural


def comparison_document(result: ComparisonResult) -> Document:
    """The report as blocks, data set by data set."""
    datasets = views(result)
    if len(datasets) == 1:
        body = _sections(datasets[0], "")
    else:
        body = (
            _overview(datasets),
            *(
                Section(
                    f"data-{index}",
                    view.name,
                    sections=_sections(view, f"data-{index}-"),
                    badges=simulated_badge(view.dataset.simulated),
                )
                for index, view in enumerate(datasets, 1)
            ),
        )
    simulated = [view for view in datasets if view.dataset.simulated]
    badges = simulated_badge(bool(simulated))
    if simulated and len(simulated) < len(datasets):
        badges = (Badge("SIMULATED AND REAL DATA", "warning"),)
    return Document(
        title=f"Odometry calibrations compared: {result.config.name}",
        subtitle=result.config.description,
        sections=(body[0], *_about(result), *body[1:], _reproduction(result)),
        badges=badges,
    )


def _about(result: ComparisonResult) -> tuple[Section, ...]:
    blocks: list[Block] = []
    if result.config.notes:
        blocks.append(Callout("Notes of the config", result.config.notes))
    if result.warnings:
        blocks.append(Callout("Warnings", result.warnings, "warning"))
    return (Section("notes", "Before you rely on it", tuple(blocks)),) if blocks else ()


def _sections(view: DatasetView, prefix: str) -> tuple[Section, ...]:
    """The sections on one data set; ``prefix`` makes their keys unique in the document."""
    sections = (
        answer_of(view),
        cost_section(view),
        error_section(view),
        path_section(view),
        outcome_section(view),
        search_section(view),
        matrix_section(view),
        *robot_section(view),
        *_recording(view),
        data_section(view),
    )
    return tuple(_prefixed(section, prefix) for section in sections)


def _prefixed(section: Section, prefix: str) -> Section:
    parts = tuple(_prefixed(part, prefix) for part in section.sections)
    return replace(section, key=f"{prefix}{section.key}", sections=parts)


def _recording(view: DatasetView) -> tuple[Section, ...]:
    """Pictures of a recording with scans or targets; where scans cannot be read, the error stands in their place."""
    if not has_recording(view.dataset):
        return ()
    try:
        return (recording_section(view.dataset),)
    except DataError as error:
        return (Section("recording", "Recording", (Callout("No pictures", (str(error),), "warning"),)),)


def _overview(datasets: list[DatasetView]) -> Section:
    """The answer on several data sets: the best entry of each, and the paths of the first."""
    tiles = []
    for view in datasets:
        best = view.best
        gained = improvement_in_words(best, view.scored, 1) if best is not None else (NOTHING, "")
        label = "" if best is None else f"{best.label}{f', {words}' if (words := rivals_in_words(view)) else ''}"
        tiles.append(Fact(f"{view.name}: the cost fell by", gained[0], label))
    sentence = f"Calibrators compared on {plural(len(datasets), 'data set')}; each has a part of its own below."
    return answer_section(sentence, tiles, path_picture(datasets[0]), _overview_table(datasets))


def _overview_table(datasets: list[DatasetView]) -> Table:
    rows = []
    for view in datasets:
        best = view.best
        reached = None if best is None else best.cost(view.scored)
        decimals = cost_decimals(view)
        rows.append(
            Row.of(
                Cell(view.name, "simulated" if view.dataset.simulated else ""),
                NOTHING if best is None else Cell(best.label, rivals_in_words(view)),
                SPLIT_NAMES[view.scored],
                fixed(view.theoretical_cost(view.scored), decimals),
                NOTHING if reached is None else fixed(reached.value, decimals),
                NOTHING if best is None else Cell(*improvement_in_words(best, view.scored, 1)),
            )
        )
    return Table(
        "Best entry of each data set",
        (
            Column("Data set", numeric=False),
            Column("Best entry", numeric=False),
            Column("Runs scored", numeric=False),
            Column("Cost, design values"),
            Column("Cost, best entry"),
            Column("Improvement"),
        ),
        tuple(rows),
        f"The cost is {cost_in_words(datasets[0])} Small print: 95 % intervals. Of several that are "
        "not told apart, the entry of lowest training cost is named.",
    )


def _reproduction(result: ComparisonResult) -> Section:
    config = result.config
    settings = (
        Fact("Budget of each run", f"{plural(config.budget.evaluations, 'evaluation')} or {config.budget.seconds:g} s"),
        Fact("Seeds", listing([str(seed) for seed in config.seeds], 20)),
        Fact(
            "Intervals",
            f"unit {config.bootstrap.unit or 'command where runs repeat commands, else run'}; from ten units on "
            f"{count(config.bootstrap.resamples)} bootstrap resamples, seed {config.bootstrap.seed}; from three on "
            "Student's t",
        ),
    )
    return reproduction_section(config, settings, result.environment)
