"""Simulated robots of seven classes, whose truth shares no code with what fits them, and the fit of the truth's form.

A robot's geometry is drawn about its design. Its wheels turn as a controller commands that believes the design, for
paths of several kinds (straight, circle, square, eight; sideways and turned circles where the robot can), and the
robot then moves by the contacts of its true wheels, one of seven effects, and slip:

    twist = (I + s_command N_command + s_run N_run + D_session) f(M P b).                                      (1)

b: speeds of the wheels' contacts, r omega, of a steered wheel r omega (cos phi, sin phi), after an effect on the wheel.
P: least-squares solution of the contacts' equations, which stand in ``Geometry.rows``. M: losses of rollers, and the
mount of the tracked point. f: an effect on the body. N (3, 3): normal numbers times SLIP_SHAPE; s_command and s_run are
log-normal of median 1 % by robot. D_session: 0 with one session. Everything is integrated at 100 Hz; wheels are
recorded at 20 Hz, poses at 5 Hz with noise, errors of the start heading and of the clock.

Tolerances, one standard deviation, with their sources:

- radius 1 % a wheel, for tyres and treads under load; places of wheels 1.5 % of their distance, since the contact of a
  tyre wanders by some mm over its width (both after Borenstein and Feng, IEEE T-RA 12:869, 1996, section 2).
- direction of an omni wheel's axle 0.5 degrees, zero of a steering angle 1 degree (one that is set with a jig or by
  eye; a car's, which is aligned by driving straight, 0.3 degrees). The gain of a steering encoder is exact, a gear's.
- rollers: forward and turning 2 %, half-normal, sideways 2 % (omni) and 5 % (mecanum), which strafes at 0.9 or so of
  its command.
- skid: track times U(1.2, 2), and a centre of turning that is off by 2 cm in x and 1 cm in y (Mandow et al., IROS 2007:
  turning by 0.5 to 0.8; Martinez et al., IJRR 24:867, 2005).
- tracked point of tricycles and cars 2 cm and 1 degree off; of the others where the robot's file says.

Sizes of effects are U(1, 3) times the size at which the effect is as strong as slip of 1 %: it changes the final poses
of a fixed set of commands, or their velocities (turning as the speed of the wheels), as much in the mean of squares,
whichever comes first. By velocities alone turns on the spot would slip by 20 %, by final poses alone a robot in a turn
would drift outward at half of its speed.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import least_squares

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.robot.kinematics import Robot, Wheel

Array = NDArray[np.float64]

CLASSES = ("differential", "skid", "tricycle", "car", "swerve", "omni", "mecanum")
EFFECTS = ("none", "lost_rate", "turn_slip", "creep", "coupling", "floor_drift", "centripetal")
FINE, SAMPLE, POSE = 0.01, 0.05, 0.2  # s: steps of the simulation, wheel samples, reference poses
RAMP, REST = 0.4, 0.4  # s: of a change of speed, and between two legs
SLIP = 0.01  # median over robots
SLIP_SPREAD = 0.5  # of its logarithm
# Slip of 1 changes (vx, vy, w) by this times normal numbers: m/m, m/rad, rad/m, rad/rad (chosen).
SLIP_SHAPE = np.array([[1.0, 0.3, 0.1], [0.3, 1.0, 0.1], [0.5, 0.5, 1.0]])
NOISE = np.array([0.002, 0.002, 0.002])  # m, m, rad, of every reference pose (motion capture)
START_HEADING, CLOCK = 0.005, 0.02  # rad, s: errors of a run
SESSION = np.array([0.01, 0.01, 0.01])  # shares by which a session's forward, sideways and turning motions differ
SMOOTH = 0.1  # rad/s: slower wheels lose less

# What is trained on; the other kinds are judged. Straight lines alone say nothing of turning.
TURNING = (("circle",), ("square",), ("straight", "circle"), ("straight", "square"), ("eight",), ("circle", "square"))
SLIDING = (("circle",), ("square",), ("sideways", "circle"), ("straight", "square"), ("straight", "circle"))
KINDS = ("circle", "square", "straight", "eight")
OF_SLIDING = (*KINDS, "sideways")


@dataclass(frozen=True, eq=False)
class Geometry:
    """Numbers of a robot, or their standard deviations. Arrays by wheel, in the order of the robot's file."""

    radii: Array  # (N,) m, of the wheels whose rates are measured
    places: Array  # (W, 2) m: contact points of all wheels that count
    rolling: Array  # (N,) rad
    zeros: Array  # (S,) rad: what is added to a measured steering angle
    losses: Array  # (3,) share of vx, vy, w that rollers lose
    skid: Array  # (3,) factor of the track, and centre of turning x, y (m)
    mount: Array  # (3,) x, y (m), yaw (rad) of the tracked point

    @property
    def vector(self) -> Array:
        """All numbers in one vector."""
        return np.concatenate([getattr(self, field.name).ravel() for field in fields(self)])

    def with_vector(self, vector: Array) -> Geometry:
        """The geometry of such a vector."""
        made, first = {}, 0
        for field in fields(self):
            old = getattr(self, field.name)
            made[field.name] = vector[first : first + old.size].reshape(old.shape)
            first += old.size
        return Geometry(**made)


