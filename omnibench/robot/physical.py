"""The geometry of a robot, the matrix that it makes, and the way back: physical parameters by a matrix.

Of a wheel on rollers, or one that rolls in one direction, count radius, distance (the lever arm of its driving force
about the robot's centre) and, on rollers, the angle of its axle: Eq. (3) of Palacin et al. 2023 for three omni wheels.
Of a steered wheel whose rate is measured count radius, place x, y and offset, by which its true steering angle exceeds
the measured one. Of a car count the radius of its rear wheels, its wheelbase and the offset of its steering. The place
and yaw of the tracked point in the robot's frame count, too (Censi et al., IEEE T-RO 29:475, 2013). What turns the
signals themselves, such as the gain of a steering angle, are effects.

``Geometry`` maps the numbers v of a robot's geometry to its matrix K (3, M); ``read_matrix`` is the way back, to radii,
track, wheelbase, distances, angles, zeros and the tracked point. Robots of a class lie about their design as

    v = v0 + B z,    p = p0 + R z,    z ~ N(0, 1),                                                        (1)

p being the parameters that are reported, such as the track, which is the distance between wheels that each have a
lever arm. Of K counts what a robot's motions show: four wheels drive three motions. With J = dK/dz at the design, in
units of the largest element of each row, the changes of z fall into those that K shows, with the orthonormal basis V,
and those that it does not, J w = 0: radii of single wheels where four drive three motions, or what is the tracked
point's place and what the distances of three omni wheels. There z keeps the design. Gauss-Newton steps

    z = V y,    y <- y + (W J V)^+ W (K - K(z))                                                            (2)

find the least-squares point. The weights W'W are the inverse covariance of K: the elements' C, and the tolerance of a
class for what no geometry has, such as slip that shortens one row. Elements that scatter by C, and the tolerance along
changes that K does not show, make parameters scatter by

    cov p = R A C A' R' + R (1 - V V') R',    A = V (W J V)^+ W.                                           (3)
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Literal, Protocol

import numpy as np
from pydantic import FiniteFloat
from scipy.special import chdtri, stdtrit

from omnibench.config import Model, Name
from omnibench.errors import DataError
from omnibench.robot import kinematics
from omnibench.robot.kinematics import Array, CarDrive, Robot, RobotClass, class_of, relative_deviations

INTERVAL = 0.95  # probability of the intervals, by convention; every table of the program says 95 %
# Degrees of freedom that stand for infinity: the quantile of Student's t differs from the normal one by 2e-9 there.
MANY = 1e9

_RANK = 1e-6  # share of the strongest change of z: less is rounding, and the matrix does not show it
_UNSEEN = 1e-3  # share of a parameter's variance by tolerance: from it on it depends on what the data do not tell
_SHOWN = 0.1  # share of an unknown change that shows in motions: one of less is of wheels that only slip; chosen
_NO_VARIANCE = 1e-9  # share of a parameter's deviation by tolerance: less is rounding
_RESTING, _MOST_STEPS = 1e-8, 50  # of y, in deviations of the tolerance
_FARTHEST = 1e3  # the same, of numbers that no robot has
_LEAST = 0.01  # share of the design: no wheel and no wheelbase is smaller
_MISFIT = 1e-3  # probability that the matrix of a geometry misses the one that was fitted by more; chosen
# Share of the design: "too high to be justified as being caused by assembling or manufacturing errors" (Palacin et al.
# 2023, section 4.2, of the parameters of their Eq. (8)).
_IMPLAUSIBLE = 0.10
_NO_LENGTH = 1e-6  # m: a shorter track or wheelbase is none
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
        reach = robot.reach
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

    @cached_property
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

    def matrices(self, vectors: Array) -> Array:
        """Matrices (P, 3, M) of vectors (P, n) of numbers."""
        robot, of_number = self.robot, dict(zip(self.names, vectors.T, strict=True))
        if isinstance(robot.drive, CarDrive):
            radius, wheelbase, offset = (of_number[name][:, None] for name in ("radius", "wheelbase", "offset"))
            matrices = robot.centre_matrix * (radius / robot.radii.mean())[..., None]
            matrices[..., 1] *= float(np.mean(robot.drive.ahead, axis=0)[0]) / wheelbase
            if offset.any():  # tan(phi + c) is tan phi + c near phi = 0
                matrices[..., 0] += offset * matrices[..., 1]
        elif all(wheel.kind in ("omni", "mecanum") for wheel in robot.wheels):
            radius, distance, angle = (
                np.stack([of_number[f"{kind}_{name}"] for name in robot.wheel_names], axis=1)
                for kind in ("radius", "distance", "angle")
            )
            rollers = [wheel.roller_angle for wheel in robot.measured]
            matrices = kinematics.inverse_kinematic_matrices(radius, distance, angle, rollers)
        else:
            rows: list[Array] = []
            for wheel in robot.measured:
                radius = of_number[f"radius_{wheel.name}"]
                if wheel.has_steering:
                    # The two rows of its signals, Eq. (K1) of kinematics.py, turned by the offset
                    steered = _twists(*(of_number[f"{kind}_{wheel.name}"] for kind in ("x", "y", "offset")))
                    rows += [steered[:, row] / radius[:, None] for row in (0, 1)]
                else:
                    angle = of_number.get(f"angle_{wheel.name}", np.full(len(radius), wheel.axle))
                    distance = of_number[f"distance_{wheel.name}"]
                    rows.append(kinematics.wheel_rows(radius, distance, angle, np.array(wheel.roller_angle)))
            basis = robot.allowed_basis
            matrices = basis @ np.linalg.pinv(np.stack(rows, axis=1) @ basis)
        mount = vectors[:, -3:]
        if not (mount == self.design[-3:]).all():
            return _twists(*mount.T) @ matrices
        return matrices if robot.mount is None else robot.mount.twist @ matrices

    def slopes(self, vector: Array) -> Array:
        """Derivatives (3M, n) of the matrix elements, row by row, by central differences."""
        steps = _STEP * np.diag(self.scale)
        difference = self.matrices(vector + steps) - self.matrices(vector - steps)
        return (difference.reshape(len(steps), -1) / (2 * _STEP * self.scale)[:, None]).T


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


@dataclass(frozen=True, eq=False)
class EstimatedCovariance:
    """Covariance (n, n) of n numbers, and degrees of freedom (n,) of their variances, or one for all."""

    matrix: Array
    degrees_of_freedom: Array | float = np.inf

    def of(self, slopes: Array) -> EstimatedCovariance:
        """Covariance of q functions of the numbers, with derivatives (q, n), and degrees of freedom of their variances.

        The reciprocal of a function's degrees of freedom is the mean of those of the numbers, weighted by their shares
        in its variance: what depends on one number has that number's, and numbers that agree give theirs.
        """
        weights = np.abs(slopes * (slopes @ self.matrix))
        freedom = np.broadcast_to(np.minimum(self.degrees_of_freedom, MANY), len(self.matrix))
        reciprocals = (weights / freedom).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-300)
        return EstimatedCovariance(slopes @ self.matrix @ slopes.T, 1 / np.maximum(reciprocals, 1 / MANY))

    @property
    def standard_deviations(self) -> Array:
        """Standard deviations (n,)."""
        return np.sqrt(np.maximum(np.diag(self.matrix), 0.0))

    @property
    def reach(self) -> Array:
        """Half-widths (n,) of the 95 % intervals."""
        quantile = stdtrit(np.minimum(self.degrees_of_freedom, MANY), (1 + INTERVAL) / 2)
        return np.asarray(quantile * self.standard_deviations)


Unit = Literal["m", "rad", "rad/s", "1"]


class NamedEffect(Protocol):
    """An effect by its name, with the values of its parameters, as a calibration file holds it."""

    @property
    def name(self) -> str: ...
    @property
    def parameters(self) -> Mapping[str, float]: ...


class PhysicalParameter(Model):
    """A physical parameter: design, value and 95 % interval, in ``unit`` (m, rad, rad/s; 1 for a factor).

    low, high: None where there is no interval.
    """

    name: Name
    design: FiniteFloat
    value: FiniteFloat
    unit: Unit
    low: FiniteFloat | None = None
    high: FiniteFloat | None = None

    @property
    def deviation(self) -> float:
        """The difference from the design value, in the parameter's unit."""
        return self.value - self.design

    @property
    def deviation_percent(self) -> float | None:
        """The difference as % of the design value, None where that is 0; of an angle it means nothing."""
        share = float(relative_deviations(np.array(self.value), np.array(self.design)))
        return None if math.isnan(share) else 100 * share


