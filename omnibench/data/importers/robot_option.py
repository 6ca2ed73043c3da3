"""The option of an importer that names the robot: inline, or the path of a YAML file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator

from omnibench.config import read_yaml, validate
from omnibench.errors import ConfigError
from omnibench.robot.kinematics import Robot


def _load(value: Any) -> Any:
    if isinstance(value, str | Path):
        content = read_yaml(Path(value))
        # A dataset.yaml and a calibration file hold the robot among other things.
        inner = content.get("robot", content) if isinstance(content, Mapping) else content
        return validate(Robot, _in_radians(inner), str(value))
    return _in_radians(value)


def _in_radians(robot: Any) -> Any:
    """The robot with ``angle_deg`` of each wheel (degrees) written as ``angle`` (rad)."""
    if not isinstance(robot, Mapping) or not isinstance(robot.get("wheels"), list | tuple):
        return robot
    return {**robot, "wheels": [_wheel_in_radians(wheel) for wheel in robot["wheels"]]}


def _wheel_in_radians(wheel: Any) -> Any:
    if not isinstance(wheel, Mapping) or "angle_deg" not in wheel:
        return wheel
    degrees = wheel["angle_deg"]
    if "angle" in wheel:
        raise ConfigError("robot: give a wheel's angle (rad) or its angle_deg, not both")
    if isinstance(degrees, bool) or not isinstance(degrees, int | float):
        raise ConfigError(f"robot: a wheel's angle_deg must be a number (given: {degrees!r})")
    return {**{key: item for key, item in wheel.items() if key != "angle_deg"}, "angle": math.radians(degrees)}


RobotOption = Annotated[Robot, BeforeValidator(_load)]
"""A robot as in dataset.yaml (each wheel may give ``angle_deg`` in place of ``angle``), or the path of a YAML file that
holds one: by itself, or under the key ``robot`` as a dataset.yaml or a calibration file does."""
