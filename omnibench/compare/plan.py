"""The fits of a comparison: robots x trainings x regimes x folds x entries x seeds; each one's problem and key.

A training divides a robot's runs: which train, fold by fold, and which judge. A data set has one, its own split.
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from omnibench.compare import config as choices
from omnibench.compare.config import AS_RECORDED, CalibratorEntry, CompareConfig, RegimeChoice
from omnibench.data.dataset import SPLITS, Dataset, Trajectory, repetitions
from omnibench.data.splits import training_split
from omnibench.errors import ConfigError, DataError, OmnibenchError, PluginError, nearest
from omnibench.fit.calibrator import refusal_of
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.parameterisation import Box, ParameterisationName
from omnibench.fit.problem import CalibrationProblem, make_parameterisation, make_problem
from omnibench.fit.settings import CompleteSettings
from omnibench.jobs.job import code_digest, content_key
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import calibrators, costs
from omnibench.robot.kinematics import Robot, interpolated
from omnibench.words import plural

_PACKAGE = Path(__file__).parents[1]
# Files that every run depends on; ** takes in subfolders.
_SHARED = (
    *("robot/**/*.py", "fit/**/*.py", "compare/plan.py"),
    *("data/dataset.py", "data/references.py", "data/parquet.py", "data/stored.py"),
)
_CALIBRATORS = "fit/calibrators/*.py"
_NO_PART = "check/*.py"  # judges recordings before they are fitted


def fit_key(settings: CompleteSettings, dataset: Dataset) -> str:
    """The key of one fit to one data set: it changes with all that the result depends on.

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
    # What a calibrator says that it uses: a file or a room of the package, as discover, or another package
    for name in sorted({name for cls in classes for name in getattr(cls, "uses", ())}):
        place = _PACKAGE / name
        files = set(place.rglob("*.py")) if place.is_dir() else {place} if place.is_file() else set()
        try:
            used = code_digest(_PACKAGE, files) if files else version(name)
        except PackageNotFoundError:
            used = "not installed"
        digest.update(used.encode())
    for file in sorted({file for module in modules if (file := getattr(module, "__file__", None))}):
        digest.update(hashlib.sha256(Path(file).read_bytes()).digest())
    code = digest.hexdigest() + _shared_code(_PACKAGE)
    return content_key({"data": dataset.hash, "settings": settings, "code": code})


def shared_code(package: Path) -> str:
    """Hash of the code that every run uses: paths and contents of the files in ``package``, an omnibench folder."""
    files = {file for pattern in _SHARED for file in package.glob(pattern)} - {
        *package.glob(_CALIBRATORS),
        *package.glob(_NO_PART),
    }
    return code_digest(package, files)


_shared_code = cache(shared_code)


# ``box_name`` of a calibrator whose answer does not depend on a box.
UNBOUNDED = "none"


@dataclass(frozen=True)
class FitTask:
    """The part of a fit that its worker process is sent: the training data, and nothing of the validation data.

    plugins: folders of plug-ins to load first. timing: True if the machine's speed is to be measured beside the run.
    """

    settings: CompleteSettings
    robot: Robot
    trajectories: tuple[Trajectory, ...]
    plugins: tuple[Path, ...]
    timing: bool


def in_regime(runs: Sequence[Trajectory], regime: RegimeChoice, seed: int) -> tuple[Trajectory, ...]:
    """The training runs under a regime. Chance hangs on the seed and each run's content alone.

    Runs without poses are only reduced in number. The first pose of a run is noisy, too, but stays at t = 0.
    """
    kept = runs
    if regime.runs_per_command is not None:
        numbers = repetitions([run.command or run.id for run in runs])
        kept = [run for run, number in zip(runs, numbers, strict=True) if number <= regime.runs_per_command]
    return tuple(_worsened(run, regime, seed) if run.has_poses else run for run in kept)


