"""A scan as points and lines in the robot's frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.scans import Ranges, Scanner
from omnibench.robot.kinematics import Array
from omnibench.slam.matching.lines import Lines, fit_lines
from omnibench.slam.motion_within_scan import MotionWithinScan


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
        motions, of_lines = self.delays[:, None] * twist, self.lines.delays[:, None] * twist
        lines = replace(
            self.lines,
            centres=_moved(self.lines.centres, of_lines),
            normals=_turned(self.lines.normals, of_lines[:, 2]),
        )
        return replace(self, points=_moved(self.points, motions), rays=_turned(self.rays, motions[:, 2]), lines=lines)


def scan_points(ranges: Ranges, scanner: Scanner, noise_factor: float, within: MotionWithinScan) -> ScanPoints:
    """Points and lines of a scan (R,).

    noise_factor: by which ranges are noisier than the scanner says. within: the robot's motion during the scan.
    """
    returned = np.flatnonzero(scanner.valid(ranges))
    distances, delays = ranges[returned].astype(float), scanner.delays[returned]
    deviations = noise_factor * scanner.deviations(distances)
    angles = scanner.angles[returned] + scanner.mount.yaw
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    mount = np.array([scanner.mount.x, scanner.mount.y])
    motions = within.at(delays)
    points = _moved(mount + distances[:, None] * directions, motions)
    lines, line = fit_lines(points - mount, deviations, delays, returned)
    lines = replace(lines, centres=lines.centres + mount)
    return ScanPoints(points, _turned(directions, motions[:, 2]), delays, deviations, lines, line)


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


def _moved(points: Array, motions: Array) -> Array:
    """Points (n, 2) seen after motions (n, 3), each the twist that makes it in unit time, as seen from before."""
    half = motions[:, 2] / 2
    return _turned(points, motions[:, 2]) + np.sinc(half / np.pi)[:, None] * _turned(motions[:, :2], half)
