"""Figures of a recording: the runs that are shown, the room with its paths and scans, and the wheels' rates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.scans import Scanner, TrajectoryScans
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.figures import START, joined, line, marks
from omnibench.report.numbers import count, decimals_for, fixed
from omnibench.report.style import INK, PALETTE, REFERENCE, THEORETICAL, plan, plot
from omnibench.robot.kinematics import Array, Robot, compose, interpolated, seen_from
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

_SHOWN = 4  # runs, where kinds of motion are not known
KINDS = ("straight", "turning left", "turning right", "both ways", "on the spot")
_TURNS = 0.35  # rad: a run that turns less in all is straight; chosen
_ON_THE_SPOT = 0.5  # m a turn: a run that drives less turns on the spot, as seen from the wheels' reach; chosen
_ONE_WAY = 0.8  # of all turning that is to one side; chosen
_LOOKED_AT = 40  # poses by which a run's motion is told, so that the reference's noise does not count; chosen


def describe(trajectory: Trajectory) -> str:
    """A trajectory's motion command as the paper writes it; without one, its name."""
    if trajectory.alpha is None or trajectory.omega is None:
        command = "" if trajectory.command is None else f"{trajectory.command}, "
        return f"{command}{trajectory.id}"
    speed = "" if trajectory.v is None else f"{trajectory.v:.3g} m/s, "
    turn = fixed(trajectory.omega, 2)
    return f"({speed}{math.degrees(trajectory.alpha):.0f}°, {turn} rad/s), {trajectory.id}"


def kinds_of(runs: Sequence[Trajectory]) -> dict[str, list[int]]:
    """Indices of the runs of each kind of motion, by their reference poses; runs without poses are of none."""
    found: dict[str, list[int]] = {kind: [] for kind in KINDS}
    for index, run in enumerate(runs):
        if not run.has_poses:
            continue
        steps = np.diff(run.poses[evenly(len(run.poses), _LOOKED_AT)], axis=0)
        way, turned = float(np.hypot(*steps[:, :2].T).sum()), float(np.abs(steps[:, 2]).sum())
        left = float(steps[:, 2].clip(0).sum()) / turned if turned else 0.5
        kind = "turning left" if left > _ONE_WAY else "turning right" if left < 1 - _ONE_WAY else "both ways"
        if way < _ON_THE_SPOT * turned / math.tau:
            kind = "on the spot"
        found["straight" if turned < _TURNS else kind].append(index)
    return {kind: indices for kind, indices in found.items() if indices}


