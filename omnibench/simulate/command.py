"""Motion commands: their twists, and the wheel rates and steering angles that drive them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.robot.kinematics import Array, Robot, class_of

# Largest steering angles where none is given, deg (chosen): a tricycle's front wheel nearly reaches the turn on the
# spot, a car's wheels 30 to 40 deg; any other module drives backward in the place of turning further than 90.
_LIMITS, _LARGEST = {"tricycle": 80.0, "car": 35.0}, 90.0
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


def straight_and_pivot(robot: Robot) -> tuple[float, tuple[float, float]] | None:
    """The direction, rad, in which a robot rolls that cannot go sideways, and its pivot; None for one that can."""
    motions = robot.motions
    if len(motions) == 3:
        return None
    line, turning = motions
    straight = line / np.hypot(line[0], line[1]) * np.sign(max(line[:2], key=abs))
    turning = turning / turning[2]
    x, y = (round(float(value), _DIGITS) + 0.0 for value in (-turning[1], turning[0]))  # + 0.0: never -0.0
    degrees = round(math.degrees(math.atan2(straight[1], straight[0])), _DIGITS) + 0.0
    return math.radians(degrees), (x, y)


def default_directions(robot: Robot) -> tuple[float, ...]:
    """Directions, deg, where none are given: every 45 degrees; forward and backward for a robot that only rolls."""
    rolls = straight_and_pivot(robot)
    return (
        _EVERY_WAY if rolls is None else tuple(round(math.degrees(rolls[0]) + back, _DIGITS) for back in (0.0, 180.0))
    )


def steering_limit(robot: Robot, degrees: float | None) -> float:
    """The largest steering angle, rad: as given in degrees, or the default of the robot's type."""
    if degrees is None:
        degrees = _LIMITS.get(class_of(robot), _LARGEST)
    return math.radians(degrees)


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
    wanted = robot.signal_equations @ command.twist
    rates, steering = wheels_of(robot, command.twist)
    driven = robot.drive.signals(rates[None], steering[None])[0]
    missed = np.abs(driven - wanted).max() > _SLACK * max(np.abs(wanted).max(), 1e-9)
    return not missed and np.abs(steering).max() <= limit + _SLACK


def sharpest_turn(robot: Robot, command: Command, limit: float) -> float:
    """The fastest rate of turn, rad/s, that steering up to a limit, rad, allows at a command's speed and side."""
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = (low + high) / 2
        turning = Command(command.speed, command.direction, middle * command.turn_rate, command.pivot)
        low, high = (middle, high) if is_within(robot, turning, limit) else (low, middle)
    return low * abs(command.turn_rate)


def within_steering(
    robot: Robot, commands: Sequence[Command], degrees: float | None
) -> tuple[list[Command], list[Command]]:
    """The commands that a robot can steer, and those that are beyond its limit, deg, or need it to turn on the spot."""
    limit = steering_limit(robot, degrees)
    kept = [command for command in commands if is_within(robot, command, limit)]
    return kept, [command for command in commands if command not in kept]


def beyond_steering(robot: Robot, left_out: Sequence[Command], degrees: float | None) -> str:
    """The reason why commands cannot be driven, in words, by the example of the first, and what to give instead."""
    first, limit = left_out[0], steering_limit(robot, degrees)
    if not first.speed:
        return f"{first.name} turns on the spot, which steering angles up to {math.degrees(limit):g} deg do not allow"
    sharpest = sharpest_turn(robot, first, limit)
    radius = f", a radius of {first.speed / sharpest:.3g} m" if sharpest else ""
    return (
        f"{first.name} needs more than steering_limit_deg {math.degrees(limit):g}; at {first.speed:g} m/s it turns by "
        f"at most {sharpest:.3g} rad/s{radius}"
    )
