"""Simulated data sets that the YAML of a comparison, or of a simulation alone, describes.

Simulation of a data set by the generator that its config names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Discriminator, Field, Tag, ValidationInfo, field_validator, model_validator

from omnibench.config import Model, RelativePath, folder_of, parse_yaml, read_yaml, validate
from omnibench.data.dataset import Dataset
from omnibench.data.storage import load_dataset
from omnibench.errors import CHOSEN, ConfigError, UnknownNameError, require_type
from omnibench.progress import Reporter, no_progress
from omnibench.registry import effects
from omnibench.robot.calibration import EffectTerm
from omnibench.robot.odometry import Integration
from omnibench.simulate.config import FlowerConfig, Truth
from omnibench.simulate.robot_config import RobotConfig
from omnibench.simulate.robot_simulator import simulate_flower
from omnibench.simulate.truth import Simulation
from omnibench.slam.import_dataset import import_dataset
from omnibench.views import Brief

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


class ImportSource(Model):
    """Recordings that an importer reads."""

    format: str = Field(description="an importer, see omnibench list")
    source: RelativePath = Field(description="file or folder; relative to the config file")
    options: dict[str, Any] = {}

    @field_validator("options")
    @classmethod
    def _files_start_from_the_config(cls, options: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        folder = folder_of(info)
        return {key: value if folder is None else _absolute_option(value, folder) for key, value in options.items()}


class DatasetSource(Model):
    """Source of a data set: exactly one of the three keys is given."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_by_name=True, validate_by_alias=True)

    path: RelativePath | tuple[RelativePath, ...] | None = Field(
        None, description="a data set folder, a glob or a list of them; relative to the config file"
    )
    simulate: SimulatedConfig | None = None
    import_: ImportSource | None = Field(default=None, alias="import")

    @model_validator(mode="after")
    def _one_is_given(self) -> DatasetSource:
        given = [n for n, v in (("path", self.path), ("simulate", self.simulate), ("import", self.import_)) if v]
        if len(given) != 1:
            raise ValueError(f"give one of path, simulate, import (given: {', '.join(given) or 'none'})")
        return self

    def at(self, location: Path) -> DatasetSource:
        """The source with its data at ``location``: a data set folder, or recordings for the same importer."""
        if self.import_ is not None and not (location / "dataset.yaml").is_file():
            return self.model_copy(update={"import_": self.import_.model_copy(update={"source": location})})
        return DatasetSource(path=location)

    def load(self, name: str, description: str = "", progress: Reporter = no_progress) -> Dataset:
        """Read, import or simulate the data set. name, description: of a simulated one. OmnibenchError in one line."""
        if self.simulate is not None:
            return simulate_dataset(self.simulate, name, description, progress).dataset
        if self.import_ is not None:
            return import_dataset(self.import_.format, self.import_.source, self.import_.options)
        assert self.path is not None  # one of the three is given
        return load_dataset(self.path)


def _absolute_option(value: Any, folder: Path) -> Any:
    """An importer's option; a text that names an existing file beside the config becomes that file's absolute path."""
    if isinstance(value, str) and value and not value.isnumeric() and (folder / value).is_file():
        return str((folder / value).resolve())
    return value


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
    simulated = {key: config for key, config in sources.items() if config is not None}
    if dataset is not None and dataset in sources and dataset not in simulated:
        raise ConfigError(f"{path}: data set {dataset!r} is not simulated; name its folder in place of the config")
    if dataset is not None and dataset not in simulated:
        raise UnknownNameError("simulated data set", dataset, simulated, str(path))
    if not simulated:
        raise ConfigError(f"{path}: no simulated data set in it; name the folder of a data set")
    if dataset is None and len(simulated) > 1:
        known = ", ".join(sorted(simulated))
        raise ConfigError(f"{path}: several simulated data sets; choose one with --dataset: {known}")
    name = dataset or next(iter(simulated))
    return SimulationSource(name, simulated[name], config.description, config.plugins)


def check_effect_options(given: Sequence[str]) -> None:
    """Raise UnknownNameError for an ``--effect`` that is not known; to be called once the plug-ins are loaded."""
    for text in given:
        effects.entry(_effect(text).name, f"--effect {text}")


def _effect(text: str) -> EffectTerm:
    place = f"--effect {text}"
    content = parse_yaml(text, place)
    if isinstance(content, dict) and len(content) == 1:
        ((name, parameters),) = content.items()
        if isinstance(parameters, dict):
            return validate(EffectTerm, {"name": name, "parameters": parameters}, place)
    raise ConfigError(f"{place}: expected 'name: {{parameter: value}}'")