def unit_of(name: str) -> Unit:
    """The unit of a physical parameter, or of a number of the geometry, by its name."""
    if name.startswith("steering_gain"):
        return "1"
    if name == "lost_rate":
        return "rad/s"
    return "rad" if name.startswith(("angle", "offset", "steering_zero", "mount_yaw")) else "m"


@dataclass(frozen=True, eq=False)
class PhysicalReading:
    """The physical parameters of a matrix; none, where no geometry has such a matrix.

    doubt: one sentence on why there are none, or why they can hardly be the robot's; else empty.
    """

    parameters: tuple[PhysicalParameter, ...]
    doubt: str = ""


def read_matrix(
    robot: Robot,
    matrix: Array,
    covariance: Array | None = None,
    degrees_of_freedom: Array | float = np.inf,
    effects: Sequence[NamedEffect] = (),
    *,
    fitted_mount: bool = False,
    unknown: Array | None = None,
) -> PhysicalReading:
    """The physical parameters of a robot by its matrix (3, M) and its effects, Eq. (2) and (3).

    covariance: of the elements, row by row, and of the effects' parameters, or of the elements alone; intervals are by
    Student's t with these degrees of freedom of the variances, one for all or one for each. fitted_mount: the tracked
    point may stand elsewhere than the robot's file says, and its place is among the parameters. unknown (q, 3M):
    changes of the matrix of which the data say nothing; parameters that depend on them have no interval.
    """
    # By how much each parameter of the effects changes the physical parameters
    every = robot.drive.steered
    changes: dict[tuple[str, str], Mapping[str, float]] = {
        ("wheel_dead_zone", "c"): {"lost_rate": -1.0},  # c is gained
        ("steering_gain", "g"): {f"steering_gain_{name}": 1.0 for name in every},
        ("steering_offset", "c"): {f"steering_zero_{name}": 1.0 for name in every},
        ("lidar_lever_arm", "x"): {"mount_x": 1.0},
        ("lidar_lever_arm", "y"): {"mount_y": 1.0},
        **{("driven_steering_offset", f"c_{name}"): {f"steering_zero_{name}": 1.0} for name in every},
    }
    factors = [changes.get((term.name, name), {}) for term in effects for name in term.parameters]
    model = _class_model(robot, fitted_mount, [name for factor in factors for name in factor])
    geometry, size = model.geometry, matrix.size

    # What the robot's motions show of a matrix, and which changes of z that shows.
    _, _, signals = np.linalg.svd(robot.inverse_kinematic_matrix)
    units = np.repeat(robot.row_scales, len(robot.drive.names))
    seen = np.kron(np.eye(3), signals[: len(robot.motions)]) / units  # (3D, 3M)
    at_design = seen @ geometry.slopes(geometry.design) @ model.spread
    shown, hidden = _split(at_design)

    # The least-squares point, Eq. (2).
    of_elements = np.zeros((size, size)) if covariance is None else covariance[:size, :size]
    tolerance, motions = physical_tolerance(robot), robot.inverse_kinematic_matrix
    slipping = np.array(
        [share * (np.eye(3)[row][:, None] * motions).ravel() for row, share in enumerate(tolerance.rows)]
    )
    scatter = seen @ (of_elements + slipping.T @ slipping) @ seen.T + tolerance.elements**2 * np.eye(len(seen))
    weighted = np.linalg.solve(np.linalg.cholesky(scatter), seen)
    try:
        change, slopes = _least_squares(model, matrix, weighted, shown)
    except DataError as error:
        return PhysicalReading((), f"the matrix has no reading in physical parameters: {error}")

    # What effects add to it.
    by_effects = np.array([[factor.get(name, 0.0) for factor in factors] for name in model.design])
    of_effects = np.array([value for term in effects for value in term.parameters.values()])
    values = np.array(list(model.design.values())) + model.reported @ shown @ change + by_effects @ of_effects

    # The intervals, Eq. (3); none of what the covariance says nothing of, or of what depends on unknown changes.
    reach = np.full(len(values), np.nan)
    if covariance is not None:
        by_elements = model.reported @ shown @ np.linalg.pinv(slopes) @ weighted
        known = len(covariance)  # elements, perhaps with effects
        scattering = EstimatedCovariance(covariance, degrees_of_freedom)
        scattering = scattering.of(np.hstack([by_elements, by_effects])[:, :known])
        untold = scattering.standard_deviations <= _NO_VARIANCE * model.deviations(np.eye(len(model.spread.T)))
        untold |= by_effects.any(axis=1) & (known == size)
        if unknown is not None and len(unknown):
            sizes = np.linalg.norm(unknown / units, axis=1)
            lost, strengths, _ = np.linalg.svd(seen @ unknown.T / np.where(sizes > 0, sizes, 1.0), full_matrices=False)
            lost = lost[:, strengths > _SHOWN]
            _, unseen = _split(at_design - lost @ lost.T @ at_design)
            more = model.deviations(unseen) ** 2 - model.deviations(hidden) ** 2
            untold |= more > _UNSEEN * model.deviations(np.eye(len(model.spread.T))) ** 2
        by_tolerance = EstimatedCovariance(np.diag(model.deviations(hidden) ** 2))
        reach = np.where(untold, np.nan, np.hypot(scattering.reach, by_tolerance.reach))
    parameters = []
    for (name, design), value, half in zip(model.design.items(), values.tolist(), reach.tolist(), strict=True):
        low, high = (None, None) if math.isnan(half) else (value - half, value + half)
        parameters.append(
            PhysicalParameter(name=name, design=design, value=value, unit=unit_of(name), low=low, high=high)
        )
    return PhysicalReading(tuple(parameters), _doubt(robot, parameters, fitted_mount))


