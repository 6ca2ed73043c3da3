"""Mistakes by which what was recorded differs from what was meant, and what each makes of a log or a fitted matrix."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, permutations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omnibench.config import parse_yaml
from omnibench.data.checks.finding import Finding, FindingWarning, Kind
from omnibench.data.stored_rows import in_memory
from omnibench.robot.kinematics import Array, CarDrive, Drive, Robot, rotation, wrapped
from omnibench.robot.odometry import OdometryBatch, WheelLog

_ARRANGED = 4  # wheels of which every order and sign is tried, at most; of more only one mistake
# Other units by the size of the SI unit in them: of wheel rates, and of positions.
RATE_UNITS = ((60 / (2 * math.pi), "rpm"), (180 / math.pi, "deg/s"), (1 / (2 * math.pi), "rev/s"))
POSITION_UNITS = ((1e3, "mm"), (1e2, "cm"))
_COUNTS = (4.0, 2.0, 0.5, 0.25)  # factors of counters: edges counted fourfold, twofold, or stated so and counted once
_GEARS = 1.1 ** np.array([power for power in range(-97, 98) if abs(power) > 3])  # 1/10,000 to 10,000, not about 1
FEWEST_TICKS = 100  # ticks of a turn of the wheel: a factor from there on is named as theirs; chosen
# Cost of a mistake, in units of d^2, so that the simplest explanation is taken of those that fit alike (chosen): each
# wheel that is changed, a reference that is wrong, a factor that is fitted.
_WHEEL, _REFERENCE, _FITTED = 4.0, 4.5, 6.0


@dataclass(frozen=True)
class Misreading:
    """A mistake in words, and the options that mend it, relative to those by which the recording was read."""

    kind: Kind
    what: str
    where: str
    changes: Mapping[str, Any] = field(default_factory=dict)

    def finding(self, more: str = "") -> Finding:
        """The finding of the mistake. more: words that follow."""
        return Finding(kind=self.kind, what=self.what + more, where=self.where, severity="error", changes=self.changes)


@dataclass(frozen=True, eq=False)
class Reading:
    """The steering angles (F, S) and rates (F, N) that were meant, of those recorded.

    mistakes: of the recording, if these were meant. cost: of the mistakes, in units of d^2 (misread_search.py). order,
    factors, offsets: of the steering angles, offsets in rad. rate_order, rate_factors: of the rates.
    """

    mistakes: tuple[Misreading, ...] = ()
    cost: float = 0.0
    order: tuple[int, ...] = ()
    factors: Array | float = 1.0
    offsets: Array | float = 0.0
    rate_order: tuple[int, ...] = ()
    rate_factors: Array | float = 1.0

    def of(self, log: WheelLog) -> WheelLog:
        """The log as it was meant."""
        rates = log.rates[:, list(self.rate_order)] if self.rate_order else log.rates
        steering = log.steering
        if steering is not None:
            ordered = steering[:, list(self.order)] if self.order else steering
            steering = ordered * self.factors + self.offsets
        return replace(log, steering=steering, rates=rates * self.rate_factors)


@dataclass(frozen=True, eq=False)
class Transform:
    """Mistakes that are linear in what was recorded.

    rows (3, 3): from the reference's twist as recorded to the one meant. columns (M, M): from the signals that are
    meant to those recorded. cost: of the mistakes, in units of d^2.
    """

    rows: Array
    columns: Array
    cost: float
    mistakes: tuple[Misreading, ...]

    def with_reference(self, other: Transform) -> Transform:
        """Both mistakes at once."""
        return Transform(other.rows, self.columns, self.cost + other.cost, (*self.mistakes, *other.mistakes))


def wheel_transforms(robot: Robot) -> Iterator[Transform]:
    """Wheels that are swapped, negated, or scaled; the first one is none of these."""
    count = len(robot.drive.names)
    yield Transform(np.eye(3), np.eye(count), 0.0, ())
    if robot.drive.direct:
        yield from arrangements(robot)
    else:
        # Wheels of a robot that steers, counted the wrong way round: every one alone, and all.
        drive, wheels = robot.drive, len(robot.drive.wheels)
        for signs in _few_signs(wheels):
            factors = signal_factors(robot, np.array(signs, dtype=float))
            if factors is not None:
                mistake = arrangement(drive.wheels, range(wheels), signs)
                yield Transform(np.eye(3), np.diag(factors), _WHEEL, (mistake,))
    for factor, unit in RATE_UNITS:
        yield Transform(np.eye(3), factor * np.eye(count), _WHEEL, (wrong_unit(unit),))
    # Counts of one wheel or of all that are off by a factor.
    names = robot.wheel_names
    groups = [np.ones(len(names))] + [row for row in np.eye(len(names)) if len(names) > 1]
    for group in groups:
        for factor, cost in [(each, _WHEEL) for each in _COUNTS] + [(float(each), _FITTED) for each in _GEARS]:
            factors = signal_factors(robot, np.where(group > 0, factor, 1.0))
            if factors is not None:
                yield Transform(np.eye(3), np.diag(factors), cost, (scaled(names, group, factor),))


def reference_transforms(flipped: bool) -> Iterator[Transform]:
    """References that are mirrored, or whose axes are exchanged.

    flipped: the fit was made with headings of the other sign; the positions then are right, or mirrored.
    """

    def pose(signs: Sequence[int], swapped: bool = False, angle: float = 0.0, mirror: bool = True) -> Transform:
        rows = rotation(angle) @ np.diag([1.0, -1.0, -1.0] if mirror else [1.0, 1.0, 1.0])
        changes: dict[str, Any] = {"pose_signs": list(signs)} if min(signs) < 0 else {}
        changes |= {"pose_order": [1, 0, 2]} if swapped else {}
        parts = ["x and y are exchanged"] if swapped else []
        negative = [name for name, sign in zip(("x", "y", "the heading"), signs, strict=True) if sign < 0]
        if negative:
            parts.append(f"{' and '.join(negative)} {'has' if len(negative) == 1 else 'have'} the wrong sign")
        words = f"the reference is mirrored: {' and '.join(parts)}"
        mistake = Misreading("reference_mirrored", words, "the reference", changes)
        return Transform(rows, np.eye(0), _REFERENCE + 0.1 * (sum(sign < 0 for sign in signs) + swapped), (mistake,))

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


def position_units() -> Iterator[Transform]:
    """Positions in other units than metres."""
    for factor, unit in POSITION_UNITS:
        yield Transform(np.diag([1 / factor, 1 / factor, 1.0]), np.eye(0), _REFERENCE, (positions_in(unit),))


def positions_in(unit: str) -> Misreading:
    """Positions in another unit than m."""
    words = f"positions look like {unit}; x and y must be m"
    return Misreading("position_unit", words, "the reference", {"position_unit": unit})


def headings_in_degrees() -> Misreading:
    """Headings in degrees."""
    words = "theta looks like degrees; it must be rad"
    return Misreading("heading_unit", words, "the reference", {"heading_unit": "deg"})


def turned_reference(angle: float) -> Transform:
    """A reference whose headings are too small by an angle, rad."""
    degrees = round(math.degrees(angle), 1)
    mistake = Misreading(
        "reference_turned",
        f"the reference's heading is constantly {abs(degrees):g} degrees too {'small' if degrees > 0 else 'large'}: "
        "the tracked point is turned on the robot",
        "the reference",
        {"heading_offset_deg": degrees},
    )
    return Transform(rotation(-angle), np.eye(0), _REFERENCE, (mistake,))


def arrangements(robot: Robot) -> Iterator[Transform]:
    """Every order and sign of up to four wheels; of more, one mistake."""
    names, count = robot.wheel_names, len(robot.wheel_names)
    identity = tuple(range(count))
    if count <= _ARRANGED:
        every = list(product(permutations(range(count)), product((1, -1), repeat=count)))
    else:
        every = [(identity, signs) for signs in _few_signs(count)]
        every += [(exchanged(count, *pair), (1,) * count) for pair in combinations(range(count), 2)]
    for order, signs in every:
        if order == identity and min(signs) > 0:
            continue
        columns = np.zeros((count, count))
        for column, (wheel, sign) in enumerate(zip(order, signs, strict=True)):
            columns[column, wheel] = sign  # recorded column = sign x rate of wheel
        moved = sum(wheel != column for column, wheel in enumerate(order))
        negative = sum(sign < 0 for sign in signs)
        yield Transform(
            np.eye(3),
            columns,
            _WHEEL * (moved / 2 + (1 if negative == len(signs) else negative)),
            (arrangement(names, order, signs),),
        )


def arrangement(names: Sequence[str], order: Sequence[int], signs: Sequence[int]) -> Misreading:
    """Recorded column i holds signs[i] times the rate of wheel order[i]."""
    found_in = {wheel: column for column, wheel in enumerate(order)}
    columns = [found_in[wheel] for wheel in range(len(names))]
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
        return Misreading("wheels_swapped", words, wheels_in_words(moved), changes)
    every = len(negative) == len(names)
    which = f"every wheel ({', '.join(names)})" if every and len(names) > 1 else wheels_in_words(negative)
    words = f"{which} {'looks' if every or len(negative) == 1 else 'look'} counted the wrong way round"
    return Misreading("wheels_negated" if every else "wheel_negated", words, wheels_in_words(negative), changes)


def signal_factors(robot: Robot, factors: Array) -> Array | None:
    """Factors (M,) of the drive signals if those of the wheels' rates are (N,); None where they mix, as of a car."""
    if len(set(factors.tolist())) == 1:
        return np.full(len(robot.drive.names), factors[0])
    if any(not wheel.has_rate for wheel in robot.wheels if wheel.has_steering):
        return None
    return np.repeat(factors, [1 if pair < 0 else 2 for pair in robot.drive.pairs])


