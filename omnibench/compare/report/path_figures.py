"""The section on paths, as Fig. 5 to 7 of the paper: reference, theoretical and calibrated, and their ends."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.report.view import REFERENCE_STYLE, SPLIT_NAMES, THEORETICAL_STYLE, DatasetView
from omnibench.data.dataset import Trajectory
from omnibench.report.blocks import Figure, FigureGrid, LegendItem, Section
from omnibench.report.recording.runs import describe
from omnibench.report.recording.scan_points import evenly
from omnibench.report.style import plan, text
from omnibench.report.traces import START, line, marks, path
from omnibench.robot.kinematics import Array

_SHOWN = 4  # trajectories that are drawn, as many as in Fig. 6 of the paper
_POINTS = 160  # points that a path is drawn with (chosen)
_TAIL = 0.15  # last share of a run's duration, which the figure of its end shows (chosen)
_PAPER_DIRECTIONS = (30, 210, 120, 300)  # deg, of Fig. 6 (a) to (d)
_PAPER_TURN_RATE = 0.35  # rad/s


def path_section(view: DatasetView) -> Section:
    """A few trajectories of the scored split: whole paths, each beside the detail of its end."""
    figures = [
        figure(view, trajectory)
        for trajectory in chosen_trajectories(view.dataset.split(view.scored))
        for figure in (_path_figure, _end_figure)
    ]
    styles = [REFERENCE_STYLE, THEORETICAL_STYLE, *(view.styles[entry.label] for entry, _ in view.calibrated)]
    grid = FigureGrid(
        tuple(figures),
        tuple(styles),
        2,
        f"As Fig. 5 to 7 of the paper, on {SPLIT_NAMES[view.scored]} trajectories. Right: final poses about the "
        "reference's final position, the short strokes show the headings. The window holds the nearer ends; "
        "Autoscale, at the top right of a plot, shows all.",
    )
    return Section("paths", "Paths", (grid,))


def chosen_trajectories(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Up to four trajectories to draw: those of the paper's commands where they were driven, else a variety."""
    first_of = {t.command or t.session or t.id: t for t in reversed(trajectories)}
    distinct = [t for t in trajectories if first_of[t.command or t.session or t.id] is t]
    commanded = [t for t in distinct if t.alpha is not None and t.omega is not None and (t.v is None or t.v > 0)]
    by_direction = [_with_command(commanded, degrees) for degrees in _PAPER_DIRECTIONS]
    paper = [trajectory for trajectory in by_direction if trajectory is not None]
    if len(paper) == _SHOWN:
        return paper
    # Turns show an error of the model best.
    if commanded:
        strongest = max(abs(t.omega or 0.0) for t in commanded)
        distinct = [t for t in commanded if math.isclose(abs(t.omega or 0.0), strongest)]
        distinct.sort(key=lambda t: ((t.omega or 0.0) < 0, t.alpha or 0.0))
    pool = distinct if len(distinct) >= _SHOWN else list(trajectories)
    return [pool[index] for index in evenly(len(pool), _SHOWN)]


def _with_command(trajectories: Sequence[Trajectory], degrees: float) -> Trajectory | None:
    for trajectory in trajectories:
        direction = math.degrees(trajectory.alpha or 0.0) % 360
        if abs(direction - degrees) < 0.5 and math.isclose(trajectory.omega or 0.0, _PAPER_TURN_RATE, abs_tol=1e-3):
            return trajectory
    return None


def _models(view: DatasetView) -> list[tuple[LegendItem, Array]]:
    drawn = [(THEORETICAL_STYLE, view.design_matrix)]
    calibrated = sorted(view.calibrated, key=lambda pair: pair[0].is_best)  # the best on top
    drawn += [(view.styles[entry.label], run.matrix) for entry, run in calibrated if run.matrix is not None]
    return drawn


