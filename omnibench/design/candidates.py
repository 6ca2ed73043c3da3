"""Candidate runs for a design: the commands of recordings, of a data set or config, or those that suit a robot.

The config of a design: a robot, the noise of its reference poses, and sets of commands to choose from.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from omnibench.config import Model, Positive, read_yaml, validate
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.recording_options import RobotOption, read_robot
from omnibench.data.splits import training_split
from omnibench.data.storage import load_dataset
from omnibench.design.exchange import Counts
from omnibench.errors import ConfigError, DataError, OmnibenchError, UnknownNameError
from omnibench.fit.identifiability import identifiability, kept_motions
from omnibench.fit.span import driven_span
from omnibench.report.numbers import drive_in_words, noise_in_words
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration
from omnibench.simulate import commands as motion
from omnibench.simulate.commands import Command, Shapes, TimedCommand
from omnibench.simulate.config import RobotConfig, SteeringLimit
from omnibench.simulate.robot_simulator import run_as_designed
from omnibench.simulate.source import ComparedData
from omnibench.words import noun_for

# They guard memory against slips of the pen and decide nothing else: so many samples of four wheels take 640 MB.
_MOST_COMMANDS = 5000  # commands of a set, at most
_MOST_SAMPLES = 2e7  # wheel samples and poses of a set's commands together, at most
Name = Annotated[str, Field(min_length=1, max_length=60)]


class OtherSet(Model):
    """The commands of another set, included in this one."""

    set: Name = Field(description="its name")


def _kind(block: Any) -> str:
    keys = set(block) if isinstance(block, Mapping) else set(type(block).model_fields)
    return "set" if "set" in keys else "command" if keys & {"speed", "direction_deg", "turn_rate"} else "grid"


Block = Annotated[
    Annotated[motion.CommandGrid, Tag("grid")]
    | Annotated[motion.SingleCommand, Tag("command")]
    | Annotated[OtherSet, Tag("set")],
    Discriminator(_kind),
]

# One block stands for a list of it.
_listed = BeforeValidator(lambda block: [block] if isinstance(block, Mapping) else block, Block | tuple[Block, ...])
Blocks = Annotated[tuple[Block, ...], _listed]


class DesignBaseline(Model):
    """The experiment that designs are compared with: every command of a set, ``repetitions`` times."""

    set: Name = Field(description="a name among sets")
    repetitions: int = Field(5, gt=0, le=1000, description="runs of each command")


class DesignConfig(Model):
    """A robot without recordings so far, and the commands that could be driven with it."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=60)
    description: str = ""
    notes: tuple[str, ...] = Field((), description="what a reader of the result must know")
    robot: RobotOption
    steering_limit_deg: SteeringLimit = None
    integration: Integration = "arc"
    sample_period: Positive = Field(0.01, description="time between wheel samples, s")
    pose_period: Positive = Field(0.25, description="time between reference poses, s")
    noise: Noise = Field(description="of the reference poses, as far as it is known")
    sets: dict[Name, Blocks] = Field(
        min_length=1, description="each a grid of commands, or a list of grids, single commands and other sets"
    )
    baseline: DesignBaseline

    @model_validator(mode="after")
    def _sets_are_known_and_of_a_size(self) -> DesignConfig:
        if self.baseline.set not in self.sets:
            raise ValueError(str(UnknownNameError("set", self.baseline.set, self.sets, "baseline")))
        if self.steering_limit_deg is not None and self.robot.drive.direct:
            raise ValueError("steering_limit_deg: no wheel of this robot steers; leave it out")
        for name in self.sets:
            commands = self.commands(name)
            if not commands:
                raise ValueError(f"sets.{name}: no command moves the robot")
            limit = motion.steering_limit(self.robot, self.steering_limit_deg)
            beyond = [timed.command for timed in commands if not motion.is_within(self.robot, timed.command, limit)]
            if beyond:
                why = motion.beyond_steering(self.robot, beyond, limit)
                raise ValueError(f"sets.{name}: {why}; take such commands out")
            samples = sum(command.duration for command in commands) * (1 / self.sample_period + 1 / self.pose_period)
            if len(commands) > _MOST_COMMANDS or samples > _MOST_SAMPLES:
                size = f"{len(commands)} commands of {samples:.1g} samples, of {_MOST_COMMANDS} and {_MOST_SAMPLES:.0e}"
                raise ValueError(f"sets.{name}: {size} at most; check the grids, durations and periods")
        return self

    def commands(self, name: str) -> tuple[TimedCommand, ...]:
        """The commands of a set and of the sets that it includes, each once. ValueError: unknown set, or a circle."""
        return tuple(dict.fromkeys(self._expanded(name, ())))

    def _expanded(self, name: str, above: tuple[str, ...]) -> Iterator[TimedCommand]:
        for block in self.sets[name]:
            try:
                if not isinstance(block, OtherSet):
                    yield from block.commands(self.robot)
                    continue
            except ValueError as error:
                raise ValueError(f"sets.{name}: {error}") from None
            if block.set not in self.sets:
                raise ValueError(str(UnknownNameError("set", block.set, self.sets, f"sets.{name}")))
            if block.set in (*above, name):
                raise ValueError(f"sets.{name}: includes {block.set!r}, which includes {name!r}; leave one out")
            yield from self._expanded(block.set, (*above, name))


