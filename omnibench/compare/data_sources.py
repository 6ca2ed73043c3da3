"""The data sets of a comparison: read from a folder, imported or simulated."""

from __future__ import annotations

from omnibench.compare.config import CompareConfig
from omnibench.data.dataset import Dataset
from omnibench.data.progress import ProgressCallback, no_progress
from omnibench.fit.problem import training_split


def load_datasets(config: CompareConfig, progress: ProgressCallback = no_progress) -> dict[str, Dataset]:
    """Read, import or simulate every data set. DataError when one has no training data."""
    datasets = {}
    for name, source in config.datasets.items():
        datasets[name] = source.load(name, config.description, progress)
        training_split(datasets[name])
    return datasets