def _worsened(run: Trajectory, regime: RegimeChoice, seed: int) -> Trajectory:
    poses = run.poses
    if regime.clock_offset or regime.clock_drift:  # what is stamped t was taken at t - (offset + drift t)
        offset, drift = _chance(run, seed, "clock").normal(0.0, [regime.clock_offset, regime.clock_drift])
        taken = np.clip(run.pose_times - offset - drift * run.pose_times, 0.0, run.pose_times[-1])
        poses = interpolated(taken, run.pose_times, run.poses)
    rng = _chance(run, seed, "noise")
    deviations = [regime.noise_position, regime.noise_position, math.radians(regime.noise_heading_deg)]
    if any(deviations):
        poses = poses + rng.normal(0.0, deviations, poses.shape)
    if regime.outlier_share:
        rng = _chance(run, seed, "outliers")
        far = rng.random(len(poses)) < regime.outlier_share
        directions = rng.uniform(0.0, 2 * math.pi, len(poses))
        away = regime.outlier_size * np.column_stack([np.cos(directions), np.sin(directions)])
        poses = poses + np.where(far[:, None], np.column_stack([away, np.zeros(len(poses))]), 0.0)
    return run if poses is run.poses else replace(run, poses=poses)


def _chance(run: Trajectory, seed: int, what: str) -> np.random.Generator:
    digest = hashlib.sha256(f"{run.fingerprint} {what}".encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "big")])


OWN_SPLIT = "own split"  # the training by the data set's own split
ONE_KIND = "all paths"  # the kind of every run, where the config names none


@dataclass(frozen=True, eq=False)
class Fold:
    """One training set. training: its runs. judged: by kind, the indices of the data set's runs that judge it.

    session: of the training runs, where they are of one. fitted: the kind of the training runs, whose own errors are
    training errors.
    """

    name: str
    training: tuple[Trajectory, ...]
    judged: Mapping[str, Sequence[int]]
    session: str | None = None
    fitted: Mapping[str, Sequence[int]] | None = None


