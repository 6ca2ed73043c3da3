"""Names of a robot's joints in its wheel messages: those of the config, or as they are mostly called."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from omnibench.errors import ConfigError
from omnibench.live.wheels.wheel_input import WheelSettings
from omnibench.robot.kinematics import Robot


@dataclass(frozen=True)
class Joints:
    """Names of the joints of wheels with a measured rate (N) and of those that steer (S)."""

    wheels: tuple[str, ...]
    steering: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """All, wheels first."""
        return self.wheels + self.steering


def joints_of(robot: Robot, settings: WheelSettings | None = None, where: str = "wheels") -> Joints:
    """A robot's joints. ConfigError that begins with ``where``: they are not one, and a different one, for each wheel.

    By default a wheel has its own name, and its steering joint that name with _steering at the end.
    """
    rated, steered, settings = robot.wheel_names, robot.drive.steered, settings or WheelSettings()
    joints = Joints(
        rated if settings.joints is None else settings.joints,
        tuple(f"{name}_steering" for name in steered) if settings.steering_joints is None else settings.steering_joints,
    )
    check_joints(joints.wheels, rated, f"{where}.joints")
    check_joints(joints.steering, steered, f"{where}.steering_joints", "steered wheels")
    if both := set(joints.wheels) & set(joints.steering):
        raise ConfigError(f"{where}.steering_joints: {min(both)} is the joint of a wheel, too; name its steering joint")
    return joints


def check_joints(joints: Sequence[str], wheels: Sequence[str], where: str, what: str = "wheels") -> None:
    """ConfigError that begins with ``where``: the joints are not one, and a different one, for each wheel."""
    if len(joints) != len(wheels) or len(set(joints)) < len(joints):
        reason = f"name one joint, and a different one, for each of the {what} {', '.join(wheels)}"
        raise ConfigError(f"{where}: {', '.join(joints) or 'none'}; {reason if wheels else 'no wheel steers'}")
