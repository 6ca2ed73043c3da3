"""The picture that a report begins with: paths of a few runs by two models, beside the reference."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.numbers import listing
from omnibench.report.recording.drawing import REFERENCE_ITEM
from omnibench.report.recording.scan_points import evenly
from omnibench.report.style import plan
from omnibench.report.traces import START, marks, path
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

MOST_PICTURES = 3  # runs: as many as stand side by side
CALIBRATED = "#0072b2"
_POINTS = 160  # points that a path is drawn with (chosen)
_HEIGHT = 330  # px
_LEAST_WINDOW = 0.1  # m: a smaller picture would magnify the reference's noise


def paths_before_after(
    runs: Mapping[str, Trajectory], models: Sequence[tuple[LegendItem, OdometryModel]], which: str
) -> FigureGrid | None:
    """Reference and odometry of at most three runs, side by side, on one scale in m; None without a run.

    runs: by titles. models: in the order in which they are drawn. which: the choice of the runs, a sentence.
    """
    shown = dict(list(runs.items())[:MOST_PICTURES])
    if not shown:
        return None
    figures = tuple(_run(title, run, models) for title, run in shown.items())
    names = listing([item.label for item, _ in models])
    caption = f"{which} Circle: start; dots: ends of reference and odometry. In the titles: distance of the end from "
    caption += f"the reference's, by {names}." if len(models) == 1 else f"the reference's, by {names}, in this order."
    items = (REFERENCE_ITEM, *(item for item, _ in models))
    columns: Literal[1, 2, 3] = 3 if len(figures) == 3 else 2 if len(figures) == 2 else 1
    return FigureGrid(figures, items, columns, caption, "paths-before-after" if len(models) > 1 else "paths")


def choice_in_words(runs: Mapping[str, Trajectory]) -> str:
    """How :func:`runs_with_paths` chose these runs."""
    if not {"Straight", "Turning left", "Turning right"} & set(runs):
        return f"{plural(len(runs), 'run')} of different motions"
    return "Of each kind of motion the run that the design values miss by the median"


def _run(title: str, run: Trajectory, models: Sequence[tuple[LegendItem, OdometryModel]]) -> Figure:
    reference = run.poses[evenly(len(run.poses), 2 * _POINTS)]
    stamps = np.linspace(0.0, max(run.pose_times[-1], run.times[-1]), _POINTS)
    traces = [path(REFERENCE_ITEM, reference, 3.5), marks(REFERENCE_ITEM, 8, *reference[-1:, :2].T)]
    drawn, ends = [reference[:, :2]], []
    for item, model in models:
        (poses,) = model.poses([run.log(stamps)])
        traces += [path(item, poses, 2.2), marks(item, 8, *poses[-1:, :2].T)]
        drawn.append(poses[:, :2])
        (end,) = model.poses([run.final_log])
        ends.append(math.hypot(*(end[-1, :2] - run.final_pose[:2])))
    traces.append(marks(START, 9, *run.start[None, :2].T, hover="start"))
    words = " → ".join(_length(end) for end in ends)
    window = _window(np.vstack(drawn))
    figure = plan(*traces, window=window)
    figure.update_layout(margin={"l": 48, "r": 10, "t": 8, "b": 44})
    description = f"Paths of a run ({title}): reference and odometry, x and y in m; at the end {words} from it"
    return Figure(f"{title}: {words}", figure, description, _HEIGHT)


def _window(points: Array) -> Array:
    """A square window (2, 2) about the points, m, with a margin."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    half = 0.56 * max(float((high - low).max()), _LEAST_WINDOW)
    window: Array = ((low + high) / 2)[:, None] + half * np.array([[-1.0, 1.0]] * 2)
    return window


def _length(metres: float) -> str:
    return f"{1e3 * metres:.0f} mm" if metres < 1 else f"{metres:.2f} m"
