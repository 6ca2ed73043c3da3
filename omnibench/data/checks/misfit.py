"""The misfit of the design model's odometry to the reference, also if the wheels were read otherwise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from omnibench.data.checks.misreading import Misreading, Reading
from omnibench.data.stored.drawn_runs import in_memory
from omnibench.robot.kinematics import Array, Robot, wrapped
from omnibench.robot.odometry import OdometryBatch, WheelLog

_MOST_TRAJECTORIES = 24  # trajectories checked, at most (chosen)
# Samples checked, at most, of which some are taken together, and stamps of each run (chosen: they keep a check of 24
# runs of two minutes below 20 ms, and are 0.2 and 0.4 s apart there).
_MOST_SAMPLES, _MOST_STAMPS = 12_000, 300

_TURN = 2 * math.pi  # rad
EXPLAINED = 0.35  # share of the misfit that may remain with an explanation (chosen)
_LEAST_TURN = 0.5  # rad, far more than references are noisy (chosen)


@dataclass(frozen=True)
class Explanation:
    """Mistakes of a recording, and the misfit that remains if it was read with them.

    unit: a unit is wrong. may_remain: share of the misfit that may remain.
    """

    mistakes: tuple[Misreading, ...]
    misfit: float
    unit: bool = False
    may_remain: float = EXPLAINED


@dataclass(frozen=True, eq=False)
class Recording:
    """Some runs, of which moments are compared: path since the start of the run, and turn since the moment before.

    design: its matrix (3, M). logs: from the origin on. poses: the reference (K, 3) at each log's stamps.
    """

    robot: Robot
    design: Array
    logs: Sequence[WheelLog]
    poses: Sequence[Array]

    @classmethod
    def of(cls, robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array]) -> Recording:
        """The recording of logs with reference poses (K, 3) at their stamps; of many, some from first to last."""
        some = _evenly(len(logs), _MOST_TRAJECTORIES)
        size = -(-sum(len(logs[index].times) for index in some) // _MOST_SAMPLES)
        seen = [_evenly(len(poses[index]), _MOST_STAMPS) for index in some]
        coarse = [
            replace(_coarser(in_memory(logs[index]), size), stamps=logs[index].stamps[stamps])
            for index, stamps in zip(some, seen, strict=True)
        ]
        return cls(
            robot,
            robot.inverse_kinematic_matrix,
            coarse,
            [poses[index][stamps] for index, stamps in zip(some, seen, strict=True)],
        )

    def read(self, reading: Reading) -> Recording:
        """The recording if its wheel rates and steering angles were read otherwise."""
        return replace(self, logs=[reading.of(log) for log in self.logs])

    @cached_property
    def misfit(self) -> float:
        """Misfit of the design matrix."""
        return float(self.misfits(self.design[None])[0])

    def misfits(self, matrices: Array, metre: float = 1.0, radian: float = 1.0) -> Array:
        """Misfit (P,) of matrices (P, 3, M) to the reference, from 0 (exact) to 1 (unrelated).

        metre, radian: units of the recorded positions, in m, and headings, in rad.
        """
        odometry = self._odometry.poses(matrices)
        moments, trajectory = self._moments, self._odometry.trajectory
        starts = np.array([pose[0] for pose in self.poses])[trajectory]
        seen = np.concatenate([pose[chosen] for pose, chosen in zip(self.poses, moments, strict=True)])
        moved = (seen - starts) * [metre, metre, radian]
        path = (moved[:, 0] + 1j * moved[:, 1]) * np.exp(-1j * radian * starts[:, 2])
        driven = odometry[..., 0] + 1j * odometry[..., 1]
        turned = self._turns(odometry[..., 2])
        # Whole turns between two moments do not show in the headings, and are no reason for a larger error.
        missed = wrapped(turned - self._turns(moved[:, 2]))
        lengths = (np.abs(driven) + np.abs(path)).sum(axis=1)
        told = np.minimum(np.abs(turned), _TURN)
        angles = (told + np.minimum(np.abs(turned - missed), _TURN)).sum(axis=1)
        # Noise and slip may amount to a radian and the robot's size at every moment, and to more while it turns.
        count, rims, size = len(moved), told.sum(axis=1), self.robot.reach
        position = np.abs(driven - path).sum(axis=1) / (lengths + size * (rims + count))
        heading = np.abs(missed).sum(axis=1) / (angles + count)
        runs = np.count_nonzero(self._first)
        still = (lengths < runs * size) & (angles < runs)  # a robot at rest fits any matrix
        return np.where(still, 1.0, np.maximum(position, heading))

    @property
    def driven(self) -> float:
        """The way by the design model's odometry, m; a turn counts as the way of the wheels."""
        reach = self.robot.reach
        ways = []
        for log in self.logs:
            vx, vy, turn = np.abs(log.signals @ self.design.T).T
            ways.append(float((np.hypot(vx, vy) + reach * turn) @ np.diff(log.times, prepend=0.0)))
        return sum(ways)

    @property
    def moved(self) -> float:
        """The way of the reference, m, as ``driven``, in steps that are longer than its noise."""
        return sum(_way(poses, self.robot.reach) for poses in self.poses)

    @cached_property
    def _moments(self) -> list[NDArray[np.intp]]:
        """The stamps of each log that are compared."""
        return [_moments(log, self.design[2]) for log in self.logs]

    @cached_property
    def _odometry(self) -> OdometryBatch:
        logs = [
            replace(log, start=np.zeros(3), stamps=log.stamps[chosen])
            for log, chosen in zip(self.logs, self._moments, strict=True)
        ]
        return OdometryBatch(logs, "arc")

    @property
    def _first(self) -> NDArray[np.bool_]:
        """True (S,) for the first moment of each run."""
        first: NDArray[np.bool_] = np.diff(self._odometry.trajectory, prepend=-1) > 0
        return first

    def _turns(self, headings: Array) -> Array:
        """Turns (..., S) since the moment before from headings since the start."""
        turns: Array = headings - np.where(self._first, 0.0, np.roll(headings, 1, axis=-1))
        return turns


