"""The geometry of a robot: its numbers, how far they are off their design, and the matrix that they make.

Of a wheel on rollers, or one that rolls in one direction, count radius, distance (the lever arm of its driving force
about the robot's centre) and, on rollers, the angle of its axle: Eq. (3) of Palacin et al. 2023 for three omni wheels.
Of a steered wheel whose rate is measured count radius, place x, y and offset, by which its true steering angle exceeds
the measured one. Of a car count the radius of its rear wheels, its wheelbase and the offset of its steering. The place
and yaw of the tracked point in the robot's frame count, too (Censi et al., IEEE T-RO 29:475, 2013). What turns the
signals themselves, such as the gain of a steering angle, are effects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np

from omnibench.robot import kinematics
from omnibench.robot.kinematics import Array, CarDrive, Robot, RobotClass, class_of

# Share of each number's scale: step of central differences, near the cube root of the rounding (Press et al.,
# Numerical Recipes, 2007, section 5.7). Half of it and twice change nothing (tests/studies/constants_fit.py).
_STEP = 1e-6


@dataclass(frozen=True)
class PhysicalTolerance:
    """Standard deviations: of radii, each row's factor and elements, as shares; of the lost rate, rad/s."""

    radius: float
    rows: tuple[float, float, float]
    elements: float
    lost_rate: float


# Tolerances were chosen once, while looking at the recordings of configs/real_robots.yaml: half and twice of each make
# 0.90 to 1.15 times the error of a robot (tests/studies/prior_study.py). The lost rate of omni wheels, whose rollers
# creep, is ten times that of tyres.
_TYRES = PhysicalTolerance(0.01, (0.02, 0.02, 0.05), 0.002, 0.004)
_STEERED = PhysicalTolerance(0.02, (0.02, 0.02, 0.05), 0.005, 0.01)
_TOLERANCES: Mapping[RobotClass, PhysicalTolerance] = MappingProxyType(
    {
        "differential": _TYRES,
        "skid": PhysicalTolerance(0.02, (0.05, 0.05, 0.2), 0.005, 0.004),
        "tricycle": _STEERED,
        "car": _STEERED,
        "swerve": _STEERED,
        "omni": PhysicalTolerance(0.02, (0.05, 0.05, 0.05), 0.01, 0.03),
        "mecanum": PhysicalTolerance(0.02, (0.06, 0.06, 0.06), 0.01, 0.01),
        "mixed": PhysicalTolerance(0.02, (0.05, 0.05, 0.05), 0.01, 0.01),
    }
)
STEERING_ZERO = 0.1  # rad, of a steering angle's zero: a mounted encoder is trued to some degrees
TRACKED_POINT = 0.05  # m: a tracker that is not on the axle's middle; of the corelli tricycle by 0.1 m
TURNING_CENTRE = 0.05  # m: the point about which a skid-steered base turns, by load and ground
TRACKED_YAW = 0.035  # rad, of a tracker's direction


def physical_tolerance(robot: Robot) -> PhysicalTolerance:
    """The tolerance of a robot's class."""
    return _TOLERANCES[class_of(robot)]


@dataclass(frozen=True)
class Number:
    """One number of a geometry: kind (radius, distance, ...), name of its wheel, design value, unit of deviations."""

    kind: str
    owner: str
    design: float
    scale: float

    @property
    def name(self) -> str:
        return f"{self.kind}_{self.owner}" if self.owner else self.kind


