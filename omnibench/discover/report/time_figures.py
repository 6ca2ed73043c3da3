"""Figures of the residuals over the time in a run, over the order of the runs, and over the reference's stamps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.report.motion_figures import CovariateFigure, fitted_curves, fitted_panels, grid, motion_panels
from omnibench.discover.report.residuals import NORMAL_95, Curve, ModelStyle, Panel, Residuals
from omnibench.report.blocks import FigureGrid
from omnibench.report.numbers import fixed
from omnibench.robot.kinematics import Array, interpolated, rotated
from omnibench.words import plural

_TIMES = 14  # times at which the mean residual is drawn; only the drawing hangs on it
_BLOCKS = 12  # blocks of runs, at most; only the drawing hangs on it
_RUNS = 3  # runs in a block, at least: the fewest that have a scatter with more than one degree of freedom
_STAMPS = 30  # bins of the stamps of a run; only the drawing hangs on it
_MOVING = 0.01  # m/s; slower counts as standing, and has no direction to be drawn along
_TURNING = math.radians(2.0)  # rad/s; slower counts as straight: a turn of 20 deg in 10 s; only the drawing hangs on it
_QUANTITIES = (("along the way", 1e3, "mm"), ("across, to the left", 1e3, "mm"), ("heading", math.degrees(1.0), "°"))


def elapsed_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
    """Mean residuals over the time of a run, for runs that turn left, right or not."""
    groups: dict[str, list[int]] = {}
    for index, run in enumerate(residuals.runs):
        groups.setdefault(_turning(run), []).append(index)
    panels = []
    for name in sorted(groups):
        members = groups[name]
        times = _times([residuals.runs[index] for index in members])
        means = {style.key: _means(residuals, members, style, times) for style in styles}
        half = NORMAL_95 * residuals.deviations(times) / np.sqrt(_running(residuals, members, times))[:, None]
        for axis, (quantity, factor, unit) in enumerate(_QUANTITIES):
            band = factor * half[:, axis]
            curves = tuple(Curve(style, factor * means[style.key][:, axis], band) for style in styles)
            panels.append(
                Panel(
                    f"{name} ({plural(len(members), 'run')}): {quantity}",
                    times,
                    curves,
                    "time since the start of the run (s)",
                    f"mean residual ({unit})",
                    unit,
                    shared=True,
                )
            )
    return grid(
        panels,
        styles,
        "Mean over runs of the pose residuals (reference minus odometry), along and across the direction of travel at "
        "that time; the band holds 95 % of what noise alone would do to the mean.",
    )


def order_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
    """The error of the motion over the runs in the order in which they were driven, in blocks of runs."""
    runs = residuals.runs
    if any(run.started_at is None for run in runs) and len({run.session for run in runs}) < 2:
        return None
    blocks = _blocks(runs)
    if len(blocks) < 2:
        return None
    paths = residuals.paths
    number = np.repeat(np.arange(len(blocks)), [len(block) for block in blocks])  # block of each run
    bins = (number[paths.owner][:, None] == np.arange(len(blocks))).astype(float)
    centres = np.array([np.mean(block) + 1 for block in blocks])
    words = tuple(_block_in_words([runs[index] for index in block]) for block in blocks)
    panels = motion_panels(residuals, styles, bins, centres, "run, in the order driven", "the runs", words)
    sessions = len({run.session for run in runs})
    several = f" The runs are of {sessions} sessions, one after another." if sessions > 1 else ""
    return grid(panels, styles, f"Each point stands for some runs in a row.{several}")


def stamps_grid(residuals: Residuals, styles: Sequence[ModelStyle]) -> FigureGrid | None:
    """The time by which reference poses seem to be taken earlier than their stamps say."""
    paths = residuals.paths
    # Velocities (S, 3) of the poses at the paths' stamps, over 100 ms, m/s and rad/s
    found = []
    for log, path in zip(paths.logs, paths.ends, strict=True):
        times = np.concatenate([[0.0], log.times])
        late, early = (interpolated(log.stamps + shift, times, path) for shift in (0.05, -0.05))
        found.append((late - early) / 0.1)
    velocity = np.concatenate(found)
    if np.abs(velocity).max() < 1e-6:
        return None
    stamp_numbers = residuals.stamp_numbers
    width = max(1, math.ceil((int(stamp_numbers.max()) + 1) / _STAMPS))
    bins = (stamp_numbers // width)[:, None] == np.arange(int(stamp_numbers.max()) // width + 1)
    bins = bins[:, bins.mean(axis=0) > 1e-3]
    x = np.array([paths.stamps[chosen].mean() for chosen in bins.T])
    panels = []
    for name, part in (("pose", [1.0, 1.0, 1.0]), ("heading alone", [0.0, 0.0, 1.0])):
        title = f"Delay of the reference's {name}, over the stamps of a run"
        panel = Panel(title, x, (), "stamp (s)", "apparent delay (ms)", "ms")
        columns = -(velocity * part)[:, :, None] * bins[:, None, :]
        panels += fitted_panels(residuals, styles, [(columns, 1e3, panel)])
    panels.append(
        Panel(
            "Delay of the reference's pose, run by run",
            np.arange(1.0, len(residuals.runs) + 1),
            fitted_curves(residuals.fit_runs(-velocity[:, :, None]), styles, 1e3),
            "run, in the order driven",
            "apparent delay (ms)",
            "ms",
            lines=False,
            words=tuple(run.id for run in residuals.runs),
        )
    )
    return grid(
        panels,
        styles,
        "By how much earlier than its stamp a pose would have to be taken to explain the residuals best.",
    )


def _turning(run: Trajectory) -> str:
    """The side to which a run turns, by its reference poses."""
    turned = run.poses[-1, 2] - run.poses[0, 2]
    if abs(turned) < max(_TURNING * float(run.pose_times[-1]), math.radians(3.0)):
        return "Runs that do not turn"
    return "Runs that turn left" if turned > 0 else "Runs that turn right"


def _times(runs: Sequence[Trajectory]) -> Array:
    """Times until which at least half of the runs last."""
    end = float(np.median([run.pose_times[-1] for run in runs]))
    first = float(np.median([run.pose_times[1] for run in runs]))
    return np.linspace(min(first, end), end, _TIMES)


def _running(residuals: Residuals, members: Sequence[int], times: Array) -> Array:
    """The number of runs that have poses up to each time, at least 1."""
    ends = np.array([residuals.runs[index].pose_times[-1] for index in members])
    return np.maximum((ends[:, None] >= times - 1e-6).sum(axis=0), 1)


def _means(residuals: Residuals, members: Sequence[int], style: ModelStyle, times: Array) -> Array:
    """Mean residuals (T, 3) along the path, across it and of the heading, at the stamps nearest to each time."""
    total = np.zeros((len(times), 3))
    for index in members:
        run = residuals.runs[index]
        stamps = run.pose_times[1:]
        own = residuals.each[style.index][index]
        turned = np.column_stack([rotated(own, -_courses(run)), own[:, 2]])
        nearest = np.abs(stamps[:, None] - times).argmin(axis=0)
        total += np.where((stamps[-1] >= times - 1e-6)[:, None], turned[nearest], 0.0)
    return total / _running(residuals, members, times)[:, None]


def _courses(run: Trajectory) -> Array:
    """Direction of travel (K,) at the stamps after the start, rad; the heading while the robot stays in its place."""
    times, poses = run.pose_times, run.poses
    window = max(1, round(0.5 / max(float(np.median(np.diff(times))), 1e-6)))
    low = np.maximum(np.arange(1, len(times)) - window, 0)
    high = np.minimum(np.arange(1, len(times)) + window, len(times) - 1)
    moved = poses[high, :2] - poses[low, :2]
    speed = np.hypot(moved[:, 0], moved[:, 1]) / (times[high] - times[low])
    usual = float(np.median(speed))
    if usual < _MOVING:
        return poses[1:, 2]
    course = np.arctan2(moved[:, 1], moved[:, 0])
    return np.where(speed > 0.3 * usual, course, poses[1:, 2])


def _blocks(runs: Sequence[Trajectory]) -> list[range]:
    """Blocks of successive runs, each within one session."""
    sessions: list[range] = []
    for index, run in enumerate(runs):
        if sessions and runs[sessions[-1].start].session == run.session:
            sessions[-1] = range(sessions[-1].start, index + 1)
        else:
            sessions.append(range(index, index + 1))
    size = max(_RUNS, math.ceil(len(runs) / _BLOCKS))
    blocks = []
    for session in sessions:
        count = max(1, round(len(session) / size))
        edges = np.linspace(session.start, session.stop, count + 1).round().astype(int)
        blocks += [range(int(low), int(high)) for low, high in pairwise(edges)]
    return blocks


def _block_in_words(runs: Sequence[Trajectory]) -> str:
    times = [run.started_at for run in runs if run.started_at is not None]
    session = f"session {runs[0].session}, " if runs[0].session else ""
    if not times:
        return f"{session}{plural(len(runs), 'run')}:"
    return f"{session}{fixed(min(times) / 60, 1)} to {fixed(max(times) / 60, 1)} min:"


# Figures over each covariate: a figure that is added here is shown.
FIGURES: Mapping[str, tuple[CovariateFigure, ...]] = {
    "elapsed time": (elapsed_grid,),
    "order of runs": (order_grid,),
    "stamps": (stamps_grid,),
}