@dataclass(frozen=True, eq=False)
class Base:
    """A class of robots. size: length of its paths, m; fastest: m/s; tightest: least radius of a turn, m."""

    name: str
    robot: Robot
    design: Geometry
    widths: Geometry
    rollers: Array  # (N,) rad: angle of the rollers' axes to the rolling direction; 0: across it
    size: float
    fastest: float
    tightest: float

    @property
    def slides(self) -> bool:
        """True if it can drive sideways."""
        return self.name in ("swerve", "omni", "mecanum")

    @property
    def steers(self) -> bool:
        """True if it has steered wheels."""
        return self.name in ("tricycle", "car", "swerve")

    @property
    def reach(self) -> float:
        """Mean distance of the wheels from the centre, m."""
        return float(np.linalg.norm(self.design.places, axis=1).mean())

    @property
    def free(self) -> NDArray[np.intp]:
        """Indices of the geometry's numbers that differ from robot to robot."""
        return np.flatnonzero(self.widths.vector > 0)

    def rows(self, geometry: Geometry) -> Array:
        """Equations (B, 3) of the contacts: rows by the centre's twist (vx, vy, w), equal to the speeds b of Eq. (1).

        The velocity of the contact at (x, y) is (vx - y w, vy + x w).
        """
        x, y = geometry.places.T
        one, nothing = np.ones(len(x)), np.zeros(len(x))
        along_x, along_y = np.column_stack([one, nothing, -y]), np.column_stack([nothing, one, x])
        if self.name == "swerve":
            return np.stack([along_x, along_y], axis=1).reshape(-1, 3)
        if self.name == "tricycle":  # the rear axle does not slide
            return np.array([along_x[0], along_y[0], [0.0, 1.0, 0.0]])
        if self.name in ("omni", "mecanum"):  # held along the roller's axis, free across it
            held = geometry.rolling - self.rollers
            equations = np.cos(held)[:, None] * along_x + np.sin(held)[:, None] * along_y
            return np.asarray(equations / np.cos(self.rollers)[:, None])
        factor, centre_x, centre_y = geometry.skid
        wheels = np.column_stack([one, nothing, -factor * y + (factor - 1) * centre_y])
        return np.vstack([wheels, [0.0, 1.0, centre_x]])

    def solution(self, geometry: Geometry) -> Array:
        """M P of Eq. (1): (3, B); of a car M alone (3, 3)."""
        x, y, yaw = geometry.mount
        cosine, sine = math.cos(yaw), math.sin(yaw)
        turned = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        mount = turned @ np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
        whole = mount @ np.diag(1 - geometry.losses)
        return whole if self.name == "car" else whole @ np.linalg.pinv(self.rows(geometry))

    def twists(self, geometry: Geometry, rates: Array, steering: Array) -> Array:
        """Twists (..., 3) of the tracked point by wheel rates (..., N) and measured steering angles (..., S)."""
        speeds, solution = rates * geometry.radii, self.solution(geometry)
        angles = steering + geometry.zeros
        if self.name == "car":
            curvature = car_curvature(geometry.places[2:], angles)
            ahead = speeds.mean(axis=-1) / (1 - curvature * geometry.places[:2, 1].mean())
            centre = np.stack([ahead, np.zeros_like(ahead), curvature * ahead], axis=-1)
            return centre @ solution.T
        if self.steers:
            parts = np.stack([speeds * np.cos(angles), speeds * np.sin(angles)], axis=-1)
            speeds = parts.reshape(*parts.shape[:-2], -1)
        made: Array = speeds @ solution[:, : speeds.shape[-1]].T  # what does not slide has speed 0
        return made

    def matrix(self, geometry: Geometry) -> Array:
        """The matrix (3, M) by the robot's drive signals, as omnibench counts them; of a car the best one.

        A car's curvature is a bent function of its measured angles; the line through it is for tangents up to 0.5.
        """
        solution, radii = self.solution(geometry), geometry.radii
        if self.name == "car":
            (left, right), design = radii, self.design.places[2:]
            tangents = np.linspace(-0.5, 0.5, 21)
            nominal = (tangents / design[:, 0].mean())[:, None]
            angles = np.arctan(design[:, 0] * nominal / (1 - design[:, 1] * nominal))
            turning, straight = np.polyfit(tangents, car_curvature(geometry.places[2:], angles + geometry.zeros), 1)
            mean, skew = (left + right) / 2, (right - left) / 4
            centre = np.array([[mean, 0.0, skew], [0.0] * 3, [mean * straight, mean * turning, 0.0]])
            return np.asarray(solution @ centre)
        if not self.steers:
            return np.asarray(solution[:, : len(radii)] * radii)
        cosines, sines = np.cos(geometry.zeros), np.sin(geometry.zeros)
        columns = []
        for wheel, radius in enumerate(radii):
            by_x, by_y = solution[:, 2 * wheel], solution[:, 2 * wheel + 1]
            columns += [radius * (cosines[wheel] * by_x + sines[wheel] * by_y)]
            columns += [radius * (cosines[wheel] * by_y - sines[wheel] * by_x)]
        return np.column_stack(columns)

    def parameters(self, geometry: Geometry) -> dict[str, float]:
        """Physical parameters by their names in DESIGN.md, as far as motion can tell them.

        They are effective: wheels on rollers are those that would move as these do without loss, the track of a
        skid-steered base is the one by which it turns, and the tracked point takes in where the wheels' middle is.
        """
        names, radii, mount = self.robot.wheel_names, geometry.radii, geometry.mount
        x, y = geometry.places.T
        if self.name in ("omni", "mecanum"):
            slant = np.tan(self.rollers)
            by_x, by_y, by_turn = (self.rows(geometry) / (1 - geometry.losses) / radii[:, None]).T
            radii = np.hypot(1.0, slant) / np.hypot(by_x, by_y)
            made = {f"distance_{n}": float(abs(d)) for n, d in zip(names, by_turn * radii, strict=True)}
            axles = np.arctan2(by_y, by_x) - np.arctan2(1.0, slant)
            made |= {f"angle_{n}": float(a) for n, a in zip(names, axles, strict=True)}
            return made | {f"radius_{n}": float(r) for n, r in zip(names, radii, strict=True)}
        made = {f"radius_{n}": float(r) for n, r in zip(names, radii, strict=True)}
        made |= {f"steering_zero_{n}": float(z) for n, z in zip(self.robot.drive.steered, geometry.zeros, strict=True)}
        if self.name == "car":
            made["wheelbase"] = float(x[2:].mean())
            mount = mount - [0.0, y[:2].mean(), 0.0]
        elif self.name == "tricycle":
            made["wheelbase"] = float(x[0])
            mount = mount - [0.0, y[0], 0.0]
        elif self.name == "swerve":
            made["wheelbase"] = float(x[:2].mean() - x[2:].mean())
            made["track"] = float(y[[0, 2]].mean() - y[[1, 3]].mean())
            return made
        else:
            factor, centre_x, centre_y = geometry.skid
            made["track"] = float(factor * (y[y > 0].mean() - y[y < 0].mean()))
            middle = factor * y.mean() - (factor - 1) * centre_y  # at w = 1 the mean wheel rolls at minus this
            mount = mount - [centre_x, middle, 0.0]
        return made | dict(zip(("mount_x", "mount_y", "mount_yaw"), mount.tolist(), strict=True))

    def drawn(self, rng: np.random.Generator) -> Geometry:
        """A robot of the class."""
        numbers = rng.standard_normal(len(self.design.vector))
        geometry = self.design.with_vector(self.design.vector + numbers * self.widths.vector)
        skid = geometry.skid.copy()
        if self.name == "skid":
            skid[0] = rng.uniform(1.2, 2.0)
        return replace(geometry, losses=np.abs(geometry.losses), skid=skid)


