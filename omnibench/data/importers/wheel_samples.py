"""Wheel samples of a recording: what encoders count, and mean rates in stretches without missing samples."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, FiniteFloat, model_validator

from omnibench.config import Positive
from omnibench.data.checks.finding import FindingWarning
from omnibench.data.importers.recording_options import ReferenceOptions
from omnibench.errors import DataError, nearest
from omnibench.robot.kinematics import Array, fastest_rates
from omnibench.words import plural

POWERS_OF_TWO = tuple(2.0**bits for bits in range(8, 65))  # where counters of 8 to 64 bits begin again
# A counter is taken to begin again where its steps are short beside its range, and where the step across its end is
# not longer than the others are (chosen): that of a counter that was set to 0 is, but for one case in some thousands.
_LONGEST_STEP = 0.25  # of the range
_LONGER, _ROUNDING = 2.0, 1e-4  # times the longest other step, and of the range
_FEWEST_TICKS = 10  # of a step that is not slow; chosen
_USUAL = 2.0  # periods; a longer one without a step is a rest
# A step that lost one turn of a shorter register is one whole turn off what the wheel does before and after; all others
# keep well away from half a turn. Of a wheel that turns on, no other cause makes one step go backwards so far (chosen).
_AROUND = 1.0  # s before and after
_KEPT = 0.4  # of the register's range, that other steps may be off
_LOST = 0.6  # of the range
_RARE, _NEARLY_ALL = 0.01, 0.95  # shares of the steps
_ROUNDS = 3  # a lost turn beside another hides it at first


def recognised_wrap(counts: Array, ranges: tuple[float, ...]) -> float | None:
    """The one of ``ranges`` after which a counter with counts (F,) begins again; None if it does so after none."""
    steps, spread = np.abs(np.diff(counts)), np.ptp(counts)
    for wrap in sorted(ranges):
        across = steps > wrap / 2
        if not across.any() or spread > wrap * (1 + _ROUNDING):
            continue
        usual = float(steps[~across].max(initial=0.0))
        over = float(np.abs(steps[across] - wrap).max())
        if usual <= _LONGEST_STEP * wrap and over <= max(_LONGER * usual, _ROUNDING * wrap):
            return wrap
    return None


def counted_on(counts: Array, wrap: float) -> Array:
    """Counts (F,) of a counter that begins again after ``wrap``, signed or not, as counts that go on from the first."""
    turns = np.cumsum(np.round(np.diff(counts, prepend=counts[0]) / wrap))
    on: Array = counts - wrap * turns
    return on


def recognised_register(counts: Array, times: Array, ranges: tuple[float, ...]) -> float | None:
    """The one of ``ranges`` of which single steps of counts (F,), read at times (F,), s, lost a turn; None without.

    So does a driver that takes the difference of two readings in a register of 16 bits, and now and then reads too
    late. The steps go backwards while the wheel turns on, and not to 0, where a counter stands that was set anew.
    """
    possible = [wrap for wrap in sorted(ranges) if wrap <= np.ptp(counts)]
    if not possible:
        return None
    off, certain = _surprises(counts, times)
    steps = np.abs(np.diff(counts))
    farthest, usual = np.abs(off[certain]).max(initial=0.0), np.median(steps)
    anew = np.abs(counts[1:]) <= _LONGER * np.quantile(steps, _NEARLY_ALL)
    for wrap in possible:
        if farthest <= _LOST * wrap:  # no step lost a turn of this register, or of a longer one
            return None
        if usual > _LONGEST_STEP * wrap:
            continue
        found = counts
        for _ in range(_ROUNDS):
            found = turns_restored(found, times, wrap)
        turns = np.abs(np.round((np.diff(found) - np.diff(counts)) / wrap))
        if turns.max() > 1:  # a shorter register loses several
            continue
        lost = turns > 0
        left, certain = _surprises(found, times)
        backwards = np.diff(counts) * np.diff(found) < 0
        others = float(np.abs(left[certain & ~lost]).max(initial=0.0))
        if (lost & anew).any() or not backwards[lost].all():
            continue
        if lost.any() and lost.mean() < _RARE and others < _KEPT * wrap:
            return wrap
    return None


def turns_restored(counts: Array, times: Array, wrap: float) -> Array:
    """Counts (F,) with the whole turns of ``wrap`` that single steps lost, by what the wheel does before and after."""
    off, certain = _surprises(counts, times)
    turns = np.where(certain & (np.abs(off) > _LOST * wrap), np.round(off / wrap), 0.0)
    restored: Array = counts + wrap * np.concatenate([[0.0], np.cumsum(turns)])
    return restored


def _surprises(counts: Array, times: Array) -> tuple[Array, NDArray[np.bool_]]:
    """By how much (F - 1,) the wheel's rates before and after a step say that it is too short, and whether both do.

    A step begins where the counts last changed. Of the two rates the one that surprises less counts.
    """
    steps = np.diff(counts)
    count = len(steps)
    changed = np.maximum.accumulate(np.where(steps != 0, np.arange(count), -1))
    begin = np.concatenate([[-1], changed[:-1]]) + 1  # reading after the last step that was not 0
    end = np.arange(1, count + 1)
    first = np.searchsorted(times, times[begin] - _AROUND)
    last = np.minimum(np.searchsorted(times, times[end] + _AROUND), count)
    duration = times[end] - times[begin]
    off = []
    for low, high in ((first, begin), (end, last)):
        span = times[high] - times[low]
        rate = np.divide(counts[high] - counts[low], span, out=np.zeros(count), where=span > 0)
        off.append(rate * duration - steps)
    certain = (steps != 0) & (first < begin) & (end < last) & (off[0] * off[1] > 0) & (duration < _AROUND)
    return np.where(np.abs(off[0]) < np.abs(off[1]), off[0], off[1]), certain


def about_zero(shown: Array, turn: float) -> Array:
    """Angles (F,) of an absolute encoder, continuous; one that counts from 0 to a turn is read as about 0.

    An axle that steers stands nearer to straight ahead than half a turn of its encoder most of the time.
    """
    if np.ptp(shown) > turn * (1 + _ROUNDING):  # it counts several turns, or another unit
        return shown
    on = counted_on(shown, turn)
    if shown.min() < 0 or shown.max() > turn:  # it counts both ways
        return on
    middle: Array = on - turn * np.round(np.median(on) / turn)
    return middle


def repeated_readings(times: Array, angles: Array, steering: Array | None) -> NDArray[np.bool_]:
    """True (F,) for single readings of angles (F, N) and steering (F, S) that were logged again while the robot drives.

    They are as in the reading before, at the usual time (F,), s, after it, and the wheels turn by at least half their
    usual step before and after.
    """
    steps = np.abs(np.diff(angles, axis=0)).max(axis=1)
    durations = np.diff(times)
    still = (steps == 0) & (durations < _USUAL * np.median(durations))
    if steering is not None:
        still &= (np.diff(steering, axis=0) == 0).all(axis=1)
    moved = steps[steps > 0]
    if not len(moved) or len(steps) < 3:
        return np.zeros(len(angles), dtype=bool)
    # Slow wheels that step from tick to tick repeat themselves rightly.
    tick = np.diff(np.unique(steps)).min(initial=np.inf)
    fast = steps >= max(np.median(moved) / 2, _FEWEST_TICKS * tick)
    repeated = np.zeros(len(angles), dtype=bool)
    repeated[2:-1] = still[1:-1] & fast[:-2] & fast[2:]
    return repeated


Position = Literal["rad", "deg", "rev", "ticks"]
Rate = Literal["rad/s", "deg/s", "rev/s", "rpm", "ticks/s"]
Increment = Literal["rad/sample", "deg/sample", "rev/sample", "ticks/sample"]
WheelUnit = Literal[Position, Rate, Increment]
Quantity = Literal["positions", "rates", "increments"]

_RADIANS = {"rad": 1.0, "deg": math.pi / 180, "rev": 2 * math.pi, "ticks": 2 * math.pi, "rpm": 2 * math.pi / 60}
_TURNS = {"rad": 2 * math.pi, "deg": 360.0, "rev": 1.0}
_POWER = re.compile(r"2\s*(?:\^|\*\*)\s*(\d{1,2})")
_WORDS = ("auto", "never")
_POSITIONS = get_args(Position)
_ALL = slice(None)
_WHOLE = 1e-6  # largest distance of whole numbers, which went through rad, from such


def _listed(value: Any) -> Any:
    return value if isinstance(value, list | tuple) else (value,)


def _as_wrap(value: Any) -> Any:
    """A number, also written as a power of two such as ``2^16``, or one of the words."""
    if isinstance(value, str) and (power := _POWER.fullmatch(value.strip())):
        return 2.0 ** int(power[1])
    if value in _WORDS or (isinstance(value, int | float) and 0 < value < math.inf):
        return value
    hint = nearest(value, _WORDS) if isinstance(value, str) else ""
    raise ValueError(f"{hint}expected a number such as 65536 or 2^32, auto or never (given: {value!r})")


PerWheel = Annotated[tuple[Positive, ...], BeforeValidator(_listed)]
"""An option that takes one number for all, or one for each wheel in the robot's order."""
Signs = Annotated[tuple[Literal[1, -1], ...], BeforeValidator(_listed)]
Offsets = Annotated[tuple[FiniteFloat, ...], BeforeValidator(_listed)]
Wrap = Annotated[float | Literal["auto", "never"], BeforeValidator(_as_wrap)]


