"""The controller of ros2_controllers for a robot, with the parameters that come closest to its calibration."""

from __future__ import annotations

from collections.abc import Callable

from omnibench.robot.calibration import Calibration
from omnibench.robot.export.car import car
from omnibench.robot.export.controller import Controller, document
from omnibench.robot.export.diff_drive import diff_drive
from omnibench.robot.export.mecanum_drive import mecanum_drive
from omnibench.robot.export.omni_wheel_drive import omni_wheel_drive
from omnibench.robot.export.remaining import of_centre
from omnibench.robot.export.tricycle import tricycle
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.wheels.drive import CarDrive


def ros2_controllers(calibration: Calibration) -> tuple[str, tuple[str, ...], str]:
    """The controller's parameters as YAML, warnings of what they cannot hold, and the controller's name.

    ConfigError: no controller can describe this robot.
    """
    fitted = controller(calibration.robot, calibration.matrix_without_effects)
    design = controller(calibration.robot, calibration.robot.inverse_kinematic_matrix)
    return *document(calibration, fitted, design), fitted.name


def controller(robot: Robot, matrix: Array) -> Controller:
    """The controller of a robot, closest to a matrix (3, M) of its tracked point. ConfigError: there is none."""
    return _closest(robot)(robot, of_centre(robot, matrix))


def _closest(robot: Robot) -> Callable[[Robot, Array], Controller]:
    kinds = {wheel.kind for wheel in robot.measured}
    if isinstance(robot.drive, CarDrive):
        return car
    if "steered" in kinds:
        return tricycle
    if "fixed" in kinds:
        return diff_drive
    return mecanum_drive if "mecanum" in kinds else omni_wheel_drive
