"""Jumps of a reference: lone poses that are elsewhere, and shifts after which it goes on apart.

Motion capture that takes one marker for another turns or shifts single poses; a SLAM that closes a loop moves its poses
at once, and for good. Between two poses the odometry of the design tells the motion, up to a share of the way. A pose
jumps if it does not agree with the last good one; it is alone if one of the next poses does, and else the reference has
shifted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, Robot, relative, wrapped

# A step is a jump if it differs from the odometry's by more than this, m and rad, and by more than the share of the
# way; chosen: above the scatter of motion capture and of matched scans, and the errors of a design.
_LEAST, _SHARE = np.array([0.05, 0.1]), 0.5
# It differs by so many standard deviations of the usual scatter, by the median absolute deviation (Hampel 1974), which
# up to half of the steps cannot spoil; chosen. Of fewer poses it cannot be said what is usual.
_DEVIATIONS, _FEWEST = 6.0, 20
_MOST_AWAY = 8  # poses that a reference may be elsewhere before it counts as shifted; chosen


@dataclass(frozen=True, eq=False)
class Jumps:
    """Jumps of a reference. lone: poses that are elsewhere. shifts: of poses after which it goes on apart."""

    lone: NDArray[np.intp]
    shifts: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.lone) + len(self.shifts)


def reference_jumps(robot: Robot, odometry: Array, poses: Array) -> Jumps:
    """The jumps of reference poses (K, 3), m, m, rad. odometry (K, 3): of the design at their times."""
    none = np.empty(0, dtype=np.intp)
    if len(poses) <= _FEWEST:
        return Jumps(none, none)
    steps = np.arange(len(poses) - 1)
    usual = np.median(_misfits(odometry, poses, steps, steps + 1), axis=0)

    def agree(first: NDArray[np.intp], last: NDArray[np.intp]) -> NDArray[np.bool_]:
        driven = np.abs(relative(odometry[first], odometry[last]))
        way = np.hypot(driven[:, 0], driven[:, 1]) + robot.reach * driven[:, 2]
        allowed = _LEAST + _SHARE * np.column_stack([way, driven[:, 2]])
        within = _misfits(odometry, poses, first, last) <= np.maximum(allowed, _DEVIATIONS * 1.4826 * usual)
        return np.asarray(within.all(axis=1))

    if agree(steps, steps + 1).all():
        return Jumps(none, none)

    def fitting(first: int, begin: int, count: int) -> NDArray[np.bool_]:
        others = np.arange(begin, min(begin + count, len(poses)))
        return agree(np.full(len(others), first), others)

    # The first pose with which most of the next ones agree.
    begins = (first for first in range(_MOST_AWAY) if fitting(first, first + 1, _MOST_AWAY).mean() > 0.5)
    good = next(begins, 0)
    lone, shifts = list(range(good)), list[int]()
    while good < len(poses) - 1:
        near = np.flatnonzero(fitting(good, good + 1, _MOST_AWAY + 1))
        if len(near):
            lone += range(good + 1, good + 1 + int(near[0]))
            good += 1 + int(near[0])
            continue
        # It goes on from the first of the next poses with which others agree.
        ahead = range(good + 1, min(good + 2 + _MOST_AWAY, len(poses)))
        begun = next((first for first in ahead if fitting(first, first + 1, 3).any()), None)
        if begun is None:
            lone += ahead
            break
        lone += range(good + 1, begun)
        shifts.append(good)
        good = begun
    return Jumps(np.array(lone, dtype=np.intp), np.array(shifts, dtype=np.intp))


def _misfits(odometry: Array, poses: Array, first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
    """By how much (n, 2), m and rad, the motions between poses differ from the odometry's."""
    off = relative(poses[first], poses[last]) - relative(odometry[first], odometry[last])
    misfits: Array = np.column_stack([np.hypot(off[:, 0], off[:, 1]), np.abs(wrapped(off[:, 2]))])
    return misfits
