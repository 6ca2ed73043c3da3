"""Figures of a recording: the runs that are shown, the room with its paths and scans, and the wheels' rates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.scans import Scanner, TrajectoryScans
from omnibench.data.true_poses import TruePath
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.figures import START, joined, line, marks, path
from omnibench.report.numbers import count, decimals_for, fixed, motion_in_words, round_down, significant
from omnibench.report.style import INK, PALETTE, REFERENCE, THEORETICAL, plan, plot
from omnibench.robot.kinematics import Array, Robot, compose, interpolated, placed, seen_from
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


SCANS, TRUTH, COVARIANCE, PLAN = "#7c8894", INK, PALETTE[0], "#b8977e"

REFERENCE_ITEM = LegendItem("reference", "reference poses", REFERENCE)
ODOMETRY_ITEM = LegendItem("odometry", "odometry by the design values", THEORETICAL, "dash")
TRUTH_ITEM = LegendItem("truth", "true path", TRUTH, "dot")
SCANS_ITEM = LegendItem("scans", "scan points", SCANS)
PLAN_ITEM = LegendItem("plan", "floor plan (truth)", PLAN)
COVARIANCE_ITEM = LegendItem("covariance", "covariance", COVARIANCE)


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


_MEAN_OVER = 0.1  # s; also in the legends
_DRAWN = 2000  # samples drawn at most (chosen: finer than a screen shows)
_ROW = 150  # px, height of a wheel's row
_GAP = 0.05  # space between rows, as a share of the plot

_HOVER = "{}<br>%{{y:.3f}} rad/s at %{{x:.2f}} s"
_MEASURED = LegendItem("measured", "measured", "#a9c9e8")
_MEAN = LegendItem("mean", "measured, mean over 100 ms", PALETTE[0])
_TARGET = LegendItem("target", "target", INK, "dash")
_STEERING = LegendItem("steering", "steering angle", PALETTE[3])
_ERROR = LegendItem("error", "measured − target, mean over 100 ms", PALETTE[2])


@dataclass(frozen=True, eq=False)
class _Series:
    """Piecewise constant values (n, N) between ``edges`` (n + 1,), s."""

    edges: Array
    values: Array

    @property
    def middles(self) -> Array:
        middles: Array = (self.edges[:-1] + self.edges[1:]) / 2
        return middles


def wheel_rates(trajectory: Trajectory, robot: Robot) -> FigureGrid:
    """Measured rates, targets and steering angles over time, a row for each wheel; with targets also the difference."""
    measured = _blocks(trajectory.times, trajectory.rates, max(1, -(-len(trajectory.times) // _DRAWN)))
    period = float(np.median(np.diff(trajectory.times, prepend=0.0)))
    size = max(1, round(_MEAN_OVER / period), -(-len(trajectory.times) // _DRAWN))
    mean = _blocks(trajectory.times, trajectory.rates, size)
    rows = [[_steps(_MEASURED, measured, w, 1.0), _line(_MEAN, mean, w, 1.8)] for w in range(len(robot.wheel_names))]
    items = [_MEASURED, _MEAN]
    words = []
    if len(measured.values) < len(trajectory.times):
        words.append(f"Samples are drawn as means over {significant(1e3 * size * period, 2)} ms.")
    step = rate_step(trajectory)
    if step is not None:
        words.append(
            f"The encoder resolves {significant(step, 3)} rad/s, one tick per sample; a mean over 100 ms is finer."
        )
    titles = [f"{name} (rad/s)" for name in robot.wheel_names]
    end = float(trajectory.times[-1])
    figures = []
    if trajectory.targets is not None:
        target = _blocks(trajectory.times, trajectory.targets, max(1, -(-len(trajectory.times) // _DRAWN)))
        for wheel, row in enumerate(rows):
            row.append(_steps(_TARGET, target, wheel, 1.6))
        error = _blocks(trajectory.times, trajectory.rates - trajectory.targets, size)
        errors = [[_line(_ERROR, error, wheel, 1.6)] for wheel in range(len(rows))]
        items += [_TARGET, _ERROR]
        figures.append(
            Figure(
                f"Measured − target: {_error_in_words(trajectory)}",
                _stacked(errors, titles, end, with_zero=True),
                "Difference of measured wheel rates and targets over time, one row a wheel",
                _ROW * len(rows) + 60,
            )
        )
    with_targets = bool(figures)
    description = "Wheel rates over time, one row a wheel" + (", with their targets" if with_targets else "")
    if trajectory.steering is not None:
        every = slice(None, None, max(1, -(-len(trajectory.times) // _DRAWN)))
        degrees = np.degrees(trajectory.steering[every].T)
        hover = "steering angle<br>%{y:.2f}° at %{x:.2f} s"
        angles = [[line(_STEERING, 1.8, trajectory.times[every], angle, hover=hover)] for angle in degrees]
        items.append(_STEERING)
        figures.append(
            Figure(
                "Steering angles",
                _stacked(angles, [f"{name} (°)" for name in robot.drive.steered], end),
                "Steering angles over time, one row a wheel",
                _ROW * len(angles) + 60,
            )
        )
    rates = Figure("Wheel rates", _stacked(rows, titles, end), description, _ROW * len(rows) + 60)
    return FigureGrid((rates, *figures), tuple(items), 2 if with_targets else 1, " ".join(words))


def rate_step(trajectory: Trajectory) -> float | None:
    """The quantisation step of the measured wheel rates, rad/s; None if they show no encoder ticks."""
    values = np.unique(np.round(trajectory.rates, 7))
    if not 2 <= len(values) <= trajectory.rates.size / 4:
        return None
    step = float(np.diff(values).min())
    multiples = values / step
    # Ticks counted over periods that vary would not be multiples.
    return step if np.abs(multiples - np.round(multiples)).max() < 0.02 else None


def _error_in_words(trajectory: Trajectory) -> str:
    assert trajectory.targets is not None
    error = (trajectory.rates - trajectory.targets).ravel()
    rms = float(np.sqrt((error**2).mean()))
    decimals = decimals_for(rms, 2)
    return f"mean {fixed(float(error.mean()), decimals)}, RMS {fixed(rms, decimals)} rad/s"


def _blocks(times: Array, values: Array, size: int) -> _Series:
    """Means over blocks of ``size`` samples, weighted by their durations; the last block may be shorter."""
    starts = np.arange(0, len(times), size)
    durations = np.diff(times, prepend=0.0)[:, None]
    weights = np.add.reduceat(durations, starts)
    means = np.round(np.add.reduceat(values * durations, starts) / weights, 9)  # an even rate stays even
    ends = times[np.minimum(starts + size, len(times)) - 1]
    return _Series(np.append(0.0, ends), means)


def _steps(item: LegendItem, series: _Series, wheel: int, width: float) -> go.Scatter:
    values = np.append(series.values[:, wheel], series.values[-1, wheel])
    return line(item, width, series.edges, values, hover=_HOVER.format(item.label), line_shape="hv")


def _line(item: LegendItem, series: _Series, wheel: int, width: float) -> go.Scatter:
    return line(item, width, series.middles, series.values[:, wheel], hover=_HOVER.format(item.label))


def _stacked(
    rows: Sequence[Sequence[go.Scatter]], titles: Sequence[str], end: float, with_zero: bool = False
) -> go.Figure:
    """Plots in rows above each other with a common time axis from 0 to ``end`` s."""
    height = (1 + _GAP) / len(rows) - _GAP
    layout: dict[str, Any] = {}
    traces = []
    for index, (row, title) in enumerate(zip(rows, titles, strict=True)):
        number = "" if index == 0 else str(index + 1)
        top = 1 - index * (height + _GAP)
        layout[f"yaxis{number}"] = {
            "domain": [max(0.0, top - height), top],
            "title": {"text": title},
            "zeroline": with_zero,
            "zerolinecolor": INK,
            "zerolinewidth": 1,
        }
        traces += [trace.update(yaxis=f"y{number}") for trace in row]
    last = "y" if len(rows) == 1 else f"y{len(rows)}"
    return plot(*traces, xaxis={"title": {"text": "t (s)"}, "anchor": last, "range": [0.0, end]}, **layout)
