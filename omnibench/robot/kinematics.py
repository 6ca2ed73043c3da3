"""Kinematics of wheeled robots: wheels, drive signals, the inverse kinematic matrix, and algebra of planar poses.

A wheel that rolls in one direction, or on rollers, has the equation ``omega = row . (vx, vy, w)`` with the row
``(-sin d + tan g cos d, cos d + tan g sin d, R) / r``: d is the direction of the wheel's axle, g the angle of its
rollers (0: none), R the lever arm of the driving force about the robot's centre, r the radius. A steered wheel at
(x, y) whose rate is measured has two, for its signals omega cos phi and omega sin phi, Eq. (D1):

    (omega cos phi, omega sin phi) = (vx - y w, vy + x w) / r.                                        (K1)

A fixed wheel does not slide along its axle, which is the condition

    0 = (cos d, sin d, x sin d - y cos d) . (vx, vy, w).                                              (K2)

The twists that all conditions allow have an orthonormal basis Z (3, D). With the equations E (M, 3) of all signals the
matrix is K = Z (E Z)^+, which gives the least-squares twist among them; for three omni wheels it is Eq. (3) of Palacin
et al. 2023. A skid-steered robot slides; the condition then is that the mean of its fixed wheels does not.

Poses are (x, y, heading), m, m, rad, and headings are not wrapped. Functions of two arrays (..., 3) of poses take every
pose with its counterpart, by NumPy's rules of broadcasting.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import chain
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    PlainSerializer,
    PlainValidator,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from omnibench.config import Model, Name
from omnibench.errors import UnknownNameError
from omnibench.views import Shown

Array = NDArray[np.floating[Any]]


def _as_lists(array: Array) -> list[Any]:
    """Nested lists; of texts where JSON has no number for an element."""
    return (array if np.isfinite(array).all() else array.astype(str)).tolist()


# An array as a field that pydantic writes as nested lists and reads back to the last bit.
JsonArray = Annotated[
    Array, PlainValidator(lambda values: np.array(values, dtype=float)), PlainSerializer(_as_lists, list[Any])
]

WheelType = Literal["omni", "mecanum", "fixed", "steered"]
RobotClass = Literal["omni", "mecanum", "differential", "skid", "tricycle", "car", "swerve", "mixed"]

_FORWARD = 0.0  # rad, the direction of rolling where none is given
_FARTHEST = 1e3  # m
_ON_AN_AXIS = 1e-9  # m2: a wheel ahead of the centre, or beside it, may have its rollers either way

# Largest steering angles where none is given, deg (chosen): a tricycle's front wheel nearly reaches the turn on the
# spot, a car's wheels 30 to 40 deg; any other module drives backward in the place of turning further than 90.
STEERING_LIMITS: Mapping[RobotClass, float] = MappingProxyType({"tricycle": 80.0, "car": 35.0})
FASTEST = 100.0  # rad/s; chosen, above the wheels of usual robots
FASTEST_RIM = 5.0  # m/s, of small wheels, which turn faster; chosen

# Of the largest singular value: directions below it are rounding of design values, which have some digits.
_RANK = 1e-6
_ZERO = 1e-9  # m, rad, or either per rad of wheel: no length, angle or element of a real robot is smaller but for 0
_ROUNDING = 1e-12  # of the largest element: a smaller one is no design value

# Standard deviations of measured poses, m and rad, beyond which a covariance means that it is unknown (chosen).
_LEAST_SIGMA, _LARGEST_SIGMA = 1e-7, 1e7

# Matrices of the APR-02 from Palacin et al. 2023: Eq. (8), the parametric calibration of the authors' earlier work, and
# Eq. (9), the genetic, non-parametric calibration of the article.
_PUBLISHED_ROWS = {
    "palacin2023_eq8": (
        (-0.0892930568372762, -0.0005606566978203, 0.0867466159313470),
        (0.0520955668635434, -0.1010213675626970, 0.0533117820461363),
        (0.2364093797047320, 0.2341358647406650, 0.2353792947863630),
    ),
    "palacin2023_eq9": (
        (-0.0883286476963123, 0.0000000000000000, 0.0873330402667908),
        (0.0522829495809178, -0.1008246738469390, 0.0536189007203205),
        (0.2357044251338890, 0.2338948216993490, 0.2348793373133590),
    ),
}
PUBLISHED = tuple(_PUBLISHED_ROWS)


def in_radians(content: Any, *keys: str) -> Any:
    """A mapping in which each of some angles, rad, may stand in degrees under its key with ``_deg`` at the end."""
    if not isinstance(content, dict):
        return content
    content = dict(content)
    for key in keys:
        degrees = f"{key}_deg"
        if degrees not in content:
            continue
        if key in content:
            raise ValueError(f"{key} and {degrees} are both given; keep one")
        if isinstance(content[degrees], bool) or not isinstance(content[degrees], int | float):
            raise ValueError(f"{degrees} must be a number (given: {content[degrees]!r})")
        content[key] = math.radians(content.pop(degrees))
    return content


def _with_usual_rollers(content: Any) -> Any:
    """A mecanum wheel by x and y with the rollers that it usually has, where none are given.

    Four such wheels show an X from above: the lever arm of each is ``abs(x) + abs(y)`` where it rolls forward.
    """
    if not isinstance(content, dict) or content.get("type") != "mecanum" or content.get("roller_angle") is not None:
        return content
    place = [content.get(key) for key in ("x", "y", "angle")]
    x, y, axle = (value if isinstance(value, int | float) else None for value in place)
    if x is None or y is None:
        return content
    rolling = _FORWARD if axle is None else axle + math.pi / 2
    ahead, left = x * math.cos(rolling) + y * math.sin(rolling), y * math.cos(rolling) - x * math.sin(rolling)
    if abs(ahead * left) < _ON_AN_AXIS:
        return content
    return content | {"roller_angle": math.copysign(math.pi / 4, ahead * left)}


def _looks_like_radians(angle: float) -> float:
    """The angle, rad. ValueError: no angle is that large."""
    if abs(angle) > 4 * math.pi:
        raise ValueError(f"{angle:g} cannot be an angle in rad; is it in degrees?")
    return angle


_Angle = Annotated[FiniteFloat, AfterValidator(_looks_like_radians)]
_Length = Annotated[FiniteFloat, Field(ge=1e-6, le=_FARTHEST)]
_Place = Annotated[FiniteFloat, Field(ge=-_FARTHEST, le=_FARTHEST)]


def in_degrees_too(*keys: str) -> Callable[[dict[str, Any]], None]:
    """Adds to a model's JSON schema the keys that ``in_radians`` takes."""

    def add(schema: dict[str, Any]) -> None:
        schema["properties"] |= {f"{key}_deg": {"type": "number", "description": f"{key} in degrees"} for key in keys}

    return add


