"""Saving a robot's state now and then, and resuming from a state that was saved."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from omnibench.errors import DataError
from omnibench.live.estimation.live_odometry import Motion
from omnibench.live.estimation.robot_state import RobotState
from omnibench.live.estimation.saved_state import RobotMemory, SavedState
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_PERIOD = 0.1  # s between two states; chosen: a node that is killed loses no more
_RETRY = 10.0  # s until a state that could not be written is tried again; chosen


class StateWriter:
    """Writes a robot's state to its memory; does nothing without one."""

    def __init__(self, memory: RobotMemory | None) -> None:
        self._memory = memory
        # arrival (s, monotonic) of the wheel sample after which the state is to be written; never without a memory
        self._due = -math.inf if memory is not None else math.inf

    def save_if_due(self, state: RobotState) -> None:
        """Write the state unless that was done less than 0.1 s ago."""
        if state.arrival is not None and state.arrival >= self._due:
            self.save(state)

    def save(self, state: RobotState) -> None:
        """Write the state after the last wheel sample; a disk that refuses is counted and told in health."""
        last = state.wheel_input.last_sample
        if self._memory is None or last is None or state.arrival is None:
            return
        self._due = state.arrival + _PERIOD
        stamp, positions, steering = last
        fusion = state.fusion
        fused = (fusion.pose, fusion.covariance) if fusion is not None and fusion.located else (None, None)
        saved = SavedState.model_construct(  # not validated: reading refuses numbers that cannot be
            stamp=stamp,
            wall=time.time() - (time.monotonic() - state.arrival),
            positions=_row(positions),
            steering=_row(steering),
            pose=_row(state.odometry.pose),
            covariance=_row(state.odometry.covariance),
            map_pose=_row(fused[0]),
            map_covariance=_row(fused[1]),
            session_time=state.odometry.session_time,
            flows=dict(state.flows),
        )
        try:
            self._memory.save(saved)
        except OSError as error:  # a full disk must not stop the odometry
            state.counts.failures += 1
            state.refused(f"the state could not be written: {error.strerror}")
            self._due += _RETRY

    def close(self, state: RobotState) -> None:
        """Write the last state and let another node use the memory."""
        self.save(state)
        if self._memory is not None:
            self._memory.close()
            self._memory = None


def _row(values: Array | None) -> Any:
    return None if values is None else tuple(values.ravel().tolist())


def resume_state(state: RobotState, saved: SavedState, now: float, wall: float) -> Motion:
    """Bring a new state to where another node stopped; the motion that begins the timeline there.

    now, wall: monotonic and unix time, s. DataError: the saved state is of a robot with other wheels.
    """
    drive = state.calibration.robot.drive
    for angles, wheels, what in (
        (saved.positions, drive.wheels, "wheel"),
        (saved.steering, drive.steered, "steered wheel"),
    ):
        if angles is not None and len(angles) != len(wheels):
            raise DataError(
                f"the state of robot {state.name!r} is of a robot with {plural(len(angles), what)}; remove it"
            )
    positions, steering = (None if row is None else np.array(row) for row in (saved.positions, saved.steering))
    state.wheel_input.resume(saved.stamp, positions, now - (wall - saved.wall), steering)
    state.flows.update(saved.flows)
    state.odometry.resume(np.array(saved.pose), np.reshape(saved.covariance, (3, 3)), saved.session_time, steering)
    if state.fusion is not None and saved.map_pose is not None and saved.map_covariance is not None:
        state.fusion.begin(np.array(saved.map_pose), np.reshape(saved.map_covariance, (3, 3)))
    state.stamps.unique(saved.stamp)
    return Motion(saved.stamp, 0.0, np.zeros(3), state.calibration.integration, 0.0, 0.0)
