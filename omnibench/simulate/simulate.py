"""Simulation of a data set by the generator that its config names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Discriminator, Tag

from omnibench.errors import CHOSEN, require_type
from omnibench.progress import Reporter, no_progress
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.flower import simulate_flower
from omnibench.simulate.robot_config import RobotConfig
from omnibench.simulate.truth import Simulation

_FLOWER, _ROBOT = CHOSEN + FlowerConfig.__name__, CHOSEN + RobotConfig.__name__


def _generator(config: Any) -> str | None:
    """Tag of the config's class by its key ``generator``; None for an unknown generator."""
    name = config.get("generator", "flower") if isinstance(config, Mapping) else getattr(config, "generator", "flower")
    return {"flower": _FLOWER, "robot": _ROBOT}.get(str(name))


SimulatedConfig = Annotated[
    Annotated[FlowerConfig, Tag(_FLOWER)] | Annotated[RobotConfig, Tag(_ROBOT)],
    Discriminator(
        _generator, custom_error_type="generator", custom_error_message="generator must be 'flower' or 'robot'"
    ),
]


def simulate_dataset(
    config: FlowerConfig | RobotConfig,
    name: str = "flower",
    description: str = "",
    watch: Reporter = no_progress,
) -> Simulation:
    """Simulate the training session and, if there is one, the validation session.

    ConfigError or DataError in one line: an effect of the truth, or a parameter of one, is not known or is missing; a
    command is faster than the motors, or leads out of the room.
    """
    if isinstance(config, FlowerConfig):
        return simulate_flower(config, name, description, watch)
    require_type(config, RobotConfig, "read_simulation(...).config")
    from omnibench.simulate.robot_simulator import simulate_robot  # loads for a second (numba)

    return simulate_robot(config, name, description, watch)
