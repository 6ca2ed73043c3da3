"""The report of a comparison: one HTML file that opens offline. The answer, then folded sections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from omnibench.compare.report import charts, tables
from omnibench.compare.report import view as sets
from omnibench.compare.report.answer import answer_section, path_picture, robots_answer
from omnibench.compare.report.paper import flower_figures, paper_paths, published_blocks
from omnibench.compare.report.searches import search_blocks
from omnibench.compare.result import Cell, ComparisonResult
from omnibench.report import blocks as page
from omnibench.report.figures import DESIGN, is_drawn, motion_system
from omnibench.report.numbers import count, listing
from omnibench.report.recording.data_results import RobotResult
from omnibench.report.render import reproduction_section
from omnibench.report.style import INK
from omnibench.robot.kinematics import Robot, class_of
from omnibench.robot.physical import read_matrix
from omnibench.words import plural

_SHOWN = 12  # failures that are listed; the others are counted


def comparison_document(result: ComparisonResult) -> page.Document:
    """The report as blocks: the answer, then folded sections; of several data sets a part each."""
    config, notes, failures = result.config, list[page.Block](), result.failures
    notes += [page.Callout("Notes of the config", config.notes)] if config.notes else []
    broken = tuple(f"{name}: {reason}" for name, reason in result.broken.items())
    if config.robots and len(failures) > _SHOWN:
        failures = (*failures[:_SHOWN], f"and {len(failures) - _SHOWN} more, see study.parquet")
    for title, items in (
        ("Recordings that cannot be read", broken),
        ("Fits that failed", failures if config.robots else ()),  # of data sets the answer says it
        ("Warnings", result.warnings),
    ):
        notes += [page.Callout(title, items, "warning")] if items else []
    about = (page.Section("notes", "Before you rely on it", tuple(notes)),) if notes else ()
    answer, *body = _of_robots(result) if config.robots else _of_datasets(result)
    budget = f"{plural(config.budget.evaluations, 'evaluation')} or {config.budget.seconds:g} s"
    basis = f"unit {config.bootstrap.unit or 'command where runs repeat commands, else run'}; "
    basis += f"{count(config.bootstrap.resamples)} resamples from ten units on, seed {config.bootstrap.seed}"
    facts = [page.Fact("Budget of each run", budget), page.Fact("Seeds", listing(list(map(str, config.seeds)), 20))]
    facts += [] if config.robots else [page.Fact("Intervals", basis)]
    title = "Calibration methods on several robots" if config.robots else "Odometry calibrations compared"
    return page.Document(
        title=f"{title}: {config.name}",
        subtitle=config.description,
        sections=(answer, *about, *body, reproduction_section(config, tuple(facts), result.environment)),
        badges=page.simulated_badge(*(dataset.simulated for dataset in result.datasets.values())),
    )


def _folded(key: str, title: str, about: str, *blocks: page.Block | None) -> Iterator[page.Section]:
    """A folded section; nothing without blocks."""
    if shown := tuple(block for block in blocks if block is not None):
        yield page.Section(key, title, shown, about=about, folded=True)


def _of_robots(result: ComparisonResult) -> Iterator[page.Section]:
    yield robots_answer(result)
    parts = []
    for robot in result.robots:
        cells = result.recorded_cells(robot.name)
        of_cells: dict[str, tuple[page.Block, ...]] = {
            f"{cell.key.within_robot}": (tables.cell_table(result, cell),) for cell in cells
        }
        blocks = (charts.heat_map(result, robot.name, cells), page.Choice("Cell", of_cells))
        parts.append(page.Section(f"cells-{robot.name}", robot.name, blocks))
    about = "Every method in every cell, against the design."
    yield page.Section("cells", "Every cell", sections=tuple(parts), about=about, folded=True)
    judged = result.judged_cells
    asked = tuple(cell for cell in judged if all(entry.shown in cell.methods for entry in result.config.entries))
    groups: dict[str, tuple[Cell, ...]] = {"all robots": judged} if len(result.robots) > 1 else {}
    groups |= {"cells in which every method was asked": asked} if 0 < len(asked) < len(judged) else {}
    groups |= {r.name: tuple(cell for cell in judged if cell.key.robot == r.name) for r in result.robots}
    choices = {name: drawn for name, cells in groups.items() if (drawn := tuple(charts.rank_blocks(result, cells)))}
    about = "Which method is best over many cells, and how often each is near the best."
    yield from _folded("ranks", "Ranks and profiles", about, page.Choice("Robots", choices))
    yield from _folded("curves", "Learning curves", "How many runs a method needs.", charts.learning_curves(result))
    about = "Fewer runs, noise, outliers and drifting clocks in the training runs; those that judge stay."
    regimes = tables.regime_table(result) if result.config.regimes else None
    yield from _folded("regimes", "Which method breaks where", about, regimes)
    about = "How each method ended on each robot, what it took and what it found."
    yield from _folded("methods", "Methods, time and parameters", about, tables.outcome_table(result, result.runs))
    about = "Where the recordings come from."
    yield from _folded("data", "Data", about, tables.data_table(result.robots, result.broken))


def _of_datasets(result: ComparisonResult) -> Iterator[page.Section]:
    views = sets.views(result)
    if len(views) == 1:
        yield from _sections(views[0])
        return
    sentence = f"Calibrators compared on {plural(len(views), 'data set')}; each has a part of its own below."
    costs = (tables.cost_table(view, view.scored, brief=True) for view in views)
    tiles = [
        page.Fact(f"{view.name}: the cost fell by", sets.improvement_cells(share, 1)[0], view.best.label)
        for view in views
        if view.best is not None and (share := view.best.improvements[view.scored]) is not None
    ]
    yield page.answer_section(sentence, tiles, path_picture(views[0]), *costs)
    for index, view in enumerate(views, 1):
        parts = tuple(replace(section, key=f"data-{index}-{section.key}") for section in _sections(view))
        badges = page.simulated_badge(view.dataset.simulated)
        yield page.Section(f"data-{index}", view.name, sections=parts, badges=badges)


def _sections(view: sets.DatasetView) -> Iterator[page.Section]:
    """The answer on one data set, then folded sections."""
    result, fits = view.result, view.runs
    yield answer_section(view)
    costs: list[page.Block] = [tables.cost_table(view, split) for split in view.splits]
    costs.append(page.Paragraph(tables.cost_note(view), "note"))
    yield from _folded("costs", "Costs and final errors", "Every entry beside the design values.", *costs)
    about = "Tables and figures of the paper."
    published: list[page.Block] = [*published_blocks(view), *paper_paths(view)]
    yield from _folded("published", "Beside the published figures", about, *published)
    about = "Where the odometry ended, by commanded motion."
    yield from _folded("directions", "Errors by direction", about, *flower_figures(view))
    every = page.Details(f"Every run ({len(fits)})", (tables.outcome_table(result, fits, every=True),))
    several = len(fits) > len(view.statistics)  # seeds of some entry
    about = "Every entry over its seeds; what no optimiser can beat; every run."
    yield from _folded("outcomes", "Outcomes", about, tables.outcome_table(result, fits), every if several else None)
    yield from _folded("searches", "Searches", "How fast each came how near the best known cost.", *search_blocks(view))
    about = "All elements, their differences from the design values, and the wheels that they stand for."
    if view.calibrated:
        yield from _folded("matrices", "Matrices", about, *tables.matrix_blocks(view))
    about = "Where the recordings come from, and the robot's wheels."
    of_set = [robot for robot in result.robots if robot.name == view.name]
    (wheels,) = RobotResult(view.dataset.robot).tables()
    data = (tables.data_table(of_set, {}), replace(wheels, caption="Wheels, by design"), robot_picture(view))
    yield from _folded("data", "Data and robot", about, *data)


def robot_picture(view: sets.DatasetView) -> page.FigureGrid | None:
    """Fig. 2 and 3: the robot as designed and, of three omni wheels, as the best entry's matrix has it.

    None where it is not known where its wheels stand.
    """
    robot, best = view.dataset.robot, view.best
    if not is_drawn(robot):
        return None
    fitted: list[tuple[page.LegendItem, Robot]] = []
    matrix = None if best is None or best.typical is None else best.typical.matrix
    # The matrix of other robots has many geometries
    if best is not None and matrix is not None and class_of(robot) == "omni" and len(robot.wheels) == 3:
        found = {each.name: each.value for each in read_matrix(robot, matrix).parameters}
        if found:
            wheels = [
                wheel.model_copy(
                    update={kind: found[f"{kind}_{wheel.name}"] for kind in ("radius", "distance", "angle")}
                    | {"x": None, "y": None}
                )
                for wheel in robot.wheels
            ]
            style = view.styles[best.label]
            colour = style.colour if style.colour != DESIGN.colour else INK
            item = replace(style, key="fitted", colour=colour, dash="dash")
            fitted = [(item, robot.model_copy(update={"wheels": tuple(wheels)}))]
    words = "A wheel's width is not known; its length is its diameter."
    words += " A fitted geometry takes up whatever else is wrong with the model." if fitted else ""
    return replace(motion_system(robot, fitted), caption=words)
