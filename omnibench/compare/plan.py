"""From a config to data sets and a list of runs."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from omnibench.compare.config import CalibratorEntry, CompareConfig, DatasetSource
from omnibench.config import read_model, validate
from omnibench.data.dataset import Dataset
from omnibench.data.progress import ProgressCallback, no_progress
from omnibench.data.storage import load_dataset
from omnibench.errors import ConfigError, OmnibenchError, PluginError, UnknownNameError
from omnibench.fit.calibrator import unloadable
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.problem import make_parameterisation, training_split
from omnibench.registry import PluginFailure, calibrators, costs, load_plugins
from omnibench.simulate.simulate import simulate_dataset
from omnibench.slam.import_dataset import import_dataset


@dataclass(frozen=True)
class PlannedRun:
    """One run: an entry of the config on one data set with one seed."""

    config: CompareConfig
    dataset_name: str
    dataset: Dataset
    entry: CalibratorEntry
    label: str
    parameterisation: ParameterisationName
    box: str
    seed: int

    @cached_property
    def key(self) -> str:
        """Names the run's result: changes with anything that the result depends on, the code too."""
        facts = {
            "data": self.dataset.hash,
            "cost": self.config.cost.model_dump(mode="json"),
            "integration": self.config.integration,
            "calibrator": self.entry.model_dump(mode="json", exclude={"label"}),
            "box": self.config.box if isinstance(self.config.box, str) else self.config.box.model_dump(mode="json"),
            "budget": self.config.budget.model_dump(mode="json"),
            "seed": self.seed,
            "code": _code(self.entry, self.config.cost.name),
        }
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:20]


def read_compare_config(path: Path | str, data: Mapping[str, Path] | None = None) -> CompareConfig:
    """The config at ``path`` with its paths, which are relative to it, made absolute.

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
        sources[name] = _relocated(sources[name], location.resolve())
    folder = path.resolve().parent
    return config.model_copy(
        update={
            "datasets": {name: _anchored(source, folder) for name, source in sources.items()},
            "plugins": tuple((folder / plugin).resolve() for plugin in config.plugins),
        }
    )


def load_calibrators(config: CompareConfig) -> list[PluginFailure]:
    """Load the config's plug-ins. One that cannot be imported fails in its row, and the others run."""
    failures = load_plugins(config.plugins)
    missing = {entry.name for entry in config.calibrators} - {entry.name for entry in calibrators.entries()}
    for failure in failures:
        for name in missing & _names_in(Path(failure.origin)):
            calibrators.register(name)(unloadable(failure))
            missing.remove(name)
    return failures


def _names_in(plugin: Path) -> set[str]:
    """The names under which a plug-in file would register calibrators: its own, and those that its text registers."""
    text = plugin.read_text(encoding="utf-8", errors="replace") if plugin.is_file() else ""
    return {plugin.stem, *re.findall(r"""calibrators\s*\.\s*register\(\s*["']([^"']+)["']""", text)}


def load_datasets(config: CompareConfig, watch: ProgressCallback = no_progress) -> dict[str, Dataset]:
    """Read, import or simulate every data set. DataError when one has no training data."""
    loaded = {}
    for name, source in config.datasets.items():
        loaded[name] = load_source(name, source, config.description, watch)
        training_split(loaded[name])
    return loaded


def load_source(
    name: str, source: DatasetSource, description: str = "", watch: ProgressCallback = no_progress
) -> Dataset:
    """One data set from its source."""
    if source.simulate is not None:
        return simulate_dataset(source.simulate, name, description, watch).dataset
    if source.import_ is not None:
        return import_dataset(source.import_.format, source.import_.source, source.import_.options)
    assert source.path is not None  # one of the three is given
    return load_dataset(source.path)


def effective_config(config: CompareConfig) -> CompareConfig:
    """The config with every default of every option written out. Refuses unknown names and options."""
    cost = config.cost
    cost_options = costs.create(cost.name, cost.options, f"config {config.name}").options
    entries = []
    for index, entry in enumerate(config.calibrators):
        place = f"config {config.name}: calibrators.{index}"
        options = _effective_options(entry, place)
        entries.append(entry.model_copy(update={"options": options.model_dump(mode="json")}))
    return config.model_copy(
        update={
            "calibrators": tuple(entries),
            "cost": cost.model_copy(update={"options": cost_options.model_dump(mode="json")}),
        }
    )


