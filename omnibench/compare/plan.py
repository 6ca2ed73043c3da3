"""The data sets of a comparison, its runs (data sets x calibrators x seeds), and each run's problem and key."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from omnibench.compare.config import CalibratorEntry, CompareConfig
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.splits import training_split
from omnibench.errors import ConfigError
from omnibench.fit.calibrator import as_answered
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.loss import with_loss
from omnibench.fit.parameterisation import Box, ParameterisationName
from omnibench.fit.problem import CalibrationProblem, make_parameterisation
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
    "data/references/*.py",
    "data/stored/*.py",
    "compare/plan.py",
)
_CALIBRATORS = "fit/calibrators/*.py"
_NO_PART = "fit/check/*.py"  # judges recordings before they are fitted


def run_key(config: CompareConfig, dataset: Dataset, entry: CalibratorEntry, seed: int) -> str:
    """The key of one entry's run on one data set with one seed: it changes with all that the result depends on.

    The code behind a run is what all runs share (``robot/``, ``fit/``, trajectories, the problem that a run is given)
    and the files of the calibrators and the cost that it names. Files in ``fit/calibrators/`` that it does not name are
    left out, so that a new calibrator does not discard the stored runs of the others; none of them imports another.
    """
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


@dataclass(frozen=True)
class RunTask:
    """The part of a run that its worker process is sent: the training data, and nothing of the validation data."""

    config: CompareConfig
    robot: Robot
    trajectories: tuple[Trajectory, ...]
    entry: CalibratorEntry
    parameterisation: ParameterisationName
    box: Box
    seed: int

    def problem(self, watch: Reporter = no_progress) -> CalibrationProblem:
        """The calibration problem; ``watch`` is told the evaluations so far and the best cost."""
        calibrator = calibrators.entry(self.entry.name).cls
        unidentified, mount = as_answered(calibrator, self.config.unidentified, self.config.mount)
        return CalibrationProblem(
            self.robot,
            self.trajectories,
            with_loss(costs.create(self.config.cost.name, self.config.cost.options), self.config.loss),
            make_parameterisation(
                self.parameterisation,
                self.robot,
                self.trajectories,
                box=self.box,
                limits=self.entry.limits,
                unidentified=unidentified,
                mount=mount,
                tolerance=self.config.tolerance,
            ),
            integration=self.config.integration,
            budget=self.config.budget,
            seed=self.seed,
            shrinks=unidentified == "shrink",
            watch=watch,
        )


@dataclass(frozen=True)
class PlannedRun:
    """One run: an entry of the config on one data set with one seed.

    training: the data set's training runs, the same object for all runs on it. box: the entry's box of matrix elements,
    or else the config's; a geometry does not use it. box_name: the name of the bounds that are searched, or
    ``UNBOUNDED``.
    """

    config: CompareConfig
    dataset_name: str
    dataset: Dataset
    training: tuple[Trajectory, ...]
    entry: CalibratorEntry
    label: str
    parameterisation: ParameterisationName
    box: Box
    box_name: str
    seed: int

    @property
    def title(self) -> str:
        """Data set, entry and seed."""
        return f"{self.dataset_name} {self.label} seed {self.seed}"

    @property
    def element_box(self) -> Box | None:
        """The box of matrix elements that is searched; None for a geometry, or an answer without a box."""
        return None if self.parameterisation == "geometry" or self.box_name == UNBOUNDED else self.box

    @property
    def search_space(self) -> SearchSpace:
        """The set of matrices that the run chooses from."""
        limits = (self.entry.limits or GeometryLimits()) if self.parameterisation == "geometry" else self.box
        return SearchSpace(self.parameterisation, limits, self.box_name != UNBOUNDED)

    @property
    def task(self) -> RunTask:
        """The run as its worker process sees it."""
        return RunTask(
            config=self.config.model_copy(update={"datasets": {}}),
            robot=self.dataset.robot,
            trajectories=self.training,
            entry=self.entry,
            parameterisation=self.parameterisation,
            box=self.box,
            seed=self.seed,
        )

    @cached_property
    def key(self) -> str:
        """The key of the run's stored result."""
        return run_key(self.config, self.dataset, self.entry, self.seed)


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
            cls = calibrators.entry(entry.name).cls
            parameterisation = entry.parameterisation or cls.parameterisation
            box = entry.box or config.box
            box_name = _box_name(config, entry, dataset, parameterisation, box)
            label = _label(config, entry, parameterisation, box_name, labels)
            seeds = config.seeds if cls.stochastic else config.seeds[:1]
            plan += [
                PlannedRun(config, name, dataset, training, entry, label, parameterisation, box, box_name, seed)
                for seed in seeds
            ]
    return plan


def _box_name(
    config: CompareConfig, entry: CalibratorEntry, dataset: Dataset, parameterisation: ParameterisationName, box: Box
) -> str:
    if not calibrators.entry(entry.name).cls.bounded:
        return UNBOUNDED
    try:
        searched = make_parameterisation(
            parameterisation, dataset.robot, dataset.split("train"), box=box, limits=entry.limits
        )
        return searched.bounds.name
    except ConfigError as error:
        raise ConfigError(f"config {config.name}: calibrator {entry.name!r}: {error}") from None


def _label(config: CompareConfig, entry: CalibratorEntry, parameterisation: str, box: str, taken: set[str]) -> str:
    """The entry's label, by default its name with the parameterisation or box that is not the usual one."""
    cls = calibrators.entry(entry.name).cls
    label = entry.label or entry.name
    if not entry.label:
        if parameterisation != cls.parameterisation:
            label += f" ({parameterisation})"
        elif entry.box is not None and entry.box != config.box:
            label += f" ({box} box)"
    if label in taken:
        raise ConfigError(f"config {config.name}: two entries are called {label!r}; give one a label of its own")
    taken.add(label)
    return label
