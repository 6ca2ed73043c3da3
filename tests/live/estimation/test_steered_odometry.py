"""Robots that steer in a running node: the batch's numbers, over swaps and restarts too, and of their centre."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drives import EXACT, ORIGIN, PERIOD, slam
from steered import CAR, DIFFERENTIAL, SKID, SWERVE, TRICYCLE, calibration, drive, only

from omnibench.errors import DataError
from omnibench.live.estimation.saved_state import RobotMemory, SavedState
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.fusion.pose_fusion import FusionSettings
from omnibench.live.wheels.wheel_input import WheelSettings
from omnibench.live.wire.messages import JOINT_STATE
from omnibench.live.wire.outputs import Update
from omnibench.robot.calibration import Calibration, EffectTerm, Noise, covariance_rows, matrix_rows
from omnibench.robot.kinematics import Array, Mount, Robot, compose, moved_to, relative
from omnibench.robot.odometry import Integration, OdometryBatch

MOUNT = Mount(x=0.3, y=-0.1, yaw=0.4)
EFFECTS = (
    EffectTerm(name="speed_dependent_radius", parameters={"k": 0.01}),
    EffectTerm(name="acceleration_slip", parameters={"k": 0.08}),
    EffectTerm(name="centripetal_slip", parameters={"k": 0.05}),
    EffectTerm(name="floor_drift", parameters={"dx": 0.02, "dy": -0.01}),
    EffectTerm(name="heading_drift", parameters={"b": 0.005}),
)


def fed(robot: RobotTracker, payloads: list[bytes], begin: float = 0.0) -> list[Update]:
    return [
        update
        for index, payload in enumerate(payloads)
        for update in robot.take_wheels(payload, begin + PERIOD * index)
    ]


def odometry(updates: list[Update]) -> Array:
    return np.array([update.pose for update in updates])


def mounted(robot: Robot, mount: Mount | None = MOUNT) -> Robot:
    return robot.model_copy(update={"mount": mount})


def centre_of(tracked: Array) -> Array:
    """The centre's pose, from that of the tracked point."""
    return compose(tracked, relative(np.array([MOUNT.x, MOUNT.y, MOUNT.yaw]), np.zeros(3)))


def retracked(one: Calibration, robot: Robot) -> Array:
    """The matrix by which another point of a robot, its tracked one or the centre, moves as in a calibration."""
    assert one.robot.mount is not None
    centred: Array = np.linalg.inv(one.robot.mount.twist) @ one.matrix_array
    return centred if robot.mount is None else robot.mount.twist @ centred


def with_effects(plain: Calibration) -> Calibration:
    return plain.model_copy(update={"effects": EFFECTS, "covariance": None, "session": "evening"})


@pytest.mark.parametrize("robot", [SWERVE, TRICYCLE, CAR], ids=lambda robot: robot.name)
@pytest.mark.parametrize("integration", ["euler", "arc"])
@pytest.mark.parametrize("effects", [False, True])
def test_odom_is_the_batch_odometry(robot: Robot, integration: Integration, effects: bool) -> None:
    plain = calibration(robot, integration=integration)
    path = drive(using=with_effects(plain) if effects else plain)
    updates = fed(RobotTracker("base", path.using), path.payloads())
    np.testing.assert_allclose(odometry(updates), path.poses, atol=1e-12)


@pytest.mark.parametrize("use", ["positions", "velocities"])
def test_wheels_are_read_by_what_the_config_says_and_steering_by_positions(use: Any) -> None:
    path = drive()
    robot = RobotTracker("base", path.using, wheels=WheelSettings(use=use))
    np.testing.assert_allclose(odometry(fed(robot, path.payloads())), path.poses, atol=1e-12)


def test_the_first_sample_steers_by_the_mean_of_its_own_angle_and_that_of_the_message_before() -> None:
    path = drive(0.01)
    turned = path.steering.copy()
    turned[0] -= 0.3
    updates = fed(RobotTracker("base", path.using), replace(path, steering=turned).payloads())
    middle = replace(path, steering=path.steering - 0.15)
    np.testing.assert_allclose(odometry(updates), middle.poses, atol=1e-12)


def test_messages_that_are_lost_cost_the_turns_of_the_steering_and_no_way() -> None:
    path = drive(2.0)
    kept = [path.payloads()[0], *(each for number, each in enumerate(path.payloads()[1:], 1) if number % 3 == 0)]
    robot = RobotTracker("base", path.using)
    last = [update for number, each in enumerate(kept) for update in robot.take_wheels(each, 3 * PERIOD * number)][-1]
    np.testing.assert_allclose(last.pose, path.poses[198], atol=0.02)
    assert np.hypot(*last.pose[:2]) > 0.05


