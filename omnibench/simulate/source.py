"""Simulated data sets: those that the YAML of a comparison, or of a simulation alone, describes; recordings simulated
again, with their own wheel samples and reference poses by a calibration's model; and both written into a folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Discriminator, Field, Tag, ValidationInfo, field_validator, model_validator

from omnibench.config import Model, RelativePath, folder_of, parse_yaml, read_yaml, to_json, to_yaml, validate
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.domain_check import extrapolation_warning
from omnibench.data.storage import check_dataset_folder, load_dataset, save_dataset
from omnibench.data.true_poses import POSES_FILE, TRUTH_FILE, write_true_poses
from omnibench.errors import CHOSEN, ConfigError, DataError, UnknownNameError, require_type
from omnibench.files import TableFormat, refuse_existing, remove, resolved, write_text
from omnibench.progress import Reporter, no_progress
from omnibench.registry import effects
from omnibench.robot.calibration import Calibration, EffectTerm, read_calibration
from omnibench.robot.odometry import Integration
from omnibench.simulate.config import FlowerConfig, RobotConfig, Truth
from omnibench.simulate.robot_simulator import simulate_flower, simulate_robot
from omnibench.simulate.truth import Simulation, reference_noise
from omnibench.slam.import_dataset import import_dataset
from omnibench.slam.slam_dataset import SlamAccuracy, slam_accuracy
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


def simulate_like(dataset: Dataset, calibration: Calibration, noise_seed: int | None = None) -> Dataset:
    """The runs of a data set with poses by a calibration's model, from each run's recorded start pose on.

    Everything else (stamps, wheel samples, splits, sessions) is as recorded, so that both can be compared run by run.
    noise_seed: seed of the calibration's noise of the reference, which is added; None: poses without noise. Warnings
    include motions that the calibration's effects were not fitted to. DataError in one line: the calibration is for
    another robot or has no noise, or the recording lacks what one of its effects needs.
    """
    calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
    reported = calibration.model.reported([run.log(run.pose_times) for run in dataset.trajectories])
    poses = [np.vstack([run.start, path[1:]]) for run, path in zip(dataset.trajectories, reported, strict=True)]
    how = "without noise"
    if noise_seed is not None:
        noise = calibration.noise
        if noise is None or not any(noise.model_dump().values()):
            raise DataError(
                f"calibration {calibration.name!r} has no noise of the reference; leave --noise out, or calibrate with "
                "trajectory_ml, which estimates it"
            )
        rng = np.random.default_rng(noise_seed)
        stamps = [run.pose_times for run in dataset.trajectories]
        poses = [path + reference_noise(noise, times, rng) for path, times in zip(poses, stamps, strict=True)]
        how = f"with its noise, seed {noise_seed}"
    names = ", ".join(term.name for term in calibration.effects)
    model = f"calibration {calibration.name}" + (f" with {names}" if names else "")
    how_made = f"Simulated like {dataset.name} by {model}, {how}: its wheels, and poses as the model has them."
    recorded = f" ({dataset.source})" if dataset.source else ""
    runs = zip(dataset.trajectories, poses, strict=True)
    simulated = make_dataset(
        dataset.name,
        dataset.robot,
        dataset.sample_period,
        [replace(run, poses=path, pose_covariances=None) for run, path in runs],
        description=f"{how_made} {dataset.description}".strip(),
        source=f"simulated by omnibench from the wheels of {dataset.name}{recorded}",
        licence=dataset.licence,
        simulated=True,
    )
    warnings = [extrapolation_warning(calibration, dataset.trajectories)]
    if dataset.scans is not None:
        warnings.append("the recording's scans are left out: they show where its robot was")
    return replace(simulated, warnings=(*simulated.warnings, *filter(None, warnings)))


ACCURACY_FILE = "slam_accuracy.json"


@dataclass(frozen=True)
class WrittenSimulation:
    """A data set that was written. simulation: with its truth, if it came from a config. accuracy: of SLAM."""

    dataset: Dataset
    simulation: Simulation | None = None
    accuracy: SlamAccuracy | None = None


class SimulationRequest(Model):
    """What ``omnibench simulate`` was asked for: either ``config``, or ``like`` with ``model``.

    ConfigError in one line: options that exclude each other.
    """

    output: Path
    config: Path | None = None
    truth: Path | None = Field(
        None, description="Folder for the truth: matrix, effects, true poses. Default: not written."
    )
    dataset: str | None = Field(None, description="Name of the data set, if the config has several.")
    effect: tuple[str, ...] = Field((), description="Add an effect, 'name: {parameter: value}'; may be repeated.")
    like: Path | None = Field(None, description="Instead of CONFIG: drive this data set's recorded wheel rates.")
    model: Path | None = Field(None, description="With --like: the true model, a calibration file.")
    noise: bool = Field(False, description="With --like: add the noise that the calibration states.")
    seed: int | None = Field(None, ge=0, description="With --noise: its seed. Default: 0.")
    force: bool = False

    @model_validator(mode="after")
    def _go_together(self) -> SimulationRequest:
        if self.like is None and self.model is None:
            if self.config is None:
                raise ConfigError("name a CONFIG with a simulated data set, or --like DATASET --model CALIBRATION")
            why = "is for --like; a config has its own noise and seeds"
            _refuse({"--noise": self.noise or None, "--seed": self.seed}, why)
        elif self.like is None:
            raise ConfigError(f"--model {self.model}: say with --like DATASET which recording it is to drive again")
        elif self.model is None:
            raise ConfigError(f"--like {self.like}: say with --model CALIBRATION by which model")
        else:
            of_configs: dict[str, object] = {f"CONFIG {self.config}": self.config, "--truth": self.truth}
            of_configs |= {"--dataset": self.dataset, "--effect": self.effect or None}
            _refuse(of_configs, "does not go with --like, which takes all from the recording and the calibration")
            if self.seed is not None and not self.noise:
                raise ConfigError("--seed: is for --noise, which is not asked for; add --noise, or leave --seed out")
            if resolved(self.output) == resolved(self.like):
                raise ConfigError(f"-o {self.output}: is the recording itself; name another folder")
        if self.truth is not None and resolved(self.truth).is_relative_to(resolved(self.output)):
            raise ConfigError("--truth: must be a folder apart from the data set's")
        return self

    @cached_property
    def source(self) -> SimulationSource:
        """The config's data set, with the effects. ConfigError as for ``read_simulation``."""
        assert self.config is not None
        return read_simulation(self.config, self.dataset).with_effects(self.effect)

    @property
    def plugins(self) -> tuple[Path, ...]:
        """Folders of plug-ins that the config's effects may come from."""
        return () if self.config is None else self.source.effect_plugins

    def write(self, table_format: TableFormat = "parquet", watch: Reporter = no_progress) -> WrittenSimulation:
        """Simulate and write the data set; write the truth to its own folder, if one is named.

        OmnibenchError in one line: the config, the recording or the calibration is wrong, files are there already, or
        the disk refuses.
        """
        check_dataset_folder(self.output)
        refuse_existing(self.output, force=self.force, folders=True)
        if self.truth is not None:
            truths = [self.truth / name for name in (TRUTH_FILE, POSES_FILE, ACCURACY_FILE)]
            refuse_existing(*truths, force=self.force)
        if self.like is not None and self.model is not None:
            calibration = read_calibration(self.model)
            dataset = simulate_like(load_dataset(self.like), calibration, (self.seed or 0) if self.noise else None)
            save_dataset(dataset, self.output, table_format, overwrite=self.force)
            return WrittenSimulation(dataset)
        check_effect_options(self.effect)
        simulation = self.source.simulate(watch)
        save_dataset(simulation.dataset, self.output, table_format, overwrite=self.force)
        accuracy = slam_accuracy(simulation.dataset, simulation.paths) if simulation.paths else None
        if self.truth is not None:
            write_text(self.truth / TRUTH_FILE, to_yaml(simulation.truth))
            if accuracy is None:
                for name in (POSES_FILE, ACCURACY_FILE):  # an earlier truth's
                    remove(self.truth / name)
            else:
                write_true_poses(self.truth, simulation.paths)
                write_text(self.truth / ACCURACY_FILE, to_json(accuracy) + "\n")
        return WrittenSimulation(simulation.dataset, simulation, accuracy)


def _refuse(options: Mapping[str, object], why: str) -> None:
    for name, value in options.items():
        if value is not None:
            raise ConfigError(f"{name}: {why}; leave it out")
