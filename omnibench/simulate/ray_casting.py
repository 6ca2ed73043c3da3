"""The nearest wall along each ray of a moving scanner, compiled."""

from __future__ import annotations

import math

import numpy as np

from omnibench.data.scans import Scanner
from omnibench.robot.compiled import compiled
from omnibench.robot.kinematics import Array


def cast_rays(segments: Array, scanner: Scanner, track_times: Array, track_poses: Array, times: Array) -> Array:
    """True distances (S, R) over the floor, m, from a moving scanner to the nearest wall along its rays; inf: none.

    segments (W, 4): x, y of both ends of each wall, m. track_poses (M, 3): the robot's poses at track_times
    (M,), interpolated linearly, constant outside. times (S,): times of the scans' first rays, s.
    """
    mount = scanner.mount
    return _cast(
        np.ascontiguousarray(segments, dtype=float),
        np.ascontiguousarray(track_times, dtype=float),
        np.ascontiguousarray(track_poses, dtype=float),
        np.ascontiguousarray(times, dtype=float),
        scanner.delays,
        scanner.bearings,
        float(mount.x),
        float(mount.y),
    )


@compiled
def _cast(
    segments: Array,
    track_times: Array,
    track_poses: Array,
    times: Array,
    delays: Array,
    angles: Array,
    mount_x: float,
    mount_y: float,
) -> Array:
    distances = np.empty((len(times), len(angles)))
    for scan in range(len(times)):
        after = np.searchsorted(track_times, times[scan])
        for ray in range(len(angles)):
            time = times[scan] + delays[ray]
            while after < len(track_times) and track_times[after] < time:
                after += 1
            x, y, heading = _pose(track_times, track_poses, after, time)
            cosine, sine = math.cos(heading), math.sin(heading)
            x, y = x + cosine * mount_x - sine * mount_y, y + sine * mount_x + cosine * mount_y
            distances[scan, ray] = _nearest(
                segments, x, y, math.cos(heading + angles[ray]), math.sin(heading + angles[ray])
            )
    return distances


@compiled
def _pose(track_times: Array, track_poses: Array, after: int, time: float) -> tuple[float, float, float]:
    """The pose at a time. after: index of the first pose of the track that is not earlier."""
    before = max(after - 1, 0)
    after = min(after, len(track_times) - 1)
    share = (time - track_times[before]) / (track_times[after] - track_times[before]) if after > before else 0.0
    first, second = track_poses[before], track_poses[after]
    return (
        first[0] + share * (second[0] - first[0]),
        first[1] + share * (second[1] - first[1]),
        first[2] + share * (second[2] - first[2]),
    )


@compiled
def _nearest(segments: Array, x: float, y: float, along_x: float, along_y: float) -> float:
    """Distance from (x, y) to the nearest wall in a direction of length 1.

    A wall is hit if its ends are on either side of the ray. No ray slips through where two walls meet: for both, the
    corner is on the same side.
    """
    nearest = np.inf
    for wall in range(len(segments)):
        first_x, first_y = segments[wall, 0] - x, segments[wall, 1] - y
        second_x, second_y = segments[wall, 2] - x, segments[wall, 3] - y
        first_left = along_x * first_y - along_y * first_x
        second_left = along_x * second_y - along_y * second_x
        if (first_left < 0.0) != (second_left < 0.0):
            share = first_left / (first_left - second_left)
            first_ahead = along_x * first_x + along_y * first_y
            second_ahead = along_x * second_x + along_y * second_y
            distance = first_ahead + share * (second_ahead - first_ahead)
            if 0.0 <= distance < nearest:
                nearest = distance
    return nearest
