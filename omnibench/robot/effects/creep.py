"""Losses by friction that do not depend on the wheel's rate: dead zone and creep."""

from __future__ import annotations

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.effects.per_wheel import has_rollers
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals

_KNEE = 0.05  # rad/s, half-width of the smoothed sign function; chosen


def _smooth_sign(rates: Array) -> Array:
    """Sign of wheel rates, smoothed near 0."""
    return np.tanh(rates / _KNEE)


@effects.register("wheel_dead_zone")
class WheelDeadZone(MotionEffect):
    """Every wheel that turns loses or gains a constant rate: omega + c sign(omega)."""

    stage = "wheel"
    physics = "Play in the drive and dry friction of the rollers take a constant rate off every wheel that turns."
    source = "H. Olsson et al., Friction models and friction compensation, 1998"
    shows_in = "wheel rate"
    fixed_parameters = (Parameter("c", "rad/s", -0.02, 0.02, "rate that is gained in the direction of rotation"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["c"] * _smooth_sign(signals.rates)


@effects.register("coulomb_creep")
class CoulombCreep(MotionEffect):
    """Every wheel that turns loses a rate in proportion to the robot's speed: omega + c sign(omega) abs(v) / r."""

    stage = "wheel"
    physics = "Rollers drag with a friction that does not depend on their speed, and the wheels creep against it."
    source = "F. W. Carter, On the action of a locomotive driving wheel, 1926; H. Olsson et al., 1998 (friction)"
    shows_in = "wheel rate"
    form_covariates = ("wheel rate", "speed")
    fixed_parameters = (Parameter("c", "1", -0.02, 0.02, "creep as a share of the robot's speed"),)
    only_for = "robots with a wheel on rollers"

    def applies(self, robot: Robot) -> bool:
        return has_rollers(robot)

    def correction(self, signals: Signals, values: Values) -> Array:
        speed = np.hypot(signals.twists[:, 0], signals.twists[:, 1])
        radii = signals.robot.radii
        return values["c"] * _smooth_sign(signals.rates) * (speed[:, None] / radii)