def _few_signs(count: int) -> list[tuple[int, ...]]:
    """One of several signs negative, or all."""
    single = [tuple(-1 if index == turned else 1 for index in range(count)) for turned in range(count)]
    return [*single, *([(-1,) * count] if count > 1 else [])]


def exchanged(count: int, first: int, second: int) -> tuple[int, ...]:
    """The numbers below ``count`` with two of them exchanged."""
    order = list(range(count))
    order[first], order[second] = second, first
    return tuple(order)


def wrong_unit(unit: str) -> Misreading:
    """Wheel rates in another unit than rad/s."""
    name = "turns a second" if unit == "rev/s" else unit
    words = f"wheel rates look like {name}; omega_* must be rad/s"
    return Misreading("wheel_unit", words, "all wheels", {"wheel_unit": unit})


def scaled(names: Sequence[str], group: Array, factor: float) -> Misreading:
    """The wheels of a group (N,) of 0 and 1 whose rates are a factor too high."""
    chosen = [name for name, member in zip(names, group, strict=True) if member]
    where = "all wheels" if len(chosen) == len(names) else wheels_in_words(chosen)
    size, shown = ("high", factor) if factor > 1 else ("low", 1 / factor)
    words = f"the rates of {where} look about {rounded(shown)} times too {size}"
    if factor in _COUNTS:
        words += (
            f", as where counts are {'not ' if factor < 1 else ''}multiplied by {shown:g}, or by a gear of {shown:g}"
        )
    elif 2 * math.pi * factor > FEWEST_TICKS:
        words += f", as ticks would be at about {rounded(2 * math.pi * factor)} a turn of the wheel"
    else:
        words += "; is there a gear between the encoder and the wheel?"
    factors = [float(f"{factor:.3g}") if member else 1.0 for member in group]
    return Misreading("wheel_scale", words, where, {"rate_factors": factors})