def directions_of(robot: Robot) -> Mapping[str, tuple[float, Array]]:
    """Design value and derivatives (3M,) of the matrix elements, row by row, of each physical parameter by its name."""
    model = _class_model(robot, fitted_mount=False, of_effects=())
    slopes = model.geometry.slopes(model.geometry.design) @ model.spread
    found = {}
    for (name, design), reported in zip(model.design.items(), model.reported, strict=True):
        if reported.any():
            found[name] = design, slopes @ np.linalg.pinv(reported[None])[:, 0]
    return found


def _split(slopes: Array) -> tuple[Array, Array]:
    """Orthonormal changes (k, r) and (k, k - r) that slopes (q, k) show and do not show."""
    _, strengths, directions = np.linalg.svd(slopes)
    rank = int((strengths > _RANK * strengths[0]).sum())
    return directions[:rank].T, directions[rank:].T


def _least_squares(model: _ClassModel, matrix: Array, weighted: Array, shown: Array) -> tuple[Array, Array]:
    """Eq. (2): the changes y (r,), and the weighted slopes (3D, r) there.

    weighted (3D, 3M): what is seen of a matrix, weighted. DataError says why no geometry has such a matrix.
    """
    geometry = model.geometry
    change, step = np.zeros(shown.shape[1]), np.inf
    with np.errstate(all="ignore"):
        for _ in range(_MOST_STEPS):
            numbers = geometry.design + model.spread @ shown @ change
            try:
                misfit = weighted @ (matrix - geometry.matrices(numbers[None])[0]).ravel()
                slopes = weighted @ geometry.slopes(numbers) @ model.spread @ shown
                moved = np.linalg.lstsq(slopes, misfit)[0]
            except np.linalg.LinAlgError:
                break
            if step < _RESTING:
                break
            change, step = change + moved, float(np.abs(moved).max())
            if not np.abs(change).max() < _FARTHEST:
                break
    if not step < _RESTING:
        raise DataError("no wheels near the design have it")
    values = np.array(list(model.design.values())) + model.reported @ shown @ change
    for (name, design), value in zip(model.design.items(), values.tolist(), strict=True):
        if name.startswith(_LENGTHS) and value < _LEAST * design:
            raise DataError(f"{name} would be {value:.4g} m")
    freedom = len(weighted) - shown.shape[1]
    if freedom and float(misfit @ misfit) > chdtri(freedom, _MISFIT):
        raise DataError("what it does differs from what wheels can do by more than its uncertainty")
    return change, slopes