def car_curvature(places: Array, angles: Array) -> Array:
    """Mean curvature (...), 1/m, of front wheels at places (S, 2) that roll without sliding, at angles (..., S)."""
    tangents = np.tan(angles)
    mean: Array = (tangents / (places[:, 0] + places[:, 1] * tangents)).mean(axis=-1)
    return mean


def _wheel(name: str, kind: str, radius: float, x: float, y: float, **more: bool) -> Wheel:
    return Wheel(name=name, type=kind, radius=radius, x=x, y=y, **more)  # type: ignore[arg-type]


@lru_cache
def base_of(name: str) -> Base:
    """The base of a class."""
    size, fastest, tightest = 1.0, 0.4, 0.3
    rolling, rollers, steered, skid, losses = 0.0, np.zeros(4), 0, np.array([1.0, 0.0, 0.0]), np.zeros(3)
    zero, mount, angle, of_skid = math.radians(1.0), np.zeros(3), 0.0, np.zeros(3)
    if name == "differential":
        radius, places = 0.05, np.array([[0.0, 0.15], [0.0, -0.15]])
        wheels = [_wheel(n, "fixed", radius, *p) for n, p in zip(("left", "right"), places, strict=True)]
    elif name == "skid":
        radius, places = 0.08, np.array([[0.15, 0.2], [0.15, -0.2], [-0.15, 0.2], [-0.15, -0.2]])
        wheels = [_wheel(n, "fixed", radius, *p) for n, p in zip(("fl", "fr", "rl", "rr"), places, strict=True)]
        skid, of_skid = np.array([1.6, 0.0, 0.0]), np.array([0.8 / math.sqrt(12), 0.02, 0.01])
    elif name == "tricycle":
        radius, places, steered, tightest = 0.1, np.array([[0.6, 0.0]]), 1, 0.5
        wheels = [_wheel("front", "steered", radius, 0.6, 0.0)]
        wheels += [_wheel(n, "fixed", radius, 0.0, y, measured=False) for n, y in (("left", 0.25), ("right", -0.25))]
        mount = np.array([0.02, 0.02, math.radians(1.0)])
    elif name == "car":
        radius, places = 0.1, np.array([[0.0, 0.2], [0.0, -0.2], [0.6, 0.2], [0.6, -0.2]])
        names, size, fastest, tightest = ("rl", "rr", "fl", "fr"), 1.5, 0.7, 1.2
        wheels = [_wheel(n, "fixed", radius, *p) for n, p in zip(names[:2], places[:2], strict=True)]
        wheels += [_wheel(n, "steered", radius, *p, driven=False) for n, p in zip(names[2:], places[2:], strict=True)]
        steered, zero, mount = 2, math.radians(0.3), np.array([0.02, 0.02, math.radians(1.0)])
    elif name == "swerve":
        radius, places, steered = 0.05, np.array([[0.2, 0.2], [0.2, -0.2], [-0.2, 0.2], [-0.2, -0.2]]), 4
        wheels = [_wheel(n, "steered", radius, *p) for n, p in zip(("fl", "fr", "rl", "rr"), places, strict=True)]
    elif name == "omni":
        radius, directions = 0.05, np.radians([60.0, 180.0, 300.0])
        places = 0.2 * np.column_stack([np.cos(directions), np.sin(directions)])
        wheels = [
            Wheel(name=n, type="omni", radius=radius, distance=0.2, angle=float(a))
            for n, a in zip("abc", directions, strict=True)
        ]
        rolling, losses, angle = directions + math.pi / 2, np.array([0.02, 0.02, 0.02]), math.radians(0.5)
    else:
        radius, places = 0.05, np.array([[0.2, 0.15], [0.2, -0.15], [-0.2, 0.15], [-0.2, -0.15]])
        wheels = [_wheel(n, "mecanum", radius, *p) for n, p in zip(("fl", "fr", "rl", "rr"), places, strict=True)]
        rollers, losses = np.copysign(math.pi / 4, places[:, 0] * places[:, 1]), np.array([0.02, 0.05, 0.02])
        angle = math.radians(0.5)
    robot = Robot(name=name, wheels=tuple(wheels), skid=name == "skid")
    count = len(robot.wheel_names)
    design = Geometry(
        np.full(count, radius), places, np.zeros(count) + rolling, np.zeros(steered), np.zeros(3), skid, np.zeros(3)
    )
    distance = np.linalg.norm(places, axis=1)
    if name == "car":
        distance[2:] = 0.6
    of_places = 0.015 * distance[:, None] * np.ones(2)
    if name in ("differential", "skid"):  # x of a wheel that rolls along x does not matter
        of_places[:, 0] = 0.0
    widths = Geometry(
        np.full(count, 0.01 * radius), of_places, np.full(count, angle), np.full(steered, zero), losses, of_skid, mount
    )
    return Base(name, robot, design, widths, rollers[:count], size, fastest, tightest)


