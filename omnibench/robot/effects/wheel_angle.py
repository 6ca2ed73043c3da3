"""Periodic changes of a wheel's radius over a turn: eccentricity, and the ripple of rollers."""

from __future__ import annotations

import math

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.effects.per_wheel import has_rollers, one_for_each_wheel
from omnibench.robot.effects.smooth.motion import waves
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals


def mean_waves(signals: Signals, wheel: int, harmonic: float) -> Array:
    """Means (F, 2) of omega cos(n phi) and omega sin(n phi) of a wheel over each sample; harmonic: n.

    phi turns at the constant rate omega. With phi in the middle of a sample of duration d the means are cos(n phi) and
    sin(n phi) times 2 sin(n omega d / 2) / (n d).
    """
    assert signals.wheel_angles is not None  # they are needed
    half = harmonic / 2 * signals.durations
    amplitude = np.sin(half * signals.rates[:, wheel]) / half
    means: Array = amplitude[:, None] * waves(signals.wheel_angles[:, wheel], (harmonic,))
    return means


def ripple(signals: Signals, harmonic: float, values: Values) -> Array:
    """Mean of omega (a cos(n phi) + b sin(n phi)) over each sample (F, N).

    harmonic: n. values: a_<wheel> and b_<wheel>.
    """
    assert signals.wheel_angles is not None  # they are needed
    if len(signals.rates) == 1:
        return _ripple_of_one_sample(signals, signals.wheel_angles, harmonic, values)
    added = np.zeros(signals.rates.shape)
    for wheel, name in enumerate(signals.robot.wheel_names):
        amplitudes = np.array([values[f"a_{name}"], values[f"b_{name}"]])
        if amplitudes.any():
            added[:, wheel] = mean_waves(signals, wheel, harmonic) @ amplitudes
    return added


def _ripple_of_one_sample(signals: Signals, angles: Array, harmonic: float, values: Values) -> Array:
    """``ripple`` of one sample in Python floats, which are faster than NumPy for a few wheels in a stream."""
    half = harmonic / 2 * float(signals.durations[0])
    samples = zip(signals.robot.measured, signals.rates[0].tolist(), angles[0].tolist(), strict=True)
    added = []
    for wheel, rate, angle in samples:
        a, b, phase = values[f"a_{wheel.name}"], values[f"b_{wheel.name}"], harmonic * angle
        added.append((a * math.cos(phase) + b * math.sin(phase)) * math.sin(half * rate) / half)
    return np.array([added])


@effects.register("wheel_eccentricity")
class WheelEccentricity(MotionEffect):
    """A wheel's radius changes over one turn: r (1 + a cos phi + b sin phi)."""

    stage = "wheel"
    physics = "The axle does not stand in the middle of the wheel."
    source = "first principles"
    shows_in = "wheel angle"
    needs = frozenset({"wheel_angles"})

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        return (
            *one_for_each_wheel(robot, "a", "1", -0.02, 0.02, "share of the radius, with the cosine of the angle"),
            *one_for_each_wheel(robot, "b", "1", -0.02, 0.02, "share of the radius, with the sine of the angle"),
        )

    def correction(self, signals: Signals, values: Values) -> Array:
        return ripple(signals, 1.0, values)


@effects.register("roller_ripple")
class RollerRipple(MotionEffect):
    """A wheel's radius changes from roller to roller: r (1 + a cos(n phi) + b sin(n phi)), n rollers."""

    stage = "wheel"
    physics = "The rollers do not make a perfect circle: the wheel sinks in between two of them."
    source = "first principles"
    shows_in = "wheel angle"
    needs = frozenset({"wheel_angles"})
    only_for = "robots with a wheel on rollers"

    def applies(self, robot: Robot) -> bool:
        return has_rollers(robot)

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        counts = tuple(float(count) for count in range(3, 17))
        return (
            *one_for_each_wheel(robot, "a", "1", -0.03, 0.03, "share of the radius, with the cosine of n angles"),
            *one_for_each_wheel(robot, "b", "1", -0.03, 0.03, "share of the radius, with the sine of n angles"),
            Parameter("rollers", "1", 2, 64, "rollers along a wheel's circumference, n", choices=counts),
        )

    def correction(self, signals: Signals, values: Values) -> Array:
        return ripple(signals, values["rollers"], values)
