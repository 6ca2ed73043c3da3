"""A scan as points and lines in the robot's frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.scans import Ranges, Scanner
from omnibench.data.slam.lines import Lines, fit_lines
from omnibench.robot.kinematics import Array


@dataclass(frozen=True, eq=False)
class ScanPoints:
    """What a scan saw, in the frame of the robot as it stood at the scan's stamp, if its motion within is known.

    points (n, 2), m. rays (n, 2): unit vectors from the scanner to the points. delays (n,): since the scan's stamp, s.
    deviations (n,): of the ranges, m. lines: fitted to neighbouring points. line (n,): which one a point is part of, or
    -1.
    """

    points: Array
    rays: Array
    delays: Array
    deviations: Array
    lines: Lines
    line: NDArray[np.int_]

    def deskewed(self, twist: Array) -> ScanPoints:
        """The scan if the robot moved with one more twist (3,) than it was taken to, in its frame, m/s, m/s, rad/s."""
        points, rays = _moved(self.points, self.delays, twist), _turned(self.rays, self.delays * twist[2])
        lines = self.lines
        centres, normals = _moved(lines.centres, lines.delays, twist), _turned(lines.normals, lines.delays * twist[2])
        return replace(self, points=points, rays=rays, lines=replace(lines, centres=centres, normals=normals))


def scan_points(ranges: Ranges, scanner: Scanner, noise_factor: float, twist: Array) -> ScanPoints:
    """Points and lines of a scan (R,).

    noise_factor: by which ranges are noisier than the scanner says. twist (3,): of the robot during the scan, in its
    frame, m/s, m/s, rad/s.
    """
    returned = np.flatnonzero(scanner.valid(ranges))
    distances, delays = ranges[returned].astype(float), scanner.delays[returned]
    deviations = noise_factor * scanner.deviations(distances)
    angles = scanner.angles[returned] + scanner.mount.yaw
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    mount = np.array([scanner.mount.x, scanner.mount.y])
    points = _moved(mount + distances[:, None] * directions, delays, twist)
    lines, line = fit_lines(points - mount, deviations, delays, returned)
    lines = replace(lines, centres=lines.centres + mount)
    return ScanPoints(points, _turned(directions, delays * twist[2]), delays, deviations, lines, line)


def noise_factor(ranges: Ranges, scanner: Scanner) -> float:
    """By which factor, at least 1, the ranges (S, R) of scans are noisier than the scanner says.

    Second differences of neighbouring ranges are noise nearly everywhere; their median does not see edges.
    """
    with np.errstate(invalid="ignore"):
        seconds = ranges[:, 2:] - 2.0 * ranges[:, 1:-1] + ranges[:, :-2]
    valid = scanner.valid(ranges)
    whole = valid[:, 2:] & valid[:, 1:-1] & valid[:, :-2]
    if not whole.any():
        return 1.0
    expected = np.sqrt(6) * scanner.deviations(ranges[:, 1:-1][whole])
    return max(1.0, float(np.median(np.abs(seconds[whole]) / expected)) / 0.6745)


def _turned(vectors: Array, angles: Array | float) -> Array:
    cosine, sine = np.cos(angles), np.sin(angles)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y])


def _moved(points: Array, delays: Array, twist: Array) -> Array:
    """Points (n, 2) seen ``delays`` (n,) s on the way with a constant twist, as seen from its beginning."""
    angles = delays * twist[2]
    half = angles / 2
    way = (delays * np.sinc(half / np.pi))[:, None] * _turned(np.broadcast_to(twist[:2], points.shape), half)
    return _turned(points, angles) + way