class Wheel(Model):
    """Design values of one wheel, in the robot's frame (x forward, y left).

    The place of an omni or mecanum wheel is given as in Fig. 2 of Palacin et al. 2023 by ``distance``, the lever arm
    of its driving force about the centre, and ``angle``, the direction of its axle: for an omni wheel whose axle points
    at the centre its position in polar coordinates; for a mecanum wheel at (lx, ly) with rollers at 45 degrees and its
    axle along y +pi/2 (left) or -pi/2 (right), and ``abs(lx) + abs(ly)``. Or by x, y and the axle's angle.
    By x and y a mecanum wheel has the rollers of the usual arrangement, an X from above, unless it says others.
    A fixed wheel has x, y and, as ``angle``, the direction in which it rolls; a steered one x and y.
    driven: False for a steered wheel whose rate is not measured. measured: False for a wheel that only guides.
    """

    model_config = ConfigDict(json_schema_extra=in_degrees_too("angle", "roller_angle"))

    name: Name = Field(min_length=1, pattern=r"^[A-Za-z0-9_]+$", description="ends the column names: omega_<name>")
    radius: _Length = Field(description="m")
    type: WheelType | None = Field(None, description="default: omni or mecanum, by the roller angle")
    distance: _Length | None = Field(None, description="lever arm about the robot's centre, m")
    angle: _Angle | None = Field(
        None, description="direction of the axle (omni, mecanum) or of rolling (fixed, default 0), rad"
    )
    x: _Place | None = Field(None, description="in front of the robot's centre, m")
    y: _Place | None = Field(None, description="to the left of the centre, m")
    roller_angle: FiniteFloat = Field(0.0, gt=-1.5, lt=1.5, description="0 omni, +-pi/4 mecanum; rad")
    driven: bool = Field(True, description="steered wheels: false if only the steering angle is measured")
    measured: bool = Field(True, description="false for a wheel that only guides or rolls along")

    @model_validator(mode="before")
    @classmethod
    def _angles_in_radians(cls, content: Any) -> Any:
        return _with_usual_rollers(in_radians(content, "angle", "roller_angle"))

    @model_validator(mode="after")
    def _is_placed(self) -> Wheel:
        if self.kind in ("fixed", "steered"):
            if self.distance is not None:
                raise ValueError(f"a {self.type} wheel has x and y in the place of distance")
            for key in ("x", "y"):
                if getattr(self, key) is None:
                    raise ValueError(f"{key} of a {self.type} wheel is missing (m, x forward, y left)")
            if self.type == "steered" and self.angle is not None:
                raise ValueError("a steered wheel has no angle: its steering angle is 0 where it rolls forward")
        elif self.distance is None and (self.x is None or self.y is None):
            missing = "distance" if self.x is None and self.y is None else "x" if self.x is None else "y"
            raise ValueError(f"{missing} is missing; give distance and angle (of the axle), or x, y and angle")
        elif self.distance is not None and (self.x is not None or self.y is not None):
            raise ValueError("distance and x, y are both given; keep one")
        elif self.angle is None and (self.kind == "omni" or self.distance is not None):
            raise ValueError("angle (of the axle) is missing")
        if self.type in ("fixed", "steered") and self.roller_angle:
            raise ValueError(f"a {self.type} wheel has no rollers; leave roller_angle out, or is it a mecanum wheel?")
        if self.type == "mecanum" and not self.roller_angle:
            raise ValueError("roller_angle of a mecanum wheel is missing: +-pi/4, or roller_angle_deg: +-45")
        return self

    @model_serializer(mode="wrap")
    def _without_defaults(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Only what is said, so that files, hashes and documents of omni wheels stay as they were."""
        plain: dict[str, Any] = dict.fromkeys(("type", "distance", "angle", "x", "y"))
        plain |= {"driven": True, "measured": True}
        if self.type in ("fixed", "steered"):
            plain["roller_angle"] = 0.0
        return {key: value for key, value in write(self).items() if key not in plain or value != plain[key]}

    @property
    def kind(self) -> WheelType:
        """The type, of a wheel without one by its rollers."""
        return self.type or ("mecanum" if self.roller_angle else "omni")

    @property
    def has_rate(self) -> bool:
        """True if its rate is measured."""
        return self.measured and (self.kind != "steered" or self.driven)

    @property
    def has_steering(self) -> bool:
        """True if its steering angle is measured."""
        return self.measured and self.kind == "steered"

    @property
    def rolling(self) -> float:
        """Direction in which a positive rate drives the robot over this wheel, rad; of a steered one at angle 0."""
        if self.kind in ("fixed", "steered") or self.angle is None:
            return self.angle or _FORWARD
        return self.angle + math.pi / 2

    @property
    def axle(self) -> float:
        """Direction of the axle, rad, a quarter turn clockwise from that of rolling."""
        if self.kind in ("omni", "mecanum") and self.angle is not None:
            return self.angle
        return self.rolling - math.pi / 2

    @property
    def position(self) -> tuple[float, float]:
        """Position x, y, m; of a wheel given by its lever arm on the line of its axle."""
        if self.x is not None and self.y is not None:
            return self.x, self.y
        assert self.distance is not None  # it is placed
        assert self.angle is not None
        return self.distance * math.cos(self.angle), self.distance * math.sin(self.angle)

    @property
    def lever(self) -> float:
        """Lever arm of the driving force about the robot's centre, m; above 0 where it turns counter-clockwise."""
        if self.distance is not None:
            return self.distance
        x, y = self.position
        cosine, sine = math.cos(self.rolling), math.sin(self.rolling)
        return x * sine - y * cosine - math.tan(self.roller_angle) * (x * cosine + y * sine)

    @property
    def outward(self) -> float:
        """Direction of the wheel as seen from the robot's centre, rad; where only a lever arm is given, of its axle."""
        if self.distance is not None and self.angle is not None:
            return self.angle
        x, y = self.position
        return math.atan2(y, x)

    @property
    def reach(self) -> float:
        """Distance from the robot's centre as what counts when it turns, m: the lever arm where that is given."""
        return self.distance if self.distance is not None else math.hypot(*self.position)


def fastest_rates(radii: Array) -> Array:
    """Rates (N,), rad/s, that no wheels of radii (N,), m, exceed."""
    return np.maximum(FASTEST, FASTEST_RIM / radii)


@dataclass(frozen=True)
class Drive:
    """Drive signals: the quantities u (M,) in which a robot's twist is linear, twist = K u, from what its wheels
    measure.

    Let omega_i be the rate of wheel i and phi_j the steering angle of wheel j, both in the middle of a sample. A wheel
    that rolls in a fixed direction, or on rollers, has the signal omega_i. A steered wheel whose rate is measured moves
    the robot over itself by

        r omega (cos phi, sin phi)                                                    (D1)

    along x and y, and has the two signals omega cos phi and omega sin phi; K then holds its radius, its place and the
    offset of its steering angle. phi of sample k is the mean of phi(k-1) and phi(k), measured at the ends of the
    samples; the first sample holds phi(1).

    wheels (N): names of the wheels with a measured rate. steered (S): of those with a measured steering angle. names
    (M): of the signals. pairs (N): index of the steering angle that turns each wheel; -1 for one that does not steer.
    """

    wheels: tuple[str, ...]
    steered: tuple[str, ...]
    names: tuple[str, ...]
    pairs: tuple[int, ...]

    @property
    def direct(self) -> bool:
        """True if the wheel rates are the signals."""
        return not self.steered

    def signals(self, rates: Array, steering: Array | None) -> Array:
        """Signals (F, M) of mean wheel rates (F, N), rad/s, at steering angles (F, S) in the samples' middles, rad."""
        if self.direct:
            return rates
        assert steering is not None  # there are steered wheels
        wheels, _, _ = self._columns
        return rates.take(wheels, axis=1) * self._factors(steering)

    @cached_property
    def _columns(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Wheel (M) of each signal, column (M) of (1, cos phi (S), sin phi (S)) that multiplies it, and first signals.

        First signals (N): those of each wheel.
        """
        columns: list[tuple[int, int]] = []
        first = []
        for wheel, pair in enumerate(self.pairs):
            first.append(len(columns))
            columns += [(wheel, 0)] if pair < 0 else [(wheel, 1 + pair), (wheel, 1 + pair + len(self.steered))]
        wheels, factors = np.array(columns).T
        return wheels, factors, np.array(first)

    def _factors(self, steering: Array) -> Array:
        """Factors (F, M) by which steering angles (F, S) multiply the rates of the signals' wheels."""
        table = np.concatenate([np.ones((len(steering), 1)), np.cos(steering), np.sin(steering)], axis=1)
        return table.take(self._columns[1], axis=1)

    def slopes(self, rates: Array, steering: Array | None) -> tuple[Array, Array]:
        """Derivatives (F, M, N) and (F, M, S) of the signals by the rates and by the steering angles in the middles."""
        wheels, _, first = self._columns
        factors = np.ones(rates.shape) if steering is None else self._factors(steering)
        by_rate = np.zeros((*factors.shape, len(self.wheels)))
        by_angle = np.zeros((*factors.shape, len(self.steered)))
        by_rate[:, np.arange(len(wheels)), wheels] = factors
        for wheel, (along, pair) in enumerate(zip(first, self.pairs, strict=True)):
            if pair >= 0:
                by_angle[:, along, pair] = rates[:, wheel] * -factors[:, along + 1]
                by_angle[:, along + 1, pair] = rates[:, wheel] * factors[:, along]
        return by_rate, by_angle

    def commands(self, signals: Array) -> tuple[Array, Array]:
        """Wheel rates (F, N), rad/s, and steering angles (F, S), rad, that give signals (F, M): what to command.

        Steering angles lie within half a turn, and the rates of steered wheels are not negative; one that stands steers
        straight ahead.
        """
        _, _, first = self._columns
        rates, steering = signals[:, first], np.zeros((len(signals), len(self.steered)))
        for wheel, (along, pair) in enumerate(zip(first, self.pairs, strict=True)):
            if pair >= 0:
                ahead, across = signals[:, along], signals[:, along + 1]
                rates[:, wheel], steering[:, pair] = np.hypot(ahead, across), np.arctan2(across, ahead)
        return rates, steering


@dataclass(frozen=True)
class CarDrive(Drive):
    """Drive signals of a car, which steers by wheels of which only the angle is measured.

    Its rear wheels, at the rates omega_i, have the mean rate m. With w the rate of turn and v the speed of the middle
    of its rear axle, a front wheel at (L_j, y_j) from there rolls without sliding if

        tan phi_j = L_j w / (v - y_j w),  so that  w / v = tan phi_j / (L_j + y_j tan phi_j),       (D2)

    by which every steered wheel gives the tangent t_j = L w / v of the one on the middle line, L ahead, with L the mean
    of L_j. The car's signals are m, m t with t the mean of t_j, and, of two rear wheels, the difference of their rates.

    ahead (S): L_j and y_j of every steered wheel as in Eq. (D2), m.
    """

    ahead: tuple[tuple[float, float], ...]

    def signals(self, rates: Array, steering: Array | None) -> Array:
        assert steering is not None  # a car steers
        mean = rates.mean(axis=1)
        columns = [mean, mean * self._tangent(steering)]
        if rates.shape[1] == 2:
            columns.append(rates[:, 1] - rates[:, 0])
        return np.stack(columns, axis=1)

    def slopes(self, rates: Array, steering: Array | None) -> tuple[Array, Array]:
        assert steering is not None  # a car steers
        wheels = len(self.wheels)
        by_rate = np.zeros((len(rates), len(self.names), wheels))
        by_angle = np.zeros((len(rates), len(self.names), len(self.steered)))
        by_rate[:, 0] = 1 / wheels
        by_rate[:, 1] = self._tangent(steering)[:, None] / wheels
        by_rate[:, 2:] = (-1, 1)[:wheels]
        along, across = np.array(self.ahead).T
        tangents = np.tan(steering)
        slopes = along.mean() * along * (1 + tangents**2) / (along + across * tangents) ** 2 / len(along)
        by_angle[:, 1] = rates.mean(axis=1, keepdims=True) * slopes
        return by_rate, by_angle

    def commands(self, signals: Array) -> tuple[Array, Array]:
        mean = signals[:, 0]
        tangent = np.divide(signals[:, 1], mean, out=np.zeros(len(mean)), where=mean != 0)[:, None]
        along, across = np.array(self.ahead).T
        steering: Array = np.arctan(along * tangent / (along.mean() - across * tangent))
        rates = np.repeat(mean[:, None], len(self.wheels), axis=1)
        if signals.shape[1] == 3:
            rates += signals[:, 2:] * (-0.5, 0.5)
        return rates, steering

    def _tangent(self, steering: Array) -> Array:
        """Mean t (F,) of the tangents by which the steering angles (F, S) turn the car, Eq. (D2)."""
        along, across = np.array(self.ahead).T
        tangents = np.tan(steering)
        return (along.mean() * tangents / (along + across * tangents)).mean(axis=1)


@lru_cache(maxsize=64)
def drive_of(wheels: tuple[Wheel, ...]) -> Drive:
    """The drive signals of a robot's wheels; those that are not measured are left out."""
    rolling = [wheel for wheel in wheels if wheel.has_rate]
    steered = [wheel for wheel in wheels if wheel.has_steering]
    names, angles = tuple(wheel.name for wheel in rolling), tuple(wheel.name for wheel in steered)
    pairs = tuple(angles.index(wheel.name) if wheel.has_steering else -1 for wheel in rolling)
    guiding = [wheel.position for wheel in steered if not wheel.has_rate]
    if guiding and rolling:
        x, y = np.mean([wheel.position for wheel in rolling], axis=0).tolist()
        ahead = tuple((front - x, left - y) for front, left in guiding)
        return CarDrive(names, angles, ("mean", "mean_tan", "difference")[: 1 + len(rolling)], pairs, ahead)
    signals = ((name,) if pair < 0 else (f"{name}_cos", f"{name}_sin") for name, pair in zip(names, pairs, strict=True))
    return Drive(names, angles, tuple(chain.from_iterable(signals)), pairs)


def in_the_middle(steering: Array) -> Array:
    """Steering angles (F, S) in the middles of the samples from those at their ends, rad; the first one holds."""
    before = np.vstack([steering[:1], steering[:-1]])
    return (before + steering) / 2


class Mount(Model):
    """Pose of the tracked point, whose poses the reference reports, in the robot's frame."""

    model_config = ConfigDict(json_schema_extra=in_degrees_too("yaw"))

    x: FiniteFloat = Field(0.0, description="forward of the robot's centre, m")
    y: FiniteFloat = Field(0.0, description="to the left of the robot's centre, m")
    yaw: _Angle = Field(0.0, description="counter-clockwise, rad")

    @model_validator(mode="before")
    @classmethod
    def _yaw_in_radians(cls, content: Any) -> Any:
        return in_radians(content, "yaw")

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
    # Not written where they are not given, so that files, hashes and documents of earlier versions stay as they were.
    mount: Mount | None = Field(
        None, description="the tracked point in the robot's frame; default: its centre", exclude_if=operator.not_
    )
    skid: bool = Field(
        False, description="true for skid steering: fixed wheels slide when the robot turns", exclude_if=operator.not_
    )

    @model_validator(mode="after")
    def _moves(self) -> Robot:
        """Refuse a robot that cannot be, or whose motion its signals do not determine."""
        names = [wheel.name for wheel in self.wheels]
        if len(set(names)) < len(names):
            raise ValueError(f"wheel names must differ: {', '.join(names)}")
        drive, fixed = self.drive, [wheel for wheel in self.wheels if wheel.kind == "fixed"]
        if len(drive.names) < 2:
            measured = ", ".join(drive.names) or "none"
            raise ValueError(
                f"two measured wheels are needed, or one that steers and is measured (measured: {measured})"
            )
        if isinstance(drive, CarDrive):
            _check_car(self, drive)
        allowed = self.allowed_basis
        if allowed.shape[1] < 2 or np.abs(allowed[2]).max() < _RANK:
            raise ValueError(_sliding(fixed))
        if self.skid and not fixed:
            raise ValueError("skid: true is for fixed wheels; this robot has none")
        driven = self.signal_equations @ allowed
        lengths = np.linalg.norm(driven, axis=0)
        strengths = np.linalg.svd(driven / np.maximum(lengths, _RANK * lengths.max()), compute_uv=False)
        if len(strengths) < allowed.shape[1] or strengths[-1] < _RANK * strengths[0]:
            if not fixed and drive.direct:
                raise ValueError(
                    "these wheels cannot drive the robot in every direction; check angles and roller angles"
                )
            raise ValueError(
                f"signals {', '.join(drive.names)} do not determine how the robot moves; "
                "add a measured wheel or a steering angle"
            )
        return self

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
        """Mean distance of the wheels from the robot's centre, m: turning counts as the speed that it gives them.

        Of the wheels with a measured rate; of all of them where those stand in the centre, as that of a car with one.
        """
        measured = float(np.mean([wheel.reach for wheel in self.measured]))
        return measured if measured > _ZERO else float(np.mean([wheel.reach for wheel in self.wheels]))

    @property
    def inverse_kinematic_matrix(self) -> Array:
        """K of the design values, shape (3, M): the tracked point's twist in m (rows 1, 2) and rad (row 3) per rad."""
        matrix = self.centre_matrix
        return matrix if self.mount is None else self.mount.twist @ matrix

    @property
    def centre_matrix(self) -> Array:
        """K of the design values for the twist of the robot's centre, shape (3, M)."""
        drive = self.drive
        if drive.direct and all(wheel.kind in ("omni", "mecanum") for wheel in self.wheels):
            return inverse_kinematic_matrix(self.measured)
        allowed, equations = self.allowed_basis, self.signal_equations
        used = 2 if isinstance(drive, CarDrive) else len(equations)  # a car's difference of rates has no design
        matrix = np.zeros((3, len(equations)))
        matrix[:, :used] = allowed @ np.linalg.pinv(equations[:used] @ allowed)
        matrix[np.abs(matrix) < _ROUNDING * np.abs(matrix).max()] = 0.0
        return matrix

    @property
    def allowed_basis(self) -> Array:
        """An orthonormal basis Z (3, D) of the centre's twists in which no fixed wheel slides, Eq. (K2)."""
        fixed = [wheel for wheel in self.wheels if wheel.kind == "fixed"]
        if not fixed:
            return np.eye(3)
        rows = _conditions(fixed)
        conditions = np.mean(rows, axis=0, keepdims=True) if self.skid else rows
        _, strengths, directions = np.linalg.svd(conditions)
        rank = int((strengths > _RANK * strengths[0]).sum())
        return directions[rank:].T

    @property
    def row_scales(self) -> Array:
        """Largest element (3,) of each row of the design; of rows 1 and 2 the other's where one holds zeros only."""
        rows = np.abs(self.inverse_kinematic_matrix).max(axis=1)
        rows[:2] = np.where(rows[:2] > 0, rows[:2], rows[:2].max())
        return rows

    @property
    def signal_equations(self) -> Array:
        """The matrix (M, 3) from a twist of the robot's centre to its signals: 1/m (columns 1, 2), 1 (column 3)."""
        rolling, drive = wheel_equations(self.measured), self.drive
        if isinstance(drive, CarDrive):
            ahead = float(np.mean([along for along, _ in drive.ahead]))
            rows = [rolling.mean(axis=0), np.array([0.0, 0.0, ahead / float(self.radii.mean())])]
            return np.array([*rows, rolling[1] - rolling[0]] if len(rolling) == 2 else rows)
        rows = []
        for wheel, row in zip(self.measured, rolling, strict=True):
            rows += list(_steered(*wheel.position) / wheel.radius) if wheel.has_steering else [row]  # Eq. (K1)
        return np.array(rows)

    @property
    def allowed_twists(self) -> Array:
        """The matrix (3, 3) that takes from a twist of the tracked point what makes a fixed wheel slide."""
        allowed = self.allowed_basis
        projection: Array = allowed @ allowed.T
        projection[np.abs(projection) < _ROUNDING] = 0.0
        if self.mount is None or len(allowed.T) == 3:
            return projection
        return self.mount.twist @ projection @ np.linalg.inv(self.mount.twist)

    @property
    def slides(self) -> bool:
        """True if it may move along the axles of its wheels: no fixed wheel forbids it, or it is skid-steered."""
        return self.skid or len(self.allowed_basis.T) == 3

    @property
    def motions(self) -> Array:
        """Twists (D, 3) of the centre that span what it can do: for D = 3 x, y and turning, else a line and turning."""
        allowed = self.allowed_basis
        if allowed.shape[1] == 3:
            return np.eye(3)
        line = allowed @ np.array([allowed[2, 1], -allowed[2, 0]])  # the twist of Z that does not turn
        turning = allowed @ allowed[2]  # the one nearest to turning on the spot
        return np.array([motion / motion[np.abs(motion).argmax()] for motion in (line, turning)])


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
    """Rows (n, 3) that are orthogonal to the twists in which wheels do not slide along their axles, Eq. (K2)."""
    rows = [np.array([math.cos(wheel.axle), math.sin(wheel.axle)]) @ _steered(*wheel.position) for wheel in fixed]
    return np.array(rows)


def _steered(x: float, y: float) -> Array:
    """Velocity (2, 3) of the point (x, y) of a robot by its twist."""
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])


