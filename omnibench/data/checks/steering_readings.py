"""Mistakes of steering angles, and of a car's wheels: linear ones of driven wheels, and others that need a fit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from omnibench.data.checks.misfit import rounded
from omnibench.data.checks.misreading import Misreading, Transform, arrangement, scaled, wheels_in_words
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import WheelLog
from omnibench.robot.planar import rotation
from omnibench.robot.wheels.drive import CarDrive

DEGREE = math.pi / 180
# Factors of steering angles that are tried, 1.25 apart; nearer to 1 than 1.6 is what a calibration is for (chosen).
_FACTORS = tuple(1.25**power for power in (*range(-14, -1), *range(2, 15)))
_COUNTS = (2.0, 4.0, 0.5, 0.25)  # factors of one wheel of a car
# Zeros of steering angles that are tried, degrees; smaller ones are what a calibration is for: OptiOdom's tricycle is 1
# degree off. A car's are tried in larger steps, since each needs a fit.
_LEAST_ZERO, _ZERO_STEP, _CAR_STEP, _CAR_MOST = 4.0, 2.0, 4.0, 40.0
_SIMPLE, _FITTED = 4.0, 5.0  # cost of a mistake, and of one with a number that is fitted, in units of d^2; chosen
# Cost of a zero beyond a right angle, which is nearly the same as its wheel counted the other way round; chosen.
_REVERSED = 9.0
_BEYOND = 1.9  # rad: angles that steer further may be degrees; chosen


@dataclass(frozen=True, eq=False)
class SteeringReading:
    """The steering angles (F, S) and rates (F, N) that were meant, of those recorded.

    order, signs, factors, offsets: of the steering angles, offsets in rad. rate_order, rate_factors: of the rates.
    """

    mistake: Misreading
    cost: float
    order: tuple[int, ...] = ()
    factors: Array | float = 1.0
    offsets: Array | float = 0.0
    rate_order: tuple[int, ...] = ()
    rate_factors: Array | float = 1.0

    def of(self, log: WheelLog) -> WheelLog:
        """The log as it was meant."""
        assert log.steering is not None  # the robot steers
        steering = log.steering[:, list(self.order)] if self.order else log.steering
        rates = log.rates[:, list(self.rate_order)] if self.rate_order else log.rates
        return replace(log, steering=steering * self.factors + self.offsets, rates=rates * self.rate_factors)


def steering_readings(robot: Robot, logs: Sequence[WheelLog]) -> Iterator[SteeringReading]:
    """Readings of a robot that steers that need a fit of their own; none of one that does not."""
    drive = robot.drive
    if not drive.steered:
        return
    yield from _degrees(drive.steered, logs)
    for factor in _FACTORS:
        yield SteeringReading(_scaled(factor), _FITTED, factors=factor)
    for first, second in combinations(range(len(drive.steered)), 2):
        order = _exchanged(len(drive.steered), first, second)
        yield SteeringReading(_swapped(drive.steered, first, second), _SIMPLE, order=order)
    if not isinstance(drive, CarDrive):
        for first, second in combinations(range(len(drive.wheels)), 2):
            order = _exchanged(len(drive.wheels), first, second)
            mistake = arrangement(drive.wheels, order, (1,) * len(order))
            yield SteeringReading(mistake, _SIMPLE, rate_order=order)
        return
    yield from _of_a_car(robot, drive)


def _of_a_car(robot: Robot, drive: CarDrive) -> Iterator[SteeringReading]:
    for group, signs in _groups(len(drive.steered)):
        yield SteeringReading(turned_round(drive.steered, signs), _SIMPLE, factors=np.array(signs, dtype=float))
        for degrees in np.arange(_CAR_STEP, _CAR_MOST + 1, _CAR_STEP).tolist():
            for sign in (-1, 1):
                mistake = zero(robot, group, sign * degrees)
                yield SteeringReading(mistake, _FITTED, offsets=sign * degrees * DEGREE * group)
    count = len(drive.wheels)
    for wheel in range(count if count > 1 else 0):
        signs = [-1 if index == wheel else 1 for index in range(count)]
        factors = np.array(signs, dtype=float)
        yield SteeringReading(arrangement(drive.wheels, range(count), signs), _SIMPLE, rate_factors=factors)
        chosen = (factors < 0).astype(float)
        for factor in _COUNTS:
            mistake = scaled(drive.wheels, chosen, factor)
            yield SteeringReading(mistake, _SIMPLE, rate_factors=np.where(chosen > 0, 1 / factor, 1.0))


def steering_transforms(robot: Robot) -> Iterator[Transform]:
    """Mistakes of steered driven wheels: angles negated or from another zero, and modules exchanged."""
    drive = robot.drive
    if isinstance(drive, CarDrive):
        return
    begins = np.cumsum([0, *(1 if pair < 0 else 2 for pair in drive.pairs)])
    count = len(drive.names)
    for group, signs in _groups(len(drive.steered)):
        flip = _blocks(drive.pairs, begins, group, np.diag([1.0, -1.0]))
        yield Transform(np.eye(3), flip, _SIMPLE, (turned_round(drive.steered, signs),))
        for degrees in np.arange(-180.0 + _ZERO_STEP, 180.1, _ZERO_STEP).tolist():
            if abs(degrees) >= _LEAST_ZERO:
                turn = _blocks(drive.pairs, begins, group, rotation(-degrees * DEGREE)[:2, :2])
                cost = _FITTED if abs(degrees) <= 90 else _REVERSED
                yield Transform(np.eye(3), turn, cost, (zero(robot, group, degrees),))
    modules = [wheel for wheel, pair in enumerate(drive.pairs) if pair >= 0]
    for first, second in combinations(modules, 2):
        order = np.arange(count)
        one, other = (slice(begins[wheel], begins[wheel + 1]) for wheel in (first, second))
        order[one], order[other] = order[other].copy(), order[one].copy()
        wheels = arrangement(drive.wheels, _exchanged(len(drive.wheels), first, second), (1,) * len(drive.wheels))
        angles = _swapped(drive.steered, drive.pairs[first], drive.pairs[second])
        words = f"wheels {drive.wheels[first]} and {drive.wheels[second]} look swapped, rates and steering angles"
        both = replace(wheels, what=words, changes={**wheels.changes, **angles.changes})
        yield Transform(np.eye(3), np.eye(count)[order], _SIMPLE, (both,))


def _blocks(pairs: Sequence[int], begins: Array, group: Array, block: Array) -> Array:
    """The matrix (M, M) with a block at the two signals of each steered wheel of a group (S,)."""
    whole = np.eye(int(begins[-1]))
    for wheel, pair in enumerate(pairs):
        if pair >= 0 and group[pair]:
            whole[begins[wheel] : begins[wheel + 1], begins[wheel] : begins[wheel + 1]] = block
    return whole


def _degrees(steered: Sequence[str], logs: Sequence[WheelLog]) -> Iterator[SteeringReading]:
    farthest = np.max([np.abs(log.steering).max(axis=0) for log in logs if log.steering is not None], axis=0)
    for group, _ in _groups(len(steered)):
        if (farthest[group > 0] > _BEYOND).any():
            names = [name for name, chosen in zip(steered, group, strict=True) if chosen]
            every = len(names) == len(steered)
            changes = (
                {"steering_unit": "deg"}
                if every
                else {"steering_factors": [DEGREE if chosen else 1.0 for chosen in group.tolist()]}
            )
            words = f"the steering angle of {wheels_in_words(names)} looks like degrees; it must be rad"
            where = f"steering of {wheels_in_words(names)}"
            mistake = Misreading("steering_unit", words, where, changes)
            yield SteeringReading(mistake, _SIMPLE, factors=np.where(group > 0, DEGREE, 1.0))


def _scaled(factor: float) -> Misreading:
    """Steering angles that are to be taken times a factor."""
    shown, size = (1 / factor, "large") if factor < 1 else (factor, "small")
    words = f"steering angles look about {rounded(shown)} times too {size}; is there a gear before the encoder?"
    return Misreading("steering_unit", words, "steering of all wheels", {"steering_factors": [float(f"{factor:.3g}")]})


def _swapped(steered: Sequence[str], first: int, second: int) -> Misreading:
    names = f"{steered[first]}, {steered[second]}"
    return Misreading(
        "steering_swapped",
        f"the steering angles of wheels {names} look swapped",
        f"steering of wheels {names}",
        {"steering_order": list(_exchanged(len(steered), first, second))},
    )


def turned_round(steered: Sequence[str], signs: Sequence[int]) -> Misreading:
    """Steering angles that count clockwise."""
    names = wheels_in_words([name for name, sign in zip(steered, signs, strict=True) if sign < 0])
    words = f"the steering angle of {names} looks counted clockwise; it must count counter-clockwise"
    return Misreading("steering_sign", words, f"steering of {names}", {"steering_signs": list(signs)})


def zero(robot: Robot, group: Array, degrees: float) -> Misreading:
    """Steering angles of a group (S,) of 0 and 1 that lack so many degrees."""
    names = [name for name, chosen in zip(robot.drive.steered, group, strict=True) if chosen]
    free = not any(wheel.kind == "fixed" for wheel in robot.wheels) and len(names) == len(robot.drive.steered)
    turned = f"; or the reference is turned: heading_offset_deg={degrees:g}" if free else ""
    words = (
        f"the steering angle of {wheels_in_words(names)} looks {abs(degrees):g} degrees too "
        f"{'large' if degrees < 0 else 'small'}, its zero not straight ahead{turned}"
    )
    changes = {"steering_offsets_deg": [degrees if chosen else 0.0 for chosen in group.tolist()]}
    return Misreading("steering_zero", words, f"steering of {wheels_in_words(names)}", changes)


def _groups(count: int) -> list[tuple[Array, list[int]]]:
    """All of the steered wheels together, and each of several, as members (S,) of 0 and 1 and as signs."""
    groups = [np.ones(count)] + [row for row in np.eye(count) if count > 1]
    return [(group, [-1 if member else 1 for member in group.tolist()]) for group in groups]


def _exchanged(count: int, first: int, second: int) -> tuple[int, ...]:
    order = list(range(count))
    order[first], order[second] = second, first
    return tuple(order)
