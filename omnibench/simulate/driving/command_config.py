"""Configuration of motion commands: a grid of them, or a list with a duration for each."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product
from typing import Self

from pydantic import Field, FiniteFloat, model_validator

from omnibench.config import Model, NonNegative, Positive
from omnibench.robot.kinematics import Robot
from omnibench.simulate.command import Command, default_directions, straight_and_pivot
from omnibench.simulate.driving.timed_command import TimedCommand
from omnibench.simulate.variation import STEADY, Variation

_ASIDE = 1e-6  # sine of a direction off that of rolling, above which wheels would slide: rounding of degrees


class MotionGrid(Model):
    """Motion commands: every direction with every rate of turn, at each speed."""

    speeds: tuple[NonNegative, ...] = Field((0.2,), min_length=1, description="m/s")
    directions_deg: tuple[FiniteFloat, ...] | None = Field(
        None, min_length=1, description="default: every 45; forward and backward for a robot that cannot go sideways"
    )
    turn_rates: tuple[FiniteFloat, ...] = Field(min_length=1, description="rad/s")
    turn_duration: Positive = Field(6.0, description="duration of turns on the spot, s")

    @property
    def moves(self) -> bool:
        """True if some command moves the robot."""
        return any(self.speeds) or any(self.turn_rates)

    def directions(self, robot: Robot) -> tuple[float, ...]:
        """Directions, deg, for a robot. ValueError: its fixed wheels do not roll in one that is given."""
        if self.directions_deg is None:
            return default_directions(robot)
        rolls = straight_and_pivot(robot)
        for direction in self.directions_deg:
            if rolls is not None and abs(math.sin(math.radians(direction) - rolls[0])) > _ASIDE:
                forward, backward = default_directions(robot)
                raise ValueError(
                    f"directions_deg: this robot's fixed wheels would slide at {direction:g} deg; give {forward:g} and "
                    f"{backward:g}, or leave directions_deg out"
                )
        return self.directions_deg

    def extremes(self, command: Command) -> tuple[Command, ...]:
        """The commands between which a run of this one varies."""
        return (command,)

    def grid(self, robot: Robot) -> list[Command]:
        """Every direction with every rate of turn, at each speed; the direction of a turn on the spot is 0.

        ValueError as for ``directions``.
        """
        rolls = straight_and_pivot(robot)
        pivot = (0.0, 0.0) if rolls is None else rolls[1]
        directions = self.directions(robot)
        return [
            Command(speed, math.radians(direction), turn_rate, pivot)
            for speed, turn_rate in product(self.speeds, self.turn_rates)
            for direction in (directions if speed > 0 else (0.0,))
            if speed or turn_rate
        ]


class SingleCommand(Model):
    """One command with its own duration."""

    speed: NonNegative = Field(0.0, description="m/s")
    direction_deg: FiniteFloat = Field(0.0, description="degrees, in the robot's frame")
    turn_rate: FiniteFloat = Field(0.0, description="rad/s")
    duration: Positive = Field(description="s")

    @model_validator(mode="after")
    def _moves(self) -> Self:
        if not self.speed and not self.turn_rate:
            raise ValueError("this command does not move the robot; give a speed or a turn_rate")
        return self

    def command(self, robot: Robot) -> Command:
        """The motion command. ValueError: the robot's wheels do not roll in its direction."""
        directions = (self.direction_deg,) if self.speed else None
        grid = MotionGrid(speeds=(self.speed,), directions_deg=directions, turn_rates=(self.turn_rate,))
        return grid.grid(robot)[0]

    def commands(self, robot: Robot) -> Iterator[TimedCommand]:
        """The one command, as a grid has many. ValueError as for ``command``."""
        yield TimedCommand(self.command(robot), self.duration)


class ListedCommand(SingleCommand):
    """One command with its own duration, start and repetitions."""

    duration: Positive = Field(description="with its ramps, s")
    repetitions: int = Field(1, gt=0, le=1000)
    heading_deg: FiniteFloat | None = Field(None, description="at the start, degrees; default: as start says")


class Commands(MotionGrid):
    """Motion commands, a grid or a list, and the ramps with which they are driven."""

    turn_rates: tuple[FiniteFloat, ...] = Field((), description="rad/s")
    listed: tuple[ListedCommand, ...] = Field((), description="commands one by one, in the place of the grid")
    ramp: NonNegative = Field(0.0, description="time in which wheel rates rise and fall, which is added to the run, s")
    variation: Variation = Field(STEADY, description="of the commands within a run")

    @model_validator(mode="after")
    def _are_given(self) -> Commands:
        if not self.turn_rates and not self.listed:
            raise ValueError("give turn_rates (rad/s) of a grid of commands, or listed commands")
        return self

    @property
    def moves(self) -> bool:
        return bool(self.listed) or super().moves

    def extremes(self, command: Command) -> tuple[Command, ...]:
        return self.variation.extremes(command)

    def grid(self, robot: Robot) -> list[Command]:
        if not self.listed:
            return super().grid(robot)
        return list(dict.fromkeys(each.command(robot) for each in self.listed))
