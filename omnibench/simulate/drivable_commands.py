"""Commands that a robot can drive within its limits: lines, arcs and turns on the spot, at several paces."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from omnibench.robot.kinematics import Array, Robot
from omnibench.simulate.commands import (
    Command,
    TimedCommand,
    default_directions,
    is_within,
    sharpest_turn,
    straight_and_pivot,
    wheels_of,
)
from omnibench.simulate.mechanics import TrueMotion

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
    centre may be in, m.
    """

    robot: Robot
    max_speed: float
    max_turn_rate: float
    max_wheel_rate: float
    steering_limit: float
    free: tuple[float, float]
    shapes: Shapes

    def __iter__(self) -> Iterator[TimedCommand]:
        """Lines, arcs to both sides and turns on the spot, each as fast as the limits and the pace allow."""
        for pace in self.shapes.paces:
            yield from self._at_pace(pace)

    def _at_pace(self, pace: float) -> Iterator[TimedCommand]:
        rolls = straight_and_pivot(self.robot)
        pivot = (0.0, 0.0) if rolls is None else rolls[1]
        for direction in map(math.radians, default_directions(self.robot)):
            if line := self._drivable(direction, 0.0, pivot, pace):
                longest = min(max(self.free), LONGEST * line.speed)
                for share in self.shapes.lines:
                    yield TimedCommand(line, tidy(share * longest) / line.speed)
            for radius in self._radii(direction, pivot):
                for side in (1.0, -1.0):
                    if arc := self._drivable(direction, side / radius, pivot, pace):
                        turns = self.shapes.turns
                        yield from self._of_length(arc, [math.radians(turn) * radius / arc.speed for turn in turns])
        for side in (1.0, -1.0):
            turn_rate = side * pace * self._slower(Command(0.0, 0.0, side, pivot))
            spin = Command(0.0, 0.0, turn_rate, pivot)
            if is_within(self.robot, spin, self.steering_limit):
                spins = self.shapes.spins
                yield from self._of_length(spin, [math.radians(turn) / abs(spin.turn_rate) for turn in spins])

    def _radii(self, direction: float, pivot: tuple[float, float]) -> list[float]:
        """Radii of arcs, m: shares of the area, and a little more than the smallest that a robot steers."""
        radii = [tidy(share * max(self.free)) for share in self.shapes.radii]
        if self.robot.drive.direct:
            return radii
        sharpest = sharpest_turn(self.robot, Command(1.0, direction, 1 / SHORTEST, pivot), self.steering_limit)
        if not sharpest:
            return []
        tightest = 1 / sharpest
        return [tidy(_ROOM_TO_STEER * tightest), *radii] if tightest > SHORTEST else radii

    def _drivable(self, direction: float, curvature: float, pivot: tuple[float, float], pace: float) -> Command | None:
        """The fastest command of a shape within the limits, times a pace; None beyond the steering limit.

        curvature: 1/m.
        """
        speed = tidy(pace * self._slower(Command(1.0, direction, curvature, pivot)))
        command = Command(speed, direction, curvature * speed, pivot)
        return command if is_within(self.robot, command, self.steering_limit) else None

    def _slower(self, command: Command) -> float:
        """Factor by which a command becomes as fast as speed, rate of turn and wheels allow."""
        rates, _ = wheels_of(self.robot, command.twist)
        limits = [self.max_wheel_rate / max(np.abs(rates).max(), 1e-12)]
        limits += [self.max_speed / command.speed] if command.speed else []
        limits += [self.max_turn_rate / abs(command.turn_rate)] if command.turn_rate else []
        return float(min(limits))

    def _of_length(self, command: Command, durations: list[float]) -> Iterator[TimedCommand]:
        """The command for those durations, s, that are neither too long nor lead out of the area."""
        for duration in durations:
            long_enough = not command.speed or command.speed * duration >= SHORTEST
            if long_enough and duration <= LONGEST and self._fits(command.twist * duration):
                yield TimedCommand(command, duration)

    def _fits(self, moved: Array) -> bool:
        """True if the path of a constant twist stays in the area from some start and heading. moved (3,): m, m, rad."""
        path = TrueMotion(np.ones(1), np.zeros(3), moved[None], "arc").poses(np.linspace(0.0, 1.0, _POINTS))
        places = path[:, 0] + 1j * path[:, 1]
        turned = places * np.exp(1j * _HEADINGS)[:, None]
        wide, deep = np.ptp(turned.real, axis=1), np.ptp(turned.imag, axis=1)
        return bool(((wide <= self.free[0] + 1e-9) & (deep <= self.free[1] + 1e-9)).any())


def tidy(value: float) -> float:
    """A value rounded down to two digits, as a person sets it."""
    digits = 1 - math.floor(math.log10(value))
    return math.floor(value * 10.0**digits + 1e-9) / 10.0**digits
