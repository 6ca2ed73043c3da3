"""Recordings of robots that steer, played as the robot would send them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from drives import ORIGIN
from steered import CAR, SWERVE, TRICYCLE, calibration, recording

from omnibench.config import validate
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.replay.concatenated_drive import ConcatenatedDrive, ReplayConfig, concatenate_recording
from omnibench.live.replay.replay_player import events
from omnibench.live.wheels.wheel_input import WheelSettings
from omnibench.live.wire.messages import JOINT_STATE, JointState
from omnibench.robot.kinematics import Array, Robot, moved_to


def played(drive: ConcatenatedDrive, names: tuple[str, ...] | None = None, **changes: Any) -> list[JointState]:
    config = validate(ReplayConfig, changes, "test")
    messages = (each.message for each in events(drive, config, origin=ORIGIN, names=names))
    return [each for each in messages if isinstance(each, JointState)]


def odometry(robot: RobotTracker, messages: list[JointState]) -> Array:
    payloads = ((JOINT_STATE.encode(each), (each.stamp - ORIGIN) / 1e9) for each in messages)
    return np.array([update.pose for each in payloads for update in robot.take_wheels(*each)])


@pytest.mark.parametrize("robot", [SWERVE, TRICYCLE, CAR], ids=lambda robot: robot.name)
@pytest.mark.parametrize("pause", [0.0, 0.1])
def test_what_a_node_makes_of_a_replay_is_the_batch_odometry(robot: Robot, pause: float) -> None:
    using = calibration(robot)
    drive = concatenate_recording(recording(using=using), pause=pause)
    found = odometry(RobotTracker("base", using), played(drive))
    np.testing.assert_allclose(moved_to(drive.start_poses[0], found), using.model.poses([drive.log()])[0], atol=1e-12)


def test_every_run_of_a_drive_with_pauses_is_driven_as_it_was_alone() -> None:
    using = calibration()
    made = recording(using=using)
    drive = concatenate_recording(made, pause=0.1)
    (poses,) = using.model.poses([drive.log()])
    for number, run in enumerate(made.dataset.trajectories):
        ends = drive.start_times[number] + run.times
        at = np.searchsorted(drive.wheel_times, [ends[0] - run.times[0] - 1e-6, *(ends - 1e-6)])
        (alone,) = using.model.poses([run.log(np.append(0.0, run.times))])
        np.testing.assert_allclose(moved_to(alone[0], poses[at]), alone, atol=1e-12)


def test_a_run_that_is_cut_at_its_last_pose_steers_as_it_did() -> None:
    using = calibration()
    drive = concatenate_recording(recording(using=using, runs=1, pose_every=13))
    assert drive.steering is not None
    assert len(drive.steering) == len(drive.wheel_times) == 40
    (poses,) = using.model.poses([drive.log(drive.slam_times)])
    np.testing.assert_allclose(poses, drive.slam_poses, atol=1e-12)


@pytest.mark.parametrize(("use", "told"), [("positions", (1, 0)), ("velocities", (0, 1)), ("both", (1, 1))])
def test_messages_hold_the_steering_angles_whatever_they_hold_of_the_wheels(use: str, told: tuple[int, int]) -> None:
    drive = concatenate_recording(recording())
    for row, message in enumerate(played(drive, wheels={"use": use})):
        assert message.names == ("fl", "fr", "rl", "rr", *(f"{each}_steering" for each in ("fl", "fr", "rl", "rr")))
        assert drive.steering is not None
        assert message.positions is not None
        np.testing.assert_array_equal(message.positions[4:], drive.steering[row])
        velocities = np.full(8, math.nan) if message.velocities is None else message.velocities
        assert tuple(int(np.isfinite(each[:4]).all()) for each in (message.positions, velocities)) == told
        assert np.isnan(velocities[4:]).all()


@pytest.mark.parametrize("use", ["positions", "velocities"])
def test_a_node_takes_messages_that_hold_only_one_of_both_of_the_wheels(use: str) -> None:
    using = calibration()
    drive = concatenate_recording(recording(using=using))
    found = odometry(RobotTracker("base", using), played(drive, wheels={"use": use}))
    np.testing.assert_allclose(moved_to(drive.start_poses[0], found), using.model.poses([drive.log()])[0], atol=1e-12)


def test_joints_are_called_as_a_node_expects_them() -> None:
    using = calibration(TRICYCLE)
    drive = concatenate_recording(recording(using=using))
    robot = RobotTracker("base", using, wheels=WheelSettings(joints=("traction",), steering_joints=("fork",)))
    assert len(odometry(robot, played(drive, names=("traction", "fork")))) == len(drive.wheel_times)
