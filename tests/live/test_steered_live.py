"""Robots that steer in a running node: the batch and its numbers, over swaps, restarts and replays, of their centre."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drives import EXACT, ORIGIN, PERIOD, fed, odometry, slam, with_effects
from nodes import asked, config_of, running
from samples import messages_of
from steered import CAR, DIFFERENTIAL, SKID, SWERVE, TRICYCLE, calibration, drive, only, recording

from omnibench.config import validate
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import DataError
from omnibench.live.config import LiveConfig
from omnibench.live.estimation.robot_state import RobotMemory, SavedState
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.fusion.pose_fusion import FusionSettings
from omnibench.live.replay.concatenated_drive import ConcatenatedDrive, Recording, ReplayConfig, concatenate_recording
from omnibench.live.replay.demonstration import demonstrate
from omnibench.live.replay.replay_player import ReplayMessages
from omnibench.live.wheels.wheel_input import WheelSettings
from omnibench.live.wire.messages import JOINT_STATE, JointState
from omnibench.robot.calibration import Calibration, EffectTerm, Noise, covariance_rows, matrix_rows, write_calibration
from omnibench.robot.kinematics import Array, Mount, Robot, compose, moved_to, relative
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog

MOUNT = Mount(x=0.3, y=-0.1, yaw=0.4)
EFFECTS = (
    EffectTerm(name="speed_dependent_radius", parameters={"k": 0.01}),
    EffectTerm(name="acceleration_slip", parameters={"k": 0.08}),
    EffectTerm(name="centripetal_slip", parameters={"k": 0.05}),
    EffectTerm(name="floor_drift", parameters={"dx": 0.02, "dy": -0.01}),
    EffectTerm(name="heading_drift", parameters={"b": 0.005}),
)


def mounted(robot: Robot, mount: Mount | None = MOUNT) -> Robot:
    return robot.model_copy(update={"mount": mount})


def centre_of(tracked: Array) -> Array:
    """The centre's pose, from that of the tracked point."""
    return compose(tracked, relative(np.array([MOUNT.x, MOUNT.y, MOUNT.yaw]), np.zeros(3)))


def retracked(one: Calibration, robot: Robot) -> Array:
    """The matrix by which another point of a robot, its tracked one or the centre, moves as in a calibration."""
    centred: Array = np.linalg.inv(one.robot.mount.twist) @ one.matrix_array
    return centred if robot.mount is None else robot.mount.twist @ centred


@pytest.mark.parametrize("robot", [SWERVE, TRICYCLE, CAR], ids=lambda robot: robot.name)
@pytest.mark.parametrize("integration", ["euler", "arc"])
@pytest.mark.parametrize("effects", [False, True])
def test_odom_is_the_batch_odometry(robot: Robot, integration: Integration, effects: bool) -> None:
    plain = calibration(robot, integration=integration)
    path = drive(using=with_effects(*EFFECTS, plain=plain) if effects else plain)
    updates = fed(RobotTracker("base", path.calibration), path.payloads())
    np.testing.assert_allclose(odometry(updates), path.poses, atol=1e-12)


@pytest.mark.parametrize("use", ["positions", "velocities"])
def test_wheels_are_read_by_what_the_config_says_and_steering_by_positions(use: Any) -> None:
    path = drive()
    robot = RobotTracker("base", path.calibration, wheels=WheelSettings(use=use))
    np.testing.assert_allclose(odometry(fed(robot, path.payloads())), path.poses, atol=1e-12)


def test_the_first_sample_steers_by_the_mean_of_its_own_angle_and_that_of_the_message_before() -> None:
    path = drive(0.01)
    turned = path.steering.copy()
    turned[0] -= 0.3
    updates = fed(RobotTracker("base", path.calibration), replace(path, steering=turned).payloads())
    middle = replace(path, steering=path.steering - 0.15)
    np.testing.assert_allclose(odometry(updates), middle.poses, atol=1e-12)


