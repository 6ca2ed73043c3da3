"""Options by which runs are made of recordings: robot, units, signs, counters, clocks, and where runs end."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np
from pydantic import BeforeValidator, Field, FiniteFloat, model_validator

from omnibench.config import NonNegative, Positive, read_yaml, validate
from omnibench.data.splits import Names
from omnibench.errors import ConfigError, nearest
from omnibench.registry import Options
from omnibench.robot.kinematics import Array, Robot
from omnibench.words import plural

PositionUnit = Literal["m", "cm", "mm", "inch"]
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "inch": 0.0254}
TimeUnit = Literal["s", "ms", "us", "ns"]
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
HeadingUnit = Literal["rad", "deg"]
RADIANS = {"rad": 1.0, "deg": math.pi / 180, "rev": 2 * math.pi, "ticks": 2 * math.pi, "rpm": 2 * math.pi / 60}
Position = Literal["rad", "deg", "rev", "ticks"]
WheelPosition = Literal[Position, "m", "mm", "inch"]
WheelRate = Literal["rad/s", "deg/s", "rev/s", "rpm", "ticks/s", "m/s", "mm/s", "inch/s"]
WheelStep = Literal["rad/sample", "deg/sample", "rev/sample", "ticks/sample", "m/sample", "mm/sample", "inch/sample"]
WheelUnit = Literal[WheelPosition, WheelRate, WheelStep]
Quantity = Literal["positions", "rates", "increments"]
TURNS = {"rad": 2 * math.pi, "deg": 360.0, "rev": 1.0}
"""Positions in a turn."""
_POWER = re.compile(r"2\s*(?:\^|\*\*)\s*(\d{1,2})")
_WRAPS = ("auto", "never")
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|°")
_LARGEST_DRIFT = 0.1  # s per s; chosen: clocks drift by 1e-5, and a column in another unit is off by a factor of 1000


def words_of(name: str) -> list[str]:
    """The words of the name of a column or a topic in lower case: ``rpm``, ``fl`` of ``RPM_FL``."""
    return [word.lower() for word in _WORDS.findall(name)] or [name.lower()]


def quantity_of(unit: str) -> Quantity:
    """The quantity that a unit of wheels is of."""
    if unit == "rpm" or unit.endswith("/s"):
        return "rates"
    return "increments" if unit.endswith("/sample") else "positions"


def read_robot(path: Path) -> Robot:
    """The robot that a YAML file holds, by itself or among other things. ConfigError in one line: it holds none."""
    content = read_yaml(path)
    return validate(Robot, content.get("robot", content) if isinstance(content, Mapping) else content, str(path))


def _load_robot(value: Any) -> Any:
    if value in (None, ""):
        raise ValueError("nothing is given; name the robot's YAML file, as robot=robot.yaml")
    return read_robot(Path(value)) if isinstance(value, str | Path) else value


RobotOption = Annotated[Robot, BeforeValidator(_load_robot)]
"""A robot as in dataset.yaml, or the path of a YAML file that holds one: by itself, or under the key ``robot`` as a
dataset.yaml or a calibration file does."""


def _listed(value: Any) -> Any:
    return value if isinstance(value, list | tuple) else (value,)


def _as_wrap(value: Any) -> Any:
    """A number, also written as a power of two such as ``2^16``, or one of the words."""
    if isinstance(value, str) and (power := _POWER.fullmatch(value.strip())):
        return 2.0 ** int(power[1])
    if value in _WRAPS or (isinstance(value, int | float) and 0 < value < math.inf):
        return value
    hint = nearest(value, _WRAPS) if isinstance(value, str) else ""
    raise ValueError(f"{hint}expected a number such as 65536 or 2^32, auto or never (given: {value!r})")


PerWheel = Annotated[tuple[Positive, ...], BeforeValidator(_listed)]
"""An option that takes one number for all, or one for each wheel in the robot's order."""
Signs = Annotated[tuple[Literal[1, -1], ...], BeforeValidator(_listed)]
Offsets = Annotated[tuple[FiniteFloat, ...], BeforeValidator(_listed)]
Wrap = Annotated[float | Literal["auto", "never"], BeforeValidator(_as_wrap)]


Drift = Annotated[float, Field(gt=-_LARGEST_DRIFT, lt=_LARGEST_DRIFT)]
Jumps = Literal["keep", "drop", "cut"]