@dataclass(frozen=True, eq=False)
class Training:
    """A rule of division applied to a robot's runs: one fold, or one for each session or command."""

    name: str
    folds: tuple[Fold, ...]

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds that it is judged on, in the order of the folds."""
        return tuple(dict.fromkeys(kind for fold in self.folds for kind, runs in fold.judged.items() if runs))


def divide(
    dataset: Dataset, robot: choices.RobotChoice, rules: Sequence[choices.TrainingChoice], place: str
) -> tuple[Training, ...]:
    """The trainings of a robot's runs; those that nothing judges are left out.

    place: what messages begin with. ConfigError: a run is of two kinds, a rule names an unknown kind, or two rules give
    the same training. DataError: no run is of a kind, or names its session, or is left to judge by.
    """
    runs = dataset.trajectories
    # Indices of the runs by kind, in the order of the kinds' first runs
    of_kind: dict[str, list[int]] = {} if robot.kinds else {ONE_KIND: list(range(len(runs)))}
    for index, run in enumerate(runs):
        mine = [kind for kind, patterns in robot.kinds.items() if _named(run.id, patterns)]
        if len(mine) > 1:
            raise ConfigError(f"{place}: run {run.id} is of kinds {' and '.join(mine)}; make the patterns differ")
        for kind in mine:
            of_kind.setdefault(kind, []).append(index)
    for kind, patterns in robot.kinds.items():
        if kind not in of_kind:
            found = ", ".join(run.id for run in runs[:4])
            raise DataError(f"{place}: no run is of kind {kind} ({', '.join(patterns)}); runs are: {found}, ...")
    trainings: dict[str, Training] = {}
    for rule in rules:
        for kind in rule.kinds:
            if kind not in of_kind:
                hint = nearest(kind, of_kind)
                raise ConfigError(f"{place}: no kind {kind!r} to train on; {hint}known: {', '.join(of_kind)}")
        if "session" in (rule.by, rule.leave_out) and not all(run.session for run in runs):
            raise DataError(
                f"{place}: some runs name no session, by which they are to be divided; name them, or divide by kind"
            )
        for name, folds in _divisions(runs, of_kind, rule):
            if name in trainings:
                raise ConfigError(f"{place}: two trainings are {name!r}; leave one out")
            training = Training(name, tuple(folds))
            if training.kinds:
                trainings[name] = training
    if not trainings:
        raise DataError(f"{place}: no run is left to judge by; give it another training")
    return tuple(trainings.values())


_ByKind = Mapping[str, Sequence[int]]  # indices of runs by kind


def _divisions(
    runs: Sequence[Trajectory], of_kind: _ByKind, rule: choices.TrainingChoice
) -> Iterator[tuple[str, Sequence[Fold]]]:
    """The trainings of a rule, by name, with their folds."""
    everything = sorted(index for indices in of_kind.values() for index in indices)

    def fold(
        training: Sequence[int], name: str = "", *, among: Sequence[int] = everything, unused: Sequence[int] = (),
        session: str | None = None, fitted: _ByKind | None = None,
    ) -> Fold:  # fmt: skip
        """A fold that all runs of ``among`` judge which are neither in training, nor unused, nor copies of such."""
        used = {*training, *unused}
        copies = {runs[index].fingerprint for index in used}
        judging = {index for index in set(among) - used if runs[index].fingerprint not in copies}
        judged = {kind: tuple(index for index in indices if index in judging) for kind, indices in of_kind.items()}
        return Fold(name, tuple(runs[index] for index in training), judged, session, fitted)

    def grouped(what: str) -> dict[str, list[int]]:
        """The members of a kind by session or command; runs without one are a group each."""
        groups: dict[str, list[int]] = {}
        for index in members:
            groups.setdefault(getattr(runs[index], what) or runs[index].id, []).append(index)
        return groups

    if rule.by == "split":
        fitted = {kind: [i for i in indices if runs[i].split == "train"] for kind, indices in of_kind.items()}
        training = [index for index in everything if runs[index].split == "train"]
        folds = [fold(training, fitted={kind: mine for kind, mine in fitted.items() if mine})]
        yield OWN_SPLIT, folds if training else ()
        return
    for kind in rule.kinds or of_kind:
        members = of_kind[kind]
        if rule.leave_out == "kind":
            training = [index for index in everything if index not in members]
            yield f"all but {kind}", [fold(training)] if training else ()
        elif rule.leave_out is not None:
            groups = grouped(rule.leave_out)
            rest = {name: [index for index in members if index not in group] for name, group in groups.items()}
            folds = [fold(rest[name], f"without {name}", among=group) for name, group in groups.items()]
            folds = [each for each in folds if each.judged[kind]]
            yield f"{kind}, a {rule.leave_out} left out", folds if len(groups) > 1 else ()
        elif rule.by == "session":
            sessions = grouped("session")
            yield f"{kind}, one session", [fold(group, name, session=name) for name, group in sessions.items()]
        elif not rule.runs_per_command:
            yield kind, [fold(members, fitted={kind: members})]
        else:  # a learning curve: the first runs of each command train, and what never trains judges
            numbers = repetitions([runs[index].command or runs[index].id for index in members])
            first = {
                count: [index for index, number in zip(members, numbers, strict=True) if number <= count]
                for count in sorted({min(count, max(numbers, default=0)) for count in rule.runs_per_command})
            }
            for count, training in first.items():
                curve = fold(training, unused=first[max(first)], fitted={kind: training})
                yield f"{kind}, {plural(count, 'run')} a command", [curve]


@dataclass(frozen=True, eq=False)
class ComparedRobot:
    """A robot, or a data set, with its runs and how they are divided."""

    name: str
    dataset: Dataset
    trainings: tuple[Training, ...]


@dataclass(frozen=True, eq=False)
class PlannedFit:
    """One fit: an entry of the config on the training runs of a fold, in a regime, with one seed.

    dataset: what the key names, with the training runs ``training_runs``, the same object for all fits to them.
    settings: of the fit; a geometry does not use their box. box_name: the name of the bounds that are searched, or
    ``UNBOUNDED``. refusal: why the entry cannot be asked; empty where it can.
    """

    config: CompareConfig
    robot: ComparedRobot
    training: Training
    fold: Fold
    regime: str
    entry: CalibratorEntry
    dataset: Dataset
    training_runs: tuple[Trajectory, ...]
    settings: CompleteSettings
    label: str
    box_name: str
    refusal: str = ""

    @property
    def title(self) -> str:
        """Robot, training and fold where there are several, regime, entry and seed."""
        training = "" if self.config.datasets else f"{self.training.name} {self.fold.name}".strip() + ", "
        return f"{self.robot.name} {training}{self.label} seed {self.settings.seed}"

    @property
    def element_box(self) -> Box | None:
        """The box of matrix elements that is searched; None for a geometry, or an answer without a box."""
        searched = self.settings.parameterisation != "geometry" and self.box_name != UNBOUNDED
        return self.settings.box if searched else None

    @property
    def search_space(self) -> tuple[ParameterisationName, Box | GeometryLimits, bool]:
        """The set of matrices that the fit chooses from: equal where two fits searched the same set.

        Its parameterisation, the box of matrix elements or the limits of the geometry, and whether the answer keeps to
        them.
        """
        settings = self.settings
        limits = (settings.limits or GeometryLimits()) if settings.parameterisation == "geometry" else settings.box
        return settings.parameterisation, limits, self.box_name != UNBOUNDED

    @property
    def task(self) -> FitTask:
        """The fit as its worker process sees it."""
        config = self.config
        return FitTask(self.settings, self.dataset.robot, self.training_runs, config.plugins, config.timing)

    def problem(self) -> CalibrationProblem:
        """The fit's calibration problem."""
        return make_problem(self.settings, self.dataset.robot, self.training_runs)

    @cached_property
    def key(self) -> str:
        """The key of the fit's stored result."""
        return fit_key(self.settings, self.dataset)


