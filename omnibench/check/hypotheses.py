"""Mistakes by which what was recorded differs from what was meant, in the log or in the robot's file.

A hypothesis says what a mistake does to the rates and steering angles, to the reference's twist or to the design, and
which option mends it. What is linear in the drive signals transforms a fitted matrix; any other reading of the wheels
has logs of its own, and a fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product
from operator import itemgetter
from typing import Any

import numpy as np

from omnibench.check.motion_fit import DesignDistance, FreeFit, Windows
from omnibench.data.finding import Finding, Kind, error
from omnibench.data.recording_options import corrected_robot
from omnibench.errors import ConfigError
from omnibench.robot.kinematics import Array, CarDrive, Drive, Robot, interpolated, rotation
from omnibench.robot.odometry import WheelLog

_ARRANGED = 4  # wheels of which every order and sign is tried, at most; of more only one mistake
# Other units by the size of the SI unit in them: of wheel rates, and of positions.
RATE_UNITS = {"rpm": 60 / (2 * math.pi), "deg/s": 180 / math.pi, "rev/s": 1 / (2 * math.pi)}
POSITION_UNITS = ((1e3, "mm"), (1e2, "cm"), (1 / 0.0254, "inch"))
_COUNTS = (4.0, 2.0, 0.5, 0.25)  # factors of counters: edges counted fourfold, twofold, or stated so and counted once
_GEARS = 1.1 ** np.array([power for power in range(-97, 98) if abs(power) > 3])  # 1/10,000 to 10,000, not about 1
FEWEST_TICKS = 100  # ticks of a turn of the wheel: a factor from there on is named as theirs; chosen
# Cost of a mistake, in units of d^2, so that the simplest explanation is taken of those that fit alike (chosen): each
# wheel that is changed, a reference that is wrong, a factor that is fitted, a zero beyond a right angle, which is
# nearly the same as its wheel counted the other way round.
_WHEEL, _REFERENCE, _FITTED, _REVERSED = 4.0, 4.5, 6.0, 9.0
# Factors of radii in the robot's file that are tried: half to double in steps of 3 %, without those that a calibration
# is for; a diameter given as the radius. The same factor of all rates explains as much: where rates are recorded the
# radius is likelier, where ticks are their count, and the likelier one costs less by _LIKELIER. Chosen.
_RADII, _DIAMETER, _LIKELIER = 1.03 ** np.array([power for power in range(-25, 26) if abs(power) > 4]), 2.0, 0.4
# Factors of coordinates in the robot's file that are tried, the steps about the best one, and usual causes; chosen.
_FACTORS = tuple(1.15**power for power in range(-18, 19) if abs(power) > 1)
_FINER = tuple(1.03**power for power in range(-5, 6))
_CAUSES = {
    0.5: ", as where the whole track is given as y, or a diameter as distance",
    2.0: ", as where half of it is given",
    math.sqrt(2): ", as where a side is given for a diagonal",
    math.sqrt(0.5): ", as where a diagonal is given for a side",
}
_NEAR_CAUSE = 0.08  # share by which a factor may differ from that of a usual cause; chosen
# A tracked point is a mistake of the file from this distance to that, in sizes of the robot (chosen): a calibration
# finds what is nearer, and what is farther is no point of the robot.
_NEAREST_MOUNT, _FARTHEST_MOUNT = 0.15, 10.0
_LEAST_TURNED = math.radians(7.5)  # a smaller turn of the reference is what a calibration is for; chosen
# Zeros of driven steered wheels that are tried, and the least one that is a mistake, degrees; the least factor that is
# one; and how near a factor must be to that of degrees, or to -1 (chosen: OptiOdom's tricycle is 1 degree off).
_ZERO_STEP, _LEAST_ZERO, _LEAST_GEAR, _ALIKE = 2.0, 4.0, 1.6, 1.25
_LAGS = tuple(np.arange(0.0, 0.41, 0.05).tolist())  # s by which wheels may follow a commanded steering angle
_LAGGING = 0.9  # share of the cost without a lag, below which a lag is a mistake of its own; chosen
_STEERING_WINDOW = 0.4  # s: short beside the changes of a steering angle; chosen
_STEERING_SAMPLES = 5_000  # wheel samples, of evenly chosen runs, that scale, zero and lag are fitted to; chosen
_GEARS_OF_STEERING = tuple(1.25**power for power in (*range(-34, -1), *range(2, 15)))
DEGREE = math.pi / 180
_REFERENCED = "the reference"
IN_DEGREES = error("heading_unit", "theta looks like degrees; it must be rad", _REFERENCED, {"heading_unit": "deg"})


@dataclass(frozen=True, eq=False)
class Reading:
    """The rates (F, N) and steering angles (F, S) that were meant, of those recorded.

    rate_order, rate_factors: of the rates. order, factors, offsets, lag: of the steering angles; offsets in rad, lag in
    s. An empty order is the recorded one.
    """

    rate_order: Sequence[int] = ()
    rate_factors: Array | Sequence[float] | float = 1.0
    order: Sequence[int] = ()
    factors: Array | float = 1.0
    offsets: Array | float = 0.0
    lag: float = 0.0

    def of(self, log: WheelLog) -> WheelLog:
        """The log as it was meant."""
        rates, steering = log.rates[:, list(self.rate_order)] if self.rate_order else log.rates, log.steering
        if steering is not None:
            ordered = steering[:, list(self.order)] if self.order else steering
            if self.lag:
                ordered = interpolated(log.times - self.lag, log.times, ordered)
            steering = ordered * self.factors + self.offsets
        return replace(log, steering=steering, rates=rates * np.asarray(self.rate_factors))

    def columns(self, drive: Drive) -> Array | None:
        """The matrix (M, M) from the drive signals that were meant to those recorded; None if they are not linear."""
        wheels, angles, signals = len(drive.wheels), len(drive.steered), len(drive.names)
        rate_order, order = self.rate_order or range(wheels), self.order or range(angles)
        rate_factors = np.broadcast_to(self.rate_factors, wheels)
        factors, offsets = np.broadcast_to(self.factors, angles), np.broadcast_to(self.offsets, angles)
        if isinstance(drive, CarDrive):  # its signals mix the rates of all wheels
            alike = not self.order and np.ptp(rate_factors) == 0
            return np.eye(signals) / rate_factors[0] if alike else None
        if drive.direct:
            return np.eye(signals)[:, list(rate_order)] / rate_factors
        if self.lag or (np.abs(factors) != 1).any():
            return None
        begins = np.cumsum([0, *(1 if pair < 0 else 2 for pair in drive.pairs)])
        columns = np.zeros((signals, signals))
        for wheel, (column, pair) in enumerate(zip(rate_order, drive.pairs, strict=True)):
            if drive.pairs[column] != (pair if pair < 0 else order[pair]):
                return None  # the rate of one wheel, and the angle of another
            block = np.ones((1, 1))
            if pair >= 0:  # recorded (cos, sin) of sign x (phi - offset)
                block = np.diag([1.0, factors[pair]]) @ rotation(-float(offsets[pair]))[:2, :2]
            columns[begins[column] : begins[column + 1], begins[wheel] : begins[wheel + 1]] = block
            columns[:, begins[wheel] : begins[wheel + 1]] /= rate_factors[wheel]
        return columns


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Mistakes of a recording, and what they make of a fitted matrix.

    rows (3, 3): from the reference's twist as recorded to the one meant. columns (M, M): from the signals that are
    meant to those recorded. cost: of the mistakes, in units of d^2. robot: the design that was meant, if another.
    reading: steering angles and rates that were meant, where the matrix must be fitted anew.
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


def plain_hypothesis(robot: Robot) -> Hypothesis:
    """No mistake."""
    return Hypothesis(np.eye(3), np.eye(len(robot.drive.names)))


def wheel_hypotheses(robot: Robot, *, counted: bool = False) -> Iterator[Hypothesis]:
    """Rates and steering angles that are exchanged, negated, scaled or from another zero; the first is no mistake.

    Radii of the robot's file are among them, which scale the rates. counted: True if rates were made of ticks.
    """
    yield (plain := plain_hypothesis(robot))
    for reading, cost, mistake in (*_misread_rates(robot, counted), *_misread_angles(robot)):
        if (columns := reading.columns(robot.drive)) is not None:
            yield replace(plain, columns=columns, cost=cost, mistakes=(mistake,))
        elif cost <= _WHEEL:  # each is a fit
            yield replace(plain, cost=cost, mistakes=(mistake,), reading=reading)


def _misread_rates(robot: Robot, counted: bool) -> Iterator[tuple[Reading, float, Finding]]:
    """Each mistake of rates or radii: the reading that was meant, the cost of the mistake, and the finding."""
    names, groups = robot.wheel_names, _groups(len(robot.wheel_names))
    for order, signs in _arrangements(len(names), orders=robot.drive.direct):
        moved, negative = sum(wheel != column for wheel, column in enumerate(order)), sum(sign < 0 for sign in signs)
        # Positions alone do not tell ahead from back: of readings alike to them those that keep it come first.
        cost = _WHEEL * (moved / 2 + (1.05 if negative == len(signs) else negative))
        yield Reading(order, signs), cost, _arrangement(names, order, signs)
    for unit, factor in RATE_UNITS.items():
        words = f"wheel rates look like {'turns a second' if unit == 'rev/s' else unit}; omega_* must be rad/s"
        yield Reading((), 1 / factor), _WHEEL, error("wheel_unit", words, "all wheels", {"wheel_unit": unit})
    for group in groups:
        for factor, cost in [*((count, _WHEEL) for count in _COUNTS), *((float(gear), _FITTED) for gear in _GEARS)]:
            yield Reading((), np.where(group > 0, 1 / factor, 1.0)), cost, _scaled(names, group, factor)
    # A diameter given as the radius, and other factors.
    diameter = _WHEEL + (_LIKELIER if counted else -_LIKELIER)
    yield Reading((), 1 / _DIAMETER), diameter, _radius(robot, groups[0], _DIAMETER)
    for group in groups:
        for factor in _RADII.tolist():
            yield Reading((), np.where(group > 0, 1 / factor, 1.0)), _FITTED, _radius(robot, group, factor)


def _misread_angles(robot: Robot) -> Iterator[tuple[Reading, float, Finding]]:
    """Each mistake of steering angles, perhaps with the rates of their wheels."""
    drive, names = robot.drive, robot.wheel_names
    for pair in combinations(range(len(drive.steered)), 2):
        yield _exchanged_angles(drive, *pair)
    if drive.direct or isinstance(drive, CarDrive):
        return
    for group in _groups(len(drive.steered)):
        yield Reading(factors=np.where(group > 0, -1.0, 1.0)), _WHEEL, _clockwise(drive.steered, group)
        for degrees in np.arange(-180.0 + _ZERO_STEP, 180.1, _ZERO_STEP).tolist():
            if abs(degrees) >= _LEAST_ZERO:
                cost = _FITTED if abs(degrees) <= 90 else _REVERSED
                yield Reading(offsets=group * degrees * DEGREE), cost, another_zero(robot, group, degrees)
    for first, second in combinations(range(len(names)), 2):
        order = exchanged(len(names), first, second)
        rates = _arrangement(names, order, (1,) * len(names))
        yield Reading(order), _WHEEL, rates
        if min(drive.pairs[first], drive.pairs[second]) >= 0:
            reading, _, angles = _exchanged_angles(drive, drive.pairs[first], drive.pairs[second])
            words = f"wheels {names[first]} and {names[second]} look swapped, rates and steering angles"
            both = error("wheels_swapped", words, rates.where, {**rates.changes, **angles.changes})
            yield replace(reading, rate_order=order), _WHEEL, both


def _arrangements(count: int, *, orders: bool) -> list[tuple[Sequence[int], Sequence[int]]]:
    """The recorded column and the sign of each wheel: every one but the right one, of more than four one mistake."""
    identity = tuple(range(count))
    if count <= _ARRANGED:
        every = [*product(permutations(identity) if orders else (identity,), product((1, -1), repeat=count))]
    else:
        single = (1 - 2 * np.eye(count, dtype=int)).tolist()
        every = [(identity, tuple(signs)) for signs in (*single, [-1] * count)]
        every += [(exchanged(count, *pair), (1,) * count) for pair in combinations(identity if orders else (), 2)]
    return [(order, signs) for order, signs in every if order != identity or min(signs) < 0]


def reference_hypotheses(flipped: bool) -> Iterator[Hypothesis]:
    """References that are mirrored, or whose axes are exchanged.

    flipped: the fit was made with headings of the other sign; the positions then are right, or mirrored.
    """
    mirror, heading = np.diag([1.0, -1.0, -1.0]), 1 if flipped else -1
    ways: list[tuple[tuple[int, int, int], bool, Array]] = [((1, 1, -1), False, np.eye(3))] if flipped else []
    ways += [((1, -1, heading), False, mirror), ((-1, 1, heading), False, rotation(math.pi) @ mirror)]
    for signs, swapped, rows in [*ways, ((1, 1, heading), True, rotation(math.pi / 2) @ mirror)]:
        changes: dict[str, Any] = {"pose_signs": list(signs)} if min(signs) < 0 else {}
        changes |= {"pose_order": [1, 0, 2]} if swapped else {}
        parts = ["x and y are exchanged"] if swapped else []
        negative = [name for name, sign in zip(("x", "y", "the heading"), signs, strict=True) if sign < 0]
        if negative:
            parts.append(f"{' and '.join(negative)} {'has' if len(negative) == 1 else 'have'} the wrong sign")
        wrong = error("reference_mirrored", f"the reference is mirrored: {' and '.join(parts)}", _REFERENCED, changes)
        yield Hypothesis(rows, np.eye(0), _REFERENCE + 0.1 * (len(negative) + swapped), (wrong,))


def mirrored_positions() -> Hypothesis:
    """Positions without headings, with y to the right."""
    words = "the reference is mirrored: y has the wrong sign"
    wrong = error("reference_mirrored", words, _REFERENCED, {"pose_signs": [1, -1, 1]})
    return Hypothesis(np.diag([1.0, -1.0, 1.0]), np.eye(0), _REFERENCE, (wrong,))


def position_units() -> Iterator[Hypothesis]:
    """Positions in other units than metres."""
    for factor, unit in POSITION_UNITS:
        words = f"positions look like {unit}; x and y must be m"
        wrong = error("position_unit", words, _REFERENCED, {"position_unit": unit})
        yield Hypothesis(np.diag([1 / factor, 1 / factor, 1.0]), np.eye(0), _REFERENCE, (wrong,))


def turned_reference(robot: Robot, fit: FreeFit, columns: Array) -> Hypothesis | None:
    """A reference, or wheels in the robot's file, turned by the angle that fits best; None if it is small."""
    matrix, design = fit.matrix @ columns, robot.inverse_kinematic_matrix
    inverse = np.linalg.pinv(columns @ np.linalg.pinv(fit.covariance[0]) @ columns.T)
    weights = np.linalg.pinv(inverse) if np.isfinite(inverse).all() else np.eye(matrix.shape[1])
    angle = float(np.angle((matrix[0] + 1j * matrix[1]) @ weights @ (design[0] + 1j * design[1]).conj()))
    if abs(angle) < _LEAST_TURNED:
        return None
    degrees = round(math.degrees(angle), 1)
    words = f"the reference's heading is constantly {abs(degrees):g} degrees too {'small' if degrees > 0 else 'large'}"
    words += ": the tracked point is turned on the robot"
    if not _has_fixed_wheels(robot):
        words += f", or the wheels' angles in robot.yaml are turned by {-degrees:g} degrees"
    turned = error("reference_turned", words, _REFERENCED, {"heading_offset_deg": degrees})
    return Hypothesis(rotation(-angle), columns, _REFERENCE, (turned,))


