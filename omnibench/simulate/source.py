"""Simulated data sets that the YAML of a comparison, or of a simulation alone, describes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from pydantic import ConfigDict, Field

from omnibench.config import Model, RelativePath, parse_yaml, read_yaml, validate
from omnibench.errors import ConfigError, UnknownNameError
from omnibench.progress import Reporter, no_progress
from omnibench.registry import effects
from omnibench.robot.calibration import EffectTerm
from omnibench.robot.odometry import Integration
from omnibench.simulate.config import FlowerConfig, Truth
from omnibench.simulate.dataset_source import DatasetSource
from omnibench.simulate.robot_config import RobotConfig
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.simulation import Simulation
from omnibench.views import Brief


class SimulationConfig(Model):
    """Config of simulated data sets alone."""

    name: str = ""
    description: str = ""
    notes: tuple[str, ...] = Field((), description="remarks for readers of the report")
    plugins: tuple[RelativePath, ...] = Field((), description="folders of effects; relative to the config file")
    datasets: dict[Annotated[str, Field(min_length=1, max_length=60)], DatasetSource] = Field(min_length=1)


class ComparedData(SimulationConfig):
    """Part of a comparison's config that simulations and designs take: data sets, and the integration of odometry."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    integration: Integration = "arc"


@dataclass(frozen=True, repr=False)
class SimulationSource(Brief):
    """A simulated data set of a config. plugins: folders of plug-ins that its effects may come from."""

    name: str
    config: FlowerConfig | RobotConfig
    description: str = ""
    plugins: tuple[Path, ...] = ()

    @property
    def effect_plugins(self) -> tuple[Path, ...]:
        """The folders of plug-ins, if the data set has effects."""
        return self.plugins if self.config.truth.effects else ()

    def with_effects(self, given: Sequence[str]) -> SimulationSource:
        """A copy with more effects, each as YAML ``name: {parameter: value}``. ConfigError names the wrong one."""
        if not given:
            return self
        truth = self.config.truth
        terms = [*truth.effects, *map(_effect, given)]
        changed = validate(Truth, {**truth.model_dump(), "effects": terms}, "--effect")
        return replace(self, config=self.config.model_copy(update={"truth": changed}))

    def simulate(self, watch: Reporter = no_progress) -> Simulation:
        """Simulate the data set. ConfigError or DataError as for ``simulate_dataset``."""
        return simulate_dataset(self.config, self.name, self.description, watch)


def read_simulation(path: Path | str, dataset: str | None = None) -> SimulationSource:
    """The simulated data set in the YAML of a comparison or of a simulation.

    dataset: its name, needed if there are several. ConfigError in one line when there is no such data set.
    """
    path = Path(path)
    content = read_yaml(path)
    if not isinstance(content, dict) or "datasets" not in content:
        raise ConfigError(f"{path}: no data sets in it; name a data set folder or a comparison's config")
    model = ComparedData if "calibrators" in content else SimulationConfig
    config = validate(model, content, str(path), path.resolve().parent)
    sources = {name: source.simulate for name, source in config.datasets.items()}
    name, chosen = _chosen(sources, dataset, str(path))
    return SimulationSource(name, chosen, config.description, config.plugins)


def check_effect_options(given: Sequence[str]) -> None:
    """Raise UnknownNameError for an ``--effect`` that is not known; to be called once the plug-ins are loaded."""
    for text in given:
        effects.entry(_effect(text).name, f"--effect {text}")


def _chosen(
    sources: Mapping[str, FlowerConfig | RobotConfig | None], name: str | None, place: str
) -> tuple[str, FlowerConfig | RobotConfig]:
    simulated = {key: config for key, config in sources.items() if config is not None}
    if name is not None and name in sources and name not in simulated:
        raise ConfigError(f"{place}: data set {name!r} is not simulated; name its folder in place of the config")
    if name is not None and name not in simulated:
        raise UnknownNameError("simulated data set", name, simulated, place)
    if not simulated:
        raise ConfigError(f"{place}: no simulated data set in it; name the folder of a data set")
    if name is None and len(simulated) > 1:
        known = ", ".join(sorted(simulated))
        raise ConfigError(f"{place}: several simulated data sets; choose one with --dataset: {known}")
    name = name or next(iter(simulated))
    return name, simulated[name]


def _effect(text: str) -> EffectTerm:
    place = f"--effect {text}"
    content = parse_yaml(text, place)
    if isinstance(content, dict) and len(content) == 1:
        ((name, parameters),) = content.items()
        if isinstance(parameters, dict):
            return validate(EffectTerm, {"name": name, "parameters": parameters}, place)
    raise ConfigError(f"{place}: expected 'name: {{parameter: value}}'")
