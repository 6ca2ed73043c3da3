"""Configuration of a simulated experiment: what all generators share, the flower, and the robot link by link."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Generic, Literal, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, Field, FiniteFloat, field_validator, model_validator

from omnibench.config import Model, Positive
from omnibench.data.dataset import Split
from omnibench.errors import UnknownNameError
from omnibench.robot.calibration import EffectTerm, Noise
from omnibench.robot.kinematics import PUBLISHED, Array, Robot, class_of
from omnibench.robot.odometry import Integration
from omnibench.simulate import commands as motion
from omnibench.simulate.commands import Command, Commands, MotionGrid, TimedCommand
from omnibench.simulate.floor_plan import RoomPlan
from omnibench.simulate.lidar import Lidar
from omnibench.simulate.motion_commands import CommandLink, MotionProfile
from omnibench.simulate.motors import TRUE_STEP, Controller, Encoder, Motor
from omnibench.slam.slam_options import SlamOptions
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
        tolerances = self.tolerances or Tolerances()
        placed_by_distance = [wheel.distance is not None for wheel in robot.wheels]
        if tolerances.distance and not all(placed_by_distance):
            raise ValueError("truth.tolerances.distance: wheels that are placed by x and y have position (m) instead")
        if tolerances.position and all(placed_by_distance):
            raise ValueError("truth.tolerances.position: these wheels have no x and y; give distance (relative)")
        if tolerances.steering_deg and not robot.drive.steered:
            raise ValueError("truth.tolerances.steering_deg: no steering angle of this robot is measured; leave it out")
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
        if self.steering_limit_deg is not None and self.robot.drive.direct:
            raise ValueError("steering_limit_deg: no wheel of this robot steers; leave it out")
        self.truth.check_robot(self.robot)
        try:
            grid = self.commands.grid(self.robot)
        except ValueError as error:
            raise ValueError(f"commands.{error}") from None
        if not grid:
            raise ValueError("commands: no command moves the robot")
        if not self.driven:
            raise ValueError(f"commands: {self._why_beyond(grid[0])}")
        return self

    @property
    def _limit(self) -> float:
        """Steering limit, rad."""
        return motion.steering_limit(self.robot, self.steering_limit_deg)

    def _extremes(self, command: Command) -> tuple[Command, ...]:
        """The commands between which a run of this one varies."""
        return self.commands.variation.extremes(command) if isinstance(self.commands, Commands) else (command,)

    def _why_beyond(self, command: Command) -> str:
        return motion.beyond_steering(self.robot, self._extremes(command), self._limit)

    @property
    def driven(self) -> list[Command]:
        """The commands within the steering limit, in the order of the grid."""
        robot, limit = self.robot, self._limit
        grid = self.commands.grid(robot)
        return [c for c in grid if all(motion.is_within(robot, extreme, limit) for extreme in self._extremes(c))]

    @property
    def left_out(self) -> tuple[str, ...]:
        """A warning if commands are beyond the steering limit, and are not driven."""
        grid, driven = self.commands.grid(self.robot), self.driven
        beyond = [command for command in grid if command not in driven]
        if not beyond:
            return ()
        left_out = f"{len(beyond)} of {plural(len(grid), 'command')} cannot be steered and are left out"
        return (f"{left_out}: {self._why_beyond(beyond[0])}",)

    @property
    def sessions(self) -> dict[Split, S]:
        """The sessions by the split that they are for."""
        validation: dict[Split, S] = {} if self.validation is None else {"validation": self.validation}
        return {"train": self.train, **validation}


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
            raise ValueError(f"this is {runs} runs, more than {_MOST_RUNS}; give fewer commands or repetitions")
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
        grid, driven = self.commands, self.driven
        planned = []
        if not grid.listed:
            for command in driven:
                seconds = session.distance / command.speed if command.speed else grid.turn_duration
                timed = TimedCommand(command, seconds + grid.ramp, grid.ramp, grid.variation)
                planned.append(PlannedCommand(command.name, timed, self.repetitions))
            return planned
        durations: dict[Command, set[float]] = {}
        for listed in grid.listed:
            durations.setdefault(listed.command(self.robot), set()).add(listed.duration)
        for listed in grid.listed:
            command = listed.command(self.robot)
            name = command.name if len(durations[command]) == 1 else f"{command.name}_t{listed.duration:g}"
            heading = None
            if listed.heading_deg is not None:
                name, heading = f"{name}_h{listed.heading_deg:g}", math.radians(listed.heading_deg)
            if command in driven:
                timed = TimedCommand(command, listed.duration, grid.ramp, grid.variation)
                planned.append(PlannedCommand(name, timed, listed.repetitions, heading))
        return planned


class Steering(Model):
    """The drives of steering angles. Each turns its wheel to the commanded angle at a constant rate, and holds it."""

    rate_deg: Positive = Field(180.0, description="of a steering motor, degrees/s")
    ticks: int = Field(8192, gt=0, le=10**9, description="of the absolute encoder, per turn of the steering angle")
    noise_deg: float = Field(0.05, ge=0, le=45, description="white noise of the measured angle, degrees")
    waits: bool | None = Field(
        None,
        description="the wheels drive once they are steered; default: true for several driven steered wheels, which "
        "would push against each other, else false",
    )

    def rest(self, robot: Robot, before: Array, targets: Array, sample_period: float) -> int:
        """Samples for which a robot stands until its steering has gone from angles to targets (S,), rad."""
        waits = class_of(robot) == "swerve" if self.waits is None else self.waits
        if not waits:
            return 0
        seconds = np.abs(targets - before).max(initial=0.0) / math.radians(self.rate_deg)
        return math.ceil(seconds / sample_period - 1e-9)

    def angles(self, before: Array, targets: Array, steps: int) -> Array:
        """True angles (steps + 1, S), rad, every millisecond, from those before a run to its targets (S,)."""
        reach = math.radians(self.rate_deg) * TRUE_STEP * np.arange(steps + 1)[:, None]
        turned: Array = before + np.clip(targets - before, -reach, reach)
        return turned

    def measured(self, angles: Array, rng: np.random.Generator) -> Array:
        """Measured angles (F, S) of true ones (F, S), rad: with noise, and in whole ticks."""
        tick = 2 * math.pi / self.ticks
        noisy = angles + math.radians(self.noise_deg) * rng.standard_normal(angles.shape)
        return tick * np.round(noisy / tick)


_MOST_ANGLES = 1e8  # true wheel angles of all runs; more do not fit into memory


class Placement(Model):
    """Standard deviations with which the robot is put back on its mark before each run."""

    position: float = Field(0.02, ge=0, le=1, description="m, in x and y")
    heading_deg: float = Field(2.0, ge=0, le=180, description="degrees")


class RobotConfig(Experiment[RobotSession]):
    """A simulated robot: commands, motors under PID, encoders, true motion, LIDAR in a room, SLAM."""

    generator: Literal["robot"]
    sample_period: Positive = Field(0.01, description="of PID controllers and encoders, s")
    profile: MotionProfile = MotionProfile()
    link: CommandLink = CommandLink()
    settle: float = Field(0.6, ge=0, le=60, description="rest that is recorded after the motion, s")
    motor: Motor = Motor()
    controller: Controller = Controller()
    encoder: Encoder = Encoder()
    steering: Steering = Field(Steering(), description="of robots that steer")
    room: RoomPlan
    radius: Positive = Field(0.25, description="of the robot, to check for collisions, m")
    placement: Placement = Placement()
    lidar: Lidar = Lidar()
    slam: SlamOptions = SlamOptions()

    @field_validator("sample_period")
    @classmethod
    def _whole_milliseconds(cls, period: FiniteFloat) -> FiniteFloat:
        steps = period / TRUE_STEP
        if abs(steps - round(steps)) > 1e-6 or not 1 <= round(steps) <= 100:
            raise ValueError("must be a whole number of milliseconds, 0.001 to 0.1 s")
        return period

    @model_validator(mode="after")
    def _can_be_driven(self) -> RobotConfig:
        coarse, fastest = self.encoder.tick / self.sample_period, self.motor.fastest_rate
        if coarse > fastest / 2:
            raise ValueError(
                f"encoder.ticks: one tick a sample is {coarse:.3g} rad/s, and the motor's fastest rate {fastest:.3g} "
                "rad/s, so that it cannot be controlled; give it more ticks a turn"
            )
        # True wheel angles that are simulated, about.
        sessions, seconds = self.sessions.values(), 0.0
        for command in self.driven:
            limits = self.profile.limits(command)
            rest = 2 / limits.slope + 4 / math.sqrt(limits.jerk) + self.settle
            if not self.robot.drive.direct:  # half a turn of the steering, at most, before each run
                rest += 180 / self.steering.rate_deg
            for session in sessions:
                seconds += rest + (session.distance / command.speed if command.speed else self.commands.turn_duration)
        angles = seconds * self.repetitions * len(self.robot.wheels) / TRUE_STEP
        if angles > _MOST_ANGLES:
            raise ValueError(
                f"this is {angles:.1g} milliseconds of wheels, more than {_MOST_ANGLES:.0e}; check the "
                "distances (m), speeds (m/s), accelerations, settle and repetitions"
            )
        return self