def _doubt(robot: Robot, parameters: Sequence[PhysicalParameter], fitted_mount: bool) -> str:
    """A sentence on lengths that are farther off their design than wheels are; empty if none is."""
    doubted = []
    for each in parameters:
        ends = (each.low, each.high) if each.low is not None and each.high is not None else (each.value, each.value)
        nearest = min(max(each.design, ends[0]), ends[1])
        effective = each.name == "track" and robot.skid  # of wheels that slide
        is_length = each.name.startswith(_LENGTHS) and each.design and not effective
        if is_length and abs(nearest / each.design - 1) > _IMPLAUSIBLE:
            doubted.append(f"{each.name} {each.deviation_percent:+.1f} %")
    if not doubted:
        return ""
    point = ", or the tracked point stands off the centre (mount: fit)" if robot.slides and not fitted_mount else ""
    return (
        f"{', '.join(doubted)}: wheels are seldom off by more than {_IMPLAUSIBLE:.0%} (Palacin et al. 2023, section "
        f"4.2); measure them: if they are as designed, the matrix has no physical reading and makes up for something "
        f"else, such as slip{point}"
    )


_LENGTHS = ("radius", "track", "wheelbase", "distance")


@dataclass(frozen=True, eq=False)
class _ClassModel:
    """Eq. (1): B (n, k), R (p, k), and the design values of the p parameters that are reported."""

    geometry: Geometry
    spread: Array
    design: Mapping[str, float]
    reported: Array

    def deviations(self, changes: Array) -> Array:
        """Standard deviations (p,) of the parameters by orthonormal changes (k, q) of z."""
        return np.asarray(np.linalg.norm(self.reported @ changes, axis=1))