def _check_car(robot: Robot, drive: CarDrive) -> None:
    """Raise ValueError if wheels that steer and are not driven cannot be read as a car's."""
    guiding = ", ".join(wheel.name for wheel in robot.wheels if wheel.has_steering and not wheel.has_rate)
    others = [wheel.name for wheel in robot.measured if wheel.kind != "fixed" or wheel.rolling]
    if others:
        raise ValueError(
            f"steered wheels {guiding} without a rate need fixed wheels that roll forward beside them, found "
            f"{', '.join(others)}; say measured: false for {guiding}, or driven: true"
        )
    if len(robot.measured) > 2:
        raise ValueError(
            f"a car has one or two measured rear wheels, found {', '.join(robot.wheel_names)}; measured: false for one"
        )
    for name, (ahead, _) in zip(drive.steered, drive.ahead, strict=True):
        if abs(ahead) < _RANK or ahead * drive.ahead[0][0] < 0:
            raise ValueError(f"steered wheel {name} must stand ahead of the fixed wheels, or all behind them; check x")


def relative_deviations(values: Array, design: Array) -> Array:
    """Shares (values - design) / design; NaN where the design value is 0 but for rounding, as m12 of Eq. (7) of Palacin
    et al. 2023."""
    return (values - design) / np.where(np.abs(design) < _ZERO, np.nan, design)