@dataclass(frozen=True)
class Effect:
    """One of EFFECTS with its size; of the floor's drift the two components of it."""

    name: str
    size: tuple[float, float] = (0.0, 0.0)

    @property
    def numbers(self) -> int:
        """How many numbers are its size."""
        return {"none": 0, "floor_drift": 2}.get(self.name, 1)

    def of_wheels(self, base: Base, rates: Array, steering: Array) -> Array:
        """Rates (..., N) at which the wheels drive the robot, by those that encoders tell."""
        size, turning = self.size[0], np.tanh(rates / SMOOTH)
        if self.name == "lost_rate":
            return np.asarray(rates - size * turning)
        if self.name == "creep":  # in one direction alone
            return np.asarray(rates + size * np.maximum(rates, 0.0))
        if self.name == "coupling":  # by what the other wheels turn; of a tricycle its rear wheels
            if base.name == "tricycle":
                across = np.sin(steering) * 0.25 / 0.6
                others = np.abs(rates) * (np.abs(np.cos(steering) - across) + np.abs(np.cos(steering) + across)) / 2
            else:
                speeds = np.abs(rates)
                others = (speeds.sum(axis=-1, keepdims=True) - speeds) / (rates.shape[-1] - 1)
            return np.asarray(rates - size * turning * others)
        return rates

    def of_body(self, base: Base, twists: Array) -> Array:
        """Twists (..., 3) with slip of turns or with centripetal slip."""
        x, y, turn = twists[..., 0], twists[..., 1], twists[..., 2]
        if self.name == "turn_slip":  # none on straight lines, all of it on the spot
            rim = np.abs(turn) * base.reach
            share = rim / np.maximum(np.hypot(x, y) + rim, 1e-9)
            return np.stack([x, y, turn * (1 - self.size[0] * share)], axis=-1)
        if self.name == "centripetal":
            return np.stack([x - self.size[0] * turn * y, y + self.size[0] * turn * x, turn], axis=-1)
        return twists

    def measured(self, base: Base, rates: Array, steering: Array) -> Array:
        """Rates (..., N) that encoders tell, by those at which the wheels drive the robot."""
        told = rates
        for _ in range(6):
            told = told + rates - self.of_wheels(base, told, steering)
        return told


def driven(
    base: Base,
    geometry: Geometry,
    effect: Effect,
    rates: Array,
    steering: Array,
    step: float,
    start: Array,
    slip: Array | None = None,
) -> Array:
    """Poses (R, F + 1, 3) of runs from start poses (R, 3), by Eq. (1); steering: in the middles of steps of step s.

    slip: (R, 3, 3), what is added to I.
    """
    twists = effect.of_body(base, base.twists(geometry, effect.of_wheels(base, rates, steering), steering))
    if slip is not None:
        twists = twists + np.einsum("rij,rfj->rfi", slip, twists)
    turned = twists[..., 2] * step
    headings = start[:, 2:] + np.cumsum(np.concatenate([np.zeros((len(start), 1)), turned], axis=1), axis=1)
    middle, chord = headings[:, :-1] + turned / 2, step * np.sinc(turned / 2 / np.pi)
    cosine, sine = np.cos(middle), np.sin(middle)
    x = chord * (twists[..., 0] * cosine - twists[..., 1] * sine)
    y = chord * (twists[..., 0] * sine + twists[..., 1] * cosine)
    if effect.name == "floor_drift":
        way = step * np.hypot(twists[..., 0], twists[..., 1])
        x, y = x + effect.size[0] * way, y + effect.size[1] * way
    places = [np.cumsum(np.concatenate([start[:, [i]], part], axis=1), axis=1) for i, part in enumerate((x, y))]
    return np.stack([*places, headings], axis=-1)


@dataclass(frozen=True)
class Command:
    """A path: its kind, and legs (vx, vy in m/s, w in rad/s, s), each from rest to rest."""

    kind: str
    legs: tuple[tuple[float, float, float, float], ...]


def command_of(base: Base, kind: str, number: int, rng: np.random.Generator) -> Command:
    """The command of that number of a kind: directions alternate by its number, sizes and speeds are random."""
    speed = base.fastest * rng.uniform(0.5, 1.0)
    way, sign = base.size * rng.uniform(0.8, 1.4), 1.0 if number % 2 == 0 else -1.0
    backward = -1.0 if number % 4 >= 2 and rng.random() < 0.5 else 1.0

    def line(x: float, y: float, length: float) -> tuple[float, float, float, float]:
        return speed * x, speed * y, 0.0, length / speed

    def arc(radius: float, angle: float, toward: float = 0.0) -> tuple[float, float, float, float]:
        seconds = radius * abs(angle) / speed
        return speed * math.cos(toward), speed * math.sin(toward), angle / seconds, seconds

    if kind == "straight":
        back = -1.0 if number % 2 else 1.0
        return Command(kind, (line(back, 0.0, 2 * way),))
    if kind == "sideways":  # a square without turns
        legs = [(0.0, sign), (backward, 0.0), (0.0, -sign), (-backward, 0.0)][: 4 if number % 3 else 1]
        return Command(kind, tuple(line(x, y, way) for x, y in legs))
    if kind in ("circle", "eight"):
        radius = base.tightest * math.exp(rng.uniform(0.0, math.log(2.5)))
        toward = rng.integers(4) * math.pi / 2 if base.slides else 0.0 if backward > 0 else math.pi
        whole = sign * 2 * math.pi
        if kind == "circle":
            return Command(kind, (arc(radius, 1.25 * whole, toward),))
        return Command(kind, (arc(radius, whole, toward), arc(radius, -whole, toward)))
    corner = sign * math.pi / 2
    if base.name in ("tricycle", "car"):  # which cannot turn on the spot
        return Command(
            kind, (line(backward, 0.0, way), arc(base.tightest, corner, 0.0 if backward > 0 else math.pi)) * 4
        )
    return Command(kind, (line(backward, 0.0, way), (0.0, 0.0, math.copysign(0.8, corner), abs(corner) / 0.8)) * 4)