def _class_model(robot: Robot, fitted_mount: bool, of_effects: Collection[str]) -> _ClassModel:
    """How robots of a class lie about their design. of_effects: parameters that effects change."""
    geometry, tolerance = Geometry(robot), physical_tolerance(robot)
    at_design: dict[str, float] = dict(zip(geometry.names, geometry.design.tolist(), strict=True))
    car = isinstance(robot.drive, CarDrive)
    steered = [wheel for wheel in robot.measured if wheel.has_steering]
    design: dict[str, float] = {}
    columns: list[tuple[Mapping[str, float], Mapping[str, float]]] = []  # of B and of R

    def vary(
        deviation: float, changes: Mapping[str, float], name: str = "", value: float = 0.0, unit: float = 1.0
    ) -> None:
        """A deviation times these changes of the geometry, and times the unit of the parameter that is reported."""
        reported = {name: deviation * unit} if name else {}
        columns.append(({number: deviation * change for number, change in changes.items()}, reported))
        design.update(dict.fromkeys(reported, value))

    # Radii. The matrix of a car has the mean of its rear wheels'.
    for wheel in robot.measured:
        name = f"radius_{wheel.name}"
        changes: Mapping[str, float] = {"radius": 1 / len(robot.measured)} if car else {name: 1.0}
        vary(tolerance.radius * wheel.radius, changes, name, wheel.radius)

    # Track and wheelbase: changes of numbers where wheels stand farther from the middle between them, or from the axle.
    stretched: list[tuple[str, Mapping[str, float], float]] = []
    fixed = [wheel for wheel in robot.measured if wheel.kind == "fixed" and not car]
    if fixed:
        sides = [math.copysign(1.0, math.cos(wheel.rolling - fixed[0].rolling)) for wheel in fixed]
        middle, length = _middle([side * wheel.lever for side, wheel in zip(sides, fixed, strict=True)])
        changes = {
            f"distance_{wheel.name}": side * (side * wheel.lever - middle)
            for wheel, side in zip(fixed, sides, strict=True)
        }
        stretched.append(("track", changes, length))
    if car:
        stretched.append(("wheelbase", {"wheelbase": at_design["wheelbase"]}, abs(at_design["wheelbase"])))
    elif steered and not robot.slides:
        _, turning = robot.motions
        axle = -float(turning[1] / turning[2])
        ahead = {f"x_{wheel.name}": wheel.position[0] - axle for wheel in steered}
        stretched.append(("wheelbase", ahead, float(np.mean(np.abs(list(ahead.values()))))))
    elif steered:
        for name, axis in (("track", 1), ("wheelbase", 0)):
            middle, length = _middle([wheel.position[axis] for wheel in steered])
            ways = {f"{'xy'[axis]}_{wheel.name}": wheel.position[axis] - middle for wheel in steered}
            if name == "wheelbase" or not fixed:
                stretched.append((name, ways, length))
            for number in ways:
                vary(tolerance.elements * robot.reach, {number: 1.0})
    share = tolerance.rows[2]  # as turning is off
    for name, changes, length in stretched:
        if length > _NO_LENGTH:
            vary(share, changes, name, length, length)

    # Distances and angles of wheels on rollers.
    on_rollers = [wheel for wheel in robot.measured if wheel.kind in ("omni", "mecanum")]
    for wheel in on_rollers:
        name, length = f"distance_{wheel.name}", abs(wheel.lever)
        vary(tolerance.radius * (length or robot.reach), {name: math.copysign(1.0, wheel.lever)}, name, length)
    for wheel in on_rollers:
        name = f"angle_{wheel.name}"
        vary(tolerance.elements, {name: 1.0}, name, wheel.axle)

    # Zeros of steering angles: the matrix of a car has their mean.
    for owner in robot.drive.steered:
        changes = {"offset": 1 / len(robot.drive.steered)} if car else {f"offset_{owner}": 1.0}
        vary(STEERING_ZERO, changes, f"steering_zero_{owner}")

    # The tracked point. Where all wheels slide it could be anywhere, by other distances, and its yaw is the angles':
    # there it stands where the file says, unless it is fitted.
    mount = {"mount_x": TRACKED_POINT, "mount_y": TRACKED_POINT, "mount_yaw": TRACKED_YAW}
    if robot.slides and not robot.skid:
        mount = {name: TRACKED_POINT for name in ("mount_x", "mount_y") if fitted_mount}
    for name, deviation in mount.items():
        vary(deviation, {name: 1.0}, name if fitted_mount else "", at_design[name])

    for name in of_effects:
        design.setdefault(name, 1.0 if name.startswith("steering_gain") else at_design.get(name, 0.0))

    spread = np.array([[changes.get(name, 0.0) for changes, _ in columns] for name in at_design])
    reported = np.array([[shown.get(name, 0.0) for _, shown in columns] for name in design])
    return _ClassModel(geometry, spread, design, reported)


def _middle(places: Sequence[float]) -> tuple[float, float]:
    """The middle between the least and the largest place, and the distance between them."""
    return (min(places) + max(places)) / 2, max(places) - min(places)
