"""Line segments fitted to neighbouring points of a scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array

# rad: a line with a larger standard deviation of its direction is dropped. With half of it and with twice, SLAM's
# median error in three rooms is 1.15 and 1.03 mm in the place of 1.07 mm (tests/studies/constants_slam.py).
_TILT = 0.05


@dataclass(frozen=True, eq=False)
class Lines:
    """Line segments.

    centres (m, 2): m. normals (m, 2): unit vectors towards the scanner. half_lengths (m,): m. rays (m,): number of rays
    that were fitted. tilt_variances (m,): variances of the normals' directions, rad^2. delays (m,): times since the
    scan's stamp, s.
    """

    centres: Array
    normals: Array
    half_lengths: Array
    rays: NDArray[np.int_]
    tilt_variances: Array
    delays: Array


def fit_lines(
    points: Array, deviations: Array, delays: Array, rays: NDArray[np.intp]
) -> tuple[Lines, NDArray[np.int_]]:
    """Line segments, and for each point (n,) the index of the segment that it is part of, or -1.

    points (n, 2): from the scanner, m. deviations (n,): standard deviations of their ranges, m. delays (n,): since the
    scan's stamp, s. rays (n,): their numbers in the scan.
    """
    from omnibench.slam.line_growth import grow_lines  # numba takes half a second to load

    ranges = np.hypot(points[:, 0], points[:, 1])
    directions = points / ranges[:, None]
    part_of = np.empty(len(points), dtype=np.int64)
    cosines, sines = np.ascontiguousarray(directions.T)
    grown = grow_lines(ranges, cosines, sines, np.ascontiguousarray(deviations), rays.astype(np.int64), part_of)
    line, first, last = grown[:, :2], grown[:, 5].astype(int), grown[:, 6].astype(int)
    squared = (line**2).sum(axis=1)
    tilts = (
        line[:, 1] ** 2 * grown[:, 2] - 2 * line[:, 0] * line[:, 1] * grown[:, 3] + line[:, 0] ** 2 * grown[:, 4]
    ) / squared**2
    kept = np.flatnonzero(tilts < _TILT**2)
    ends = [directions[at] / (line * directions[at]).sum(axis=1)[:, None] for at in (first, last)]
    lines = Lines(
        centres=((ends[0] + ends[1]) / 2)[kept],
        normals=(-line / np.sqrt(squared)[:, None])[kept],
        half_lengths=np.linalg.norm(ends[1] - ends[0], axis=1)[kept] / 2,
        rays=np.bincount(part_of[part_of >= 0], minlength=len(line))[kept],
        tilt_variances=tilts[kept],
        delays=((delays[first] + delays[last]) / 2)[kept],
    )
    number = np.full(len(line) + 1, -1)  # the last one is for points that are part of no line
    number[kept] = np.arange(len(kept))
    return lines, number[part_of]
