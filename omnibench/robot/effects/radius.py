"""Wheel radii that vary: with wheel rate, direction, time in the session, or from session to session."""

from __future__ import annotations

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.effects.per_wheel import of_wheels, one_for_each_wheel
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals

_RADIUS_OF = "radius_"


@effects.register("speed_dependent_radius")
class SpeedDependentRadius(MotionEffect):
    """The radius of all wheels changes with their rate: r (1 + k abs(omega))."""

    stage = "wheel"
    physics = "A soft tread grows with the rate of its wheel, or is pressed flatter by what drives it."
    source = "H. B. Pacejka, Tire and Vehicle Dynamics (effective rolling radius)"
    shows_in = "wheel rate"
    fixed_parameters = (Parameter("k", "s/rad", -0.02, 0.02, "relative change of the radius per rad/s"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["k"] * np.abs(signals.rates) * signals.rates


@effects.register("direction_dependent_radius")
class DirectionDependentRadius(MotionEffect):
    """A wheel drives farther one way than the other: omega + k_i abs(omega)."""

    stage = "wheel"
    physics = "Rollers, tread or backlash give way differently when a wheel turns backwards."
    source = "first principles"
    shows_in = "command"

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        return one_for_each_wheel(robot, "k", "1", -0.01, 0.01, "half the relative difference between both directions")

    def correction(self, signals: Signals, values: Values) -> Array:
        return of_wheels(signals.robot, "k", values) * np.abs(signals.rates)


@effects.register("thermal_radius_drift")
class ThermalRadiusDrift(MotionEffect):
    """The radius of all wheels drifts in the course of a session: r (1 + k session time)."""

    stage = "wheel"
    physics = "Treads warm up while they roll and expand, or soften and sink in."
    source = "first principles"
    shows_in = "order of runs"
    needs = frozenset({"session_time"})
    # 2 % within 1000 s; over hours the drift levels off, and its mean rate is smaller.
    fixed_parameters = (Parameter("k", "1/s", -2e-5, 2e-5, "relative change of the radius per second of the session"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        assert signals.session_time is not None  # it is needed
        return (values["k"] * signals.session_time)[:, None] * signals.rates


@effects.register("tyre_wear")
class TyreWear(MotionEffect):
    """The radius of all wheels differs from session to session: r (1 + radius_session)."""

    stage = "wheel"
    physics = "Treads wear off, or are changed or pumped up, between two sessions."
    source = (
        "J. Borenstein and L. Feng, Measurement and correction of systematic odometry errors in mobile robots, 1996"
    )
    shows_in = "order of runs"
    needs = frozenset({"session"})

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        return tuple(
            Parameter(f"{_RADIUS_OF}{session}", "1", -0.01, 0.01, f"relative to the radius of session {sessions[0]}")
            for session in sessions[1:]
        )

    def accepts(self, parameter: str) -> bool:
        return parameter.startswith(_RADIUS_OF)

    def correction(self, signals: Signals, values: Values) -> Array:
        """The correction; zero in a session without a radius of its own."""
        return values.get(f"{_RADIUS_OF}{signals.session}", 0.0) * signals.rates
