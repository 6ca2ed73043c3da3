"""Parameters of diff_drive_controller (ros2_controllers) that come closest to a calibrated matrix.

With the mean rates l and r of the left and the right wheels the controller computes, at the middle between them,

    v = (R_l l + R_r r) / 2,    w = (R_r r - R_l l) / B,                                              (1)

with R_l = left_wheel_radius_multiplier wheel_radius, R_r alike, and B = wheel_separation_multiplier wheel_separation
(odometry.cpp and diff_drive_controller.cpp of the package, 2020 to 2026). By column k_l of a matrix the left wheel
alone turns the robot about a point k_1l / k_3l to the left of the frame, for Eq. (1) at -B / 2, and the right one about
one k_1r / k_3r to the left, at B / 2. So B = k_1r / k_3r - k_1l / k_3l, R_l = -B k_3l and R_r = B k_3r hold distances
and headings of rows 1 and 3 exactly, for a frame in the middle between these points. What is left is its lever arm,
which displaces the robot where it turns and does not add up.
"""

from __future__ import annotations

import math

import numpy as np

from omnibench.errors import ConfigError
from omnibench.robot.export.controller import Controller, Parameter, joint_name, reversed_joints
from omnibench.robot.export.remaining import as_read
from omnibench.robot.kinematics import Array, Mount, Robot, Wheel

_ALONG = math.cos(math.radians(10))  # of the largest angle to the robot's x axis; chosen


def diff_drive(robot: Robot, matrix: Array) -> Controller:
    """The controller closest to a matrix (3, N) of the robot's centre. ConfigError: it cannot describe this robot."""
    left, right = _sides(robot)
    reading = np.zeros((2, len(robot.measured)))
    for row, side in enumerate((left, right)):
        for index in side:
            reading[row, index] = _sign(robot.measured[index]) / len(side)
    places = np.array([wheel.position for wheel in robot.measured])
    middles = np.array([places[side].mean(axis=0) for side in (left, right)])
    base, apart = Mount(x=middles[:, 0].mean(), y=middles[:, 1].mean()), float(middles[0, 1] - middles[1, 1])
    ahead, _, turning = base.twist @ as_read(robot, matrix, reading)
    separation = float(np.diff(ahead / turning)[0]) if turning[0] < 0 < turning[1] else 0.0
    if separation <= 0:
        raise ConfigError(
            "ros2_controllers: the matrix does not drive this robot ahead and turn it counter-clockwise; check wheel "
            "signs and which wheels are on the left"
        )
    radii = separation * turning * (-1, 1)
    by_side = np.array([[radii[0] / 2, radii[1] / 2], [0.0, 0.0], [-radii[0] / separation, radii[1] / separation]])
    radius = float(robot.radii[[*left, *right]].mean())
    wheels = [[robot.wheel_names[index] for index in side] for side in (left, right)]
    unread = [name for name in robot.wheel_names if name not in wheels[0] + wheels[1]]
    backwards = [name for name in robot.wheel_names if _sign(robot.measured[robot.wheel_names.index(name)]) < 0]
    return Controller(
        "diff_drive_controller",
        (
            Parameter("left_wheel_names", tuple(map(joint_name, wheels[0]))),
            Parameter("right_wheel_names", tuple(map(joint_name, wheels[1]))),
            Parameter("wheel_separation", apart, "m, as designed"),
            Parameter("wheel_radius", radius, "m, as designed"),
            Parameter("wheel_separation_multiplier", separation / apart),
            Parameter("left_wheel_radius_multiplier", float(radii[0] / radius)),
            Parameter("right_wheel_radius_multiplier", float(radii[1] / radius)),
            Parameter("open_loop", "false"),
        ),
        by_side @ reading,
        "two wheel radii and one separation",
        "left_wheel_names and right_wheel_names",
        notes=(
            *reversed_joints([name for name in backwards if name not in unread]),
            *([f"the controller does not read {', '.join(unread)}"] if unread else []),
        ),
        base=base,
    )


def _sides(robot: Robot) -> tuple[list[int], list[int]]:
    """Indices of the fixed wheels on the left and on the right of their middle."""
    fixed = [index for index, wheel in enumerate(robot.measured) if wheel.kind == "fixed"]
    askew = [robot.wheel_names[index] for index in fixed if abs(math.cos(robot.measured[index].rolling)) < _ALONG]
    if askew:
        raise ConfigError(
            f"ros2_controllers: diff_drive_controller needs wheels that roll along x, and {', '.join(askew)} do not; "
            "turn the robot's frame, or use c_header"
        )
    across = np.array([robot.measured[index].position[1] for index in fixed])
    middle = (across.max() + across.min()) / 2
    left = [index for index, y in zip(fixed, across, strict=True) if y > middle]
    right = [index for index in fixed if index not in left]
    if not left or len(left) != len(right):
        raise ConfigError(
            "ros2_controllers: diff_drive_controller needs as many measured wheels on the left as on the right, found "
            f"{len(left)} and {len(right)}; use c_header"
        )
    return left, right


def _sign(wheel: Wheel) -> float:
    """1 for a wheel whose positive rate drives the robot forward, else -1."""
    return math.copysign(1.0, math.cos(wheel.rolling))
