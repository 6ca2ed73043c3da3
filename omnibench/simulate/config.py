"""Configuration of a simulated experiment: the flower generator, and what all generators share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Generic, Literal, Self, TypeVar

from pydantic import AfterValidator, Field, FiniteFloat, model_validator

from omnibench.config import Model, Positive
from omnibench.data.dataset import Split
from omnibench.errors import UnknownNameError
from omnibench.robot.calibration import EffectTerm, Noise
from omnibench.robot.kinematics import PUBLISHED, Robot
from omnibench.robot.odometry import Integration
from omnibench.simulate.commands import Command, Commands, MotionGrid, TimedCommand, beyond_steering, unsteerable
from omnibench.words import plural

_MOST_NOISE = 1e4  # rad/s, or a factor; chosen: a hundred thousand turns a minute
_MOST_RUNS = 100_000  # simulated runs; chosen: more take hours and gigabytes
_MOST_ROWS = 1e8  # wheel samples and poses; more do not fit into memory
SteeringLimit = Annotated[
    float | None,
    Field(None, gt=0, le=180, description="largest steering angle, degrees; default: tricycle 80, car 35, others 90"),
]


def _named(robot: Robot) -> Robot:
    if not robot.name:
        raise ValueError("give the robot a name")
    return robot


NamedRobot = Annotated[Robot, AfterValidator(_named)]


class Tolerances(Model):
    """Standard deviations of the true robot about its design values."""

    radius: float = Field(0.0, ge=0, lt=0.3, description="relative to the radius")
    distance: float = Field(0.0, ge=0, lt=0.3, description="relative to the distance")
    angle_deg: float = Field(0.0, ge=0, lt=30, description="degrees, of the axle or the direction of rolling")
    seed: int = Field(0, ge=0)
    position: float = Field(0.0, ge=0, lt=1, description="of wheels placed by x and y, in each, m")
    steering_deg: float = Field(0.0, ge=0, lt=30, description="offset of each steering angle, degrees")
    mount: float = Field(0.0, ge=0, lt=10, description="of the tracked point's place, in x and y, m")
    mount_deg: float = Field(0.0, ge=0, lt=90, description="of the tracked point's yaw, degrees")

    def check_robot(self, robot: Robot) -> None:
        """ValueError: a tolerance is for another kind of robot."""
        if self.distance and any(wheel.distance is None for wheel in robot.wheels):
            raise ValueError("truth.tolerances.distance: wheels that are placed by x and y have position (m) instead")
        if self.position and all(wheel.distance is not None for wheel in robot.wheels):
            raise ValueError(
                "truth.tolerances.position: these wheels have no x and y; give distance (relative) instead"
            )
        if self.steering_deg and not robot.drive.steered:
            raise ValueError("truth.tolerances.steering_deg: no steering angle of this robot is measured; leave it out")


class Truth(Model):
    """The true robot: its matrix, given by exactly one of published, matrix and tolerances, and its effects."""

    published: str | None = Field(None, description=f"one of {', '.join(PUBLISHED)}")
    matrix: tuple[tuple[FiniteFloat, ...], ...] | None = Field(None, description="3 rows of M, of the drive signals")
    tolerances: Tolerances | None = Field(None, description="drawn about the design")
    lateral_friction: float = Field(
        0.0, ge=0, le=10, description="skid steering, with tolerances: across the wheels, as a share of that along them"
    )
    effects: tuple[EffectTerm, ...] = Field((), description="effects hidden in the data; see omnibench list")

    @model_validator(mode="after")
    def _one_is_given(self) -> Truth:
        given = [name for name in ("published", "matrix", "tolerances") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of published, matrix, tolerances (given: {', '.join(given) or 'none'})")
        if self.published is not None and self.published not in PUBLISHED:
            raise ValueError(str(UnknownNameError("published matrix", self.published, PUBLISHED)))
        names = [term.name for term in self.effects]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"effects: {name} is given twice; add the parameters up, or leave one out")
        return self

    def check_robot(self, robot: Robot) -> None:
        """ValueError: the matrix, a tolerance or the friction is for another robot."""
        signals = robot.drive.names
        if self.matrix is not None and [len(row) for row in self.matrix] != [len(signals)] * 3:
            of = "" if robot.drive.direct else f" ({', '.join(signals)})"
            raise ValueError(f"truth.matrix must have 3 rows of {len(signals)} values{of}")
        if self.published is not None and not (len(robot.wheels) == len(signals) == 3 and robot.drive.direct):
            raise ValueError("truth.published matrices are for three wheels")
        if self.tolerances is not None:
            self.tolerances.check_robot(robot)
        if self.lateral_friction and not (robot.skid and self.tolerances):
            raise ValueError("truth.lateral_friction: is for a robot with skid: true and truth.tolerances")


class RobotSession(Model):
    """One session of recordings: every command, repeated."""

    seed: int = Field(ge=0)
    distance: Positive = Field(description="commanded length of each run, m")


class Session(RobotSession):
    """One session of recordings: every command, repeated, with noise of the reference."""

    noise_scale: float = Field(1.0, ge=0, le=_MOST_NOISE, description="factor on all noise of the reference")


class EncoderNoise(Noise):
    """Noise of the encoders, and of the reference poses as in a calibration file."""

    encoder: float = Field(0.0, ge=0, le=_MOST_NOISE, description="white noise of each wheel rate, rad/s")
    steering: float = Field(0.0, ge=0, le=1, description="white noise of each steering angle, rad")


S = TypeVar("S", bound=RobotSession)


class Experiment(Model, Generic[S]):
    """A simulated experiment: a robot of known truth drives every command in one session or two."""

    generator: str
    robot: NamedRobot
    sample_period: Positive = Field(0.01, description="s")
    commands: MotionGrid
    steering_limit_deg: SteeringLimit = None
    repetitions: int = Field(5, gt=0)
    order: Literal["shuffled", "sorted"] = "shuffled"
    truth: Truth
    train: S
    validation: S | None = None

    @model_validator(mode="after")
    def _something_moves(self) -> Self:
        if not self.commands.moves:
            raise ValueError("commands: no command moves the robot")
        if self.steering_limit_deg is not None and self.robot.drive.direct:
            raise ValueError("steering_limit_deg: no wheel of this robot steers; leave it out")
        self.truth.check_robot(self.robot)
        try:
            grid = self.commands.grid(self.robot)
        except ValueError as error:
            raise ValueError(f"commands.{error}") from None
        if not self.driven:
            raise ValueError(f"commands: {self._beyond(grid)}")
        return self

    @property
    def driven(self) -> list[Command]:
        """The commands within the steering limit, in the order of the grid."""
        return [command for command in self.commands.grid(self.robot) if self._is_steered(command)]

    @property
    def left_out(self) -> tuple[str, ...]:
        """A warning if commands are beyond the steering limit, and are not driven."""
        grid = self.commands.grid(self.robot)
        beyond = [command for command in grid if not self._is_steered(command)]
        if not beyond:
            return ()
        left_out = f"{len(beyond)} of {plural(len(grid), 'command')} cannot be steered and are left out"
        return (f"{left_out}: {self._beyond(beyond)}",)

    def _is_steered(self, command: Command) -> bool:
        return not unsteerable(self.robot, self.commands.extremes(command), self.steering_limit_deg)

    def _beyond(self, left_out: Sequence[Command]) -> str:
        beyond = unsteerable(self.robot, self.commands.extremes(left_out[0]), self.steering_limit_deg)
        return beyond_steering(self.robot, beyond, self.steering_limit_deg)

    @property
    def sessions(self) -> dict[Split, S]:
        """The sessions by the split that they are for."""
        sessions: dict[Split, S] = {"train": self.train}
        if self.validation is not None:
            sessions["validation"] = self.validation
        return sessions


@dataclass(frozen=True)
class PlannedCommand:
    """A command of a session. heading: at the start, rad; None: as for all runs."""

    name: str
    timed: TimedCommand
    repetitions: int
    heading: float | None = None


class FlowerConfig(Experiment[Session]):
    """A simulated flower-shaped experiment: constant commands or ramps, wheel rates and reference poses with noise."""

    generator: Literal["flower"] = "flower"
    pose_period: Positive = Field(0.25, description="time between reference poses, s")
    commands: Commands
    integration: Integration = Field("arc", description="how the true robot moves within a sample")
    noise: EncoderNoise = EncoderNoise()
    start: Literal["fixed", "random"] = Field("fixed", description="at the origin, or anywhere with any heading")
    start_area: Positive = Field(4.0, description="side of the square about the origin for random starts, m")

    @model_validator(mode="after")
    def _can_be_driven(self) -> FlowerConfig:
        planned, chosen = self._all_planned, self.commands
        shortest = min(each.timed.duration for each in planned) - chosen.ramp
        if not chosen.listed and shortest < self.sample_period:
            raise ValueError("runs are shorter than one sample; raise distance or lower sample_period")
        if chosen.ramp > shortest:
            raise ValueError(
                f"commands.ramp: {chosen.ramp:g} s; the shortest run would have to slow down before it has its "
                f"speed, give it less than {shortest:g} s"
            )
        seconds = sum(each.repetitions * each.timed.duration for each in planned)
        rows = seconds / self.sample_period + seconds / self.pose_period
        if rows > _MOST_ROWS:
            raise ValueError(
                f"this is {rows:.1g} wheel samples and poses, more than {_MOST_ROWS:.0e}; "
                "check the periods, distances, speeds and repetitions"
            )
        runs = sum(each.repetitions for each in planned)
        if runs > _MOST_RUNS:
            raise ValueError(
                f"this is {runs} runs, more than {_MOST_RUNS}; give fewer speeds, directions, rates of turn or "
                "repetitions"
            )
        return self

    @property
    def runs(self) -> int:
        """Number of runs of all sessions."""
        return sum(each.repetitions for each in self._all_planned)

    @property
    def _all_planned(self) -> list[PlannedCommand]:
        return [each for session in self.sessions.values() for each in self.planned(session)]

    def planned(self, session: Session) -> list[PlannedCommand]:
        """The commands within the steering limit; ramps lengthen runs of a grid, so that their length in m stays."""
        chosen, driven = self.commands, self.driven
        if not chosen.listed:
            seconds = [session.distance / each.speed if each.speed else chosen.turn_duration for each in driven]
            return [
                PlannedCommand(
                    each.name,
                    TimedCommand(each, driving + chosen.ramp, chosen.ramp, chosen.variation),
                    self.repetitions,
                )
                for each, driving in zip(driven, seconds, strict=True)
            ]
        planned = []
        lengths: dict[Command, set[float]] = {}
        for listed in chosen.listed:
            lengths.setdefault(listed.command(self.robot), set()).add(listed.duration)
        for listed in chosen.listed:
            command = listed.command(self.robot)
            name = command.name if len(lengths[command]) == 1 else f"{command.name}_t{listed.duration:g}"
            heading = None
            if listed.heading_deg is not None:
                name, heading = f"{name}_h{listed.heading_deg:g}", math.radians(listed.heading_deg)
            if command in driven:
                timed = TimedCommand(command, listed.duration, chosen.ramp, chosen.variation)
                planned.append(PlannedCommand(name, timed, listed.repetitions, heading))
        return planned
