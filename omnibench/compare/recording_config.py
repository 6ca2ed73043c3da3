"""The comparison that is run where a data set is given in the place of a config: every calibrator that suits it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omnibench.compare.config import CompareConfig
from omnibench.compare.result import THEORETICAL_NAME
from omnibench.config import validate
from omnibench.data.dataset import Dataset
from omnibench.data.splits import training_split
from omnibench.data.storage import dataset_folders, in_few_words, load_dataset
from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Calibrator
from omnibench.fit.prior import default_cost
from omnibench.fit.problem import make_parameterisation
from omnibench.registry import Entry, calibrators, load_plugins

_EVALUATIONS, _SECONDS = 10_000, 30.0  # of each run; s; chosen: on two cores a first look takes a minute or two
_LONGEST_NAME = 60  # letters, of a config's name


def recording_config(places: Path | Sequence[Path], plugins: Sequence[Path] = ()) -> CompareConfig:
    """A quick comparison on a data set, with cost and treatment of what is hardly driven as ``calibrate`` has.

    places: its folder, or several, named one by one or by a glob. plugins: folders of plug-ins, whose calibrators
    take part. DataError: the data set cannot be read, or has no run to train. PluginError: a folder of plug-ins is not
    there.
    """
    folders = dataset_folders(places)
    dataset = load_dataset(folders)
    load_plugins(plugins)
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", dataset.name).strip("_.-")[:_LONGEST_NAME] or "dataset"
    paths = [str(folder.resolve()) for folder in folders]
    content: dict[str, Any] = {
        "name": name,
        "datasets": {name: {"path": paths if len(paths) > 1 else paths[0]}},
        "cost": default_cost(dataset.robot, len(training_split(dataset))),
        "budget": {"evaluations": _EVALUATIONS, "seconds": _SECONDS},
        "calibrators": suitable_calibrators(dataset),
        "plugins": [str(path.resolve()) for path in plugins],
    }
    return validate(CompareConfig, content, f"comparison on {in_few_words(folders)}")


def suitable_calibrators(dataset: Dataset) -> list[str]:
    """Names of the registered calibrators that can fit a data set's robot, the design values first.

    A matrix that is not fitted, such as a published one, is another robot's and is left out.
    """
    entries = [entry for entry in calibrators.entries() if _suits(entry, dataset)]
    return [THEORETICAL_NAME, *(entry.name for entry in entries if entry.name != THEORETICAL_NAME)]


def config_in_words(config: CompareConfig) -> str:
    """What such a comparison runs, in a sentence."""
    names = ", ".join(entry.name for entry in config.calibrators)
    return (
        f"no config is given: {names}; cost {config.cost.name}, at most {config.budget.evaluations:,} evaluations and "
        f"{config.budget.seconds:g} s each, one seed (config.yaml beside the results says all of it)"
    )


def _suits(entry: Entry[Calibrator], dataset: Dataset) -> bool:
    calibrator = entry.cls
    if not calibrator.fitted or not calibrators.create(entry.name).applies(dataset.robot):
        return False
    try:
        make_parameterisation(calibrator.parameterisation, dataset.robot, training_split(dataset))
    except ConfigError:  # this robot has no such parameters
        return False
    return True
