"""Jumps of a reference: lone poses that are elsewhere, and shifts after which it goes on apart.

Motion capture that takes one marker for another turns or shifts single poses; a SLAM that closes a loop moves its poses
at once, and for good. Between two poses the odometry of the design tells the motion, up to a share of the way. Poses
that agree make a track, of which the longest is the robot's; others are alone, and where the track goes on elsewhere
the reference has shifted.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, Robot, relative, wrapped
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

# A step is a jump if it differs from the odometry's by more than this, m and rad, and by more than the share of the
# way; chosen: above the scatter of motion capture and of matched scans, and the errors of a design.
_LEAST, _SHARE = np.array([0.05, 0.1]), 0.5
# It differs by so many standard deviations of the usual scatter; chosen. That is told by a quantile of the deviations,
# as by their median (Hampel 1974), but by one that 60 % of the steps cannot spoil, since each lone pose spoils two; its
# factor is 1 / 0.524, the quantile's of a normal deviation. Of fewer poses it cannot be said what is usual.
_DEVIATIONS, _QUANTILE, _PER_QUANTILE, _FEWEST = 6.0, 0.4, 1.91, 20
_MOST_AWAY = 8  # poses that a reference may be elsewhere before it counts as shifted; chosen


@dataclass(frozen=True, eq=False)
class Jumps:
    """Jumps of a reference. lone: poses that are elsewhere. shifts: of poses after which it goes on apart."""

    lone: NDArray[np.intp]
    shifts: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.lone) + len(self.shifts)


def reference_jumps(robot: Robot, log: WheelLog, poses: Array) -> Jumps:
    """The jumps of reference poses (K, 3), m, m, rad, at the stamps of a log of the wheels."""
    none = np.empty(0, dtype=np.intp)
    if len(poses) <= _FEWEST:
        return Jumps(none, none)
    (odometry,) = OdometryModel.of_design(robot, "arc").poses([log])
    # The odometry of coarse counters is late by up to a tick of every wheel.
    angles = np.abs(log.signals) * np.diff(log.times, prepend=0.0)[:, None]
    ticks = np.where(angles > 1e-9 * angles.max(axis=0, initial=0.0), angles, np.inf).min(axis=0, initial=np.inf)
    x, y, turn = np.abs(robot.inverse_kinematic_matrix) @ np.where(np.isfinite(ticks), ticks, 0.0)
    least = _LEAST + np.array([np.hypot(x, y), turn])
    steps = np.arange(len(poses) - 1)
    usual = _PER_QUANTILE * np.quantile(_misfits(odometry, poses, steps, steps + 1), _QUANTILE, axis=0)

    def agree(first: NDArray[np.intp], last: NDArray[np.intp]) -> NDArray[np.bool_]:
        driven = np.abs(relative(odometry[first], odometry[last]))
        way = np.hypot(driven[:, 0], driven[:, 1]) + robot.reach * driven[:, 2]
        allowed = least + _SHARE * np.column_stack([way, driven[:, 2]])
        within = _misfits(odometry, poses, first, last) <= np.maximum(allowed, _DEVIATIONS * usual)
        return np.asarray(within.all(axis=1))

    if agree(steps, steps + 1).all():
        return Jumps(none, none)

    # The longest track of poses that agree, each with the one before; it goes on elsewhere at the price of some poses.
    near = [agree(np.arange(len(poses) - lag), np.arange(lag, len(poses))).tolist() for lag in range(1, _MOST_AWAY + 2)]
    scores, before, longest = list[int](), list[int](), -1  # of the longest track that ends with each pose
    for pose in range(len(poses)):
        lags = [lag for lag, agrees in enumerate(near[:pose], 1) if agrees[pose - lag]]
        score, previous = max(((scores[pose - lag], pose - lag) for lag in lags), default=(0, -1))
        if longest >= 0 and scores[longest] - _MOST_AWAY > score:
            score, previous = scores[longest] - _MOST_AWAY, longest
        scores.append(score + 1)
        before.append(previous)
        longest = pose if longest < 0 or scores[pose] > scores[longest] else longest
    track = [longest]
    while before[track[-1]] >= 0:
        track.append(before[track[-1]])
    track.reverse()
    apart = [first for first, last in pairwise(track) if last - first > len(near) or not near[last - first - 1][first]]
    return Jumps(np.setdiff1d(np.arange(len(poses)), track), np.array(apart, dtype=np.intp))


def _misfits(odometry: Array, poses: Array, first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
    """By how much (n, 2), m and rad, the motions between poses differ from the odometry's."""
    off = relative(poses[first], poses[last]) - relative(odometry[first], odometry[last])
    misfits: Array = np.column_stack([np.hypot(off[:, 0], off[:, 1]), np.abs(wrapped(off[:, 2]))])
    return misfits
