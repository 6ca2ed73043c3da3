"""Wheel geometry from a matrix: radius, distance and angle of each wheel, and which of them it identifies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omnibench.errors import DataError
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.parameterisation import MatrixElements
from omnibench.robot.kinematics import Array, Robot

# Both are far above the rounding of derivatives (1e-10) and below any share that a direction of wheel rates can have;
# half of each and twice name the same parameters (tests/studies/constants_fit.py).
_UNIDENTIFIED = 1e-3  # share of a parameter's axis in the unidentified space from which on it is not identified
_NO_CHANGE = 1e-6  # share of the largest singular value below which a change of the geometry leaves the matrix as it is
_ROUNDING = 1e-12  # strength of a change, in units of its scale, that is none: nothing of the matrix may be known


@dataclass(frozen=True)
class ParameterEstimate:
    """A physical parameter of a wheel: value, standard deviation and 95 % interval, m, or rad for angles.

    standard_deviation, low and high are None where ``untold`` says why: the data do not identify the parameter, or it
    depends on a number that the box holds, or on a bound of it.
    """

    name: str
    value: float
    unit: str
    standard_deviation: float | None
    low: float | None
    high: float | None
    untold: str = ""


def is_invertible(robot: Robot) -> bool:
    """True if the matrix determines the geometry: three omni wheels, nine elements for nine parameters."""
    return len(robot.wheels) == 3 and all(wheel.kind == "omni" and wheel.measured for wheel in robot.wheels)


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
    design = np.array([wheel.axle for wheel in robot.wheels])
    angle = np.arctan2(-across, along)
    angle += 2 * np.pi * np.round((design - angle) / (2 * np.pi))
    return np.concatenate([radius, turn * radius, angle])


def known_slopes(geometry: WheelGeometry, kept: Array, left_open: Array | None = None) -> Array:
    """Derivatives (3M, n) of the matrix elements by the numbers of a geometry in units of their scale, at the design.

    kept (q, M): directions of drive signals along which the matrix is unknown; the derivatives are 0 there.
    left_open (r, 3M): combinations of elements that are unknown, too, as MatrixElements has them.
    """
    known = MatrixElements(geometry.robot, "row", kept, known_mount=False, open=left_open).projection
    slopes: Array = known @ geometry.slopes(geometry.start) * geometry.scale
    return slopes


def identified_parameters(geometry: WheelGeometry, kept: Array, left_open: Array | None = None) -> tuple[bool, ...]:
    """True (n,) for the numbers that a matrix identifies which is unknown along the directions ``kept`` (q, M).

    left_open (r, 3M): combinations of its elements that are unknown, too, as MatrixElements has them.

    Linearised about the design: a parameter is identified if every change of the geometry that moves it changes the
    known part of the matrix.
    """
    return tuple(bool(share < _UNIDENTIFIED) for share in np.diag(_unseen_changes(geometry, kept, left_open)))


def inseparable_parameters(
    geometry: WheelGeometry, kept: Array, left_open: Array | None = None
) -> tuple[tuple[str, ...], ...]:
    """Groups of numbers that cannot be told apart: a change of one is made up for by the others of its group.

    kept, left_open as for ``identified_parameters``; the numbers that are not identified are those of all groups. A
    group of one is a number of which nothing is known. The changes that are not seen form a space; its projection is
    zero between numbers of different groups.
    """
    projection = _unseen_changes(geometry, kept, left_open)
    left = [index for index, share in enumerate(np.diag(projection)) if share >= _UNIDENTIFIED]
    groups = []
    while left:
        group, reached = [], [left[0]]
        while reached:
            number = reached.pop()
            group.append(number)
            left.remove(number)
            tied = [other for other in left if abs(projection[number, other]) > _UNIDENTIFIED]
            reached += [other for other in tied if other not in reached]
        groups.append(tuple(geometry.names[index] for index in sorted(group)))
    return tuple(groups)


def inseparable_in_words(geometry: WheelGeometry, kept: Array, left_open: Array | None = None) -> tuple[str, ...]:
    """A sentence for each group of a geometry's numbers that cannot be told apart."""
    return tuple(map(_group_in_words, inseparable_parameters(geometry, kept, left_open)))


def _group_in_words(group: tuple[str, ...]) -> str:
    if len(group) == 1:
        return f"these data say nothing of {group[0]}: it stays where the search left it"
    return (
        f"these data cannot tell {', '.join(group[:-1])} and {group[-1]} apart: a change of one is made up for by the "
        "others, so that no such number is known by itself, only what they do together in the motions that were driven"
    )


def _unseen_changes(geometry: WheelGeometry, kept: Array, left_open: Array | None) -> Array:
    """The projection (n, n) onto changes of a geometry, in units of its scale, that leave the known matrix as it is.

    Linearised about the design.
    """
    rows = np.repeat(geometry.robot.row_scales, len(geometry.robot.drive.names))
    slopes = known_slopes(geometry, kept, left_open) / rows[:, None]
    _, strengths, directions = np.linalg.svd(np.vstack([slopes, np.zeros((slopes.shape[1], slopes.shape[1]))]))
    unidentified = directions[strengths <= max(_NO_CHANGE * strengths[0], _ROUNDING)]
    projection: Array = unidentified.T @ unidentified
    return projection
