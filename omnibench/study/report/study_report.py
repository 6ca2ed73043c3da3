"""The report of a study: one HTML file that opens offline."""

from __future__ import annotations

from collections import Counter

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
    simulated_badge,
)
from omnibench.report.numbers import count, listing, seconds
from omnibench.report.reproduction import reproduction_section
from omnibench.study.report.cell_tables import robot_cells
from omnibench.study.report.rank_figures import rank_section
from omnibench.study.report.regime_figures import curve_section, regime_section
from omnibench.study.report.study_answer import study_answer
from omnibench.study.report.study_view import StudyView, study_view
from omnibench.study.study_result import StudyResult
from omnibench.words import plural

_SHOWN = 12  # failures that are listed; the others are counted


def study_document(result: StudyResult) -> Document:
    """The report as blocks."""
    view = study_view(result)
    simulated = [robot.dataset.simulated for robot in result.robots]
    badges = simulated_badge(any(simulated))
    if any(simulated) and not all(simulated):
        badges = (Badge("SIMULATED AND REAL DATA", "warning"),)
    return Document(
        title=f"Calibration methods on several robots: {result.config.name}",
        subtitle=result.config.description,
        sections=(
            study_answer(view),
            *_notes(result),
            Section("cells", "Every cell", sections=tuple(robot_cells(view, robot) for robot in view.robots)),
            rank_section(view),
            *curve_section(view),
            *regime_section(view),
            _method_section(view),
            _data_section(result),
            _reproduction(result),
        ),
        badges=badges,
    )


def _notes(result: StudyResult) -> tuple[Section, ...]:
    blocks: list[Block] = []
    if result.config.notes:
        blocks.append(Callout("Notes of the config", result.config.notes))
    if result.broken:
        items = tuple(f"{name}: {reason}" for name, reason in result.broken.items())
        blocks.append(Callout("Recordings that cannot be read", items, "warning"))
    if result.failures:
        more = len(result.failures) - _SHOWN
        rest = (f"and {more} more, see study.parquet",) if more > 0 else ()
        blocks.append(Callout("Fits that failed", (*result.failures[:_SHOWN], *rest), "warning"))
    if result.warnings:
        blocks.append(Callout("Warnings", result.warnings, "warning"))
    return (Section("notes", "Before you rely on it", tuple(blocks)),) if blocks else ()


def _method_section(view: StudyView) -> Section:
    """Outcomes, time and first numbers of every method, robot by robot."""
    rows = []
    for robot in view.robots:
        rows.append(Row.of(robot, role="group"))
        rows += [row for method in view.methods if (row := _method_row(view, robot, method)) is not None]
    table = Table(
        "Outcomes and time",
        (
            Column("Method", numeric=False),
            Column("Fits"),
            Column("Outcomes", numeric=False),
            Column("Median time"),
            Column("Says of its first answer, or why it has none", numeric=False),
        ),
        tuple(rows),
        "Not applicable: the method is not for this robot, or not for such paths.",
    )
    about = "How each method ended on each robot, what it took and what it found."
    return Section("methods", "Methods, time and parameters", (table,), about=about, folded=True)


def _method_row(view: StudyView, robot: str, method: str) -> Row | None:
    fits = [each for each in view.result.fits if each.fit.robot.name == robot and each.fit.method.shown == method]
    if not fits:
        return None
    outcomes = Counter(str(each.outcome) for each in fits)
    answered = [each for each in fits if each.answered]
    spent = sorted(each.result.seconds for each in answered if each.result is not None)
    first = answered[0] if answered else fits[0]
    return Row.of(
        Cell(method, view.family(method)),
        count(len(fits)),
        ", ".join(f"{number} {outcome}" for outcome, number in outcomes.items()),
        seconds(spent[len(spent) // 2] if spent and view.result.config.timing else None),
        first.reason,
        role="plain" if answered else "muted",
    )


def _data_section(result: StudyResult) -> Section:
    rows = []
    for robot in result.robots:
        dataset = robot.dataset
        sessions = {run.session for run in dataset.trajectories} - {None}
        rows.append(
            Row.of(
                Cell(robot.name, "simulated" if dataset.simulated else "recorded"),
                count(len(dataset.trajectories)),
                count(len(sessions)) if sessions else "not known",
                listing([training.name for training in robot.trainings], 20),
                Cell(dataset.source, dataset.licence),
            )
        )
    rows += [
        Row.of(name, "", "", Cell("cannot be read", reason), "", role="failed")
        for name, reason in result.broken.items()
    ]
    table = Table(
        "Robots",
        (
            Column("Robot", numeric=False),
            Column("Runs"),
            Column("Sessions"),
            Column("Trainings", numeric=False),
            Column("Source", numeric=False),
        ),
        tuple(rows),
    )
    return Section("data", "Data", (table,), about="Where the recordings come from.", folded=True)


def _reproduction(result: StudyResult) -> Section:
    config = result.config
    settings = (
        Fact("Budget of each fit", f"{plural(config.budget.evaluations, 'evaluation')} or {config.budget.seconds:g} s"),
        Fact("Seeds", listing([str(seed) for seed in config.seeds], 20)),
    )
    return reproduction_section(config, settings, result.environment)
