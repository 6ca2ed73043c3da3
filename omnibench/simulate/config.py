"""Configuration of a simulated experiment: the flower generator, and what all generators share."""

from __future__ import annotations

import math
from typing import Annotated, Generic, Literal, Self, TypeVar

from pydantic import AfterValidator, Field, FiniteFloat, model_validator

from omnibench.config import Model, NonNegative, Positive
from omnibench.data.dataset import Split
from omnibench.errors import UnknownNameError
from omnibench.robot.calibration import EffectTerm, Noise
from omnibench.robot.kinematics import Robot
from omnibench.robot.odometry import Integration
from omnibench.robot.published_matrices import PUBLISHED

_MOST_NOISE = 1e4  # rad/s, or a factor; chosen: a hundred thousand turns a minute
_MOST_RUNS = 100_000  # simulated runs; chosen: more take hours and gigabytes
_MOST_ROWS = 1e8  # wheel samples and poses; more do not fit into memory


def _named(robot: Robot) -> Robot:
    if not robot.name:
        raise ValueError("give the robot a name")
    return robot


NamedRobot = Annotated[Robot, AfterValidator(_named)]


class Tolerances(Model):
    """Standard deviations of the true wheels about their design values."""

    radius: float = Field(0.0, ge=0, lt=0.3, description="relative to the radius")
    distance: float = Field(0.0, ge=0, lt=0.3, description="relative to the distance")
    angle_deg: float = Field(0.0, ge=0, lt=30, description="degrees")
    seed: int = Field(0, ge=0)


class Truth(Model):
    """The true robot: its matrix, given by exactly one of published, matrix and tolerances, and its effects."""

    published: str | None = Field(None, description=f"one of {', '.join(PUBLISHED)}")
    matrix: tuple[tuple[FiniteFloat, ...], ...] | None = Field(None, description="3 rows of N")
    tolerances: Tolerances | None = Field(None, description="drawn about the design")
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

    def check_wheels(self, robot: Robot) -> None:
        """ValueError: the matrix is for another number of wheels than the robot's."""
        wheels = len(robot.wheels)
        if self.matrix is not None and [len(row) for row in self.matrix] != [wheels] * 3:
            raise ValueError(f"truth.matrix must have 3 rows of {wheels} values")
        if self.published is not None and wheels != 3:
            raise ValueError("truth.published matrices are for three wheels")


class RobotSession(Model):
    """One session of recordings: every command, repeated."""

    seed: int = Field(ge=0)
    distance: Positive = Field(description="commanded length of each run, m")


class Session(RobotSession):
    """One session of recordings: every command, repeated, with noise of the reference."""

    noise_scale: float = Field(1.0, ge=0, le=_MOST_NOISE, description="factor on all noise of the reference")


class MotionGrid(Model):
    """Motion commands: every direction with every rate of turn, at each speed."""

    speeds: tuple[NonNegative, ...] = Field((0.2,), min_length=1, description="m/s")
    directions_deg: tuple[FiniteFloat, ...] = Field(min_length=1)
    turn_rates: tuple[FiniteFloat, ...] = Field(min_length=1, description="rad/s")
    turn_duration: Positive = Field(6.0, description="duration of turns on the spot, s")


class Commands(MotionGrid):
    """Motion commands and the ramps with which they are driven."""

    ramp: NonNegative = Field(0.0, description="time in which wheel rates rise and fall, which is added to the run, s")


class EncoderNoise(Noise):
    """Noise of the encoders, and of the reference poses as in a calibration file."""

    encoder: float = Field(0.0, ge=0, le=_MOST_NOISE, description="white noise of each wheel rate, rad/s")


S = TypeVar("S", bound=RobotSession)


class Experiment(Model, Generic[S]):
    """A simulated experiment: a robot of known truth drives every command in one session or two."""

    generator: str
    robot: NamedRobot
    sample_period: Positive = Field(0.01, description="s")
    commands: MotionGrid
    repetitions: int = Field(5, gt=0)
    order: Literal["shuffled", "sorted"] = "shuffled"
    truth: Truth
    train: S
    validation: S | None = None

    @model_validator(mode="after")
    def _something_moves(self) -> Self:
        if not any(self.commands.speeds) and not any(self.commands.turn_rates):
            raise ValueError("commands: no command moves the robot")
        self.truth.check_wheels(self.robot)
        return self

    @property
    def sessions(self) -> dict[Split, S]:
        """The sessions by the split that they are for."""
        sessions: dict[Split, S] = {"train": self.train}
        if self.validation is not None:
            sessions["validation"] = self.validation
        return sessions


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
        shortest = min(session.distance for session in self.sessions.values()) / max(*self.commands.speeds, 1e-9)
        if math.isfinite(shortest) and shortest < self.sample_period:
            raise ValueError("runs are shorter than one sample; raise distance or lower sample_period")
        if 0.0 in self.commands.speeds:
            shortest = min(shortest, self.commands.turn_duration)
        if self.commands.ramp > shortest:
            raise ValueError(
                f"commands.ramp: {self.commands.ramp:g} s; the shortest run would have to slow down before it has its "
                f"speed, give it less than {shortest:g} s"
            )
        if self._rows() > _MOST_ROWS:
            raise ValueError(
                f"this is {self._rows():.1g} wheel samples and poses, more than {_MOST_ROWS:.0e}; "
                "check the periods, distances, speeds and repetitions"
            )
        if self.runs > _MOST_RUNS:
            raise ValueError(
                f"this is {self.runs} runs, more than {_MOST_RUNS}; give fewer speeds, directions, rates of turn or "
                "repetitions"
            )
        return self

    @property
    def runs(self) -> int:
        """Number of runs of all sessions, at most."""
        chosen = self.commands
        commands = len(chosen.speeds) * len(chosen.directions_deg) * len(chosen.turn_rates)
        return commands * self.repetitions * len(self.sessions)

    def _rows(self) -> float:
        """Number of wheel samples and poses of the experiment."""
        chosen = self.commands
        ways = [session.distance for session in self.sessions.values()]
        driven = [way / speed + chosen.ramp for way in ways for speed in chosen.speeds if speed]
        turns = (chosen.turn_duration + chosen.ramp) * len(ways) * (0.0 in chosen.speeds)
        runs = len(chosen.turn_rates) * self.repetitions
        seconds = runs * (len(chosen.directions_deg) * sum(driven) + turns)
        return seconds / self.sample_period + seconds / self.pose_period
