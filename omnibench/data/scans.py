"""A planar laser scanner and its scans, one trajectory at a time.

The ray at angle a of a scanner that is tilted by p (nose down) has, with x ahead of the scanner, y to its left and z
up, the direction

    (cos a cos p, sin a, -cos a sin p).                                                          (1)

Over the floor it points to the bearing atan2(sin a, cos a cos p), the share hypot(cos a cos p, sin a) of its length
lies along the floor, and from the height h it meets the floor after h/(cos a sin p), if that is positive.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, model_validator

from omnibench.config import Model, NonNegative, Positive
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

Ranges = NDArray[np.float32]
_FLOOR_MARGIN = 5.0  # standard deviations of a range: one floor range in 3.5 million is shorter (normal noise)


MOST_PITCH = math.radians(60)  # rad; beyond that a plane of rays shows the floor and no room (chosen)


class Mount(Model):
    """Pose of the scanner in the robot's frame."""

    x: FiniteFloat = Field(0.0, description="m, forward")
    y: FiniteFloat = Field(0.0, description="m, left")
    yaw: FiniteFloat = Field(0.0, description="rad, counter-clockwise")
    pitch: float = Field(0.0, ge=-MOST_PITCH, le=MOST_PITCH, description="rad, tilted down ahead")
    height: NonNegative = Field(0.0, description="m above the floor, of a tilted scanner")

    @model_validator(mode="after")
    def _is_above_the_floor_it_is_tilted_to(self) -> Mount:
        if self.pitch and not self.height:
            raise ValueError("a tilted scanner (pitch) needs its height above the floor, m")
        return self

    @property
    def pose(self) -> Array:
        """(3,): m, m, rad."""
        return np.array([self.x, self.y, self.yaw])


class Scanner(Model):
    """A planar scanner: ray i points to angle_min + i angle_increment and is measured i time_increment late."""

    name: str = ""
    rays: int = Field(gt=0, le=100_000, description="ranges of a scan")
    angle_min: FiniteFloat = Field(description="rad, in the scanner's frame, counter-clockwise")
    angle_increment: FiniteFloat = Field(description="rad from ray to ray; negative for clockwise")
    time_increment: NonNegative = Field(0.0, description="s from ray to ray")
    range_min: NonNegative = Field(0.0, description="m; shorter ranges are no measurements")
    range_max: Positive = Field(description="m; longer ranges are no measurements")
    noise: Positive = Field(0.01, description="standard deviation of a range, m")
    far_noise: Positive = Field(0.03, description="standard deviation of ranges beyond far, m")
    far: Positive = Field(10.0, description="m")
    mount: Mount = Mount()

    @model_validator(mode="after")
    def _measures_something(self) -> Scanner:
        if self.range_min >= self.range_max:
            raise ValueError(f"range_min {self.range_min:g} m is not below range_max {self.range_max:g} m")
        if self.angle_increment == 0 and self.rays > 1:
            raise ValueError("angle_increment is 0; all rays would point the same way")
        if abs(self.angle_increment) * (self.rays - 1) > 2 * math.pi + 1e-3:
            raise ValueError(f"{self.rays} rays, {self.angle_increment:g} rad apart, are more than a whole turn")
        return self

    @property
    def angles(self) -> Array:
        """Directions of the rays (R,) in the scanner's frame, rad."""
        return self.angle_min + self.angle_increment * np.arange(self.rays)

    @property
    def bearings(self) -> Array:
        """Directions of the rays (R,) over the floor, in the robot's frame, rad."""
        pitch = self.mount.pitch
        if not pitch:
            return self.angles + self.mount.yaw
        over_the_floor: Array = np.arctan2(np.sin(self.angles), np.cos(self.angles) * math.cos(pitch))  # Eq. (1)
        return over_the_floor + self.mount.yaw

    @property
    def level_shares(self) -> Array:
        """Share (R,) of each ray's length that lies along the floor: 1 where the scanner is not tilted."""
        shares: Array = np.hypot(np.cos(self.angles) * math.cos(self.mount.pitch), np.sin(self.angles))  # Eq. (1)
        return shares if self.mount.pitch else np.ones(self.rays)

    @property
    def floor_ranges(self) -> Array:
        """Ranges (R,) at which the rays meet the floor, m; inf for those that do not."""
        down = np.cos(self.angles) * math.sin(self.mount.pitch)  # Eq. (1)
        falling = down > 0
        ranges: Array = np.where(falling, self.mount.height / np.where(falling, down, 1.0), np.inf)
        return ranges

    @property
    def delays(self) -> Array:
        """Delays (R,) of the rays after the scan's stamp, s."""
        return self.time_increment * np.arange(self.rays)

    def valid(self, ranges: Ranges) -> NDArray[np.bool_]:
        """True for ranges, of any shape, that are measurements."""
        return np.isfinite(ranges) & (ranges >= self.range_min) & (ranges <= self.range_max)

    def on_floor(self, ranges: Ranges | Array) -> NDArray[np.bool_]:
        """True for ranges (..., R) that are the floor's, within five standard deviations."""
        return np.asarray(ranges >= self.floor_ranges - _FLOOR_MARGIN * self.deviations(ranges))

    def deviations(self, ranges: Ranges | Array) -> Array:
        """Standard deviations of ranges of any shape, m."""
        return np.where(np.asarray(ranges) > self.far, self.far_noise, self.noise)


@dataclass(frozen=True, eq=False)
class TrajectoryScans:
    """Scans of one trajectory. times (S,): stamps of the first rays, s. ranges (S, R), m; inf: nothing was seen."""

    times: Array
    ranges: Ranges


class Scans(ABC):
    """The scans of a data set, one trajectory at a time, so that no more than that is in memory."""

    scanner: Scanner

    @property
    @abstractmethod
    def trajectories(self) -> tuple[str, ...]:
        """Ids of the trajectories that have scans."""

    @abstractmethod
    def of(self, trajectory: str) -> TrajectoryScans:
        """The scans of a trajectory. DataError in one line: there are none, or they are broken."""

    def times(self, trajectory: str) -> Array:
        """The stamps of a trajectory's scans (S,), s. DataError as for ``of``."""
        return self.of(trajectory).times

    def __iter__(self) -> Iterator[tuple[str, TrajectoryScans]]:
        return ((trajectory, self.of(trajectory)) for trajectory in self.trajectories)


class ScansInMemory(Scans):
    """Scans in memory."""

    def __init__(self, scanner: Scanner, scans: Mapping[str, TrajectoryScans]) -> None:
        self.scanner = scanner
        self._scans = dict(scans)

    @property
    def trajectories(self) -> tuple[str, ...]:
        return tuple(self._scans)

    def of(self, trajectory: str) -> TrajectoryScans:
        if trajectory not in self._scans:
            raise DataError(f"trajectory {trajectory} has no scans")
        return self._scans[trajectory]
