"""Smooth functions of wheel rates, wheel angles and acceleration, for unknown effects."""

from __future__ import annotations

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.effects.per_wheel import of_wheels, one_for_each_wheel
from omnibench.robot.effects.smooth.motion import WithoutCause, direction, scale
from omnibench.robot.effects.wheel_angle import ripple
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import STILL, Signals

KNOTS = 8  # knots of the function of each wheel's rate; chosen
_COMMON_KNOTS = 33  # knots of the function that all wheels share; chosen
HARMONICS = (0.5, *(float(number) for number in range(1, 17)), 1.5, 2.5, 3.5)  # waves in a turn of a wheel; chosen

_TOP = scale("top", "rad/s", 1e-6, 1e6, 6.0, "the fastest rate that was seen; knots are spread from -top to top")


def hat_functions(rates: Array, top: float) -> Array:
    """Piecewise linear hat functions (..., 8) of rates between -top and top, rad/s, constant beyond.

    Zero for standing wheels.
    """
    return np.stack([_between_knots(rates, top, heights) for heights in np.eye(KNOTS)], axis=-1)


def _between_knots(rates: Array, top: float, heights: Array) -> Array:
    """The piecewise linear function (...) of rates with given heights at the knots; zero for standing wheels."""
    interpolated: Array = np.interp(rates, np.linspace(-top, top, len(heights)), heights)
    return np.where(np.abs(rates) > STILL, interpolated, 0.0)


@effects.register("smooth_wheel_rate")
class SmoothWheelRate(WithoutCause, MotionEffect):
    """Unknown effect: a piecewise linear function of each wheel's rate, which holds its value beyond the rates seen."""

    stage = "wheel"
    shows_in = "wheel rate"

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        at_knots = [
            one_for_each_wheel(robot, f"change_{knot}", "rad/s", -0.02, 0.02, f"change at knot {knot} of 0 to 7")
            for knot in range(KNOTS)
        ]
        return (*(parameter for knot in at_knots for parameter in knot), _TOP)

    def correction(self, signals: Signals, values: Values) -> Array:
        heights = np.array([of_wheels(signals.robot, f"change_{knot}", values) for knot in range(KNOTS)])
        wheels = zip(signals.rates.T, heights.T, strict=True)
        return np.column_stack([_between_knots(rates, values["top"], at_knots) for rates, at_knots in wheels])


@effects.register("smooth_common_rate")
class SmoothCommonRate(WithoutCause, MotionEffect):
    """Unknown effect: a finer function of the wheel rate, the same for all wheels, held beyond the rates seen."""

    stage = "wheel"
    shows_in = "wheel rate"
    fixed_parameters = (
        *(
            Parameter(f"change_{knot}", "rad/s", -0.02, 0.02, f"change at knot {knot} of 0 to {_COMMON_KNOTS - 1}")
            for knot in range(_COMMON_KNOTS)
        ),
        _TOP,
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        heights = np.array([values[f"change_{knot}"] for knot in range(_COMMON_KNOTS)])
        return _between_knots(signals.rates, values["top"], heights)


@effects.register("smooth_wheel_angle")
class SmoothWheelAngle(WithoutCause, MotionEffect):
    """Unknown effect: a wave of each wheel's angle, so many times a turn."""

    stage = "wheel"
    shows_in = "wheel angle"
    needs = frozenset({"wheel_angles"})

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        return (
            *one_for_each_wheel(robot, "a", "1", -0.03, 0.03, "share of the radius, with the cosine"),
            *one_for_each_wheel(robot, "b", "1", -0.03, 0.03, "share of the radius, with the sine"),
            Parameter("harmonic", "1", 0.1, 256.0, "waves in a turn of the wheel", choices=HARMONICS),
        )

    def correction(self, signals: Signals, values: Values) -> Array:
        return ripple(signals, values["harmonic"], values)


_OF_ACCELERATION = (
    Parameter("straight", "s", -0.1, 0.1, "change of the velocity, of the acceleration"),
    Parameter("aside", "s", -0.1, 0.1, "change of the velocity to the left of the acceleration, of its size"),
    Parameter("about_x", "rad s/m", -0.1, 0.1, "change of the rate of turn, of the acceleration forwards"),
    Parameter("about_y", "rad s/m", -0.1, 0.1, "change of the rate of turn, of the acceleration to the left"),
    Parameter("about_omega", "s", -0.1, 0.1, "change of the rate of turn, of its own rate of change"),
    Parameter("about_size", "rad s/m", -0.1, 0.1, "change of the rate of turn, of the acceleration's size"),
    Parameter("about_turning", "s", -0.1, 0.1, "change of the rate of turn, of the size of its rate of change"),
    Parameter("along", "s2/m", -0.1, 0.1, "change along the way, of the speed times the acceleration's size"),
    Parameter("across", "s2/m", -0.1, 0.1, "change across the way, of the speed times the acceleration's size"),
    Parameter("rotation", "s2/m", -0.1, 0.1, "change of the rate of turn, of itself times the acceleration's size"),
)


@effects.register("smooth_acceleration")
class SmoothAcceleration(WithoutCause, MotionEffect):
    """Unknown effect: changes that grow with the acceleration, up to the largest that was seen, and then no more."""

    stage = "body"
    shows_in = "acceleration"
    fixed_parameters = (
        *_OF_ACCELERATION,
        scale("top", "m/s2", 1e-9, 1e9, 10.0, "the largest acceleration that was seen"),
        scale("top_turning", "rad/s2", 1e-9, 1e9, 50.0, "the largest change of the rate of turn that was seen"),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        forward, left, angular = signals.accelerations.T
        size = np.hypot(forward, left)
        limit = np.minimum(1.0, values["top"] / np.maximum(size, 1e-300))
        forward, left, size = limit * forward, limit * left, limit * size
        angular = np.clip(angular, -values["top_turning"], values["top_turning"])
        zeros = np.zeros(len(size))
        turning = values["about_x"] * forward + values["about_y"] * left + values["about_omega"] * angular
        turning = turning + values["about_size"] * size + values["about_turning"] * np.abs(angular)
        added = values["straight"] * np.column_stack([forward, left, zeros])
        added += values["aside"] * np.column_stack([-left, forward, zeros])
        added[:, 2] += turning
        for mode in ("along", "across", "rotation"):
            added += values[mode] * size[:, None] * direction(mode, signals)
        return added