class EncoderOptions(ReferenceOptions, ABC):
    """What the encoders of wheels and of steering axles count. A subclass has the signs of the wheels."""

    group: ClassVar[str] = "Wheels and steering"

    wheel_unit: WheelUnit = Field(
        "rad/s", description=f"positions {', '.join(_POSITIONS)}; rates rad/s, ..., rpm; increments rad/sample, ..."
    )
    ticks_per_turn: PerWheel = Field((), description="of the wheel, gear included; with gear_ratio of the motor")
    gear_ratio: PerWheel = Field((), description="turns of the motor for one of the wheel, where it has the encoder")
    wraps_at: Wrap = Field("auto", description="wheel_unit after which positions begin again (65536, 2^32), or never")
    fastest: Positive | None = Field(None, description="rad/s, of any wheel; default 100, or 5 m/s at its rim")
    steering_unit: Position = Field("rad", description="of the steering angles")
    steering_ticks_per_turn: PerWheel = Field((), description="of the steering encoder")
    steering_scale: PerWheel = Field((), description="steering angle for an angle of its encoder; default 1")
    steering_signs: Signs = Field((), description="-1 for steering angles that count clockwise")
    steering_offsets_deg: Offsets = Field((), description="degrees added to the steering angles, after scale and sign")

    @model_validator(mode="after")
    def _encoders_fit_together(self) -> EncoderOptions:
        self.require_one_each("ticks_per_turn", "gear_ratio", or_one=True)
        self.require_one_each("steering_ticks_per_turn", "steering_scale", "steering_offsets_deg", or_one=True)
        self.require_one_each("steering_signs")
        for unit, key, what in (
            ("wheel_unit", "ticks_per_turn", "of the wheel, gear included; of the motor with gear_ratio"),
            ("steering_unit", "steering_ticks_per_turn", "of the steering encoder"),
        ):
            value, given = getattr(self, unit), getattr(self, key)
            if value.startswith("ticks") and not given:
                raise ValueError(f"{unit} {value} needs {key} ({what}): --set {key}=N")
            if given and not value.startswith("ticks"):
                raise ValueError(f"{key} is for {unit} ticks, not for {value}; --set {unit}=ticks")
        if isinstance(self.wraps_at, float) and self.quantity != "positions":
            raise ValueError(
                f"wraps_at is for positions ({', '.join(_POSITIONS)}), not for wheel_unit {self.wheel_unit}"
            )
        return self

    def require_one_each(self, *keys: str, or_one: bool = False) -> None:
        """ValueError: an option has not a value for each wheel (or steered wheel), nor one for all if that will do."""
        for key in keys:
            what = "steered wheel" if key.startswith("steering") else "wheel"
            names = self.robot.drive.steered if what == "steered wheel" else self.robot.wheel_names
            given = len(getattr(self, key))
            if given and not names:
                raise ValueError(f"{key} is for wheels that steer; the robot has none (type: steered)")
            if given not in (0, len(names), 1 if or_one else 0):
                expected = f"expected {len(names)}, one for each {what}: {', '.join(names)}"
                raise ValueError(f"{key} has {plural(given, 'value')}, {expected}")

    @property
    def quantity(self) -> Quantity:
        """The quantity that ``wheel_unit`` is of."""
        if self.wheel_unit in get_args(Rate):
            return "rates"
        return "increments" if self.wheel_unit in get_args(Increment) else "positions"

    @property
    @abstractmethod
    def signs(self) -> Signs:
        """Signs of the wheels; empty if all are positive."""

    @property
    def wheel_radians(self) -> Array:
        """Factors (N,) from the wheels' unit to rad, or rad/s, of the wheels in the robot's sense."""
        unit = _RADIANS[self.wheel_unit.partition("/")[0]]
        factors = unit / np.array(self.ticks_per_turn or 1) / np.array(self.gear_ratio or 1) * np.array(self.signs or 1)
        return np.broadcast_to(factors, len(self.robot.wheel_names))

    def wheel_angles(self, shown: Array, times: Array, place: str, warnings: list[str], wheels: slice = _ALL) -> Array:
        """Angles (F, n) that count on, rad, of some wheels whose encoders show positions or increments (F, n).

        times (F,): of the readings, s.

        Where counters were recognised to begin again is added to ``warnings``. DataError: they count beyond wraps_at.
        """
        factors = self.wheel_radians[wheels]
        if self.quantity == "increments":
            return np.cumsum(shown * factors, axis=0)
        unit = self.wheel_unit
        turns = np.broadcast_to(self.ticks_per_turn or _TURNS[unit], len(self.robot.wheel_names))[wheels]
        columns = [
            self._on(column, times, float(turn), place, warnings) for column, turn in zip(shown.T, turns, strict=True)
        ]
        return np.column_stack(columns) * factors

    def _on(self, counts: Array, times: Array, turn: float, place: str, warnings: list[str]) -> Array:
        """Counts (F,) of an encoder with ``turn`` counts a turn that go on."""
        if self.wraps_at == "never":
            return counts
        ranges = POWERS_OF_TWO if self.wheel_unit == "ticks" else ()
        given = self.wraps_at if isinstance(self.wraps_at, float) else None
        wrap = given or recognised_wrap(counts, (turn, *ranges))
        on = counts if wrap is None else counted_on(counts, wrap)
        register = recognised_register(on, times, (given,) if given else ranges)
        if given and register is None and (spread := float(np.ptp(counts))) > given * (1 + 1e-9):
            raise DataError(
                f"{place}: wraps_at is {given:.10g}, but positions span {spread:.10g} {self.wheel_unit}; correct it"
            )
        if wrap and not given:
            again = f"wheel positions begin again after {wrap:.10g} {self.wheel_unit}"
            _say(f"{again} and were counted on (wraps_at={wrap:.10g} says so)", warnings)
        return on if register is None else _restored(on, times, register, place, warnings)

    @property
    def steers_otherwise(self) -> bool:
        """True if an option says how steering angles are to be read."""
        return any(name.startswith("steering_") for name in self.model_fields_set - {"steering_columns"})

    def steering_angles(self, shown: Array, place: str, wheels: slice = _ALL) -> Array:
        """Steering angles (F, n), rad, of some steered wheels whose encoders show positions (F, n) in the unit.

        DataError: they are whole numbers beyond a turn, as ticks are.
        """
        unit, count = self.steering_unit, len(self.robot.drive.steered)
        beyond = np.ptp(shown, axis=0) > _TURNS.get(unit, math.inf)
        if (beyond & (shown == np.round(shown)).all(axis=0)).any():
            raise DataError(
                f"{place}: the steering angles, read in {unit}, are whole numbers from {shown.min():g} to "
                f"{shown.max():g}; --set steering_unit=ticks --set steering_ticks_per_turn=N, or another steering_unit "
                f"({', '.join(_POSITIONS)})"
            )

        def each(values: Sequence[float], default: float) -> Array:
            return np.broadcast_to(np.array(values or default), count)[wheels]

        turns = each(self.steering_ticks_per_turn, _TURNS.get(unit, 1.0))
        angles = np.column_stack([about_zero(*pair) for pair in zip(shown.T, turns, strict=True)])
        angles *= 2 * math.pi / turns * each(self.steering_scale, 1.0) * each(self.steering_signs, 1.0)
        return angles + np.radians(each(self.steering_offsets_deg, 0.0))

    @property
    def fastest_rates(self) -> Array:
        """Rates (N,), rad/s, that no wheel exceeds."""
        radii = self.robot.radii
        return fastest_rates(radii) if self.fastest is None else np.full(len(radii), self.fastest)

    def misread(self, place: str, rates: Array, durations: Array) -> DataError:
        """The error of mean rates (F, N), rad/s, over durations (F,), s, that are too fast to be in the unit."""
        unit, counts = self.wheel_unit, rates * durations[:, None] / self.wheel_radians
        what = f"{place}: the wheels, read in {unit}, turn at up to {np.abs(rates).max():.3g} rad/s"
        others = "wraps_at where positions begin again, or fastest if the wheels are that fast"
        whole = (np.abs(counts - np.round(counts)) < _WHOLE).all(axis=0)
        if whole.any() and unit == "rad":  # of other wheels they may be interpolated
            return DataError(f"{what}; positions are whole numbers: --set wheel_unit=ticks --set ticks_per_turn=N")
        first = "ticks_per_turn=N" if "ticks" in unit else f"wheel_unit=UNIT ({', '.join(_POSITIONS)}, rad/s, rpm ...)"
        return DataError(f"{what}; --set {first}, gear_ratio=N (turns of the motor for one of the wheel), {others}")


