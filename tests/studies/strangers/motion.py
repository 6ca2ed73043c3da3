"""Wheeled robots at 1 kHz: bodies move by given twists, wheels turn by the velocities of their contact points.

Nothing here is omnibench's. A robot is a mapping as in robot.yaml, one as it is drawn and one as it truly is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Array = NDArray[np.float64]
Robot = dict[str, Any]
Segment = Sequence[float]  # vx, vy (m/s), w (rad/s), and s at full speed
STEP = 1e-3  # s
TURN = 2 * math.pi  # rad
CLASSES = ("diff", "skid", "omni3", "mecanum", "tricycle", "car", "swerve")
_CORNERS = {"front_left": (1, 1), "front_right": (1, -1), "rear_left": (-1, 1), "rear_right": (-1, -1)}
_AXLES = {"a": 60.0, "b": 180.0, "c": 300.0}  # deg


@dataclass(eq=False)
class Run:
    """One drive as it was recorded.

    times (F,) of wheels (F, N) and steering (F, S), both rad; pose_times (K,) of poses (K, 3): m, rad.
    net: x, y (m) and turn (rad) from begin to end, in the frame of the begin; way (m) and turned (rad): along the path.
    """

    times: Array
    wheels: Array
    steering: Array
    pose_times: Array
    poses: Array
    net: Array
    way: float
    turned: float


@dataclass(eq=False)
class Log:
    """Runs by name, the robot as its robot.yaml describes it, and as it is."""

    robot: Robot
    true: Robot
    runs: dict[str, Run] = field(default_factory=dict)

    @property
    def wheels(self) -> list[str]:
        return [wheel["name"] for wheel in counted(self.robot)]

    @property
    def steered(self) -> list[str]:
        return [wheel["name"] for wheel in self.robot["wheels"] if wheel["type"] == "steered"]


def counted(robot: Robot) -> list[Robot]:
    """The wheels whose turning is measured."""
    return [wheel for wheel in robot["wheels"] if wheel.get("measured", True) and wheel.get("driven", True)]


def design(kind: str, radius: float = 0.05, x: float = 0.2, y: float = 0.15, distance: float = 0.2) -> Robot:
    """A robot of one of CLASSES."""

    def wheel(name: str, type_: str, **more: Any) -> Robot:
        return {"name": name, "type": type_, "radius": radius, **more}

    def corners(type_: str) -> list[Robot]:
        return [wheel(name, type_, x=i * x, y=j * y) for name, (i, j) in _CORNERS.items()]

    sides = [wheel("left", "fixed", x=0.0, y=y), wheel("right", "fixed", x=0.0, y=-y)]
    wheels: dict[str, list[Robot]] = {
        "diff": sides,
        "skid": corners("fixed"),
        "omni3": [wheel(name, "omni", distance=distance, angle_deg=angle) for name, angle in _AXLES.items()],
        "mecanum": corners("mecanum"),
        "tricycle": [wheel("front", "steered", x=x, y=0.0), *(side | {"measured": False} for side in sides)],
        "car": [wheel("front", "steered", x=x, y=0.0, driven=False), *sides],
        "swerve": corners("steered"),
    }
    return {"name": kind, "wheels": wheels[kind]} | ({"skid": True} if kind == "skid" else {})


def changed(robot: Robot, factors: Mapping[str, float], only: str = "") -> Robot:
    """The robot with numbers of its wheels, or of one of them, times a factor."""
    wheels = []
    for wheel in robot["wheels"]:
        there = factors if only in ("", wheel["name"]) else {}
        wheels.append(wheel | {key: wheel[key] * factor for key, factor in there.items() if key in wheel})
    return robot | {"wheels": wheels}


def slightly_off(robot: Robot) -> Robot:
    """What a calibration is for: a radius 0.8 % and the arms 1.5 % larger than drawn; skidding wheels turn it less."""
    arms = {"y": 1.25} if robot.get("skid") else {"x": 1.015, "y": 1.015, "distance": 1.015}
    return changed(changed(robot, {"radius": 1.008}, counted(robot)[0]["name"]), arms)


def commands(kind: str, v: float = 0.3, w: float = 0.8, seconds: float = 6.0) -> dict[str, list[Segment]]:
    """Motions that tell all of a robot's geometry. v, w: m/s and rad/s at full speed."""
    motions = {"ahead": (v, 0.0, 0.0), "back": (-v, 0.0, 0.0)}
    for side, sign in (("left", 1), ("right", -1)):
        motions[f"arc_{side}"] = (v, 0.0, sign * w / 2)
        if kind in ("tricycle", "car"):
            motions[f"wide_{side}"] = (v, 0.0, sign * w / 4)
        else:
            motions[f"turn_{side}"] = (0.0, 0.0, sign * w)
        if kind in ("omni3", "mecanum", "swerve"):
            motions[f"side_{side}"] = (0.0, sign * v, 0.0)
    return {name: [(*twist, seconds)] for name, twist in motions.items()}


