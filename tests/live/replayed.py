"""A short drive, its replay and what the messages of one hold, for tests of replays."""

import math
from typing import Any

import numpy as np
from recordings import random_dataset

from omnibench.config import validate
from omnibench.live.drive import ConcatenatedDrive, ReplayConfig, concatenate_runs
from omnibench.live.replay import Event, ReplayMessages
from omnibench.live.wire import JointState, PoseEstimate
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

ORIGIN = 1_700_000_000_000_000_000
DRIVE = concatenate_runs(random_dataset(1))  # 2.4 s of motion and 2 s of rest, a pose every 0.1 s
TOPICS = ("joint_states", "slam_pose")


def config(**changes: Any) -> ReplayConfig:
    return validate(ReplayConfig, {"stamp_origin": ORIGIN} | changes, "test")


def played(drive: ConcatenatedDrive = DRIVE, *, noise: Noise | None = None, **changes: Any) -> list[Event]:
    return list(ReplayMessages(drive, config(**changes), noise=noise).stamped_from())


def of(played_events: list[Event], topic: str) -> list[Event]:
    return [each for each in played_events if each.topic == topic]


def taken(played_events: list[Event]) -> Array:
    """When the messages were taken, s of the recording."""
    return np.array([each.message.stamp - ORIGIN for each in played_events]) / 1e9


def arrivals(played_events: list[Event]) -> Array:
    return np.array([each.arrival for each in played_events])


def same(one: JointState | PoseEstimate, other: JointState | PoseEstimate) -> bool:
    if isinstance(one, JointState) and isinstance(other, JointState):
        return (
            (one.stamp, one.names) == (other.stamp, other.names)
            and np.array_equal(np.asarray(one.positions), np.asarray(other.positions))
            and np.array_equal(np.asarray(one.velocities), np.asarray(other.velocities))
        )
    turn = (one.pose[2] - other.pose[2]) / (2 * math.pi)
    return (
        (one.stamp, one.frame) == (other.stamp, other.frame)
        and np.array_equal(one.pose[:2], other.pose[:2])
        and abs(turn - round(turn)) < 1e-12
        and np.array_equal(one.covariance, other.covariance)
    )
