"""Reading a comparison's config file: its paths made absolute, its data sets replaced by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omnibench.compare.config import CompareConfig, DatasetSource
from omnibench.config import read_model
from omnibench.errors import ConfigError, UnknownNameError


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
        sources[name] = _relocated(sources[name], location.resolve())
    folder = path.resolve().parent
    return config.model_copy(
        update={
            "datasets": {name: _absolute(source, folder) for name, source in sources.items()},
            "plugins": tuple((folder / plugin).resolve() for plugin in config.plugins),
        }
    )


def _relocated(source: DatasetSource, location: Path) -> DatasetSource:
    """The source with its data at ``location``: a data set folder, or recordings for the same importer."""
    if source.import_ is not None and not (location / "dataset.yaml").is_file():
        return source.model_copy(update={"import_": source.import_.model_copy(update={"source": location})})
    return DatasetSource(path=location)


def _absolute(source: DatasetSource, folder: Path) -> DatasetSource:
    """The source with its paths, which are relative to ``folder``, made absolute."""
    if source.path is not None:
        return source.model_copy(update={"path": (folder / source.path).resolve()})
    if source.import_ is not None:
        update = {
            "source": (folder / source.import_.source).resolve(),
            "options": {key: _absolute_option(value, folder) for key, value in source.import_.options.items()},
        }
        return source.model_copy(update={"import_": source.import_.model_copy(update=update)})
    return source


def _absolute_option(value: Any, folder: Path) -> Any:
    """An importer's option; a text that names an existing file beside the config becomes that file's absolute path."""
    if isinstance(value, str) and value and not value.isnumeric() and (folder / value).is_file():
        return str((folder / value).resolve())
    return value