def test_messages_that_are_lost_cost_the_turns_of_the_steering_and_no_way() -> None:
    path = drive(2.0)
    kept = [path.payloads()[0], *(each for number, each in enumerate(path.payloads()[1:], 1) if number % 3 == 0)]
    robot = RobotTracker("base", path.calibration)
    last = [update for number, each in enumerate(kept) for update in robot.take_wheels(each, 3 * PERIOD * number)][-1]
    np.testing.assert_allclose(last.pose, path.poses[198], atol=0.02)
    assert np.hypot(*last.pose[:2]) > 0.05


def test_steering_joints_in_messages_of_their_own_give_the_same_poses() -> None:
    path = drive()
    robot, updates = RobotTracker("base", path.calibration), []
    for number, sample in enumerate(path.samples()):
        for joints in (sample.names[4:], sample.names[:4]):
            updates += robot.take_wheels(JOINT_STATE.encode(only(sample, *joints)), PERIOD * number)
    np.testing.assert_allclose(odometry(updates), path.poses, atol=1e-12)
    assert robot.counts.anomalies() == {}


def test_the_covariance_of_the_matrix_spreads_as_the_batch_derivatives_say() -> None:
    quiet = calibration(noise=Noise(walk_position=1e-9, walk_heading=1e-9))
    path = drive(4.0, using=quiet)
    slopes = OdometryBatch([replace(path.log, stamps=path.times[-1:])], "arc").jacobian(quiet.matrix_array)[0]
    expected = slopes.reshape(3, 24) @ np.array(quiet.covariance) @ slopes.reshape(3, 24).T
    found = fed(RobotTracker("base", quiet), path.payloads())[-1].covariance
    np.testing.assert_allclose(found, expected, rtol=5e-3, atol=2e-3 * np.abs(expected).max())


@pytest.mark.parametrize("robot", [SWERVE, CAR], ids=lambda robot: robot.name)
def test_the_twist_is_the_matrix_times_the_signals(robot: Robot) -> None:
    path = drive(0.5, using=calibration(robot))
    update = fed(RobotTracker("base", path.calibration), path.payloads())[-1]
    np.testing.assert_allclose(update.twist, path.calibration.matrix_array @ path.log.signals[-1], atol=1e-9)


def test_health_says_what_a_robot_without_steering_angles_waits_for_and_how_old_its_last_ones_are() -> None:
    path = drive(0.6)
    robot = RobotTracker("base", path.calibration)
    wheels = [JOINT_STATE.encode(only(sample, *sample.names[:4])) for sample in path.samples()]
    robot.take_wheels(wheels[0], 0.0)
    assert robot.health(0.0).status == "waiting"
    assert "no joint 'fl_steering' among fl, fr, rl, rr" in robot.health(0.0).message
    fed(robot, [path.payloads()[1], *wheels[2:]], PERIOD)
    health = robot.health(0.6)
    assert (health.status, "no steering angles for 0.6 s" in health.message) == ("degraded", True)
    assert health.counts["old_steering"] == 39


def test_what_is_driven_by_old_angles_makes_the_pose_as_uncertain_as_the_way_is_long() -> None:
    path = drive(3.0)
    robot = RobotTracker("base", path.calibration)
    fed(robot, [path.payloads()[0]])
    wheels = [JOINT_STATE.encode(only(sample, *sample.names[:4])) for sample in path.samples()[1:]]
    deviations = np.sqrt([update.covariance[0, 0] for update in fed(robot, wheels, PERIOD)])
    rolled = 0.05 * np.abs(np.diff(path.angles[[20, -1]], axis=0)).max()
    assert deviations[19] < 0.005
    assert deviations[-1] > 0.3 * rolled > 0.02


# Restarts


def saved(**state: Any) -> SavedState:
    covariance = (1e-4 * np.eye(3)).ravel().tolist()
    return SavedState(sequence=5, stamp=ORIGIN, wall=1.8e9, pose=[1.0, 2.0, 0.3], covariance=covariance, **state)


