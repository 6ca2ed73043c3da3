"""The document that templates/player.js plays: poses, wheel rates and scans of a run, rounded."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.true_poses import TruePath
from omnibench.report.blocks import LegendItem, Player
from omnibench.report.figures import is_placed
from omnibench.report.numbers import listing
from omnibench.report.recording.recording_figures import (
    ODOMETRY_ITEM,
    PLAN_ITEM,
    REFERENCE_ITEM,
    SCANS,
    SCANS_ITEM,
    TRUTH_ITEM,
    evenly,
    poses_at,
    scan_points,
)
from omnibench.report.style import INK
from omnibench.robot.kinematics import Array, Robot, compose, interpolated, placed
from omnibench.robot.model import OdometryModel

_FRAMES = 240  # frames drawn of a run (chosen: steps of the slider that can be told apart)
_MEAN_OVER = 0.1  # s; wheel rates are means over this time before each frame
_SCANS = 60  # scans drawn of a run (chosen: keeps the file small)
_RAYS = 270  # rays drawn of a scan (chosen: keeps the file small)
_MARGIN = 0.4  # m around everything that is drawn
_SEEN = LegendItem("scan", "this moment's scan", "#d97706")


def player(
    dataset: Dataset,
    runs: Mapping[str, Trajectory],
    odometry: OdometryModel,
    truth: Mapping[str, TruePath],
    outlines: Mapping[str, Sequence[Array]],
) -> Player:
    """A player for these runs, chosen by the menu's names and moved through with a slider.

    outlines: for each run the walls of the floor plan in the frame of its reference poses, each (n, 2), m.
    """
    shown = ["the robot"]
    shown += ["its last scan, and what it saw before"] if dataset.scans is not None else []
    shown += ["the path so far and its wheel rates"]
    return Player(
        {name: _run(dataset, run, odometry, truth.get(run.id), outlines.get(run.id, ())) for name, run in runs.items()},
        f"A plan of the room with {listing(shown)}, at the time that the slider names",
        "Between reference poses the robot is drawn on a straight line; wheel rates are means over the 100 ms before. "
        "With the slider in focus the arrow keys go step by step.",
    )


def _run(
    dataset: Dataset, run: Trajectory, odometry: OdometryModel, truth: TruePath | None, outlines: Sequence[Array]
) -> dict[str, Any]:
    end = run.end
    times = np.linspace(0.0, end, min(_FRAMES, max(2, round(end / 0.02) + 1)))
    poses = poses_at(run, times)
    (driven,) = odometry.poses([run.log(times)])
    true_poses = None if truth is None else placed(run.start, truth.at(times))
    scans = _scans(dataset, run)
    rates = _means(run, run.rates, times)
    targets = None if run.targets is None else _means(run, run.targets, times)
    everything = [rates] if targets is None else [rates, targets]
    drawn = [poses[:, :2], driven[:, :2], *outlines, *(np.reshape(scan["points"], (-1, 2)) for scan in scans)]
    # Left, bottom, right and top of the picture, m; the farthest 0.5 % of the points on each side are cut off
    points = np.vstack(drawn)
    low, high = np.quantile(points, 0.005, axis=0) - _MARGIN, np.quantile(points, 0.995, axis=0) + _MARGIN
    return {
        "times": _rounded(times),
        "poses": _rounded(poses, 4),
        "odometry": _rounded(driven[:, :2]),
        "truth": None if true_poses is None else _rounded(true_poses),
        "rates": _rounded(rates),
        "targets": None if targets is None else _rounded(targets),
        "rate_limit": round(1.05 * max(float(np.abs(np.vstack(everything)).max()), 1e-3), 3),
        "scans": scans,
        "plan": [_rounded(outline) for outline in outlines],
        "window": _rounded(np.concatenate([low, high])),
        "rated": dataset.robot.wheel_names,
        "steering": None if run.steering is None else _rounded(interpolated(times, run.times, run.steering)),
        "wheels": _wheels(dataset.robot),
        "radius": max(math.hypot(wheel.reach, wheel.radius) for wheel in dataset.robot.wheels),
        "colours": {
            "reference": REFERENCE_ITEM.colour,
            "odometry": ODOMETRY_ITEM.colour,
            "truth": TRUTH_ITEM.colour,
            "plan": PLAN_ITEM.colour,
            "map": SCANS + "66",
            "scan": _SEEN.colour,
            "ray": _SEEN.colour + "44",
            "whole": REFERENCE_ITEM.colour + "55",
            "robot": INK,
        },
        "key": _key(bool(scans), truth is not None, bool(outlines)),
    }


def _scans(dataset: Dataset, run: Trajectory) -> list[dict[str, Any]]:
    """Some scans of a run: stamp, scanner position, and points as x, y, x, y, ..., m."""
    if dataset.scans is None or run.id not in dataset.scans.trajectories:
        return []
    scanner, scans = dataset.scans.scanner, dataset.scans.of(run.id)
    stride = -(-scanner.rays // _RAYS)
    documents = []
    for scan in evenly(len(scans.times), _SCANS):
        stamp = scans.times[scan]
        origin = compose(poses_at(run, stamp), scanner.mount.pose)
        points = scan_points(run, scanner, scans, int(scan), stride)
        documents.append(
            {"t": round(float(stamp), 4), "from": _rounded(origin[:2]), "points": _rounded(points.ravel())}
        )
    return documents


def _means(run: Trajectory, values: Array, times: Array) -> Array:
    """Mean rates (n, N) over the 0.1 s before each of ``times`` (n,), s; values (F, N): the rate of each sample."""
    ends = np.append(0.0, run.times)
    durations = np.diff(ends)[:, None]
    angles = np.vstack([np.zeros(values.shape[1]), np.cumsum(values * durations, axis=0)])
    late = np.clip(times, _MEAN_OVER / 2, ends[-1])
    early = np.maximum(late - _MEAN_OVER, 0.0)
    driven = interpolated(late, ends, angles) - interpolated(early, ends, angles)
    means: Array = driven / (late - early)[:, None]
    return means


def _wheels(robot: Robot) -> list[dict[str, Any]]:
    """The wheels that are drawn: radius and place, m, direction of rolling, rad, index of the angle that steers it."""
    steered = robot.drive.steered
    return [
        {
            "radius": wheel.radius,
            "at": _rounded(np.array(wheel.position), 6),
            "rolling": wheel.rolling,
            "steered": steered.index(wheel.name) if wheel.has_steering else None,
        }
        for wheel in robot.wheels
        if is_placed(wheel)
    ]


def _key(scans: bool, truth: bool, plan: bool) -> list[dict[str, Any]]:
    items = [REFERENCE_ITEM, ODOMETRY_ITEM] + [TRUTH_ITEM] * truth + [PLAN_ITEM] * plan
    points = [_SEEN, LegendItem("map", "earlier scans", SCANS_ITEM.colour)] * scans
    entries: list[dict[str, Any]] = [{"label": item.label, "colour": item.colour, "points": False} for item in items]
    return entries + [{"label": item.label, "colour": item.colour, "points": True} for item in points]


def _rounded(values: Array, decimals: int = 3) -> Any:
    return np.round(values, decimals).tolist()