def test_steering_joints_in_messages_of_their_own_give_the_same_poses() -> None:
    path = drive()
    robot, updates = RobotTracker("base", path.using), []
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
    update = fed(RobotTracker("base", path.using), path.payloads())[-1]
    np.testing.assert_allclose(update.twist, path.using.matrix_array @ path.log.signals[-1], atol=1e-9)


def test_health_says_what_a_robot_without_steering_angles_waits_for_and_how_old_its_last_ones_are() -> None:
    path = drive(0.6)
    robot = RobotTracker("base", path.using)
    wheels = [JOINT_STATE.encode(only(sample, *sample.names[:4])) for sample in path.samples()]
    robot.take_wheels(wheels[0], 0.0)
    health = robot.health(0.0)
    assert health.status == "waiting"
    assert health.message == (
        "no wheel sample yet: no steering angle yet: no joint 'fl_steering' among fl, fr, rl, rr; set "
        "wheels.steering_joints"
    )
    fed(robot, [path.payloads()[1], *wheels[2:]], PERIOD)
    health = robot.health(0.6)
    assert (health.status, health.message) == ("degraded", "no steering angles for 0.6 s: the last ones are held")
    assert health.counts["old_steering"] == 39


def test_what_is_driven_by_old_angles_makes_the_pose_as_uncertain_as_the_way_is_long() -> None:
    path = drive(3.0)
    robot = RobotTracker("base", path.using)
    fed(robot, [path.payloads()[0]])
    wheels = [JOINT_STATE.encode(only(sample, *sample.names[:4])) for sample in path.samples()[1:]]
    deviations = np.sqrt([update.covariance[0, 0] for update in fed(robot, wheels, PERIOD)])
    rolled = 0.05 * np.abs(np.diff(path.angles[[20, -1]], axis=0)).max()
    assert deviations[19] < 0.005
    assert deviations[-1] > 0.3 * rolled > 0.02


class TestRestarts:
    @pytest.mark.parametrize("robot", [SWERVE, mounted(CAR)], ids=["swerve", "car with a mount"])
    def test_a_node_that_starts_again_goes_on_exactly(self, tmp_path: Path, robot: Robot) -> None:
        path = drive(using=calibration(robot))
        memory = RobotMemory(tmp_path, "base")
        first = RobotTracker("base", path.using, memory=memory)
        before = fed(first, path.payloads()[:51])
        first.close()
        saved = RobotMemory(tmp_path, "base").load()
        assert saved is not None
        second = RobotTracker("base", path.using)
        second.resume(saved, 0.5, saved.wall)
        found = odometry(before + fed(second, path.payloads()[51:], 0.51))
        uninterrupted = odometry(fed(RobotTracker("base", path.using), path.payloads()))
        np.testing.assert_allclose(found, uninterrupted, atol=1e-12)

    def test_a_robot_whose_saved_state_has_no_steering_waits_for_it(self) -> None:
        path = drive(0.1)
        state = {"sequence": 5, "stamp": ORIGIN, "wall": 1.8e9, "positions": path.angles[0].tolist()}
        state |= {"pose": [1.0, 2.0, 0.3], "covariance": (1e-4 * np.eye(3)).ravel().tolist()}
        robot = RobotTracker("base", path.using)
        robot.resume(SavedState(**state), 0.0, 1.8e9)
        bare = path.samples()[1]
        assert robot.take_wheels(JOINT_STATE.encode(only(bare, *bare.names[:4])), PERIOD) == []
        updates = fed(robot, path.payloads()[2:], 2 * PERIOD)
        held = replace(path, angles=path.angles[[0, *range(2, 11)]], steering=path.steering[[0, *range(2, 11)]])
        np.testing.assert_allclose(odometry(updates)[-1], compose(np.array([1.0, 2.0, 0.3]), held.poses[-1]), atol=1e-9)

    def test_a_state_of_a_robot_with_other_steered_wheels_is_refused(self, tmp_path: Path) -> None:
        memory, path = RobotMemory(tmp_path, "base"), drive(0.1, using=calibration(CAR))
        robot = RobotTracker("base", path.using, memory=memory)
        fed(robot, path.payloads())
        robot.close()
        saved = RobotMemory(tmp_path, "base").load()
        assert saved is not None
        other = saved.model_copy(update={"steering": (0.1,)})
        with pytest.raises(DataError, match="of a robot with 1 steered wheel; remove it"):
            RobotTracker("base", path.using).resume(other, 0.0, saved.wall)


