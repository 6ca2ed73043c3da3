"""Mistakes by which what was recorded differs from what was meant, in the log or in the robot's file.

A hypothesis that is linear in the drive signals or in the reference's twist transforms a fitted matrix; one about the
robot's file has another design; one about steering angles has logs of its own, and a fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product
from typing import Any

import numpy as np

from omnibench.check.motion_fit import DesignDistance, FreeFit, Windows
from omnibench.data.finding import Finding, Kind
from omnibench.data.recording import corrected_robot
from omnibench.errors import ConfigError
from omnibench.robot.kinematics import Array, CarDrive, Drive, Robot, interpolated, rotation
from omnibench.robot.odometry import WheelLog

_ARRANGED = 4  # wheels of which every order and sign is tried, at most; of more only one mistake
# Other units by the size of the SI unit in them: of wheel rates, and of positions.
RATE_UNITS = ((60 / (2 * math.pi), "rpm"), (180 / math.pi, "deg/s"), (1 / (2 * math.pi), "rev/s"))
POSITION_UNITS = ((1e3, "mm"), (1e2, "cm"), (1 / 0.0254, "inch"))
_COUNTS = (4.0, 2.0, 0.5, 0.25)  # factors of counters: edges counted fourfold, twofold, or stated so and counted once
_GEARS = 1.1 ** np.array([power for power in range(-97, 98) if abs(power) > 3])  # 1/10,000 to 10,000, not about 1
FEWEST_TICKS = 100  # ticks of a turn of the wheel: a factor from there on is named as theirs; chosen
# Cost of a mistake, in units of d^2, so that the simplest explanation is taken of those that fit alike (chosen): each
# wheel that is changed, a reference that is wrong, a factor that is fitted, a zero beyond a right angle, which is
# nearly the same as its wheel counted the other way round.
_WHEEL, _REFERENCE, _FITTED, _REVERSED = 4.0, 4.5, 6.0, 9.0
# Factors of coordinates in the robot's file that are tried, the steps about the best one, and usual causes; chosen.
_FACTORS, _FINER = tuple(1.15**power for power in range(-18, 19) if abs(power) > 1), 1.03
_CAUSES = {
    0.5: ", as where the whole track is given as y, or a diameter as distance",
    2.0: ", as where half of it is given",
    math.sqrt(2): ", as where a side is given for a diagonal",
    math.sqrt(0.5): ", as where a diagonal is given for a side",
}
_NEAR_CAUSE = 0.08
_LEAST_MOUNT, _MOST_MOUNT = 0.15, 10.0  # of the robot's size: a nearer tracked point is for a calibration; chosen
_LEAST_TURNED = math.radians(7.5)  # a smaller turn of the reference is what a calibration is for; chosen
# Steering angles: zeros that are tried of driven wheels, degrees; the least zero, degrees, and factor that are told
# (OptiOdom's tricycle is 1 degree off); how near a factor must be to that of degrees, or to -1; chosen.
_LEAST_ZERO, _ZERO_STEP, _LEAST_GEAR, _ALIKE = 4.0, 2.0, 1.6, 1.25
_LAGS = tuple(np.arange(0.0, 0.41, 0.05).tolist())  # s by which wheels may follow a commanded steering angle
_LAGGING = 0.9  # share of what is unexplained without a lag, below which one is told; chosen
_STEERING_WINDOW = 0.4  # s: short beside the changes of a steering angle; chosen
_GENTLE = 1.0  # m/s2 of lateral acceleration, up to which tyres hardly slip; chosen
_STEERING_SAMPLES = 5_000  # of the runs by which steering angles are fitted; chosen
_GEARS_OF_STEERING = tuple(1.25**power for power in (*range(-34, -1), *range(2, 15)))
DEGREE = math.pi / 180


@dataclass(frozen=True, eq=False)
class Reading:
    """The steering angles (F, S) and rates (F, N) that were meant, of those recorded.

    order, factors, offsets, lag: of the steering angles; offsets in rad, lag in s. rate_order, rate_factors: of rates.
    """

    order: tuple[int, ...] = ()
    factors: Array | float = 1.0
    offsets: Array | float = 0.0
    lag: float = 0.0
    rate_order: tuple[int, ...] = ()
    rate_factors: Array | float = 1.0

    def of(self, log: WheelLog) -> WheelLog:
        """The log as it was meant."""
        rates, steering = log.rates[:, list(self.rate_order)] if self.rate_order else log.rates, log.steering
        if steering is not None:
            ordered = steering[:, list(self.order)] if self.order else steering
            if self.lag:
                ordered = interpolated(log.times - self.lag, log.times, ordered)
            steering = ordered * self.factors + self.offsets
        return replace(log, steering=steering, rates=rates * self.rate_factors)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Mistakes of a recording, and what they make of a fitted matrix.

    rows (3, 3): from the reference's twist as recorded to the one meant. columns (M, M): from the signals that are
    meant to those recorded. cost: of the mistakes, in units of d^2. robot: the design that was meant, if another.
    reading: steering angles and rates that were meant, for which the matrix is fitted anew.
    """

    rows: Array
    columns: Array
    cost: float = 0.0
    mistakes: tuple[Finding, ...] = ()
    robot: Robot | None = None
    reading: Reading | None = None

    def with_reference(self, other: Hypothesis) -> Hypothesis:
        """Both mistakes at once."""
        return replace(self, rows=other.rows, cost=self.cost + other.cost, mistakes=(*self.mistakes, *other.mistakes))


