"""The data sets of a comparison, its runs (data sets x calibrators x seeds), and each run's problem and key."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Protocol

from omnibench.compare.config import CompareConfig
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.splits import training_split
from omnibench.errors import ConfigError
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.parameterisation import Box, ParameterisationName
from omnibench.fit.problem import CalibrationProblem, make_parameterisation, make_problem
from omnibench.fit.settings import CompleteSettings
from omnibench.jobs.job import code_digest, content_key
from omnibench.progress import Reporter, no_progress
from omnibench.registry import calibrators, costs
from omnibench.robot.kinematics import Robot

_PACKAGE = Path(__file__).parents[1]
# Files that every run depends on; ** takes in subfolders.
_SHARED = (
    "robot/**/*.py",
    "fit/**/*.py",
    "data/dataset.py",
    "data/references.py",
    "data/parquet.py",
    "data/stored.py",
    "compare/plan.py",
)
_CALIBRATORS = "fit/calibrators/*.py"
_NO_PART = "check/*.py"  # judges recordings before they are fitted


def run_key(settings: CompleteSettings, dataset: Dataset) -> str:
    """The key of one run on one data set: it changes with all that the result depends on.

    The code behind a run is what all runs share (``robot/``, ``fit/``, trajectories, the problem that a run is given)
    and the files of the calibrators and the cost that it names. Files in ``fit/calibrators/`` that it does not name are
    left out, so that a new calibrator does not discard the stored runs of the others; none of them imports another.
    """
    # Hash of the code of the calibrator, of the calibrators that its options name, of the cost, and of their bases
    named = {settings.calibrator, *(value for value in settings.options.values() if isinstance(value, str))}
    classes = [known.cls for known in calibrators.entries() if known.name in named]
    classes.append(costs.entry(settings.cost.name).cls)
    modules = {sys.modules.get(base.__module__) for cls in classes for base in cls.__mro__}
    digest = hashlib.sha256()
    for name in sorted({name for cls in classes for name in getattr(cls, "uses", ())}):
        digest.update(_code_of(name).encode())
    for file in sorted({file for module in modules if (file := getattr(module, "__file__", None))}):
        digest.update(hashlib.sha256(Path(file).read_bytes()).digest())
    code = digest.hexdigest() + _shared_code()
    return content_key({"data": dataset.hash, "settings": settings, "code": code})


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


# ``box_name`` of a calibrator whose answer does not depend on a box.
UNBOUNDED = "none"


@dataclass(frozen=True)
class SearchSpace:
    """A set of matrices to choose from: equal where two runs searched the same set.

    limits: the box of the matrix elements, or the limits of the geometry. bounded: False where the answer does not
    keep to them.
    """

    parameterisation: ParameterisationName
    limits: Box | GeometryLimits
    bounded: bool


class RunConfig(Protocol):
    """The part of a comparison's or a study's config that says how runs are made."""

    @property
    def plugins(self) -> tuple[Path, ...]: ...
    @property
    def timing(self) -> bool: ...
    @property
    def memory_mb(self) -> float | None: ...


@dataclass(frozen=True)
class RunTask:
    """The part of a run that its worker process is sent: the training data, and nothing of the validation data.

    plugins: folders of plug-ins to load first. timing: True if the machine's speed is to be measured beside the run.
    """

    settings: CompleteSettings
    robot: Robot
    trajectories: tuple[Trajectory, ...]
    plugins: tuple[Path, ...]
    timing: bool


@dataclass(frozen=True)
class PlannedRun:
    """One run: an entry of the config on one data set with one seed.

    config: where the run's plug-ins, timing and memory are from. training: the data set's training runs, the same
    object for all runs on it. settings: of the fit; a geometry does not use their box. box_name: the name of the bounds
    that are searched, or ``UNBOUNDED``.
    """

    config: RunConfig
    dataset_name: str
    dataset: Dataset
    training: tuple[Trajectory, ...]
    settings: CompleteSettings
    label: str
    box_name: str

    @property
    def title(self) -> str:
        """Data set, entry and seed."""
        return f"{self.dataset_name} {self.label} seed {self.settings.seed}"

    @property
    def element_box(self) -> Box | None:
        """The box of matrix elements that is searched; None for a geometry, or an answer without a box."""
        searched = self.settings.parameterisation != "geometry" and self.box_name != UNBOUNDED
        return self.settings.box if searched else None

    @property
    def search_space(self) -> SearchSpace:
        """The set of matrices that the run chooses from."""
        settings = self.settings
        limits = (settings.limits or GeometryLimits()) if settings.parameterisation == "geometry" else settings.box
        return SearchSpace(settings.parameterisation, limits, self.box_name != UNBOUNDED)

    @property
    def task(self) -> RunTask:
        """The run as its worker process sees it."""
        config = self.config
        return RunTask(self.settings, self.dataset.robot, self.training, config.plugins, config.timing)

    def problem(self) -> CalibrationProblem:
        """The run's calibration problem."""
        return make_problem(self.settings, self.dataset.robot, self.training)

    @cached_property
    def key(self) -> str:
        """The key of the run's stored result."""
        return run_key(self.settings, self.dataset)


def load_datasets(config: CompareConfig, progress: Reporter = no_progress) -> dict[str, Dataset]:
    """Read, import or simulate every data set. DataError when one has no training data."""
    datasets = {}
    for name, source in config.datasets.items():
        datasets[name] = source.load(name, config.description, progress)
        training_split(datasets[name])
    return datasets


def make_plan(config: CompareConfig, datasets: Mapping[str, Dataset]) -> list[PlannedRun]:
    """Data sets x calibrators x seeds; a calibrator without randomness runs once. ConfigError for a bad box."""
    plan = []
    for name, dataset in datasets.items():
        labels: set[str] = set()
        training = dataset.split("train")
        for entry in config.calibrators:
            settings = config.settings(entry, config.seeds[0])
            try:
                box_name = name_of_bounds(settings, dataset.robot, training)
            except ConfigError as error:
                raise ConfigError(f"config {config.name}: calibrator {entry.name!r}: {error}") from None
            # The entry's label, by default its name with the parameterisation or box that is not the usual one
            cls = calibrators.entry(entry.name).cls
            label = entry.label or entry.name
            if not entry.label:
                if settings.parameterisation != cls.parameterisation:
                    label += f" ({settings.parameterisation})"
                elif entry.box is not None and entry.box != config.box:
                    label += f" ({box_name} box)"
            if label in labels:
                raise ConfigError(
                    f"config {config.name}: two entries are called {label!r}; give one a label of its own"
                )
            labels.add(label)
            seeds = config.seeds if calibrators.entry(entry.name).cls.stochastic else config.seeds[:1]
            plan += [
                PlannedRun(config, name, dataset, training, settings.model_copy(update={"seed": seed}), label, box_name)
                for seed in seeds
            ]
    return plan


def name_of_bounds(settings: CompleteSettings, robot: Robot, training: Sequence[Trajectory]) -> str:
    """The name of the bounds that a fit searches, or ``UNBOUNDED``. ConfigError: the robot has no such parameters."""
    if not calibrators.entry(settings.calibrator).cls.bounded:
        return UNBOUNDED
    box, limits = settings.box, settings.limits
    return make_parameterisation(settings.parameterisation, robot, training, box=box, limits=limits).bounds.name