def load_robots(
    config: CompareConfig, progress: Reporter = no_progress
) -> tuple[tuple[ComparedRobot, ...], dict[str, str]]:
    """The data sets, or the robots whose recordings can be read, and why not of the others, by name.

    DataError: a data set cannot be read, or has no training data, or no robot's recordings can be read.
    """
    robots, broken = [], {}
    for name, source in config.datasets.items():
        dataset = source.load(name, config.description, progress)
        training_split(dataset)
        robots.append(data_set(name, dataset))
    for number, (name, choice) in enumerate(config.robots.items()):
        progress(Progress("reading the recordings", number, len(config.robots), "robot", note=name))
        try:
            dataset = choice.source(config.data, name).load(name)
            rules = choice.trainings or config.trainings
            robots.append(ComparedRobot(name, dataset, divide(dataset, choice, rules, f"robot {name}")))
        except ConfigError:
            raise
        except OmnibenchError as error:
            broken[name] = str(error)
    if config.robots:
        progress(Progress("reading the recordings", len(config.robots), len(config.robots), "robot"))
    if not robots:
        name, reason = next(iter(broken.items()))
        raise DataError(f"no robot's recordings can be read, the first: {name}: {reason}")
    return tuple(robots), broken


def data_set(name: str, dataset: Dataset) -> ComparedRobot:
    """A data set, divided by its own split."""
    split = {
        part: tuple(index for index, run in enumerate(dataset.trajectories) if run.split == part) for part in SPLITS
    }
    judged = {"validation": split["validation"]} if split["validation"] else {}
    fold = Fold("", dataset.split("train"), judged, fitted={"train": split["train"]})
    return ComparedRobot(name, dataset, (Training(OWN_SPLIT, (fold,)),))