def mistake(kind: Kind, what: str, where: str, changes: Mapping[str, Any] | None = None) -> Finding:
    """The finding of a mistake, with the options that mend it, relative to those by which the recording was read."""
    return Finding(kind=kind, what=what, where=where, severity="error", changes=changes or {})


def wheel_hypotheses(robot: Robot) -> Iterator[Hypothesis]:
    """Wheels that are exchanged, negated, or scaled; the first hypothesis is none of these."""
    drive, names = robot.drive, robot.wheel_names
    plain = Hypothesis(np.eye(3), np.eye(len(drive.names)))
    yield plain
    for order, signs in _arrangements(len(names), orders=drive.direct):
        moved, negative = sum(wheel != column for column, wheel in enumerate(order)), sum(sign < 0 for sign in signs)
        cost = _WHEEL * (moved / 2 + (1 if negative == len(signs) else negative))
        if drive.direct:
            columns = np.zeros((len(names), len(names)))
            columns[np.arange(len(names)), list(order)] = signs  # recorded column = sign x rate of wheel
        elif (factors := signal_factors(robot, np.array(signs, dtype=float))) is not None:
            columns = np.diag(factors)
        else:
            continue
        yield replace(plain, columns=columns, cost=cost, mistakes=(arrangement(names, order, signs),))
    for factor, unit in RATE_UNITS:
        yield replace(plain, columns=factor * plain.columns, cost=_WHEEL, mistakes=(wrong_unit(unit),))
    # Counts of one wheel or of all that are off by a factor.
    for group in groups(len(names)):
        for factor, cost in [*((count, _WHEEL) for count in _COUNTS), *((float(gear), _FITTED) for gear in _GEARS)]:
            factors = signal_factors(robot, np.where(group > 0, factor, 1.0))
            if factors is not None:
                yield replace(plain, columns=np.diag(factors), cost=cost, mistakes=(scaled(names, group, factor),))


def _arrangements(count: int, *, orders: bool) -> Iterator[tuple[Sequence[int], Sequence[int]]]:
    """Orders and signs of up to four wheels, every one but the right one; of more wheels one mistake alone."""
    identity = tuple(range(count))
    if count <= _ARRANGED:
        every: Iterable[tuple[tuple[int, ...], tuple[int, ...]]] = product(
            permutations(identity) if orders else (identity,), product((1, -1), repeat=count)
        )
    else:
        single = [tuple(-1 if index == turned else 1 for index in range(count)) for turned in range(count)]
        every = [(identity, signs) for signs in (*single, (-1,) * count)]
        if orders:
            every = [*every, *((exchanged(count, *pair), (1,) * count) for pair in combinations(identity, 2))]
    yield from ((order, signs) for order, signs in every if order != identity or min(signs) < 0)