# Reference poses that a calibration uses: the final one alone, as Eq. (6), or all of them under the noise model.
Use = Literal["final", "trajectory"]
# Cost of a run: 1, its duration, or the distance that its wheels roll (mean of the wheels).
Per = Literal["run", "second", "metre"]


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
        """The way of the robot's centre, m: as commanded, or else along the reference poses."""
        if self.runs[0].distance is not None:
            return self.runs[0].distance
        return float(np.mean([np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum() for run in self.runs]))

    @property
    def in_words(self) -> str:
        """The command as a person drives it."""
        run = self.runs[0]
        return drive_in_words(self.name, run.v, run.alpha, run.omega, self.duration, self.distance)


@dataclass(frozen=True, eq=False)
class CommandedRun(CandidateRun):
    """A command with its one run at the design values. heading: at its start, deg; None: any."""

    timed: TimedCommand
    heading: float | None = None

    @property
    def in_words(self) -> str:
        variation = self.timed.variation
        heading = "" if self.heading is None else f", from a heading of {self.heading:.0f}°"
        weave = f", weaving by {variation.weave:g} rad/s every {variation.period:g} s" if variation.weave else ""
        return f"{super().in_words}{heading}{weave}{', turning back halfway' if variation.reversals else ''}"


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
    candidates: Sequence[CandidateRun]
    sets: Mapping[str, Sequence[int]]
    baseline: Counts
    baseline_name: str
    noise: Noise
    noise_source: str
    simulated: bool
    recorded: bool
    notes: tuple[str, ...]


# Shapes of the runs that are offered; more of them change a design little, because it is a choice of few (chosen).
_SHAPES = Shapes(lines=(0.5, 1.0), radii=(0.1, 0.2, 0.4, 0.8), turns=(45.0, 90.0, 180.0, 360.0), spins=(360.0, 1080.0))
_DECIMAL = r"[0-9]+\.?[0-9]*|\.[0-9]+"
_SET = "robot"  # name of the candidates' set
_SAMPLE_PERIOD = 0.05  # s; commands are constant, so that longer samples tell the same
# White noise of a motion capture or of scan matching, and per sqrt(s) what a floor and slip add: the order of magnitude
# of the recordings that omnibench was tried on, 3 to 9 mm.
_NOISE = Noise(pose_position=0.005, pose_heading=0.005, walk_position=0.003, walk_heading=0.003)