@dataclass(frozen=True, eq=False)
class Geometry:
    """The numbers of a robot's geometry, kind by kind, and the matrix that they make."""

    robot: Robot

    @cached_property
    def numbers(self) -> tuple[Number, ...]:
        """The numbers at their design values; the pose of the tracked point stands last."""
        robot, mount = self.robot, self.robot.mount or kinematics.Mount()
        reach = robot.reach or 1.0  # 0 for one wheel at the centre
        tracked = (
            Number("mount_x", "", mount.x, reach),
            Number("mount_y", "", mount.y, reach),
            Number("mount_yaw", "", mount.yaw, 1.0),
        )
        if isinstance(robot.drive, CarDrive):
            radius, wheelbase = float(robot.radii.mean()), float(np.mean(robot.drive.ahead, axis=0)[0])
            car = (Number("radius", "", radius, radius), Number("wheelbase", "", wheelbase, abs(wheelbase)))
            return (*car, Number("offset", "", 0.0, 1.0), *tracked)
        plain = [wheel for wheel in robot.measured if not wheel.has_steering]
        steered = [wheel for wheel in robot.measured if wheel.has_steering]
        return (
            *(Number("radius", wheel.name, wheel.radius, wheel.radius) for wheel in robot.measured),
            *(Number("distance", wheel.name, wheel.lever, abs(wheel.lever) or reach) for wheel in plain),
            *(Number("angle", wheel.name, wheel.axle, 1.0) for wheel in plain if wheel.kind != "fixed"),
            *(Number("x", wheel.name, wheel.position[0], wheel.reach or reach) for wheel in steered),
            *(Number("y", wheel.name, wheel.position[1], wheel.reach or reach) for wheel in steered),
            *(Number("offset", wheel.name, 0.0, 1.0) for wheel in steered),
            *tracked,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names (n,) of the numbers."""
        return tuple(number.name for number in self.numbers)

    @cached_property
    def design(self) -> Array:
        """The numbers (n,) of the design."""
        return np.array([number.design for number in self.numbers])

    @cached_property
    def scale(self) -> Array:
        """Scale (n,) of each number: of radii and distances the design, m; of places the reach; of angles 1 rad."""
        return np.array([number.scale for number in self.numbers])

    @cached_property
    def _columns(self) -> Mapping[str, list[int]]:
        """The indices of the numbers of each kind."""
        columns: dict[str, list[int]] = {}
        for index, number in enumerate(self.numbers):
            columns.setdefault(number.kind, []).append(index)
        return columns

    def matrices(self, vectors: Array) -> Array:
        """Matrices (P, 3, M) of vectors (P, n) of numbers."""
        of_kind = {kind: vectors[:, columns] for kind, columns in self._columns.items()}
        matrices, mount = self._matrices_of_centre(of_kind), vectors[:, -3:]
        if not (mount == self.design[-3:]).all():
            return _twists(*mount.T) @ matrices
        return matrices if self.robot.mount is None else self.robot.mount.twist @ matrices

    def slopes(self, vector: Array) -> Array:
        """Derivatives (3M, n) of the matrix elements, row by row, by central differences."""
        steps = _STEP * np.diag(self.scale)
        difference = self.matrices(vector + steps) - self.matrices(vector - steps)
        slopes: Array = (difference.reshape(len(steps), -1) / (2 * _STEP * self.scale)[:, None]).T
        return slopes

    def _matrices_of_centre(self, of_kind: Mapping[str, Array]) -> Array:
        """Matrices (P, 3, M) of the robot's centre, from the values (P, k) of each kind of number."""
        robot, radius = self.robot, of_kind["radius"]
        rolling = [wheel for wheel in robot.measured if not wheel.has_steering]
        rollers = np.array([wheel.roller_angle for wheel in rolling])
        if all(wheel.kind in ("omni", "mecanum") for wheel in robot.wheels):
            return kinematics.inverse_kinematic_matrices(radius, of_kind["distance"], of_kind["angle"], rollers)
        if isinstance(robot.drive, CarDrive):
            design = robot.centre_matrix
            matrices = np.repeat(design[None], len(radius), axis=0) * (radius / robot.radii.mean())[..., None]
            matrices[..., 1] *= float(np.mean(robot.drive.ahead, axis=0)[0]) / of_kind["wheelbase"]
            if of_kind["offset"].any():  # tan(phi + c) is tan phi + c near phi = 0
                matrices[..., 0] += of_kind["offset"] * matrices[..., 1]
            return matrices
        plain = np.array([not wheel.has_steering for wheel in robot.measured])
        rows: list[Array] = []
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
        inverse: Array = basis @ np.linalg.pinv(np.stack(rows, axis=1) @ basis)
        return inverse


def _twists(x: Array, y: Array, yaw: Array) -> Array:
    """The matrices (P, 3, 3) that make the twist of a tracked point, at poses (P,), of the centre's."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    zero, one = np.zeros(len(x)), np.ones(len(x))
    rows = [
        [cosine, sine, x * sine - y * cosine],
        [-sine, cosine, x * cosine + y * sine],
        [zero, zero, one],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _steered_rows(radius: Array, x: Array, y: Array, offset: Array) -> list[Array]:
    """The two rows (P, 3) of a steered wheel, by which a twist gives its signals: Eq. (K1) of kinematics.py, turned."""
    cosine, sine = np.cos(offset), np.sin(offset)
    along = np.stack([cosine, sine, x * sine - y * cosine], axis=-1) / radius[:, None]
    across = np.stack([-sine, cosine, x * cosine + y * sine], axis=-1) / radius[:, None]
    return [along, across]
