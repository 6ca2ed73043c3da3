"""The fits of a study: robots x trainings x regimes x folds x methods x seeds, and the errors of their answers.

A training divides a robot's runs: which train, fold by fold, and which judge.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np

from omnibench.compare.plan import PlannedRun, name_of_bounds
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.splits import repetitions
from omnibench.errors import ConfigError, DataError, OmnibenchError, PluginError, nearest
from omnibench.fit.calibrator import Outcome, RunResult, refusal_of
from omnibench.fit.evaluate import final_errors
from omnibench.fit.reference_rows import with_mean_errors
from omnibench.progress import Progress, Reporter
from omnibench.registry import calibrators
from omnibench.robot.calibration import extended_model
from omnibench.robot.kinematics import Array, interpolated
from omnibench.robot.odometry import Integration
from omnibench.robot.stored_odometry import odometry_of
from omnibench.study.config import RECORDED, MethodChoice, RegimeChoice, RobotChoice, StudyConfig, TrainingChoice
from omnibench.words import plural

AS_RECORDED = RECORDED


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
    poses = _late(run, regime, _chance(run, seed, "clock"))
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


def _late(run: Trajectory, regime: RegimeChoice, rng: np.random.Generator) -> Array:
    """Poses (K, 3) whose stamps t are late: each was taken at t - (offset + drift t)."""
    if not (regime.clock_offset or regime.clock_drift):
        return run.poses
    offset, drift = rng.normal(0.0, [regime.clock_offset, regime.clock_drift])
    taken = np.clip(run.pose_times - offset - drift * run.pose_times, 0.0, run.pose_times[-1])
    return interpolated(taken, run.pose_times, run.poses)


def _chance(run: Trajectory, seed: int, what: str) -> np.random.Generator:
    digest = hashlib.sha256(f"{run.fingerprint} {what}".encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "big")])


ONE_KIND = "all paths"  # the kind of every run, where the config names none


@dataclass(frozen=True, eq=False)
class Fold:
    """One training set. training: its runs. judged: by kind, the indices of the data set's runs that judge it.

    session: of the training runs, where they are of one. fitted: the kind of the training runs, whose own errors are
    training errors.
    """

    name: str
    training: tuple[Trajectory, ...]
    judged: Mapping[str, tuple[int, ...]]
    session: str | None = None
    fitted: Mapping[str, tuple[int, ...]] | None = None


@dataclass(frozen=True, eq=False)
class Training:
    """A rule of division applied to a robot's runs: one fold, or one for each session or command."""

    name: str
    folds: tuple[Fold, ...]

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds that it is judged on, in the order of the folds."""
        return tuple(dict.fromkeys(kind for fold in self.folds for kind, runs in fold.judged.items() if runs))

    @property
    def fitted_kinds(self) -> tuple[str, ...]:
        """The kinds of whose training errors are known."""
        return tuple(dict.fromkeys(kind for fold in self.folds for kind in fold.fitted or ()))


@dataclass(frozen=True, eq=False)
class _Runs:
    """A data set's runs with their kinds; None: a run that is left out."""

    dataset: Dataset
    kinds: tuple[str | None, ...]

    def of(self, kind: str) -> tuple[int, ...]:
        return tuple(index for index, each in enumerate(self.kinds) if each == kind)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(kind for kind in self.kinds if kind is not None))

    def runs(self, indices: Sequence[int]) -> tuple[Trajectory, ...]:
        return tuple(self.dataset.trajectories[index] for index in indices)

    def session(self, index: int) -> str | None:
        return self.dataset.trajectories[index].session

    def others(self, training: Sequence[int]) -> dict[str, tuple[int, ...]]:
        """All runs outside a training set that are not copies of runs in it, by kind."""
        within = set(training)
        copies = {self.dataset.trajectories[index].fingerprint for index in training}
        return {
            kind: tuple(
                index
                for index in self.of(kind)
                if index not in within and self.dataset.trajectories[index].fingerprint not in copies
            )
            for kind in self.names
        }