def design_hypotheses(robot: Robot, fit: FreeFit) -> Iterator[Hypothesis]:
    """Mistakes in the robot's file: distances by a factor, rollers the other way, a tracked point off the centre."""
    plain, designs = plain_hypothesis(robot), [robot.inverse_kinematic_matrix]

    def wrong(kind: Kind, words: str, changes: Mapping[str, Any], other: Robot, cost: float) -> Hypothesis:
        return replace(plain, cost=cost, mistakes=(error(kind, words, "robot.yaml", changes),), robot=other)

    for keys, place in ((("x", "y", "distance"), "distances"), (("y",), "y"), (("x",), "x")):
        distance, factor, other = math.inf, 1.0, robot
        for tried in (_FACTORS, _FINER):  # the second about the best of the first
            for scaled in [factor * each for each in tried]:
                if (candidate := _corrected(robot, _placed(robot, keys, scaled))) is not None:
                    candidates = ((distance, factor, other), (DesignDistance(candidate).of(fit), scaled, candidate))
                    distance, factor, other = min(candidates, key=itemgetter(0, 1))
        if any(np.allclose(other.inverse_kinematic_matrix, design) for design in designs):
            continue
        designs.append(other.inverse_kinematic_matrix)
        cause = next((words for near, words in _CAUSES.items() if abs(factor / near - 1) < _NEAR_CAUSE), "")
        words = f"the {place} of the wheels in robot.yaml look about {_times_too(1 / factor, 'large', 'small')}{cause}"
        # A factor of one steered axle may be one of its angles as well.
        cost = _REFERENCE if cause and (robot.drive.direct or len(robot.drive.steered) > 2) else _FITTED
        yield wrong("design_distance", words, {"wheels": _placed(robot, keys, factor)}, other, cost)
    mecanum = [wheel for wheel in robot.wheels if wheel.kind == "mecanum"]
    rollers = {wheel.name: {"roller_angle_deg": round(-math.degrees(wheel.roller_angle), 3)} for wheel in mecanum}
    if (exchanged_rollers := _corrected(robot, rollers)) is not None:
        words = "the rollers of the wheels in robot.yaml look exchanged: those of left and right wheels"
        yield wrong("design_rollers", words, {"wheels": rollers}, exchanged_rollers, _WHEEL)
    # Offset (2,), m, of the tracked point from its place in the design: one at (x, y) has rows k1 - y k3 and k2 + x k3.
    design, turn = robot.inverse_kinematic_matrix, fit.matrix[2]
    weights = 1 / np.maximum(np.diag(fit.covariance[0]), 1e-300)
    whole = float(weights @ turn**2)
    off = np.array([weights @ ((fit.matrix[1] - design[1]) * turn), -(weights @ ((fit.matrix[0] - design[0]) * turn))])
    offset = off / whole if whole and np.isfinite(whole) else np.full(2, np.nan)
    if (mistake := another_mount(robot, offset)) is not None:
        other = corrected_robot(robot, {}, mistake.changes["mount"])
        yield replace(plain, cost=_FITTED, mistakes=(mistake,), robot=other)