def _moments(log: WheelLog, row_3: Array) -> NDArray[np.intp]:
    """Indices of a log's stamps between which the odometry turns by a radian or more, and the last index."""
    turned = np.cumsum((log.signals @ row_3) * np.diff(log.times, prepend=0.0))
    headings = np.interp(log.stamps, np.append(0.0, log.times), np.append(0.0, turned))
    chosen, last = [], headings[0]
    for index, heading in enumerate(headings.tolist()):
        if abs(heading - last) >= 1.0:
            chosen.append(index)
            last = heading
    return np.unique([*chosen, len(headings) - 1])


def _evenly(count: int, most: int) -> list[int]:
    """Indices below ``count``, from the first to the last, ``most`` at most."""
    indices: list[int] = np.unique(np.round(np.linspace(0, count - 1, min(count, most))).astype(int)).tolist()
    return indices


def _coarser(log: WheelLog, size: int) -> WheelLog:
    """The log with each ``size`` samples taken together, with their mean rates; the last ones may be fewer."""
    if size == 1:
        return log
    starts = np.arange(0, len(log.times), size)
    ends = np.append(starts[1:], len(log.times)) - 1
    driven = np.add.reduceat(log.rates * np.diff(log.times, prepend=0.0)[:, None], starts)
    times = log.times[ends]
    steering = None if log.steering is None else log.steering[ends]
    return replace(
        log, times=times, rates=driven / np.diff(times, prepend=0.0)[:, None], steering=steering, wheel_angles=None
    )


def _way(poses: Array, reach: float) -> float:
    """The way along poses (K, 3), m, in steps of ``reach`` or half a radian and more; a turn counts at ``reach``, m."""
    way, last = 0.0, poses[0]
    for pose in poses[1:].tolist():
        step = math.hypot(pose[0] - last[0], pose[1] - last[1])
        turn = abs(math.remainder(pose[2] - last[2], _TURN))
        if step >= reach or turn >= _LEAST_TURN:
            way, last = way + step + reach * turn, pose
    return way
