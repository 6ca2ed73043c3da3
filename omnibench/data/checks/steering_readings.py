"""Mistakes of steering angles, and of the wheels of robots that steer: readings, and those that are linear."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from omnibench.data.checks.finding import Finding
from omnibench.data.checks.misreading import (
    FEWEST_TICKS,
    Misreading,
    Reading,
    Transform,
    arrangement,
    exchanged,
    rounded,
    scaled,
    wheels_in_words,
)
from omnibench.robot.kinematics import Array, CarDrive, Drive, Robot, rotation
from omnibench.robot.odometry import WheelLog

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


def steering_readings(robot: Robot, logs: Sequence[WheelLog]) -> Iterator[Reading]:
    """Readings of a robot that steers that need a fit of their own; none of one that does not."""
    drive = robot.drive
    if not drive.steered:
        return
    farthest = farthest_steered(logs)
    for group in groups(len(drive.steered)):
        if (farthest[group > 0] > _BEYOND).any():
            yield in_degrees(drive.steered, group)
    for factor in _FACTORS:
        yield gear(factor)
    yield from _exchanged_angles(drive)
    if not isinstance(drive, CarDrive):
        yield from _exchanged_rates(drive)
        return
    for group in groups(len(drive.steered)):
        yield clockwise(drive.steered, group)
        for degrees in np.arange(_CAR_STEP, _CAR_MOST + 1, _CAR_STEP).tolist():
            for sign in (-1, 1):
                yield another_zero(robot, group, sign * degrees)
    for group in groups(len(drive.wheels))[1:]:
        yield _turned_back(drive.wheels, group)
        for factor in _COUNTS:
            mistake = scaled(drive.wheels, group, factor)
            yield Reading((mistake,), _SIMPLE, rate_factors=np.where(group > 0, 1 / factor, 1.0))


def simple_readings(robot: Robot) -> Iterator[Reading]:
    """One wheel of a robot that steers or its angle, or all, counted the wrong way round; and two exchanged."""
    drive = robot.drive
    for group in groups(len(drive.wheels)):
        yield _turned_back(drive.wheels, group)
    for group in groups(len(drive.steered)):
        yield clockwise(drive.steered, group)
    yield from _exchanged_rates(drive)
    yield from _exchanged_angles(drive)
    for wheels in combinations(_modules(drive), 2):
        angles = tuple(drive.pairs[wheel] for wheel in wheels)
        orders = exchanged(len(drive.steered), *angles), exchanged(len(drive.wheels), *wheels)
        yield Reading((_exchanged_modules(drive, *wheels),), _SIMPLE, order=orders[0], rate_order=orders[1])


def steering_transforms(robot: Robot) -> Iterator[Transform]:
    """Mistakes of steered driven wheels: angles negated or from another zero, and modules exchanged."""
    drive = robot.drive
    if isinstance(drive, CarDrive):
        return
    begins = np.cumsum([0, *(1 if pair < 0 else 2 for pair in drive.pairs)])
    count = len(drive.names)
    for group in groups(len(drive.steered)):
        flip = _blocks(drive.pairs, begins, group, np.diag([1.0, -1.0]))
        yield Transform(np.eye(3), flip, _SIMPLE, clockwise(drive.steered, group).mistakes)
        for degrees in np.arange(-180.0 + _ZERO_STEP, 180.1, _ZERO_STEP).tolist():
            if abs(degrees) >= _LEAST_ZERO:
                turn = _blocks(drive.pairs, begins, group, rotation(-degrees * DEGREE)[:2, :2])
                cost = _FITTED if abs(degrees) <= 90 else _REVERSED
                yield Transform(np.eye(3), turn, cost, another_zero(robot, group, degrees).mistakes)
    for first, second in combinations(_modules(drive), 2):
        order = np.arange(count)
        one, other = (slice(begins[wheel], begins[wheel + 1]) for wheel in (first, second))
        order[one], order[other] = order[other].copy(), order[one].copy()
        yield Transform(np.eye(3), np.eye(count)[order], _SIMPLE, (_exchanged_modules(drive, first, second),))


def _blocks(pairs: Sequence[int], begins: Array, group: Array, block: Array) -> Array:
    """The matrix (M, M) with a block at the two signals of each steered wheel of a group (S,)."""
    whole = np.eye(int(begins[-1]))
    for wheel, pair in enumerate(pairs):
        if pair >= 0 and group[pair]:
            whole[begins[wheel] : begins[wheel + 1], begins[wheel] : begins[wheel + 1]] = block
    return whole


def farthest_steered(logs: Sequence[WheelLog]) -> Array:
    """Largest angle (S,) of each steered wheel, rad."""
    farthest: Array = np.max([np.abs(log.steering).max(axis=0) for log in logs if log.steering is not None], axis=0)
    return farthest


def groups(count: int) -> list[Array]:
    """All wheels together, and each of several, as members (S,) of 0 and 1."""
    return [np.ones(count), *(np.eye(count) if count > 1 else ())]


def in_degrees(steered: Sequence[str], group: Array) -> Reading:
    """Steering angles of a group (S,) of 0 and 1 in degrees."""
    names = _members(steered, group)
    factors = np.where(group > 0, DEGREE, 1.0)
    if len(names) == len(steered):
        words, changes = "steering angles look like degrees; steer_* must be rad", {"steering_unit": "deg"}
    else:
        columns = ", ".join(f"steer_{name}" for name in names)
        words = f"the steering angle of {wheels_in_words(names)} looks like degrees; {columns} must be rad"
        changes = {"steering_factors": factors.tolist()}
    mistake = Misreading("steering_unit", words, f"steering of {wheels_in_words(names)}", changes)
    return Reading((mistake,), _SIMPLE, factors=factors)


def gear(factor: float) -> Reading:
    """Steering angles that are to be taken times a factor."""
    shown, size = (1 / factor, "large") if factor < 1 else (factor, "small")
    words, count = f"steering angles look about {rounded(shown)} times too {size}", 2 * math.pi / factor
    if count > FEWEST_TICKS:
        words += f", as ticks would be at about {rounded(count)} a turn of the wheel"
    else:
        words += "; is there a gear between the encoder and the wheel?"
    changes = {"steering_factors": [float(f"{factor:.3g}")]}
    return Reading((Misreading("steering_unit", words, "steering of all wheels", changes),), _FITTED, factors=factor)


def clockwise(steered: Sequence[str], group: Array) -> Reading:
    """Steering angles of a group (S,) of 0 and 1 that count clockwise."""
    names, signs = wheels_in_words(_members(steered, group)), _signs(group)
    words = f"the steering angle of {names} looks counted clockwise; it must count counter-clockwise"
    mistake = Misreading("steering_sign", words, f"steering of {names}", {"steering_signs": signs})
    return Reading((mistake,), _SIMPLE, factors=np.array(signs, dtype=float))


def another_zero(robot: Robot, group: Array, degrees: float) -> Reading:
    """Steering angles of a group (S,) of 0 and 1 that lack so many degrees."""
    names = _members(robot.drive.steered, group)
    free = not any(wheel.kind == "fixed" for wheel in robot.wheels) and len(names) == len(robot.drive.steered)
    turned = f"; or the reference is turned: heading_offset_deg={degrees:g}" if free else ""
    words = (
        f"the steering angle of {wheels_in_words(names)} looks {abs(degrees):g} degrees too "
        f"{'large' if degrees < 0 else 'small'}, its zero not straight ahead{turned}"
    )
    changes = {"steering_offsets_deg": [degrees if chosen else 0.0 for chosen in group.tolist()]}
    mistake = Misreading("steering_zero", words, f"steering of {wheels_in_words(names)}", changes)
    return Reading((mistake,), _FITTED, offsets=degrees * DEGREE * group)


def frozen_steering(steered: Sequence[str]) -> Finding:
    """Steering angles that never change though those of the robot must."""
    names = wheels_in_words(steered)
    return Finding(
        kind="steering_frozen",
        what=f"the steering angle of {names} never changes, though the reference shows that it must",
        where=f"steering of {names}",
        severity="error",
        fix=f"read the column or topic that holds the angle of {names} (steering_columns; of bags steering_joints or "
        "steering_topic), or record it, and import again",
    )


def _turned_back(wheels: Sequence[str], group: Array) -> Reading:
    signs = _signs(group)
    mistake = arrangement(wheels, range(len(wheels)), signs)
    return Reading((mistake,), _SIMPLE, rate_factors=np.array(signs, dtype=float))


def _exchanged_rates(drive: Drive) -> Iterator[Reading]:
    for pair in combinations(range(len(drive.wheels)), 2):
        order = exchanged(len(drive.wheels), *pair)
        yield Reading((arrangement(drive.wheels, order, (1,) * len(order)),), _SIMPLE, rate_order=order)


def _exchanged_angles(drive: Drive) -> Iterator[Reading]:
    for pair in combinations(range(len(drive.steered)), 2):
        order = exchanged(len(drive.steered), *pair)
        yield Reading((_swapped(drive.steered, *pair),), _SIMPLE, order=order)


def _exchanged_modules(drive: Drive, first: int, second: int) -> Misreading:
    """Two steered driven wheels whose rates and angles are exchanged."""
    count = len(drive.wheels)
    wheels = arrangement(drive.wheels, exchanged(count, first, second), (1,) * count)
    angles = _swapped(drive.steered, drive.pairs[first], drive.pairs[second])
    words = f"wheels {drive.wheels[first]} and {drive.wheels[second]} look swapped, rates and steering angles"
    return replace(wheels, what=words, changes={**wheels.changes, **angles.changes})


def _swapped(steered: Sequence[str], first: int, second: int) -> Misreading:
    names = wheels_in_words((steered[first], steered[second]))
    words, order = f"the steering angles of {names} look swapped", list(exchanged(len(steered), first, second))
    return Misreading("steering_swapped", words, f"steering of {names}", {"steering_order": order})


def _modules(drive: Drive) -> list[int]:
    """Numbers of the driven wheels that steer."""
    return [wheel for wheel, pair in enumerate(drive.pairs) if pair >= 0]


def _members(names: Sequence[str], group: Array) -> list[str]:
    return [name for name, member in zip(names, group.tolist(), strict=True) if member]


def _signs(group: Array) -> list[int]:
    """-1 for the members of a group (S,) of 0 and 1."""
    return [-1 if member else 1 for member in group.tolist()]