@pytest.mark.parametrize("robot", [SWERVE, mounted(CAR)], ids=["swerve", "car with a mount"])
def test_a_node_that_starts_again_goes_on_exactly(tmp_path: Path, robot: Robot) -> None:
    path = drive(using=calibration(robot))
    memory = RobotMemory(tmp_path, "base")
    first = RobotTracker("base", path.calibration, memory=memory)
    before = fed(first, path.payloads()[:51])
    first.close()
    saved = RobotMemory(tmp_path, "base").load()
    second = RobotTracker("base", path.calibration)
    second.resume(saved, 0.5, saved.wall)
    found = odometry(before + fed(second, path.payloads()[51:], 0.51))
    uninterrupted = odometry(fed(RobotTracker("base", path.calibration), path.payloads()))
    np.testing.assert_allclose(found, uninterrupted, atol=1e-12)


def test_a_robot_whose_saved_state_has_no_steering_waits_for_it() -> None:
    path = drive(0.1)
    robot = RobotTracker("base", path.calibration)
    robot.resume(saved(positions=path.angles[0].tolist()), 0.0, 1.8e9)
    bare = path.samples()[1]
    assert robot.take_wheels(JOINT_STATE.encode(only(bare, *bare.names[:4])), PERIOD) == []
    updates = fed(robot, path.payloads()[2:], 2 * PERIOD)
    held = replace(path, angles=path.angles[[0, *range(2, 11)]], steering=path.steering[[0, *range(2, 11)]])
    np.testing.assert_allclose(odometry(updates)[-1], compose(np.array([1.0, 2.0, 0.3]), held.poses[-1]), atol=1e-9)


def test_a_state_of_a_robot_with_other_steered_wheels_is_refused() -> None:
    with pytest.raises(DataError, match="1 steered wheel"):
        RobotTracker("base", calibration(CAR)).resume(saved(positions=[0.0] * 2, steering=[0.1]), 0.0, 1.8e9)


# Swaps


@pytest.mark.parametrize("place", [0, 50])
@pytest.mark.parametrize("effects", [False, True])
def test_the_next_sample_steers_by_the_angle_before_the_swap(place: int, effects: bool) -> None:
    plain = calibration()
    path = drive()
    other = with_effects(*EFFECTS, plain=plain) if effects else plain.model_copy(update={"name": "other"})
    robot = RobotTracker("base", plain)
    fed(robot, path.payloads()[: place + 1])
    robot.swap(other)
    after = fed(robot, path.payloads()[place + 1 :], PERIOD * (place + 1))
    if not effects:
        np.testing.assert_allclose(odometry(after), path.poses[place + 1 :], atol=1e-12)
    assert len(after) == 100 - place
    assert np.abs(odometry(after)[0] - path.poses[place + 1]).max() < 2e-3


