"""Reading of a source with an importer, by its own options and by those that every recording takes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omnibench.data.dataset import Dataset
from omnibench.data.importer import Importer
from omnibench.data.importers.dataset_folder import DatasetOptions, read_again
from omnibench.registry import importers


def importer_of(name: str, source: Path, options: Mapping[str, Any]) -> tuple[Importer, dict[str, Any]]:
    """The importer called ``name`` with its options, completed by the source; and the options that it does not have.

    These are options of ``import dataset``, as if the data set that it gives was imported again. UnknownNameError,
    ConfigError or DataError in one line.
    """
    entry = importers.entry(name)
    others = DatasetOptions.model_fields.keys() - entry.options.model_fields.keys()
    again = {key: value for key, value in options.items() if key in others}
    own = {key: value for key, value in options.items() if key not in again}
    importer: Importer = importers.create(name, entry.cls.completed(own, source))
    return importer, again


def read_dataset(importer: Importer, source: Path, again: Mapping[str, Any]) -> Dataset:
    """The data set of a source, read again by options that its importer does not have.

    Its poses are placeholders where they must be made of scans. ConfigError or DataError in one line.
    """
    dataset = importer.read(source)
    return read_again(dataset, again, f"importer {importer.name!r}") if again else dataset
