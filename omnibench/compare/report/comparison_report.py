"""The report of a comparison: one HTML file that opens offline, with its sections on the data and on the robot.

The robot is shown as in Fig. 2 and 3 of the paper: its geometry as designed and as fitted, and its tracks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnibench.compare.report import view as sets
from omnibench.compare.report.cost_tables import cost_section
from omnibench.compare.report.error_figures import error_section, path_section
from omnibench.compare.report.headline import answer_of, path_picture
from omnibench.compare.report.outcome_tables import matrix_section, outcome_section
from omnibench.compare.report.search_figures import search_section
from omnibench.compare.report.study_report import study_document
from omnibench.compare.result import ComparisonResult
from omnibench.data.dataset import SPLITS, Trajectory
from omnibench.errors import DataError
from omnibench.report import blocks as page
from omnibench.report.figures import DESIGN, START, is_drawn, joined, line, marks, motion_system, parameters
from omnibench.report.numbers import MOST_MOTIONS, NOTHING, count, fixed, listing, motion_items, motion_of, significant
from omnibench.report.recording.recording_figures import evenly
from omnibench.report.recording.section import has_recording, recording_section
from omnibench.report.render import reproduction_section
from omnibench.report.style import INK, PALETTE, plan
from omnibench.robot.kinematics import Array, Robot, Wheel, class_of, seen_from
from omnibench.robot.physical import read_matrix
from omnibench.words import plural


def data_section(view: sets.DatasetView) -> page.Section:
    """The section about the data: origin, amount, robot, and warnings on reading them."""
    dataset = view.dataset
    trajectories = dataset.trajectories
    durations = np.array([trajectory.end for trajectory in trajectories])
    commands = {trajectory.command for trajectory in trajectories} - {None}
    sessions = {trajectory.session for trajectory in trajectories} - {None}
    split_sizes = [f"{count(len(dataset.split(split)))} {sets.SPLIT_NAMES[split]}" for split in SPLITS]
    wheels = [_wheel(wheel) for wheel in dataset.robot.wheels]
    facts = [
        page.Fact("Data set", dataset.name, "simulated" if dataset.simulated else ""),
        page.Fact("Description", dataset.description),
        page.Fact("Source", dataset.source),
        page.Fact("Licence", dataset.licence),
        page.Fact("Trajectories", f"{count(len(trajectories))}: {listing(split_sizes)}"),
        page.Fact("Commands", count(len(commands)) if commands else "not known"),
        page.Fact("Sessions", listing(sorted(map(str, sessions))) if sessions else "not known"),
        page.Fact(
            "Duration",
            f"{_range(durations)} s a run",
            f"wheel samples every {significant(1e3 * dataset.sample_period, 3)} ms",
        ),
        page.Fact("Robot", dataset.robot.name, "; ".join(wheels)),
        page.Fact("Odometry", "exact arcs" if view.config.integration == "arc" else "Euler steps, Eq. (1)"),
        page.Fact("Content (SHA-256)", dataset.hash[:16]),
    ]
    shown_above = " ".join(view.warnings)
    warnings = tuple(warning for warning in dataset.warnings if warning not in shown_above)
    blocks = (
        page.Facts(tuple(fact for fact in facts if fact.value)),
        page.Callout("Warnings on reading the data", warnings, "warning"),
    )
    return page.Section(
        "data", "Data", blocks, about="Where the recordings come from, and what they hold.", folded=True
    )


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


def _range(values: Array) -> str:
    low, high = (significant(float(value), 3) for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


_TRACKS = 72  # runs that are drawn at most: more cannot be told apart (chosen)
_POSES = 60  # poses that a track is drawn with (chosen)


def robot_section(view: sets.DatasetView) -> tuple[page.Section, ...]:
    """The robot where its wheels' positions are known; its tracks where no section on the recording shows them."""
    robot = view.dataset.robot
    grids = [] if has_recording(view.dataset) else [_tracks(view)]
    if is_drawn(robot):
        system, items = motion_system(robot)
        fitted = _fitted(view)
        legend = (*items, *(item for item, _ in fitted))
        words = "As Fig. 2 and 3 of the paper. " if view.of_the_paper else ""
        words += "A wheel's width is not known; its length is its diameter."
        if fitted:
            words += (
                f" {fitted[0][0].label}: the geometry that has its matrix. It takes up whatever else is wrong with the "
                "model, so that its wheels need not stand there."
            )
        grids.insert(0, page.FigureGrid((system, parameters(robot, fitted)), legend, 2, words))
    about = "Its wheels as designed and as fitted."
    return (page.Section("robot", "Robot", tuple(grids), about=about, folded=True),) if grids else ()


