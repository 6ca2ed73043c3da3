"""Classes of robots: what they are called, and whether they can slide."""

from __future__ import annotations

from typing import Literal

from omnibench.robot.kinematics import Robot
from omnibench.robot.wheels.drive import CarDrive

RobotClass = Literal["omni", "mecanum", "differential", "skid", "tricycle", "car", "swerve", "mixed"]


def class_of(robot: Robot) -> RobotClass:
    """The class of a robot by its measured wheels.

    differential: fixed wheels on one axle. tricycle: steered driven wheels beside fixed ones that guide. swerve:
    steered driven wheels alone. mixed: measured wheels of several kinds.
    """
    if isinstance(robot.drive, CarDrive):
        return "car"
    kinds = {wheel.kind for wheel in robot.measured}
    if len(kinds) > 1:
        return "mixed"
    (kind,) = kinds
    if kind == "fixed":
        return "skid" if robot.skid else "differential"
    if kind == "steered":
        return "tricycle" if any(wheel.kind == "fixed" for wheel in robot.wheels) else "swerve"
    return kind
