"""Parameters with one value for each wheel, named by a prefix and the wheel's name."""

from __future__ import annotations

import numpy as np

from omnibench.robot.effects.effect import Parameter, Values
from omnibench.robot.kinematics import Array, Robot


def has_rollers(robot: Robot) -> bool:
    """True if a wheel with a measured rate has rollers."""
    return any(wheel.kind in ("omni", "mecanum") for wheel in robot.measured)


def one_for_each_wheel(
    robot: Robot, prefix: str, unit: str, low: float, high: float, description: str
) -> tuple[Parameter, ...]:
    """The parameters ``prefix_<wheel>`` of a robot's wheels."""
    return tuple(
        Parameter(f"{prefix}_{name}", unit, low, high, f"{description}, wheel {name}") for name in robot.wheel_names
    )


def of_wheels(robot: Robot, prefix: str, values: Values) -> Array:
    """The values (N,) of the parameters ``prefix_<wheel>``."""
    return np.array([values[f"{prefix}_{name}"] for name in robot.wheel_names])
