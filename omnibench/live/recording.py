"""A recording to replay: a data set's folder, or a comparison's config whose simulated data set is made on the spot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from omnibench.config import Model, read_yaml, validate
from omnibench.data.dataset import Dataset
from omnibench.data.simulate.config import FlowerConfig
from omnibench.data.simulate.flower import TruthRecord, simulate_dataset
from omnibench.data.storage import load_dataset
from omnibench.errors import ConfigError, UnknownNameError


@dataclass(frozen=True, eq=False)
class Recording:
    """A data set and, where it was simulated on the spot, what is hidden from it."""

    dataset: Dataset
    truth: TruthRecord | None = None


class _Source(Model):
    """What a comparison says of one data set; only ``simulate`` is used here."""

    path: Any = None
    simulate: FlowerConfig | None = None
    import_: Any = Field(default=None, alias="import")


class _Config(BaseModel):
    """The data sets of a comparison's config; the rest of it does not matter here."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    datasets: dict[str, _Source]


def load_recording(path: Path, dataset: str | None = None) -> Recording:
    """The data set in a folder, or the simulated one of a comparison's config, with its truth.

    dataset: which one, if the config has several. ConfigError or DataError in one line when there is no such thing.
    """
    path = Path(path)
    if not path.exists():
        raise ConfigError(f"{path}: no such file or folder; name a data set folder or a comparison's config")
    if not path.is_dir():
        return _simulated(path, dataset)
    if dataset is not None:
        raise ConfigError(f"--dataset {dataset}: {path} is a folder with one data set; leave --dataset out")
    return Recording(load_dataset(path))


def _simulated(path: Path, name: str | None) -> Recording:
    content = read_yaml(path)
    if not isinstance(content, dict) or "datasets" not in content:
        raise ConfigError(f"{path}: no data sets in it; name a data set folder or a comparison's config")
    sources = validate(_Config, content, str(path)).datasets
    simulated = {key: source.simulate for key, source in sources.items() if source.simulate is not None}
    if name is not None and name in sources and name not in simulated:
        raise ConfigError(f"{path}: data set {name!r} is not simulated; name its folder in place of the config")
    if name is not None and name not in simulated:
        raise UnknownNameError("simulated data set", name, simulated, str(path))
    if not simulated:
        raise ConfigError(f"{path}: no simulated data set in it; name the folder of a data set")
    if name is None and len(simulated) > 1:
        known = ", ".join(sorted(simulated))
        raise ConfigError(f"{path}: several simulated data sets; choose one with --dataset: {known}")
    name = name or next(iter(simulated))
    simulation = simulate_dataset(simulated[name], name, str(content.get("description") or ""))
    return Recording(simulation.dataset, simulation.truth)