def _restored(counts: Array, times: Array, register: float, place: str, warnings: list[str]) -> Array:
    """Counts (F,) with the turns of a register that single steps lost, which ``warnings`` tell."""
    restored = counts
    while not np.array_equal(again := turns_restored(restored, times, register), restored):
        restored = again
    lost = int((np.round((np.diff(restored) - np.diff(counts)) / register) != 0).sum())
    note = (
        f"{place}: {plural(lost, 'step')} of wheel positions ran back while the wheel turned on, as in a register of "
        f"{register:.10g} ticks that was read late; they got a turn of it back (wraps_at=2^32 or never keeps them)"
    )
    _say(FindingWarning.of_restart(note), warnings)
    return restored


def _say(sentence: str, warnings: list[str]) -> None:
    """Add a sentence to the warnings, once."""
    warnings += [sentence] if sentence not in warnings else []


_MOST_TOO_FAST = 0.05  # share of samples faster than any wheel turns; more mean a wrong unit


@dataclass(frozen=True, eq=False)
class WheelReadings:
    """What a robot's encoders showed.

    times (F,): s, increasing. values (F, N): angles that count on, rad, if ``counted``; else mean rates since the
    reading before, rad/s. absolute: the angles are the wheels' own, not counted from an unknown one. steering (F, S):
    steering angles, rad, where there are any.
    """

    times: Array
    values: Array
    counted: bool
    absolute: bool
    steering: Array | None = None

    def only(self, kept: NDArray[np.bool_]) -> WheelReadings:
        """Some of the readings."""
        steering = None if self.steering is None else self.steering[kept]
        return WheelReadings(self.times[kept], self.values[kept], self.counted, self.absolute, steering)


