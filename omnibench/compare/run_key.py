"""The key of a run's stored result: it changes with everything that the result depends on, the code included.

The code behind a run is what all runs share (``robot/``, ``fit/``, trajectories, the problem that a run is given) and
the files of the calibrators and the cost that it names. Files in ``fit/calibrators/`` that it does not name are left
out, so that a new calibrator does not discard the stored runs of the others; none of them imports another.
"""

from __future__ import annotations

import hashlib
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from omnibench.compare.config import CalibratorEntry, CompareConfig
from omnibench.data.dataset import Dataset
from omnibench.jobs.result_store import code_digest, content_key
from omnibench.registry import calibrators, costs

_PACKAGE = Path(__file__).parents[1]
# Files that every run depends on; ** takes in subfolders.
_SHARED = (
    "robot/**/*.py",
    "fit/**/*.py",
    "data/dataset.py",
    "data/references/*.py",
    "data/stored/*.py",
    "compare/plan.py",
)
_CALIBRATORS = "fit/calibrators/*.py"
_NO_PART = "fit/check/*.py"  # judges recordings before they are fitted


def run_key(config: CompareConfig, dataset: Dataset, entry: CalibratorEntry, seed: int) -> str:
    """The key of one entry's run on one data set with one seed."""
    return content_key(
        {
            "data": dataset.hash,
            "cost": config.cost,
            **({} if config.loss == "squares" else {"loss": config.loss}),
            "integration": config.integration,
            "unidentified": config.unidentified,
            "mount": config.mount,
            "tolerance": config.tolerance,
            "calibrator": entry.model_dump(mode="json", exclude={"label"}),
            "box": config.box,
            "budget": config.budget,
            "seed": seed,
            "code": named_code(entry, config.cost.name) + _shared_code(),
        }
    )


def shared_code(package: Path) -> str:
    """Hash of the code that every run uses: paths and contents of the files in ``package``, an omnibench folder."""
    files = {file for pattern in _SHARED for file in package.glob(pattern)} - {
        *package.glob(_CALIBRATORS),
        *package.glob(_NO_PART),
    }
    return code_digest(package, files)


@cache
def _shared_code() -> str:
    return shared_code(_PACKAGE)


def named_code(entry: CalibratorEntry, cost: str) -> str:
    """Hash of the code of the calibrator, of the calibrators that its options name, of the cost, and of their bases."""
    named = {entry.name, *(value for value in entry.options.values() if isinstance(value, str))}
    classes = [known.cls for known in calibrators.entries() if known.name in named] + [costs.entry(cost).cls]
    modules = {sys.modules.get(base.__module__) for cls in classes for base in cls.__mro__}
    digest = hashlib.sha256()
    for name in sorted({name for cls in classes for name in getattr(cls, "uses", ())}):
        digest.update(_code_of(name).encode())
    for file in sorted({file for module in modules if (file := getattr(module, "__file__", None))}):
        digest.update(hashlib.sha256(Path(file).read_bytes()).digest())
    return digest.hexdigest()


def _code_of(name: str) -> str:
    """Hash of a file or a room of the package, as ``discover``; the version of another package."""
    place = _PACKAGE / name
    if place.is_dir():
        return code_digest(_PACKAGE, set(place.rglob("*.py")))
    if place.is_file():
        return code_digest(_PACKAGE, {place})
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
