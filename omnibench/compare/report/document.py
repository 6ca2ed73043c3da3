"""The report of a comparison: one HTML file that opens offline; on the terminal, its answer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from omnibench.compare.config import CompareConfig
from omnibench.compare.report import tables
from omnibench.compare.report import view as sets
from omnibench.compare.report.answer import answer_section, path_picture
from omnibench.compare.report.paper import flower_figures, paper_paths, published_blocks
from omnibench.compare.report.robots import (
    RobotsView,
    cell_sections,
    curve_section,
    method_section,
    rank_section,
    regime_section,
    robots_answer,
    robots_table,
)
from omnibench.compare.report.searches import search_blocks
from omnibench.compare.result import ComparisonResult
from omnibench.data.dataset import SPLITS
from omnibench.errors import DataError
from omnibench.report import blocks as page
from omnibench.report.figures import DESIGN, is_drawn, motion_system
from omnibench.report.numbers import NOTHING, count, fixed, listing, significant
from omnibench.report.recording.section import has_recording, recording_section
from omnibench.report.render import reproduction_section
from omnibench.report.style import INK
from omnibench.robot.kinematics import Robot, Wheel, class_of
from omnibench.robot.physical import read_matrix
from omnibench.words import plural

_SHOWN = 12  # failures that are listed; the others are counted


def comparison_document(result: ComparisonResult) -> page.Document:
    """The report as blocks: the answer, then folded sections; of several data sets an overview and a part each."""
    config, notes = result.config, list[page.Block]()
    if config.notes:
        notes.append(page.Callout("Notes of the config", config.notes))
    if result.broken:
        items = tuple(f"{name}: {reason}" for name, reason in result.broken.items())
        notes.append(page.Callout("Recordings that cannot be read", items, "warning"))
    if config.robots and result.failures:
        more = len(result.failures) - _SHOWN
        rest = (f"and {more} more, see study.parquet",) if more > 0 else ()
        notes.append(page.Callout("Fits that failed", (*result.failures[:_SHOWN], *rest), "warning"))
    if result.warnings:
        notes.append(page.Callout("Warnings", result.warnings, "warning"))
    about = (page.Section("notes", "Before you rely on it", tuple(notes)),) if notes else ()
    answer, *body = _of_robots(result) if config.robots else _of_datasets(result)
    title = "Calibration methods on several robots" if config.robots else "Odometry calibrations compared"
    return page.Document(
        title=f"{title}: {config.name}",
        subtitle=config.description,
        sections=(answer, *about, *body, reproduction_section(config, _settings(config), result.environment)),
        badges=page.simulated_badge(*(dataset.simulated for dataset in result.datasets.values())),
    )


def _of_robots(result: ComparisonResult) -> Iterator[page.Section]:
    view = RobotsView(result)
    yield robots_answer(result)
    yield page.Section("cells", "Every cell", sections=tuple(cell_sections(view)), folded=True)
    yield rank_section(view)
    yield from curve_section(view)
    yield from regime_section(view)
    yield method_section(view)
    yield page.Section("data", "Data", (robots_table(result),), about="Where the recordings come from.", folded=True)


def _of_datasets(result: ComparisonResult) -> Iterator[page.Section]:
    views = sets.views(result)
    if len(views) == 1:
        yield from _sections(views[0])
        return
    yield _overview(views)
    for index, view in enumerate(views, 1):
        parts = tuple(replace(section, key=f"data-{index}-{section.key}") for section in _sections(view))
        badges = page.simulated_badge(view.dataset.simulated)
        yield page.Section(f"data-{index}", view.name, sections=parts, badges=badges)


def _sections(view: sets.DatasetView) -> Iterator[page.Section]:
    """The answer on one data set, then folded sections."""

    def folded(key: str, title: str, about: str, *blocks: page.Block) -> page.Section:
        return page.Section(key, title, blocks, about=about, folded=True)

    others = [split for split in view.splits if split != view.scored]
    costs: list[page.Block] = [tables.cost_table(view, view.scored), tables.final_error_table(view, view.scored)]
    for split in others:
        both = (tables.cost_table(view, split), tables.final_error_table(view, split))
        costs.append(page.Details(f"Costs and final errors of the {sets.SPLIT_NAMES[split]} runs", both))
    yield answer_section(view)
    yield folded("costs", "Costs and final errors", "Every entry beside the design values.", *costs)
    if published := (*published_blocks(view), *paper_paths(view)):
        yield folded("published", "Beside the published figures", "Tables and figures of the paper.", *published)
    if flower := tuple(flower_figures(view)):
        yield folded("directions", "Errors by direction", "Where the odometry ended, by commanded motion.", *flower)
    about = "Every entry over its seeds, beside the best; what no optimiser can beat; every run."
    runs = page.Details(f"Every run ({len(view.runs)})", (tables.run_table(view),))
    yield folded("outcomes", "Outcomes", about, tables.entry_table(view), *tables.certificate_table(view), runs)
    yield folded("searches", "Searches", "How fast each came how near the best known cost.", *search_blocks(view))
    about = "All elements, their differences from the design values, and the wheels that they stand for."
    if view.calibrated:
        yield folded("matrices", "Matrices", about, *tables.matrix_blocks(view))
    about = "Where the recordings come from, what they hold, and the robot's wheels."
    yield folded("data", "Data and robot", about, _data_facts(view), *_robot(view), *_recording(view))


def _data_facts(view: sets.DatasetView) -> page.Facts:
    dataset, runs = view.dataset, view.dataset.trajectories
    commands, sessions = {run.command for run in runs} - {None}, {run.session for run in runs} - {None}
    sizes = [f"{count(len(dataset.split(split)))} {sets.SPLIT_NAMES[split]}" for split in SPLITS]
    low, high = (significant(end(run.end for run in runs), 3) for end in (min, max))
    facts = (
        page.Fact("Data set", dataset.name, "simulated" if dataset.simulated else ""),
        page.Fact("Description", dataset.description),
        page.Fact("Source", dataset.source),
        page.Fact("Licence", dataset.licence),
        page.Fact("Trajectories", f"{count(len(runs))}: {listing(sizes)}"),
        page.Fact("Commands", count(len(commands)) if commands else "not known"),
        page.Fact("Sessions", listing(sorted(map(str, sessions))) if sessions else "not known"),
        page.Fact(
            "Duration",
            f"{low if low == high else f'{low} to {high}'} s a run",
            f"wheel samples every {significant(1e3 * dataset.sample_period, 3)} ms",
        ),
        page.Fact("Robot", dataset.robot.name, "; ".join(map(_wheel, dataset.robot.wheels))),
        page.Fact("Odometry", "exact arcs" if view.config.integration == "arc" else "Euler steps, Eq. (1)"),
        page.Fact("Content (SHA-256)", dataset.hash[:16]),
    )
    return page.Facts(tuple(fact for fact in facts if fact.value))


def _wheel(wheel: Wheel) -> str:
    """A wheel's design values: its place as it was given, angles in degrees."""
    lengths = (("radius", wheel.radius), ("distance", wheel.distance), ("x", wheel.x), ("y", wheel.y))
    angles = (("angle", wheel.angle), ("rollers", wheel.roller_angle or None))
    parts = [
        *([wheel.type] if wheel.type else []),
        *(f"{name} {value:g} m".replace("-", "−") for name, value in lengths if value is not None),
        *(f"{name} {fixed(np.degrees(value), 1)}°" for name, value in angles if value is not None),
        *([] if wheel.driven else ["not driven"]),
        *([] if wheel.measured else ["not measured"]),
    ]
    return f"{wheel.name}: {', '.join(parts)}"


