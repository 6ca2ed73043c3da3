"""Inputs for the conformance cases of effects: robots, parameters within their ranges, signals and poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np

from omnibench.robot.effects.effect import ActuatorEffect, Effect, MotionEffect, Parameter, ReferenceEffect, Values
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Caster, Signals, SteeringGears
from omnibench.robot.wheels.drive import in_the_middle
from omnibench.testing.synthetic import synthetic_robot, synthetic_robots

PERIOD: Final = 0.01  # s, of the wheel samples
SAMPLES: Final = 200
SESSIONS: Final = ("morning", "evening")
_OMNI: Final = frozenset({synthetic_robot(3).name, synthetic_robot(4).name})
Poses = tuple[Array, Array, Array]  # stamps (K,), poses (K, 3), start (3,)
Motors = tuple[Array, Array]  # durations (F,), targets (F, N)
Input = Signals | Poses | Motors


def driven_signals(robot: Robot, samples: int = SAMPLES, speed: float = 1.0) -> Signals:
    """Signals (F = samples) of a varied drive with rates of about 5 ``speed`` rad/s; speed 0: the robot stands."""
    rng = np.random.default_rng(0)
    ends = PERIOD * np.arange(1, samples + 1)
    phases = rng.uniform(0, 2 * math.pi, (2, len(robot.wheel_names)))
    rates = 5 * speed * (np.sin(2 * ends[:, None] + phases[0]) + 0.3 * np.sin(9 * ends[:, None] + phases[1]))
    swings = 0.4 * speed * np.sin(3 * ends[:, None] + np.arange(len(robot.drive.steered)))  # rad
    steering = in_the_middle(swings) if robot.drive.steered else None
    gears, caster = SteeringGears(), Caster(robot)
    twists = robot.drive.signals(rates, steering) @ robot.inverse_kinematic_matrix.T
    middle = ends - PERIOD / 2
    return Signals(
        robot=robot,
        durations=np.full(samples, PERIOD),
        rates=rates,
        elapsed=middle,
        twists=twists,
        accelerations=np.diff(twists, axis=0, prepend=0.0) / PERIOD,
        travelled=np.cumsum(np.hypot(twists[:, 0], twists[:, 1])) * PERIOD,
        wheel_angles=3.0 + np.cumsum(rates, axis=0) * PERIOD,
        session_time=600.0 + middle,
        session=SESSIONS[1],
        poses=_poses(twists, middle),
        steering=steering,
        steering_rates=None if steering is None else np.diff(swings, axis=0, prepend=swings[:1]) / PERIOD,
        steering_side=None if steering is None else np.array([gears.turned(angles) for angles in steering]),
        caster_rates=np.array([caster.moved(twist, PERIOD) for twist in twists.tolist()]),
    )


def _poses(twists: Array, elapsed: Array) -> Array:
    """Poses (F, 3): headings of the twists, positions on a loop beside the origin."""
    heading = 0.3 + PERIOD * np.cumsum(twists[:, 2])
    return np.column_stack([0.5 + 0.8 * np.sin(elapsed), -0.4 + 0.8 * np.cos(1.3 * elapsed), heading])


def robots(effect: Effect) -> tuple[Robot, ...]:
    """A robot on three omni wheels and one on four; robots on other wheels for an effect that applies to neither."""
    applies = tuple(robot for robot in synthetic_robots() if effect.applies(robot))
    return tuple(robot for robot in applies if robot.name in _OMNI) or applies


def trial_values(effect: Effect, robot: Robot, seed: int = 0) -> Iterator[Values]:
    """Parameters within their ranges, once for each choice of those that have choices."""
    rng = np.random.default_rng(seed)
    parameters = effect.parameters(robot, SESSIONS)
    free = {item.name: float(rng.uniform(item.low, item.high)) for item in parameters if not item.choices}
    shapes = [item for item in parameters if item.choices]
    for number in range(max((len(item.choices) for item in shapes), default=1)):
        yield {item.name: _choice(item, number) if item.choices else free[item.name] for item in parameters}


def trials(effect: Effect) -> Iterator[tuple[Robot, Values]]:
    """Every trial robot with its trial parameters."""
    return ((robot, values) for robot in robots(effect) for values in trial_values(effect, robot))


def without(effect: Effect, robot: Robot, values: Values) -> Values:
    """The values with every parameter that has no choices set to 0, at which the effect changes nothing."""
    shapes = {item.name for item in effect.parameters(robot, SESSIONS) if item.choices}
    return {name: value if name in shapes else 0.0 for name, value in values.items()}


def trial_input(effect: Effect, robot: Robot, speed: float = 1.0, samples: int = SAMPLES) -> Input:
    """Input for an effect of this kind; speed as for ``driven_signals``."""
    if isinstance(effect, MotionEffect):
        return driven_signals(robot, samples, speed)
    if isinstance(effect, ActuatorEffect):
        return motor_input(robot, samples, speed)
    poses = trial_poses(samples)
    return 0.25 * np.arange(1, samples + 1), poses[0] + speed * (poses - poses[0]), poses[0]


def trial_poses(count: int = SAMPLES) -> Array:
    """Poses (K, 3) on a curved path away from the origin."""
    angle = np.linspace(0.4, 2.4, count)
    return np.column_stack([1.0 + np.cos(angle), -2.0 + np.sin(2 * angle), 0.3 + angle])


def motor_input(robot: Robot, samples: int = SAMPLES, speed: float = 1.0) -> Motors:
    """Durations (F,), s, and target rates (F, N), rad/s, of a varied drive."""
    return np.full(samples, PERIOD), driven_signals(robot, samples, speed).rates


def results(effect: Effect, given: Input, values: Values) -> dict[str, Array]:
    """Results of the effect's methods, by name; an effect that has weights gets its trial weights."""
    if isinstance(given, Signals):
        if effect.weighted:
            effect = effect.with_weights(effect.trial_weights(given.robot), given.robot, f"effect {effect.name!r}")
        assert isinstance(effect, MotionEffect)
        return {"correction": effect.correction(given, values)}
    if len(given) == 2:
        assert isinstance(effect, ActuatorEffect)
        return {"driven": effect.driven(given[0], given[1], values)}
    assert isinstance(effect, ReferenceEffect)
    stamps, poses, start = given
    position, heading = effect.delays(stamps, values)
    return {
        "delays of position": position,
        "delays of heading": heading,
        "reported": effect.reported(poses, start, values),
        "corrected": effect.corrected(poses, start, values),
    }


def changes(effect: Effect, given: Input, values: Values) -> Array:
    """Changes by the effect: of wheel rates or twists (F, n), or of delays and poses, reported and corrected (K, 8)."""
    outputs = results(effect, given, values)
    changed = {"driven": given[1], "reported": given[1], "corrected": given[1]} if isinstance(given, tuple) else {}
    return np.column_stack([np.asarray(value) - changed.get(name, 0.0) for name, value in outputs.items()])


def arrays(given: Input) -> dict[str, Array]:
    """The arrays of an input by name."""
    if isinstance(given, tuple):
        return {str(number): array for number, array in enumerate(given)}
    values = {name: getattr(given, name) for name in type(given).__dataclass_fields__}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def one_row(given: Signals | Poses, row: int) -> Signals | Poses:
    """The input reduced to one sample or pose."""
    if isinstance(given, Signals):
        alone: dict[str, Any] = {name: value[row : row + 1] for name, value in arrays(given).items()}
        return replace(given, **alone)
    stamps, poses, start = given
    return stamps[row : row + 1], poses[row : row + 1], start


def _choice(parameter: Parameter, number: int) -> float:
    """The choice of that number, counted cyclically."""
    return parameter.choices[number % len(parameter.choices)]
