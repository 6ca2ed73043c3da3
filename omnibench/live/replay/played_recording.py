"""A recording to replay: a data set's folder, or a comparison's config, whose data set is simulated when loaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from omnibench.data.dataset import Dataset
from omnibench.data.storage import load_whole
from omnibench.data.true_poses import TruePath
from omnibench.errors import ConfigError
from omnibench.progress import Reporter, no_progress
from omnibench.registry import load_plugins
from omnibench.simulate.source import read_simulation
from omnibench.simulate.truth import TruthRecord


@dataclass(frozen=True, eq=False)
class Recording:
    """A data set and, if it was simulated when loaded, its truth.

    paths: run -> true poses, for robots whose true motion does not follow from the wheels' set points alone.
    """

    dataset: Dataset
    truth: TruthRecord | None = None
    paths: Mapping[str, TruePath] = field(default_factory=dict)


def load_recording(path: Path, dataset: str | None = None, watch: Reporter = no_progress) -> Recording:
    """The data set in a folder, or the simulated one of a comparison's config, with its truth.

    dataset: name of the data set if the config has several. ConfigError or DataError in one line: it does not exist.
    """
    path = Path(path)
    if not path.exists():
        raise ConfigError(f"{path}: no such file or folder; name a data set folder or a comparison's config")
    if not path.is_dir():
        source = read_simulation(path, dataset)
        load_plugins(source.effect_plugins, installed=False)
        simulation = source.simulate(watch)
        return Recording(simulation.dataset, simulation.truth, simulation.paths)
    if dataset is not None:
        raise ConfigError(f"--dataset {dataset}: {path} is a folder with one data set; leave --dataset out")
    return Recording(load_whole(path))
