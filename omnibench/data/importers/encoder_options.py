"""Options that say what the encoders of any robot count: units, gears, signs, and where counters begin again."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np
from pydantic import BeforeValidator, Field, FiniteFloat, model_validator

from omnibench.config import Positive
from omnibench.data.checks.finding import FindingWarning
from omnibench.data.importers.encoder_counts import (
    POWERS_OF_TWO,
    about_zero,
    counted_on,
    recognised_register,
    recognised_wrap,
    turns_restored,
)
from omnibench.data.importers.runs.reference_options import ReferenceOptions
from omnibench.errors import DataError, nearest
from omnibench.robot.kinematics import Array, fastest_rates
from omnibench.words import plural

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