def reference_hypotheses(flipped: bool) -> Iterator[Hypothesis]:
    """References that are mirrored, or whose axes are exchanged.

    flipped: the fit was made with headings of the other sign; the positions then are right, or mirrored.
    """

    def pose(signs: Sequence[int], swapped: bool = False, angle: float = 0.0, mirror: bool = True) -> Hypothesis:
        rows = rotation(angle) @ np.diag([1.0, -1.0, -1.0] if mirror else [1.0, 1.0, 1.0])
        changes: dict[str, Any] = {"pose_signs": list(signs)} if min(signs) < 0 else {}
        changes |= {"pose_order": [1, 0, 2]} if swapped else {}
        parts = ["x and y are exchanged"] if swapped else []
        negative = [name for name, sign in zip(("x", "y", "the heading"), signs, strict=True) if sign < 0]
        if negative:
            parts.append(f"{' and '.join(negative)} {'has' if len(negative) == 1 else 'have'} the wrong sign")
        words = f"the reference is mirrored: {' and '.join(parts)}"
        cost = _REFERENCE + 0.1 * (len(negative) + swapped)
        return Hypothesis(rows, np.eye(0), cost, (mistake("reference_mirrored", words, "the reference", changes),))

    quarter = math.pi / 2
    if flipped:
        yield pose((1, 1, -1), mirror=False)
        yield pose((1, -1, 1))
        yield pose((-1, 1, 1), angle=2 * quarter)
        yield pose((1, 1, 1), swapped=True, angle=quarter)
    else:
        yield pose((1, -1, -1))
        yield pose((-1, 1, -1), angle=2 * quarter)
        yield pose((1, 1, -1), swapped=True, angle=quarter)


def position_units() -> Iterator[Hypothesis]:
    """Positions in other units than metres."""
    for factor, unit in POSITION_UNITS:
        words = f"positions look like {unit}; x and y must be m"
        wrong = mistake("position_unit", words, "the reference", {"position_unit": unit})
        yield Hypothesis(np.diag([1 / factor, 1 / factor, 1.0]), np.eye(0), _REFERENCE, (wrong,))


def headings_in_degrees() -> Finding:
    """Headings in degrees."""
    return mistake("heading_unit", "theta looks like degrees; it must be rad", "the reference", {"heading_unit": "deg"})


def turned_reference(robot: Robot, fit: FreeFit, columns: Array) -> Hypothesis | None:
    """A reference, or wheels in the robot's file, turned by the angle that fits best; None if it is small."""
    matrix, design = fit.matrix @ columns, robot.inverse_kinematic_matrix
    inverse = np.linalg.pinv(columns @ np.linalg.pinv(fit.covariance[0]) @ columns.T)
    weights = np.linalg.pinv(inverse) if np.isfinite(inverse).all() else np.eye(matrix.shape[1])
    angle = float(np.angle((matrix[0] + 1j * matrix[1]) @ weights @ (design[0] + 1j * design[1]).conj()))
    if abs(angle) < _LEAST_TURNED:
        return None
    degrees = round(math.degrees(angle), 1)
    words = (
        f"the reference's heading is constantly {abs(degrees):g} degrees too {'small' if degrees > 0 else 'large'}: "
        "the tracked point is turned on the robot"
    )
    if not any(wheel.kind == "fixed" for wheel in robot.wheels):
        words += f", or the wheels' angles in robot.yaml are turned by {-degrees:g} degrees"
    turned = mistake("reference_turned", words, "the reference", {"heading_offset_deg": degrees})
    return Hypothesis(rotation(-angle), columns, _REFERENCE, (turned,))


