"""Inverse kinematic matrix of a wheel geometry: Eq. (3) for three omni wheels, its general form for N >= 3.

A wheel's equation is ``omega = row . (vx, vy, w)`` with the row ``(-sin d + tan g cos d, cos d + tan g sin d, R) / r``:
d is the direction of the wheel's axle, g the angle of its rollers (0: omni), R the lever arm of the driving force
about the robot's centre, r the radius. A positive rate drives the robot counter-clockwise.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, FiniteFloat, PlainSerializer, PlainValidator, field_validator, model_validator

from omnibench.config import Model

Array = NDArray[np.floating[Any]]


def _as_lists(array: Array) -> list[Any]:
    """Nested lists; of texts where JSON has no number for an element."""
    return (array if np.isfinite(array).all() else array.astype(str)).tolist()


# An array as a field that pydantic writes as nested lists and reads back to the last bit.
JsonArray = Annotated[
    Array, PlainValidator(lambda values: np.array(values, dtype=float)), PlainSerializer(_as_lists, list[Any])
]


class Wheel(Model):
    """Design values of one wheel, in the robot's frame (x forward, y left).

    angle: direction of the axle. distance: lever arm about the centre. For an omni wheel whose axle points at the
    centre they are the wheel's position in polar coordinates. For a mecanum wheel at (lx, ly) with its axle along y
    the angle is +pi/2 (left) or -pi/2 (right), and the distance ``abs(lx) + abs(ly)`` for rollers at 45 degrees.
    """

    name: str = Field(min_length=1, pattern=r"^[A-Za-z0-9_]+$", description="ends the column names: omega_<name>")
    radius: FiniteFloat = Field(ge=1e-6, le=1e3, description="m")
    distance: FiniteFloat = Field(ge=1e-6, le=1e3, description="lever arm about the robot's centre, m")
    angle: FiniteFloat = Field(description="direction of the axle, rad")
    roller_angle: FiniteFloat = Field(0.0, gt=-1.5, lt=1.5, description="0 omni, +-pi/4 mecanum; rad")

    @field_validator("angle")
    @classmethod
    def _looks_like_radians(cls, angle: float) -> float:
        if abs(angle) > 4 * math.pi:
            raise ValueError(f"{angle:g} cannot be an angle in rad; is it in degrees?")
        return angle


class Robot(Model):
    """A robot on three or more omnidirectional wheels, as designed."""

    name: str
    wheels: tuple[Wheel, ...] = Field(min_length=3)

    @model_validator(mode="after")
    def _drives_in_every_direction(self) -> Robot:
        names = [wheel.name for wheel in self.wheels]
        if len(set(names)) < len(names):
            raise ValueError(f"wheel names must differ: {', '.join(names)}")
        directions = wheel_equations(self.wheels)
        directions /= np.linalg.norm(directions, axis=0)
        if np.linalg.matrix_rank(directions, tol=1e-6) < 3:
            raise ValueError("these wheels cannot drive the robot in every direction; check angles and roller angles")
        return self

    @property
    def wheel_names(self) -> tuple[str, ...]:
        return tuple(wheel.name for wheel in self.wheels)

    @property
    def inverse_kinematic_matrix(self) -> Array:
        """M^-1 of the design values, shape (3, N): m (rows 1, 2) and rad (row 3) per rad of wheel."""
        return inverse_kinematic_matrix(self.wheels)


def wheel_equations(wheels: tuple[Wheel, ...]) -> Array:
    """The matrix M (N, 3) that maps a twist (vx, vy, w) to wheel rates: 1/m (columns 1, 2) and 1 (column 3)."""
    radius, distance, angle = _columns(wheels)
    return _wheel_equations(radius, distance, angle, np.array([wheel.roller_angle for wheel in wheels]))


def inverse_kinematic_matrix(wheels: tuple[Wheel, ...]) -> Array:
    """M^-1 of these wheels, shape (3, N): Eq. (3) for three omni wheels, else the pseudo-inverse."""
    radius, distance, angle = _columns(wheels)
    rollers = np.array([wheel.roller_angle for wheel in wheels])
    return inverse_kinematic_matrices(radius[None], distance[None], angle[None], rollers)[0]


def inverse_kinematic_matrices(
    radius: ArrayLike, distance: ArrayLike, angle: ArrayLike, roller_angle: ArrayLike = 0.0
) -> Array:
    """M^-1 (P, 3, N) of P geometries at once.

    radius, distance (P, N): m. angle (P, N): rad. roller_angle (N,): rad. Three omni wheels: Eq. (3) of Palacin et al.
    2023. Others: the Moore-Penrose inverse of the wheel equations, which gives the least-squares twist of N wheel
    rates. NaN or infinity for a geometry without inverse.
    """
    r, R, d = (np.asarray(values, dtype=float) for values in (radius, distance, angle))
    rollers = np.broadcast_to(np.asarray(roller_angle, dtype=float), r.shape[-1:])
    if r.shape[-1] == 3 and not rollers.any():
        return _eq_3(r, R, d)
    return _pseudo_inverse(_wheel_equations(r, R, d, rollers))


def _columns(wheels: tuple[Wheel, ...]) -> Array:
    """Radii, distances and angles (3, N)."""
    return np.array([[wheel.radius, wheel.distance, wheel.angle] for wheel in wheels]).T


def _wheel_equations(radius: Array, distance: Array, angle: Array, rollers: Array) -> Array:
    slant = np.tan(rollers)
    across = -np.sin(angle) + slant * np.cos(angle)
    along = np.cos(angle) + slant * np.sin(angle)
    return np.stack([across, along, distance], axis=-1) / radius[..., None]


def _pseudo_inverse(equations: Array) -> Array:
    finite = np.isfinite(equations).all(axis=(-2, -1))  # LAPACK raises on NaN and never returns on infinity
    inverse: Array = np.full(np.swapaxes(equations, -2, -1).shape, np.nan)
    inverse[finite] = np.linalg.pinv(equations[finite])
    return inverse


def _eq_3(r: Array, R: Array, d: Array) -> Array:
    ra, rb, rc = (r[..., wheel] for wheel in range(3))
    Ra, Rb, Rc = (R[..., wheel] for wheel in range(3))
    sin_bc, sin_ac, sin_ab = (np.sin(d[..., i] - d[..., j]) for i, j in ((1, 2), (0, 2), (0, 1)))
    cosine, sine = np.cos(d), np.sin(d)
    ca, cb, cc = (cosine[..., wheel] for wheel in range(3))
    sa, sb, sc = (sine[..., wheel] for wheel in range(3))
    rows = [
        [ra * (Rb * cc - Rc * cb), -rb * (Ra * cc - Rc * ca), rc * (Ra * cb - Rb * ca)],
        [ra * (Rb * sc - Rc * sb), -rb * (Ra * sc - Rc * sa), rc * (Ra * sb - Rb * sa)],
        [ra * sin_bc, -rb * sin_ac, rc * sin_ab],
    ]
    determinant = Ra * sin_bc - Rb * sin_ac + Rc * sin_ab
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1)) / determinant[..., None, None]
