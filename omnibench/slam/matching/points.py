"""A scan as points and lines in the robot's frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.scans import Ranges, Scanner
from omnibench.robot.kinematics import Array, rotated
from omnibench.slam.matching.lines import Lines, fit_lines
from omnibench.slam.motion_within_scan import MotionWithinScan


@dataclass(frozen=True, eq=False)
class ScanPoints:
    """Points and lines of a deskewed scan, in the robot's frame at the scan's stamp.

    points (n, 2): m. rays (n, 2): unit vectors from the scanner to the points. delays (n,): since the scan's stamp, s.
    deviations (n,): standard deviations of the ranges, m. lines: fitted to neighbouring points. line (n,): index of the
    line that a point is part of, or -1.
    """

    points: Array
    rays: Array
    delays: Array
    deviations: Array
    lines: Lines
    line: NDArray[np.int_]

    def deskewed(self, twist: Array) -> ScanPoints:
        """The scan, deskewed by a further twist (3,) in the robot's frame, m/s, m/s, rad/s."""
        motions, line_motions = self.delays[:, None] * twist, self.lines.delays[:, None] * twist
        lines = replace(
            self.lines,
            centres=_moved(self.lines.centres, line_motions),
            normals=rotated(self.lines.normals, line_motions[:, 2]),
        )
        return replace(self, points=_moved(self.points, motions), rays=rotated(self.rays, motions[:, 2]), lines=lines)


def scan_points(ranges: Ranges, scanner: Scanner, noise_factor: float, within: MotionWithinScan) -> ScanPoints:
    """Points and lines of a scan (R,), over the floor; rays of a tilted scanner that end on the floor are left out.

    noise_factor: ratio of the ranges' noise to that of the scanner's description. within: motion during the scan.
    """
    returned = np.flatnonzero(scanner.valid(ranges) & ~scanner.on_floor(ranges))
    shares, delays = scanner.level_shares[returned], scanner.delays[returned]
    distances = ranges[returned].astype(float) * shares
    deviations = noise_factor * scanner.deviations(ranges[returned]) * shares
    angles = scanner.bearings[returned]
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    mount = np.array([scanner.mount.x, scanner.mount.y])
    motions = within.at(delays)
    points = _moved(mount + distances[:, None] * directions, motions)
    lines, line = fit_lines(points - mount, deviations, delays, returned)
    lines = replace(lines, centres=lines.centres + mount)
    return ScanPoints(points, rotated(directions, motions[:, 2]), delays, deviations, lines, line)


def noise_factor(ranges: Ranges, scanner: Scanner) -> float:
    """Ratio, at least 1, of the noise of ranges (S, R) to that of the scanner's description.

    Estimated by the median of second differences of neighbouring ranges, which are noise nearly everywhere but at
    edges.
    """
    with np.errstate(invalid="ignore"):
        second_differences = ranges[:, 2:] - 2.0 * ranges[:, 1:-1] + ranges[:, :-2]
    valid = scanner.valid(ranges)
    whole = valid[:, 2:] & valid[:, 1:-1] & valid[:, :-2]
    if not whole.any():
        return 1.0
    expected = np.sqrt(6) * scanner.deviations(ranges[:, 1:-1][whole])
    return max(1.0, float(np.median(np.abs(second_differences[whole]) / expected)) / 0.6745)


def _moved(points: Array, motions: Array) -> Array:
    """Points (n, 2) that were seen after motions (n, 3), in the frame from before the motions."""
    half = motions[:, 2] / 2
    return rotated(points, motions[:, 2]) + np.sinc(half / np.pi)[:, None] * rotated(motions[:, :2], half)
