"""Parameterisations: the vector that a calibrator searches, its box, and the matrix that it stands for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from pydantic import Field, FiniteFloat, field_validator

from omnibench.config import Model
from omnibench.errors import ConfigError
from omnibench.robot.kinematics import Array, Robot, inverse_kinematic_matrices

ParameterisationName = Literal["matrix", "geometry"]

# Share of each parameter's scale: step of central differences, near the cube root of the rounding (Press et al.,
# Numerical Recipes, 2007, section 5.7). Half of it and twice change nothing (tests/benchmarks/constants_fit.py).
_STEP = 1e-6
_PAPER_WIDTH = 0.10  # share of each start element: the box of the paper
# Share of each row's largest element: the optimum of the recordings that are known is up to 18 % from the start
# elements (configs/omni3.yaml).
_ROW_WIDTH = 0.25


class ExplicitBox(Model):
    """Bounds of each matrix element, 3 rows of N."""

    lower: tuple[tuple[FiniteFloat, ...], ...]
    upper: tuple[tuple[FiniteFloat, ...], ...]


Box = Literal["paper", "row"] | ExplicitBox
Deviation = FiniteFloat | tuple[FiniteFloat, FiniteFloat]


class GeometryLimits(Model):
    """Largest deviation of the physical parameters from their design values: +-number, or [low, high]."""

    radius: Deviation = Field(0.10, description="share of the wheel radius")
    distance: Deviation = Field(0.20, description="share of the distance from wheel to centre")
    angle_deg: Deviation = Field(3.0, description="degrees of the wheel's direction")

    @field_validator("radius", "distance")
    @classmethod
    def _stays_positive(cls, deviation: Deviation) -> Deviation:
        if _range(deviation)[0] <= -1:
            raise ValueError("a wheel cannot lose its whole radius or distance; give a share below 1")
        return deviation


@dataclass(frozen=True)
class Bounds:
    """A box: ``lower`` and ``upper`` (n,), and its name in tables."""

    name: str
    lower: Array
    upper: Array


class Parameterisation(Protocol):
    """A mapping from vectors of n numbers to inverse kinematic matrices."""

    @property
    def name(self) -> ParameterisationName: ...
    @property
    def names(self) -> tuple[str, ...]:
        """Names of the n numbers."""

    @property
    def start(self) -> Array:
        """The vector (n,) of the design values."""

    @property
    def bounds(self) -> Bounds: ...
    def matrices(self, vectors: Array) -> Array:
        """Inverse kinematic matrices (P, 3, N) of vectors (P, n)."""

    def slopes(self, vector: Array) -> Array:
        """Derivatives (3N, n) of the matrix elements, row by row, by the vector (n,)."""


@dataclass(frozen=True, eq=False)
class MatrixElements:
    """Elements of the matrix row by row, Eq. (4) and (5): the paper's non-parametric calibration.

    null (q, N): orthonormal directions of wheel rates that the data do not identify; along them the matrix keeps its
    start values.
    """

    robot: Robot
    box: Box
    null: Array
    name: ParameterisationName = field(default="matrix", init=False)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"m{row}{column}" for row in (1, 2, 3) for column in range(1, len(self.robot.wheels) + 1))

    @property
    def start(self) -> Array:
        return self.robot.inverse_kinematic_matrix.ravel()

    @property
    def bounds(self) -> Bounds:
        return _checked(make_bounds(self.robot, self.box), self.start, self.names)

    def matrices(self, vectors: Array) -> Array:
        """Matrices (P, 3, N): the elements, with their deviation along ``null`` removed."""
        matrices = np.asarray(vectors, dtype=float).reshape(len(vectors), 3, -1)
        if len(self.null) == 0:
            return matrices
        across = (matrices - self.robot.inverse_kinematic_matrix) @ self.null.T
        return matrices - across @ self.null

    def slopes(self, vector: Array) -> Array:  # noqa: ARG002 (the matrix is linear in the vector)
        """Derivatives (3N, 3N): the identity, less its part along ``null``."""
        slopes: Array = np.kron(np.eye(3), np.eye(len(self.robot.wheels)) - self.null.T @ self.null)
        return slopes


@dataclass(frozen=True, eq=False)
class WheelGeometry:
    """Radius, distance and angle of each wheel, Eq. (3), within physical limits: parametric calibration."""

    robot: Robot
    limits: GeometryLimits | None = None
    name: ParameterisationName = field(default="geometry", init=False)

    @property
    def names(self) -> tuple[str, ...]:
        kinds = ("radius", "distance", "angle")
        return tuple(f"{kind}_{wheel}" for kind in kinds for wheel in self.robot.wheel_names)

    @property
    def start(self) -> Array:
        wheels = self.robot.wheels
        return np.array([[w.radius for w in wheels], [w.distance for w in wheels], [w.angle for w in wheels]]).ravel()

    @property
    def scale(self) -> Array:
        """Scale (3N,) of each parameter: radii and distances their design values in m, angles 1 rad."""
        wheels = self.robot.wheels
        return np.array([[w.radius for w in wheels], [abs(w.distance) for w in wheels], [1.0] * len(wheels)]).ravel()

    @property
    def bounds(self) -> Bounds:
        count = len(self.robot.wheels)
        limits = self.limits or GeometryLimits()
        low, high = np.array([_range(limits.radius), _range(limits.distance), np.radians(_range(limits.angle_deg))]).T
        lower = self.start + np.repeat(low, count) * self.scale
        upper = self.start + np.repeat(high, count) * self.scale
        return _checked(Bounds("limits", lower, upper), self.start, self.names)

    def matrices(self, vectors: Array) -> Array:
        """Matrices (P, 3, N) by Eq. (3), or by the pseudo-inverse for other wheels."""
        radius, distance, angle = np.moveaxis(np.asarray(vectors, dtype=float).reshape(len(vectors), 3, -1), 1, 0)
        rollers = np.array([wheel.roller_angle for wheel in self.robot.wheels])
        return inverse_kinematic_matrices(radius, distance, angle, rollers)

    def slopes(self, vector: Array) -> Array:
        """Derivatives (3N, 3N) by central differences."""
        steps = _STEP * np.diag(self.scale)
        difference = self.matrices(vector + steps) - self.matrices(vector - steps)
        slopes: Array = (difference.reshape(len(steps), -1) / (2 * _STEP * self.scale)[:, None]).T
        return slopes


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


def fitted_parameters(robot: Robot, vector: Array) -> tuple[FittedParameter, ...]:
    """The physical parameters in a vector (3N,) of the geometry parameterisation."""
    geometry = WheelGeometry(robot)
    return tuple(
        FittedParameter(
            name=name,
            value=float(value),
            unit="rad" if name.startswith("angle") else "m",
            design=float(design),
            deviation=float(value - design),
            deviation_percent=float(100 * (value - design) / design) if design else None,
        )
        for name, value, design in zip(geometry.names, vector, geometry.start, strict=True)
    )


def make_bounds(robot: Robot, box: Box) -> Bounds:
    """The bounds (3N,) of the matrix elements. ConfigError when an explicit box has the wrong shape."""
    start = robot.inverse_kinematic_matrix
    if isinstance(box, ExplicitBox):
        for side in (box.lower, box.upper):
            if [len(row) for row in side] != [start.shape[1]] * 3:
                raise ConfigError(f"box: lower and upper must have 3 rows of {start.shape[1]} values")
        return Bounds("custom", np.array(box.lower).ravel(), np.array(box.upper).ravel())
    if box == "paper":
        width = _PAPER_WIDTH * np.abs(start)
    else:
        width = np.repeat(_ROW_WIDTH * np.abs(start).max(axis=1, keepdims=True), start.shape[1], axis=1)
    return Bounds(box, (start - width).ravel(), (start + width).ravel())


def _range(deviation: float | tuple[float, float]) -> tuple[float, float]:
    """Lowest and highest deviation."""
    return deviation if isinstance(deviation, tuple) else (-abs(deviation), abs(deviation))


def _checked(bounds: Bounds, start: Array, names: Sequence[str]) -> Bounds:
    """The bounds; ConfigError if they are reversed or exclude the start."""
    for name, low, high, value in zip(names, bounds.lower, bounds.upper, start, strict=True):
        if low > high:
            raise ConfigError(f"box: lower bound {low:g} of {name} is above its upper bound {high:g}")
        if not low <= value <= high:
            raise ConfigError(f"box: start value {value:g} of {name} is outside [{low:g}, {high:g}]; widen the box")
    return bounds
