"""The geometry of a robot as what is searched: parametric calibration, within physical limits.

Of a wheel on rollers, or one that rolls in one direction, count radius, distance (the lever arm of its driving force
about the robot's centre) and, on rollers, the angle of its axle: Eq. (3) of Palacin et al. 2023 for three omni wheels.
Of a steered wheel whose rate is measured count radius, place x, y and offset, by which its true steering angle exceeds
the measured one. Of a car count the radius of its rear wheels and its wheelbase. Where the tracked point of a robot
that cannot slide is not known, its place and yaw in the robot's frame count, too (Censi et al., IEEE T-RO 29:475,
2013). What turns the signals themselves, the gain of a steering angle or a car's offset, are effects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from pydantic import Field, FiniteFloat, field_validator

from omnibench.config import Model
from omnibench.fit.parameterisation import Bounds, ParameterisationName, checked
from omnibench.fit.prior import tolerance_of
from omnibench.robot import kinematics

# Share of each parameter's scale: step of central differences, near the cube root of the rounding (Press et al.,
# Numerical Recipes, 2007, section 5.7). Half of it and twice change nothing (tests/studies/constants_fit.py).
_STEP = 1e-6
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


@dataclass(frozen=True)
class _Number:
    """One number of a geometry: kind (radius, distance, ...), name of its wheel, design value, unit of deviations."""

    kind: str
    owner: str
    design: float
    scale: float

    @property
    def name(self) -> str:
        return f"{self.kind}_{self.owner}" if self.owner else self.kind


@dataclass(frozen=True, eq=False)
class WheelGeometry:
    """The numbers of a robot's geometry, kind by kind, within physical limits.

    fitted_mount: the place of the tracked point of a robot that cannot slide is among them.
    """

    robot: kinematics.Robot
    limits: GeometryLimits | None = None
    fitted_mount: bool = False
    tolerance: float | None = None
    name: ParameterisationName = field(default="geometry", init=False)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(number.name for number in self._numbers)

    @property
    def start(self) -> kinematics.Array:
        return np.array([number.design for number in self._numbers])

    @property
    def scale(self) -> kinematics.Array:
        """Scale (n,) of each number: of radii and distances the design, m; of places the reach; of angles 1 rad."""
        return np.array([number.scale for number in self._numbers])

    @property
    def bounds(self) -> Bounds:
        skidding = GeometryLimits(distance=_SKIDDING) if kinematics.class_of(self.robot) == "skid" else GeometryLimits()
        limits = self.limits or skidding
        ranges = {
            "radius": deviation_range(limits.radius),
            "distance": deviation_range(limits.distance),
            "angle": np.radians(deviation_range(limits.angle_deg)),
            "wheelbase": deviation_range(limits.distance),
            "x": deviation_range(limits.distance),
            "y": deviation_range(limits.distance),
            "offset": np.radians(deviation_range(limits.offset_deg)),
            "mount_x": deviation_range(limits.mount),
            "mount_y": deviation_range(limits.mount),
            "mount_yaw": np.radians(deviation_range(limits.yaw_deg)),
        }
        low, high = np.array([ranges[number.kind] for number in self._numbers]).T
        return checked(Bounds("limits", self.start + low * self.scale, self.start + high * self.scale), self)

    @property
    def prior_root(self) -> kinematics.Array:
        tolerance = tolerance_of(self.robot, self.tolerance)
        of_lengths = math.hypot(tolerance.elements, max(tolerance.rows))  # what shortens a motion does so as a length
        shares = [tolerance.elements if unit_of(name) == "rad" else of_lengths for name in self.names]
        return np.diag(shares * self.scale)

    @property
    def projection(self) -> kinematics.Array:
        return np.eye(len(self._numbers))

    def matrices(self, vectors: kinematics.Array) -> kinematics.Array:
        """Matrices (P, 3, M) of vectors (P, n)."""
        values = np.asarray(vectors, dtype=float).T
        of_kind: dict[str, kinematics.Array] = {}
        for number, column in zip(self._numbers, values, strict=True):
            known = of_kind.get(number.kind)
            of_kind[number.kind] = column[:, None] if known is None else np.column_stack([known, column])
        matrices = self._matrices_of_centre(of_kind)
        mount = self._mounts(of_kind, values.shape[1])
        return matrices if mount is None else mount @ matrices

    def slopes(self, vector: kinematics.Array) -> kinematics.Array:
        """Derivatives (3M, n) by central differences."""
        steps = _STEP * np.diag(self.scale)
        difference = self.matrices(vector + steps) - self.matrices(vector - steps)
        slopes: kinematics.Array = (difference.reshape(len(steps), -1) / (2 * _STEP * self.scale)[:, None]).T
        return slopes

    @property
    def _on_rollers(self) -> bool:
        return all(wheel.kind in ("omni", "mecanum") for wheel in self.robot.wheels)

    @property
    def _numbers(self) -> tuple[_Number, ...]:
        robot = self.robot
        mounted = self._mount_numbers if self.fitted_mount and not robot.slides else ()
        if isinstance(robot.drive, kinematics.CarDrive):
            radius, wheelbase = float(robot.radii.mean()), float(np.mean(robot.drive.ahead, axis=0)[0])
            car = (_Number("radius", "", radius, radius), _Number("wheelbase", "", wheelbase, abs(wheelbase)))
            return (*car, *mounted)
        plain = [wheel for wheel in robot.measured if not wheel.has_steering]
        steered = [wheel for wheel in robot.measured if wheel.has_steering]
        return (
            *(_Number("radius", wheel.name, wheel.radius, wheel.radius) for wheel in robot.measured),
            *(_Number("distance", wheel.name, wheel.lever, abs(wheel.lever) or robot.reach) for wheel in plain),
            *(_Number("angle", wheel.name, wheel.axle, 1.0) for wheel in plain if wheel.kind != "fixed"),
            *(_Number("x", wheel.name, wheel.position[0], wheel.reach) for wheel in steered),
            *(_Number("y", wheel.name, wheel.position[1], wheel.reach) for wheel in steered),
            *(_Number("offset", wheel.name, 0.0, 1.0) for wheel in steered),
            *mounted,
        )

    @property
    def _mount_numbers(self) -> tuple[_Number, ...]:
        mount, reach = self.robot.mount, self.robot.reach
        x, y, yaw = (mount.x, mount.y, mount.yaw) if mount else (0.0, 0.0, 0.0)
        return _Number("mount_x", "", x, reach), _Number("mount_y", "", y, reach), _Number("mount_yaw", "", yaw, 1.0)

    def _matrices_of_centre(self, of_kind: dict[str, kinematics.Array]) -> kinematics.Array:
        """Matrices (P, 3, M) of the robot's centre, from the values (P, k) of each kind of number."""
        robot, radius = self.robot, of_kind["radius"]
        rolling = [wheel for wheel in robot.measured if not wheel.has_steering]
        rollers = np.array([wheel.roller_angle for wheel in rolling])
        if self._on_rollers:
            return kinematics.inverse_kinematic_matrices(radius, of_kind["distance"], of_kind["angle"], rollers)
        if isinstance(robot.drive, kinematics.CarDrive):
            design = robot.centre_matrix
            matrices = np.repeat(design[None], len(radius), axis=0) * (radius / robot.radii.mean())[..., None]
            matrices[..., 1] *= float(np.mean(robot.drive.ahead, axis=0)[0]) / of_kind["wheelbase"]
            return matrices
        plain = np.array([not wheel.has_steering for wheel in robot.measured])
        rows: list[kinematics.Array] = []
        if plain.any():
            angles = np.array([wheel.axle for wheel in rolling])
            angles = np.repeat(angles[None], len(radius), axis=0)
            turning = [index for index, wheel in enumerate(rolling) if wheel.kind != "fixed"]
            if turning:
                angles[:, turning] = of_kind["angle"]
            of_plain = kinematics.wheel_rows(radius[:, plain], of_kind["distance"], angles, rollers)  # (P, k, 3)
        nth = {True: 0, False: 0}
        for wheel, is_plain in enumerate(plain):
            index = nth[bool(is_plain)]
            nth[bool(is_plain)] += 1
            if is_plain:
                rows.append(of_plain[:, index])
            else:
                rows += _steered_rows(radius[:, wheel], *(of_kind[kind][:, index] for kind in ("x", "y", "offset")))
        basis = robot.allowed_basis
        inverse: kinematics.Array = basis @ np.linalg.pinv(np.stack(rows, axis=1) @ basis)
        return inverse

    def _mounts(self, of_kind: dict[str, kinematics.Array], count: int) -> kinematics.Array | None:
        """The matrices (P, 3, 3), or one, that make the tracked point's twist of the centre's; None: it is that."""
        if "mount_x" not in of_kind:
            return None if self.robot.mount is None else self.robot.mount.twist
        x, y, yaw = (of_kind[kind][:, 0] for kind in ("mount_x", "mount_y", "mount_yaw"))
        cosine, sine = np.cos(yaw), np.sin(yaw)
        zero, one = np.zeros(count), np.ones(count)
        rows = [
            [cosine, sine, x * sine - y * cosine],
            [-sine, cosine, x * cosine + y * sine],
            [zero, zero, one],
        ]
        return np.moveaxis(np.array(rows), -1, 0)