def wheel_equations(wheels: Sequence[Wheel]) -> Array:
    """The matrix M (N, 3) that maps a twist (vx, vy, w) to wheel rates: 1/m (columns 1, 2) and 1 (column 3)."""
    return wheel_rows(*_geometry(wheels))


def inverse_kinematic_matrix(wheels: Sequence[Wheel]) -> Array:
    """M^-1 of these wheels, shape (3, N): Eq. (3) of Palacin et al. for three omni wheels, else the pseudo-inverse."""
    radius, distance, angle, rollers = _geometry(wheels)
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
    equations = wheel_rows(r, R, d, rollers)
    finite = np.isfinite(equations).all(axis=(-2, -1))  # LAPACK raises on NaN and never returns on infinity
    inverse: Array = np.full(np.swapaxes(equations, -2, -1).shape, np.nan)
    inverse[finite] = np.linalg.pinv(equations[finite])
    return inverse


def _geometry(wheels: Sequence[Wheel]) -> tuple[Array, Array, Array, Array]:
    """Radii, lever arms, directions of the axles and roller angles (N,)."""
    radius, lever, axle = np.array([[wheel.radius, wheel.lever, wheel.axle] for wheel in wheels]).T
    return radius, lever, axle, np.array([wheel.roller_angle for wheel in wheels])


