"""The vector that a calibrator searches, its box, and the matrix that it stands for; a geometry is in geometry.py."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from pydantic import FiniteFloat

from omnibench.config import Model
from omnibench.errors import ConfigError
from omnibench.robot.kinematics import Array, Robot

ParameterisationName = Literal["matrix", "geometry"]

_PAPER_WIDTH = 0.10  # share of each start element: the box of the paper
# Share of each row's largest element: the optimum of the recordings that are known is up to 18 % from the start
# elements (configs/omni3.yaml).
_ROW_WIDTH = 0.25
_SKIDDING_WIDTH = 0.8  # the same for row 3 of a skid-steered robot, which turns by half of what its track says


class ExplicitBox(Model):
    """Bounds of each matrix element, 3 rows of N."""

    lower: tuple[tuple[FiniteFloat, ...], ...]
    upper: tuple[tuple[FiniteFloat, ...], ...]


BoxName = Literal["paper", "row"]
Box = BoxName | ExplicitBox


@dataclass(frozen=True)
class Bounds:
    """A box: ``lower`` and ``upper`` (n,), and its name in tables."""

    name: str
    lower: Array
    upper: Array


@dataclass(frozen=True, eq=False)
class MatrixElements:
    """Elements of the matrix row by row, Eq. (4) and (5): the paper's non-parametric calibration.

    null (q, M): orthonormal directions of drive signals that the data do not identify; along them the matrix keeps its
    start values. known_mount: the matrix gives a robot that cannot slide only twists in which its fixed wheels do not,
    the tracked point being where the robot says; False: it may be elsewhere. open (q, 3M):
    orthonormal combinations of elements, in units of their rows' largest, that references other than poses leave open;
    along them the matrix keeps its start values, too.
    """

    robot: Robot
    box: Box
    null: Array
    known_mount: bool = True
    open: Array | None = None
    name: ParameterisationName = field(default="matrix", init=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the n numbers that are searched."""
        return tuple(f"m{row}{column}" for row in (1, 2, 3) for column in range(1, len(self.robot.drive.names) + 1))

    @property
    def start(self) -> Array:
        """The vector (n,) of the design values."""
        return self.robot.inverse_kinematic_matrix.ravel()

    @property
    def bounds(self) -> Bounds:
        """The box of the vector. ConfigError: it excludes the start."""
        return checked(make_bounds(self.robot, self.box), self.names, self.start)

    def matrices(self, vectors: Array) -> Array:
        """Matrices (P, 3, M): the elements, without deviations along ``null`` and those that make wheels slide."""
        matrices = np.asarray(vectors, dtype=float).reshape(len(vectors), 3, -1)
        if len(self.null):
            across = (matrices - self.robot.inverse_kinematic_matrix) @ self.null.T
            matrices = matrices - across @ self.null
        if not (self.rows == np.eye(3)).all():
            design = self.robot.inverse_kinematic_matrix
            matrices = design + self.rows @ (matrices - design)
        if self.open is not None and len(self.open):
            deviations = (matrices.reshape(len(matrices), -1) - self.start) / self.units
            matrices = matrices - (deviations @ self.open.T @ self.open * self.units).reshape(matrices.shape)
        return matrices

    def slopes(self, vector: Array) -> Array:  # noqa: ARG002 (the matrix is linear in the vector)
        """Derivatives (3M, 3M): the identity, less its part along ``null`` and across what the wheels allow."""
        return self.projection

    @property
    def projection(self) -> Array:
        """The matrix (n, n) that takes from a deviation of the vector what leaves the matrix as it is."""
        projection: Array = np.kron(self.rows, np.eye(len(self.robot.drive.names)) - self.null.T @ self.null)
        if self.open is not None and len(self.open):
            kept = self.units[:, None] * self.open.T @ self.open / self.units
            projection = projection - kept @ projection
        return projection

    @property
    def units(self) -> Array:
        """The largest element (3M,) of each element's row, m and rad per rad."""
        return np.repeat(self.robot.row_scales, len(self.robot.drive.names))

    @cached_property
    def rows(self) -> Array:
        """The matrix (3, 3) that takes from deviations what makes a fixed wheel slide; the identity where one may."""
        guided = self.known_mount and not self.robot.slides
        return self.robot.allowed_twists if guided else np.eye(3)


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
        shares = np.full(3, _ROW_WIDTH)
        shares[2] = _SKIDDING_WIDTH if robot.skid else _ROW_WIDTH
        width = np.repeat((shares * robot.row_scales)[:, None], start.shape[1], axis=1)
    return Bounds(box, (start - width).ravel(), (start + width).ravel())


def checked(bounds: Bounds, names: tuple[str, ...], start: Array) -> Bounds:
    """The bounds of a vector (n,); ConfigError if they are reversed or exclude the start."""
    for name, low, high, value in zip(names, bounds.lower, bounds.upper, start, strict=True):
        if low > high:
            raise ConfigError(f"box: lower bound {low:g} of {name} is above its upper bound {high:g}")
        if not low <= value <= high:
            raise ConfigError(f"box: start value {value:g} of {name} is outside [{low:g}, {high:g}]; widen the box")
    return bounds