@pytest.mark.parametrize(
    ("robot", "reason"),
    [
        (TRICYCLE, "is for wheels front, this robot has fl, fr, rl, rr"),
        (SKID, "is for steered wheels none, this robot has fl, fr, rl, rr"),
    ],
)
def test_a_calibration_of_other_wheels_is_refused(robot: Robot, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        RobotTracker("base", calibration()).swap(calibration(robot))


def test_a_matrix_row_without_design_is_compared_with_the_size_of_the_other() -> None:
    robot = RobotTracker("base", calibration(DIFFERENTIAL))
    slid = robot.calibration.matrix_array
    slid[1] = 0.1 * slid[0]
    robot.swap(calibration(DIFFERENTIAL, matrix=matrix_rows(slid)))
    slid[1] = slid[0]
    with pytest.raises(DataError, match=r"row 2 of the matrix is 10.% off the design of robot 'differential'"):
        robot.swap(calibration(DIFFERENTIAL, matrix=matrix_rows(slid)))


def test_the_tracked_point_may_move_and_the_centre_does_not_jump() -> None:
    path = drive(using=calibration(mounted(SWERVE)))
    other = calibration(mounted(SWERVE, Mount(x=-0.5, y=0.4, yaw=2.0)))
    other = other.model_copy(update={"matrix": matrix_rows(retracked(path.calibration, other.robot))})
    robot = RobotTracker("base", path.calibration)
    before = fed(robot, path.payloads()[:51])
    robot.swap(other)
    found = odometry(before + fed(robot, path.payloads()[51:], 0.51))
    alone = fed(RobotTracker("base", path.calibration), path.payloads())
    np.testing.assert_allclose(found, odometry(alone), atol=1e-12)


# A calibration moves the tracked point; what a node tells is of the robot's centre.


@pytest.mark.parametrize("effects", [False, True])
def test_the_pose_is_of_the_point_from_which_the_tracked_one_is_mounted(effects: bool) -> None:
    plain = calibration(mounted(SWERVE))
    path = drive(using=with_effects(*EFFECTS, plain=plain) if effects else plain)
    updates = fed(RobotTracker("base", path.calibration), path.payloads())
    np.testing.assert_allclose(updates[0].pose, np.zeros(3), atol=1e-15)
    tracked = compose(odometry(updates), np.array([MOUNT.x, MOUNT.y, MOUNT.yaw]))
    if not effects:
        np.testing.assert_allclose(moved_to(np.zeros(3), tracked), path.poses, atol=1e-12)
    log = replace(path.log, start=tracked[0])
    np.testing.assert_allclose(tracked, path.calibration.model.poses([log])[0], atol=1e-12)


def test_twist_and_covariances_are_those_of_a_calibration_of_the_centre_itself() -> None:
    mount, noise = mounted(SWERVE), Noise(walk_position=1e-9, walk_heading=1e-9)
    path = drive(using=calibration(mount, noise=noise))
    carry = np.kron(np.linalg.inv(MOUNT.twist), np.eye(8))
    centred = calibration(
        SWERVE,
        noise=noise,
        matrix=matrix_rows(retracked(path.calibration, SWERVE)),
        covariance=covariance_rows(carry @ np.array(path.calibration.covariance) @ carry.T),
    )
    (found, expected) = (fed(RobotTracker("base", each), path.payloads())[-1] for each in (path.calibration, centred))
    np.testing.assert_allclose(found.pose, expected.pose, atol=1e-12)
    np.testing.assert_allclose(found.twist, expected.twist, atol=1e-12)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-3, atol=1e-10)
    np.testing.assert_allclose(np.diag(found.twist_covariance), np.diag(expected.twist_covariance), rtol=0.5)


@pytest.mark.parametrize("late", [0.0, 0.1])
def test_poses_of_the_tracked_point_locate_the_centre(late: float) -> None:
    terms = (EffectTerm(name="reference_time_offset", parameters={"tau": late}),) if late else ()
    path = drive(3.0, using=calibration(mounted(SWERVE), effects=terms, covariance=None))
    at = np.array([2.0, -1.0, 0.7])
    tracked = moved_to(at, path.poses)
    robot = RobotTracker("base", path.calibration, fusion=FusionSettings())
    behind = round(late / PERIOD)
    for number, payload in enumerate(path.payloads()):
        updates = robot.take_wheels(payload, PERIOD * number)
        if number % 25 == 20:
            seen = slam(path.samples()[number].stamp, tracked[number - behind], 1e-2 * EXACT)
            robot.take_pose(seen, PERIOD * number)
    np.testing.assert_allclose(updates[-1].in_map[0], centre_of(tracked[-1]), atol=1e-6)
    assert robot.counts.anomalies() == {}


def played(drive: ConcatenatedDrive, names: tuple[str, ...] | None = None, **changes: Any) -> list[JointState]:
    config = validate(ReplayConfig, changes, "test")
    messages = (each.message for each in ReplayMessages(drive, config, names=names).stamped_from(ORIGIN))
    return [each for each in messages if isinstance(each, JointState)]


def replayed_odometry(robot: RobotTracker, messages: list[JointState]) -> Array:
    payloads = ((JOINT_STATE.encode(each), (each.stamp - ORIGIN) / 1e9) for each in messages)
    return np.array([update.pose for each in payloads for update in robot.take_wheels(*each)])


@pytest.mark.parametrize("robot", [SWERVE, TRICYCLE, CAR], ids=lambda robot: robot.name)
@pytest.mark.parametrize("pause", [0.0, 0.1])
def test_what_a_node_makes_of_a_replay_is_the_batch_odometry(robot: Robot, pause: float) -> None:
    using = calibration(robot)
    drive = concatenate_recording(recording(using=using), pause=pause)
    found = replayed_odometry(RobotTracker("base", using), played(drive))
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
    assert len(drive.steering) == len(drive.wheel_times) == 40
    (poses,) = using.model.poses([drive.log(drive.slam_times)])
    np.testing.assert_allclose(poses, drive.slam_poses, atol=1e-12)