def wheel_rows(radius: Array, distance: Array, angle: Array, rollers: Array) -> Array:
    """The wheel equations (..., N, 3) of radii, lever arms, axle directions (..., N) and roller angles (N,)."""
    slant = np.tan(rollers)
    across = -np.sin(angle) + slant * np.cos(angle)
    along = np.cos(angle) + slant * np.sin(angle)
    return np.stack([across, along, distance], axis=-1) / radius[..., None]


def _eq_3(r: Array, R: Array, d: Array) -> Array:
    """M^-1 (..., 3, 3) of three omni wheels, Eq. (3) of Palacin et al. 2023."""
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


def class_of(robot: Robot) -> RobotClass:
    """The class of a robot by its measured wheels.

    differential: fixed wheels on one axle. tricycle: steered driven wheels beside fixed ones that guide. swerve:
    steered driven wheels alone. mixed: measured wheels of several kinds.
    """
    if isinstance(robot.drive, CarDrive):
        return "car"
    kinds = {wheel.kind for wheel in robot.measured}
    if len(kinds) > 1:
        return "mixed"
    (kind,) = kinds
    if kind == "fixed":
        return "skid" if robot.skid else "differential"
    if kind == "steered":
        return "tricycle" if any(wheel.kind == "fixed" for wheel in robot.wheels) else "swerve"
    return kind


