"""Candidate runs for a design: the commands of recordings, of a simulated data set, or of a design config."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omnibench.config import read_yaml, validate
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.splits import training_split
from omnibench.data.storage import load_whole
from omnibench.design.config import DesignConfig
from omnibench.design.d_optimality import Counts
from omnibench.errors import ConfigError, DataError, OmnibenchError, UnknownNameError
from omnibench.fit.identifiability import identifiability
from omnibench.fit.span import aligned, direction_in_words, driven_span, motion_in_words
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration
from omnibench.simulate.commands import TimedCommand
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.flower import planned_commands, run_as_designed
from omnibench.simulate.robot_config import RobotConfig
from omnibench.simulate.source import ComparedData
from omnibench.words import noun_for, plural


@dataclass(frozen=True, eq=False)
class CandidateRun:
    """A command that a design may choose, with runs of it: those recorded, or one at the design values."""

    name: str
    runs: tuple[Trajectory, ...]

    @property
    def duration(self) -> float:
        """The mean duration of the command's runs, s."""
        return float(np.mean([run.pose_times[-1] for run in self.runs]))

    @property
    def distance(self) -> float:
        """The distance that the robot's centre drives, m: as commanded, or else along the reference poses."""
        given = self.runs[0].distance
        if given is not None:
            return float(given)
        return float(np.mean([np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum() for run in self.runs]))


@dataclass(frozen=True, eq=False)
class CandidatePool:
    """Candidates, noise and baseline of a design.

    sets: indices of the candidates of each set. baseline (C,): how often each is driven in the experiment that
    designs are compared with. recorded: the candidates' wheel logs are recordings; else rates are as designed.
    """

    source: str
    name: str
    description: str
    robot: Robot
    integration: Integration
    candidates: tuple[CandidateRun, ...]
    sets: Mapping[str, tuple[int, ...]]
    baseline: Counts
    baseline_name: str
    noise: Noise
    noise_source: str
    simulated: bool
    recorded: bool
    notes: tuple[str, ...]

    def runs(self, name: str) -> tuple[Trajectory, ...]:
        """Runs of the candidates in a set."""
        return tuple(run for index in self.sets[name] for run in self.candidates[index].runs)


def read_candidates(
    source: Path | str | Dataset, *, dataset: str | None = None, integration: Integration | None = None
) -> CandidatePool:
    """The candidates of a data set or its folder, of a comparison config's data set, or of a design config.

    dataset: the one to use where a comparison config has several. integration: default: the config's, or arc for a data
    set. OmnibenchError in one line that names the source, what is wrong and what to do.
    """
    if isinstance(source, Dataset):
        refuse_choice(dataset, source.name)
        return candidates_of_dataset(source, integration or "arc")
    path = Path(source)
    if path.is_dir():
        refuse_choice(dataset, path)
        return candidates_of_dataset(load_whole(path), integration or "arc", str(path))
    content = read_yaml(path)
    if isinstance(content, Mapping) and "datasets" in content:
        compared = validate(ComparedData, content, str(path), path.resolve().parent)
        return _candidates_of_comparison(compared, dataset, integration, str(path))
    refuse_choice(dataset, path)
    config = validate(DesignConfig, content, str(path))
    return candidates_of_config(
        config if integration is None else config.model_copy(update={"integration": integration}), str(path)
    )


