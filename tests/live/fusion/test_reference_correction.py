"""SLAM and effects in a running node: poses are put where and when they were taken, the floor drifts along the map."""

from __future__ import annotations

import numpy as np
import pytest
from drives import EXACT, ORIGIN, PERIOD, calibration, drive, slam

from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.fusion.pose_fusion import FusionSettings
from omnibench.live.wire.outputs import Update
from omnibench.robot.calibration import Calibration, EffectTerm
from omnibench.robot.kinematics import Array, compose, moved_to

LATE = EffectTerm(name="reference_time_offset", parameters={"tau": 0.12})


def term(name: str, **parameters: float) -> EffectTerm:
    return EffectTerm(name=name, parameters=parameters)


def with_effects(*terms: EffectTerm) -> Calibration:
    return calibration(deviation=None).model_copy(update={"effects": terms})


def fed(robot: RobotTracker, payloads: list[bytes]) -> list[Update]:
    return [update for index, payload in enumerate(payloads) for update in robot.take_wheels(payload, 0.01 * index)]


def odometry(updates: list[Update]) -> Array:
    return np.array([update.pose for update in updates])


def seen(using: Calibration, tau: tuple[float, float], arm: Array | None = None) -> tuple[Array, int]:
    """What a node with a calibration makes of SLAM poses: the largest errors of fused ones (3,), and how many it took.

    tau: by how much earlier positions and headings were taken than their stamps say, s. arm (2,): where the LIDAR is.
    """
    path = drive(6.0, using=calibration())
    start = np.array([2.0, -1.0, 0.7])
    truth = moved_to(start, path.poses)
    robot = RobotTracker("apr", using, fusion=FusionSettings(gate=0.999999))
    errors = []
    for index, payload in enumerate(path.payloads()):
        updates = robot.take_wheels(payload, 0.01 * index)
        if index % 25 == 0:
            taken, heading = (min(max(index - round(each / PERIOD), 0), 600) for each in tau)
            pose = np.append(truth[taken, :2], truth[heading, 2])
            if arm is not None:
                for sign, angle in ((1, pose[2]), (-1, start[2])):
                    pose[:2] += sign * compose(np.array([0, 0, angle]), np.append(arm, 0.0))[:2]
            robot.take_pose(slam(path.stamps[index], pose, 1e-2 * EXACT), 0.01 * index)
        if updates and updates[0].in_map is not None and index > 300:
            errors.append(updates[0].in_map[0] - truth[index])
    return np.abs(errors).max(axis=0), robot.health(6.0).counts["poses"]


def test_late_poses_are_put_where_they_were_taken() -> None:
    uncorrected, _ = seen(calibration(), (0.12, 0.12))
    corrected, poses = seen(with_effects(LATE), (0.12, 0.12))
    assert uncorrected[:2].max() > 0.01
    assert corrected.max() < 1e-6
    assert poses == 24  # the first was taken before there were wheel samples


def test_early_poses_wait_for_the_wheels_of_their_time() -> None:
    corrected, poses = seen(with_effects(term("reference_time_offset", tau=-0.1)), (-0.1, -0.1))
    assert corrected.max() < 1e-6
    assert poses == 24  # the last one's time has not come


@pytest.mark.parametrize("tau", [0.08, -0.08])
def test_a_heading_of_another_time_is_turned_to_that_of_its_position(tau: float) -> None:
    uncorrected, _ = seen(calibration(), (0.0, tau))
    corrected, _ = seen(with_effects(term("heading_latency", tau=tau)), (0.0, tau))
    assert uncorrected[2] > 0.01
    assert corrected.max() < 1e-6


def test_a_lever_arm_is_taken_off() -> None:
    arm = np.array([0.05, -0.03])
    uncorrected, _ = seen(calibration(), (0.0, 0.0), arm)
    corrected, _ = seen(with_effects(term("lidar_lever_arm", x=0.05, y=-0.03)), (0.0, 0.0), arm)
    assert uncorrected[:2].max() > 0.01
    assert corrected.max() < 1e-6


def test_all_together_are_undone() -> None:
    arm, terms = np.array([0.05, -0.03]), (LATE, term("heading_latency", tau=-0.05))
    corrected, _ = seen(with_effects(*terms, term("lidar_lever_arm", x=0.05, y=-0.03)), (0.12, 0.07), arm)
    assert corrected.max() < 1e-6


def test_odom_does_not_know_of_them() -> None:
    path = drive(1.0)
    updates = fed(RobotTracker("apr", with_effects(LATE), fusion=FusionSettings()), path.payloads())
    np.testing.assert_allclose(odometry(updates), path.poses, atol=1e-9)


def test_a_swap_brings_its_own() -> None:
    robot = RobotTracker("apr", calibration(), fusion=FusionSettings())
    path = drive(1.0)
    fed(robot, path.payloads()[:51])
    assert robot.take_pose(slam(path.stamps[50], path.poses[50]), 0.5) == "located"
    robot.swap(with_effects(LATE))
    assert robot.take_pose(slam(path.stamps[50], path.poses[38]), 0.5) == "fused"  # another time: no duplicate


def test_the_floor_carries_the_robot_along_the_axes_of_the_map() -> None:
    using = with_effects(term("floor_drift", dx=0.02, dy=0.0))
    path = drive(2.0, using=using)
    robot = RobotTracker("apr", using, fusion=FusionSettings())
    payloads = path.payloads()
    fed(robot, payloads[:1])
    robot.take_pose(slam(ORIGIN, [0.0, 0.0, 1.2]), 0.0)
    carried = odometry(fed(robot, payloads[1:]))[-1]
    plain = odometry(fed(RobotTracker("apr", calibration()), payloads))[-1]
    along = compose(np.array([0.0, 0.0, 1.2]), carried - plain)
    assert along[0] > 0.005
    assert abs(along[1]) < 1e-6
