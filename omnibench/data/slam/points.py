"""A scan as points in the robot's frame, at rest or on its way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.scans import Ranges, Scanner
from omnibench.data.slam.lines import Lines, fit_lines, turned
from omnibench.robot.kinematics import Array


@dataclass(frozen=True, eq=False)
class ScanPoints:
    """What a scan saw, each point in the frame of the robot as it stood when the point was measured.

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
        """The scan as it would look from where the robot was at the scan's stamp.

        twist (3,): of the robot during the scan, in its frame, m/s, m/s, rad/s.
        """
        points, rays = _moved(self.points, self.delays, twist), turned(self.rays, self.delays * twist[2])
        lines = self.lines
        centres, normals = _moved(lines.centres, lines.delays, twist), turned(lines.normals, lines.delays * twist[2])
        return replace(self, points=points, rays=rays, lines=replace(lines, centres=centres, normals=normals))


def scan_points(ranges: Ranges, scanner: Scanner, noise_factor: float, twist: Array) -> ScanPoints:
    """Points and lines of a scan (R,).

    noise_factor: by which ranges are noisier than the scanner says. twist (3,): of the robot, roughly, m/s, m/s, rad/s.
    """
    valid: NDArray[np.bool_] = scanner.valid(ranges)
    distances = np.where(valid, ranges, 1.0).astype(float)
    deviations = noise_factor * scanner.deviations(distances)
    mount = scanner.mount
    of_scanner = twist[:2] + twist[2] * np.array([-mount.y, mount.x])
    lines, part_of = fit_lines(distances, valid, deviations, scanner, turned(of_scanner[None], -mount.yaw)[0])
    angles = scanner.angles[valid] + mount.yaw
    rays = np.column_stack([np.cos(angles), np.sin(angles)])
    offset = np.array([mount.x, mount.y])
    return ScanPoints(
        offset + distances[valid, None] * rays,
        rays,
        scanner.delays[valid],
        deviations[valid],
        replace(
            lines,
            centres=offset + turned(lines.centres, mount.yaw),
            normals=turned(lines.normals, mount.yaw),
        ),
        part_of[valid],
    )


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


def _moved(points: Array, delays: Array, twist: Array) -> Array:
    """Points (n, 2) seen ``delays`` (n,) s on the way with a constant twist, as seen from its beginning."""
    angles = delays * twist[2]
    half = angles / 2
    way = (delays * np.sinc(half / np.pi))[:, None] * turned(np.broadcast_to(twist[:2], points.shape), half)
    return turned(points, angles) + way