def divide(dataset: Dataset, robot: RobotChoice, rules: Sequence[TrainingChoice], place: str) -> tuple[Training, ...]:
    """The trainings of a robot's runs; those that nothing judges are left out.

    place: what messages begin with. ConfigError: a run is of two kinds, a rule names an unknown kind, or two rules give
    the same training. DataError: no run is of a kind, or names its session, or is left to judge by.
    """
    runs = _Runs(dataset, _kinds_of(dataset.trajectories, robot.kinds, place))
    trainings: dict[str, Training] = {}
    for rule in rules:
        for kind in rule.kinds:
            if kind not in runs.names:
                hint = nearest(kind, runs.names)
                raise ConfigError(f"{place}: no kind {kind!r} to train on; {hint}known: {', '.join(runs.names)}")
        if "session" in (rule.by, rule.leave_out) and not all(run.session for run in dataset.trajectories):
            raise DataError(
                f"{place}: some runs name no session, by which they are to be divided; name them, or divide by kind"
            )
        for training in _trainings(runs, rule):
            if training.name in trainings:
                raise ConfigError(f"{place}: two trainings are {training.name!r}; leave one out")
            if training.folds and training.kinds:
                trainings[training.name] = training
    if not trainings:
        raise DataError(f"{place}: no run is left to judge by; give it another training")
    return tuple(trainings.values())


def _kinds_of(runs: Sequence[Trajectory], kinds: Mapping[str, Sequence[str]], place: str) -> tuple[str | None, ...]:
    if not kinds:
        return (ONE_KIND,) * len(runs)
    matched: list[list[str]] = [
        [kind for kind, patterns in kinds.items() if any(fnmatchcase(run.id, pattern) for pattern in patterns)]
        for run in runs
    ]
    for kind, patterns in kinds.items():
        if not any(kind in of_run for of_run in matched):
            found = ", ".join(run.id for run in runs[:4])
            raise DataError(f"{place}: no run is of kind {kind} ({', '.join(patterns)}); runs are: {found}, ...")
    for run, of_run in zip(runs, matched, strict=True):
        if len(of_run) > 1:
            raise ConfigError(f"{place}: run {run.id} is of kinds {' and '.join(of_run)}; make the patterns differ")
    return tuple(of_run[0] if of_run else None for of_run in matched)


def _trainings(runs: _Runs, rule: TrainingChoice) -> Iterator[Training]:
    if rule.by == "split":
        train = [
            index for index, run in enumerate(runs.dataset.trajectories) if run.split == "train" and runs.kinds[index]
        ]
        judged = runs.others(train)
        kinds = dict.fromkeys(runs.kinds[index] for index in train)
        fold = Fold(
            "",
            runs.runs(train),
            judged,
            fitted={kind: tuple(i for i in train if runs.kinds[i] == kind) for kind in kinds if kind is not None},
        )
        yield Training("own split", (fold,) if train else ())
    elif rule.leave_out == "kind":
        for kind in runs.names:
            training = [index for index, each in enumerate(runs.kinds) if each not in (kind, None)]
            if training:
                fold = Fold("", runs.runs(training), {kind: runs.others(training)[kind]})
                yield Training(f"all but {kind}", (fold,))
    else:
        for kind in rule.kinds or runs.names:
            if rule.by == "session":
                yield _each_session(runs, kind)
            elif rule.by == "kind":
                yield from _whole_kind(runs, kind, rule.runs_per_command)
            elif rule.leave_out is not None:
                yield _left_out(runs, kind, rule.leave_out)


def _whole_kind(runs: _Runs, kind: str, curve: Sequence[int]) -> Iterator[Training]:
    """All runs of a kind train; on a learning curve the first of each command, judged by what never trains."""
    members = runs.of(kind)
    if not curve:
        yield Training(kind, (Fold("", runs.runs(members), runs.others(members), fitted={kind: members}),))
        return
    used = _first_of_commands(runs, members, max(curve))
    most = max(repetitions([run.command or run.id for run in runs.runs(members)]), default=0)
    for count in sorted({min(count, most) for count in curve}):
        train = _first_of_commands(runs, members, count)
        fold = Fold("", runs.runs(train), runs.others(used), fitted={kind: tuple(train)})
        yield Training(f"{kind}, {plural(count, 'run')} a command", (fold,))


def _first_of_commands(runs: _Runs, members: Sequence[int], count: int) -> list[int]:
    chosen = runs.runs(members)
    numbers = repetitions([run.command or run.id for run in chosen])
    return [index for index, number in zip(members, numbers, strict=True) if number <= count]


def _each_session(runs: _Runs, kind: str) -> Training:
    folds = []
    for session, members in _grouped(runs, runs.of(kind), "session").items():
        judged = {
            name: tuple(index for index in indices if name != kind or runs.session(index) != session)
            for name, indices in runs.others(members).items()
        }
        folds.append(Fold(session, runs.runs(members), judged, session))
    return Training(f"{kind}, one session", tuple(folds))


