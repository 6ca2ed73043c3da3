"""Checks of one run: what reading a data set refuses with its row, and ``make_dataset`` with its trajectory."""

from __future__ import annotations

import numpy as np

from omnibench.data.delimited import not_increasing
from omnibench.errors import DataError
from omnibench.robot.calibration import SAMPLE_PERIODS
from omnibench.robot.kinematics import Array, Robot

Flaw = tuple[int, str]
"""Row (0 is the first) of an array, and what is wrong there."""

LARGEST = 1e9  # a larger number is no measurement in SI units
# The farthest pose from a run's start as a multiple of the wheels' travel and a metre; chosen: poses in mm, of which a
# warning tells, are a thousand times too far.
_FARTHEST = 1e4
# A sample period is refused when it is this many times longer or shorter than the median of the stamps; chosen: one in
# ms in the place of s is just within, and warned of.
_MOST_PERIODS = 1001.0


def wheel_times_flaw(times: Array, _: str) -> Flaw | None:
    """The flaw in the ends of a run's wheel samples (F,), s; None if there is none."""
    for row in np.flatnonzero(times <= 0)[:1]:
        return int(row), f"t is {times[row]:g}; wheel samples start after t = 0 (a row holds the rate up to its t)"
    return _increase_flaw(times)


def pose_times_flaw(times: Array, run: str) -> Flaw | None:
    """The flaw in the times of a run's reference poses (K,), s; None if there is none. run: its id."""
    for row in np.flatnonzero(times < 0)[:1]:
        return int(row), f"t is {times[row]:g}; it must not be negative"
    if (flaw := _increase_flaw(times)) is not None:
        return flaw
    if times[0] != 0:
        return 0, f"trajectory {run} has no reference pose at t = 0, its start pose"
    return None


def stored_pose_times_flaw(times: Array, run: str) -> Flaw | None:
    """As ``pose_times_flaw``; on disk a run has a pose after its start, too, or nothing could be learnt from it."""
    if (flaw := pose_times_flaw(times, run)) is not None:
        return flaw
    return None if len(times) > 1 else (0, f"trajectory {run} has no reference pose after its start")


def values_flaw(values: Array) -> Flaw | None:
    """The first row of values (rows, ...) with one that is not finite or that no robot can reach; None if all are."""
    rows = values.reshape(len(values), -1)
    for row in np.flatnonzero(~np.isfinite(rows).all(axis=1))[:1]:
        return int(row), f"it holds {rows[row][~np.isfinite(rows[row])][0]}; remove or repair the row"
    for row in np.flatnonzero((np.abs(rows) > LARGEST).any(axis=1))[:1]:
        return int(row), f"it holds {np.abs(rows[row]).max():g}, which no robot can reach; check the units"
    return None


def reach_flaw(robot: Robot, times: Array, rates: Array, pose_times: Array, poses: Array) -> Flaw | None:
    """A pose that lies farther from the start than a run's wheels can have rolled, by orders of magnitude.

    times (F,), pose_times (K,): s. rates (F, N): rad/s. poses (K, 3): m, m, rad.
    """
    travel = float((np.abs(rates) * robot.radii).max(axis=1) @ np.diff(times, prepend=0.0))  # m, of the fastest wheel
    distances = np.linalg.norm(poses[:, :2] - poses[0, :2], axis=1)
    for row in np.flatnonzero(distances > _FARTHEST * (travel + 1.0))[:1]:
        x, y = poses[row, :2]
        return int(row), (
            f"the pose at {pose_times[row]:g} s, x {x:g} and y {y:g}, is {distances[row]:.3g} m from the "
            f"run's start, whose wheels rolled {travel:.3g} m; remove or repair it"
        )
    return None


def check_sample_period(place: str, sample_period: float, median: float) -> None:
    """DataError: a nominal sample period, s, cannot be meant, as the wheel samples come every ``median`` s."""
    if not median / _MOST_PERIODS < sample_period < median * _MOST_PERIODS:
        raise DataError(
            f"{place}: sample_period is {sample_period:g} s, but the wheel samples come every {median:g} s (the "
            f"median); set it to {median:.3g}"
        )
    shortest, longest = SAMPLE_PERIODS
    if not shortest <= sample_period <= longest:
        raise DataError(
            f"{place}: sample_period is {sample_period:g} s, expected {shortest:g} to {longest:g} s; "
            "check the units of the times"
        )


def _increase_flaw(times: Array) -> Flaw | None:
    flaw = not_increasing(times)
    return None if flaw is None else (flaw[0], f"t {flaw[1]}")
