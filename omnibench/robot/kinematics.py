"""Inverse kinematic matrix of a robot: Eq. (3) for three omni wheels, its general form for every kind of wheel.

A wheel that rolls in one direction, or on rollers, has the equation ``omega = row . (vx, vy, w)`` with the row
``(-sin d + tan g cos d, cos d + tan g sin d, R) / r``: d is the direction of the wheel's axle, g the angle of its
rollers (0: none), R the lever arm of the driving force about the robot's centre, r the radius. A steered wheel at
(x, y) whose rate is measured has two, for its signals omega cos phi and omega sin phi (drive.py):

    (omega cos phi, omega sin phi) = (vx - y w, vy + x w) / r.                                        (1)

A fixed wheel does not slide along its axle, which is the condition

    0 = (cos d, sin d, x sin d - y cos d) . (vx, vy, w).                                              (2)

The twists that all conditions allow have an orthonormal basis Z (3, D). With the equations E (M, 3) of all signals the
matrix is K = Z (E Z)^+, which gives the least-squares twist among them. A skid-steered robot slides; the condition then
is that the mean of its fixed wheels does not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    ConfigDict,
    Field,
    FiniteFloat,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from omnibench.config import Model, Name
from omnibench.robot.arrays import Array as Array
from omnibench.robot.arrays import JsonArray as JsonArray
from omnibench.robot.wheels.drive import CarDrive, Drive, drive_of
from omnibench.robot.wheels.wheel import Wheel as Wheel
from omnibench.robot.wheels.wheel import in_degrees_too, in_radians, looks_like_radians
from omnibench.views import Shown

# Of the largest singular value: directions below it are rounding of design values, which have some digits.
_RANK = 1e-6
_ZERO = 1e-9  # m, rad, or either per rad of wheel: no length, angle or element of a real robot is smaller but for 0
_ROUNDING = 1e-12  # of the largest element: a smaller one is no design value


class Mount(Model):
    """Pose of the tracked point, whose poses the reference reports, in the robot's frame."""

    model_config = ConfigDict(json_schema_extra=in_degrees_too("yaw"))

    x: FiniteFloat = Field(0.0, description="forward of the robot's centre, m")
    y: FiniteFloat = Field(0.0, description="to the left of the robot's centre, m")
    yaw: FiniteFloat = Field(0.0, description="counter-clockwise, rad")

    @model_validator(mode="before")
    @classmethod
    def _yaw_in_radians(cls, content: Any) -> Any:
        return in_radians(content, "yaw")

    @field_validator("yaw")
    @classmethod
    def _looks_like_radians(cls, yaw: float) -> float:
        looks_like_radians(yaw)
        return yaw

    @property
    def twist(self) -> Array:
        """The matrix (3, 3) that makes the tracked point's twist, in its own axes, of the robot's."""
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        axes = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        axes[np.abs(axes) < _ROUNDING] = 0.0  # of a quarter turn: a row of the design would be rounding alone
        return axes @ np.array([[1.0, 0.0, -self.y], [0.0, 1.0, self.x], [0.0, 0.0, 1.0]])