def rotation(angle: float) -> Array:
    """Matrix (3, 3) that turns a pose's or a twist's (x, y, heading) counter-clockwise by an angle, rad."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def rotated(vectors: Array, angles: Array | float) -> Array:
    """Vectors (..., 2), turned counter-clockwise by angles (...), rad; of vectors (..., 3) the first two elements."""
    cosine, sine = np.cos(angles), np.sin(angles)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def placed(pose: Array, points: Array) -> Array:
    """Points (..., 2) given in the frame of a pose (..., 3), in the frame of the pose's parent."""
    return pose[..., :2] + rotated(points, pose[..., 2])


def seen_from(pose: Array, points: Array) -> Array:
    """Points (..., 2) as seen from a pose (..., 3): the inverse of ``placed``."""
    return rotated(points[..., :2] - pose[..., :2], -pose[..., 2])


def compose(first: Array, second: Array) -> Array:
    """Composition (..., 3) of poses: ``second``, given in the frame ``first``, in the frame of ``first``'s parent."""
    return np.concatenate([placed(first, second), (first + second)[..., 2:]], axis=-1)


def relative(first: Array, second: Array) -> Array:
    """``second`` (..., 3) as seen from ``first``, so that compose(first, relative(first, second)) is ``second``."""
    return np.concatenate([seen_from(first, second), (second - first)[..., 2:]], axis=-1)


