"""Reading a comparison's config file: its paths made absolute, its data sets replaced by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from omnibench.compare.config import CompareConfig
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
        sources[name] = sources[name].at(location.resolve())
    return config.model_copy(update={"datasets": sources})
