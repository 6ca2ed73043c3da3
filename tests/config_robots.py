"""The robots of the configs that bring one on fixed, steered or mecanum wheels, and their simulations."""

from typing import Any

import yaml
from commands import CONFIGS

from omnibench.config import validate
from omnibench.robot.kinematics import Robot
from omnibench.simulate.config import EncoderNoise, FlowerConfig

NAMES = ("diff", "skid", "tricycle", "car", "swerve", "mecanum")
QUIET = dict.fromkeys(EncoderNoise.model_fields, 0.0)


def settings(name: str) -> dict[str, Any]:
    """What the config called ``name`` says under ``simulate``."""
    content: dict[str, Any] = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())["datasets"][name]["simulate"]
    return content


def apr02_settings(**changes: Any) -> dict[str, Any]:
    """What the config of the articles' benchmark says under ``simulate``, changed."""
    content: dict[str, Any] = yaml.safe_load((CONFIGS / "apr02.yaml").read_text())
    return {**content["datasets"]["flower"]["simulate"], **changes}


def apr02(**changes: Any) -> FlowerConfig:
    return validate(FlowerConfig, apr02_settings(**changes), "flower.yaml")


def robot(name: str, **changes: Any) -> Robot:
    return Robot.model_validate(settings(name)["robot"] | changes)


def experiment(name: str, **changes: Any) -> FlowerConfig:
    """One quiet run of each command of a config."""
    quiet = {"noise": QUIET, "repetitions": 1, "validation": None, "order": "sorted"}
    return validate(FlowerConfig, settings(name) | quiet | changes, f"{name}.yaml")
