"""The data sets of a comparison: read from a folder, imported or simulated."""

from __future__ import annotations

from omnibench.compare.config import CompareConfig, DatasetSource
from omnibench.data.dataset import Dataset
from omnibench.data.progress import ProgressCallback, no_progress
from omnibench.data.storage import load_dataset
from omnibench.fit.problem import training_split
from omnibench.simulate.simulate import simulate_dataset
from omnibench.slam.import_dataset import import_dataset


def load_datasets(config: CompareConfig, progress: ProgressCallback = no_progress) -> dict[str, Dataset]:
    """Read, import or simulate every data set. DataError when one has no training data."""
    loaded = {}
    for name, source in config.datasets.items():
        loaded[name] = load_source(name, source, config.description, progress)
        training_split(loaded[name])
    return loaded


def load_source(
    name: str, source: DatasetSource, description: str = "", progress: ProgressCallback = no_progress
) -> Dataset:
    """Read, import or simulate one data set."""
    if source.simulate is not None:
        return simulate_dataset(source.simulate, name, description, progress).dataset
    if source.import_ is not None:
        return import_dataset(source.import_.format, source.import_.source, source.import_.options)
    assert source.path is not None  # one of the three is given
    return load_dataset(source.path)