class RobotLimits(Model):
    """Limits of what a robot without recordings may drive, and the noise of its reference; None: the default."""

    max_speed: Positive | None = Field(None, description="With --robot: its greatest speed, m/s. Default: 0.5.")
    max_turn_rate: Positive | None = Field(None, description="With --robot: its fastest turn, rad/s. Default: 1.")
    max_wheel_rate: Positive | None = Field(
        None, description="With --robot: of any wheel, rad/s. Default: as at max speed."
    )
    steering_limit: Annotated[float, Field(gt=0, le=180)] | None = Field(
        None, description="With --robot: largest steering angle, deg. Default: tricycle 80, car 35, others 90."
    )
    area: str | None = Field(None, description="With --robot: free floor, m, like 3x2.5. Default: 3x3.")
    position_noise: Annotated[float, Field(gt=0, lt=10)] | None = Field(
        None, description="With --robot: of the reference's positions, m. Default: 0.005."
    )
    heading_noise: Annotated[float, Field(gt=0, lt=90)] | None = Field(
        None, description="With --robot: of the reference's headings, deg. Default: 0.3."
    )

    def config(self, robot: Robot, source: str, integration: Integration = "arc") -> DesignConfig:
        """Lines, arcs to both sides and turns on the spot, as fast as the limits allow; the baseline drives each once.

        source: for messages. ConfigError: limits that exclude each other or every curve.
        """
        speed, rate = self.max_speed or 0.5, self.max_turn_rate or 1.0
        limit = motion.steering_limit(robot, self.steering_limit)
        if self.steering_limit is not None and robot.drive.direct:
            raise ConfigError(f"{source}: --steering-limit: no wheel of this robot steers; leave it out")
        # Largest wheel rates straight on at the greatest speed, in each direction that the robot drives
        twists = [Command(speed, math.radians(way), 0.0).twist for way in motion.default_directions(robot)]
        rates = [float(np.abs(motion.wheels_of(robot, twist)[0]).max()) for twist in twists]
        wheel_rate = self.max_wheel_rate or max(rates)
        if wheel_rate < (1 - 1e-9) * min(rates):
            fastest = math.floor(1000 * speed * wheel_rate / min(rates)) / 1000
            why = f"at --max-wheel-rate {wheel_rate:g} rad/s the wheels drive at most {fastest:g} m/s"
            raise ConfigError(f"{source}: --max-speed {speed:g}: {why}; give no more, or raise the wheels' rate")
        sides = re.fullmatch(rf"\s*({_DECIMAL})\s*[xX×]\s*({_DECIMAL})\s*m?\s*", self.area or "3x3")
        wide, deep = map(float, sides.groups()) if sides else (0.0, 0.0)
        if not 0 < min(wide, deep) <= max(wide, deep) < math.inf:
            raise ConfigError(f"--area {self.area}: give two sides in m, like --area 3x2.5")
        half_width = max(math.hypot(*wheel.position) + wheel.radius for wheel in robot.wheels)
        free, floor = (wide - 2 * half_width, deep - 2 * half_width), f"{wide:g}x{deep:g}"
        if min(free) < 2 * motion.SHORTEST:
            least = math.ceil(20 * (half_width + motion.SHORTEST)) / 10
            why = f"the robot alone takes {2 * half_width:.2g} m; give both sides at least {least:g} m"
            raise ConfigError(f"{source}: --area {floor}: {why}")
        drivable = dict.fromkeys(motion.DrivableCommands(robot, speed, rate, wheel_rate, limit, free, _SHAPES))
        if not any(timed.command.turn_rate for timed in drivable):
            why = f"no curve that it can drive within {motion.LONGEST:g} s fits an area of {floor} m"
            way_out = "give a larger --area, or a greater --steering-limit or --max-speed"
            raise ConfigError(f"{source}: {why}; {way_out}")
        steering = "" if robot.drive.direct else f", steering angles {math.degrees(limit):g} deg"
        sizes = {"pose_position": self.position_noise, "pose_heading": math.radians(self.heading_noise or 0.0)}
        return DesignConfig(
            name=re.sub(r"[^A-Za-z0-9_.-]+", "_", robot.name).strip("_.-")[:60] or "robot",
            description="What to drive before anything was recorded.",
            notes=(
                f"Commands were made for at most {speed:g} m/s, {rate:g} rad/s, wheels {wheel_rate:.3g} rad/s"
                f"{steering}, and a free floor of {floor} m, of which its wheels need {half_width:.2g} m.",
                "Left is counter-clockwise as seen from above, backward too. Begin where a run stays on the floor.",
            ),
            robot=robot,
            steering_limit_deg=self.steering_limit,
            integration=integration,
            sample_period=_SAMPLE_PERIOD,
            noise=_NOISE.model_copy(update={name: size for name, size in sizes.items() if size}),
            sets={_SET: tuple(map(motion.SingleCommand.of, drivable))},
            baseline=DesignBaseline(set=_SET, repetitions=1),
        )