def candidates_of_dataset(dataset: Dataset, integration: Integration = "arc", source: str = "") -> CandidatePool:
    """The commands of the training runs, as recorded; the noise is estimated from their repetitions.

    DataError: no command is named, or only one; the commands leave part of the matrix undetermined; there is no noise.
    """
    place = source or f"data set {dataset.name}"
    training = training_split(dataset)
    if not any(run.has_poses for run in training):
        raise DataError(
            f"{place}: its runs have distances, turns and the like and no reference poses, from whose noise a design "
            "is chosen; without a recording: omnibench design --robot FILE; what to drive without poses: "
            "omnibench guide references"
        )
    commands: dict[str, list[Trajectory]] = {}
    for run in training:
        if run.command is not None and run.has_poses:
            commands.setdefault(run.command, []).append(run)
    if not commands:
        raise DataError(f"{place}: no training run has a command; fill the column command, so that a design can choose")
    if len(commands) == 1:
        raise DataError(f"{place}: {next(iter(commands))} is its only command; a design needs several to choose from")
    named = [run for runs in commands.values() for run in runs]
    require_every_motion(dataset.robot, named, place, DataError)
    identified = identifiability(dataset.robot, named, integration)
    if _noiseless(identified.noise):
        raise DataError(f"{place}: repetitions agree without any noise, so that runs cannot be weighed by it")
    unnamed = len(training) - len(named)
    have = "has" if unnamed == 1 else "have"
    notes = [f"{unnamed} of {len(training)} training runs {have} no command or one pose: left out"] if unnamed else []
    if dataset.simulated:
        notes.append("The recordings are simulated, and so is the noise that was estimated from them.")
    return CandidatePool(
        source=place,
        name=dataset.name,
        description=dataset.description,
        robot=dataset.robot,
        integration=integration,
        candidates=tuple(CandidateRun(name, tuple(runs)) for name, runs in commands.items()),
        sets={dataset.name: tuple(range(len(commands)))},
        baseline=np.array([len(runs) for runs in commands.values()]),
        baseline_name=f"the {len(named)} {noun_for(len(named), 'training run')} of {dataset.name}",
        noise=identified.noise,
        noise_source=f"estimated from {identified.noise_source}",
        simulated=dataset.simulated,
        recorded=True,
        notes=tuple(notes),
    )


def candidates_of_config(config: DesignConfig, source: str = "") -> CandidatePool:
    """The commands of a design config, driven as designed.

    ConfigError: a set leaves part of the matrix undetermined, or has one command; the noise is zero.
    """
    place = source or f"config {config.name}"
    periods = (config.sample_period, config.pose_period)
    commands = {name: config.commands(name) for name in config.sets}
    pool, candidates = driven_as_designed(config.robot, config.integration, periods, commands)
    sets = {name: tuple(pool[command] for command in of_set) for name, of_set in commands.items()}
    baseline = np.zeros(len(candidates), dtype=np.intp)
    baseline[list(sets[config.baseline.set])] = config.baseline.repetitions
    count = len(sets[config.baseline.set])
    return checked_pool(
        CandidatePool(
            source=place,
            name=config.name,
            description=config.description,
            robot=config.robot,
            integration=config.integration,
            candidates=candidates,
            sets=sets,
            baseline=baseline,
            baseline_name=(
                f"{count} {noun_for(count, 'command')} of {config.baseline.set} x {config.baseline.repetitions}"
            ),
            noise=config.noise,
            noise_source="assumed: as the config says",
            simulated=True,
            recorded=False,
            notes=config.notes,
        )
    )


def candidates_of_simulation(
    name: str, config: FlowerConfig, integration: Integration, source: str = "", notes: Sequence[str] = ()
) -> CandidatePool:
    """The commands that a simulated data set's training session drives, as designed, with the noise that is simulated.

    ConfigError: the commands leave part of the matrix undetermined, there is one only, or the noise is zero.
    """
    planned = planned_commands(config, config.train)
    periods = (config.sample_period, config.pose_period)
    pool, candidates = driven_as_designed(config.robot, integration, periods, {name: [each.timed for each in planned]})
    baseline = np.zeros(len(candidates), dtype=np.intp)
    for each in planned:
        baseline[pool[each.timed]] += each.repetitions
    often = f" x {baseline[0]}" if len(set(baseline)) == 1 else f", {plural(int(baseline.sum()), 'run')}"
    scale = config.train.noise_scale
    noise = Noise(**{kind: scale * getattr(config.noise, kind) for kind in Noise.model_fields})
    return checked_pool(
        CandidatePool(
            source=source or f"data set {name}",
            name=name,
            description="",
            robot=config.robot,
            integration=integration,
            candidates=candidates,
            sets={name: tuple(range(len(candidates)))},
            baseline=baseline,
            baseline_name=f"{len(candidates)} {noun_for(len(candidates), 'command')} of {name}{often}",
            noise=noise,
            noise_source="assumed: what the config simulates for training",
            simulated=True,
            recorded=False,
            notes=tuple(notes),
        )
    )