def representative_runs(dataset: Dataset) -> dict[str, Trajectory]:
    """One run of each kind of motion, by a name that says which.

    The run chosen of a kind has the median final position error of the design odometry. Where the data set has
    scans, only runs with scans are chosen. Where all are of one kind: runs spread over the recording.
    """
    runs: Sequence[Trajectory] = dataset.trajectories
    if dataset.scans is not None:
        scanned = set(dataset.scans.trajectories)
        runs = [run for run in runs if run.id in scanned]
    kinds = kinds_of(runs)
    if len(kinds) < 2:
        return {describe(run): run for run in (runs[index] for index in evenly(len(runs), _SHOWN))}
    design = OdometryModel.of_design(dataset.robot, "arc")
    posed = {index: runs[index] for like in kinds.values() for index in like}
    ends = zip(posed.items(), design.poses([run.final_log for run in posed.values()]), strict=True)
    errors = {index: math.hypot(*(end[-1, :2] - run.final_pose[:2])) for (index, run), end in ends}
    middle = {kind: sorted(like, key=lambda index: errors[index])[(len(like) - 1) // 2] for kind, like in kinds.items()}
    return {f"{kind}: {describe(runs[index])}": runs[index] for kind, index in middle.items()}


SCANS, TRUTH, PLAN = "#7c8894", INK, "#b8977e"

REFERENCE_ITEM = LegendItem("reference", "reference poses", REFERENCE)
ODOMETRY_ITEM = LegendItem("odometry", "odometry by the design values", THEORETICAL, "dash")
TRUTH_ITEM = LegendItem("truth", "true path", TRUTH, "dot")
SCANS_ITEM = LegendItem("scans", "scan points", SCANS)
PLAN_ITEM = LegendItem("plan", "floor plan (truth)", PLAN)


_GOES_ON = 0.1  # s of motion after the last pose: longer than a scan takes


def poses_at(trajectory: Trajectory, times: Array) -> Array:
    """Reference poses (..., 3) interpolated linearly at times (...), s.

    Before the first pose the robot rests; after the last one it keeps its velocity for 0.1 s.
    """
    stamps, poses = trajectory.pose_times, trajectory.poses
    if len(stamps) > 1:
        velocity = (poses[-1] - poses[-2]) / (stamps[-1] - stamps[-2])
        stamps, poses = np.append(stamps, stamps[-1] + _GOES_ON), np.vstack([poses, poses[-1] + velocity * _GOES_ON])
    return interpolated(times, stamps, poses)


def scan_points(trajectory: Trajectory, scanner: Scanner, scans: TrajectoryScans, scan: int, stride: int = 1) -> Array:
    """Points (n, 2) of one scan's walls, m; each ray starts at the reference pose of the time when it was measured."""
    ranges = scans.ranges[scan]
    seen = np.flatnonzero(scanner.valid(ranges) & ~scanner.on_floor(ranges))
    seen = seen[seen % stride == 0]
    poses = compose(poses_at(trajectory, scans.times[scan] + scanner.delays[seen]), scanner.mount.pose)
    directions = poses[:, 2] - scanner.mount.yaw + scanner.bearings[seen]
    over_the_floor = (ranges[seen] * scanner.level_shares[seen])[:, None]
    return poses[:, :2] + over_the_floor * np.column_stack([np.cos(directions), np.sin(directions)])


def evenly(count: int, limit: int) -> Array:
    """At most ``limit`` of the indices 0 to ``count`` - 1, evenly spaced, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(limit, count)).round().astype(int))


# How much one figure draws (chosen: more cannot be told apart on a screen).
_POINTS = 2500  # scan points
_SCANS = 120  # scans of a run
_RUNS = 80  # runs
_PATH = 100  # poses of a path


def all_runs(dataset: Dataset, shown: Trajectory, outlines: Sequence[Array]) -> FigureGrid:
    """The paths of all runs, moved to one start, in the room that the scans of the run ``shown`` saw.

    They are the reference's or, where no run has reference poses, those of the odometry by the design values.

    outlines: the walls of the floor plan as seen from that start, closed (n, 2) each, m; empty where not known.
    """
    runs = [dataset.trajectories[index] for index in evenly(len(dataset.trajectories), _RUNS)]
    item, poses = REFERENCE_ITEM, [run.poses[evenly(len(run.poses), _PATH)] for run in runs]
    if not any(run.has_poses for run in runs):
        model = OdometryModel.of_design(dataset.robot, "arc")
        item, poses = ODOMETRY_ITEM, [model.poses([run.log(np.linspace(0.0, run.end, _PATH))])[0] for run in runs]
    flower = joined([seen_from(run.start, each) for run, each in zip(runs, poses, strict=True)])
    paths = [line(item, 1.0, *flower.T, opacity=0.75), marks(START, 9, [0.0], [0.0], hover="start")]
    words = "Each run is moved to begin at the origin along x."
    if len(runs) < len(dataset.trajectories):
        words += f" {count(len(runs))} of them are drawn."
    figures = [
        Figure(f"{plural(len(dataset.trajectories), 'run')} from one start", _map(paths), "Paths of all runs", 340)
    ]
    items = [item]
    if dataset.scans is not None:
        room = [line(PLAN_ITEM, 1.5, *joined(outlines).T)] if outlines else []
        scanner, scans = dataset.scans.scanner, dataset.scans.of(shown.id)
        picks = evenly(len(scans.times), _SCANS)
        points = np.vstack([scan_points(shown, scanner, scans, int(scan)) for scan in picks])
        points = seen_from(shown.start, points[evenly(len(points), _POINTS)])
        room.append(marks(SCANS_ITEM, 2.5, *points.T, opacity=0.6))
        title = f"The room that {shown.id} saw"
        figures.append(Figure(title, _map([*room, *paths]), f"{title}, by its scans, with the paths of all runs", 340))
        items += [SCANS_ITEM, *([PLAN_ITEM] if outlines else [])]
    return FigureGrid(tuple(figures), tuple(items), 2, words, "paths")


def _map(traces: Sequence[go.Scatter]) -> go.Figure:
    """A plan of the traces with a margin, so that no line runs along the frame."""
    columns = [np.concatenate([np.asarray(getattr(each, axis), float) for each in traces]) for axis in "xy"]
    window = np.array([[np.nanmin(values), np.nanmax(values)] for values in columns])
    margin = np.maximum(0.05 * np.ptp(window, axis=1, keepdims=True), 0.05)  # m
    return plan(*traces, window=window + margin * [-1, 1])


MEAN_OVER = 0.1  # s; also in the legends
_DRAWN = 600  # means drawn at most (chosen: as fine as a screen shows)
_ROW = 130  # px, height of a wheel's row
_GAP = 0.06  # space between rows, as a share of the plot

_MEAN = LegendItem("mean", "measured, mean over 100 ms", PALETTE[0])
_TARGET = LegendItem("target", "target", INK, "dash")
_STEERING = LegendItem("steering", "steering angle", PALETTE[3])


def means_before(run: Trajectory, values: Array, times: Array, over: float = MEAN_OVER) -> Array:
    """Means (n, N) of the samples' values (F, N) over the time ``over`` before each of ``times`` (n,), s."""
    ends = np.append(0.0, run.times)
    sums = np.vstack([np.zeros(values.shape[1]), np.cumsum(values * np.diff(ends)[:, None], axis=0)])
    late = np.clip(times, over / 2, ends[-1])
    early = np.maximum(late - over, 0.0)
    return (interpolated(late, ends, sums) - interpolated(early, ends, sums)) / (late - early)[:, None]


def wheel_rates(run: Trajectory, robot: Robot) -> FigureGrid:
    """Rates with their targets, and steering angles, over time: a row for each wheel."""
    end = float(run.times[-1])
    over = max(MEAN_OVER, float(np.median(np.diff(run.times, prepend=0.0))), end / _DRAWN)
    times = np.arange(over, end + 1e-9, over) if end > over else run.times[-1:]

    def lines(item: LegendItem, values: Array, width: float, unit: str) -> list[go.Scatter]:
        rows = np.round(means_before(run, values, times, over), 9).T  # an even rate stays even
        hover = f"{item.label}<br>%{{y:.3f}}{unit} at %{{x:.2f}} s"
        return [line(item, width, times - over / 2, row, hover=hover) for row in rows]

    rows = [[trace] for trace in lines(_MEAN, run.rates, 1.6, " rad/s")]
    items, names, caption = [_MEAN], [f"{name} (rad/s)" for name in robot.wheel_names], ""
    if run.targets is not None:
        for row, target in zip(rows, lines(_TARGET, run.targets, 1.2, " rad/s"), strict=True):
            row.append(target)
        error = run.rates - run.targets
        mean, rms = float(error.mean()), float(np.sqrt((error**2).mean()))
        decimals = decimals_for(rms, 2)
        caption = f"Measured − target: mean {fixed(mean, decimals)}, RMS {fixed(rms, decimals)} rad/s."
        items.append(_TARGET)
    if run.steering is not None:
        rows += [[trace] for trace in lines(_STEERING, np.degrees(run.steering), 1.6, "°")]
        names += [f"{name} (°)" for name in robot.drive.steered]
        items.append(_STEERING)
    # Plots above each other with a common time axis
    height = (1 + _GAP) / len(rows) - _GAP
    layout: dict[str, Any] = {"xaxis": {"title": {"text": "t (s)"}, "anchor": f"y{len(rows)}", "range": [0.0, end]}}
    for index, (row, name) in enumerate(zip(rows, names, strict=True)):
        top = 1 - index * (height + _GAP)
        layout[f"yaxis{index + 1}"] = {"domain": [max(0.0, top - height), top], "title": {"text": name}}
        for trace in row:
            trace.update(yaxis=f"y{index + 1}")
    figure = plot(*(trace for row in rows for trace in row), **layout)
    shown = Figure("Wheel rates", figure, "Wheel rates over time, a row a wheel", _ROW * len(rows) + 60)
    return FigureGrid((shown,), tuple(items), 1, caption)


def rate_step(trajectory: Trajectory) -> float | None:
    """The quantisation step of the measured wheel rates, rad/s; None if they show no encoder ticks."""
    values = np.unique(np.round(trajectory.rates, 7))
    if not 2 <= len(values) <= trajectory.rates.size / 4:
        return None
    step = float(np.diff(values).min())
    multiples = values / step
    # Ticks counted over periods that vary would not be multiples.
    return step if np.abs(multiples - np.round(multiples)).max() < 0.02 else None
