"""Plans of the room with scans, reference poses, odometry and true paths: of all runs, and of one run."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.true_poses import TruePath
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.numbers import count, round_down
from omnibench.report.recording.driven import (
    COVARIANCE_ITEM,
    ODOMETRY_ITEM,
    PLAN_ITEM,
    REFERENCE_ITEM,
    SCANS_ITEM,
    TRUTH_ITEM,
    evenly,
    scan_points,
    thinned,
)
from omnibench.report.style import plan
from omnibench.report.traces import START, joined, line, marks, path
from omnibench.robot.kinematics import Array, placed, seen_from
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

# How much one figure draws (chosen: more cannot be told apart on a screen).
_POINTS = 3500  # scan points
_SCANS = 120  # scans of a run
_RUNS = 400  # runs
_PATH = 300  # poses of a path
_ELLIPSES = 6
_QUANTILE = math.sqrt(5.991)  # 95 % quantile of chi-square with 2 degrees of freedom, as a radius
_SHOWN_AS = 0.07  # half axis of the largest ellipse, as a share of the picture's size (chosen)


def all_runs(dataset: Dataset, shown: Trajectory, outlines: Sequence[Array]) -> FigureGrid:
    """The paths of all runs, moved to one start, and the room that the scans of the run ``shown`` saw.

    They are the reference's or, where no run has reference poses, those of the odometry by the design values.

    outlines: the walls of the floor plan as seen from that start, closed (n, 2) each, m; empty where not known.
    """
    runs = [dataset.trajectories[index] for index in evenly(len(dataset.trajectories), _RUNS)]
    measured = any(run.has_poses for run in runs)
    item = REFERENCE_ITEM if measured else ODOMETRY_ITEM
    poses = [_thin(run.poses) for run in runs] if measured else _driven(dataset, runs)
    flower = joined([seen_from(run.start, each) for run, each in zip(runs, poses, strict=True)])
    paths = [line(item, 1.0, *flower.T, opacity=0.75), _start(np.zeros(2))]
    number = plural(len(dataset.trajectories), "run")
    close = Figure(f"{number} from one start", _map(paths), "Paths of all runs from one start, close up", 380)
    words = "Each run is moved to begin at the origin along x."
    if len(runs) < len(dataset.trajectories):
        words += f" {count(len(runs))} of them are drawn."
    items = [item, *_room_items(dataset, outlines)]
    if dataset.scans is None:
        return FigureGrid((close,), tuple(items), 1, words, "paths")
    points = seen_from(shown.start, thinned(run_points(dataset, shown), _POINTS))
    room = Figure(
        f"The runs in the room that {shown.id} saw",
        _map([*_plan(outlines), marks(SCANS_ITEM, 2.5, *points.T, opacity=0.6), *paths]),
        "Reference paths of all runs with the points that the scans of one have seen, x and y in metres",
        380,
    )
    return FigureGrid((close, room), tuple(items), 2, words, "paths")


def _driven(dataset: Dataset, runs: Sequence[Trajectory]) -> list[Array]:
    """Paths (n, 3) of runs by the odometry at the robot's design values, m, m, rad."""
    model = OdometryModel.of_design(dataset.robot, "arc")
    return [model.poses([run.log(np.linspace(0.0, run.end, _PATH))])[0] for run in runs]


