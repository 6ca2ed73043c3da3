"""Motion commands: those of a config with twists and times, the wheels that drive them, and those a robot can drive."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from omnibench.config import Model, NonNegative, Positive
from omnibench.robot.kinematics import STEERING_LIMITS, Array, Robot, class_of
from omnibench.simulate.mechanics import TrueMotion

_LARGEST = 90.0  # deg, of other steering than STEERING_LIMITS names
_DIGITS = 9  # of a pivot, m, and a direction, deg: the rest is rounding
_SLACK = 1e-6  # rad, and relative to the signals: rounding of what lies on a limit
_EVERY_WAY = tuple(float(degrees) for degrees in range(0, 360, 45))


@dataclass(frozen=True)
class Command:
    """A motion command: speed (m/s), direction (rad, robot's frame), rate of turn (rad/s).

    pivot: the point, m in the robot's frame, that stands still when the robot turns on the spot, and whose speed is
    commanded: the centre, except for a robot whose fixed wheels have their axle elsewhere.
    """

    speed: float
    direction: float
    turn_rate: float
    pivot: tuple[float, float] = (0.0, 0.0)

    @property
    def name(self) -> str:
        return f"v{self.speed:g}_a{math.degrees(self.direction):g}_w{self.turn_rate:g}"

    @property
    def twist(self) -> Array:
        """(vx, vy, w) of the robot's centre."""
        x, y = self.speed * math.cos(self.direction), self.speed * math.sin(self.direction)
        return np.array([x + self.turn_rate * self.pivot[1], y - self.turn_rate * self.pivot[0], self.turn_rate])


def straight_and_pivot(robot: Robot) -> tuple[float | None, tuple[float, float]]:
    """Direction, rad, in which a robot rolls that cannot go sideways, and its pivot; of others None and the centre."""
    motions = robot.motions
    if len(motions) == 3:
        return None, (0.0, 0.0)
    line, turning = motions
    straight = line / np.hypot(line[0], line[1]) * np.sign(max(line[:2], key=abs))
    turning = turning / turning[2]
    x, y = (round(float(value), _DIGITS) + 0.0 for value in (-turning[1], turning[0]))  # + 0.0: never -0.0
    degrees = round(math.degrees(math.atan2(straight[1], straight[0])), _DIGITS) + 0.0
    return math.radians(degrees), (x, y)


def default_directions(robot: Robot) -> tuple[float, ...]:
    """Directions, deg, where none are given: every 45 degrees; forward and backward for a robot that only rolls."""
    rolling, _ = straight_and_pivot(robot)
    if rolling is None:
        return _EVERY_WAY
    return tuple(round(math.degrees(rolling) + back, _DIGITS) for back in (0.0, 180.0))


def steering_limit(robot: Robot, degrees: float | None) -> float:
    """The largest steering angle, rad: as given in degrees, or the default of the robot's type."""
    return math.radians(STEERING_LIMITS.get(class_of(robot), _LARGEST) if degrees is None else degrees)


def wheels_of(robot: Robot, twist: Array) -> tuple[Array, Array]:
    """Wheel rates (N,), rad/s, and steering angles (S,), rad, that drive a twist by the design values.

    A wheel that would have to steer by more than a quarter turn drives backward.
    """
    with np.errstate(divide="ignore"):  # a car's wheel at a right angle, which its limit refuses
        rates, steering = (values[0] for values in robot.drive.commands((robot.signal_equations @ twist)[None]))
    for wheel, pair in enumerate(robot.drive.pairs):
        if pair >= 0 and abs(steering[pair]) > math.pi / 2 + _SLACK:
            steering[pair] -= math.copysign(math.pi, steering[pair])
            rates[wheel] = -rates[wheel]
    return rates, steering


def is_within(robot: Robot, command: Command, limit: float) -> bool:
    """True if the robot can drive a command with steering angles up to a limit, rad."""
    if robot.drive.direct:
        return True
    signals = robot.signal_equations @ command.twist
    rates, steering = wheels_of(robot, command.twist)
    driven = robot.drive.signals(rates[None], steering[None])[0]
    missed = np.abs(driven - signals).max() > _SLACK * max(np.abs(signals).max(), 1e-9)
    return not missed and np.abs(steering).max() <= limit + _SLACK


def sharpest_turn(robot: Robot, command: Command, limit: float) -> float:
    """The fastest rate of turn, rad/s, that steering up to a limit, rad, allows at a command's speed and side."""
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = (low + high) / 2
        turning = replace(command, turn_rate=middle * command.turn_rate)
        low, high = (middle, high) if is_within(robot, turning, limit) else (low, middle)
    return low * abs(command.turn_rate)


def beyond_steering(robot: Robot, commands: Sequence[Command], limit: float) -> str:
    """Why the first of the commands beyond a steering limit, rad, cannot be driven, and what to give instead."""
    first = next(command for command in commands if not is_within(robot, command, limit))
    degrees = math.degrees(limit)
    if not first.speed:
        return f"{first.name} turns on the spot, which steering angles up to {degrees:g} deg do not allow"
    sharpest = sharpest_turn(robot, first, limit)
    radius = f", a radius of {first.speed / sharpest:.3g} m" if sharpest else ""
    return (
        f"{first.name} needs more than steering_limit_deg {degrees:g}; at {first.speed:g} m/s it turns by "
        f"at most {sharpest:.3g} rad/s{radius}"
    )


class Variation(Model):
    """Variation of every command within a run, by default none: what changes only then shows steering and casters."""

    weave: NonNegative = Field(0.0, description="by which the rate of turn swings about the command's, rad/s")
    period: Positive = Field(4.0, description="of the weave, s")
    reversals: int = Field(0, ge=0, le=1000, description="of the speed within a run; the rate of turn goes on")

    @property
    def is_none(self) -> bool:
        """True if a run holds its command throughout."""
        return not self.weave and not self.reversals

    def extremes(self, command: Command) -> tuple[Command, ...]:
        """The command with the slowest and with the fastest rate of turn that it takes."""
        if not self.weave:
            return (command,)
        return tuple(replace(command, turn_rate=command.turn_rate + side * self.weave) for side in (-1, 1))

    def wheels(self, robot: Robot, command: Command, times: Array, *, ends: bool) -> tuple[Array, Array]:
        """Wheel rates (F, N), rad/s, and steering angles (F, S), rad, by the design in samples that end at times (F,).

        ends: at the samples' ends, else in their middles. Between two reversals steering angles are continuous; after
        each a wheel that would steer by more than a quarter turn drives backward.
        """
        if self.is_none:
            held, angles = wheels_of(robot, command.twist)
            return np.tile(held, (len(times), 1)), np.tile(angles, (len(times), 1))
        middles = times - np.diff(times, prepend=0.0) / 2
        legs = np.floor(middles / times[-1] * (self.reversals + 1)).astype(int)
        swing = self.weave * np.sin(2 * math.pi / self.period * (times if ends else middles))
        straight = replace(command, turn_rate=0.0).twist
        turning = replace(command, speed=0.0, turn_rate=1.0).twist
        twists = (1 - 2 * (legs % 2))[:, None] * straight + (command.turn_rate + swing)[:, None] * turning
        rates, steering = robot.drive.commands(twists @ robot.signal_equations.T)
        for wheel, pair in enumerate(robot.drive.pairs):
            if pair >= 0:
                angles = steering[:, pair].copy()
                for leg in np.unique(legs):  # of rolling either way: continuous, and begins within a quarter turn
                    part = np.unwrap(angles[legs == leg], period=math.pi)
                    angles[legs == leg] = part - math.pi * round(part[0] / math.pi)
                rates[:, wheel] *= np.sign(np.cos(angles - steering[:, pair]))
                steering[:, pair] = angles
        return rates, steering


STEADY = Variation()  # a run holds its command throughout


@dataclass(frozen=True)
class TimedCommand:
    """A motion command with its duration, s.

    ramp: time at its start and its end in which the speed changes, s. variation: of the command within the run.
    """

    command: Command
    duration: float
    ramp: float = 0.0
    variation: Variation = STEADY


_ASIDE = 1e-6  # sine of a direction off that of rolling, above which wheels would slide: rounding of degrees


class MotionGrid(Model):
    """Motion commands: every direction with every rate of turn, at each speed."""

    speeds: tuple[NonNegative, ...] = Field((0.2,), min_length=1, description="m/s")
    directions_deg: tuple[FiniteFloat, ...] | None = Field(
        None, min_length=1, description="default: every 45; forward and backward for a robot that cannot go sideways"
    )
    turn_rates: tuple[FiniteFloat, ...] = Field(min_length=1, description="rad/s")
    turn_duration: Positive = Field(6.0, description="duration of turns on the spot, s")

    def grid(self, robot: Robot) -> list[Command]:
        """Every direction with every rate of turn, at each speed; the direction of a turn on the spot is 0.

        ValueError: the robot's fixed wheels do not roll in a direction.
        """
        rolling, pivot = straight_and_pivot(robot)
        for direction in self.directions_deg or ():
            if rolling is not None and abs(math.sin(math.radians(direction) - rolling)) > _ASIDE:
                forward, backward = default_directions(robot)
                raise ValueError(
                    f"directions_deg: this robot's fixed wheels would slide at {direction:g} deg; give {forward:g} and "
                    f"{backward:g}, or leave directions_deg out"
                )
        directions = default_directions(robot) if self.directions_deg is None else self.directions_deg
        return [
            Command(speed, math.radians(direction), turn_rate, pivot)
            for speed, turn_rate in product(self.speeds, self.turn_rates)
            for direction in (directions if speed > 0 else (0.0,))
            if speed or turn_rate
        ]


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

    @classmethod
    def of(cls, timed: TimedCommand, digits: int = 12, **fields: Any) -> Self:
        """A command as a config lists it. digits: decimals of its rate of turn, rad/s. fields: further ones."""
        command, degrees = timed.command, round(math.degrees(timed.command.direction), 6)
        rate = round(command.turn_rate, digits)
        return cls(speed=command.speed, direction_deg=degrees, turn_rate=rate, duration=timed.duration, **fields)


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

    def grid(self, robot: Robot) -> list[Command]:
        if not self.listed:
            return super().grid(robot)
        return list(dict.fromkeys(each.command(robot) for each in self.listed))


LONGEST = 60.0  # s of a run: a person gets tired, and a reference drifts (chosen)
SHORTEST = 0.1  # m of a line or an arc: a shorter one drowns in noise (chosen)
_ROOM_TO_STEER = 1.15  # times the smallest radius, of an arc: a controller needs some of the steering's range (chosen)
_HEADINGS = np.radians(np.arange(0.0, 180.0, 7.5))  # in which a run may begin in the area, whose sides are two of them
_POINTS = 60  # places of a path at which the area is checked (chosen)


@dataclass(frozen=True)
class Shapes:
    """Shapes of runs that are offered.

    lines, radii: shares of the longer side of the free floor. turns: deg, of an arc. spins: deg, on the spot. paces:
    shares of the fastest that the limits allow.
    """

    lines: tuple[float, ...]
    radii: tuple[float, ...]
    turns: tuple[float, ...]
    spins: tuple[float, ...]
    paces: tuple[float, ...] = (1.0,)


@dataclass(frozen=True)
class DrivableCommands:
    """Limits of a robot, and the commands within them.

    max_speed: m/s. max_turn_rate, max_wheel_rate: rad/s. steering_limit: rad. free: sides of the floor that the robot's
    centre may be in, m. ramp: of every run, s, which makes it longer. variation: of every command within its run.
    """

    robot: Robot
    max_speed: float
    max_turn_rate: float
    max_wheel_rate: float
    steering_limit: float
    free: tuple[float, float]
    shapes: Shapes
    ramp: float = 0.0
    variation: Variation = STEADY

    def __iter__(self) -> Iterator[TimedCommand]:
        """Lines, arcs to both sides and turns on the spot, each as fast as the limits and the pace allow."""
        for command, duration in self._steady():
            extremes = self.variation.extremes(command)
            if all(is_within(self.robot, extreme, self.steering_limit) for extreme in extremes):
                # A person times a run with ramps to a tenth of a second
                seconds = round(duration + self.ramp, 1) if self.ramp else duration
                yield TimedCommand(command, seconds, self.ramp, self.variation)

    def _steady(self) -> Iterator[tuple[Command, float]]:
        """The commands with their durations, s, without ramps."""
        _, pivot = straight_and_pivot(self.robot)
        for pace in self.shapes.paces:
            for direction in map(math.radians, default_directions(self.robot)):
                if line := self._drivable(direction, 0.0, pivot, pace):
                    longest = min(max(self.free), LONGEST * line.speed)
                    for share in self.shapes.lines:
                        yield line, rounded_down(share * longest) / line.speed
                for radius, side in product(self._radii(direction, pivot), (1.0, -1.0)):
                    if arc := self._drivable(direction, side / radius, pivot, pace):
                        durations = [math.radians(turn) * radius / arc.speed for turn in self.shapes.turns]
                        yield from self._of_length(arc, durations)
            for side in (1.0, -1.0):  # turns on the spot
                turn_rate = side * pace * self._slower(Command(0.0, 0.0, side, pivot))
                spin = Command(0.0, 0.0, turn_rate, pivot)
                if is_within(self.robot, spin, self.steering_limit):
                    durations = [math.radians(turn) / abs(turn_rate) for turn in self.shapes.spins]
                    yield from self._of_length(spin, durations)

    def _radii(self, direction: float, pivot: tuple[float, float]) -> list[float]:
        """Radii of arcs, m: shares of the area, and a little more than the smallest that a robot steers."""
        radii = [rounded_down(share * max(self.free)) for share in self.shapes.radii]
        if self.robot.drive.direct:
            return radii
        sharpest = sharpest_turn(self.robot, Command(1.0, direction, 1 / SHORTEST, pivot), self.steering_limit)
        if not sharpest:
            return []
        return [rounded_down(_ROOM_TO_STEER * (1 / sharpest)), *radii] if 1 / sharpest > SHORTEST else radii

    def _drivable(self, direction: float, curvature: float, pivot: tuple[float, float], pace: float) -> Command | None:
        """The fastest command of a shape within the limits, times a pace; None beyond the steering limit.

        curvature: 1/m.
        """
        speed = rounded_down(pace * self._slower(Command(1.0, direction, curvature, pivot)))
        command = Command(speed, direction, curvature * speed, pivot)
        return command if is_within(self.robot, command, self.steering_limit) else None

    def _slower(self, command: Command) -> float:
        """Factor by which a command becomes as fast as speed, rate of turn and wheels allow."""
        rates, _ = wheels_of(self.robot, command.twist)
        limits = [self.max_wheel_rate / max(np.abs(rates).max(), 1e-12)]
        limits += [self.max_speed / command.speed] if command.speed else []
        limits += [self.max_turn_rate / abs(command.turn_rate)] if command.turn_rate else []
        return float(min(limits))

    def _of_length(self, command: Command, durations: list[float]) -> Iterator[tuple[Command, float]]:
        """The command for those durations, s, that are neither too short or long nor lead out of the area, from some
        start and heading."""
        for duration in durations:
            if duration > LONGEST or 0 < command.speed * duration < SHORTEST:
                continue
            motion = TrueMotion(np.ones(1), np.zeros(3), command.twist[None] * duration, "arc")
            path = motion.poses(np.linspace(0.0, 1.0, _POINTS))
            turned = (path[:, 0] + 1j * path[:, 1]) * np.exp(1j * _HEADINGS)[:, None]
            wide, deep = np.ptp(turned.real, axis=1), np.ptp(turned.imag, axis=1)
            if ((wide <= self.free[0] + 1e-9) & (deep <= self.free[1] + 1e-9)).any():
                yield command, duration


def rounded_down(value: float, digits: int = 2) -> float:
    """A value rounded down to so many digits, as a person sets it."""
    decimals = digits - 1 - math.floor(math.log10(value))
    return math.floor(value * 10.0**decimals + 1e-9) / 10.0**decimals
