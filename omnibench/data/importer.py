"""The contract of importers, which turn other people's recordings into data sets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from omnibench.data.dataset import Dataset
from omnibench.registry import Options, importers


class Importer(ABC):
    """Reader of one kind of recording, made with validated options.

    An importer that also reads recordings with scans and without reference poses returns them with ``referenced=False``
    and placeholders for poses (zeros, say). ``import_dataset`` then makes the poses by SLAM; an option ``slam`` (a
    mapping) of the importer holds the options for it.
    """

    Options: ClassVar[type[Options]] = Options
    name: ClassVar[str]

    def __init__(self, options: Any) -> None:
        self.options = options

    @classmethod
    def completed(cls, options: Mapping[str, Any], source: Path) -> dict[str, Any]:
        """The options with those that the source says itself: the robot by ``robot.yaml`` in it or beside it."""
        given = dict(options)
        robots = [folder / "robot.yaml" for folder in (source, source.parent) if (folder / "robot.yaml").is_file()]
        field = cls.Options.model_fields.get("robot")
        if field is not None and field.is_required() and robots:
            given.setdefault("robot", robots[0])
        return given

    @abstractmethod
    def read(self, source: Path) -> Dataset:
        """The recordings under ``source`` as a data set, made with ``make_dataset``.

        DataError in one line: the file, the row, what is wrong.
        """


importers.contract = Importer
