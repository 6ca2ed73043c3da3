"""What an importer is: something that turns other people's recordings into a data set."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from omnibench.data.dataset import Dataset
from omnibench.errors import DataError
from omnibench.registry import Options, importers


class Importer(ABC):
    """Reads one kind of recording. Made with validated options."""

    Options: ClassVar[type[Options]] = Options
    name: ClassVar[str]

    def __init__(self, options: Any) -> None:
        self.options = options

    @abstractmethod
    def read(self, source: Path) -> Dataset:
        """The recordings under ``source`` as a data set, made with ``make_dataset``.

        DataError in one line: the file, the row, what is wrong.
        """


importers.contract = Importer


def import_dataset(name: str, source: Path | str, options: Mapping[str, Any] | None = None) -> Dataset:
    """Read ``source`` with the importer called ``name``. UnknownNameError, ConfigError or DataError in one line."""
    importer: Importer = importers.create(name, options)
    source = Path(source)
    if not source.exists():
        raise DataError(f"{source}: no such file or folder")
    return importer.read(source)
