"""A term of the odometry model: an effect with the values of its parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from types import MappingProxyType

from omnibench.errors import DataError, UnknownNameError
from omnibench.registry import effects
from omnibench.robot.effects.effect import Effect, MotionEffect, Parameter, Values
from omnibench.robot.effects.forms import accepts_form
from omnibench.robot.effects.weights import decode_weights
from omnibench.robot.kinematics import Robot

_SCALES = -1e9, 1e9  # range of the values that scale a form's covariate; chosen
_FAR_OUTSIDE = 1e3  # multiple of the plausible range beyond which a value is refused; chosen


@dataclass(frozen=True, eq=False, slots=True)
class Term:
    """An effect with the values of its parameters, each in its unit; weights: as in a calibration file, or None."""

    effect: Effect
    values: Values
    weights: str | None = None

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.effect.name


def make_term(
    name: str,
    parameters: Mapping[str, float],
    robot: Robot,
    where: str = "",
    *,
    sessions: tuple[str, ...] = (),
    weights: str | None = None,
) -> Term:
    """The effect called ``name`` with values of its parameters for a robot, in the given order.

    weights: as in a calibration file, for an effect that has some. UnknownNameError: no such effect, or no such
    parameter. DataError: the effect does not apply to the robot, or a parameter is missing, is no finite number, is a
    thousand times larger than plausible, or has ``choices`` and lies outside its range; or the weights are missing, are
    those of another robot, or are none. Messages begin with ``where``.
    """
    effect = effects.create(name, where=where)
    prefix = f"{where}: effect {name!r}" if where else f"effect {name!r}"
    check_applies(effect, robot, prefix)
    known = {parameter.name: parameter for parameter in effect.parameters(robot, sessions)}
    for given, value in parameters.items():
        if given not in known and not effect.accepts(given) and not _is_form(effect, robot, given):
            raise UnknownNameError("parameter", given, known, prefix)
        if not _is_number(value) or not math.isfinite(value):
            raise DataError(f"{prefix}: parameter {given!r} is {value!r}, not a finite number")
        formed = given.partition(":")[0]
        low, high = _SCALES if ":" in given and formed not in known else _limits(known.get(formed))
        if not low <= value <= high:
            raise DataError(f"{prefix}: parameter {given!r} is {value:g}, not within {low:g} and {high:g}")
    for parameter in known.values():
        if parameter.name not in parameters:
            raise DataError(
                f"{prefix}: parameter {parameter.name!r} ({parameter.unit}) is missing; {parameter.description}"
            )
    values = MappingProxyType({given: float(value) for given, value in parameters.items()})
    return Term(_weighted(effect, robot, weights, prefix), values, weights)


def _weighted(effect: Effect, robot: Robot, weights: str | None, prefix: str) -> Effect:
    """The effect with its weights, if it has some."""
    if weights is None:
        if effect.weighted:
            raise DataError(f"{prefix}: weights are missing; take it whole from the file that calibrate wrote")
        return effect
    if not effect.weighted:
        raise DataError(f"{prefix} has no weights; leave them out")
    return effect.with_weights(decode_weights(weights, f"{prefix}: weights"), robot, prefix)


def check_applies(effect: Effect, robot: Robot, prefix: str) -> None:
    """DataError, in one line that begins with ``prefix``: the effect does not apply to the robot."""
    if not effect.applies(robot):
        raise DataError(f"{prefix} is for {effect.only_for}; robot {robot.name} is none, leave the effect out")


def _is_form(effect: Effect, robot: Robot, name: str) -> bool:
    return isinstance(effect, MotionEffect) and accepts_form(effect, robot, name)


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _limits(parameter: Parameter | None) -> tuple[float, float]:
    """Lowest and highest allowed value; None: a parameter that is accepted but not listed."""
    if parameter is None:
        return -_FAR_OUTSIDE, _FAR_OUTSIDE
    if parameter.choices:
        return parameter.low, parameter.high
    largest = _FAR_OUTSIDE * max(abs(parameter.low), abs(parameter.high))
    return -largest, largest