class Robot(Shown, Model):
    """A wheeled robot as designed.

    mount: the tracked point, where it is not the robot's centre. skid: True where fixed wheels have to slide in turns.
    """

    name: Name
    wheels: tuple[Wheel, ...] = Field(min_length=1)
    mount: Mount | None = Field(None, description="the tracked point in the robot's frame; default: its centre")
    skid: bool = Field(False, description="true for skid steering: fixed wheels slide when the robot turns")

    @model_validator(mode="after")
    def _moves(self) -> Robot:
        names = [wheel.name for wheel in self.wheels]
        if len(set(names)) < len(names):
            raise ValueError(f"wheel names must differ: {', '.join(names)}")
        if flaw := _flaw(self):
            raise ValueError(flaw)
        return self

    @model_serializer(mode="wrap")
    def _without_defaults(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Only what is said, so that files, hashes and documents of earlier versions stay as they were."""
        plain: dict[str, Any] = {"mount": None, "skid": False}
        return {key: value for key, value in write(self).items() if key not in plain or value != plain[key]}

    @property
    def drive(self) -> Drive:
        """The drive signals of its measured wheels."""
        return drive_of(self.wheels)

    @property
    def measured(self) -> tuple[Wheel, ...]:
        """The N wheels with a measured rate."""
        return tuple(wheel for wheel in self.wheels if wheel.has_rate)

    @property
    def wheel_names(self) -> tuple[str, ...]:
        """Names of the N wheels with a measured rate."""
        return self.drive.wheels

    @property
    def radii(self) -> Array:
        """Radii (N,) of the wheels with a measured rate, m."""
        return np.array([wheel.radius for wheel in self.measured])

    @property
    def reach(self) -> float:
        """Mean distance of the wheels from the robot's centre, m: turning counts as the speed that it gives them."""
        return float(np.mean([wheel.reach for wheel in self.measured]))

    @property
    def inverse_kinematic_matrix(self) -> Array:
        """K of the design values, shape (3, M): the tracked point's twist in m (rows 1, 2) and rad (row 3) per rad."""
        matrix = self.centre_matrix
        return matrix if self.mount is None else self.mount.twist @ matrix

    @property
    def centre_matrix(self) -> Array:
        """K of the design values for the twist of the robot's centre, shape (3, M)."""
        return _design(self)

    @property
    def allowed_basis(self) -> Array:
        """An orthonormal basis Z (3, D) of the centre's twists in which no fixed wheel slides."""
        return _allowed(self)

    @property
    def row_scales(self) -> Array:
        """Largest element (3,) of each row of the design; of rows 1 and 2 the other's where one holds zeros only."""
        rows = np.abs(self.inverse_kinematic_matrix).max(axis=1)
        rows[:2] = np.where(rows[:2] > 0, rows[:2], rows[:2].max())
        return rows

    @property
    def signal_equations(self) -> Array:
        """The matrix (M, 3) from a twist of the robot's centre to its signals: 1/m (columns 1, 2), 1 (column 3)."""
        return _equations(self)

    @property
    def allowed_twists(self) -> Array:
        """The matrix (3, 3) that takes from a twist of the tracked point what makes a fixed wheel slide."""
        allowed = _allowed(self)
        projection: Array = allowed @ allowed.T
        projection[np.abs(projection) < _ROUNDING] = 0.0
        if self.mount is None or len(allowed.T) == 3:
            return projection
        return self.mount.twist @ projection @ np.linalg.inv(self.mount.twist)

    @property
    def slides(self) -> bool:
        """True if it may move along the axles of its wheels: no fixed wheel forbids it, or it is skid-steered."""
        return self.skid or len(_allowed(self).T) == 3

    @property
    def motions(self) -> Array:
        """Twists (D, 3) of the centre that span what it can do: ahead, aside where it can, and turning."""
        return _motions(_allowed(self))


def _flaw(robot: Robot) -> str:
    """The reason why a robot cannot be, in words; empty if it can."""
    drive, lateral = robot.drive, [wheel for wheel in robot.wheels if wheel.kind == "fixed"]
    if len(drive.names) < 2:
        measured = ", ".join(drive.names) or "none"
        return f"two measured wheels are needed, or one that steers and is measured (measured: {measured})"
    if isinstance(drive, CarDrive) and (flaw := _flaw_of_car(robot)):
        return flaw
    allowed = _allowed(robot)
    if allowed.shape[1] < 2 or np.abs(allowed[2]).max() < _RANK:
        return _sliding(lateral)
    if robot.skid and not lateral:
        return "skid: true is for fixed wheels; this robot has none"
    driven = _equations(robot) @ allowed
    strengths = np.linalg.svd(driven / np.linalg.norm(driven, axis=0), compute_uv=False)
    if len(strengths) < allowed.shape[1] or strengths[-1] < _RANK * strengths[0]:
        if not lateral and drive.direct:
            return "these wheels cannot drive the robot in every direction; check angles and roller angles"
        return (
            f"signals {', '.join(drive.names)} do not determine how the robot moves; "
            "add a measured wheel or a steering angle"
        )
    return ""


def _sliding(fixed: Sequence[Wheel]) -> str:
    """Names the one of the fixed wheels whose axle is off the others' line, or all of them."""
    conditions = _conditions(fixed)
    off = [wheel.name for i, wheel in enumerate(fixed) if np.linalg.matrix_rank(np.delete(conditions, i, axis=0)) < 2]
    one = len(off) == 1 < len(fixed) - 1
    every = ", ".join(wheel.name for wheel in fixed)
    which, line = (f"wheel {off[0]}", "the others' axle") if one else (f"wheels {every}", "one axle")
    return (
        f"fixed {which} would have to slide when it turns; put {'it' if one else 'them'} on {line} (x, y, angle), or "
        "write skid: true beside the robot's wheels"
    )


def _conditions(fixed: Sequence[Wheel]) -> Array:
    """Rows (n, 3) that are orthogonal to the twists in which wheels do not slide along their axles, Eq. (2)."""
    rows = [np.array([math.cos(wheel.axle), math.sin(wheel.axle)]) @ _steered(*wheel.position) for wheel in fixed]
    return np.array(rows)


def _flaw_of_car(robot: Robot) -> str:
    """The reason why wheels that steer and are not driven cannot be read as a car's; empty if they can."""
    assert isinstance(robot.drive, CarDrive)
    guiding = ", ".join(wheel.name for wheel in robot.wheels if wheel.has_steering and not wheel.has_rate)
    others = [wheel.name for wheel in robot.measured if wheel.kind != "fixed" or wheel.rolling]
    if others:
        return (
            f"steered wheels {guiding} without a rate need fixed wheels that roll forward beside them, found "
            f"{', '.join(others)}; say measured: false for {guiding}, or driven: true"
        )
    if len(robot.measured) > 2:
        return (
            f"a car has one or two measured rear wheels, found {', '.join(robot.wheel_names)}; measured: false for one"
        )
    for name, (ahead, _) in zip(robot.drive.steered, robot.drive.ahead, strict=True):
        if abs(ahead) < _RANK or ahead * robot.drive.ahead[0][0] < 0:
            return f"steered wheel {name} must stand ahead of the fixed wheels, or all behind them; check x"
    return ""


def _equations(robot: Robot) -> Array:
    """E (M, 3) of a robot's signals."""
    rolling = wheel_equations(robot.measured)
    drive = robot.drive
    if isinstance(drive, CarDrive):
        ahead = float(np.mean([along for along, _ in drive.ahead]))
        rows = [rolling.mean(axis=0), np.array([0.0, 0.0, ahead / float(robot.radii.mean())])]
        return np.array([*rows, rolling[1] - rolling[0]] if len(rolling) == 2 else rows)
    rows = []
    for wheel, row in zip(robot.measured, rolling, strict=True):
        x, y = wheel.position
        rows += [row] if not wheel.has_steering else list(_steered(x, y) / wheel.radius)
    return np.array(rows)


def _steered(x: float, y: float) -> Array:
    """Velocity (2, 3) of the point (x, y) of a robot by its twist."""
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])