def rounded(value: float) -> str:
    """A value to two digits."""
    return f"{float(f'{value:.2g}'):,.12g}"


def wheels_in_words(names: Sequence[str]) -> str:
    """``wheel a``, or ``wheels a, b``."""
    return f"wheel{'' if len(names) == 1 else 's'} {', '.join(names)}"


_TIMES, _PLUS, _COLUMNS = "times the present ones", "added to the present ones", "the columns of these wheels"
# Of changes relative to the present options: the option, how its value is meant, and the option of bags, if another.
_OPTIONS = {
    "wheel_order": ("wheel_columns", _COLUMNS, "joints"),
    "wheel_signs": ("wheel_signs", _TIMES, "joint_signs"),
    "rate_factors": ("gear_ratio", _TIMES, ""),
    "steering_order": ("steering_columns", _COLUMNS, "steering_joints"),
    "steering_signs": ("steering_signs", _TIMES, ""),
    "steering_factors": ("steering_scale", _TIMES, ""),
    "steering_offsets_deg": ("steering_offsets_deg", _PLUS, ""),
}
# Of a factor of all wheels: the options where it is that of ticks, and other ways.
_FACTORS = {
    "rate_factors": (
        "--set wheel_unit=ticks --set ticks_per_turn=N, with /s or /sample behind ticks",
        ", where the encoder is at the motor; or ticks_per_turn, which counts edges (4 a pulse), or correct the radius "
        "of the wheels, in m, in robot.yaml",
    ),
    "steering_factors": (
        "--set steering_unit=ticks --set steering_ticks_per_turn=N",
        "; or steering_unit; or calibrate with --steering fit",
    ),
}


