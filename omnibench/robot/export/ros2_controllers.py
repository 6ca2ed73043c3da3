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
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array, Robot

_SPACING_TOLERANCE = math.radians(10)  # rad, largest deviation from equal spacing; chosen


@dataclass(frozen=True)
class OmniWheelDrive:
    """The controller's parameters: order of the wheels (indices), radii in m, offset in rad."""

    order: tuple[int, ...]
    robot_radius: float
    wheel_radius: float
    wheel_offset: float

    @property
    def matrix(self) -> Array:
        """The inverse kinematic matrix (3, N) that the controller uses, columns in the robot's order."""
        count = len(self.order)
        angles = self.wheel_offset + 2 * np.pi * np.arange(count) / count
        matrix = np.empty((3, count))
        matrix[0, self.order] = -2 * self.wheel_radius / count * np.sin(angles)
        matrix[1, self.order] = 2 * self.wheel_radius / count * np.cos(angles)
        matrix[2, self.order] = self.wheel_radius / (count * self.robot_radius)
        return matrix


@dataclass(frozen=True)
class RemainingError:
    """Odometry error of a matrix against another, in the worst direction of straight driving and on the spot."""

    straight_position: float  # m per m
    straight_heading: float  # rad per m
    turn_position: float  # m per rad
    turn_heading: float  # rad per rad

    def __str__(self) -> str:
        return (
            f"{1000 * self.straight_position:.1f} mm and {math.degrees(self.straight_heading):.2f} deg a metre, "
            f"{math.degrees(self.turn_heading * 2 * math.pi):.1f} deg and {2000 * math.pi * self.turn_position:.1f} mm "
            "a full turn"
        )


def closest_omni_wheel_drive(robot: Robot, matrix: Array) -> OmniWheelDrive:
    """The parameters whose matrix is closest to ``matrix`` (3, N) in the sum of squares of each row.

    Raises ConfigError for a robot that the controller cannot describe: wheels with slanted rollers, wheels farther than
    10 degrees from equal spacing, or a matrix that turns the robot clockwise.
    """
    order = _counter_clockwise(robot)
    count = len(order)
    slots = np.exp(-2j * np.pi * np.arange(count) / count) / 1j
    columns = matrix[:, order]
    scaled = complex(((columns[0] + 1j * columns[1]) * slots).sum() / 2)
    turn = float(columns[2].mean())
    if turn <= 0 or abs(scaled) == 0:
        raise ConfigError("ros2_controllers: the matrix does not turn this robot counter-clockwise; check wheel signs")
    return OmniWheelDrive(order, abs(scaled) / (count * turn), abs(scaled), float(np.angle(scaled)))


def remaining_error(used: Array, true: Array) -> RemainingError:
    """Error of odometry with the matrix ``used`` (3, N) on a robot whose matrix is ``true`` (3, N)."""
    error = used @ np.linalg.pinv(true) - np.eye(3)
    return RemainingError(
        float(np.linalg.norm(error[:2, :2], 2)),
        float(np.linalg.norm(error[2, :2])),
        float(np.linalg.norm(error[:2, 2])),
        float(abs(error[2, 2])),
    )


def ros2_controllers(calibration: Calibration) -> tuple[str, tuple[str, ...]]:
    """The controller's parameters as YAML, and warnings of their errors. ConfigError: another kind of robot."""
    robot, matrix = calibration.robot, calibration.matrix_array
    fitted = closest_omni_wheel_drive(robot, matrix)
    design = closest_omni_wheel_drive(robot, robot.inverse_kinematic_matrix)
    names = [robot.wheel_names[index] for index in fitted.order]
    warnings = _warnings(calibration, fitted, design)
    lines = [
        f"omni_wheel_drive_controller (ros2_controllers) for robot {_line(robot.name)!r},",
        f"closest to the omnibench calibration {_line(calibration.name)!r} of {calibration.created:%Y-%m-%d}.",
        *(f"- {warning}" for warning in warnings),
        f"Design values: wheel_offset {design.wheel_offset:.6f}, robot_radius {design.robot_radius:.6f}, "
        f"wheel_radius {design.wheel_radius:.6f}",
    ]
    comment = "".join(f"# {line}\n" for line in lines)
    parameters = (
        "omni_wheel_drive_controller:\n"
        "  ros__parameters:\n"
        f"    wheel_names: [{', '.join(f'wheel_{name}_joint' for name in names)}]  # counter-clockwise\n"
        f"    wheel_offset: {fitted.wheel_offset:.12f}  # rad\n"
        f"    robot_radius: {fitted.robot_radius:.12f}  # m\n"
        f"    wheel_radius: {fitted.wheel_radius:.12f}  # m\n"
        "    open_loop: false\n"
    )
    return comment + parameters, warnings


def _warnings(calibration: Calibration, fitted: OmniWheelDrive, design: OmniWheelDrive) -> tuple[str, ...]:
    matrix = calibration.matrix_array
    residual = 100 * (fitted.matrix - matrix) / np.abs(matrix).max(axis=1, keepdims=True)
    rows = "; ".join(", ".join(f"{value:+.2f}" for value in row) for row in residual)
    warnings = [
        "one wheel radius, one distance and equal spacing stand for the whole matrix: "
        f"its elements are off by ({rows}) % of their row's largest, rows x; y; heading, wheels "
        f"{', '.join(calibration.robot.wheel_names)}",
        f"that leaves up to {remaining_error(fitted.matrix, matrix)}; "
        f"with the design values it would be {remaining_error(design.matrix, matrix)}",
        "a positive joint velocity turns the robot clockwise for this controller, counter-clockwise for the "
        "calibration: reverse the joints' axes",
        "wheel_names are made up from the calibration's wheels: put in the joints of your URDF, in this order",
    ]
    if calibration.integration == "euler":
        warnings.append("the matrix was calibrated for Euler steps, the controller integrates arcs")
    if calibration.effects:
        named = ", ".join(term.name for term in calibration.effects)
        warnings.append(f"effects of the calibration are left out, the controller has none: {named}")
    return tuple(warnings)


def _counter_clockwise(robot: Robot) -> tuple[int, ...]:
    """Indices of the wheels in counter-clockwise order from the first one on."""
    slanted = [wheel.name for wheel in robot.wheels if wheel.roller_angle != 0]
    if slanted:
        raise ConfigError(
            f"ros2_controllers: omni_wheel_drive_controller has no slanted rollers (wheels {', '.join(slanted)} have); "
            "for mecanum wheels use c_header"
        )
    angles = np.array([wheel.angle for wheel in robot.wheels])
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


def _line(text: str) -> str:
    return " ".join(text.split())
