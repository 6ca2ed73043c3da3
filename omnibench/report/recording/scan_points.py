"""Scan points of a run in the frame of its reference poses, and the legend that figures of a recording share."""

from __future__ import annotations

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.data.scans import Scanner, TrajectoryScans
from omnibench.report.blocks import LegendItem
from omnibench.report.style import INK, PALETTE, REFERENCE, THEORETICAL
from omnibench.robot.kinematics import Array, compose, interpolated

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