def design_hypotheses(robot: Robot, fit: FreeFit) -> Iterator[Hypothesis]:
    """Mistakes in the robot's file: distances by a factor, rollers the other way, a tracked point off the centre."""
    plain = Hypothesis(np.eye(3), np.eye(len(robot.drive.names)))
    designs = [robot.inverse_kinematic_matrix]
    for keys, place in ((("x", "y", "distance"), "distances"), (("y",), "y"), (("x",), "x")):
        factor, other = _best_factor(robot, fit, keys)
        if other is None or any(np.allclose(other.inverse_kinematic_matrix, design) for design in designs):
            continue
        designs.append(other.inverse_kinematic_matrix)
        shown, size = (1 / factor, "large") if factor < 1 else (factor, "small")
        cause = next((words for near, words in _CAUSES.items() if abs(factor / near - 1) < _NEAR_CAUSE), "")
        words = f"the {place} of the wheels in robot.yaml look about {rounded(shown)} times too {size}{cause}"
        wrong = mistake("design_distance", words, "robot.yaml", {"wheels": _placed(robot, keys, factor)})
        cost = _REFERENCE if cause and robot.drive.direct else _FITTED
        yield replace(plain, cost=cost, mistakes=(wrong,), robot=other)
    if any(wheel.kind == "mecanum" for wheel in robot.wheels):
        rollers = {
            wheel.name: {"roller_angle_deg": round(-math.degrees(wheel.roller_angle), 3)}
            for wheel in robot.wheels
            if wheel.kind == "mecanum"
        }
        if (other := _corrected(robot, rollers)) is not None:
            words = "the rollers of the wheels in robot.yaml look exchanged: those of left and right wheels"
            wrong = mistake("design_rollers", words, "robot.yaml", {"wheels": rollers})
            yield replace(plain, cost=_WHEEL, mistakes=(wrong,), robot=other)
    if (offset := _tracked_point(robot, fit)) is not None:
        mount = {"x": round(float(offset[0]), 3), "y": round(float(offset[1]), 3)}
        if robot.mount is not None:
            mount = {
                "x": round(mount["x"] + robot.mount.x, 3),
                "y": round(mount["y"] + robot.mount.y, 3),
                "yaw": robot.mount.yaw,
            }
        words = (
            f"the tracked point looks {abs(offset[0]):.2f} m {'ahead of' if offset[0] > 0 else 'behind'} and "
            f"{abs(offset[1]):.2f} m to the {'left' if offset[1] > 0 else 'right'} of where robot.yaml has it"
        )
        wrong = mistake("design_mount", words, "robot.yaml", {"mount": mount})
        yield replace(plain, cost=_FITTED, mistakes=(wrong,), robot=corrected_robot(robot, {}, mount))


def _best_factor(robot: Robot, fit: FreeFit, keys: Sequence[str]) -> tuple[float, Robot | None]:
    """The factor of some of the wheels' coordinates by which the design comes nearest to a fit, and that design."""
    factors, nearest = _FACTORS, (math.inf, 1.0)
    for step in (None, _FINER):
        factors = factors if step is None else tuple(nearest[1] * step**power for power in range(-5, 6))
        for factor in factors:
            if (other := _corrected(robot, _placed(robot, keys, factor))) is not None:
                distance = DesignDistance(other).of(fit)
                nearest = min(nearest, (distance, factor))
    factor = nearest[1]
    return factor, None if math.isinf(nearest[0]) else _corrected(robot, _placed(robot, keys, factor))


def _placed(robot: Robot, keys: Sequence[str], factor: float) -> dict[str, dict[str, float]]:
    """Some coordinates of the wheels times a factor, as the option ``wheels`` takes them."""
    values = {
        wheel.name: {key: float(f"{value * factor:.4g}") for key in keys if (value := getattr(wheel, key))}
        for wheel in robot.wheels
    }
    return {name: coordinates for name, coordinates in values.items() if coordinates}


def _corrected(robot: Robot, wheels: Mapping[str, Mapping[str, Any]]) -> Robot | None:
    """The robot with other values of some wheels; None if nothing changes, or it is no robot."""
    if not wheels:
        return None
    try:
        other = corrected_robot(robot, wheels, None)
        return other if np.isfinite(other.inverse_kinematic_matrix).all() else None
    except (ConfigError, np.linalg.LinAlgError):
        return None


def _tracked_point(robot: Robot, fit: FreeFit) -> Array | None:
    """Where the tracked point is (2,), m, beside where the design has it, by the matrix; None if it is near.

    A point at (x, y) of the robot has rows k1 - y k3 and k2 + x k3.
    """
    design, turn = robot.inverse_kinematic_matrix, fit.matrix[2]
    weights = 1 / np.maximum(np.diag(fit.covariance[0]), 1e-300)
    whole = float(weights @ turn**2)
    off = np.array([weights @ ((fit.matrix[1] - design[1]) * turn), -(weights @ ((fit.matrix[0] - design[0]) * turn))])
    if not whole or not np.isfinite(whole):
        return None
    off = off / whole
    return off if _LEAST_MOUNT * robot.reach < np.hypot(*off) < _MOST_MOUNT * robot.reach else None