def _effective_options(entry: CalibratorEntry, place: str) -> BaseModel:
    known = calibrators.entry(entry.name, place)
    options = validate(known.options, entry.options, f"{place}: calibrator {entry.name!r}")
    try:
        calibrators.create(entry.name, entry.options)  # some look at their options once more
    except PluginError:
        pass  # its run fails in its row
    except OmnibenchError as error:
        raise ConfigError(f"{place}: {error}") from None
    return options


def make_plan(config: CompareConfig, datasets: Mapping[str, Dataset]) -> list[PlannedRun]:
    """Data sets x calibrators x seeds; a calibrator without randomness runs once. ConfigError for a bad box."""
    plan = []
    for name, dataset in datasets.items():
        labels: set[str] = set()
        for entry in config.calibrators:
            cls = calibrators.entry(entry.name).cls
            parameterisation = entry.parameterisation or cls.parameterisation
            box = _box_name(config, entry, dataset, parameterisation)
            label = _label(config, entry, parameterisation, box, labels)
            seeds = config.seeds if cls.stochastic else config.seeds[:1]
            plan += [PlannedRun(config, name, dataset, entry, label, parameterisation, box, seed) for seed in seeds]
    return plan


# The box of a calibrator whose answer does not depend on it.
UNBOUNDED = "none"


def _box_name(
    config: CompareConfig, entry: CalibratorEntry, dataset: Dataset, parameterisation: ParameterisationName
) -> str:
    if not calibrators.entry(entry.name).cls.bounded:
        return UNBOUNDED
    try:
        searched = make_parameterisation(
            parameterisation,
            dataset.robot,
            dataset.split("train"),
            box=entry.box or config.box,
            limits=entry.limits,
        )
        return searched.bounds.name
    except ConfigError as error:
        raise ConfigError(f"config {config.name}: calibrator {entry.name!r}: {error}") from None


def _label(config: CompareConfig, entry: CalibratorEntry, parameterisation: str, box: str, taken: set[str]) -> str:
    cls = calibrators.entry(entry.name).cls
    label = entry.label or entry.name
    if not entry.label:
        if parameterisation != cls.parameterisation:
            label += f" ({parameterisation})"
        elif entry.box is not None and entry.box != config.box:
            label += f" ({box} box)"
    if label in taken:
        raise ConfigError(f"config {config.name}: two entries are called {label!r}; give one a label of its own")
    taken.add(label)
    return label


def _relocated(source: DatasetSource, location: Path) -> DatasetSource:
    if source.import_ is not None and not (location / "dataset.yaml").is_file():
        return source.model_copy(update={"import_": source.import_.model_copy(update={"source": location})})
    return DatasetSource(path=location)


def _anchored(source: DatasetSource, folder: Path) -> DatasetSource:
    if source.path is not None:
        return source.model_copy(update={"path": (folder / source.path).resolve()})
    if source.import_ is not None:
        anchored = {
            "source": (folder / source.import_.source).resolve(),
            "options": {key: _anchored_value(value, folder) for key, value in source.import_.options.items()},
        }
        return source.model_copy(update={"import_": source.import_.model_copy(update=anchored)})
    return source


def _anchored_value(value: Any, folder: Path) -> Any:
    """An importer's option; one that names a file beside the config means that file, wherever one stands."""
    if isinstance(value, str) and value and not value.isnumeric() and (folder / value).is_file():
        return str((folder / value).resolve())
    return value


def _code(entry: CalibratorEntry, cost: str) -> str:
    """Hash of the code behind a run: what all share, the calibrator's file, its search's and the cost's."""
    named = {entry.name, *(value for value in entry.options.values() if isinstance(value, str))}
    classes = [known.cls for known in calibrators.entries() if known.name in named] + [costs.entry(cost).cls]
    modules = [sys.modules.get(cls.__module__) for cls in classes]
    files = {file for module in modules if (file := getattr(module, "__file__", None))}
    return _digest(sorted(Path(file) for file in files)) + _shared_code()


@cache
def _shared_code() -> str:
    package = Path(__file__).parents[1]
    return _digest(sorted([*package.glob("robot/**/*.py"), *package.glob("fit/**/*.py")]))


def _digest(files: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()