def profile(command: Command) -> tuple[Array, Array]:
    """Full twists (F, 3) of the legs and shares (F,) of them, at steps of FINE; a rest belongs to the next leg."""
    ramp, rest = round(RAMP / FINE), round(REST / FINE)
    rise = (np.arange(ramp) + 0.5) / ramp
    twists, shares = [], []
    for x, y, turn, seconds in command.legs:
        held = max(round(seconds / FINE) - ramp, 0)
        share = np.concatenate([np.zeros(rest), rise, np.ones(held), rise[::-1]])
        twists.append(np.tile([x, y, turn], (len(share), 1)))
        shares.append(share)
    each = round(POSE / FINE)
    length = sum(map(len, shares))
    last = rest + (-(length + rest)) % each
    return np.vstack([*twists, np.tile(twists[-1][-1], (last, 1))]), np.concatenate([*shares, np.zeros(last)])


def wheels_of(base: Base, geometry: Geometry, effect: Effect, command: Command) -> tuple[Array, Array]:
    """Measured rates (F, N) and steering angles (F, S) of a command by a controller that believes the design.

    A car's rear wheels roll as its true front wheels make them; all others turn as they are told.
    """
    twists, shares = profile(command)
    design = base.design
    if base.name == "car":
        curvature = (twists[:, 2] / twists[:, 0])[:, None]
        steering = np.arctan(design.places[2:, 0] * curvature / (1 - design.places[2:, 1] * curvature))
        true = car_curvature(geometry.places[2:], steering + geometry.zeros)[:, None]
        by_ahead = (1 - true * geometry.places[:2, 1]) / geometry.radii  # rates at 1 m/s of the rear axle's middle
        mean = twists[:, :1] * shares[:, None] / design.radii.mean()
        rates = mean * by_ahead / by_ahead.mean(axis=1, keepdims=True)
        return effect.measured(base, rates, steering), steering
    speeds, count = twists @ base.rows(design).T, len(design.radii)
    if not base.steers:
        return speeds[:, :count] / design.radii * shares[:, None], np.zeros((len(shares), 0))
    parts = speeds[:, : 2 * count].reshape(-1, count, 2)
    turned = parts[..., 0] < -1e-9  # a wheel that would have to steer by more than 90 degrees drives backward
    ways = np.where(turned, -1.0, 1.0)
    steering = np.arctan2(ways * parts[..., 1], ways * parts[..., 0])
    return ways * np.linalg.norm(parts, axis=-1) / design.radii * shares[:, None], steering


@dataclass(frozen=True, eq=False)
class Drives:
    """Runs of a robot side by side (R, F, ...), those that end sooner padded by rest, and their lengths in steps."""

    rates: Array
    steering: Array
    lengths: NDArray[np.intp]

    @classmethod
    def of(cls, runs: Sequence[tuple[Array, Array]]) -> Drives:
        """The runs with these rates (F, N) and steering angles (F, S)."""
        lengths = np.array([len(rates) for rates, _ in runs])
        longest = int(lengths.max())

        def padded(part: Array, mode: str) -> Array:
            return np.pad(part, ((0, longest - len(part)), (0, 0)), mode=mode)  # type: ignore[call-overload, no-any-return]

        return cls(
            np.array([padded(rates, "constant") for rates, _ in runs]),
            np.array([padded(steering, "edge") for _, steering in runs]),
            lengths,
        )

    @cached_property
    def middles(self) -> Array:
        """Steering angles (R, F, S) in the middles of the steps, from those at their ends."""
        before = np.concatenate([self.steering[:, :1], self.steering[:, :-1]], axis=1)
        return np.asarray((before + self.steering) / 2)


@dataclass(frozen=True, eq=False)
class Case:
    """A simulated robot: training runs, judged paths, and its truth.

    judged: runs whose last pose is exact, as the robot drives without slip. with_slip: their final poses (J, 3) with
    the slip of their commands, but not of their runs. slip: scales of that of commands and of that of runs.
    matrix (3, M), parameters: the truth.
    """

    base: Base
    seed: int
    geometry: Geometry
    effect: Effect
    trained: tuple[str, ...]
    dataset: Dataset
    judged: tuple[Trajectory, ...]
    with_slip: Array
    slip: tuple[float, float]

    @property
    def final_poses(self) -> Array:
        """The judged paths' true final poses (J, 3)."""
        return np.array([run.final_pose for run in self.judged])

    @property
    def matrix(self) -> Array:
        """The true matrix."""
        return self.base.matrix(self.geometry)

    @property
    def parameters(self) -> dict[str, float]:
        """The true physical parameters, and the lost rate where that is defined."""
        lost = {"lost_rate": self.effect.size[0]} if self.effect.name in ("none", "lost_rate") else {}
        return self.base.parameters(self.geometry) | lost

    def errors(self, final_poses: Array, with_slip: bool = False) -> Array:
        """Norms (J,) of the errors of final poses (J, 3) of the judged paths, m and rad: Eq. (6) is their mean."""
        truth = self.with_slip if with_slip else self.final_poses
        norms: Array = np.linalg.norm(final_poses - truth, axis=1)
        return norms

    @cached_property
    def form(self) -> Form:
        """The fit of the truth's form to the training runs."""
        return Form(self.base, self.effect.name, self.dataset.trajectories)

    @cached_property
    def truth_fit(self) -> tuple[Geometry, Effect]:
        """Its answer by the errors along the path, Eq. (2)."""
        return self.form.model(self.form.by_path())

    @cached_property
    def likelihood_fit(self) -> tuple[Geometry, Effect]:
        """Its answer by the true likelihood, Eq. (3): hardly any fit can be better in the mean."""
        return self.form.model(self.form.by_likelihood(self.slip))

    def ends(self, geometry: Geometry, effect: Effect) -> Array:
        """The judged paths' final poses (J, 3) by a model."""
        return np.array([path[-1] for path in model_poses(self.base, geometry, effect, self.judged)])

    @property
    def truth_error(self) -> float:
        """Eq. (6) of the fit of the truth's form on the judged paths."""
        return float(self.errors(self.ends(*self.truth_fit)).mean())