@pytest.mark.parametrize(("use", "told"), [("positions", (1, 0)), ("velocities", (0, 1)), ("both", (1, 1))])
def test_messages_hold_the_steering_angles_whatever_they_hold_of_the_wheels(use: str, told: tuple[int, int]) -> None:
    drive = concatenate_recording(recording())
    for row, message in enumerate(played(drive, wheels={"use": use})):
        assert message.names == ("fl", "fr", "rl", "rr", *(f"{each}_steering" for each in ("fl", "fr", "rl", "rr")))
        np.testing.assert_array_equal(message.positions[4:], drive.steering[row])
        velocities = np.full(8, math.nan) if message.velocities is None else message.velocities
        assert tuple(int(np.isfinite(each[:4]).all()) for each in (message.positions, velocities)) == told
        assert np.isnan(velocities[4:]).all()


MOUNTED = mounted(SWERVE)


def config(folder: Path, using: Calibration, **changes: object) -> LiveConfig:
    made = config_of(folder, "base", **changes)
    write_calibration(using, folder / "calibration.yaml")
    return made


def test_a_node_says_how_its_robot_steers_and_where_its_tracked_point_is(tmp_path: Path) -> None:
    with running(config(tmp_path, calibration(MOUNTED))) as (_, session):
        info = asked(session, "omnibench/base/info")
    assert info["steered"] == ["fl", "fr", "rl", "rr"]
    assert info["signals"][:2] == ["fl_cos", "fl_sin"]
    assert info["mount"] == {"x": 0.3, "y": -0.1, "yaw": 0.4}


def test_a_replay_shows_the_batch_odometry_of_the_tracked_point_and_is_recorded(tmp_path: Path) -> None:
    using = calibration(MOUNTED)
    made = config(tmp_path, using, record="run.mcap", replay={"speed": "max", "slam": {"period": 0.1, "delay": 0.0}})
    shown = demonstrate(made, recording(using=using))
    assert shown.batch_difference < 1e-12
    assert shown.calibrated.final_position < 1e-9 < 1e-4 < shown.theoretical.final_position
    assert shown.fused.final_position < 0.05
    assert len(messages_of(tmp_path / "run.mcap")["/base/joint_states"]) == shown.report.sent["joint_states"]


def test_a_replay_counts_every_turn_by_which_the_odometry_is_off(tmp_path: Path) -> None:
    design = DIFFERENTIAL.inverse_kinematic_matrix
    using = calibration(DIFFERENTIAL, matrix=matrix_rows(design * [[1.0], [1.0], [0.4]]))
    times, rates = PERIOD * np.arange(1, 401), np.tile([-4.0, 4.0], (400, 1))
    log = WheelLog(times, rates, np.zeros(3), np.append(0.0, times[9::10]))
    poses = using.model.poses([log])[0]
    run = Trajectory("turn", "train", times, rates, log.stamps, poses)
    made = config(tmp_path, using, replay={"speed": "max", "slam": {"period": 0.1, "delay": 0.0}})
    shown = demonstrate(made, Recording(Dataset("turns", using.robot, PERIOD, (run,))))
    headings = np.append(0.0, times * (design[2] @ rates[0]))
    assert poses[-1, 2] > np.pi
    assert 0.6 * headings[-1] > np.pi
    assert shown.theoretical.heading == pytest.approx(float(np.sqrt(np.mean((0.6 * headings) ** 2))), rel=1e-6)
    assert shown.calibrated.heading < 1e-9
    assert shown.batch_difference < 1e-9
    assert shown.fused.heading < 0.05


def test_a_recording_of_a_robot_that_steers_otherwise_is_refused(tmp_path: Path) -> None:
    fixed = SWERVE.model_copy(update={"wheels": SWERVE.wheels[:2]})
    with pytest.raises(DataError, match="'base' has fl, fr"):
        demonstrate(config(tmp_path, calibration()), recording(using=calibration(fixed)))