def another_mount(robot: Robot, offset: Array) -> Finding | None:
    """The tracked point (2,), m, beside where the robot's file has it; None if it is near, or no point of the robot."""
    if not _NEAREST_MOUNT * robot.reach < np.hypot(*offset) < _FARTHEST_MOUNT * robot.reach:
        return None
    mount = {"x": round(float(offset[0]), 3), "y": round(float(offset[1]), 3)}
    if (present := robot.mount) is not None:
        mount = {key: round(value + getattr(present, key), 3) for key, value in mount.items()}
        mount["yaw"] = present.yaw
    words = f"the tracked point looks {abs(offset[0]):.2f} m {'ahead of' if offset[0] > 0 else 'behind'} and "
    words += f"{abs(offset[1]):.2f} m to the {'left' if offset[1] > 0 else 'right'} of where robot.yaml has it"
    return error("design_mount", words, "robot.yaml", {"mount": mount})


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


def steering_readings(robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array]) -> Iterator[Hypothesis]:
    """Steering angles with another scale, zero and lag: fitted where the steering alone makes the robot turn."""
    if robot.drive.direct:
        return
    if not _has_fixed_wheels(robot):
        yield from steering_scales(robot)
        return
    for group in _groups(len(robot.drive.steered)):
        if (fitted := _fitted_steering(robot, logs, poses, group)) is not None:
            yield from _named_steering(robot, group, fitted)