def model_poses(base: Base, geometry: Geometry, effect: Effect, runs: Sequence[Trajectory]) -> list[Array]:
    """Poses of recorded runs at their pose stamps, by Eq. (1) without slip."""
    drives = Drives.of([_recorded(run) for run in runs])
    return _at_stamps(base, geometry, effect, drives, runs)


def _recorded(run: Trajectory) -> tuple[Array, Array]:
    return run.rates, run.steering if run.steering is not None else np.zeros((len(run.rates), 0))


def _at_stamps(
    base: Base, geometry: Geometry, effect: Effect, drives: Drives, runs: Sequence[Trajectory]
) -> list[Array]:
    starts = np.array([run.start for run in runs])
    paths = driven(base, geometry, effect, drives.rates, drives.middles, SAMPLE, starts)
    return [
        path[np.minimum(np.round(run.pose_times / SAMPLE).astype(int), length)]
        for path, run, length in zip(paths, runs, drives.lengths, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class Form:
    """A fit to runs by the truth's form: unknowns z (n,) are geometry and sizes of an effect, in standard deviations.

    chosen: the poses of each run that are looked at, spread along it, with its end.
    """

    base: Base
    effect: str
    runs: tuple[Trajectory, ...]
    poses_each: int = 9

    @cached_property
    def drives(self) -> Drives:
        """The recorded wheels."""
        return Drives.of([_recorded(run) for run in self.runs])

    @cached_property
    def chosen(self) -> list[NDArray[np.intp]]:
        """Indices of poses by run."""
        counts = [len(run.pose_times) - 1 for run in self.runs]
        return [np.unique(np.round(np.linspace(1, count, self.poses_each)).astype(np.intp)) for count in counts]

    @cached_property
    def references(self) -> Array:
        """The chosen reference poses (S, 3)."""
        return np.concatenate([run.poses[which] for run, which in zip(self.runs, self.chosen, strict=True)])

    @property
    def unknowns(self) -> int:
        """Their number."""
        return len(self.base.free) + Effect(self.effect).numbers

    def model(self, unknowns: Array) -> tuple[Geometry, Effect]:
        """The geometry and the effect of unknowns."""
        free, vector = self.base.free, self.base.design.vector
        vector[free] += self.base.widths.vector[free] * unknowns[: len(free)]
        width = size_unit(self.base.name, self.effect) * math.sqrt(13 / 3) if self.effect != "none" else 0.0  # U(1, 3)
        sizes = np.append(width * unknowns[len(free) :], [0.0, 0.0])[:2]
        return self.base.design.with_vector(vector), Effect(self.effect, (float(sizes[0]), float(sizes[1])))

    def errors(self, unknowns: Array, of_runs: Array | None = None) -> Array:
        """Errors (S, 3) of the chosen poses. of_runs (R, 13): slip (9, in units of SLIP_SHAPE), start, clock (s)."""
        starts, slips, clocks = np.array([run.start for run in self.runs]), None, np.zeros(len(self.runs))
        if of_runs is not None:
            slips, clocks = of_runs[:, :9].reshape(-1, 3, 3) * SLIP_SHAPE, of_runs[:, 12]
            starts = starts + of_runs[:, 9:12]
        drives = self.drives
        paths = driven(self.base, *self.model(unknowns), drives.rates, drives.middles, SAMPLE, starts, slips)
        grid = SAMPLE * np.arange(paths.shape[1])
        made = [
            np.column_stack([np.interp(run.pose_times[which] + clock, grid, part) for part in path.T])
            for run, which, path, clock in zip(self.runs, self.chosen, paths, clocks, strict=True)
        ]
        return np.asarray(np.concatenate(made) - self.references)

    def by_path(self, rounds: int = 4) -> Array:
        """The unknowns that minimise

            sum_runs 1/T sum_poses ((e_x^2 + e_y^2) / p^2 + e_h^2 / q^2) + |z|^2                       (2)

        with the deviations p and q of the errors, taken anew in every round: posterior's form, without its loss.
        """
        shares = np.concatenate([np.full(len(which), 1 / len(which)) for which in self.chosen])
        unknowns, deviations = np.zeros(self.unknowns), np.full(3, 0.01)
        for _ in range(rounds):
            scales = np.sqrt(shares)[:, None] / deviations

            def residuals(numbers: Array, scales: Array = scales) -> Array:
                return np.concatenate([(self.errors(numbers) * scales).ravel(), numbers])

            unknowns = least_squares(residuals, unknowns, xtol=1e-5, ftol=1e-7).x
            squares = shares @ self.errors(unknowns) ** 2 / max(len(self.runs) - 1, 1)
            place = (squares[0] + squares[1]) / 2
            deviations = np.maximum(np.sqrt([place, place, squares[2]]), 0.003)
        return unknowns

    def by_likelihood(self, slip: tuple[float, float], most: int = 10) -> Array:
        """The most probable unknowns z by the true likelihood, slip, starts and clocks n being unknown, too.

        Gauss-Newton steps, halved where they lead up. With errors y + A z + B n, n ~ N(0, P), and noise of covariance
        R, C = B P B' + R,

            z = -(A' C^-1 A + 1)^-1 A' C^-1 y,    n = -P B' C^-1 (y + A z).                            (3)
        """
        unknowns, of_runs, step = self.by_path(2), np.zeros((len(self.runs), 13)), 1e-4
        prior, noise = self._prior_of_runs(slip), np.tile(np.square(NOISE), len(self.references))
        of_prior = cho_factor(prior)
        owner = np.repeat(np.arange(len(self.runs)), [3 * len(which) for which in self.chosen])

        def loss(unknowns: Array, of_runs: Array) -> float:
            errors, flat = self.errors(unknowns, of_runs).ravel(), of_runs.ravel()
            return float((errors**2 / noise).sum() + flat @ cho_solve(of_prior, flat) + unknowns @ unknowns)

        for _ in range(most):
            errors = self.errors(unknowns, of_runs).ravel()
            by_unknowns = np.column_stack(
                [(self.errors(unknowns + step * one, of_runs).ravel() - errors) / step for one in np.eye(len(unknowns))]
            )
            by_runs = np.zeros((len(errors), *of_runs.shape))
            for number, one in enumerate(np.eye(13)):
                slopes = (self.errors(unknowns, of_runs + step * one).ravel() - errors) / step
                by_runs[np.arange(len(errors)), owner, number] = slopes
            by_runs = by_runs.reshape(len(errors), -1)
            offset = errors - by_unknowns @ unknowns - by_runs @ of_runs.ravel()
            factor = cho_factor(by_runs @ prior @ by_runs.T + np.diag(noise))
            solved = cho_solve(factor, np.column_stack([by_unknowns, offset]))
            information = by_unknowns.T @ solved[:, :-1] + np.eye(len(unknowns))
            found = -np.linalg.solve(information, by_unknowns.T @ solved[:, -1])
            found_runs = -(prior @ by_runs.T @ (solved[:, -1] + solved[:, :-1] @ found)).reshape(of_runs.shape)
            before, share = loss(unknowns, of_runs), 1.0
            change, change_of_runs = found - unknowns, found_runs - of_runs
            while share > 1e-3 and not loss(unknowns + share * change, of_runs + share * change_of_runs) < before:
                share /= 2
            unknowns, of_runs = unknowns + share * change, of_runs + share * change_of_runs
            if np.abs(change).max() < 0.01 or share <= 1e-3:
                break
        return unknowns

    def _prior_of_runs(self, slip: tuple[float, float]) -> Array:
        """P of Eq. (3)."""
        own = np.square([*[slip[1]] * 9, *NOISE[:2], np.hypot(START_HEADING, NOISE[2]), CLOCK])
        of_command = np.square([*[slip[0]] * 9, *[0.0] * 4])
        of_session = np.zeros(13)
        of_session[:9:4] = np.square(SESSION / np.diag(SLIP_SHAPE))
        commands, sessions = [run.command for run in self.runs], [run.session for run in self.runs]
        same_command = np.equal.outer(commands, commands).astype(float)
        same_session = np.equal.outer(sessions, sessions).astype(float) * (len(set(sessions)) > 1)
        return np.asarray(
            np.kron(np.eye(len(self.runs)), np.diag(own))
            + np.kron(same_command, np.diag(of_command))
            + np.kron(same_session, np.diag(of_session))
        )


@lru_cache(maxsize=64)
def size_unit(base_name: str, effect: str) -> float:
    """The size of an effect that is as strong as slip of SLIP, see the module's docstring."""
    base, rng = base_of(base_name), np.random.default_rng(0)
    kinds = OF_SLIDING if base.slides else KINDS
    commands = [command_of(base, kind, number, rng) for kind in kinds for number in range(6)]
    none, unit = Effect("none"), Effect(effect, (1e-3, 0.0))
    runs = Drives.of([wheels_of(base, base.design, none, command) for command in commands])
    start = np.zeros((len(commands), 3))

    def paths(of: Effect, slip: Array | None = None) -> Array:
        return driven(base, base.design, of, runs.rates, runs.middles, FINE, start, slip)

    def strengths(moved: Array) -> Array:
        """Root mean squares of the changes of final poses, and of velocities, turning as the wheels' speed."""
        velocities = (np.diff(moved, axis=1) - np.diff(plain, axis=1)) * [1.0, 1.0, base.reach]
        local = velocities - still(np.diff(plain, axis=1), moved[:, :-1, 2] - plain[:, :-1, 2])
        ends = np.square(moved[:, -1] - plain[:, -1]).sum(axis=-1).mean()
        return np.sqrt([ends, np.square(local).sum(axis=-1).mean()])

    def still(steps: Array, turned: Array) -> Array:
        """How steps (R, F, 3) change where the robot is turned, which is no change of its velocity."""
        x, y = steps[..., 0], steps[..., 1]
        cosine, sine = np.cos(turned) - 1, np.sin(turned)
        return np.stack([cosine * x - sine * y, sine * x + cosine * y, np.zeros_like(x)], axis=-1)

    plain = paths(none)
    slips = SLIP * rng.standard_normal((8, len(commands), 3, 3)) * SLIP_SHAPE
    of_slip = np.sqrt(np.mean([np.square(strengths(paths(none, slip))) for slip in slips], axis=0))
    return float(unit.size[0] * (of_slip / strengths(paths(unit))).min())


def simulated_case(
    name: str,
    seed: int,
    *,
    commands: int = 12,
    repetitions: int = 3,
    sessions: int = 1,
    effects: Sequence[str] = EFFECTS,
    all_kinds: bool = False,
) -> Case:
    """The simulated robot of a class and a seed.

    commands, repetitions: of the training runs, the latter in each session. sessions: more than one differ by SESSION.
    effects: that of the robot is one of them, in turn by its seed. all_kinds: train on all kinds of path in turn, else
    on some, and judge the others.
    """
    base, rng = base_of(name), np.random.default_rng([zlib.crc32(name.encode()), seed])
    geometry, effect = base.drawn(rng), effects[(seed + CLASSES.index(name)) % len(effects)]
    size, direction = rng.uniform(1.0, 3.0), rng.uniform(0.0, 2 * math.pi)
    sign = 1.0 if effect == "lost_rate" or rng.random() < 0.5 else -1.0
    if effect == "none":
        true = Effect(effect)
    else:
        size *= size_unit(name, effect)
        true = Effect(effect, (sign * size, 0.0))
        if effect == "floor_drift":
            true = Effect(effect, (size * math.cos(direction), size * math.sin(direction)))
    slip_of_command, slip_of_run = SLIP * np.exp(SLIP_SPREAD * rng.standard_normal(2))
    kinds = OF_SLIDING if base.slides else KINDS
    choices = SLIDING if base.slides else TURNING
    trained = kinds if all_kinds else choices[rng.integers(len(choices))]

    def slips(scale: float, count: int) -> Array:
        return np.asarray(scale * rng.standard_normal((count, 3, 3)) * SLIP_SHAPE)

    # The training runs: every command in every session, some times
    paths = [
        command_of(base, trained[number % len(trained)], number // len(trained), rng) for number in range(commands)
    ]
    wheels = [wheels_of(base, geometry, true, path) for path in paths]
    of_command = slips(slip_of_command, commands)
    of_session = np.zeros((sessions, 3, 3))
    if sessions > 1:
        of_session = np.array([np.diag(SESSION * rng.standard_normal(3)) for _ in range(sessions)])
    plan = [(s, c, r) for s in range(sessions) for c in range(commands) for r in range(repetitions)]
    of_runs = slips(slip_of_run, len(plan))
    slip = np.array([of_session[s] + of_command[c] + own for (s, c, _), own in zip(plan, of_runs, strict=True)])
    drives = Drives.of([wheels[c] for _, c, _ in plan])
    starts = np.column_stack([rng.uniform(-0.5, 0.5, (len(plan), 2)), rng.normal(0.0, 0.1, len(plan))])
    poses = driven(base, geometry, true, drives.rates, drives.middles, FINE, starts, slip)
    runs = [
        _recording(f"{paths[c].kind}{c}-{s}-{r}", wheels[c], path, rng, str(c), r, str(s), 60.0 * number)
        for number, ((s, c, r), path) in enumerate(zip(plan, poses, strict=True))
    ]
    dataset = make_dataset(f"{name} {seed}", base.robot, SAMPLE, runs, simulated=True)

    # The judged paths
    others = [kind for kind in kinds if all_kinds or kind not in trained]
    paths = [command_of(base, kind, number, rng) for kind in others for number in range(4)]
    wheels = [wheels_of(base, geometry, true, path) for path in paths]
    drives, origin = Drives.of(wheels), np.zeros((len(paths), 3))
    slip = slips(slip_of_command, len(paths))
    exact, slipped = (
        driven(base, geometry, true, drives.rates, drives.middles, FINE, origin, each) for each in (None, slip)
    )
    judged = [
        _recording(f"{path.kind}{number}", wheels[number], exact[number], None, str(number), 0, "0", 0.0)
        for number, path in enumerate(paths)
    ]
    checked = make_dataset(f"{name} {seed} judged", base.robot, SAMPLE, judged, simulated=True).trajectories
    return Case(
        base,
        seed,
        geometry,
        true,
        tuple(trained),
        dataset,
        checked,
        slipped[:, -1],
        (float(slip_of_command), float(slip_of_run)),
    )


def _recording(
    name: str,
    wheels: tuple[Array, Array],
    path: Array,
    rng: np.random.Generator | None,
    command: str,
    repetition: int,
    session: str,
    started_at: float,
) -> Trajectory:
    """A run as it is recorded, from its wheels (F, N), (F, S) and path (F' + 1, 3) at FINE; rng None: exact."""
    (rates, steering), each = wheels, round(SAMPLE / FINE)
    count = len(rates) // each
    stamps = np.arange(0.0, len(rates) * FINE + 1e-9, POSE)
    fine = FINE * np.arange(len(rates) + 1)
    clock = rng.normal(0.0, CLOCK) if rng else 0.0
    seen = np.column_stack([np.interp(stamps + clock, fine, part) for part in path[: len(rates) + 1].T])
    if rng:
        seen += NOISE * rng.standard_normal(seen.shape)
        seen[0, 2] += rng.normal(0.0, START_HEADING)
    return Trajectory(
        name,
        "train" if rng else "validation",
        SAMPLE * np.arange(1, count + 1),
        rates.reshape(count, each, -1).mean(axis=1),
        stamps,
        seen,
        command=command,
        repetition=repetition,
        session=session,
        started_at=started_at,
        steering=steering[each - 1 :: each] if steering.shape[1] else None,
    )


def simulated_cases(name: str, sets: int, seed: int = 0, **choices: object) -> Iterator[Case]:
    """Simulated robots of a class, of the seeds from ``seed`` on; choices: those of simulated_case."""
    for number in range(sets):
        yield simulated_case(name, seed + number, **choices)  # type: ignore[arg-type]
