"""Pose query: where a robot was at a time of the last seconds."""

from __future__ import annotations

from dataclasses import dataclass

from omnibench.errors import DataError
from omnibench.live.estimation.robot_state import RobotState
from omnibench.robot.kinematics import Array

_SECOND = 1e9  # ns


@dataclass(frozen=True, slots=True, eq=False)
class PoseAt:
    """A robot's pose at ``stamp`` (ns). odometry: pose (3,) in odom. in_map: pose (3,) and covariance (3, 3)."""

    stamp: int
    odometry: Array
    in_map: tuple[Array, Array] | None


def pose_at(state: RobotState, stamp: int | None = None) -> PoseAt:
    """The pose at a time (ns; default: of the last sample). DataError: nothing is remembered of that time."""
    timeline = state.timeline
    if not timeline.entries:
        raise DataError(f"robot {state.name!r} has sent no wheel sample yet")
    chosen = timeline.newest if stamp is None else stamp
    odometry = timeline.odometry_at(chosen)
    if odometry is None:
        oldest, newest = timeline.oldest / _SECOND, timeline.newest / _SECOND
        raise DataError(f"at: {chosen / _SECOND:.6f} s is not within {oldest:.6f} to {newest:.6f} s")
    return PoseAt(chosen, odometry, state.fusion.at(chosen) if state.fusion else None)
