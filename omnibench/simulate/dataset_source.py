"""The source of a data set in a config: a folder, recordings to import, or a simulation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ConfigDict, Field, ValidationInfo, field_validator, model_validator

from omnibench.config import Model, RelativePath, folder_of
from omnibench.data.dataset import Dataset
from omnibench.data.storage import load_dataset
from omnibench.progress import Reporter, no_progress
from omnibench.simulate.simulate import SimulatedConfig, simulate_dataset
from omnibench.slam.import_dataset import import_dataset


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