def arrangement(names: Sequence[str], order: Sequence[int], signs: Sequence[int]) -> Finding:
    """Recorded column i holds signs[i] times the rate of wheel order[i]."""
    columns = [list(order).index(wheel) for wheel in range(len(names))]
    wheel_signs = [signs[column] for column in columns]
    moved = [names[wheel] for wheel, column in enumerate(columns) if wheel != column]
    negative = [name for name, sign in zip(names, wheel_signs, strict=True) if sign < 0]
    changes: dict[str, Any] = {"wheel_order": columns} if moved else {}
    changes |= {"wheel_signs": wheel_signs} if negative else {}
    if moved:
        shown = ", ".join(
            f"{name} <- {'-' if sign < 0 else ''}{names[column]}"
            for name, column, sign in zip(names, columns, wheel_signs, strict=True)
        )
        flipped = " and sign-flipped" if negative else ""
        words = f"wheels look swapped{flipped}; the reference fits with omega of {shown}"
        return mistake("wheels_swapped", words, wheels_in_words(moved), changes)
    every = len(negative) == len(names)
    which = f"every wheel ({', '.join(names)})" if every and len(names) > 1 else wheels_in_words(negative)
    words = f"{which} {'looks' if every or len(negative) == 1 else 'look'} counted the wrong way round"
    return mistake("wheels_negated" if every else "wheel_negated", words, wheels_in_words(negative), changes)


def signal_factors(robot: Robot, factors: Array) -> Array | None:
    """Factors (M,) of the drive signals if those of the wheels' rates are (N,); None where they mix, as of a car."""
    if len(set(factors.tolist())) == 1:
        return np.full(len(robot.drive.names), factors[0])
    if any(not wheel.has_rate for wheel in robot.wheels if wheel.has_steering):
        return None
    return np.repeat(factors, [1 if pair < 0 else 2 for pair in robot.drive.pairs])


def exchanged(count: int, first: int, second: int) -> tuple[int, ...]:
    """The numbers below ``count`` with two of them exchanged."""
    order = list(range(count))
    order[first], order[second] = second, first
    return tuple(order)


def wrong_unit(unit: str) -> Finding:
    """Wheel rates in another unit than rad/s."""
    words = f"wheel rates look like {'turns a second' if unit == 'rev/s' else unit}; omega_* must be rad/s"
    return mistake("wheel_unit", words, "all wheels", {"wheel_unit": unit})


def scaled(names: Sequence[str], group: Array, factor: float) -> Finding:
    """The wheels of a group (N,) of 0 and 1 whose rates are a factor too high."""
    chosen = members(names, group)
    where = "all wheels" if len(chosen) == len(names) else wheels_in_words(chosen)
    size, shown = ("high", factor) if factor > 1 else ("low", 1 / factor)
    words = f"the rates of {where} look about {rounded(shown)} times too {size}"
    if factor in _COUNTS:
        words += (
            f", as where counts are {'not ' if factor < 1 else ''}multiplied by {shown:g}, or by a gear of {shown:g}"
        )
        words += ", or a diameter is given as the radius" if factor == 2 else ""
    elif 2 * math.pi * factor > FEWEST_TICKS:
        words += f", as ticks would be at about {rounded(2 * math.pi * factor)} a turn of the wheel"
    else:
        words += "; is there a gear between the encoder and the wheel?"
    factors = [float(f"{factor:.3g}") if member else 1.0 for member in group]
    return mistake("wheel_scale", words, where, {"rate_factors": factors})


def rounded(value: float) -> str:
    """A value to two digits."""
    return f"{float(f'{value:.2g}'):,.12g}"


def wheels_in_words(names: Sequence[str]) -> str:
    """``wheel a``, or ``wheels a, b``."""
    return f"wheel{'' if len(names) == 1 else 's'} {', '.join(names)}"


def groups(count: int) -> list[Array]:
    """All wheels together, and each of several, as members (n,) of 0 and 1."""
    return [np.ones(count), *(np.eye(count) if count > 1 else ())]


def members(names: Sequence[str], group: Array) -> list[str]:
    """The names of a group's members."""
    return [name for name, member in zip(names, group.tolist(), strict=True) if member]


