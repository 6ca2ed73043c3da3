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
from omnibench.report.numbers import count, decimals_for, fixed, motion_in_words
from omnibench.report.style import INK, PALETTE, REFERENCE, THEORETICAL, plan, plot
from omnibench.robot.kinematics import Array, Robot, compose, interpolated, seen_from
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

_SHOWN = 4  # runs, where kinds of motion are not known
_STRAIGHT = 1e-3  # rad/s; a slower turn counts as straight
ON_THE_SPOT = "on the spot"


def describe(trajectory: Trajectory) -> str:
    """A trajectory's motion command as the paper writes it; without one, its name."""
    if trajectory.alpha is None or trajectory.omega is None:
        command = "" if trajectory.command is None else f"{trajectory.command}, "
        return f"{command}{trajectory.id}"
    speed = "" if trajectory.v is None else f"{trajectory.v:.3g} m/s, "
    turn = fixed(trajectory.omega, 2)
    return f"({speed}{math.degrees(trajectory.alpha):.0f}°, {turn} rad/s), {trajectory.id}"


def representative_runs(dataset: Dataset) -> dict[str, Trajectory]:
    """One run of each kind of motion (straight, turning left, turning right, on the spot), by a name that says which.

    The run chosen of a kind has the median final position error of the design odometry. Where the data set has
    scans, only runs with scans are chosen. Where commands are unknown or of one kind: runs spread over the recording.
    """
    runs: Sequence[Trajectory] = dataset.trajectories
    if dataset.scans is not None:
        scanned = set(dataset.scans.trajectories)
        runs = [run for run in runs if run.id in scanned]
    design = OdometryModel.of_design(dataset.robot, "arc")
    by_kind = {kind: _of_median_error(like, design) for kind, like in kinds_of(runs).items()}
    if len(by_kind) > 1:
        return {f"{kind}: {describe(run)}": run for kind, run in by_kind.items()}
    return {describe(run): run for run in spread(runs)}


def motion_titles(runs: Sequence[Trajectory]) -> dict[str, Trajectory]:
    """Runs by their motions in words, with their names where motions are not known or alike."""
    words = [motion_in_words(run.id, run.v, run.alpha, run.omega) for run in runs]
    unique = len(set(words)) == len(words)
    return {name if unique else f"{name}, {run.id}": run for name, run in zip(words, runs, strict=True)}


def spread(runs: Sequence[Trajectory], number: int = _SHOWN) -> list[Trajectory]:
    """Some runs, evenly spaced, the first and the last among them."""
    return [runs[index] for index in evenly(len(runs), number)]


def kinds_of(runs: Sequence[Trajectory]) -> dict[str, list[Trajectory]]:
    """The runs of each kind of commanded motion; of turning ones only those at the highest rate."""
    kinds: dict[str, list[Trajectory]] = {"straight": [], "turning left": [], "turning right": [], ON_THE_SPOT: []}
    for run in runs:
        if run.omega is None or run.alpha is None:
            continue
        turns = abs(run.omega) >= _STRAIGHT
        if run.v == 0 and turns:
            kinds[ON_THE_SPOT].append(run)
        elif run.v != 0:
            kinds["straight" if not turns else "turning left" if run.omega > 0 else "turning right"].append(run)
    fastest = {kind: max((abs(run.omega or 0.0) for run in like), default=0.0) for kind, like in kinds.items()}
    return {
        kind: [run for run in like if kind == "straight" or math.isclose(abs(run.omega or 0.0), fastest[kind])]
        for kind, like in kinds.items()
        if like
    }