def _candidates_of_comparison(
    config: ComparedData, name: str | None, integration: Integration | None, place: str
) -> CandidatePool:
    if name is not None and name not in config.datasets:
        raise UnknownNameError("data set", name, config.datasets, place)
    if name is None and len(config.datasets) > 1:
        raise ConfigError(f"{place}: it has several data sets; choose one with --dataset: {', '.join(config.datasets)}")
    name = name or next(iter(config.datasets))
    source = config.datasets[name]
    chosen = integration or config.integration
    if isinstance(source.simulate, RobotConfig):
        raise ConfigError(
            f"{place}: data set {name} is a simulated robot, whose noise is not stated beforehand; make it with "
            "`omnibench simulate`, and design from its folder"
        )
    if source.simulate is None:
        return candidates_of_dataset(source.load(name), chosen, f"{place}: data set {name}")
    return candidates_of_simulation(name, source.simulate, chosen, place, config.notes)


def driven_as_designed(
    robot: Robot,
    integration: Integration,
    periods: tuple[float, float],
    sets: Mapping[str, Iterable[TimedCommand]],
) -> tuple[dict[TimedCommand, int], tuple[CandidateRun, ...]]:
    """Index of each distinct command, and its run: wheel rates and poses of a robot that is exactly as designed."""
    commands = list(dict.fromkeys(timed for of_set in sets.values() for timed in of_set))
    model = OdometryModel.of_design(robot, integration)
    names = [timed.command.name for timed in commands]
    candidates = []
    for timed, name in zip(commands, names, strict=True):
        title = name if names.count(name) == 1 else f"{name}_t{timed.duration:.4g}"
        candidates.append(CandidateRun(title, (run_as_designed(model, timed, periods, title),)))
    return {timed: index for index, timed in enumerate(commands)}, tuple(candidates)


def checked_pool(pool: CandidatePool) -> CandidatePool:
    """The pool. ConfigError: a set leaves part of the matrix undetermined, or has one command; the noise is zero."""
    if _noiseless(pool.noise):
        raise ConfigError(
            f"{pool.source}: noise: give position and heading some noise; without it, runs cannot be weighed"
        )
    for name, indices in pool.sets.items():
        place = f"{pool.source}: {name}"
        if len(indices) == 1:
            raise ConfigError(f"{place}: it has one command only; a design needs several to choose from")
        require_every_motion(pool.robot, pool.runs(name), place, ConfigError)
    return pool


def _noiseless(noise: Noise) -> bool:
    """True if position or heading has no noise of any kind."""
    return any(
        not any(getattr(noise, f"{kind}_{coordinate}") for kind in ("pose", "walk", "bias"))
        for coordinate in ("position", "heading")
    )


def require_every_motion(robot: Robot, runs: Sequence[Trajectory], place: str, error: type[OmnibenchError]) -> None:
    """Raise ``error`` where runs leave out a motion that the robot can make, whose part of the matrix stays unknown."""
    # Signals (M, D) of the robot's motions without slip, orthonormal.
    possible, _ = np.linalg.qr(robot.signal_equations @ robot.motions.T)
    count = possible.shape[1]
    _, strengths, motions = np.linalg.svd(np.vstack([driven_span(runs).strong @ possible, np.zeros((count, count))]))
    missing = motions[strengths < 0.5] @ possible.T
    if len(missing):
        words = [
            f"{direction_in_words(direction, robot.drive.names)} ({motion_in_words(direction, robot)})"
            for direction in aligned(missing, robot)
        ]
        raise error(
            f"{place}: its commands do not drive the wheels along {' nor along '.join(words)}, beyond what slip may "
            "do, and so cannot identify the matrix there; add commands that do"
        )


def refuse_choice(dataset: str | None, source: Path | str) -> None:
    """ConfigError: ``--dataset`` chooses where there is nothing to choose from."""
    if dataset is not None:
        raise ConfigError(f"--dataset: only a comparison config with several data sets needs it; {source} is none")
