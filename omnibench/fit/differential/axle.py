"""The axle of a differential drive with two measured wheels: its middle, its length, and robots that differ in both."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.planar import compose, relative, rotated
from omnibench.robot.robot_class import class_of

TWO_WHEELS = "differential drives with two measured wheels"


def has_two_wheels(robot: Robot) -> bool:
    """True for a differential drive with two measured wheels."""
    return class_of(robot) == "differential" and len(robot.measured) == 2


def middle_of_axle(robot: Robot) -> Array:
    """Pose (3,) of the axle's middle in the robot's frame, looking ahead; m, m, rad."""
    ahead = robot.motions[0]
    places = np.mean([wheel.position for wheel in robot.measured], axis=0)
    return np.array([*places, math.atan2(ahead[1], ahead[0])])


def poses_of_axle(robot: Robot, poses: Array) -> Array:
    """Poses (K, 3) of the axle's middle, from those of the tracked point."""
    mount = robot.mount or Mount()
    return compose(poses, relative(np.array([mount.x, mount.y, mount.yaw]), middle_of_axle(robot)))


def sides_of_axle(robot: Robot) -> dict[str, float]:
    """Distance of each measured wheel to the left of the axle's middle, m."""
    middle = middle_of_axle(robot)
    return {
        wheel.name: float(rotated(np.array(wheel.position) - middle[:2], -middle[2])[1]) for wheel in robot.measured
    }


def axle_length(robot: Robot) -> float:
    """Distance of the two wheels, m."""
    return sum(abs(side) for side in sides_of_axle(robot).values())


def with_axle(robot: Robot, radii: Mapping[str, float], length: float) -> Robot:
    """The robot with the radii of its measured wheels, by name, and the length of its axle times factors."""
    middle = middle_of_axle(robot)[:2]
    wheels = []
    for wheel in robot.wheels:
        if wheel.name in radii:
            x, y = (middle + length * (np.array(wheel.position) - middle)).tolist()
            wheel = wheel.model_copy(update={"radius": float(wheel.radius * radii[wheel.name]), "x": x, "y": y})
        wheels.append(wheel)
    return robot.model_copy(update={"wheels": tuple(wheels)})


def with_diameter_ratio(robot: Robot, ratio: float, length: float) -> Robot:
    """The robot with diameters in a ratio, right to left, their mean kept, and its axle times a factor.

    With E_d the ratio and D the mean, D_right = 2 D / (1 + 1/E_d) and D_left = 2 D / (1 + E_d) (Borenstein and Feng,
    IEEE T-RA 12:869, 1996); where the design's differ, each is multiplied.
    """
    sides = sides_of_axle(robot)
    return with_axle(robot, {name: 2 / (1 + ratio ** float(np.sign(side))) for name, side in sides.items()}, length)


def left_and_right(robot: Robot) -> tuple[str, str]:
    """Name and radius, mm, of the left wheel and of the right one."""
    sides = sides_of_axle(robot)
    left, right = sorted(robot.measured, key=lambda wheel: -sides[wheel.name])
    return f"{left.name} {1000 * left.radius:.3f}", f"{right.name} {1000 * right.radius:.3f}"