@dataclass(frozen=True, eq=False)
class WheelSamples:
    """Wheel samples from begins (F,) to ends (F,), s; none spans a gap.

    rates (F, N): rad/s. angles (F, N) and steering (F, S): at the ends, rad, or None. stretch (F,): number of the
    unbroken stretch that a sample belongs to; angles are continuous within a stretch only.
    """

    begins: Array
    ends: Array
    rates: Array
    angles: Array | None
    steering: Array | None
    stretch: NDArray[np.intp]

    def stretches(self) -> Iterator[slice]:
        """The samples of each unbroken stretch."""
        edges = np.flatnonzero(np.diff(self.stretch, prepend=-1, append=-1))
        for first, last in pairwise(edges.tolist()):
            yield slice(first, last)

    def edges(self, part: slice) -> tuple[Array, Array]:
        """Times (F + 1,) and the angles driven until then (F + 1, N), from 0, of an unbroken part."""
        driven = self.rates[part] * (self.ends[part] - self.begins[part])[:, None]
        times = np.append(self.begins[part.start], self.ends[part])
        return times, np.vstack([np.zeros(driven.shape[1]), np.cumsum(driven, axis=0)])


@dataclass(frozen=True)
class Losses:
    """Samples that were dropped: gaps in the stream, restarts of the counters, and readings that were logged again."""

    gaps: int
    longest: float  # gap, s
    restarts: int
    repeats: int

    def in_words(self, place: str, reading: str) -> list[str]:
        """Warnings of restarts and repeats. place: their recording. reading: a message, or a row."""
        words: list[str] = []
        if self.restarts:
            anew = f"the positions begin anew {plural(self.restarts, 'time')}, faster than any wheel turns"
            way = "if that is a counter that wraps, --set wraps_at=N"
            words.append(FindingWarning.of_restart(f"{place}: {anew} ({way}); runs end there"))
        if self.repeats:
            repeated = "that repeats the one before" if self.repeats == 1 else "that repeat the ones before"
            words.append(f"{place}: {plural(self.repeats, reading)} {repeated} while the wheels turn left out")
        return words