def profile(segments: Sequence[Segment], rest: float = 1.2, ramp: float = 0.4) -> tuple[Array, Array]:
    """Twists (n, 3), trapezoids of speed with a rest between two and half of one at both ends; and at full speed."""
    still, up = np.zeros(round(rest / STEP / 2)), np.arange(round(ramp / STEP)) * STEP / ramp
    twists, full = [], []
    for *twist, seconds in segments:
        shape = np.concatenate([still, up, np.ones(round(seconds / STEP)), 1 - up, still])
        twists.append(shape[:, None] * twist)
        full.append(np.tile(twist, (len(shape), 1)))
    return np.vstack(twists), np.vstack(full)


def track(twists: Array) -> Array:
    """Poses (n + 1, 3) from the origin, by exact arcs."""
    turns = twists[:, 2] * STEP
    heading = np.append(0.0, np.cumsum(turns))
    chords = (twists[:, 0] + 1j * twists[:, 1]) * STEP * np.sinc(turns / TURN)
    place = np.append(0.0, np.cumsum(chords * np.exp(1j * (heading[:-1] + turns / 2))))
    return np.column_stack([place.real, place.imag, heading])


def wheel_motion(robot: Robot, twists: Array, full: Array) -> tuple[Array, Array]:
    """Rates (n, N) of the counted wheels, rad/s, and angles (n, S) of the steered ones, rad, by contact velocities."""
    rates, steering = [], []
    for wheel in robot["wheels"]:
        x, y, roll = wheel.get("x", 0.0), wheel.get("y", 0.0), 0.0
        if wheel["type"] == "omni":
            axle = math.radians(wheel["angle_deg"])
            x, y, roll = wheel["distance"] * math.cos(axle), wheel["distance"] * math.sin(axle), axle + math.pi / 2
        along, across = twists[:, 0] - twists[:, 2] * y, twists[:, 1] + twists[:, 2] * x
        angle = np.full(len(twists), roll)
        roller = -math.copysign(math.pi / 4, x * y) if wheel["type"] == "mecanum" else 0.0
        if wheel["type"] == "steered":
            towards = np.arctan2(full[:, 1] + full[:, 2] * x, full[:, 0] - full[:, 2] * y)
            angle = (towards + math.pi / 2) % math.pi - math.pi / 2  # a module turns by at most a quarter
            steering.append(angle)
        if wheel.get("measured", True) and wheel.get("driven", True):
            speed = along * np.cos(angle + roller) + across * np.sin(angle + roller)
            rates.append(speed / (wheel["radius"] * math.cos(roller)))
    return np.column_stack(rates), np.column_stack(steering) if steering else np.empty((len(twists), 0))


def sampled(values: Array, hz: float) -> tuple[Array, Array]:
    """Times (F,) and rows of 1 kHz, at a rate."""
    rows = np.arange(0, len(values) - 0.5, 1 / (hz * STEP)).round().astype(int)
    return rows * STEP, values[rows]


def recorded(
    rng: Generator, twists: Array, rates: Array, steering: Array, *,
    hz: float = 25.0, pose_hz: float = 10.0, noise: float = 0.002, walk: float = 0.002,
    tracked: Sequence[float] = (0.0, 0.0),
) -> Run:  # fmt: skip
    """A run of 1 kHz as it is recorded. noise: of poses, m and rad; walk: of the body's motion, m and rad a root s.

    tracked: the point that the reference follows, m, in the robot's frame.
    """
    moving = (np.abs(twists).sum(axis=1) > 1e-9)[:, None]
    body = track(twists + moving * rng.standard_normal(twists.shape) * walk / math.sqrt(STEP))
    point = body[:, 0] + 1j * body[:, 1] + (tracked[0] + 1j * tracked[1]) * (np.exp(1j * body[:, 2]) - 1)
    angles = np.vstack([np.zeros(rates.shape[1]), np.cumsum(rates * STEP, axis=0)])
    times, wheels = sampled(angles + rng.uniform(0, TURN, rates.shape[1]), hz)
    turn = rng.uniform(-math.pi, math.pi)
    placed = rng.uniform(-1, 1) + 1j * rng.uniform(-1, 1) + point * np.exp(1j * turn)
    pose_times, poses = sampled(np.column_stack([placed.real, placed.imag, body[:, 2] + turn]), pose_hz)
    poses = poses + rng.standard_normal(poses.shape) * noise
    _, steered = sampled(np.vstack([steering[:1], steering]), hz)
    net = np.array([point[-1].real, point[-1].imag, body[-1, 2]])
    way, turned = float(np.abs(np.diff(point)).sum()), float(np.abs(twists[:, 2]).sum() * STEP)
    return Run(times, wheels, steered, pose_times, poses, net, way, turned)


def simulate(
    robot: Robot, seed: int, motions: Mapping[str, Sequence[Segment]], *,
    true: Robot | None = None, repeats: int = 3, rest: float = 1.2, **record: Any,
) -> Log:  # fmt: skip
    """A log of motions, each repeated: runs <motion>_<number>. true: the robot as it is, default: slightly off."""
    rng, log = np.random.default_rng(seed), Log(robot, true or slightly_off(robot))
    for name, segments in motions.items():
        twists, full = profile(segments, rest)
        rates, steering = wheel_motion(log.true, twists, full)
        for number in range(1, repeats + 1):
            log.runs[f"{name}_{number}"] = recorded(rng, twists, rates, steering, **record)
    return log
