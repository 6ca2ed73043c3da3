"""The report of a comparison: one HTML file that opens offline."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from omnibench.compare.report.error_figures import error_blocks
from omnibench.compare.report.headline import headline
from omnibench.compare.report.matrices import matrix_blocks
from omnibench.compare.report.path_figures import path_grid
from omnibench.compare.report.published_tables import published_blocks
from omnibench.compare.report.search_figures import search_blocks
from omnibench.compare.report.tables import (
    certificate_table,
    cost_in_words,
    cost_table,
    entry_table,
    final_error_table,
    run_table,
)
from omnibench.compare.report.view import SPLIT_NAMES, DatasetView, views
from omnibench.compare.report.wording import cost, cost_decimals, improvement_in_words, level_in_words
from omnibench.compare.result import ComparisonResult
from omnibench.config import to_yaml
from omnibench.data.dataset import SPLITS
from omnibench.errors import DataError
from omnibench.report.blocks import (
    Badge,
    Block,
    Callout,
    Cell,
    Code,
    Column,
    Details,
    Document,
    Fact,
    Facts,
    Paragraph,
    Row,
    Section,
    Table,
)
from omnibench.report.numbers import NOTHING, count, fixed, listing, plural, significant
from omnibench.report.recording.section import has_recording, recording_section
from omnibench.report.render import write_document
from omnibench.robot.kinematics import Array

_SIMULATED = Badge("SIMULATED DATA", "warning")
_FOLDED_ABOVE = 20  # runs


def write_report(result: ComparisonResult, path: Path) -> None:
    """Write the report of a comparison to ``path``, whole or not at all. DataError when the disk refuses."""
    write_document(comparison_document(result), path)


def comparison_document(result: ComparisonResult) -> Document:
    """The report as blocks, data set by data set."""
    found = views(result)
    if len(found) == 1:
        body = _parts(result, found[0], "")
    else:
        body = (
            Section("overview", "Overview", (_overview(found),)),
            *(
                Section(f"data-{index}", view.name, (), _parts(result, view, f"data-{index}-"), _badges(view))
                for index, view in enumerate(found, 1)
            ),
        )
    simulated = [view for view in found if view.dataset.simulated]
    badges = (_SIMULATED,) if len(simulated) == len(found) else (Badge("SIMULATED AND REAL DATA", "warning"),)
    return Document(
        title=f"Odometry calibrations compared: {result.config.name}",
        subtitle=result.config.description,
        sections=(*_about(result), *body, _reproduction(result)),
        badges=badges if simulated else (),
        footer=f"omnibench {result.environment.versions.get('omnibench', '')}, "
        f"written {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
    )


def _about(result: ComparisonResult) -> tuple[Section, ...]:
    blocks: list[Block] = []
    if result.config.notes:
        blocks.append(Callout("Before you read on", result.config.notes))
    if result.warnings:
        blocks.append(Callout("Warnings", result.warnings, "warning"))
    return (Section("notes", "Notes", tuple(blocks)),) if blocks else ()


def _parts(result: ComparisonResult, view: DatasetView, prefix: str) -> tuple[Section, ...]:
    splits = [split for split in SPLITS if split in view.design_errors]
    runs: Block = run_table(view)
    if len(view.runs) > _FOLDED_ABOVE:
        runs = Details(f"Every run ({len(view.runs)})", (runs,))
    others = (
        Details(f"The same on the {SPLIT_NAMES[split]} data", (final_error_table(view, split),))
        for split in splits
        if split != view.scored
    )
    return (
        Section(f"{prefix}result", "Result", headline(view)),
        Section(f"{prefix}costs", "Costs", (*(cost_table(view, split) for split in splits), *published_blocks(view))),
        Section(
            f"{prefix}errors",
            "Final errors",
            (final_error_table(view, view.scored), *error_blocks(view), *others),
        ),
        Section(f"{prefix}paths", "Paths", (path_grid(view),)),
        *_recording(view, prefix),
        Section(f"{prefix}searches", "Searches", search_blocks(view)),
        Section(f"{prefix}outcomes", "Outcomes", (entry_table(view), *_proofs(result, view), runs)),
        Section(f"{prefix}matrices", "Matrices", matrix_blocks(view)),
        Section(f"{prefix}data", "Data", _data_blocks(result, view)),
    )


def _recording(view: DatasetView, prefix: str) -> tuple[Section, ...]:
    """Pictures of the recording; scans that cannot be read are no reason to lose the comparison."""
    if not has_recording(view.dataset):
        return ()
    try:
        return (recording_section(view.dataset, prefix),)
    except DataError as error:
        return (Section(f"{prefix}recording", "Recording", (Callout("No pictures", (str(error),), "warning"),)),)


def _proofs(result: ComparisonResult, view: DatasetView) -> tuple[Block, ...]:
    own = [certificate for certificate in result.certificates if certificate.dataset == view.name]
    return (certificate_table(own),) if own else ()


def _badges(view: DatasetView) -> tuple[Badge, ...]:
    return (_SIMULATED,) if view.dataset.simulated else ()


def _overview(found: list[DatasetView]) -> Table:
    rows = []
    for view in found:
        best = view.best
        reached = None if best is None else cost(best, view.scored)
        decimals = cost_decimals(view)
        rows.append(
            Row(
                (
                    Cell(view.name, "simulated" if view.dataset.simulated else ""),
                    Cell(NOTHING) if best is None else Cell(best.label, level_in_words(view)),
                    Cell(SPLIT_NAMES[view.scored]),
                    Cell(fixed(view.theoretical_cost(view.scored), decimals)),
                    Cell(NOTHING if reached is None else fixed(reached.value, decimals)),
                    Cell(NOTHING) if best is None else Cell(*improvement_in_words(best, view.scored, 1)),
                )
            )
        )
    return Table(
        "Best entry of each data set",
        (
            Column("Data set", numeric=False),
            Column("Best entry", numeric=False),
            Column("Scored on", numeric=False),
            Column("CF theoretical"),
            Column("CF best"),
            Column("Improvement"),
        ),
        tuple(rows),
        f"CF is the cost {cost_in_words(found[0])} Small print: 95 % bootstrap intervals. Of several that are level, "
        "the entry of lowest training cost is named.",
    )


def _data_blocks(result: ComparisonResult, view: DatasetView) -> tuple[Block, ...]:
    dataset = view.dataset
    trajectories = dataset.trajectories
    durations = np.array([trajectory.pose_times[-1] for trajectory in trajectories])
    commands = {trajectory.command for trajectory in trajectories} - {None}
    sessions = {trajectory.session for trajectory in trajectories} - {None}
    split_sizes = [f"{count(len(dataset.split(split)))} for {SPLIT_NAMES[split]}" for split in SPLITS]
    wheels = [
        f"{wheel.name}: radius {wheel.radius:g} m, distance {wheel.distance:g} m, "
        f"angle {fixed(np.degrees(wheel.angle), 1)}°"
        + (f", rollers {fixed(np.degrees(wheel.roller_angle), 1)}°" if wheel.roller_angle else "")
        for wheel in dataset.robot.wheels
    ]
    facts = [
        Fact("Data set", dataset.name, "simulated" if dataset.simulated else ""),
        Fact("Description", dataset.description),
        Fact("Source", dataset.source),
        Fact("Licence", dataset.licence),
        Fact("Trajectories", f"{count(len(trajectories))}: {listing(split_sizes)}"),
        Fact("Commands", count(len(commands)) if commands else "not known"),
        Fact("Sessions", listing(sorted(map(str, sessions))) if sessions else "not known"),
        Fact(
            "Duration",
            f"{_range(durations)} s a run",
            f"wheel samples every {significant(1e3 * dataset.sample_period, 3)} ms",
        ),
        Fact("Robot", dataset.robot.name, "; ".join(wheels)),
        Fact("Odometry", "exact arcs" if result.config.integration == "arc" else "Euler steps, Eq. (1)"),
        Fact("Content (SHA-256)", dataset.hash[:16]),
    ]
    told = " ".join(result.warnings)
    warnings = tuple(warning for warning in dataset.warnings if warning not in told)
    return (
        Facts(tuple(fact for fact in facts if fact.value)),
        Callout("Warnings on reading the data", warnings, "warning"),
    )


def _range(values: Array) -> str:
    low, high = (significant(float(value), 3) for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def _reproduction(result: ComparisonResult) -> Section:
    environment, config = result.environment, result.config
    facts = Facts(
        (
            Fact(
                "Budget of each run", f"{count(config.budget.evaluations)} evaluations or {config.budget.seconds:g} s"
            ),
            Fact("Seeds", listing([str(seed) for seed in config.seeds], 20)),
            Fact("Intervals", f"{count(config.bootstrap.resamples)} bootstrap resamples, seed {config.bootstrap.seed}"),
            Fact("Python", environment.python),
            Fact("Platform", environment.platform),
            Fact(
                "Processor", environment.processor or "not known", plural(environment.processors, "logical processor")
            ),
            Fact("Versions", ", ".join(f"{name} {version}" for name, version in environment.versions.items())),
        )
    )
    return Section(
        "reproduction",
        "How to reproduce",
        (
            Paragraph("The effective config lies beside this report. From this folder:"),
            Code("omnibench compare config.yaml --output again"),
            facts,
            Details("Effective config", (Code(to_yaml(config)),)),
        ),
    )
