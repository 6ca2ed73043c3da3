"""What can be chosen of SLAM."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from omnibench.config import Model
from omnibench.robot.kinematics import Array


class SlamOptions(Model):
    """How scans become poses. The defaults suit a robot indoors, up to 0.5 m/s and 1 rad/s with four scans a second."""

    start: Literal["odometry", "last_pose"] = Field(
        "odometry", description="where the search for a scan's pose begins, and what is kept where scans tell nothing"
    )
    deskew: bool = Field(True, description="undo the robot's motion within a scan")
    search_distance: float = Field(
        1.0, gt=0, le=10, allow_inf_nan=False, description="m; farther from the map no point is matched, at first"
    )
    match_distance: float = Field(
        0.15, gt=0, le=10, allow_inf_nan=False, description="m; the same once the pose is roughly known"
    )
    spacing: float = Field(0.1, gt=0.005, le=1, allow_inf_nan=False, description="m between points of the map")
    keyframe_distance: float = Field(
        0.25, gt=0, allow_inf_nan=False, description="m; after it a scan adds to the map what is not there yet"
    )
    keyframe_angle: float = Field(0.2, gt=0, allow_inf_nan=False, description="rad; the same")
    constrained_position: float = Field(
        0.02, gt=0, allow_inf_nan=False, description="m; along a direction told less well than this the start is kept"
    )
    constrained_heading: float = Field(0.01, gt=0, allow_inf_nan=False, description="rad; the same for headings")
    odometry_error: float = Field(
        0.1, gt=0, allow_inf_nan=False, description="standard deviation of the odometry's error, share of the distance"
    )
    speed: float = Field(
        0.5, gt=0, allow_inf_nan=False, description="m/s; what the robot may drive where scans and start tell nothing"
    )
    turn_rate: float = Field(1.0, gt=0, allow_inf_nan=False, description="rad/s; the same")

    @model_validator(mode="after")
    def _narrows(self) -> SlamOptions:
        if self.search_distance < self.match_distance:
            raise ValueError(
                f"search_distance {self.search_distance:g} m is less than match_distance {self.match_distance:g} m"
            )
        return self

    @property
    def limits(self) -> Array:
        """How well (3,) a scan must tell x, y (m) and heading (rad), or the start is kept."""
        return np.array([self.constrained_position, self.constrained_position, self.constrained_heading])