_ROBOT = "--set robot=FILE.yaml, or robot.yaml in the source or beside it; import csv --template DIR writes one"


class RunsOptions(Options):
    """The robot, which runs train and validate, and what the data set says of itself."""

    group: ClassVar[str] = "Robot and runs"

    robot: RobotOption = Field(description=_ROBOT)
    wheels: dict[str, dict[str, Any]] = Field({}, description="values in place of the file's, as {left: {y: 0.12}}")
    mount: dict[str, float] | None = Field(None, description="tracked point, {x: 0.1, y: 0} (m), yaw (rad) or yaw_deg")
    train: Names = Field((), description="patterns of run names that train")
    validation: Names = Field((), description="patterns of run names that validate")
    leave_out: Names = Field((), description="patterns of the names of runs that are left out")
    sample_period: Positive | None = Field(None, description="s; default: by the wheel samples")
    name: str = Field("recording", min_length=1, description="name of the data set")
    description: str = Field("", description="description of the data set")
    source: str = Field("", description="origin of the recording")
    licence: str = Field("", description="licence of the recording")

    @model_validator(mode="after")
    def _robot_is_corrected(self) -> RunsOptions:
        if self.wheels or self.mount:
            self.__dict__["robot"] = corrected_robot(self.robot, self.wheels, self.mount)
        return self


def corrected_robot(robot: Robot, wheels: Mapping[str, Mapping[str, Any]], mount: Mapping[str, float] | None) -> Robot:
    """A robot with other values of some wheels, by their names, and another tracked point. ConfigError: it is none."""
    written = robot.model_dump(mode="json", by_alias=True) | ({"mount": dict(mount)} if mount else {})
    by_name = {wheel["name"]: wheel for wheel in written["wheels"]}
    for name, values in wheels.items():
        if name not in by_name:
            raise ConfigError(f"wheels: no wheel {name!r}; {nearest(str(name), by_name)}known: {', '.join(by_name)}")
        # An angle in degrees takes the place of one in rad, and the other way; x and y that of a distance.
        gone = {key.removesuffix("_deg") for key in values} | {f"{key}_deg" for key in values}
        gone |= {"distance"} if {"x", "y"} & values.keys() else set()
        by_name[name] = {key: value for key, value in by_name[name].items() if key not in gone} | dict(values)
    return validate(Robot, written | {"wheels": [*by_name.values()]}, "the robot with the values of wheels and mount")


class RecordingOptions(RunsOptions):
    """How the streams of a recording are read: units, signs, counters, clocks; and what it is cut at."""

    group: ClassVar[str] = "Wheels and steering"

    wheel_unit: WheelUnit = Field("rad/s", description="positions rad, m ...; rates rad/s, rpm ...; or rad/sample ...")
    wheel_signs: Signs = Field((), description="-1 for wheels that count the other way round, as [-1,1]")
    ticks_per_turn: PerWheel = Field((), description="of the wheel, gear included; with gear_ratio of the motor")
    gear_ratio: PerWheel = Field((), description="turns of the motor for one of the wheel, where it has the encoder")
    wraps_at: Wrap = Field("auto", description="wheel_unit after which positions begin again (65536, 2^32), or never")
    fastest: Positive | None = Field(None, description="rad/s, of any wheel; default 100, or 5 m/s at its rim")
    wheel_time_unit: TimeUnit = Field("s", description="unit of the wheels' times")
    steering_unit: Position = Field("rad", description="of the steering angles")
    steering_ticks_per_turn: PerWheel = Field((), description="of the steering encoder")
    steering_scale: PerWheel = Field((), description="steering angle, rad, for 1 of its column; default 1")
    steering_signs: Signs = Field((), description="-1 for steering angles that count clockwise")
    steering_offsets_deg: Offsets = Field((), description="degrees added to the steering angles, after scale and sign")
    steering_lag: NonNegative = Field(0.0, description="s by which the wheels follow a commanded steering angle")