def wheel_samples(
    readings: WheelReadings,
    options: EncoderOptions,
    place: str,
    period: float,
    *,
    longest_gap: float = np.inf,
    still: float = 0.0,
) -> tuple[WheelSamples, Losses]:
    """Samples from the readings of encoders at least two times.

    place: for messages. period: of a first sample of rates, s. longest_gap: s; a longer one while the robot drives ends
    a stretch, since a constant twist does not describe it. still: rad; wheels that turned by less in a gap stood.
    A position that changes faster than ``fastest`` has started again. DataError: so many samples are faster that the
    unit must be another.
    """
    repeats = 0
    if readings.counted:
        repeated = repeated_readings(readings.times, readings.values, readings.steering)
        repeats, readings = int(repeated.sum()), readings.only(~repeated)
    times, values = readings.times, readings.values
    angles: Array | None = None
    if readings.counted:
        driven = np.diff(values, axis=0)
        begins, ends = times[:-1], times[1:]
        rates: Array = driven / (ends - begins)[:, None]
        angles = values[1:] if readings.absolute else None
        moved = (np.abs(driven) >= still).any(axis=1)
    else:
        begins, ends = np.append(times[0] - period, times[:-1]), times
        rates, moved = values, np.ones(len(times), dtype=bool)
    steering = None if readings.steering is None else readings.steering[-len(ends) :]
    lengths = ends - begins
    gap = (lengths > longest_gap) & moved
    too_fast = (np.abs(rates) > options.fastest_rates).any(axis=1) & ~gap
    if too_fast.mean() > _MOST_TOO_FAST:
        raise options.misread(place, rates, lengths)
    restart = too_fast & readings.counted
    lost: NDArray[np.bool_] = gap | restart
    kept = ~lost
    samples = WheelSamples(
        begins[kept],
        ends[kept],
        rates[kept],
        None if angles is None else angles[kept],
        None if steering is None else steering[kept],
        np.cumsum(lost, dtype=np.intp)[kept],
    )
    return samples, Losses(int(gap.sum()), float(lengths[gap].max(initial=0.0)), int(restart.sum()), repeats)