def _steered_rows(
    radius: kinematics.Array, x: kinematics.Array, y: kinematics.Array, offset: kinematics.Array
) -> list[kinematics.Array]:
    """The two rows (P, 3) of a steered wheel, by which a twist gives its signals: Eq. (K1) of kinematics.py, turned."""
    cosine, sine = np.cos(offset), np.sin(offset)
    along = np.stack([cosine, sine, x * sine - y * cosine], axis=-1) / radius[:, None]
    across = np.stack([-sine, cosine, x * cosine + y * sine], axis=-1) / radius[:, None]
    return [along, across]


def unit_of(name: str) -> str:
    """The unit of a number of the geometry."""
    return "rad" if name.startswith(("angle", "offset", "mount_yaw")) else "m"


@dataclass(frozen=True)
class FittedParameter:
    """A physical parameter and its deviation from the design value, as in section 4.2 of the paper.

    deviation: in the parameter's unit. deviation_percent: of the design value; of an angle, whose zero is a convention,
    it means nothing, and stands for comparison with the paper's section 4.2.
    """

    name: str
    value: float
    unit: str
    design: float
    deviation: float
    deviation_percent: float | None  # None where the design value is 0


def fitted_parameters(geometry: WheelGeometry, vector: kinematics.Array) -> tuple[FittedParameter, ...]:
    """The physical parameters in a vector (n,) of a geometry."""
    shares = kinematics.relative_deviations(vector, geometry.start)
    return tuple(
        FittedParameter(
            name=name,
            value=float(value),
            unit=unit_of(name),
            design=float(design),
            deviation=float(value - design),
            deviation_percent=None if np.isnan(share) else float(100 * share),
        )
        for name, value, design, share in zip(geometry.names, vector, geometry.start, shares, strict=True)
    )