class ReferenceOptions(RecordingOptions):
    """Unit, signs, heading and clock of the reference poses, and what ends a run."""

    group: ClassVar[str] = "Reference poses, clocks and cuts"

    position_unit: PositionUnit = Field("m", description="unit of x and y of the poses")
    heading_unit: HeadingUnit = Field("rad", description="unit of the headings of the poses")
    pose_signs: tuple[Literal[1, -1], ...] = Field((), description="of x, y and heading, each 1 or -1, as [1,-1,-1]")
    heading_offset_deg: FiniteFloat = Field(0.0, description="deg, added to the headings, after the signs")
    pose_time_unit: TimeUnit | None = Field(None, description="default: s, or the wheels' in one table")
    pose_time_offset: FiniteFloat = Field(0.0, description="s, added to the times of the poses")
    pose_time_drift: Drift = Field(0.0, description="s per s since the first pose, added to the times of the poses")
    clocks: Literal["same", "match"] = Field("same", description="match: find offsets and drifts from wheels and poses")
    longest_gap: Positive | None = Field(None, description="s; cut where data lack for longer; default: the source's")
    jumps: Jumps = Field("keep", description="drop lone poses that jump; cut: and end a run where the reference shifts")
    start_at_rest: bool = Field(False, description="true: a run begins where the robot last stood before it drives")
    cut: Literal["rests", "topic", "windows", "none"] = Field("none", description="where runs end and begin")
    window: Positive | None = Field(None, description="s; cuts each recording into runs this long (cut=windows)")
    least_rest: Positive = Field(0.5, description="s; shorter rests do not cut")
    rest_rate: Positive = Field(0.05, description="rad/s; wheels that turn slower, over least_rest, rest")
    least_run: NonNegative = Field(1.0, description="s; shorter drives between rests are left out")
    command_pattern: str | None = Field(None, description="regular expression; group 1 in a run's name: the command")

    @model_validator(mode="after")
    def _options_fit_together(self) -> ReferenceOptions:
        self.require_one_each("ticks_per_turn", "gear_ratio", or_one=True)
        self.require_one_each("steering_ticks_per_turn", "steering_scale", "steering_offsets_deg", or_one=True)
        self.require_one_each("wheel_signs", "steering_signs")
        for unit, key in (("wheel_unit", "ticks_per_turn"), ("steering_unit", "steering_ticks_per_turn")):
            value, given, what = getattr(self, unit), getattr(self, key), type(self).model_fields[key].description
            if value.startswith("ticks") and not given:
                raise ValueError(f"{unit} {value} needs {key} ({what}): --set {key}=N")
            if given and not value.startswith("ticks"):
                raise ValueError(f"{key} is for {unit} ticks, not for {value}; --set {unit}=ticks")
        if isinstance(self.wraps_at, float) and self.quantity != "positions":
            positions = ", ".join(get_args(WheelPosition))
            raise ValueError(f"wraps_at is for positions ({positions}), not for wheel_unit {self.wheel_unit}")
        if len(self.pose_signs) not in (0, 3):
            raise ValueError(f"pose_signs has {plural(len(self.pose_signs), 'value')}, expected 3: [1,-1,-1]")
        if self.command_pattern is not None:
            try:
                groups = re.compile(self.command_pattern).groups
            except re.error as error:
                raise ValueError(f"command_pattern is not a regular expression: {error}") from None
            if groups < 1:
                raise ValueError("command_pattern needs a group in parentheses, for example '^(.*)_rep'")
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
        return quantity_of(self.wheel_unit)

    def wheel_factors(self, unit: str) -> Array:
        """Factors (N,) from a unit to rad, or rad/s, of the wheels in the robot's sense."""
        base = unit.partition("/")[0]
        radians = METRES[base] / self.robot.radii if base in METRES else np.array(RADIANS[base])
        factors = radians / np.array(self.ticks_per_turn or 1) / np.array(self.gear_ratio or 1)
        return np.broadcast_to(factors * np.array(self.wheel_signs or 1), len(self.robot.wheel_names))

    @property
    def still(self) -> float:
        """Largest angle, rad, by which a resting wheel moves within ``least_rest`` s."""
        return self.rest_rate * self.least_rest

    @property
    def cutting(self) -> str:
        """Where runs end: ``cut``, or windows where only ``window`` is given."""
        return "windows" if self.cut == "none" and self.window else self.cut

    @property
    def pose_factors(self) -> Array:
        """Factors (3,) of x, y and heading as recorded to m, m and rad, with their signs."""
        metre = METRES[self.position_unit]
        return np.array([metre, metre, RADIANS[self.heading_unit]]) * np.array(self.pose_signs or (1, 1, 1))
