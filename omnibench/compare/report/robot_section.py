"""The section on the robot, as Fig. 2 and 3 of the paper: its geometry as designed and as fitted, and its tracks."""

from __future__ import annotations

from dataclasses import replace

from omnibench.compare.report.view import SPLIT_NAMES, DatasetView
from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.uncertainty.physical import geometry_of
from omnibench.report.blocks import Figure, FigureGrid, LegendItem, Section
from omnibench.report.motions import MOST_MOTIONS, motion_items, motion_of
from omnibench.report.recording.scan_points import evenly
from omnibench.report.recording.section import has_recording
from omnibench.report.robot_figures import DESIGN, is_drawn, motion_system, parameters
from omnibench.report.style import INK, PALETTE, plan
from omnibench.report.traces import START, joined, line, marks
from omnibench.robot.kinematics import Robot
from omnibench.robot.planar import seen_from
from omnibench.words import plural

_TRACKS = 72  # runs that are drawn at most: more cannot be told apart (chosen)
_POSES = 60  # poses that a track is drawn with (chosen)


def robot_section(view: DatasetView) -> tuple[Section, ...]:
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
        grids.insert(0, FigureGrid((system, parameters(robot, fitted)), legend, 2, words))
    about = "Its wheels as designed and as fitted."
    return (Section("robot", "Robot", tuple(grids), about=about, folded=True),) if grids else ()


def _fitted(view: DatasetView) -> list[tuple[LegendItem, Robot]]:
    """The robot with the geometry of the best entry's matrix; empty where no geometry has it."""
    best = view.best
    if best is None or best.typical is None or best.typical.matrix is None or best.label not in view.styles:
        return []
    robot = view.dataset.robot
    try:
        radii, distances, angles = geometry_of(best.typical.matrix, robot).reshape(3, -1).tolist()
        wheels = tuple(
            wheel.model_copy(update={"radius": radius, "distance": distance, "angle": angle, "x": None, "y": None})
            for wheel, radius, distance, angle in zip(robot.wheels, radii, distances, angles, strict=True)
        )
    except DataError:
        return []
    style = view.styles[best.label]
    item = replace(style, key="fitted", colour=style.colour if style.colour != DESIGN.colour else INK, dash="dash")
    return [(item, robot.model_copy(update={"wheels": wheels}))]


def _tracks(view: DatasetView) -> FigureGrid:
    """Reference paths of one run of each command from one start, a colour for each rate of turn."""
    runs = view.dataset.split(view.scored)
    first: dict[str, Trajectory] = {}
    for run in runs:
        first.setdefault(run.command or run.id, run)
    distinct = list(first.values())
    drawn = [distinct[index] for index in evenly(len(distinct), _TRACKS)]
    motions = sorted({motion_of(run) for run in drawn}, key=lambda motion: (motion[1], motion[0]))
    known = len(motions) <= MOST_MOTIONS and all(run.omega is not None for run in drawn)
    items = motion_items(motions) if known else [LegendItem("track", "reference", PALETTE[0])]
    traces = []
    for index, item in enumerate(items):
        paths = [
            seen_from(run.start, run.poses[evenly(len(run.poses), _POSES)])
            for run in drawn
            if not known or motion_of(run) == motions[index]
        ]
        traces.append(line(item, 1.4, *joined([path[:, :2] for path in paths]).T, opacity=0.85))
    traces.append(marks(START, 9, [0.0], [0.0], hover="start"))
    title = f"Reference paths of {plural(len(drawn), 'run')} from one start, {SPLIT_NAMES[view.scored]}"
    figure = Figure(title, plan(*traces), "Reference paths of the runs, x and y in metres", 460)
    words = "One run of each command, moved to begin at the origin along x."
    return FigureGrid((figure,), tuple(items), 1, words)
