"""Options of the importer of CSV tables."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from omnibench.config import Positive
from omnibench.data.importers.encoder_options import EncoderOptions, Signs
from omnibench.data.importers.runs.reference_options import HeadingUnit
from omnibench.data.splits import Names
from omnibench.errors import nearest
from omnibench.words import plural

TimeUnit = Literal["s", "ms", "us", "ns"]
POSE_SUFFIXES = ("_poses.csv", "_poses.tum")
BLANKS = "blanks"


def _as_separator(value: str) -> str:
    if value.isspace():
        return BLANKS
    if len(value) != 1 and value != BLANKS:
        raise ValueError(f"{nearest(value, [BLANKS])}expected one character, or blanks (given: {value!r})")
    return value


def _as_name(value: object) -> object:
    return str(value) if isinstance(value, int) else value


Column = Annotated[str, BeforeValidator(_as_name)]
"""An option that takes the name of a column, or its number."""


class CsvOptions(EncoderOptions):
    """Names of files and columns, units, the robot, and which runs train and validate."""

    name: str = Field("csv", min_length=1, description="name of the data set")
    wheel_columns: Names = Field((), description="in the robot's order; default omega_, phi_ or ticks_ <wheel>")
    wheel_signs: Signs = Field((), description="-1 for wheels that count the other way round")
    wheel_time_column: Column = "t"
    wheel_time_unit: TimeUnit = "s"
    steering_columns: Names = Field((), description="in the order of the wheels that steer; default steer_<wheel>")
    pose_columns: Names = Field(("x", "y", "theta"), description="of CSV poses")
    pose_time_column: Column | None = Field(None, description="of CSV poses; default t, or the wheels' in one file")
    pose_time_unit: TimeUnit | None = Field(None, description="of CSV poses; default s, or the wheels' in one file")
    heading_unit: HeadingUnit = Field("rad", description="unit of the headings of CSV poses")
    separator: Annotated[str, AfterValidator(_as_separator)] = Field(
        ",", min_length=1, description="a character, or blanks: white space between fields, comments from # on"
    )
    header_lines: int = Field(
        1, ge=0, description="lines above the rows, the last with the columns' names; 0: columns by number, from 1"
    )
    wheel_suffix: str = Field("_wheels.csv", min_length=1, description="what follows a run's name")
    pose_suffix: str | None = Field(None, min_length=1, description=f"default: {' or '.join(POSE_SUFFIXES)}")
    window: Positive | None = Field(None, description="s; cuts each recording into runs this long")
    command_pattern: str | None = Field(
        None, description="regular expression: its group 1 in a run's name is the command"
    )

    @model_validator(mode="after")
    def _fits_together(self) -> CsvOptions:
        self.require_one_each("wheel_columns", "wheel_signs", "steering_columns")
        if len(self.pose_columns) != 3:
            raise ValueError(f"pose_columns has {plural(len(self.pose_columns), 'value')}, expected 3")
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
    def columns(self) -> tuple[str, ...]:
        """The columns of the wheels."""
        prefix = "omega_" if self.quantity == "rates" else "ticks_" if "ticks" in self.wheel_unit else "phi_"
        return self.wheel_columns or tuple(prefix + wheel for wheel in self.robot.wheel_names)

    @property
    def angle_columns(self) -> tuple[str, ...]:
        """The columns of the steering angles."""
        return self.steering_columns or tuple(f"steer_{wheel}" for wheel in self.robot.drive.steered)
