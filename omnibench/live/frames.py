"""Names of a robot's coordinate frames (REP-105)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from omnibench.config import Model

FrameName = Annotated[str, Field(pattern=r"^[^\s/][^\s]*$", max_length=200)]


class Frames(Model):
    """map: the world as SLAM knows it. odom: where odometry started; it never jumps. base: the robot."""

    map: FrameName = "map"
    odom: FrameName = "odom"
    base: FrameName = "base_link"

    @model_validator(mode="after")
    def _differ(self) -> Frames:
        if len({self.map, self.odom, self.base}) < 3:
            raise ValueError(f"map, odom and base must differ: {self.map}, {self.odom}, {self.base}")
        return self