def warning_of(robot: Robot, finding: Finding, *, unit: bool = False) -> FindingWarning:
    """The warning of a finding, with what mends it. unit: a unit cannot be right."""
    way = _mended_by(robot, finding.changes) if finding.changes else finding.fix
    return FindingWarning.of(finding, f"{finding.what} ({way})", unit=unit)


def _mended_by(robot: Robot, changes: Mapping[str, Any]) -> str:
    """The options of an import that make the changes, in words."""
    options = " and ".join(_option(robot, key, value) for key, value in changes.items())
    of_bags = " and ".join(_OPTIONS[key][2] for key in changes if key in _OPTIONS and _OPTIONS[key][2])
    return f"import with {options}{f'; rosbag: {of_bags}' if of_bags else ''}"


def _option(robot: Robot, key: str, value: Any) -> str:
    if key not in _OPTIONS:
        positions = f", or {value[:-2]} of positions" if key == "wheel_unit" and value.endswith("/s") else ""
        return f"--set {key}={as_yaml(value)}{positions}"
    option, meant, _ = _OPTIONS[key]
    if meant == _COLUMNS:
        names = robot.wheel_names if key == "wheel_order" else robot.drive.steered
        return f"--set {option}={as_yaml([names[column] for column in value])}, {meant}"
    rounded = [float(f"{each:.6g}") for each in value]
    if key not in _FACTORS or len(set(value)) > 1:
        return f"--set {option}={as_yaml(rounded)}, {meant}"
    count = 2 * math.pi * (value[0] if key == "rate_factors" else 1 / value[0])
    ticks, otherwise = _FACTORS[key]
    return f"{f'{ticks}; or ' if count > FEWEST_TICKS else ''}--set {option}={as_yaml(rounded[0])}, {meant}{otherwise}"