class DesignRequest(Model):
    """The options of ``omnibench design``, whose source is a data set, a config or a robot's file."""

    source: Path | None = None
    use: Use = Field("trajectory", description="Reference poses to calibrate from: all of a run's, or its final one.")
    per: Per = Field("run", description="Effort to keep small: runs, time or distance.")
    runs: int | None = Field(None, ge=1, description="Runs to choose. Default: the fewest within 1 % of the optimum.")
    repetitions: int | None = Field(None, ge=1, description="How often a command may be chosen at most.")
    dataset: str | None = Field(None, description="Name of the data set, if the config has several.")
    integration: Integration | None = Field(None, description="Path within a sample. Default: the config's, or arc.")
    robot: Path | None = Field(None, description="Instead of DATASET|CONFIG: a robot (as in dataset.yaml).")
    limits: RobotLimits = RobotLimits()

    @property
    def choices(self) -> dict[str, Any]:
        """The keyword arguments of ``design_experiment``."""
        return self.model_dump(include={"use", "per", "runs", "repetitions", "dataset", "integration"})

    def candidates(self) -> Path | CandidatePool:
        """The data set or config to design from, or the candidates of a robot's file.

        ConfigError in one line: both or neither are given, options that go with the other, or a value that cannot be.
        """
        if self.robot is not None:
            if self.source is not None:
                raise ConfigError(f"--robot {self.robot}: designs without {self.source}; give one of them")
            refuse_choice(self.dataset, self.robot)
            robot = read_robot(self.robot)
            config = self.limits.config(robot, str(self.robot), self.integration or "arc")
            return candidates_of_config(config, str(self.robot))
        for name in self.limits.model_dump(exclude_none=True):
            raise ConfigError(f"--{name.replace('_', '-')}: is for --robot FILE, a design without a recording")
        if self.source is None:
            raise ConfigError("name a DATASET or a CONFIG, or a robot's file with --robot FILE")
        return self.source


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
        return candidates_of_dataset(load_dataset(path), integration or "arc", str(path))
    content = read_yaml(path)
    if not (isinstance(content, Mapping) and "datasets" in content):
        refuse_choice(dataset, path)
        config = validate(DesignConfig, content, str(path))
        chosen = integration or config.integration
        return candidates_of_config(config.model_copy(update={"integration": chosen}), str(path))
    compared = validate(ComparedData, content, str(path), path.resolve().parent)
    known = compared.datasets
    if dataset is not None and dataset not in known:
        raise UnknownNameError("data set", dataset, known, str(path))
    if dataset is None and len(known) > 1:
        raise ConfigError(f"{path}: it has several data sets; choose one with --dataset: {', '.join(known)}")
    name = dataset or next(iter(known))
    if isinstance(known[name].simulate, RobotConfig):
        raise ConfigError(
            f"{path}: data set {name} is a simulated robot, whose recordings take long to make; make them once with "
            "`omnibench simulate`, and design from their folder"
        )
    return candidates_of_dataset(
        known[name].load(name), integration or compared.integration, f"{path}: data set {name}"
    )