def steering_scales(robot: Robot) -> Iterator[Hypothesis]:
    """Steering angles in degrees, of all axles or of one, or by another factor; none of a robot that does not steer."""
    for group in _groups(len(robot.drive.steered)) if robot.drive.steered else ():
        for factor in (DEGREE, *_GEARS_OF_STEERING) if group.all() else (DEGREE,):
            yield from _named_steering(robot, group, Reading(factors=np.where(group > 0, factor, 1.0)))


def _fitted_steering(robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array], group: Array) -> Reading | None:
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

    def reading(values: Array, lag: float) -> Reading:
        return Reading((), gain, factors=np.where(group > 0, values[0], 1.0), offsets=group * values[1], lag=lag)

    def windows_by(values: Array, lag: float) -> Windows | None:
        meant = reading(values, lag)
        return Windows.of([meant.of(log) for log in logs], poses, _STEERING_WINDOW)

    windows = windows_by(np.array([1.0, 0.0]), 0.0)
    if windows is None or (chosen := windows.gentle()).sum() < 8 or not windows.turned[chosen].any():
        return None
    widest = max(float(np.abs(log.steering[:, group > 0]).max()) for log in logs if log.steering is not None)
    if not widest:
        return None
    from scipy.optimize import least_squares  # slow to import, and needed by robots that steer alone

    deviation = 1.4826 * float(np.median(np.abs(windows.turned[chosen]))) + 1e-6

    def left(values: Array, lag: float) -> Array:
        windows = windows_by(values, lag)
        assert windows is not None  # the poses are the same
        return ((windows.turned - windows.driven @ row_3) / deviation)[chosen]

    def solved(start: Array, lag: float) -> tuple[float, float, Array]:
        solution = least_squares(
            left, start, args=(lag,), loss="soft_l1", max_nfev=15,
            x_scale=[max(abs(start[0]), 1e-3), 0.1], diff_step=1e-4,
        )  # fmt: skip
        return float(solution.cost), lag, solution.x

    scales = (1.0, -1.0, min(1.0, 0.3 / widest), -min(1.0, 0.3 / widest))
    best = itemgetter(0)
    at_once = min((solved(np.array([scale, 0.0]), 0.0) for scale in dict.fromkeys(scales)), key=best)
    later = min((solved(at_once[2], lag) for lag in _LAGS[1:]), key=best)
    later = min((solved(later[2], later[1] + step) for step in (-0.02, 0.0, 0.02)), key=best)
    _, lag, values = later if later[0] < _LAGGING * at_once[0] else at_once
    return replace(reading(values, lag), rate_factors=1.0)