def steering_transforms(robot: Robot) -> Iterator[Hypothesis]:
    """Mistakes of steered driven wheels: angles negated or from another zero, and modules exchanged."""
    drive = robot.drive
    if isinstance(drive, CarDrive) or drive.direct:
        return
    plain = Hypothesis(np.eye(3), np.eye(len(drive.names)))
    begins = np.cumsum([0, *(1 if pair < 0 else 2 for pair in drive.pairs)])
    for group in groups(len(drive.steered)):
        flip = _blocks(drive, begins, group, np.diag([1.0, -1.0]))
        yield replace(plain, columns=flip, cost=_WHEEL, mistakes=(clockwise(drive.steered, group),))
        for degrees in np.arange(-180.0 + _ZERO_STEP, 180.1, _ZERO_STEP).tolist():
            if abs(degrees) >= _LEAST_ZERO:
                turn = _blocks(drive, begins, group, rotation(-degrees * DEGREE)[:2, :2])
                cost = _FITTED if abs(degrees) <= 90 else _REVERSED
                yield replace(plain, columns=turn, cost=cost, mistakes=(another_zero(robot, group, degrees),))
    modules = [wheel for wheel, pair in enumerate(drive.pairs) if pair >= 0]
    for first, second in combinations(modules, 2):
        order = np.arange(len(drive.names))
        one, other = (slice(begins[wheel], begins[wheel + 1]) for wheel in (first, second))
        order[one], order[other] = order[other].copy(), order[one].copy()
        wheels = arrangement(drive.wheels, exchanged(len(drive.wheels), first, second), (1,) * len(drive.wheels))
        angles = swapped_angles(drive.steered, drive.pairs[first], drive.pairs[second])
        words = f"wheels {drive.wheels[first]} and {drive.wheels[second]} look swapped, rates and steering angles"
        both = mistake("wheels_swapped", words, wheels.where, {**wheels.changes, **angles.changes})
        yield replace(plain, columns=plain.columns[order], cost=_WHEEL, mistakes=(both,))


def _blocks(drive: Drive, begins: Array, group: Array, block: Array) -> Array:
    """The matrix (M, M) with a block at the two signals of each steered wheel of a group (S,)."""
    whole = np.eye(int(begins[-1]))
    for wheel, pair in enumerate(drive.pairs):
        if pair >= 0 and group[pair]:
            whole[begins[wheel] : begins[wheel + 1], begins[wheel] : begins[wheel + 1]] = block
    return whole


def steering_readings(robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array]) -> Iterator[Hypothesis]:
    """Readings of steering angles that need a fit of their own: exchanged, or with another scale, zero and lag."""
    drive = robot.drive
    if drive.direct:
        return
    plain = Hypothesis(np.eye(3), np.eye(len(drive.names)))
    count = len(drive.steered)
    for pair in combinations(range(count), 2):
        swapped = (swapped_angles(drive.steered, *pair),)
        yield replace(plain, cost=_WHEEL, mistakes=swapped, reading=Reading(order=exchanged(count, *pair)))
    if not isinstance(drive, CarDrive):
        for pair in combinations(range(len(drive.wheels)), 2):
            order = exchanged(len(drive.wheels), *pair)
            rates = (arrangement(drive.wheels, order, (1,) * len(order)),)
            yield replace(plain, cost=_WHEEL, mistakes=rates, reading=Reading(rate_order=order))
    elif len(drive.wheels) > 1:
        for group in groups(len(drive.wheels))[1:]:
            for factor in (-1.0, *_COUNTS):
                wrong = scaled(drive.wheels, group, factor) if factor > 0 else _negated(drive.wheels, group)
                reading = Reading(rate_factors=np.where(group > 0, 1 / factor, 1.0))
                yield replace(plain, cost=_WHEEL, mistakes=(wrong,), reading=reading)
    if not any(wheel.kind == "fixed" for wheel in robot.wheels):
        yield from steering_scales(robot)
        return
    for group in groups(count):  # the steering alone makes such a robot turn
        if (fitted := fitted_steering(robot, logs, poses, group)) is not None:
            named, cost = _named_steering(robot, group, fitted)
            if named:
                yield replace(plain, cost=cost, mistakes=tuple(named), reading=fitted)


