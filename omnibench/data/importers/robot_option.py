"""The option of an importer that names the robot: inline, or the path of a YAML file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator

from omnibench.config import read_yaml, validate
from omnibench.robot.kinematics import Robot


def _load(value: Any) -> Any:
    if value in (None, ""):
        raise ValueError("nothing is given; name the robot's YAML file, as robot=robot.yaml")
    if not isinstance(value, str | Path):
        return value
    content = read_yaml(Path(value))
    # A dataset.yaml and a calibration file hold the robot among other things.
    return validate(Robot, content.get("robot", content) if isinstance(content, Mapping) else content, str(value))


RobotOption = Annotated[Robot, BeforeValidator(_load)]
"""A robot as in dataset.yaml, or the path of a YAML file that holds one: by itself, or under the key ``robot`` as a
dataset.yaml or a calibration file does."""