def as_yaml(value: Any) -> str:
    """A value as ``--set`` takes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        plain = value and all(letter.isalnum() or letter in "._/*-" for letter in value) and value[0] != "*"
        return value if plain and parse_yaml(value, "value") == value else json.dumps(value)
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    if isinstance(value, Mapping):
        return json.dumps(value)
    if isinstance(value, list | tuple):
        return f"[{','.join(as_yaml(item) for item in value)}]"
    return str(value)


_MOST_TRAJECTORIES = 24  # trajectories checked, at most (chosen)
# Samples checked, at most, of which some are taken together, and stamps of each run (chosen: they keep a check of 24
# runs of two minutes below 20 ms, and are 0.2 and 0.4 s apart there).
_MOST_SAMPLES, _MOST_STAMPS = 12_000, 300

_TURN = 2 * math.pi  # rad
EXPLAINED = 0.35  # share of the misfit that may remain with an explanation (chosen)
_LEAST_TURN = 0.5  # rad, far more than references are noisy (chosen)


@dataclass(frozen=True)
class Explanation:
    """Mistakes of a recording, and the misfit that remains if it was read with them.

    unit: a unit is wrong. may_remain: share of the misfit that may remain.
    """

    mistakes: tuple[Misreading, ...]
    misfit: float
    unit: bool = False
    may_remain: float = EXPLAINED


@dataclass(frozen=True, eq=False)
class Recording:
    """Some runs, of which moments are compared: path since the start of the run, and turn since the moment before.

    design: its matrix (3, M). logs: from the origin on. poses: the reference (K, 3) at each log's stamps.
    """

    robot: Robot
    design: Array
    logs: Sequence[WheelLog]
    poses: Sequence[Array]

    @classmethod
    def of(cls, robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array]) -> Recording:
        """The recording of logs with reference poses (K, 3) at their stamps; of many, some from first to last."""
        some = _evenly(len(logs), _MOST_TRAJECTORIES)
        size = -(-sum(len(logs[index].times) for index in some) // _MOST_SAMPLES)
        seen = [_evenly(len(poses[index]), _MOST_STAMPS) for index in some]
        coarse = [
            replace(_coarser(in_memory(logs[index]), size), stamps=logs[index].stamps[stamps])
            for index, stamps in zip(some, seen, strict=True)
        ]
        return cls(
            robot,
            robot.inverse_kinematic_matrix,
            coarse,
            [poses[index][stamps] for index, stamps in zip(some, seen, strict=True)],
        )

    def read(self, reading: Reading) -> Recording:
        """The recording if its wheel rates and steering angles were read otherwise."""
        return replace(self, logs=[reading.of(log) for log in self.logs])

    @cached_property
    def misfit(self) -> float:
        """Misfit of the design matrix."""
        return float(self.misfits(self.design[None])[0])

    def misfits(self, matrices: Array, metre: float = 1.0, radian: float = 1.0) -> Array:
        """Misfit (P,) of matrices (P, 3, M) to the reference, from 0 (exact) to 1 (unrelated).

        metre, radian: units of the recorded positions, in m, and headings, in rad.
        """
        odometry = self._odometry.poses(matrices)
        moments, trajectory = self._moments, self._odometry.trajectory
        starts = np.array([pose[0] for pose in self.poses])[trajectory]
        seen = np.concatenate([pose[chosen] for pose, chosen in zip(self.poses, moments, strict=True)])
        moved = (seen - starts) * [metre, metre, radian]
        path = (moved[:, 0] + 1j * moved[:, 1]) * np.exp(-1j * radian * starts[:, 2])
        driven = odometry[..., 0] + 1j * odometry[..., 1]
        turned = self._turns(odometry[..., 2])
        # Whole turns between two moments do not show in the headings, and are no reason for a larger error.
        missed = wrapped(turned - self._turns(moved[:, 2]))
        lengths = (np.abs(driven) + np.abs(path)).sum(axis=1)
        told = np.minimum(np.abs(turned), _TURN)
        angles = (told + np.minimum(np.abs(turned - missed), _TURN)).sum(axis=1)
        # Noise and slip may amount to a radian and the robot's size at every moment, and to more while it turns.
        count, rims, size = len(moved), told.sum(axis=1), self.robot.reach
        position = np.abs(driven - path).sum(axis=1) / (lengths + size * (rims + count))
        heading = np.abs(missed).sum(axis=1) / (angles + count)
        runs = np.count_nonzero(self._first)
        still = (lengths < runs * size) & (angles < runs)  # a robot at rest fits any matrix
        return np.where(still, 1.0, np.maximum(position, heading))

    @property
    def driven(self) -> float:
        """The way by the design model's odometry, m; a turn counts as the way of the wheels."""
        reach = self.robot.reach
        ways = []
        for log in self.logs:
            vx, vy, turn = np.abs(log.signals @ self.design.T).T
            ways.append(float((np.hypot(vx, vy) + reach * turn) @ np.diff(log.times, prepend=0.0)))
        return sum(ways)

    @property
    def moved(self) -> float:
        """The way of the reference, m, as ``driven``, in steps that are longer than its noise."""
        return sum(_way(poses, self.robot.reach) for poses in self.poses)

    @cached_property
    def _moments(self) -> list[NDArray[np.intp]]:
        """The stamps of each log that are compared."""
        return [_moments(log, self.design[2]) for log in self.logs]

    @cached_property
    def _odometry(self) -> OdometryBatch:
        logs = [
            replace(log, start=np.zeros(3), stamps=log.stamps[chosen])
            for log, chosen in zip(self.logs, self._moments, strict=True)
        ]
        return OdometryBatch(logs, "arc")

    @property
    def _first(self) -> NDArray[np.bool_]:
        """True (S,) for the first moment of each run."""
        first: NDArray[np.bool_] = np.diff(self._odometry.trajectory, prepend=-1) > 0
        return first

    def _turns(self, headings: Array) -> Array:
        """Turns (..., S) since the moment before from headings since the start."""
        turns: Array = headings - np.where(self._first, 0.0, np.roll(headings, 1, axis=-1))
        return turns


