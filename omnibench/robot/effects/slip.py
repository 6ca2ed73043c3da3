"""Slip in proportion to forces: from accelerations, and from turning while driving."""

from __future__ import annotations

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.effects.per_wheel import of_wheels, one_for_each_wheel
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals

_PACEJKA = "H. B. Pacejka, Tire and Vehicle Dynamics"
_WOBBLES = 4  # wheels: three stand on any floor, of four one may be lighter


def _centripetal(twists: Array) -> Array:
    """w x v (F, 2) of twists (F, 3), m/s2."""
    across: Array = twists[:, 2:] * twists[:, 1::-1]  # w vy, w vx
    across[:, 0] *= -1
    return across


@effects.register("acceleration_slip")
class AccelerationSlip(MotionEffect):
    """The robot falls behind while it accelerates: v - k dv/dt, in the robot's frame."""

    stage = "body"
    physics = "Slip of the wheels grows with the force that accelerates the robot."
    source = f"{_PACEJKA} (longitudinal slip in proportion to the force)"
    shows_in = "acceleration"
    fixed_parameters = (Parameter("k", "s", 0.0, 0.1, "velocity that is lost per acceleration"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        added = np.zeros(signals.twists.shape)
        added[:, :2] = -values["k"] * signals.accelerations[:, :2]
        return added


@effects.register("centripetal_slip")
class CentripetalSlip(MotionEffect):
    """The robot slides across while it turns: v + k w x v."""

    stage = "body"
    physics = "Slip of the wheels grows with the force that keeps the robot on its curve."
    source = f"{_PACEJKA} (side slip in proportion to the force)"
    shows_in = "command"
    form_covariates = ("centripetal acceleration",)
    fixed_parameters = (
        Parameter("k", "s", 0.0, 0.1, "velocity towards the inside of the curve per centripetal acceleration"),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        added = np.zeros(signals.twists.shape)
        added[:, :2] = values["k"] * _centripetal(signals.twists)
        return added


@effects.register("load_transfer")
class LoadTransfer(MotionEffect):
    """A wheel that is pressed down has a smaller radius: r (1 - k a.u_i), u_i the direction of the wheel's axle.

    a is the whole acceleration of the body, in its own frame: dv/dt + w x v.
    """

    stage = "wheel"
    physics = "Accelerating shifts the robot's weight from wheel to wheel, and a tread gives way under load."
    source = f"{_PACEJKA} (effective rolling radius under load)"
    shows_in = "acceleration"
    fixed_parameters = (Parameter("k", "s2/m", 0.0, 0.3, "relative change of the radius per acceleration"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        angles = np.array([wheel.outward for wheel in signals.robot.measured])
        towards = np.stack([np.cos(angles), np.sin(angles)])
        acceleration = signals.accelerations[:, :2] + _centripetal(signals.twists)
        return -values["k"] * (acceleration @ towards) * signals.rates


@effects.register("rotation_translation_coupling")
class RotationTranslationCoupling(MotionEffect):
    """The robot turns faster or slower the faster it drives: w (1 + k.v)."""

    stage = "body"
    physics = "Rollers that already slide along their axles give way more easily when the robot turns."
    source = "first principles"
    shows_in = "command"
    fixed_parameters = (
        Parameter("kx", "s/m", -0.3, 0.3, "relative change of the rate of turn per velocity forward"),
        Parameter("ky", "s/m", -0.3, 0.3, "relative change of the rate of turn per velocity to the left"),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        vx, vy, w = signals.twists.T
        added = np.zeros(signals.twists.shape)
        added[:, 2] = w * (values["kx"] * vx + values["ky"] * vy)
        return added


@effects.register("quadratic_rotation_slip")
class QuadraticRotationSlip(MotionEffect):
    """The faster the robot turns, the more of it is lost or gained: w - k w abs(w)."""

    stage = "body"
    physics = "The rollers' drag grows with the rate of turn, and the wheels slip against it."
    source = "first principles"
    shows_in = "command"
    form_covariates = ("turning",)
    fixed_parameters = (Parameter("k", "s/rad", -0.1, 0.1, "share of the rate of turn that is lost per rad/s"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        rate_of_turn = signals.twists[:, 2]
        added = np.zeros(signals.twists.shape)
        added[:, 2] = -values["k"] * rate_of_turn * np.abs(rate_of_turn)
        return added


@effects.register("icr_shift")
class IcrShift(MotionEffect):
    """The faster a skid-steered robot turns, the farther ahead it has its centre of rotation: vy - x w abs(w).

    What the rate of turn itself loses by wider tracks is quadratic_rotation_slip.
    """

    stage = "body"
    physics = "The floor's friction across the wheels turns with their load, which turning shifts between the axles."
    source = (
        "A. Mandow et al., Experimental kinematics for wheeled skid-steer mobile robots, 2007; J. Pentzer, S. Brennan "
        "and K. Reichard, Model-based prediction of skid-steer robot kinematics using online estimation of track "
        "instantaneous centers of rotation, 2014"
    )
    shows_in = "command"
    form_covariates = ("turning",)
    only_for = "skid-steered robots"
    fixed_parameters = (Parameter("x", "m s/rad", -0.1, 0.1, "way ahead of the centre of rotation per rate of turn"),)

    def applies(self, robot: Robot) -> bool:
        return robot.skid

    def correction(self, signals: Signals, values: Values) -> Array:
        rate_of_turn = signals.twists[:, 2]
        added = np.zeros(signals.twists.shape)
        added[:, 1] = -values["x"] * rate_of_turn * np.abs(rate_of_turn)
        return added


@effects.register("light_wheel")
class LightWheel(MotionEffect):
    """A wheel that stands lightly slips in proportion to the force that is asked of it: omega - k_i a.u_i / r.

    u_i is the direction in which the wheel drives the robot, a the whole acceleration of the body in its own frame,
    dv/dt + w x v.
    """

    stage = "wheel"
    physics = "Four wheels or more share the weight as floor and frame will have it; grip goes with a wheel's share."
    source = f"{_PACEJKA} (slip stiffness in proportion to the load)"
    shows_in = "acceleration"
    only_for = "robots on four measured wheels or more"

    def applies(self, robot: Robot) -> bool:
        return len(robot.wheel_names) >= _WOBBLES

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        return one_for_each_wheel(robot, "k", "s", 0.0, 0.1, "rim speed that is lost per acceleration")

    def correction(self, signals: Signals, values: Values) -> Array:
        robot, acceleration = signals.robot, signals.accelerations[:, :2] + _centripetal(signals.twists)
        lost = np.empty(signals.rates.shape)
        for index, (wheel, pair) in enumerate(zip(robot.measured, robot.drive.pairs, strict=True)):
            rollers = wheel.roller_angle
            angles: Array = np.full(len(lost), wheel.rolling - rollers)
            if pair >= 0:
                assert signals.steering is not None  # the robot steers
                angles = angles + signals.steering[:, pair]
            driving = np.cos(angles) * acceleration[:, 0] + np.sin(angles) * acceleration[:, 1]
            lost[:, index] = driving / (wheel.radius * np.cos(rollers))
        return -of_wheels(robot, "k", values) * lost