def _robot(view: sets.DatasetView) -> Iterator[page.Block]:
    """Fig. 2 and 3: the robot as designed and, of three omni wheels, as the best entry's matrix has it."""
    robot, best = view.dataset.robot, view.best
    if not is_drawn(robot):
        return
    fitted: list[tuple[page.LegendItem, Robot]] = []
    matrix = None if best is None or best.typical is None else best.typical.matrix
    # The matrix of other robots has many geometries
    if best is not None and matrix is not None and class_of(robot) == "omni" and len(robot.wheels) == 3:
        found = {each.name: each.value for each in read_matrix(robot, matrix).parameters}
        wheels = []
        for wheel in robot.wheels if found else ():
            of_wheel = {kind: found[f"{kind}_{wheel.name}"] for kind in ("radius", "distance", "angle")}
            wheels.append(wheel.model_copy(update={**of_wheel, "x": None, "y": None}))
        style = view.styles[best.label]
        colour = style.colour if style.colour != DESIGN.colour else INK
        if wheels:
            item = replace(style, key="fitted", colour=colour, dash="dash")
            fitted = [(item, robot.model_copy(update={"wheels": tuple(wheels)}))]
    words = "A wheel's width is not known; its length is its diameter."
    words += " A fitted geometry takes up whatever else is wrong with the model." if fitted else ""
    yield replace(motion_system(robot, fitted), caption=words)