def _moments(log: WheelLog, row_3: Array) -> NDArray[np.intp]:
    """Indices of a log's stamps between which the odometry turns by a radian or more, and the last index."""
    turned = np.cumsum((log.signals @ row_3) * np.diff(log.times, prepend=0.0))
    headings = np.interp(log.stamps, np.append(0.0, log.times), np.append(0.0, turned))
    chosen, last = [], headings[0]
    for index, heading in enumerate(headings.tolist()):
        if abs(heading - last) >= 1.0:
            chosen.append(index)
            last = heading
    return np.unique([*chosen, len(headings) - 1])


def _evenly(count: int, most: int) -> list[int]:
    """Indices below ``count``, from the first to the last, ``most`` at most."""
    indices: list[int] = np.unique(np.round(np.linspace(0, count - 1, min(count, most))).astype(int)).tolist()
    return indices


def _coarser(log: WheelLog, size: int) -> WheelLog:
    """The log with each ``size`` samples taken together, with their mean rates; the last ones may be fewer."""
    if size == 1:
        return log
    starts = np.arange(0, len(log.times), size)
    ends = np.append(starts[1:], len(log.times)) - 1
    driven = np.add.reduceat(log.rates * np.diff(log.times, prepend=0.0)[:, None], starts)
    times = log.times[ends]
    steering = None if log.steering is None else log.steering[ends]
    return replace(
        log, times=times, rates=driven / np.diff(times, prepend=0.0)[:, None], steering=steering, wheel_angles=None
    )


def _way(poses: Array, reach: float) -> float:
    """The way along poses (K, 3), m, in steps of ``reach`` or half a radian and more; a turn counts at ``reach``, m."""
    way, last = 0.0, poses[0]
    for pose in poses[1:].tolist():
        step = math.hypot(pose[0] - last[0], pose[1] - last[1])
        turn = abs(math.remainder(pose[2] - last[2], _TURN))
        if step >= reach or turn >= _LEAST_TURN:
            way, last = way + step + reach * turn, pose
    return way


DEGREE = math.pi / 180
# Factors of steering angles that are tried, 1.25 apart; nearer to 1 than 1.6 is what a calibration is for (chosen).
_STEERING_FACTORS = tuple(1.25**power for power in (*range(-14, -1), *range(2, 15)))
_CAR_COUNTS = (2.0, 4.0, 0.5, 0.25)  # factors of one wheel of a car
# Zeros of steering angles that are tried, degrees; smaller ones are what a calibration is for: OptiOdom's tricycle is 1
# degree off. A car's are tried in larger steps, since each needs a fit.
_LEAST_ZERO, _ZERO_STEP, _CAR_STEP, _CAR_MOST = 4.0, 2.0, 4.0, 40.0
_SIMPLE, _FITTED_ANGLE = 4.0, 5.0  # cost of a mistake, and of one with a number that is fitted, in units of d^2; chosen
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
    for factor in _STEERING_FACTORS:
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
        for factor in _CAR_COUNTS:
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
                cost = _FITTED_ANGLE if abs(degrees) <= 90 else _REVERSED
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
    return Reading(
        (Misreading("steering_unit", words, "steering of all wheels", changes),), _FITTED_ANGLE, factors=factor
    )


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
    return Reading((mistake,), _FITTED_ANGLE, offsets=degrees * DEGREE * group)


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