def _allowed(robot: Robot) -> Array:
    """Z (3, D): an orthonormal basis of the twists in which no fixed wheel slides, Eq. (2)."""
    fixed = [wheel for wheel in robot.wheels if wheel.kind == "fixed"]
    if not fixed:
        return np.eye(3)
    rows = _conditions(fixed)
    conditions = np.mean(rows, axis=0, keepdims=True) if robot.skid else rows
    _, strengths, directions = np.linalg.svd(conditions)
    rank = int((strengths > _RANK * strengths[0]).sum())
    allowed: Array = directions[rank:].T
    return allowed


def _motions(allowed: Array) -> Array:
    """Twists (D, 3) that span Z (3, D): for D = 3 x, y and turning, else along a line and turning."""
    if allowed.shape[1] == 3:
        return np.eye(3)
    line = allowed @ np.array([allowed[2, 1], -allowed[2, 0]])  # the twist of Z that does not turn
    turning = allowed @ allowed[2]  # the one nearest to turning on the spot
    motions: Array = np.array([motion / motion[np.abs(motion).argmax()] for motion in (line, turning)])
    return motions


def _design(robot: Robot) -> Array:
    """K (3, M) of a robot's centre."""
    drive = robot.drive
    if drive.direct and all(wheel.kind in ("omni", "mecanum") for wheel in robot.wheels):
        return inverse_kinematic_matrix(robot.measured)
    allowed, equations = _allowed(robot), _equations(robot)
    used = 2 if isinstance(drive, CarDrive) else len(equations)  # a car's difference of rates has no design
    matrix = np.zeros((3, len(equations)))
    matrix[:, :used] = allowed @ np.linalg.pinv(equations[:used] @ allowed)
    matrix[np.abs(matrix) < _ROUNDING * np.abs(matrix).max()] = 0.0
    return matrix


def relative_deviations(values: Array, design: Array) -> Array:
    """Shares (values - design) / design; NaN where the design value is 0 but for rounding, as m12 of Eq. (7)."""
    shares: Array = (values - design) / np.where(np.abs(design) < _ZERO, np.nan, design)
    return shares


def wheel_equations(wheels: Sequence[Wheel]) -> Array:
    """The matrix M (N, 3) that maps a twist (vx, vy, w) to wheel rates: 1/m (columns 1, 2) and 1 (column 3)."""
    radius, distance, angle = _columns(wheels)
    return wheel_rows(radius, distance, angle, np.array([wheel.roller_angle for wheel in wheels]))


def inverse_kinematic_matrix(wheels: Sequence[Wheel]) -> Array:
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
    return _pseudo_inverse(wheel_rows(r, R, d, rollers))


def _columns(wheels: Sequence[Wheel]) -> Array:
    """Radii, lever arms and directions of the axles (3, N)."""
    return np.array([[wheel.radius, wheel.lever, wheel.axle] for wheel in wheels]).T


def wheel_rows(radius: Array, distance: Array, angle: Array, rollers: Array) -> Array:
    """The wheel equations (..., N, 3) of radii, lever arms, axle directions (..., N) and roller angles (N,)."""
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
