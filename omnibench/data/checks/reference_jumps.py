"""Jumps of a reference: steps from pose to pose that neither the wheels nor its usual scatter explain.

A SLAM that closes a loop moves its poses at once, and motion capture that takes one marker for another turns or shifts
them. The odometry of the design model is wrong by a share of each step, in every step alike; a jump stands out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, Robot, relative, wrapped

# A step is a jump if it differs from the odometry's by more than this, m and rad, and by more than the share of the
# way; chosen: above the scatter of motion capture and of matched scans, and the errors of a design.
_LEAST, _SHARE = (0.05, 0.1), 0.5
# It differs by so many times more than nearly all steps do (chosen); of fewer steps it cannot be said what is usual.
_TIMES, _NEARLY_ALL, _FEWEST = 4.0, 0.95, 20


def reference_jumps(robot: Robot, odometry: Array, poses: Array) -> NDArray[np.intp]:
    """Indices of the poses (K, 3) after which the reference jumps to the next one. odometry (K, 3): of the design."""
    if len(poses) <= _FEWEST:
        return np.empty(0, dtype=np.intp)
    driven, seen = relative(odometry[:-1], odometry[1:]), relative(poses[:-1], poses[1:])
    way = np.hypot(driven[:, 0], driven[:, 1]) + robot.reach * np.abs(driven[:, 2])
    position = np.hypot(*(seen - driven)[:, :2].T)
    heading = np.abs(wrapped((seen - driven)[:, 2]))
    jumps = np.zeros(len(position), dtype=bool)
    for steps, least, size in ((position, _LEAST[0], way), (heading, _LEAST[1], np.abs(driven[:, 2]))):
        usual = float(np.quantile(steps, _NEARLY_ALL))
        jumps |= steps > np.maximum(least + _SHARE * size, _TIMES * usual)
    return np.flatnonzero(jumps)