def _fitted(view: sets.DatasetView) -> list[tuple[page.LegendItem, Robot]]:
    """The robot with the geometry of the best entry's matrix; empty where no geometry has it."""
    best = view.best
    if best is None or best.typical is None or best.typical.matrix is None or best.label not in view.styles:
        return []
    robot = view.dataset.robot
    fitted = {each.name: each.value for each in read_matrix(robot, best.typical.matrix).parameters}
    if not fitted or class_of(robot) != "omni" or len(robot.wheels) != 3:  # the matrix of others has many geometries
        return []
    wheels = []
    for wheel in robot.wheels:
        of_wheel = {kind: fitted[f"{kind}_{wheel.name}"] for kind in ("radius", "distance", "angle")}
        wheels.append(wheel.model_copy(update={**of_wheel, "x": None, "y": None}))
    style = view.styles[best.label]
    item = replace(style, key="fitted", colour=style.colour if style.colour != DESIGN.colour else INK, dash="dash")
    return [(item, robot.model_copy(update={"wheels": tuple(wheels)}))]


def _tracks(view: sets.DatasetView) -> page.FigureGrid:
    """Reference paths of one run of each command from one start, a colour for each rate of turn."""
    runs = view.dataset.split(view.scored)
    first: dict[str, Trajectory] = {}
    for run in runs:
        first.setdefault(run.command or run.id, run)
    distinct = list(first.values())
    drawn = [distinct[index] for index in evenly(len(distinct), _TRACKS)]
    motions = sorted({motion_of(run) for run in drawn}, key=lambda motion: (motion[1], motion[0]))
    known = len(motions) <= MOST_MOTIONS and all(run.omega is not None for run in drawn)
    items = motion_items(motions) if known else [page.LegendItem("track", "reference", PALETTE[0])]
    traces = []
    for index, item in enumerate(items):
        paths = [
            seen_from(run.start, run.poses[evenly(len(run.poses), _POSES)])
            for run in drawn
            if not known or motion_of(run) == motions[index]
        ]
        traces.append(line(item, 1.4, *joined([path[:, :2] for path in paths]).T, opacity=0.85))
    traces.append(marks(START, 9, [0.0], [0.0], hover="start"))
    title = f"Reference paths of {plural(len(drawn), 'run')} from one start, {sets.SPLIT_NAMES[view.scored]}"
    figure = page.Figure(title, plan(*traces), "Reference paths of the runs, x and y in metres", 460)
    words = "One run of each command, moved to begin at the origin along x."
    return page.FigureGrid((figure,), tuple(items), 1, words)


def comparison_document(result: ComparisonResult) -> page.Document:
    """The report as blocks, data set by data set, or of several robots."""
    if result.config.robots:
        return study_document(result)
    datasets = sets.views(result)
    if len(datasets) == 1:
        body = _sections(datasets[0], "")
    else:
        body = (
            _overview(datasets),
            *(
                page.Section(
                    f"data-{index}",
                    view.name,
                    sections=_sections(view, f"data-{index}-"),
                    badges=page.simulated_badge(view.dataset.simulated),
                )
                for index, view in enumerate(datasets, 1)
            ),
        )
    return page.Document(
        title=f"Odometry calibrations compared: {result.config.name}",
        subtitle=result.config.description,
        sections=(body[0], *_about(result), *body[1:], _reproduction(result)),
        badges=page.simulated_badge(*(view.dataset.simulated for view in datasets)),
    )