def _of_median_error(runs: Sequence[Trajectory], odometry: OdometryModel) -> Trajectory:
    ends = odometry.poses([run.final_log for run in runs])
    errors = [math.hypot(*(end[-1, :2] - run.final_pose[:2])) for end, run in zip(ends, runs, strict=True)]
    return runs[int(np.argsort(errors)[(len(errors) - 1) // 2])]


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
    points: Array = poses[:, :2] + over_the_floor * np.column_stack([np.cos(directions), np.sin(directions)])
    return points


def evenly(count: int, limit: int) -> Array:
    """At most ``limit`` of the indices 0 to ``count`` - 1, evenly spaced, the first and the last among them."""
    picks: Array = np.unique(np.linspace(0, count - 1, min(limit, count)).round().astype(int))
    return picks


def thinned(points: Array, limit: int, cell: float = 0.01) -> Array:
    """At most ``limit`` of the points (n, 2): one for each occupied cell of a grid (``cell`` m), widened as needed."""
    while True:
        _, first = np.unique(np.round(points / cell).astype(np.int64), axis=0, return_index=True)
        if len(first) <= limit:
            kept: Array = points[np.sort(first)]
            return kept
        cell *= 1.25


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
        points = seen_from(shown.start, thinned(run_points(dataset, shown), _POINTS))
        room.append(marks(SCANS_ITEM, 2.5, *points.T, opacity=0.6))
        title = f"The room that {shown.id} saw"
        figures.append(Figure(title, _map([*room, *paths]), f"{title}, by its scans, with the paths of all runs", 340))
        items += [SCANS_ITEM, *([PLAN_ITEM] if outlines else [])]
    return FigureGrid(tuple(figures), tuple(items), 2, words, "paths")


def run_points(dataset: Dataset, trajectory: Trajectory) -> Array:
    """Scan points (n, 2) of a run, m, in the frame of its reference poses, from at most 120 scans."""
    if dataset.scans is None:
        return np.empty((0, 2))
    scanner, scans = dataset.scans.scanner, dataset.scans.of(trajectory.id)
    picks = evenly(len(scans.times), _SCANS)
    return np.vstack([scan_points(trajectory, scanner, scans, int(scan)) for scan in picks])


def _map(traces: Sequence[go.Scatter]) -> go.Figure:
    """A plan of the traces with a margin, so that no line runs along the frame."""
    columns = [np.concatenate([np.asarray(getattr(each, axis), float) for each in traces]) for axis in "xy"]
    window = np.array([[np.nanmin(values), np.nanmax(values)] for values in columns])
    margin = np.maximum(0.05 * np.ptp(window, axis=1, keepdims=True), 0.05)  # m
    return plan(*traces, window=window + margin * [-1, 1])


_MEAN_OVER = 0.1  # s; also in the legends
_DRAWN = 600  # means drawn at most (chosen: as fine as a screen shows)
_ROW = 130  # px, height of a wheel's row
_GAP = 0.06  # space between rows, as a share of the plot

_MEAN = LegendItem("mean", "measured, mean over 100 ms", PALETTE[0])
_TARGET = LegendItem("target", "target", INK, "dash")
_STEERING = LegendItem("steering", "steering angle", PALETTE[3])
_ERROR = LegendItem("error", "measured − target, mean over 100 ms", PALETTE[2])


def wheel_rates(trajectory: Trajectory, robot: Robot) -> FigureGrid:
    """Rates, targets and steering angles over time, a row for each wheel; with targets also the difference."""
    times = trajectory.times
    period = float(np.median(np.diff(times, prepend=0.0)))
    size = max(1, round(_MEAN_OVER / period), -(-len(times) // _DRAWN))
    starts = np.arange(0, len(times), size)
    durations = np.diff(times, prepend=0.0)[:, None]
    lengths = np.add.reduceat(durations, starts)
    middles = np.append(0.0, times)[starts] + lengths[:, 0] / 2

    def means(item: LegendItem, values: Array, width: float = 1.6, unit: str = " rad/s") -> list[go.Scatter]:
        """Means of the columns of values (F, N) over blocks of samples, weighted by their durations."""
        rows = np.round(np.add.reduceat(values * durations, starts) / lengths, 9).T  # an even rate stays even
        hover = f"{item.label}<br>%{{y:.3f}}{unit} at %{{x:.2f}} s"
        return [line(item, width, middles, row, hover=hover) for row in rows]

    rows = [[trace] for trace in means(_MEAN, trajectory.rates)]
    items, titles = [_MEAN], [f"{name} (rad/s)" for name in robot.wheel_names]
    figures = []
    if trajectory.targets is not None:
        for row, target in zip(rows, means(_TARGET, trajectory.targets, 1.2), strict=True):
            row.append(target)
        error = trajectory.rates - trajectory.targets
        rms = float(np.sqrt((error**2).mean()))
        decimals = decimals_for(rms, 2)
        title = f"Measured − target: mean {fixed(float(error.mean()), decimals)}, RMS {fixed(rms, decimals)} rad/s"
        differences = _stacked([[trace] for trace in means(_ERROR, error)], titles, float(times[-1]))
        height = _ROW * len(rows) + 60
        figures.append(Figure(title, differences, "Difference of measured rates and targets, a row a wheel", height))
        items += [_TARGET, _ERROR]
    if trajectory.steering is not None:
        rows += [[trace] for trace in means(_STEERING, np.degrees(trajectory.steering), unit="°")]
        titles += [f"{name} (°)" for name in robot.drive.steered]
        items.append(_STEERING)
    drawn = _stacked(rows, titles, float(times[-1]))
    rates = Figure("Wheel rates", drawn, "Wheel rates over time, a row a wheel", _ROW * len(rows) + 60)
    return FigureGrid((rates, *figures), tuple(items), 2 if figures else 1)


def rate_step(trajectory: Trajectory) -> float | None:
    """The quantisation step of the measured wheel rates, rad/s; None if they show no encoder ticks."""
    values = np.unique(np.round(trajectory.rates, 7))
    if not 2 <= len(values) <= trajectory.rates.size / 4:
        return None
    step = float(np.diff(values).min())
    multiples = values / step
    # Ticks counted over periods that vary would not be multiples.
    return step if np.abs(multiples - np.round(multiples)).max() < 0.02 else None


def _stacked(rows: Sequence[Sequence[go.Scatter]], titles: Sequence[str], end: float) -> go.Figure:
    """Plots in rows above each other with a common time axis from 0 to ``end`` s."""
    height = (1 + _GAP) / len(rows) - _GAP
    layout: dict[str, Any] = {}
    for index, (row, title) in enumerate(zip(rows, titles, strict=True)):
        number = "" if index == 0 else str(index + 1)
        top = 1 - index * (height + _GAP)
        layout[f"yaxis{number}"] = {"domain": [max(0.0, top - height), top], "title": {"text": title}}
        for trace in row:
            trace.update(yaxis=f"y{number}")
    last = "y" if len(rows) == 1 else f"y{len(rows)}"
    traces = [trace for row in rows for trace in row]
    return plot(*traces, xaxis={"title": {"text": "t (s)"}, "anchor": last, "range": [0.0, end]}, **layout)
