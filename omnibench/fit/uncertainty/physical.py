"""Wheel geometry from a matrix: radius, distance and angle of each wheel, and which of them it identifies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omnibench.errors import DataError
from omnibench.fit.parameterisation import WheelGeometry
from omnibench.robot.kinematics import Array, Robot, inverse_kinematic_matrices

_STEP = 1e-6  # share of each parameter's scale: step of central differences; chosen
_UNIDENTIFIED = 1e-3  # share of a parameter's axis in the unidentified space from which on it is not identified; chosen


@dataclass(frozen=True)
class ParameterEstimate:
    """A physical parameter of a wheel: value, standard deviation and 95 % interval, m, or rad for angles.

    standard_deviation, low and high are None if the data do not identify the parameter.
    """

    name: str
    value: float
    unit: str
    standard_deviation: float | None
    low: float | None
    high: float | None


def unit_of(name: str) -> str:
    """The unit of a physical parameter."""
    return "rad" if name.startswith("angle") else "m"


def is_invertible(robot: Robot) -> bool:
    """True if the matrix determines the geometry: three omni wheels, nine elements for nine parameters."""
    return len(robot.wheels) == 3 and not any(wheel.roller_angle for wheel in robot.wheels)


def geometry_of(matrix: Array, robot: Robot) -> Array:
    """Geometry (9,) of the three omni wheels that have a matrix (3, 3): the inverse of Eq. (3).

    The wheel equations (-sin d, cos d, R)/r are the rows of the matrix's inverse. Angles come out within half a turn of
    the design. DataError for other wheels and for a matrix that no wheels have.
    """
    if not is_invertible(robot):
        raise DataError("only the matrix of three omni wheels means one geometry")
    try:
        across, along, turn = np.linalg.inv(matrix).T
    except np.linalg.LinAlgError:
        raise DataError("the matrix is singular: no wheels have it") from None
    radius = 1 / np.hypot(across, along)
    design = np.array([wheel.angle for wheel in robot.wheels])
    angle = np.arctan2(-across, along)
    angle += 2 * np.pi * np.round((design - angle) / (2 * np.pi))
    return np.concatenate([radius, turn * radius, angle])


def matrix_slopes(robot: Robot, geometry: Array) -> Array:
    """Derivatives (3N, 3N) of the elements, row by row, with respect to the geometry (3N,): central differences."""
    scale = parameter_scale(geometry)
    steps = _STEP * np.diag(scale)
    rollers = np.array([wheel.roller_angle for wheel in robot.wheels])
    sides = []
    for sign in (1, -1):
        radius, distance, angle = np.moveaxis((geometry + sign * steps).reshape(len(steps), 3, -1), 1, 0)
        sides.append(inverse_kinematic_matrices(radius, distance, angle, rollers))
    slopes: Array = ((sides[0] - sides[1]).reshape(len(steps), -1) / (2 * _STEP * scale)[:, None]).T
    return slopes


def identified_parameters(robot: Robot, kept: Array) -> tuple[bool, ...]:
    """True (3N,) for the parameters that a matrix identifies which is unknown along the directions ``kept`` (q, N).

    Linearised about the design: a parameter is identified if every change of the geometry that moves it changes the
    known part of the matrix.
    """
    geometry = WheelGeometry(robot).start
    known = np.kron(np.eye(3), np.eye(kept.shape[1]) - kept.T @ kept)
    rows = np.repeat(np.abs(robot.inverse_kinematic_matrix).max(axis=1), kept.shape[1])
    slopes = known @ matrix_slopes(robot, geometry) * parameter_scale(geometry) / rows[:, None]
    _, strengths, directions = np.linalg.svd(slopes)
    unidentified = directions[strengths <= 1e-6 * strengths[0]]
    return tuple(bool(share < _UNIDENTIFIED) for share in np.square(unidentified).sum(axis=0))


def parameter_scale(geometry: Array) -> Array:
    """Scale (3N,) of each parameter: radii and distances their own size in m, angles 1 rad."""
    scale: Array = np.abs(geometry)
    scale[2 * len(geometry) // 3 :] = 1.0
    return scale