def _about(result: ComparisonResult) -> tuple[page.Section, ...]:
    blocks: list[page.Block] = []
    if result.config.notes:
        blocks.append(page.Callout("Notes of the config", result.config.notes))
    if result.warnings:
        blocks.append(page.Callout("Warnings", result.warnings, "warning"))
    return (page.Section("notes", "Before you rely on it", tuple(blocks)),) if blocks else ()


def _sections(view: sets.DatasetView, prefix: str) -> tuple[page.Section, ...]:
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


def _prefixed(section: page.Section, prefix: str) -> page.Section:
    parts = tuple(_prefixed(part, prefix) for part in section.sections)
    return replace(section, key=f"{prefix}{section.key}", sections=parts)


def _recording(view: sets.DatasetView) -> tuple[page.Section, ...]:
    """Pictures of a recording with scans or targets; where scans cannot be read, the error stands in their place."""
    if not has_recording(view.dataset):
        return ()
    try:
        return (recording_section(view.dataset),)
    except DataError as error:
        return (page.Section("recording", "Recording", (page.Callout("No pictures", (str(error),), "warning"),)),)


def _overview(datasets: list[sets.DatasetView]) -> page.Section:
    """The answer on several data sets: the best entry of each, and the paths of the first."""
    tiles, rows = [], []
    for view in datasets:
        best = view.best
        gained = sets.improvement_in_words(best, view.scored, 1) if best is not None else (NOTHING, "")
        label = "" if best is None else f"{best.label}{f', {words}' if (words := sets.rivals_in_words(view)) else ''}"
        tiles.append(page.Fact(f"{view.name}: the cost fell by", gained[0], label))
        reached = None if best is None else best.cost(view.scored)
        decimals = sets.cost_decimals(view)
        rows.append(
            page.Row.of(
                page.Cell(view.name, "simulated" if view.dataset.simulated else ""),
                NOTHING if best is None else page.Cell(best.label, sets.rivals_in_words(view)),
                sets.SPLIT_NAMES[view.scored],
                fixed(view.theoretical_cost(view.scored), decimals),
                NOTHING if reached is None else fixed(reached.value, decimals),
                NOTHING if best is None else page.Cell(*gained),
            )
        )
    table = page.Table(
        "Best entry of each data set",
        (
            page.Column("Data set", numeric=False),
            page.Column("Best entry", numeric=False),
            page.Column("Runs scored", numeric=False),
            page.Column("Cost, design values"),
            page.Column("Cost, best entry"),
            page.Column("Improvement"),
        ),
        tuple(rows),
        f"The cost is {sets.cost_in_words(datasets[0])} Small print: 95 % intervals. Of several that are "
        "not told apart, the entry of lowest training cost is named.",
    )
    sentence = f"Calibrators compared on {plural(len(datasets), 'data set')}; each has a part of its own below."
    return page.answer_section(sentence, tiles, path_picture(datasets[0]), table)


def _reproduction(result: ComparisonResult) -> page.Section:
    config = result.config
    settings = (
        page.Fact(
            "Budget of each run", f"{plural(config.budget.evaluations, 'evaluation')} or {config.budget.seconds:g} s"
        ),
        page.Fact("Seeds", listing([str(seed) for seed in config.seeds], 20)),
        page.Fact(
            "Intervals",
            f"unit {config.bootstrap.unit or 'command where runs repeat commands, else run'}; from ten units on "
            f"{count(config.bootstrap.resamples)} bootstrap resamples, seed {config.bootstrap.seed}; from three on "
            "Student's t",
        ),
    )
    return reproduction_section(config, settings, result.environment)