def candidates_of_dataset(dataset: Dataset, integration: Integration = "arc", source: str = "") -> CandidatePool:
    """The commands of the training runs, as recorded; the noise is estimated from their repetitions.

    DataError: no command is named, or only one; the commands leave part of the matrix undetermined; there is no noise.
    """
    place = source or f"data set {dataset.name}"
    training = training_split(dataset)
    if not any(run.has_poses for run in training):
        why = "its runs have no reference poses, from whose noise a design is chosen"
        way_out = "without a recording: omnibench design --robot FILE; without poses: omnibench guide references"
        raise DataError(f"{place}: {why}; {way_out}")
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
        sets={dataset.name: range(len(commands))},
        baseline=np.array([len(runs) for runs in commands.values()]),
        baseline_name=f"the {len(named)} {noun_for(len(named), 'training run')} of {dataset.name}",
        noise=identified.noise,
        noise_source=f"estimated from {identified.noise_source}",
        simulated=dataset.simulated,
        recorded=True,
        notes=tuple(notes),
    )


def candidates_of_config(config: DesignConfig, source: str = "") -> CandidatePool:
    """The commands of a design config, each with the one run of a robot that is exactly as designed.

    ConfigError: a set leaves part of the matrix undetermined, or has one command; the noise is zero.
    """
    place, robot, baseline = source or f"config {config.name}", config.robot, config.baseline
    if _noiseless(config.noise):
        raise ConfigError(f"{place}: noise: give position and heading some; without it, runs cannot be weighed")
    sets = {name: config.commands(name) for name in config.sets}
    commands = list(dict.fromkeys(timed for of_set in sets.values() for timed in of_set))
    same_names = Counter(timed.command.name for timed in commands)
    model, periods = OdometryModel.of_design(robot, config.integration), (config.sample_period, config.pose_period)
    candidates = {}
    for timed in commands:
        name = timed.command.name + (f"_t{timed.duration:.4g}" if same_names[timed.command.name] > 1 else "")
        candidates[timed] = CommandedRun(name, (run_as_designed(model, timed, periods, name),), timed)
    for name, of_set in sets.items():
        if len(of_set) == 1:
            raise ConfigError(f"{place}: {name}: it has one command only; a design needs several to choose from")
        runs = [run for timed in of_set for run in candidates[timed].runs]
        require_every_motion(robot, runs, f"{place}: {name}", ConfigError)
    driven, repetitions = sets[baseline.set], baseline.repetitions
    return CandidatePool(
        source=place,
        name=config.name,
        description=config.description,
        robot=robot,
        integration=config.integration,
        candidates=tuple(candidates.values()),
        sets={name: [commands.index(timed) for timed in of_set] for name, of_set in sets.items()},
        baseline=np.array([repetitions if timed in driven else 0 for timed in commands]),
        baseline_name=f"{len(driven)} {noun_for(len(driven), 'command')} of {baseline.set} x {repetitions}",
        noise=config.noise,
        noise_source="assumed: positions {}, headings {}".format(*noise_in_words(config.noise)),
        simulated=True,
        recorded=False,
        notes=config.notes,
    )


def _noiseless(noise: Noise) -> bool:
    """True if position or heading has no noise of any kind."""
    return any(
        not any(getattr(noise, f"{kind}_{coordinate}") for kind in ("pose", "walk", "bias"))
        for coordinate in ("position", "heading")
    )


def require_every_motion(robot: Robot, runs: Sequence[Trajectory], place: str, error: type[OmnibenchError]) -> None:
    """Raise ``error`` where runs leave out a motion that the robot can make, whose part of the matrix stays unknown."""
    if missing := kept_motions(robot, driven_span(runs), "matrix", "keep"):
        words = " nor along ".join(f"{each.words} ({each.motion})" for each in missing)
        what = "beyond what slip may do, and so cannot identify the matrix there; add commands that do"
        raise error(f"{place}: its commands do not drive the wheels along {words}, {what}")


def refuse_choice(dataset: str | None, source: Path | str) -> None:
    """ConfigError: ``--dataset`` chooses where there is nothing to choose from."""
    if dataset is not None:
        raise ConfigError(f"--dataset: only a comparison config with several data sets needs it; {source} is none")
