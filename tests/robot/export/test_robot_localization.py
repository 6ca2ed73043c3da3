"""Covariances for robot_localization: what the filter makes of them, and what is said of what is not known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from export_samples import DIFF, MECANUM, MOUNT, NOISE, SKID, SWERVE, calibration, mounted, parameters
from sample_robots import APR_02

from omnibench.errors import ConfigError
from omnibench.robot.calibration import covariance_rows
from omnibench.robot.export.formats import export_calibration
from omnibench.robot.export.ros2_controllers import matrix_deviations
from omnibench.robot.kinematics import Array, Mount, Robot

_PLANAR = [0, 1, 5, 6, 7, 11]  # x, y, yaw, vx, vy, vyaw of the filter's 15 states


def filtered_variances(twist: Array, process: Array, period: float, seconds: float) -> Array:
    """Variances (3,) of x, y, yaw after a time by ekf.cpp (2020): P = F P F^T + dt Q, then the velocities measured."""
    covariance, motion = 1e-9 * np.eye(6), np.eye(6)
    motion[:3, 3:] += period * np.eye(3)  # standing, heading 0
    noise = period * process[np.ix_(_PLANAR, _PLANAR)]
    measured = np.eye(6)[3:]
    for _ in range(round(seconds / period)):
        covariance = motion @ covariance @ motion.T + noise
        gain = covariance @ measured.T @ np.linalg.inv(measured @ covariance @ measured.T + np.diag(twist))
        covariance = (np.eye(6) - gain @ measured) @ covariance
    return np.diag(covariance)[:3]


def test_the_filters_pose_grows_by_the_walk_of_the_calibration() -> None:
    export = export_calibration(calibration(DIFF), "robot_localization")
    found = parameters(export, "ekf_filter_node")
    twist = np.array(parameters(export, "diff_drive_controller")["twist_covariance_diagonal"])[[0, 1, 5]]
    process = np.array(found["process_noise_covariance"]).reshape(15, 15)
    grown = filtered_variances(twist, process, 0.02, 11) - filtered_variances(twist, process, 0.02, 1)
    walk = np.square([NOISE.walk_position, NOISE.walk_position, NOISE.walk_heading])
    np.testing.assert_allclose(grown, 10 * walk, rtol=0.02)
    assert [index for index, used in enumerate(found["odom0_config"]) if used] == [6, 7, 11]
    assert found["odom0"] == "/diff_drive_controller/odom"
    assert (found["two_d_mode"], found["odom0_differential"]) == (True, False)


def test_the_robots_centre_walks_with_the_lever_arm_of_the_tracked_point() -> None:
    text = export_calibration(calibration(mounted(DIFF)), "ros2_controllers")
    found = parameters(text, "diff_drive_controller")["pose_covariance_diagonal"]
    position, heading = NOISE.walk_position**2, NOISE.walk_heading**2
    expected = [position + MOUNT.y**2 * heading, position + MOUNT.x**2 * heading, 0, 0, 0, heading]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("robot", "node", "topic"),
    [
        (APR_02, "omni_wheel_drive_controller", "odom"),
        (SKID, "diff_drive_controller", "odom"),
        (MECANUM, "mecanum_drive_controller", "odometry"),
    ],
    ids=["omni", "skid", "mecanum"],
)
def test_the_controller_gets_the_same_covariances(robot: Robot, node: str, topic: str) -> None:
    exports = [export_calibration(calibration(robot), name) for name in ("robot_localization", "ros2_controllers")]
    ours, theirs = (parameters(export, node) for export in exports)
    assert len(ours) == 2
    assert ours.items() <= theirs.items()
    assert parameters(exports[0], "ekf_filter_node")["odom0"] == f"/{node}/{topic}"


def test_a_robot_without_a_controller_gets_the_variances_of_its_messages() -> None:
    text = export_calibration(calibration(SWERVE), "robot_localization").text
    assert "# twist.covariance of the messages: [0] 1.800000e-03, [7] 1.800000e-03 m2/s2, [35] 5.000000e-03" in text
    assert "odom0: /odom\n" in text


def test_the_error_of_the_matrix_is_told_and_not_taken_for_noise() -> None:
    sigma = 1e-5  # of every element, m and rad: of 1/r rad by each wheel for a metre, of 0.2/r rad for a radian
    known = calibration(DIFF, covariance=covariance_rows(sigma**2 * np.eye(6)))
    metre, radian = math.sqrt(2) * sigma / 0.08, 0.2 * math.sqrt(2) * sigma / 0.08
    said = (
        f"{1e3 * math.sqrt(2) * metre:.1f} mm and {math.degrees(metre):.2f} deg a metre, "
        f"{360 * radian:.1f} deg and {2000 * math.pi * math.sqrt(2) * radian:.1f} mm a full turn (1 sigma)"
    )
    export = export_calibration(known, "robot_localization")
    assert any(said in warning for warning in export.warnings)
    unknown = export_calibration(calibration(DIFF), "robot_localization")
    assert any("has no covariance of its matrix" in warning for warning in unknown.warnings)
    node = "diff_drive_controller"
    assert parameters(export, node) == parameters(unknown, node)


def test_a_walk_that_was_not_seen_is_named_and_a_calibration_without_noise_refused() -> None:
    still = NOISE.model_copy(update={"walk_heading": 0.0})
    warnings = export_calibration(calibration(DIFF, noise=still), "robot_localization").warnings
    assert any("no random walk of heading" in warning for warning in warnings)
    with pytest.raises(ConfigError, match="calibration 'diff'"):
        export_calibration(calibration(DIFF, noise=None), "robot_localization")


def test_an_error_of_the_tracked_points_matrix_moves_the_centre_as_a_rigid_body() -> None:
    """With the covariance e e' the matrix errs by e times one number: the deviations are those of that one error."""
    error = 1e-3 * np.random.default_rng(3).standard_normal((3, 2))
    known = calibration(mounted(DIFF), covariance=covariance_rows(np.outer(error, error)))
    deviations = matrix_deviations(known, Mount())
    for stated, rates in zip(deviations, ([1 / 0.08, 1 / 0.08], [0.2 / 0.08, -0.2 / 0.08]), strict=True):  # 1 m, 1 rad
        along, aside, turned = error @ rates  # of the tracked point, along its own axes
        ahead = along * math.cos(MOUNT.yaw) - aside * math.sin(MOUNT.yaw) + turned * MOUNT.y
        left = along * math.sin(MOUNT.yaw) + aside * math.cos(MOUNT.yaw) - turned * MOUNT.x
        np.testing.assert_allclose(stated, np.abs([ahead, left, turned]), rtol=1e-9)