def _named_steering(robot: Robot, group: Array, reading: Reading) -> Iterator[Hypothesis]:
    """The mistakes that a reading of the steering angles of a group shows; none of what a calibration is for."""
    steered, every = robot.drive.steered, bool(group.all())
    names, chosen = _members(steered, group), int(group.argmax())
    where = f"steering of {names}"
    factor = float(np.broadcast_to(reading.factors, len(steered))[chosen])
    zero = math.degrees(float(np.broadcast_to(reading.offsets, len(steered))[chosen]))
    wrong, cost = list[Finding](), 0.0
    if 1 / _ALIKE < factor / DEGREE < _ALIKE:
        factors = np.where(group > 0, DEGREE, 1.0).tolist()
        changes: dict[str, Any] = {"steering_unit": "deg"} if every else {"steering_factors": factors}
        words = f"the steering angle of {names} looks like degrees; it must be rad"
        wrong, cost = [error("steering_unit", words, where, changes)], _WHEEL
    elif 1 / _ALIKE < -factor < _ALIKE:
        wrong, cost = [_clockwise(steered, group)], _WHEEL
    elif not 1 / _LEAST_GEAR < factor < _LEAST_GEAR:
        size = abs(factor)
        command = f": is it a command, 1 for {size:.2g} rad, or is there a gear between encoder and wheel?"
        words = f"steering angles look about {_times_too(1 / size, 'large', 'small')}"
        words += _as_ticks(2 * math.pi / size) or command
        factors = np.where(group > 0, float(f"{size:.3g}"), 1.0).tolist()
        wrong = [error("steering_unit", words, where, {"steering_factors": factors[:1] if every else factors})]
        wrong += [_clockwise(steered, group)] if factor < 0 else []
        cost = _REFERENCE
    if abs(zero) >= _LEAST_ZERO or (wrong and abs(zero) >= 0.5):
        wrong, cost = [*wrong, another_zero(robot, group, round(zero, 1))], cost or _FITTED
    if reading.lag:
        follow = "follows" if group.sum() == 1 else "follow"
        words = f"{names} {follow} the steering column {reading.lag:.2g} s late, as a servo follows its command"
        wrong, cost = [*wrong, error("steering_lag", words, where, {"steering_lag": reading.lag})], cost or _FITTED
    if wrong:
        yield replace(plain_hypothesis(robot), cost=cost, mistakes=tuple(wrong), reading=reading)