def one_run(
    dataset: Dataset, trajectory: Trajectory, odometry: OdometryModel, truth: TruePath | None, outlines: Sequence[Array]
) -> FigureGrid:
    """One run in its room, and close up with covariance ellipses of some reference poses.

    outlines: the walls of the floor plan in the frame of the run's reference poses, closed (n, 2) each, m.
    """
    end = trajectory.end
    (driven,) = odometry.poses([trajectory.log(np.linspace(0.0, end, _PATH))])
    lines = [
        path(REFERENCE_ITEM, _thin(trajectory.poses), 2.6),
        path(ODOMETRY_ITEM, driven, 1.8),
    ]
    items = [REFERENCE_ITEM, ODOMETRY_ITEM]
    if truth is not None:
        true_poses = placed(trajectory.start, truth.poses)
        lines.append(path(TRUTH_ITEM, _thin(true_poses), 1.6))
        items.append(TRUTH_ITEM)
    ellipses, words = _ellipses(trajectory, driven)
    items += [COVARIANCE_ITEM] if ellipses else []
    figures = []
    if dataset.scans is not None and trajectory.id in dataset.scans.trajectories:
        points = thinned(run_points(dataset, trajectory), _POINTS)
        room = _plan(outlines)
        room += [marks(SCANS_ITEM, 2.5, *points.T, opacity=0.7), *lines, _start(trajectory.start)]
        description = "Scan points of the run placed at its reference poses, with its paths, x and y in metres"
        figures.append(Figure("In its room", _map(room), description, 460))
    picks = evenly(len(trajectory.poses), 100)
    poses = [marks(REFERENCE_ITEM, 5, *trajectory.poses[picks, :2].T), *ellipses, _start(trajectory.start)]
    title = "Close up" if figures else "Its path"
    figures.append(Figure(title, _map([*lines, *poses]), "The run's paths close up, with covariance ellipses", 460))
    items += _room_items(dataset, outlines)
    caption = "Scan points are placed at the reference poses, each ray where the robot was when it was measured." * (
        len(figures) > 1
    )
    return FigureGrid(tuple(figures), tuple(items), 2 if len(figures) > 1 else 1, f"{caption} {words}".strip())


def run_points(dataset: Dataset, trajectory: Trajectory) -> Array:
    """Scan points (n, 2) of a run, m, in the frame of its reference poses, from at most 120 scans."""
    if dataset.scans is None:
        return np.empty((0, 2))
    scanner, scans = dataset.scans.scanner, dataset.scans.of(trajectory.id)
    picks = evenly(len(scans.times), _SCANS)
    return np.vstack([scan_points(trajectory, scanner, scans, int(scan)) for scan in picks])


def _ellipses(trajectory: Trajectory, driven: Array) -> tuple[list[go.Scatter], str]:
    """95 % ellipses of a few positions, enlarged until they can be seen, and the sentence that says so."""
    covariances = trajectory.pose_covariances
    if covariances is None:
        return [], ""
    picks = evenly(len(trajectory.poses), _ELLIPSES)
    values, vectors = np.linalg.eigh(covariances[picks, :2, :2])
    half_axes = _QUANTILE * np.sqrt(np.maximum(values, 0.0))
    largest = float(half_axes.max())
    if not largest > 0 or not math.isfinite(largest):
        return [], ""
    extent = float(np.ptp(np.vstack([trajectory.poses[:, :2], driven[:, :2]]), axis=0).max())
    factor = round_down(max(1.0, _SHOWN_AS * max(extent, 0.1) / largest))
    angle = np.linspace(0.0, 2 * math.pi, 41)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    shapes = [
        trajectory.poses[index, :2] + factor * (circle * axes) @ frame.T
        for index, axes, frame in zip(picks, half_axes, vectors, strict=True)
    ]
    trace = line(COVARIANCE_ITEM, 1.4, *joined(shapes).T)
    size = "as they are" if factor == 1 else f"drawn {count(factor)} times as large"
    return [trace], (
        f"Ellipses: 95 % of the position by the reference's covariance, {size}; the largest half axis is "
        f"{1e3 * largest:.3g} mm."
    )


def _thin(poses: Array) -> Array:
    kept: Array = poses[evenly(len(poses), _PATH)]
    return kept


def _plan(outlines: Sequence[Array]) -> list[go.Scatter]:
    return [line(PLAN_ITEM, 1.5, *joined(outlines).T)] if outlines else []


def _room_items(dataset: Dataset, outlines: Sequence[Array]) -> list[LegendItem]:
    return [SCANS_ITEM] * (dataset.scans is not None) + [PLAN_ITEM] * bool(outlines)


def _start(position: Array) -> go.Scatter:
    return marks(START, 9, position[:1], position[1:2], hover="start")


def _map(traces: Sequence[go.Scatter]) -> go.Figure:
    """A plan of the traces with a margin, so that no line runs along the frame."""
    columns = [np.concatenate([np.asarray(getattr(each, axis), float) for each in traces]) for axis in "xy"]
    window = np.array([[np.nanmin(values), np.nanmax(values)] for values in columns])
    margin = np.maximum(0.05 * np.ptp(window, axis=1, keepdims=True), 0.05)  # m
    return plan(*traces, window=window + margin * [-1, 1])
