"""Robots, drives and terms that the tests of effects share."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from sample_robots import APR_02, WHEELED

from omnibench.registry import effects
from omnibench.robot.effects.effect import Effect, MotionEffect, ReferenceEffect, Term, make_term
from omnibench.robot.kinematics import Robot, Wheel
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryStream, WheelLog

PERIOD = 0.02
SESSIONS = ("morning", "evening")
MECANUM = Robot(
    name="youBot",
    wheels=tuple(
        Wheel(name=name, radius=0.0475, distance=0.385, angle=side * math.pi / 2, roller_angle=slant * math.pi / 4)
        for name, side, slant in (("fl", 1, 1), ("fr", -1, -1), ("rl", 1, -1), ("rr", -1, 1))
    ),
)
ROBOTS = {"three": APR_02, "four": MECANUM}
EVERY = ROBOTS | {robot.name: robot for robot in WHEELED}


def built_in(*kinds: type[Effect]) -> list[str]:
    """Names of the built-in effects of some kinds that the catalogue holds."""
    return [
        entry.name
        for entry in effects.entries()
        if entry.origin == "built in"
        and isinstance(effect := effects.create(entry.name), kinds)
        and effect.in_catalogue
    ]


def that_apply(names: Sequence[str], robot: Robot) -> list[str]:
    return [name for name in names if effects.create(name).applies(robot)]


# Effects of the APR-02, and of any robot; with each, the robots to which it applies.
MOTION, REFERENCE = that_apply(built_in(MotionEffect), APR_02), built_in(ReferenceEffect)
EVERY_MOTION = built_in(MotionEffect)
# Functions without a name: not in the catalogue, nor learned, with weights.
SMOOTH_MOTION = [
    entry.name
    for entry in effects.entries()
    if not (entry.cls.in_catalogue or entry.cls.weighted) and issubclass(entry.cls, MotionEffect)
]
APPLIED = [(name, robot) for robot in EVERY for name in that_apply(EVERY_MOTION, EVERY[robot])]


def a_drive(seed: int, samples: int = 40, robot: Robot = APR_02, stamps: int = 7) -> WheelLog:
    """Random rates with rests among them, irregular samples, all that an effect can need, and stamps anywhere."""
    rng = np.random.default_rng(seed)
    durations = PERIOD * rng.uniform(0.2, 2.0, samples)
    times = np.cumsum(durations)
    wheels, steered = len(robot.wheel_names), len(robot.drive.steered)
    rates = rng.normal(0, 4, (samples, wheels))
    rates[rng.random(samples) < 0.2] = rng.choice([0.0, 5e-4])
    return WheelLog(
        times=times,
        rates=rates,
        start=rng.normal(0, 2, 3),
        stamps=np.concatenate([[0.0], np.sort(rng.uniform(0, times[-1], stamps - 2)), times[-1:]]),
        wheel_angles=rng.uniform(-9, 9, wheels) + np.cumsum(rates * durations[:, None], axis=0),
        started_at=float(rng.uniform(0, 3600)),
        session=SESSIONS[int(rng.integers(2))],
        steering=0.6 * np.sin(np.cumsum(rng.normal(0, 0.2, (samples, steered)), axis=0)) if steered else None,
        drive=robot.drive if steered else None,
    )


def a_term(name: str, robot: Robot, seed: int = 0) -> Term:
    """An effect with parameters anywhere in their plausible range."""
    rng = np.random.default_rng(seed)
    values = {
        each.name: float(rng.choice(each.choices)) if each.choices else float(rng.uniform(each.low, each.high))
        for each in effects.create(name).parameters(robot, SESSIONS)
    }
    return make_term(name, values, robot, sessions=SESSIONS)


def mixture(seed: int, robot: Robot) -> list[Term]:
    """Several effects of any motion stage, some of them twice."""
    rng = np.random.default_rng(seed)
    names = rng.choice(that_apply(EVERY_MOTION, robot), size=int(rng.integers(2, 8)))
    return [a_term(str(name), robot, seed + place) for place, name in enumerate(names)]


def term(name: str, **values: float) -> Term:
    """An effect of the APR-02."""
    return make_term(name, values, APR_02)


def model(*terms: Term, robot: Robot = APR_02, integration: Integration = "arc") -> OdometryModel:
    """The design values with effects."""
    return OdometryModel(robot, robot.inverse_kinematic_matrix, integration, terms, PERIOD)


def at_every_sample(log: WheelLog) -> WheelLog:
    return replace(log, stamps=log.times)


def streamed(stream: OdometryStream, log: WheelLog) -> np.ndarray:
    """Poses (F, 3) after every sample."""
    durations = np.diff(log.times, prepend=0.0)
    steering = [None] * len(log.rates) if log.steering is None else log.steering
    samples = zip(log.rates, durations, log.wheel_angles, steering, strict=True)
    return np.array([stream.drive(rates * duration, duration, *angles) for rates, duration, *angles in samples])