def plan_fits(config: CompareConfig, robots: Sequence[ComparedRobot]) -> list[PlannedFit]:
    """All fits; an entry without randomness is fitted once. ConfigError: a bad box, or a pattern matches nothing."""
    # Every pattern must match a training or regime; while some robots cannot be read, all trainings are not known
    trainings = list(dict.fromkeys(training.name for robot in robots for training in robot.trainings))
    given = [(f"method {entry.shown}: trainings", entry.trainings, trainings) for entry in config.entries]
    given += [(f"regime {name}: trainings", regime.trainings, trainings) for name, regime in config.regimes.items()]
    given = given if len(robots) == len(config.robots or config.datasets) else []
    given += [(f"method {entry.shown}: regimes", entry.regimes, list(config.regimes)) for entry in config.entries]
    for place, patterns, names in given:
        for pattern in patterns:
            if pattern != "*" and not any(fnmatchcase(name, pattern) for name in names):
                raise ConfigError(
                    f"config {config.name}: {place}: none is called {pattern}; {nearest(pattern, names)}known: "
                    f"{', '.join(names) or 'none'}"
                )
    regimes = {AS_RECORDED: RegimeChoice(), **config.regimes}
    fits = [fit for robot in robots for name in regimes for fit in _of_robot(config, robot, name, regimes[name])]
    # Two entries may differ by their box alone, which their labels then name
    labels: dict[tuple[str, str], CalibratorEntry] = {}
    for fit in fits:
        if labels.setdefault((fit.robot.name, fit.label), fit.entry) is not fit.entry:
            raise ConfigError(
                f"config {config.name}: two entries are called {fit.label!r}; give one a label of its own"
            )
    return fits


def _of_robot(config: CompareConfig, robot: ComparedRobot, name: str, regime: RegimeChoice) -> Iterator[PlannedFit]:
    for training in robot.trainings:
        if not _named(training.name, regime.trainings):
            continue
        for fold in training.folds:
            dataset, runs = robot.dataset, fold.training
            if config.robots:  # what judges is not the data set's own split, and no part of the key
                runs = in_regime(tuple(replace(run, split="train") for run in runs), regime, config.seeds[0])
                dataset = replace(robot.dataset, trajectories=runs, scans=None)
            if regime.of_poses and not any(run.has_poses for run in runs):
                continue  # nothing of these runs would change
            for entry in config.entries:
                if _named(training.name, entry.trainings) and (name == AS_RECORDED or _named(name, entry.regimes)):
                    fit = _with_settings(config, robot, training, fold, name, entry, dataset, runs)
                    seeds = config.seeds if calibrators.entry(entry.name).cls.stochastic else config.seeds[:1]
                    for seed in seeds:
                        yield replace(fit, settings=fit.settings.model_copy(update={"seed": seed}))


def _named(name: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def _with_settings(
    config: CompareConfig, robot: ComparedRobot, training: Training, fold: Fold, regime: str, entry: CalibratorEntry,
    dataset: Dataset, runs: tuple[Trajectory, ...],
) -> PlannedFit:  # fmt: skip
    """A fit with the first seed, and why it cannot be asked, if so.

    ConfigError: a data set's robot has no such parameters, or the box does not hold its design.
    """
    settings, refusal, box_name = config.settings(entry, dataset.robot, len(runs), config.seeds[0]), "", UNBOUNDED
    if config.robots and not runs:
        refusal = "no training run is left"
    elif config.robots:
        with suppress(PluginError):  # a constructor that raises is the outcome of the fit
            refusal = refusal_of(calibrators.create(entry.name, entry.options), dataset.robot, runs)
    try:
        if not refusal and calibrators.entry(entry.name).cls.bounded:
            searched, box, limits = settings.parameterisation, settings.box, settings.limits
            box_name = make_parameterisation(searched, dataset.robot, runs, box=box, limits=limits).bounds.name
    except ConfigError as error:
        if config.datasets:
            raise ConfigError(f"config {config.name}: calibrator {entry.name!r}: {error}") from None
        refusal = str(error)
    label = entry.shown
    if not entry.label and settings.parameterisation != calibrators.entry(entry.name).cls.parameterisation:
        label += f" ({settings.parameterisation})"
    elif not entry.label and entry.box is not None and entry.box != config.box:
        label += f" ({box_name} box)"
    return PlannedFit(config, robot, training, fold, regime, entry, dataset, runs, settings, label, box_name, refusal)