def _left_out(runs: _Runs, kind: str, what: str) -> Training:
    members = runs.of(kind)
    folds = []
    groups = _grouped(runs, members, what)
    for name, judged in groups.items():
        training = [index for index in members if index not in set(judged)]
        others = {kind: tuple(index for index in runs.others(training)[kind] if index in set(judged))}
        if training and others[kind]:
            folds.append(Fold(f"without {name}", runs.runs(training), others))
    return Training(f"{kind}, a {what} left out", tuple(folds) if len(groups) > 1 else ())


def _grouped(runs: _Runs, members: Sequence[int], what: str) -> dict[str, list[int]]:
    """Indices by session or command; runs without one are a group each."""
    groups: dict[str, list[int]] = {}
    for index in members:
        run = runs.dataset.trajectories[index]
        groups.setdefault((run.session if what == "session" else run.command) or run.id, []).append(index)
    return groups


@dataclass(frozen=True, eq=False)
class StudiedRobot:
    """A robot of the study with its runs and how they are divided."""

    name: str
    dataset: Dataset
    trainings: tuple[Training, ...]


@dataclass(frozen=True, eq=False)
class PlannedFit:
    """One fit. run: as a comparison makes it; None where the method cannot be asked, for the ``reason``."""

    robot: StudiedRobot
    training: Training
    fold: Fold
    regime: str
    method: MethodChoice
    seed: int
    run: PlannedRun | None
    reason: str = ""


def load_robots(config: StudyConfig, progress: Reporter) -> tuple[tuple[StudiedRobot, ...], dict[str, str]]:
    """The robots whose recordings can be read, and why not of the others, by name."""
    robots, broken = [], {}
    for number, (name, choice) in enumerate(config.robots.items()):
        progress(Progress("reading the recordings", number, len(config.robots), "robot", note=name))
        try:
            dataset = choice.source(config.data, name).load(name)
            rules = choice.trainings or config.trainings
            robots.append(StudiedRobot(name, dataset, divide(dataset, choice, rules, f"robot {name}")))
        except ConfigError:
            raise
        except OmnibenchError as error:
            broken[name] = str(error)
    progress(Progress("reading the recordings", len(config.robots), len(config.robots), "robot"))
    return tuple(robots), broken


def plan_fits(config: StudyConfig, robots: tuple[StudiedRobot, ...]) -> list[PlannedFit]:
    """All fits of the study; those of one training set share it. ConfigError: a pattern matches no training."""
    # Every pattern must match a training or regime; while some robots cannot be read, all trainings are not known
    trainings = list(dict.fromkeys(training.name for robot in robots for training in robot.trainings))
    given = [(f"method {method.shown}: trainings", method.trainings, trainings) for method in config.methods]
    given += [(f"regime {name}: trainings", regime.trainings, trainings) for name, regime in config.regimes.items()]
    given = given if len(robots) == len(config.robots) else []
    given += [(f"method {method.shown}: regimes", method.regimes, list(config.regimes)) for method in config.methods]
    for place, patterns, names in given:
        for pattern in patterns:
            if pattern != "*" and not any(_named(name, (pattern,)) for name in names):
                raise ConfigError(
                    f"config {config.name}: {place}: none is called {pattern}; {nearest(pattern, names)}known: "
                    f"{', '.join(names) or 'none'}"
                )
    regimes = {AS_RECORDED: RegimeChoice(), **config.regimes}
    return [
        fit for robot in robots for name, regime in regimes.items() for fit in _of_robot(config, robot, name, regime)
    ]


def _of_robot(config: StudyConfig, robot: StudiedRobot, name: str, regime: RegimeChoice) -> Iterator[PlannedFit]:
    for training in robot.trainings:
        if not _named(training.name, regime.trainings):
            continue
        for fold in training.folds:
            runs = tuple(replace(run, split="train") for run in fold.training)
            runs = in_regime(runs, regime, config.seeds[0])
            if regime.of_poses and not any(run.has_poses for run in runs):
                continue  # nothing of these runs would change
            dataset = replace(robot.dataset, trajectories=runs, scans=None)
            for method in config.methods:
                if _named(training.name, method.trainings) and (name == AS_RECORDED or _named(name, method.regimes)):
                    for seed in config.seeds if calibrators.entry(method.name).cls.stochastic else config.seeds[:1]:
                        run, reason = _planned(config, robot, method, dataset, seed, f"{training.name} {fold.name}")
                        yield PlannedFit(robot, training, fold, name, method, seed, run, reason)