def steering_scales(robot: Robot) -> Iterator[Hypothesis]:
    """Steering angles in degrees, of all axles or of one, or by another factor; none of a robot that does not steer."""
    plain, count = Hypothesis(np.eye(3), np.eye(len(robot.drive.names))), len(robot.drive.steered)
    for group in groups(count) if count else ():
        for factor in (DEGREE, *_GEARS_OF_STEERING) if group.all() else (DEGREE,):
            reading = Reading(factors=np.where(group > 0, factor, 1.0))
            wrong, cost = _named_steering(robot, group, reading)
            if wrong:
                yield replace(plain, cost=cost, mistakes=tuple(wrong), reading=reading)


def _negated(wheels: Sequence[str], group: Array) -> Finding:
    return arrangement(wheels, range(len(wheels)), [-1 if member else 1 for member in group.tolist()])


def fitted_steering(robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array], group: Array) -> Reading | None:
    """Scale, zero and lag of the steering angles of a group (S,) by which the design turns as the reference does.

    The heading changes over windows are fitted by k3 . C of the design, with C the integrals of the signals at the
    angles scale x angle + zero, of the time lag earlier. None if nothing turns.
    """
    row_3 = robot.inverse_kinematic_matrix[2]
    every = max(1, sum(len(log.times) for log in logs) // _STEERING_SAMPLES) if len(logs) > 3 else 1
    logs, poses = logs[::every], poses[::every]
    # The way ahead does not depend on the angles, if rates are in another unit.
    rolled = sum(float(np.abs(log.rates).mean(axis=1) @ np.diff(log.times, prepend=0.0)) for log in logs)
    way = sum(float(np.hypot(*np.diff(of_run[:, :2], axis=0).T).sum()) for of_run in poses)
    gain = way / (rolled * float(robot.radii.mean())) if rolled else 1.0
    gain = 1.0 if 1 / _LEAST_GEAR < gain < _LEAST_GEAR else gain

    def turned(values: Array, lag: float) -> tuple[Array, Array]:
        factors, offsets = np.where(group > 0, values[0], 1.0), group * values[1]
        reading = Reading(factors=factors, offsets=offsets, lag=lag, rate_factors=gain)
        windows = Windows.of([reading.of(log) for log in logs], poses, _STEERING_WINDOW)
        if windows is None:
            return np.zeros(0), np.zeros(0)
        # Tyres slip the less, the smaller the lateral acceleration is.
        seconds = windows.times[:, 1] - windows.times[:, 0]
        gentle = np.abs(windows.moved) * np.abs(windows.turned) < _GENTLE * seconds**2
        chosen = gentle if 5 * gentle.sum() > len(gentle) else slice(None)
        return windows.turned[chosen], windows.driven[chosen] @ row_3

    wanted, _ = turned(np.array([1.0, 0.0]), 0.0)
    if len(wanted) < 8 or not np.abs(wanted).max():
        return None
    widest = max(float(np.abs(log.steering[:, group > 0]).max()) for log in logs if log.steering is not None)
    if not widest:
        return None
    from scipy.optimize import least_squares  # slow to import, and needed by robots that steer alone

    deviation = 1.4826 * float(np.median(np.abs(wanted))) + 1e-6

    def solved(start: Array, lag: float) -> tuple[float, float, Array]:
        solution = least_squares(
            lambda values: (wanted - turned(values, lag)[1]) / deviation, start, loss="soft_l1", max_nfev=15,
            x_scale=[max(abs(start[0]), 1e-3), 0.1], diff_step=1e-4,
        )  # fmt: skip
        return float(solution.cost), lag, solution.x

    scales = (1.0, -1.0, min(1.0, 0.3 / widest), -min(1.0, 0.3 / widest))
    at_once = min((solved(np.array([scale, 0.0]), 0.0) for scale in scales), key=_first)
    later = min((solved(at_once[2], lag) for lag in _LAGS[1:]), key=_first)
    later = min((solved(later[2], later[1] + step) for step in (-0.02, 0.0, 0.02)), key=_first)
    _, lag, values = later if later[0] < _LAGGING * at_once[0] else at_once
    return Reading(factors=np.where(group > 0, values[0], 1.0), offsets=group * values[1], lag=lag)


def _first(values: tuple[float, float, Array]) -> float:
    return values[0]


def _named_steering(robot: Robot, group: Array, reading: Reading) -> tuple[list[Finding], float]:
    """The mistakes that a reading of steering angles tells, and their cost; none of what a calibration is for."""
    steered = robot.drive.steered
    names = members(steered, group)
    where = f"steering of {wheels_in_words(names)}"
    factor = float(np.broadcast_to(reading.factors, len(steered))[group > 0][0])
    zero = math.degrees(float(np.broadcast_to(reading.offsets, len(steered))[group > 0][0]))
    wrong, cost = list[Finding](), 0.0
    if 1 / _ALIKE < factor / DEGREE < _ALIKE:
        every = len(names) == len(steered)
        words = (
            "steering angles look like degrees; steer_* must be rad"
            if every
            else f"the steering angle of {wheels_in_words(names)} looks like degrees"
        )
        changes = {"steering_unit": "deg"} if every else {"steering_factors": np.where(group > 0, DEGREE, 1.0).tolist()}
        wrong, cost = [mistake("steering_unit", words, where, changes)], _WHEEL
    elif 1 / _ALIKE < -factor < _ALIKE:
        wrong, cost = [clockwise(steered, group)], _WHEEL
    elif not 1 / _LEAST_GEAR < factor < _LEAST_GEAR:
        shown, size = (1 / abs(factor), "large") if abs(factor) < 1 else (abs(factor), "small")
        words = f"steering angles look about {rounded(shown)} times too {size}"
        count = 2 * math.pi / abs(factor)
        words += (
            f", as ticks would be at about {rounded(count)} a turn of the wheel"
            if count > FEWEST_TICKS
            else f": is it a command, 1 for {abs(factor):.2g} rad, or is there a gear between encoder and wheel?"
        )
        sized = [float(f"{abs(factor):.3g}") if member else 1.0 for member in group]
        wrong = [
            mistake(
                "steering_unit", words, where, {"steering_factors": sized if len(names) < len(steered) else sized[:1]}
            )
        ]
        wrong += [clockwise(steered, group)] if factor < 0 else []
        cost = _REFERENCE
    if abs(zero) >= _LEAST_ZERO or (wrong and abs(zero) >= 0.5):
        wrong, cost = [*wrong, another_zero(robot, group, round(zero, 1))], cost or _FITTED
    if reading.lag:
        words = f"the wheels of {where} follow the column {reading.lag:.2g} s late, as a servo follows its command"
        wrong, cost = [*wrong, mistake("steering_lag", words, where, {"steering_lag": reading.lag})], cost or _FITTED
    return wrong, cost


def clockwise(steered: Sequence[str], group: Array) -> Finding:
    """Steering angles of a group (S,) of 0 and 1 that count clockwise."""
    names, signs = wheels_in_words(members(steered, group)), [-1 if member else 1 for member in group.tolist()]
    words = f"the steering angle of {names} looks counted clockwise; it must count counter-clockwise"
    return mistake("steering_sign", words, f"steering of {names}", {"steering_signs": signs})


def another_zero(robot: Robot, group: Array, degrees: float) -> Finding:
    """Steering angles of a group (S,) of 0 and 1 that lack so many degrees."""
    names = members(robot.drive.steered, group)
    free = not any(wheel.kind == "fixed" for wheel in robot.wheels) and len(names) == len(robot.drive.steered)
    turned = f"; or the reference is turned: heading_offset_deg={degrees:g}" if free else ""
    words = (
        f"the steering angle of {wheels_in_words(names)} looks {abs(degrees):g} degrees too "
        f"{'large' if degrees < 0 else 'small'}, its zero not straight ahead{turned}"
    )
    changes = {"steering_offsets_deg": [degrees if member else 0.0 for member in group.tolist()]}
    return mistake("steering_zero", words, f"steering of {wheels_in_words(names)}", changes)


def swapped_angles(steered: Sequence[str], first: int, second: int) -> Finding:
    """The steering angles of two wheels, exchanged."""
    names = wheels_in_words((steered[first], steered[second]))
    words, order = f"the steering angles of {names} look swapped", list(exchanged(len(steered), first, second))
    return mistake("steering_swapped", words, f"steering of {names}", {"steering_order": order})