def _arrangement(names: Sequence[str], order: Sequence[int], signs: Sequence[int]) -> Finding:
    """Wheel i is recorded in the column order[i], times signs[i]."""
    moved = [names[wheel] for wheel, column in enumerate(order) if wheel != column]
    negative = [name for name, sign in zip(names, signs, strict=True) if sign < 0]
    changes: dict[str, Any] = {"wheel_order": list(order)} if moved else {}
    changes |= {"wheel_signs": list(signs)} if negative else {}
    if moved:
        columns = zip(names, order, signs, strict=True)
        shown = ", ".join(f"{name} <- {'-' if sign < 0 else ''}{names[column]}" for name, column, sign in columns)
        flipped = " and sign-flipped" if negative else ""
        words = f"wheels look swapped{flipped}; the reference fits with omega of {shown}"
        return error("wheels_swapped", words, wheels_in_words(moved), changes)
    every = len(negative) == len(names)
    which = f"every wheel ({', '.join(names)})" if every and len(names) > 1 else wheels_in_words(negative)
    words = f"{which} {'looks' if every or len(negative) == 1 else 'look'} counted the wrong way round"
    return error("wheels_negated" if every else "wheel_negated", words, wheels_in_words(negative), changes)


def _scaled(names: Sequence[str], group: Array, factor: float) -> Finding:
    """The wheels of a group (N,) of 0 and 1 whose rates are a factor too high."""
    where = "all wheels" if group.all() else _members(names, group)
    words = f"the rates of {where} look about {_times_too(factor, 'high', 'low')}"
    if factor in _COUNTS:
        count, multiplied = max(factor, 1 / factor), "not multiplied" if factor < 1 else "multiplied"
        words += f", as where counts are {multiplied} by {count:g}, or by a gear of {count:g}"
    else:
        words += _as_ticks(2 * math.pi * factor) or "; is there a gear between the encoder and the wheel?"
    factors = np.where(group > 0, float(f"{factor:.3g}"), 1.0).tolist()
    return error("wheel_scale", words, where, {"rate_factors": factors})