def moved_to(start: Array, poses: Array) -> Array:
    """A path (K, 3), K >= 1, moved rigidly so that it begins at the pose ``start`` (3,)."""
    return compose(start, relative(poses[0], poses))


def interpolated(times: Array | float, stamps: Array, rows: Array) -> Array:
    """Rows (..., n) at times (...), s, by straight lines between the rows (K, n) at the stamps (K,); held beyond."""
    return np.stack([np.interp(times, stamps, column) for column in rows.T], axis=-1)


def wrapped(angles: Array) -> Array:
    """Angles in [-pi, pi), rad, that differ from the given ones by whole turns."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def unit_twist(motion: Array) -> Array:
    """The constant twist that makes a motion in unit time: the logarithm map of SE(2).

    motion (..., 3): the pose after it as seen from before, m, m, rad. ``advance`` by arcs is the inverse. Beyond half a
    turn the twist grows without bound towards a whole turn; it is limited to the length of half a turn.
    """
    half = motion[..., 2:] / 2
    longer = 1 / np.sinc(np.minimum(np.abs(half), np.pi / 2) / np.pi)
    return np.concatenate([rotated(motion, -half[..., 0]) * longer, motion[..., 2:]], axis=-1)


def correction(in_map: Array, in_odom: Array) -> Array:
    """Pose (3,) of frame odom in frame map, from the robot's pose (3,) in both (REP-105)."""
    x, y, heading = in_map.tolist()
    odom_x, odom_y, odom_heading = in_odom.tolist()
    turned = heading - odom_heading
    cosine, sine = math.cos(turned), math.sin(turned)
    return np.array([x - cosine * odom_x + sine * odom_y, y - sine * odom_x - cosine * odom_y, turned])


def pose_covariance(position_sigma: float, heading_sigma_deg: float) -> Array:
    """Covariance (3, 3) of a pose by its standard deviations, m and deg."""
    return np.diag([position_sigma, position_sigma, math.radians(heading_sigma_deg)]) ** 2


def usable_covariances(covariances: Array) -> NDArray[np.bool_]:
    """True for poses' covariances (..., 3, 3), m and rad; False for what senders write where they do not know them."""
    possible = np.asarray((np.abs(covariances) <= _LARGEST_SIGMA**2).all(axis=(-2, -1)))
    filled = np.where(possible[..., None, None], covariances, np.eye(3))
    symmetric = np.isclose(filled, np.swapaxes(filled, -2, -1)).all(axis=(-2, -1))
    return possible & symmetric & (np.linalg.eigvalsh(filled)[..., 0] >= _LEAST_SIGMA**2)


def published_matrix(name: str) -> Array:
    """A published inverse kinematic matrix (3, 3) of the APR-02. UnknownNameError lists the names."""
    if name not in _PUBLISHED_ROWS:
        raise UnknownNameError("published matrix", name, _PUBLISHED_ROWS)
    return np.array(_PUBLISHED_ROWS[name])
