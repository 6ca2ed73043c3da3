"""Parameters of omni_wheel_drive_controller (ros2_controllers) that come closest to a calibrated matrix.

The controller solves, by least squares over its wheels i = 0 .. N-1, counted counter-clockwise,

    wheel_radius * omega_i = sin(t_i) vx - cos(t_i) vy - robot_radius w,    t_i = wheel_offset + 2 pi i / N

(odometry.cpp of the package, 2025), which with omega_i negated is the wheel equation of omnibench: its positive rate
turns the robot clockwise. Its matrix is, in columns,

    m1 + i m2 = (2 r / N) i exp(i t_i),    m3 = r / (N R),

so the closest one in the sum of squares is found in closed form: r exp(i wheel_offset) from rows 1 and 2, then R from
the mean of row 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from omnibench.errors import ConfigError
from omnibench.robot.export.controller import Controller, Parameter, joint_name
from omnibench.robot.kinematics import Array, Robot

_SPACING_TOLERANCE = math.radians(10)  # rad, largest deviation from equal spacing; chosen


@dataclass(frozen=True)
class OmniWheelDrive:
    """The controller's parameters: order of the wheels (indices), radii in m, offset in rad.

    clockwise (N,): True for a wheel whose positive rate turns the robot clockwise, as the controller has it.
    """

    order: tuple[int, ...]
    robot_radius: float
    wheel_radius: float
    wheel_offset: float
    clockwise: tuple[bool, ...] = ()

    @property
    def matrix(self) -> Array:
        """The inverse kinematic matrix (3, N) that the controller uses, columns in the robot's order."""
        count = len(self.order)
        angles = self.wheel_offset + 2 * np.pi * np.arange(count) / count
        matrix = np.empty((3, count))
        matrix[0, self.order] = -2 * self.wheel_radius / count * np.sin(angles)
        matrix[1, self.order] = 2 * self.wheel_radius / count * np.cos(angles)
        matrix[2, self.order] = self.wheel_radius / (count * self.robot_radius)
        return np.where(self.clockwise, -matrix, matrix) if self.clockwise else matrix


def closest_omni_wheel_drive(robot: Robot, matrix: Array) -> OmniWheelDrive:
    """The parameters whose matrix is closest to ``matrix`` (3, N) in the sum of squares of each row.

    Raises ConfigError for a robot that the controller cannot describe: fewer than three wheels, wheels farther than 10
    degrees from equal spacing, or a matrix that turns the robot clockwise.
    """
    clockwise = tuple(wheel.lever < 0 for wheel in robot.measured)
    order = _counter_clockwise(robot)
    count = len(order)
    slots = np.exp(-2j * np.pi * np.arange(count) / count) / 1j
    columns = np.where(clockwise, -matrix, matrix)[:, order]
    scaled = complex(((columns[0] + 1j * columns[1]) * slots).sum() / 2)
    turn = float(columns[2].mean())
    if turn <= 0 or abs(scaled) == 0:
        raise ConfigError("ros2_controllers: the matrix does not turn this robot counter-clockwise; check wheel signs")
    return OmniWheelDrive(order, abs(scaled) / (count * turn), abs(scaled), float(np.angle(scaled)), clockwise)


def omni_wheel_drive(robot: Robot, matrix: Array) -> Controller:
    """The controller closest to a matrix (3, N) of the robot's centre. ConfigError: it cannot describe this robot."""
    fitted = closest_omni_wheel_drive(robot, matrix)
    names = ", ".join(joint_name(robot.wheel_names[index]) for index in fitted.order)
    off = 100 * (fitted.matrix - matrix) / np.abs(matrix).max(axis=1, keepdims=True)
    rows = "; ".join(", ".join(f"{value:+.2f}" for value in row) for row in off)
    sign = (
        "a positive joint velocity turns the robot clockwise for this controller, counter-clockwise for the "
        "calibration: reverse the joints' axes"
    )
    if any(fitted.clockwise):
        kept = [name for name, turns in zip(robot.wheel_names, fitted.clockwise, strict=True) if turns]
        sign += f", but not of {', '.join(kept)}"
    return Controller(
        "omni_wheel_drive_controller",
        (
            Parameter("wheel_names", f"[{names}]", "counter-clockwise"),
            Parameter("wheel_offset", fitted.wheel_offset, "rad"),
            Parameter("robot_radius", fitted.robot_radius, "m"),
            Parameter("wheel_radius", fitted.wheel_radius, "m"),
            Parameter("open_loop", "false"),
        ),
        fitted.matrix,
        "one wheel radius, one distance and equal spacing",
        "wheel_names",
        f": its elements are off by ({rows}) % of their row's largest, rows x; y; heading, wheels "
        f"{', '.join(robot.wheel_names)}",
        (sign,),
        covariances="diagonal_covariance.{}",
    )


def _counter_clockwise(robot: Robot) -> tuple[int, ...]:
    """Indices of the wheels in counter-clockwise order from the first one on."""
    wheels = robot.measured
    if len(wheels) < 3:
        raise ConfigError("ros2_controllers: omni_wheel_drive_controller needs three wheels or more; use c_header")
    angles = np.array([wheel.axle if wheel.lever > 0 else wheel.axle + math.pi for wheel in wheels])
    turned = np.mod(angles - angles[0], 2 * np.pi)
    # By rounding, the first wheel or one at the same angle may be a full turn away.
    turned[np.isclose(turned, 2 * np.pi)] = 0.0
    order = np.argsort(turned, kind="stable")
    slots = 2 * np.pi * np.arange(len(order)) / len(order)
    away = turned[order] - slots
    away -= (away.max() + away.min()) / 2
    if np.abs(away).max() > _SPACING_TOLERANCE:
        raise ConfigError(
            f"ros2_controllers: omni_wheel_drive_controller needs wheels at equal angles, and these are up to "
            f"{math.degrees(np.abs(away).max()):.0f} degrees off ({_degrees(angles)}); use c_header"
        )
    return tuple(int(index) for index in order)


def _degrees(angles: Array) -> str:
    return ", ".join(f"{value:.4g}" for value in np.degrees(angles)) + " deg"
