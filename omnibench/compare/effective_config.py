"""A config's names resolved: plug-ins loaded, unknown names refused, every option with its default."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from omnibench.compare.config import CompareConfig, CostChoice
from omnibench.config import validate
from omnibench.errors import ConfigError, OmnibenchError, PluginError
from omnibench.fit.calibrator import unloadable
from omnibench.registry import PluginFailure, calibrators, costs, load_plugins, plugin_text


def load_calibrators(plugins: Iterable[Path], names: Iterable[str]) -> list[PluginFailure]:
    """Load a config's plug-ins. The runs of one that cannot be imported fail with its error, the others run.

    names: the calibrators that the config names.
    """
    failures = load_plugins(plugins)
    missing = set(names) - {entry.name for entry in calibrators.entries()}
    for failure in failures:
        for name in missing & _names_in(Path(failure.origin)):
            calibrators.register(name)(unloadable(failure))
            missing.remove(name)
    return failures


def _names_in(plugin: Path) -> set[str]:
    """Calibrators that a plug-in file would register: the file's name, and names in its text."""
    text = plugin_text(plugin)
    return {plugin.stem, *re.findall(r"""calibrators\s*\.\s*register\(\s*["']([^"']+)["']""", text)}


def effective_config(config: CompareConfig) -> CompareConfig:
    """The config with every default of every option written out. Refuses unknown names and options."""
    cost = effective_cost(config.cost, f"config {config.name}")
    entries = []
    for index, entry in enumerate(config.calibrators):
        place = f"config {config.name}: calibrators.{index}"
        options = effective_options(entry.name, entry.options, place)
        entries.append(entry.model_copy(update={"options": options.model_dump(mode="json")}))
    return config.model_copy(update={"calibrators": tuple(entries), "cost": cost})


def effective_cost(choice: CostChoice, place: str) -> CostChoice:
    """A cost with every default of its options. Errors begin with ``place``: an unknown name or option."""
    options = costs.create(choice.name, choice.options, place).options
    return choice.model_copy(update={"options": options.model_dump(mode="json")})


def effective_options(name: str, given: Mapping[str, Any], place: str) -> BaseModel:
    """The options of a calibrator with every default. ConfigError begins with ``place``: an unknown name or option."""
    calibrator = calibrators.entry(name, place)
    options = validate(calibrator.options, given, f"{place}: calibrator {name!r}")
    try:
        calibrators.create(name, given)  # a constructor may check its options further
    except PluginError:
        pass  # reported as the outcome of its run
    except OmnibenchError as error:
        raise ConfigError(f"{place}: {error}") from None
    return options
