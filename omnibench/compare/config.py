"""The config of a comparison, as its YAML file says it, and as it is once every default is written out."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, Field, field_validator

from omnibench.config import Model, Positive, RelativePath, printable, read_model, validate
from omnibench.data.dataset import Split
from omnibench.errors import ConfigError, OmnibenchError, PluginError, UnknownNameError
from omnibench.fit.calibrator import as_answered, unloadable
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.intervals import Bootstrap
from omnibench.fit.loss import LossName
from omnibench.fit.parameterisation import Box, ParameterisationName
from omnibench.fit.prior import MountChoice
from omnibench.fit.settings import Budget, CompleteSettings, CostChoice, FitSettings, objective_in_words
from omnibench.fit.span import Unidentified
from omnibench.jobs.backend_choice import name_flaw
from omnibench.jobs.job import TlsFiles
from omnibench.registry import PluginFailure, calibrators, costs, load_plugins, plugin_text
from omnibench.robot.odometry import Integration
from omnibench.simulate.source import DatasetSource

LEAST_MEMORY = 256.0  # 10^6 bytes; a worker process has 200 MB before its run begins (measured, RLIMIT_DATA)


def with_names(entries: Any, key: str) -> Any:
    """The entries of a list, those that are a name alone as a mapping from ``key``; the model refuses unknown ones."""
    if isinstance(entries, list | tuple):
        return [{key: entry} if isinstance(entry, str) else entry for entry in entries]
    return entries


def known_backend(backend: str) -> str:
    """The name of a backend. ValueError: it is none's."""
    if flaw := name_flaw(backend):
        raise ValueError(flaw)
    return backend


def _is_squares(loss: object) -> bool:
    """True for the default, which files do not say, so that those of earlier versions stay as they were."""
    return loss == "squares"


class CalibratorEntry(Model):
    """One entry of the comparison: a calibrator with its options."""

    name: str = Field(description="a calibrator, see omnibench list")
    label: Annotated[str, Field(min_length=1, max_length=60), AfterValidator(printable)] | None = Field(
        None, description="what tables call it; default: the name and, if it differs, the box"
    )
    options: dict[str, Any] = {}
    parameterisation: ParameterisationName | None = Field(None, description="default: the calibrator's own")
    box: Box | None = Field(None, description="default: the config's box")
    limits: GeometryLimits | None = Field(None, description="limits of the geometry parameterisation; default: its own")

    def settings(self, common: FitSettings) -> CompleteSettings:
        """The settings of the entry's fit: those common to a comparison, with its own and its calibrator's."""
        entry = calibrators.entry(self.name)
        calibrator = entry.cls
        assert common.unidentified is not None  # a comparison says it
        unidentified, mount = as_answered(calibrator, common.unidentified, common.mount)
        of_entry = {
            "calibrator": entry.name,
            "options": self.options,
            "parameterisation": self.parameterisation or calibrator.parameterisation,
            "box": self.box or common.box,
            "limits": self.limits,
            "unidentified": unidentified,
            "mount": mount,
        }
        return CompleteSettings(**(dict(common) | of_entry))


class CertificateChoice(Model):
    """Precision to which the lowest possible cost in each box is to be proven."""

    gap: float = Field(1e-3, gt=0, lt=1, description="share of the lowest cost that may stay unproven")
    seconds: float = Field(10.0, gt=0, description="time for each box; what is proven by then is reported")
    parts: int | None = Field(None, gt=0, description="most parts of each box, the same on every machine")


class PublishedResult(Model):
    """A result from the literature, on other data, that tables show beside ours."""

    label: str
    source: str
    theoretical_train_cost: Positive
    train_cost: Positive
    train_improvement: float | None = Field(None, lt=1, description="as printed, 0.826 for 82.6 %; default: by costs")
    theoretical_validation_cost: Positive | None = None
    validation_cost: Positive | None = None
    validation_improvement: float | None = Field(None, lt=1, description="as printed; default: by costs")
    seconds: Positive | None = Field(None, description="time of the published calibration, s")
    entry: str | None = Field(None, description="label of the entry that is the same method")
    remarks: tuple[str, ...] = Field((), description="what a reader of these figures must know")

    def costs(self, split: Split) -> tuple[float, float] | None:
        """Costs of the design values and of the calibration on a split; None where one of them was not published."""
        if split == "train":
            return self.theoretical_train_cost, self.train_cost
        if self.theoretical_validation_cost is None or self.validation_cost is None:
            return None
        return self.theoretical_validation_cost, self.validation_cost

    def improvement(self, split: Split) -> float | None:
        """Share of the cost of the design values that was saved: as printed, or else from the costs as printed."""
        printed = self.train_improvement if split == "train" else self.validation_improvement
        costs = self.costs(split)
        return printed if printed is not None or costs is None else 1 - costs[1] / costs[0]


