"""Options of the importer of CSV tables."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from omnibench.config import Positive
from omnibench.data.importers.encoder_options import EncoderOptions, Signs
from omnibench.data.importers.runs.reference_options import HeadingUnit, TimeUnit
from omnibench.data.splits import Names
from omnibench.errors import nearest
from omnibench.words import plural

WHEEL_SUFFIXES = ("_wheels.csv", "_wheels.parquet")
REFERENCE_SUFFIXES = ("_references.csv", "_references.parquet")
POSE_SUFFIXES = ("_poses.csv", "_poses.tum", "_poses.parquet")
BLANKS = "blanks"
_SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t"}
TIMES = ("t", "time", "stamp", "timestamp")
HEADINGS = ("theta", "heading", "yaw")
RUNS = ("run", "trajectory", "trial", "experiment")
PREFIXES = ("omega_", "ticks_", "phi_")
"""Of the columns of wheels: rates, positions or increments in ticks, and those in other units."""


def _as_separator(value: str) -> str:
    value = _SEPARATORS.get(value, value)
    if value.isspace() and value != "\t":
        return BLANKS
    if len(value) != 1 and value != BLANKS:
        words = [BLANKS, *_SEPARATORS]
        raise ValueError(f"{nearest(value, words)}expected one character, or {', '.join(words)} (given: {value!r})")
    return value


def _as_name(value: object) -> object:
    return str(value) if isinstance(value, int) else value


def _as_names(value: Any) -> Any:
    return {key: _as_name(name) for key, name in value.items()} if isinstance(value, dict) else value


Column = Annotated[str, BeforeValidator(_as_name)]
"""An option that takes the name of a column, or its number."""


class CsvOptions(EncoderOptions):
    """Names of files and columns, units, and how the text is written."""

    group: ClassVar[str] = "Tables, columns and units"

    name: str = Field("csv", min_length=1, description="name of the data set")
    columns: Annotated[dict[str, Column], BeforeValidator(_as_names)] = Field(
        {}, description="names of columns, as {t: time, omega_left: rpm_l, x: px}; also pose_t, run"
    )
    wheel_columns: Names = Field((), description="in the robot's order; default omega_, phi_ or ticks_ <wheel>")
    wheel_signs: Signs = Field((), description="-1 for wheels that count the other way round, as [-1,1]")
    wheel_time_column: Column | None = Field(None, description=f"default: {', '.join(TIMES)}")
    wheel_time_unit: TimeUnit = Field("s", description="unit of the wheels' times")
    steering_columns: Names = Field((), description="in the order of the wheels that steer; default steer_<wheel>")
    pose_columns: Names = Field((), description="of x, y and heading; default: x, y, and theta, heading or yaw")
    pose_time_column: Column | None = Field(None, description="default: as for wheels")
    pose_time_unit: TimeUnit | None = Field(None, description="default: s, or the wheels' in one table")
    heading_unit: HeadingUnit = Field("rad", description="unit of the headings of CSV poses")
    run_column: Column | None = Field(
        None, description=f"it names the run of a row; default, if any: {', '.join(RUNS)}"
    )
    runs_table: Path | None = Field(
        None, description="table of run, command, repetition, split, session; default: runs.csv, if any"
    )
    separator: Annotated[str, AfterValidator(_as_separator)] | None = Field(
        None, min_length=1, description="comma, semicolon, tab, blanks or a character; default: recognised"
    )
    decimal: Literal["point", "comma"] = Field("point", description="what decimals are written with")
    header_lines: int = Field(
        1, ge=0, description="lines above the rows, the last with the names; 0: columns by number, from 1"
    )
    wheel_suffix: str | None = Field(None, min_length=1, description="of the wheels' files; default _wheels.csv")
    pose_suffix: str | None = Field(None, min_length=1, description="of the poses' files; default _poses.csv or .tum")
    window: Positive | None = Field(None, description="s; cuts each recording into runs this long")
    command_pattern: str | None = Field(
        None, description="regular expression: its group 1 in a run's name is the command"
    )

    @model_validator(mode="after")
    def _fits_together(self) -> CsvOptions:
        self.require_one_each("wheel_columns", "wheel_signs", "steering_columns")
        if len(self.pose_columns) not in (0, 3):
            raise ValueError(f"pose_columns has {plural(len(self.pose_columns), 'value')}, expected 3: x, y, heading")
        known = self.column_keys
        otherwise = {f"{prefix}{wheel}" for prefix in PREFIXES for wheel in self.robot.wheel_names}
        for key in self.columns:
            if key not in known and key not in otherwise:
                raise ValueError(f"columns: unknown column {key!r}; {nearest(key, known)}known: {', '.join(known)}")
        if self.command_pattern is not None:
            try:
                groups = re.compile(self.command_pattern).groups
            except re.error as error:
                raise ValueError(f"command_pattern is not a regular expression: {error}") from None
            if groups < 1:
                raise ValueError("command_pattern needs a group in parentheses, for example '^(.*)_rep'")
        return self

    @property
    def signs(self) -> Signs:
        return self.wheel_signs

    @property
    def prefix(self) -> str:
        """What the columns of the wheels begin with, by their unit."""
        rates, ticks, angles = PREFIXES
        return rates if self.quantity == "rates" else ticks if "ticks" in self.wheel_unit else angles

    @property
    def column_keys(self) -> tuple[str, ...]:
        """The keys of ``columns``."""
        wheels = [f"{self.prefix}{wheel}" for wheel in self.robot.wheel_names]
        steering = [f"steer_{wheel}" for wheel in self.robot.drive.steered]
        return ("t", *wheels, *self.robot.wheel_names, *steering, "pose_t", "x", "y", "theta", "run")