def _recording(view: sets.DatasetView) -> Iterator[page.Block]:
    """Pictures of a recording with scans or targets; where scans cannot be read, the error stands in their place."""
    if has_recording(view.dataset):
        try:
            yield from recording_section(view.dataset).blocks
        except DataError as error:
            yield page.Callout("No pictures", (str(error),), "warning")


def _overview(views: list[sets.DatasetView]) -> page.Section:
    """The answer on several data sets: the best entry of each, and the paths of the first."""
    tiles, rows = [], []
    for view in views:
        best, split, decimals = view.best, view.scored, view.cost_decimals
        gained = (NOTHING, "") if best is None else sets.improvement_cells(best, split, 1)
        reached = None if best is None else best.cost(split)
        tiles.append(page.Fact(f"{view.name}: the cost fell by", gained[0], "" if best is None else best.label))
        rows.append(
            page.Row.of(
                page.Cell(view.name, "simulated" if view.dataset.simulated else ""),
                NOTHING if best is None else page.Cell(best.label, sets.rivals_cell(view)),
                sets.SPLIT_NAMES[split],
                fixed(view.theoretical_cost(split), decimals),
                fixed(None if reached is None else reached.value, decimals),
                page.Cell(*gained),
            )
        )
    named = [page.Column(title, numeric=False) for title in ("Data set", "Best entry", "Runs scored")]
    numbers = [page.Column(title) for title in ("Cost, design values", "Cost, best entry", "Improvement")]
    note = f"The cost is {tables.cost_words(views[0])} Small print: 95 % intervals."
    table = page.Table("Best entry of each data set", (*named, *numbers), tuple(rows), note)
    sentence = f"Calibrators compared on {plural(len(views), 'data set')}; each has a part of its own below."
    return page.answer_section(sentence, tiles, path_picture(views[0]), table)


def _settings(config: CompareConfig) -> tuple[page.Fact, ...]:
    """The settings that matter most to whoever repeats the comparison."""
    budget = f"{plural(config.budget.evaluations, 'evaluation')} or {config.budget.seconds:g} s"
    seeds = listing([str(seed) for seed in config.seeds], 20)
    unit = config.bootstrap.unit or "command where runs repeat commands, else run"
    basis = (
        f"unit {unit}; {count(config.bootstrap.resamples)} resamples from ten units on, seed {config.bootstrap.seed}"
    )
    facts = (page.Fact("Budget of each run", budget), page.Fact("Seeds", seeds))
    return facts if config.robots else (*facts, page.Fact("Intervals", basis))