class NamedConfig(Model):
    """Name and remarks of a comparison or a study."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=60)
    description: str = ""
    notes: tuple[str, ...] = Field((), description="what a reader of the report must know")


class CompareConfig(NamedConfig):
    """A comparison: data sets x calibrators x seeds, with one cost and one budget for all."""

    datasets: dict[Annotated[str, Field(min_length=1, max_length=60)], DatasetSource] = Field(min_length=1)
    cost: CostChoice = CostChoice()
    loss: LossName = Field(
        "squares",
        description="of the cost's pose errors when they are fitted: as each calibrator takes them (squares), or one "
        "that bounds the influence of poses that are far off, its scale estimated",
        exclude_if=_is_squares,
    )
    integration: Integration = "arc"
    box: Box = "row"
    unidentified: Unidentified = Field(
        "keep",
        description="what the data hardly tell: keep the design values of motions that they hardly drive, or fit these "
        "to slip and noise; map weighs all against the design",
    )
    mount: MountChoice | None = Field(
        None, description="tracked point of a robot that cannot slide: known, or fitted; default: by the robot's class"
    )
    tolerance: Positive | None = Field(
        None, description="of the design, share of each row's largest element, for map; default: the robot class's"
    )
    budget: Budget = Budget()
    seeds: tuple[int, ...] = Field((1,), min_length=1, description="one run of every search for each")
    calibrators: tuple[CalibratorEntry, ...] = Field(min_length=1)
    plugins: tuple[RelativePath, ...] = Field((), description="folders of plug-ins; relative to the config file")
    workers: int | None = Field(None, gt=0, strict=True, description="processes; default: the processors")
    backend: Annotated[str, AfterValidator(known_backend)] = Field(
        "processes",
        description="where runs are made: processes, dask, or a scheduler of Dask: tcp://HOST:PORT, tls://...",
    )
    tls: TlsFiles | None = Field(None, description="files for a scheduler at tls://; relative to the config file")
    timing: bool = Field(True, description="no: the runs' seconds are not compared, and may be those of a busy machine")
    memory_mb: float | None = Field(
        None, ge=LEAST_MEMORY, description="memory of each run's process, 10^6 bytes; default: no limit"
    )
    bootstrap: Bootstrap = Bootstrap()
    certificate: CertificateChoice | None = Field(CertificateChoice(), description="null: prove nothing")
    published_results: tuple[PublishedResult, ...] = ()

    @property
    def objective(self) -> str:
        """The names of the cost and of its loss, if it has a robust one."""
        return objective_in_words(self.cost, self.loss)

    def settings(self, entry: CalibratorEntry, seed: int) -> CompleteSettings:
        """The settings of an entry's fit."""
        names = ("cost", "loss", "box", "integration", "budget", "unidentified", "tolerance", "mount")
        return entry.settings(FitSettings(seed=seed, **{name: getattr(self, name) for name in names}))

    @field_validator("calibrators", mode="before", json_schema_input_type=tuple[str | CalibratorEntry, ...])
    @classmethod
    def _names_stand_for_entries(cls, entries: Any) -> Any:
        return with_names(entries, "name")

    @field_validator("cost", mode="before", json_schema_input_type=str | CostChoice)
    @classmethod
    def _name_stands_for_cost(cls, cost: Any) -> Any:
        return {"name": cost} if isinstance(cost, str) else cost

    @field_validator("seeds")
    @classmethod
    def _seeds_differ(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(seeds)) < len(seeds):
            raise ValueError("a seed is given twice")
        if not all(0 <= seed < 2**63 for seed in seeds):
            raise ValueError("seeds must not be negative, and below 2^63")
        return seeds


def load_calibrators(plugins: Iterable[Path], names: Iterable[str]) -> list[PluginFailure]:
    """Load a config's plug-ins. The runs of one that cannot be imported fail with its error, the others run.

    names: the calibrators that the config names.
    """
    failures = load_plugins(plugins)
    missing = set(names) - {entry.name for entry in calibrators.entries()}
    for failure in failures:
        for name in missing & _names_in(Path(failure.origin)):
            calibrators.register(name)(unloadable(failure))
            missing.remove(name)
    return failures


def _names_in(plugin: Path) -> set[str]:
    """Calibrators that a plug-in file would register: the file's name, and names in its text."""
    text = plugin_text(plugin)
    return {plugin.stem, *re.findall(r"""calibrators\s*\.\s*register\(\s*["']([^"']+)["']""", text)}


def effective_config(config: CompareConfig) -> CompareConfig:
    """The config with every default of every option written out. Refuses unknown names and options."""
    cost = effective_cost(config.cost, f"config {config.name}")
    entries = []
    for index, entry in enumerate(config.calibrators):
        place = f"config {config.name}: calibrators.{index}"
        options = effective_options(entry.name, entry.options, place)
        entries.append(entry.model_copy(update={"options": options.model_dump(mode="json")}))
    return config.model_copy(update={"calibrators": tuple(entries), "cost": cost})


def effective_cost(choice: CostChoice, place: str) -> CostChoice:
    """A cost with every default of its options. Errors begin with ``place``: an unknown name or option."""
    options = costs.create(choice.name, choice.options, place).options
    return choice.model_copy(update={"options": options.model_dump(mode="json")})


def effective_options(name: str, given: Mapping[str, Any], place: str) -> BaseModel:
    """The options of a calibrator with every default. ConfigError begins with ``place``: an unknown name or option."""
    calibrator = calibrators.entry(name, place)
    options = validate(calibrator.options, given, f"{place}: calibrator {name!r}")
    try:
        calibrators.create(name, given)  # a constructor may check its options further
    except PluginError:
        pass  # reported as the outcome of its run
    except OmnibenchError as error:
        raise ConfigError(f"{place}: {error}") from None
    return options


def read_compare_config(path: Path | str, data: Mapping[str, Path] | None = None) -> CompareConfig:
    """Read a config; paths in it are relative to its folder and come back absolute.

    ``data`` replaces the sources of data sets by name; the name "" stands for the only one. ConfigError in one line.
    """
    path = Path(path)
    config = read_model(CompareConfig, path)
    sources = dict(config.datasets)
    for name, location in (data or {}).items():
        if not name and len(sources) > 1:
            raise ConfigError(f"--data: {path} has several data sets; say which: --data NAME={location}")
        name = name or next(iter(sources))
        if name not in sources:
            raise UnknownNameError("data set", name, sources, str(path))
        sources[name] = sources[name].at(location.resolve())
    return config.model_copy(update={"datasets": sources})
