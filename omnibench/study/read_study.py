"""Reading of a study's config, and telling it from a comparison's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from omnibench.config import read_model, read_yaml
from omnibench.errors import ConfigError, UnknownNameError
from omnibench.study.config import StudyConfig


def is_study(path: Path) -> bool:
    """True if a config names robots, as studies do. ConfigError: the file cannot be read."""
    content = read_yaml(path)
    return isinstance(content, Mapping) and "robots" in content


def read_study_config(path: Path | str, data: Mapping[str, Path] | None = None) -> StudyConfig:
    """Read a study's config; its paths come back absolute.

    data: the folder of the recordings in the place of the config's under the name "", that of one robot under its name.
    ConfigError in one line.
    """
    config = read_model(StudyConfig, Path(path))
    places = dict(data or {})
    base = places.pop("", config.data).resolve()
    robots = dict(config.robots)
    for name, place in places.items():
        if name not in robots:
            raise UnknownNameError("robot", name, robots, f"--data of {path}")
        robots[name] = robots[name].model_copy(update={"path": (str(place.resolve()),)})
    if not base.is_dir() and not all(Path(path).is_absolute() for robot in robots.values() for path in robot.path):
        raise ConfigError(
            f"{path}: the recordings are not at {base}; say where they are with --data DIR (omnibench guide data says "
            "where the public ones come from)"
        )
    return config.model_copy(update={"data": base, "robots": robots})
