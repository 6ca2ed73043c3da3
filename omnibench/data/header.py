"""dataset.yaml: what a data set says of itself, and how it was imported."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import Field, model_validator
from pydantic_core import to_jsonable_python

from omnibench.config import Model, Name, Positive, read_yaml, to_yaml, validate
from omnibench.data.scans import Scanner
from omnibench.errors import ConfigError, DataError, shown
from omnibench.robot.kinematics import Robot

FORMAT: Final = "omnibench-dataset/1"


class Imported(Model):
    """The importer, the source and the options as they were given: what was typed."""

    importer: str = Field(description="name of the importer")
    source: str = Field(description="file or folder, as it was given")
    options: dict[str, Any] = Field({}, description="options as they were given")

    @classmethod
    def of(cls, importer: str, source: Path, options: Mapping[str, Any]) -> Imported:
        """The import of a source; options are kept as JSON can hold them."""
        return cls(importer=importer, source=str(source), options=to_jsonable_python(dict(options), fallback=str))


class Header(Model):
    """The content of dataset.yaml."""

    format: Literal["omnibench-dataset/1"] = FORMAT
    name: Name = Field(min_length=1)
    description: str = ""
    source: str = ""
    licence: str = ""
    simulated: bool = Field(False, description="true for simulated data")
    robot: Robot
    sample_period: Positive = Field(description="s")
    wheels: tuple[str, ...] = Field(description="the wheels with a measured rate; column names: omega_<wheel>")
    scanner: Scanner | None = Field(None, description="the scanner, if there are scans")
    imported: Imported | None = Field(None, description="how it was imported; no part of the hash")

    @model_validator(mode="after")
    def _wheels_are_the_robots(self) -> Header:
        if self.wheels != self.robot.wheel_names:
            raise ValueError(
                f"wheels are {', '.join(self.wheels)}, but the robot's wheels with a measured rate are "
                f"{', '.join(self.robot.wheel_names)}; name the same wheels in the same order"
            )
        return self

    @property
    def text(self) -> str:
        """The header as it is written: how it was imported only where that is known."""
        return to_yaml(self.model_dump(mode="json", by_alias=True, exclude=None if self.imported else {"imported"}))


def read_header(folder: Path) -> Header:
    """The dataset.yaml of a data set's folder. DataError: it is none, or it is wrong."""
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "no such folder"
        raise DataError(f"{folder}: {what}; a data set is a folder with dataset.yaml in it")
    file = folder / "dataset.yaml"
    if not file.exists():
        several = any(folder.glob("*/dataset.yaml"))
        way = f"its folders are some: give '{folder}/*'" if several else "`omnibench import` makes one of a log"
        raise DataError(f"{file}: no such file, and so {folder} is no data set; {way}")
    try:
        content = read_yaml(file)
        given = content.get("format") if isinstance(content, dict) else None
        if given != FORMAT:
            raise DataError(f"{file}: format is {shown(given)}, expected {FORMAT!r}")
        return validate(Header, content, str(file))
    except ConfigError as error:
        raise DataError(str(error)) from None