def _radius(robot: Robot, group: Array, factor: float) -> Finding:
    """The wheels of a group (N,) of 0 and 1 whose radius in the robot's file is a factor too large."""
    where = "all wheels" if group.all() else _members(robot.wheel_names, group)
    words = f"the radius of {where} in robot.yaml looks about {_times_too(factor, 'large', 'small')}"
    words += ", as where a diameter is given as the radius" if factor == _DIAMETER else ""
    members = [wheel for wheel, member in zip(robot.measured, group.tolist(), strict=True) if member]
    radii = {wheel.name: {"radius": float(f"{wheel.radius / factor:.4g}")} for wheel in members}
    return error("design_radius", words, "robot.yaml", {"wheels": radii})


def _clockwise(steered: Sequence[str], group: Array) -> Finding:
    """Steering angles of a group (S,) of 0 and 1 that count clockwise."""
    names, signs = _members(steered, group), np.where(group > 0, -1, 1).tolist()
    words = f"the steering angle of {names} looks counted clockwise; it must count counter-clockwise"
    return error("steering_sign", words, f"steering of {names}", {"steering_signs": signs})


def another_zero(robot: Robot, group: Array, degrees: float) -> Finding:
    """Steering angles of a group (S,) of 0 and 1 that lack so many degrees."""
    names = _members(robot.drive.steered, group)
    words = f"the steering angle of {names} looks {abs(degrees):g} degrees too {'large' if degrees < 0 else 'small'}, "
    words += "its zero not straight ahead"
    if group.all() and not _has_fixed_wheels(robot):
        words += f"; or the reference is turned: heading_offset_deg={degrees:g}"
    changes = {"steering_offsets_deg": np.where(group > 0, degrees, 0.0).tolist()}
    return error("steering_zero", words, f"steering of {names}", changes)


