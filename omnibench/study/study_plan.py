"""The fits of a study: robots x trainings x regimes x folds x methods x seeds, and the errors of their answers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np

from omnibench.compare.plan import PlannedRun, name_of_bounds
from omnibench.data.dataset import Dataset
from omnibench.errors import ConfigError, OmnibenchError, PluginError, nearest
from omnibench.fit.calibrator import Outcome, RunResult, refusal_of
from omnibench.fit.evaluate import final_errors
from omnibench.fit.reference_rows import with_mean_errors
from omnibench.progress import Progress, Reporter
from omnibench.registry import calibrators
from omnibench.robot.calibration import extended_model
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration
from omnibench.robot.stored_odometry import odometry_of
from omnibench.study.config import MethodChoice, RegimeChoice, StudyConfig
from omnibench.study.trainings import AS_RECORDED, Fold, Training, divide, in_regime


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