def _path_figure(view: DatasetView, trajectory: Trajectory) -> Figure:
    reference = trajectory.poses[evenly(len(trajectory.poses), 2 * _POINTS)]
    stamps = np.linspace(0.0, trajectory.pose_times[-1], _POINTS)
    traces = [path(REFERENCE_STYLE, reference, 3.5), _end_mark(REFERENCE_STYLE, reference, 9)]
    for style, matrix in _models(view):
        (poses,) = view.model(matrix).poses([trajectory.log(stamps)])
        traces += [path(style, poses, 1.8), _end_mark(style, poses, 7)]
    traces.append(marks(START, 9, trajectory.start[:1], trajectory.start[1:2], hover="start"))
    title = describe(trajectory)
    description = f"Paths of {title}: reference, theoretical and calibrated odometry, x and y in metres"
    return Figure(title, plan(*traces), description, 400)


def _end_mark(style: LegendItem, poses: Array, size: int) -> go.Scatter:
    return marks(style, size, poses[-1:, 0], poses[-1:, 1], marker_line_width=2)


def _end_figure(view: DatasetView, trajectory: Trajectory) -> Figure:
    final = trajectory.final_pose
    duration = trajectory.pose_times[-1]
    stamps = np.linspace((1 - _TAIL) * duration, duration, 60)
    tails = [(style, view.model(matrix).poses([trajectory.log(stamps)])[0]) for style, matrix in _models(view)]
    calibrated = tails[1:] or tails  # the design values come first, and are far away
    half = _window([_distance_mm(poses[-1], final) for _, poses in calibrated])
    late = trajectory.poses[trajectory.pose_times >= min(stamps[0], trajectory.pose_times[-2])]
    traces = _tail_traces(REFERENCE_STYLE, late, final, half, width=2.6)
    for style, poses in tails:
        traces += _tail_traces(style, poses, final, half, width=1.6)
    window = half * np.array([[-1.0, 1.0]] * 2)
    return Figure(
        f"Its end: {_ends_in_words(view, trajectory)}",
        plan(*traces, window=window, x_title="x − x of reference (mm)", y_title="y − y of reference (mm)"),
        f"Final poses of {describe(trajectory)} about the reference's final position, in millimetres",
        400,
    )


def _tail_traces(style: LegendItem, poses: Array, final: Array, half: float, width: float) -> list[go.Scatter]:
    millimetres = 1e3 * (poses[:, :2] - final[:2])
    end = millimetres[-1]
    stroke = end + 0.28 * half * np.array([[0.0, 0.0], [math.cos(poses[-1, 2]), math.sin(poses[-1, 2])]])
    hover = f"{text(style.label)}: {math.hypot(*end):.1f} mm, {math.degrees(poses[-1, 2] - final[2]):.2f}°"
    return [
        line(style, width, *millimetres.T, hover=hover, opacity=0.55),
        line(style, 2.2, *stroke.T, hover=hover, line_dash="solid"),
        marks(style, 11, end[:1], end[1:], hover=hover, marker_line_width=2),
    ]


def _ends_in_words(view: DatasetView, trajectory: Trajectory) -> str:
    """Distances of the theoretical end and the best entry's end from the reference's, in words."""
    (design,) = view.model(view.design_matrix).poses([trajectory.final_log])
    parts = [f"theoretical {_distance_mm(design[-1], trajectory.final_pose):.0f} mm off"]
    best = view.best
    if best is not None and best.typical is not None and best.typical.matrix is not None:
        (pose,) = view.model(best.typical.matrix).poses([trajectory.final_log])
        parts.append(f"{best.label} {_distance_mm(pose[-1], trajectory.final_pose):.0f} mm")
    return ", ".join(parts)


def _window(distances: Sequence[float]) -> float:
    """Half the width (mm) of a detail that holds the reference's end and the nearer half of the others at least."""
    near = [distance for distance in distances if distance <= 2.5 * float(np.median(distances))]
    return max(5.0, 1.45 * max(near))


def _distance_mm(pose: Array, reference: Array) -> float:
    return 1e3 * float(math.hypot(pose[0] - reference[0], pose[1] - reference[1]))