class TestSwaps:
    @pytest.mark.parametrize("place", [0, 50])
    @pytest.mark.parametrize("effects", [False, True])
    def test_the_next_sample_steers_by_the_angle_before_the_swap(self, place: int, effects: bool) -> None:
        plain = calibration()
        path, other = drive(), with_effects(plain) if effects else plain.model_copy(update={"name": "other"})
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
    def test_a_calibration_of_other_wheels_is_refused(self, robot: Robot, reason: str) -> None:
        with pytest.raises(DataError, match=reason):
            RobotTracker("base", calibration()).swap(calibration(robot))

    def test_a_matrix_row_without_design_is_compared_with_the_size_of_the_other(self) -> None:
        robot = RobotTracker("base", calibration(DIFFERENTIAL))
        slid = robot.calibration.matrix_array
        slid[1] = 0.1 * slid[0]
        robot.swap(calibration(DIFFERENTIAL, matrix=matrix_rows(slid)))
        slid[1] = slid[0]
        with pytest.raises(DataError, match=r"row 2 of the matrix is 10.% off the design of robot 'differential'"):
            robot.swap(calibration(DIFFERENTIAL, matrix=matrix_rows(slid)))

    def test_the_tracked_point_may_move_and_the_centre_does_not_jump(self) -> None:
        path = drive(using=calibration(mounted(SWERVE)))
        other = calibration(mounted(SWERVE, Mount(x=-0.5, y=0.4, yaw=2.0)))
        other = other.model_copy(update={"matrix": matrix_rows(retracked(path.using, other.robot))})
        robot = RobotTracker("base", path.using)
        before = fed(robot, path.payloads()[:51])
        robot.swap(other)
        found = odometry(before + fed(robot, path.payloads()[51:], 0.51))
        alone = fed(RobotTracker("base", path.using), path.payloads())
        np.testing.assert_allclose(found, odometry(alone), atol=1e-12)


class TestCentre:
    """A calibration moves the tracked point; what a node tells is of the robot's centre."""

    @pytest.mark.parametrize("effects", [False, True])
    def test_the_pose_is_of_the_point_from_which_the_tracked_one_is_mounted(self, effects: bool) -> None:
        plain = calibration(mounted(SWERVE))
        path = drive(using=with_effects(plain) if effects else plain)
        updates = fed(RobotTracker("base", path.using), path.payloads())
        np.testing.assert_allclose(updates[0].pose, np.zeros(3), atol=1e-15)
        tracked = compose(odometry(updates), np.array([MOUNT.x, MOUNT.y, MOUNT.yaw]))
        if not effects:
            np.testing.assert_allclose(moved_to(np.zeros(3), tracked), path.poses, atol=1e-12)
        log = replace(path.log, start=tracked[0])
        np.testing.assert_allclose(tracked, path.using.model.poses([log])[0], atol=1e-12)

    def test_twist_and_covariances_are_those_of_a_calibration_of_the_centre_itself(self) -> None:
        mount, noise = mounted(SWERVE), Noise(walk_position=1e-9, walk_heading=1e-9)
        path = drive(using=calibration(mount, noise=noise))
        carry = np.kron(np.linalg.inv(MOUNT.twist), np.eye(8))
        centred = calibration(
            SWERVE,
            noise=noise,
            matrix=matrix_rows(retracked(path.using, SWERVE)),
            covariance=covariance_rows(carry @ np.array(path.using.covariance) @ carry.T),
        )
        (found, expected) = (fed(RobotTracker("base", each), path.payloads())[-1] for each in (path.using, centred))
        np.testing.assert_allclose(found.pose, expected.pose, atol=1e-12)
        np.testing.assert_allclose(found.twist, expected.twist, atol=1e-12)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-3, atol=1e-10)
        np.testing.assert_allclose(np.diag(found.twist_covariance), np.diag(expected.twist_covariance), rtol=0.5)

    @pytest.mark.parametrize("late", [0.0, 0.1])
    def test_poses_of_the_tracked_point_locate_the_centre(self, late: float) -> None:
        terms = (EffectTerm(name="reference_time_offset", parameters={"tau": late}),) if late else ()
        path = drive(3.0, using=calibration(mounted(SWERVE), effects=terms, covariance=None))
        at = np.array([2.0, -1.0, 0.7])
        tracked = moved_to(at, path.poses)
        robot = RobotTracker("base", path.using, fusion=FusionSettings())
        behind = round(late / PERIOD)
        for number, payload in enumerate(path.payloads()):
            updates = robot.take_wheels(payload, PERIOD * number)
            if number % 25 == 20:
                seen = slam(path.samples()[number].stamp, tracked[number - behind], 1e-2 * EXACT)
                robot.take_pose(seen, PERIOD * number)
        assert updates[-1].in_map is not None
        np.testing.assert_allclose(updates[-1].in_map[0], centre_of(tracked[-1]), atol=1e-6)
        assert robot.counts.anomalies() == {}
