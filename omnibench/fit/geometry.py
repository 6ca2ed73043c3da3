"""The geometry of a robot as what is searched: parametric calibration, within physical limits.

The numbers are those of robot/physical.py. The tracked point of a robot that cannot slide is searched where it is not
known; a car's steering offset is an effect. What turns the signals themselves, such as the gain of a steering angle,
are effects, too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, field_validator

from omnibench.config import Model
from omnibench.fit.parameterisation import Bounds, MatrixElements, ParameterisationName, checked
from omnibench.robot import kinematics
from omnibench.robot.physical import Geometry, Number, PhysicalParameter, unit_of

Deviation = FiniteFloat | tuple[FiniteFloat, FiniteFloat]
# A skid-steered base turns as if its wheels stood up to twice as far apart (Mandow et al., IROS 2007).
_SKIDDING = (-0.2, 1.5)


class GeometryLimits(Model):
    """Largest deviation of the physical parameters from their design values: +-number, or [low, high]."""

    radius: Deviation = Field(0.10, description="share of the wheel radius")
    distance: Deviation = Field(0.20, description="share of the distance from wheel to centre, or of the wheelbase")
    angle_deg: Deviation = Field(3.0, description="degrees of the wheel's direction")
    offset_deg: Deviation = Field(10.0, description="degrees of a steering angle")
    mount: Deviation = Field(
        0.20, description="place of the tracked point, share of the wheels' distance from the centre"
    )
    yaw_deg: Deviation = Field(10.0, description="degrees by which the tracked point is turned")

    @field_validator("radius", "distance")
    @classmethod
    def _stays_positive(cls, deviation: Deviation) -> Deviation:
        if deviation_range(deviation)[0] <= -1:
            raise ValueError("a wheel cannot lose its whole radius or distance; give a share below 1")
        return deviation


def deviation_range(deviation: float | tuple[float, float]) -> tuple[float, float]:
    """Lowest and highest deviation."""
    return deviation if isinstance(deviation, tuple) else (-abs(deviation), abs(deviation))


@dataclass(frozen=True, eq=False)
class WheelGeometry:
    """The numbers of a robot's geometry, kind by kind, within physical limits.

    fitted_mount: the place of the tracked point of a robot that cannot slide is among them.
    """

    robot: kinematics.Robot
    limits: GeometryLimits | None = None
    fitted_mount: bool = False
    name: ParameterisationName = field(default="geometry", init=False)

    @cached_property
    def _every(self) -> Geometry:
        return Geometry(self.robot)

    @cached_property
    def _searched(self) -> NDArray[np.intp]:
        """Indices (n,) of the numbers that are searched; the others keep their design values."""
        mounted = self.fitted_mount and not self.robot.slides
        car = isinstance(self.robot.drive, kinematics.CarDrive)
        kept = ("offset",) * car + ("mount_x", "mount_y", "mount_yaw") * (not mounted)
        return np.flatnonzero([number.kind not in kept for number in self._every.numbers])

    @property
    def _numbers(self) -> tuple[Number, ...]:
        return tuple(self._every.numbers[index] for index in self._searched)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(number.name for number in self._numbers)

    @property
    def start(self) -> kinematics.Array:
        return self._every.design[self._searched]

    @property
    def scale(self) -> kinematics.Array:
        """Scale (n,) of each number: of radii and distances the design, m; of places the reach; of angles 1 rad."""
        return self._every.scale[self._searched]

    @property
    def bounds(self) -> Bounds:
        skidding = GeometryLimits(distance=_SKIDDING) if kinematics.class_of(self.robot) == "skid" else GeometryLimits()
        limits = self.limits or skidding
        shares = dict.fromkeys(("distance", "wheelbase", "x", "y"), limits.distance) | {"radius": limits.radius}
        shares |= dict.fromkeys(("mount_x", "mount_y"), limits.mount)
        degrees = {"angle": limits.angle_deg, "offset": limits.offset_deg, "mount_yaw": limits.yaw_deg}
        ranges = {kind: np.array(deviation_range(limit)) for kind, limit in shares.items()}
        ranges |= {kind: np.radians(deviation_range(limit)) for kind, limit in degrees.items()}
        low, high = np.array([ranges[number.kind] for number in self._numbers]).T
        box = Bounds("limits", self.start + low * self.scale, self.start + high * self.scale)
        return checked(box, self.names, self.start)

    @property
    def projection(self) -> kinematics.Array:
        return np.eye(len(self._numbers))

    def matrices(self, vectors: kinematics.Array) -> kinematics.Array:
        """Matrices (P, 3, M) of vectors (P, n)."""
        return self._every.matrices(self._completed(np.asarray(vectors, dtype=float)))

    def slopes(self, vector: kinematics.Array) -> kinematics.Array:
        """Derivatives (3M, n)."""
        return self._every.slopes(self._completed(vector[None])[0])[:, self._searched]

    def _completed(self, vectors: kinematics.Array) -> kinematics.Array:
        """Vectors (P, n) with the numbers that are not searched."""
        completed = np.tile(self._every.design, (len(vectors), 1))
        completed[:, self._searched] = vectors
        return completed


Parameterisation = MatrixElements | WheelGeometry  # what is searched


def searched_parameters(geometry: WheelGeometry, vector: kinematics.Array) -> tuple[PhysicalParameter, ...]:
    """The numbers in a vector (n,) of a geometry beside their design values, as in section 4.2 of the paper."""
    numbers = zip(geometry.names, geometry.start.tolist(), vector.tolist(), strict=True)
    return tuple(
        PhysicalParameter(name=name, design=design, value=value, unit=unit_of(name)) for name, design, value in numbers
    )
