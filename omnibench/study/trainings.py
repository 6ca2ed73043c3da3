"""Division of a robot's runs: which train, fold by fold, and which judge."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.splits import repetitions
from omnibench.errors import ConfigError, DataError, nearest
from omnibench.robot.kinematics import Array, interpolated
from omnibench.study.config import RECORDED, RegimeChoice, RobotChoice, TrainingChoice
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