def _named(name: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def _planned(
    config: StudyConfig, robot: StudiedRobot, method: MethodChoice, dataset: Dataset, seed: int, what: str
) -> tuple[PlannedRun | None, str]:
    """A fit as a run of a comparison, or why the method cannot be asked."""
    if not dataset.trajectories:
        return None, "no training run is left"
    with suppress(PluginError):  # a constructor that raises is the outcome of the fit
        made = calibrators.create(method.name, method.options)
        if refusal := refusal_of(made, dataset.robot, dataset.trajectories):
            return None, refusal
    settings = config.settings_of(method, dataset.robot, len(dataset.trajectories), seed)
    try:
        box_name = name_of_bounds(settings, dataset.robot, dataset.trajectories)
    except ConfigError as error:  # the robot has no such parameters
        return None, str(error)
    label = f"{what.strip()}, {method.shown}"
    return PlannedRun(config, robot.name, dataset, dataset.trajectories, settings, label, box_name), ""


_TOGETHER = 64  # matrices that are judged at once (chosen: 164 runs of 1,200 samples take 0.1 GB)


@dataclass(frozen=True, eq=False)
class JudgedFit:
    """A fit with its result and the errors (Z, 3) of its answer on all runs of the robot, m, m, rad; None without one.

    outcome, reason: the result's, or why there is none.
    """

    fit: PlannedFit
    result: RunResult | None
    outcome: Outcome
    reason: str
    errors: Array | None

    @property
    def answered(self) -> bool:
        """True if there is an answer."""
        return self.errors is not None


def judge_fits(
    fits: Sequence[PlannedFit],
    results: Mapping[int, RunResult],
    integration: Integration,
    progress: Reporter,
) -> tuple[tuple[JudgedFit, ...], dict[str, Array]]:
    """Every fit with its errors, and by robot the errors (Z, 3) of the design values.

    results: by the fit's place in ``fits``; those that are missing could not be asked.
    """
    judged: dict[int, JudgedFit] = {}
    design: dict[str, Array] = {}
    robots = {fit.robot.name: fit.robot for fit in fits}
    for name, robot in robots.items():
        judge = _Judge(robot, integration)
        design[name] = judge.of_matrices([robot.dataset.robot.inverse_kinematic_matrix])[0]
        mine = [index for index, fit in enumerate(fits) if fit.robot.name == name]
        progress(Progress("judging", len(judged), len(fits), "answer"))
        plain = [i for i in mine if i in results and results[i].matrix is not None and results[i].extension is None]
        matrices = [results[i].matrix for i in plain]
        errors = dict(zip(plain, judge.of_matrices([m for m in matrices if m is not None]), strict=True))
        for index in mine:
            judged[index] = judge.judged(fits[index], results.get(index), errors.get(index))
    progress(Progress("judging", len(fits), len(fits), "answer"))
    return tuple(judged[index] for index in range(len(fits))), design


class _Judge:
    """Judges answers on all runs of one robot."""

    def __init__(self, robot: StudiedRobot, integration: Integration) -> None:
        self._robot, self._integration = robot.dataset.robot, integration
        self._period, self._runs = robot.dataset.sample_period, robot.dataset.trajectories
        self._ends = np.array([run.final_pose for run in self._runs])
        self._odometry = odometry_of([run.final_log for run in self._runs], integration)

    def of_matrices(self, matrices: Sequence[Array]) -> list[Array]:
        """Errors (Z, 3) of each matrix (3, M)."""
        errors: list[Array] = []
        for first in range(0, len(matrices), _TOGETHER):
            poses = self._odometry.poses(np.array(matrices[first : first + _TOGETHER]))
            errors += [
                with_mean_errors(of_one - self._ends, matrix, self._runs, self._integration)
                for of_one, matrix in zip(poses, matrices[first : first + _TOGETHER], strict=True)
            ]
        return errors

    def judged(self, fit: PlannedFit, result: RunResult | None, errors: Array | None) -> JudgedFit:
        """A fit with its errors; an answer whose effects do not act on some run is a failed one."""
        if result is None:
            return JudgedFit(fit, None, Outcome.NOT_APPLICABLE, fit.reason, None)
        outcome, reason = result.outcome, result.reason
        if errors is None and result.matrix is not None:
            try:
                model = extended_model(
                    self._robot, result.matrix, self._integration, self._period, result.extension, fit.method.shown
                )
                errors = final_errors(model, self._runs)
            except OmnibenchError as error:
                outcome, reason = Outcome.FAILED, str(error)
        if errors is not None and not np.isfinite(errors).all():
            outcome, reason, errors = Outcome.INVALID, "its odometry is not finite on a run that judges it", None
        return JudgedFit(fit, result, outcome, reason, errors)
