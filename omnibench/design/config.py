"""The config of a design: a robot, the noise of its reference poses, and sets of commands to choose from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from omnibench.config import Model, Positive
from omnibench.data.recording import RobotOption
from omnibench.errors import UnknownNameError
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Robot
from omnibench.robot.odometry import Integration
from omnibench.simulate.commands import MotionGrid, SingleCommand, TimedCommand, beyond_steering, unsteerable
from omnibench.simulate.config import SteeringLimit
from omnibench.words import plural

# They guard memory against slips of the pen and decide nothing else: so many samples of four wheels take 640 MB.
_MOST_COMMANDS = 5000  # commands of a set, at most
_MOST_SAMPLES = 2e7  # wheel samples and poses of a set's commands together, at most
Name = Annotated[str, Field(min_length=1, max_length=60)]


class CommandGrid(MotionGrid):
    """A grid of commands: every direction with every turn rate, at each speed."""

    distance: Positive | None = Field(None, description="length of each run, m; or give duration")
    duration: Positive | None = Field(None, description="duration of each run that is not a turn on the spot, s")

    @model_validator(mode="after")
    def _length_is_given(self) -> CommandGrid:
        if any(self.speeds) and (self.distance is None) == (self.duration is None):
            raise ValueError("give the length of the runs: either distance (m) or duration (s)")
        return self

    def commands(self, robot: Robot) -> Iterator[TimedCommand]:
        """The commands in the order of the grid. ValueError: the robot's wheels do not roll in a direction."""
        for command in self.grid(robot):
            driven = self.duration or (self.distance or 0.0) / max(command.speed, 1e-9)
            yield TimedCommand(command, driven if command.speed else self.turn_duration)


class OtherSet(Model):
    """The commands of another set, included in this one."""

    set: Name = Field(description="its name")


def _kind(block: Any) -> str:
    keys = set(block) if isinstance(block, Mapping) else set()
    if isinstance(block, OtherSet) or "set" in keys:
        return "set"
    return "command" if isinstance(block, SingleCommand) or keys & {"speed", "direction_deg", "turn_rate"} else "grid"


Block = Annotated[
    Annotated[CommandGrid, Tag("grid")] | Annotated[SingleCommand, Tag("command")] | Annotated[OtherSet, Tag("set")],
    Discriminator(_kind),
]


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
    sets: dict[Name, tuple[Block, ...]] = Field(
        min_length=1, description="each a grid of commands, or a list of grids, single commands and other sets"
    )
    baseline: DesignBaseline

    @field_validator("sets", mode="before", json_schema_input_type=dict[Name, Block | tuple[Block, ...]])
    @classmethod
    def _one_block_stands_for_a_list(cls, sets: Any) -> Any:
        if not isinstance(sets, Mapping):
            return sets
        return {name: [blocks] if isinstance(blocks, Mapping) else blocks for name, blocks in sets.items()}

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
            chosen = [timed.command for timed in commands]
            if beyond := unsteerable(self.robot, chosen, self.steering_limit_deg):
                why = beyond_steering(self.robot, beyond, self.steering_limit_deg)
                raise ValueError(f"sets.{name}: {why}; take such commands out")
            samples = sum(command.duration for command in commands) * (1 / self.sample_period + 1 / self.pose_period)
            if len(commands) > _MOST_COMMANDS or samples > _MOST_SAMPLES:
                raise ValueError(
                    f"sets.{name}: {plural(len(commands), 'command')} with {samples:.1g} wheel samples and poses, more "
                    f"than {_MOST_COMMANDS} or {_MOST_SAMPLES:.0e}; check the grids, durations and periods"
                )
        return self

    def commands(self, name: str) -> tuple[TimedCommand, ...]:
        """The commands of a set and of the sets that it includes, each once. ValueError: unknown set, or a circle."""
        return tuple(dict.fromkeys(self._expanded(name, ())))

    def _expanded(self, name: str, above: tuple[str, ...]) -> Iterator[TimedCommand]:
        for block in self.sets[name]:
            if not isinstance(block, OtherSet):
                try:
                    yield from block.commands(self.robot)
                except ValueError as error:
                    raise ValueError(f"sets.{name}: {error}") from None
            elif block.set not in self.sets:
                raise ValueError(str(UnknownNameError("set", block.set, self.sets, f"sets.{name}")))
            elif block.set in (*above, name):
                raise ValueError(f"sets.{name}: includes {block.set!r}, which includes {name!r}; leave one out")
            else:
                yield from self._expanded(block.set, (*above, name))


Use = Literal["final", "trajectory"]
"""Reference poses that a calibration uses: the final one alone, as Eq. (6), or all of them under the noise model."""
Per = Literal["run", "second", "metre"]
"""Cost of a run: 1, its duration, or the distance that its wheels roll (mean of the wheels)."""
