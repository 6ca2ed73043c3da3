"""Bringing wheel samples and reference poses of one recording to a common t = 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array

TURN = 2 * np.pi  # rad
_SAME_TIME = 1e-6  # s; unix time in a double has steps of 0.2 us


@dataclass(frozen=True, eq=False)
class Alignment:
    """Wheel samples and poses from a common t = 0 on.

    zero: time of the recording that becomes t = 0, s. kept (F,): True for wheel samples after it. pose_times (K,) and
    poses (K, 3) start with the pose at t = 0 and end with the wheels.
    """

    zero: float
    kept: NDArray[np.bool_]
    pose_times: Array
    poses: Array


def align(begin: float, wheel_times: Array, pose_times: Array, poses: Array) -> Alignment | None:
    """Set t = 0 of a recording to the first instant with both wheels and poses; None when they do not overlap.

    begin: when the first wheel sample began, s. wheel_times (F,): when each ended, s. All times by one clock, in any
    epoch. t = 0 is the first pose after ``begin``, or ``begin`` itself where poses reach back before it: the start
    pose is then interpolated (heading the shortest way). The sample during which t = 0 falls keeps its mean rate.
    Poses after the last wheel sample are left out, since no odometry predicts them.
    """
    zero = float(pose_times[0])
    if zero < begin - _SAME_TIME:
        zero = begin
    if zero >= min(wheel_times[-1], pose_times[-1]):
        return None
    shown = (pose_times > zero + _SAME_TIME) & (pose_times <= wheel_times[-1] + _SAME_TIME)
    kept = wheel_times > zero + _SAME_TIME
    if not shown.any() or not kept.any():
        return None
    start = _pose_at(zero, pose_times, poses)
    return Alignment(
        zero,
        kept,
        np.concatenate([[0.0], pose_times[shown] - zero]),
        np.vstack([start, poses[shown]]),
    )


def median_period(times: Sequence[Array]) -> float:
    """The median time between samples of several recordings, to the microsecond, s."""
    steps = [np.diff(recording) for recording in times if len(recording) > 1]
    typical = float(np.median(np.concatenate(steps))) if steps else float(times[0][0])
    return round(typical, 6) or typical


def _pose_at(time: float, times: Array, poses: Array) -> Array:
    after = int(np.searchsorted(times, time))
    if after < len(times) and abs(times[after] - time) <= _SAME_TIME:
        exact: Array = poses[after]
        return exact
    share = (time - times[after - 1]) / (times[after] - times[after - 1])
    step = poses[after] - poses[after - 1]
    step[2] -= TURN * np.round(step[2] / TURN)
    between: Array = poses[after - 1] + share * step
    return between