def _exchanged_angles(drive: Drive, first: int, second: int) -> tuple[Reading, float, Finding]:
    """The steering angles of two wheels, exchanged."""
    names = wheels_in_words((drive.steered[first], drive.steered[second]))
    order = exchanged(len(drive.steered), first, second)
    words = f"the steering angles of {names} look swapped"
    wrong = error("steering_swapped", words, f"steering of {names}", {"steering_order": list(order)})
    return Reading(order=order), _WHEEL, wrong


def exchanged(count: int, first: int, second: int) -> tuple[int, ...]:
    """The numbers below ``count`` with two of them exchanged."""
    return tuple({first: second, second: first}.get(number, number) for number in range(count))


def _groups(count: int) -> list[Array]:
    """All wheels together, and each of several, as members (n,) of 0 and 1."""
    return [np.ones(count), *(np.eye(count) if count > 1 else ())]


def _has_fixed_wheels(robot: Robot) -> bool:
    return any(wheel.kind == "fixed" for wheel in robot.wheels)


def _as_ticks(count: float) -> str:
    """So many ticks a turn as a likely cause of a factor; empty if they are too few for an encoder."""
    return f", as ticks would be at about {_rounded(count)} a turn of the wheel" if count > FEWEST_TICKS else ""


def _times_too(factor: float, above: str, below: str) -> str:
    """``2.5 times too high``: a factor, above or below 1, in words."""
    return f"{_rounded(max(factor, 1 / factor))} times too {above if factor > 1 else below}"


def _rounded(value: float) -> str:
    """A value to two digits."""
    return f"{float(f'{value:.2g}'):,.12g}"


def wheels_in_words(names: Sequence[str]) -> str:
    """``wheel a``, or ``wheels a, b``."""
    return f"wheel{'' if len(names) == 1 else 's'} {', '.join(names)}"


def _members(names: Sequence[str], group: Array) -> str:
    """The wheels of a group (N,) of 0 and 1 in words."""
    return wheels_in_words([name for name, member in zip(names, group.tolist(), strict=True) if member])
