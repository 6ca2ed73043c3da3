"""The picture that a report begins with: paths by two models beside the reference, and the ends of all runs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from omnibench.data.dataset import Trajectory
from omnibench.fit.evaluate import final_errors
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.figures import START, marks, path
from omnibench.report.numbers import fixed, motion_in_words
from omnibench.report.recording.recording_figures import REFERENCE_ITEM, evenly
from omnibench.report.style import INK, THEORETICAL, plan, text
from omnibench.robot.kinematics import Array, rotated
from omnibench.robot.model import OdometryModel

DESIGN_ITEM = LegendItem("design", "design values", THEORETICAL, "dash")
CALIBRATED = "#0072b2"
Models = Sequence[tuple[LegendItem, OdometryModel]]
_BEFORE, _AFTER = 3.2, 1.8  # px: before is seen behind after
_POINTS = 160  # points that a path is drawn with (chosen)
_ENDS = 500  # ends that are drawn of each model (chosen: more cannot be told apart)
_HEIGHT = 330  # px
_LEAST_WINDOW = 0.1  # m: a smaller picture would magnify the reference's noise
_TARGET = LegendItem("", "reference's end", INK, symbol="cross-thin-open")


def paths_before_after(runs: Sequence[Trajectory], models: Models, which: str) -> FigureGrid | None:
    """The path of a typical run by the reference and two models, and the ends of all runs; None without a run.

    models: before and after. which: the runs in words, such as ``held-out``. Runs without poses are left out. Typical
    is the run whose error, m and rad as one length, changes by the median; a turn on the spot has no path to see.
    """
    runs = [run for run in runs if run.has_poses]
    if not runs:
        return None
    ends = [_final_errors(model, runs) for _, model in models]
    gains = np.linalg.norm(ends[0], axis=1) - np.linalg.norm(ends[-1], axis=1)
    seen = [index for index, run in enumerate(runs) if np.ptp(run.poses[:, :2], axis=0).max() > _LEAST_WINDOW]
    ordered = sorted(seen or range(len(runs)), key=lambda index: gains[index])
    run = runs[ordered[(len(ordered) - 1) // 2]]
    title = motion_in_words(run.id, run.v, run.alpha, run.omega)
    figures = (path_picture(f"{title[0].upper()}{title[1:]}", run, models), _all_ends(runs, ends, models, which))
    caption = "The run whose error changes by the median. Circle: start; dots: ends. In the titles: distance of the "
    caption += "end from the reference's, and turn between them, before and after."
    items = (REFERENCE_ITEM, *(item for item, _ in models))
    return FigureGrid(figures, items, 2, caption, "paths-before-after")


def _final_errors(model: OdometryModel, runs: Sequence[Trajectory]) -> Array:
    """Final errors (Z, 3) of the odometry, x and y along the axes of each run's start, m, m, rad."""
    errors = final_errors(model, runs)
    along_starts = rotated(errors, np.array([-run.start[2] for run in runs]))
    return np.column_stack([along_starts, errors[:, 2]])


def path_picture(title: str, run: Trajectory, models: Models) -> Figure:
    """The path of a run by the reference and by models; after the title the error of each at its end."""
    reference = run.poses[evenly(len(run.poses), 2 * _POINTS)]
    stamps = np.linspace(0.0, run.pose_times[-1], _POINTS)
    traces = [path(REFERENCE_ITEM, reference, 3.5), marks(REFERENCE_ITEM, 8, *reference[-1:, :2].T)]
    drawn, words = [reference[:, :2]], []
    for number, (item, model) in enumerate(models):
        (poses,) = model.reported([run.log(stamps)])
        traces += [path(item, poses, _AFTER if number else _BEFORE), marks(item, 8, *poses[-1:, :2].T)]
        drawn.append(poses[:, :2])
        words.append(_error_in_words(_final_errors(model, [run])))
    traces.append(marks(START, 9, *run.start[None, :2].T, hover="start"))
    points = np.vstack(drawn)
    middle = (np.nanmin(points, axis=0) + np.nanmax(points, axis=0)) / 2
    figure = plan(*traces, window=_window(points, middle))
    return _compact(f"{title}: {' → '.join(words)}", figure, "Paths of a run: reference and odometry, x and y in m")


def _all_ends(runs: Sequence[Trajectory], ends: Sequence[Array], models: Models, which: str) -> Figure:
    """The ends of all runs by both models about the reference's."""
    picks = evenly(len(runs), _ENDS)
    names = [runs[index].id for index in picks]
    traces = []
    for (item, _), errors in zip(models, ends, strict=True):
        at = 1e3 * errors[picks, :2]
        hover = f"%{{text}}, {text(item.label)}<br>%{{x:.0f}} mm, %{{y:.0f}} mm"
        traces.append(marks(item, 6, *at.T, hover=hover, words=names, marker_opacity=0.65))
    traces.append(marks(_TARGET, 14, [0.0], [0.0], hover="the reference's end", marker_line_width=2.5))
    axes = {"x_title": "ahead (mm)", "y_title": "to the left (mm)"}
    drawn = np.vstack([np.zeros((1, 2)), *(1e3 * errors[picks, :2] for errors in ends)])
    figure = plan(*traces, window=_window(drawn, np.zeros(2)), **axes)
    words = " → ".join(map(_error_in_words, ends))
    title = f"Ends of {f'all {len(runs)}' if len(runs) > 1 else 'the'} {which} {'runs' if len(runs) > 1 else 'run'}"
    return _compact(f"{title}: {words}", figure, "Ends of the runs by both models about the reference's, in mm")


def _compact(title: str, figure: go.Figure, description: str) -> Figure:
    figure.update_layout(margin={"l": 48, "r": 10, "t": 8, "b": 44})
    return Figure(title, figure, f"{title}. {description}", _HEIGHT)


def _window(points: Array, middle: Array) -> Array:
    """A square window (2, 2) about a middle that holds the points, with a margin."""
    reach = np.nanmax(np.abs(points - middle), initial=_LEAST_WINDOW / 2)
    return middle[:, None] + 1.12 * float(reach) * np.array([[-1.0, 1.0]] * 2)


def _error_in_words(errors: Array) -> str:
    """The mean of final errors (n, 3), such as ``84 mm, 5.1°``."""
    distance = float(np.hypot(errors[:, 0], errors[:, 1]).mean())
    turned = math.degrees(float(np.abs(errors[:, 2]).mean()))
    words = f"{1e3 * distance:.0f} mm" if distance < 1 else f"{distance:.2f} m"
    return f"{words}, {fixed(turned, 1)}°".replace(" ", "\N{NO-BREAK SPACE}")
