"""Options of SLAM."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from omnibench.config import Model, Positive
from omnibench.robot.kinematics import Array

# Modules that the processes of SLAM share; the second loads compiled code.
PRELOAD = ("omnibench.slam.slam_dataset", "omnibench.slam.line_growth")


class SlamOptions(Model):
    """Options of SLAM. The defaults suit a robot indoors, up to 0.5 m/s and 1 rad/s with four scans a second."""

    start: Literal["odometry", "last_pose"] = Field(
        "odometry", description="where the search for a scan's pose starts; kept along what the scans do not measure"
    )
    deskew: bool = Field(True, description="undo the robot's motion within a scan")
    search_distance: Positive = Field(1.0, le=10, description="m; the first search matches no points farther apart")
    match_distance: Positive = Field(0.15, le=10, description="m; as search_distance, once the pose is roughly known")
    spacing: FiniteFloat = Field(0.1, gt=0.005, le=1, description="m between points of the map")
    keyframe_distance: Positive = Field(0.25, description="m; distance after which a scan adds new surfaces to the map")
    keyframe_angle: Positive = Field(0.2, description="rad; turn after which a scan does so")
    constrained_position: Positive = Field(0.02, description="m; along what a scan tells worse, the start is kept")
    constrained_heading: Positive = Field(0.01, description="rad; as constrained_position, for the heading")
    odometry_error: Positive = Field(0.1, description="standard deviation of odometry, as a share of the distance")
    speed: Positive = Field(0.5, description="m/s; greatest speed, for start last_pose")
    turn_rate: Positive = Field(1.0, description="rad/s; greatest rate of turn, for start last_pose")

    @model_validator(mode="after")
    def _narrows(self) -> SlamOptions:
        if (search := self.search_distance) < self.match_distance:
            raise ValueError(f"search_distance {search:g} m is less than match_distance {self.match_distance:g} m")
        return self

    @property
    def limits(self) -> Array:
        """Least precision (3,) of a scan along x, y (m) and in heading (rad) at which the start is not kept."""
        return np.array([self.constrained_position, self.constrained_position, self.constrained_heading])
