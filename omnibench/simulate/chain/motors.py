"""Parameters of a wheel's drive (brushed DC motor, PID controller, encoder), and which commands it can follow."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydantic import Field, model_validator

from omnibench.config import Model, NonNegative, Positive
from omnibench.errors import ConfigError
from omnibench.robot.kinematics import Array, Robot
from omnibench.simulate.command import Command, wheels_of
from omnibench.words import plural

TRUE_STEP = 1e-3  # s between the true wheel angles that are kept (chosen: a tenth of the usual sample period)
_RESERVE = 0.1  # share of the fastest rate that is left to the controller (chosen)


class Motor(Model):
    """A brushed DC motor with its gear and its share of the robot's inertia.

    Palacin et al. give no data sheet of the APR-02's motors. The defaults (chosen) are a 24 V motor with a gear of 50
    for a robot of some 30 kg on three wheels of 0.148 m radius. Losses of the gear are part of the frictions.
    """

    supply_voltage: Positive = Field(24.0, description="V")
    resistance: Positive = Field(0.8, description="of the winding, ohm")
    inductance: Positive = Field(0.0008, description="of the winding, H")
    torque_constant: Positive = Field(0.045, description="N m/A, and of the back-EMF V s/rad, at the motor")
    gear_ratio: Positive = Field(50.0, description="turns of the motor per turn of the wheel")
    inertia: Positive = Field(0.5, description="of rotor, gear, wheel and share of the robot, at the wheel, kg m2")
    static_friction: NonNegative = Field(0.6, description="at the wheel, N m")
    coulomb_friction: NonNegative = Field(0.5, description="at the wheel, N m")
    viscous_friction: NonNegative = Field(0.1, description="at the wheel, N m s/rad")

    @model_validator(mode="after")
    def _turns(self) -> Motor:
        if self.coulomb_friction > self.static_friction:
            raise ValueError(
                f"coulomb_friction {self.coulomb_friction:g} N m is above static_friction {self.static_friction:g} "
                "N m; a wheel needs at least as much torque to start as to go on"
            )
        stalled = self.wheel_torque_constant * self.supply_voltage / self.resistance
        if stalled <= self.static_friction:
            raise ValueError(
                f"the motor never turns: {stalled:.3g} N m at the full voltage do not beat static_friction "
                f"{self.static_friction:g} N m"
            )
        return self

    @property
    def wheel_torque_constant(self) -> float:
        """Torque at the wheel per current, N m/A; voltage per wheel rate, V s/rad."""
        return self.torque_constant * self.gear_ratio

    @property
    def fastest_rate(self) -> float:
        """Wheel rate in steady state at the full voltage against friction, rad/s."""
        constant = self.wheel_torque_constant
        pull = constant * self.supply_voltage / self.resistance - self.coulomb_friction
        return pull / (constant**2 / self.resistance + self.viscous_friction)


class Controller(Model):
    """PID controller of the wheel rate, once a sample; its output is limited to the supply voltage.

    The integral does not grow at that limit. The derivative is that of the measured rate. A wheel with target 0 that
    turns by no more than a tick in a sample is braked by its short-circuited motor: no voltage, no integral.
    """

    proportional: NonNegative = Field(3.0, description="V per rad/s")
    integral: NonNegative = Field(50.0, description="V per rad")
    derivative: NonNegative = Field(0.005, description="V per rad/s2")

    @model_validator(mode="after")
    def _acts(self) -> Controller:
        if not self.proportional and not self.integral:
            raise ValueError("proportional and integral are both 0; no wheel would ever turn")
        return self


class Encoder(Model):
    """An incremental encoder. The default is a magnetic one with 64 pulses, x 4, at the motor, before a gear of 50."""

    ticks: int = Field(12_800, gt=0, le=10**9, description="quadrature counts per turn of the wheel")

    @property
    def tick(self) -> float:
        """Wheel angle of one count, rad."""
        return 2 * math.pi / self.ticks


def check_reach(robot: Robot, commands: Sequence[Command], motor: Motor | Sequence[Motor]) -> None:
    """ConfigError in one line for a command that needs a higher wheel rate than the motor reaches.

    A tenth of the motor's fastest rate is left to the controller.
    """
    motors = motors_of_wheels(motor, len(robot.wheel_names))
    limits = (1 - _RESERVE) * np.array([each.fastest_rate for each in motors])
    for command in commands:
        rates, _ = wheels_of(robot, command.twist)
        wheel = int(np.argmax(np.abs(rates) / limits))
        if abs(rates[wheel]) > limits[wheel]:
            raise ConfigError(
                f"command {command.name} (speed {command.speed:g} m/s, direction {math.degrees(command.direction):g} "
                f"deg, turn rate {command.turn_rate:g} rad/s) is faster than the motors can go: wheel "
                f"{robot.wheel_names[wheel]} would need {abs(rates[wheel]):.4g} rad/s, its motor reaches "
                f"{motors[wheel].fastest_rate:.4g} rad/s, of which the controller keeps {_RESERVE:.0%}; "
                f"{_way_out(robot, command, limits)}"
            )


def _way_out(robot: Robot, command: Command, limits: Array) -> str:
    """Advice: the greatest speed at this rate of turn; if there is none, the greatest rate of turn."""
    if not robot.drive.direct:
        share = float(np.min(limits / np.maximum(np.abs(wheels_of(robot, command.twist)[0]), 1e-9)))
        if not command.speed:
            return f"give it a turn rate of at most {_rounded_down(share * abs(command.turn_rate))} rad/s"
        return f"give it a speed of at most {_rounded_down(share * command.speed)} m/s, and a turn rate as much lower"
    straight, across, turn = (robot.signal_equations * command.twist).T
    travel = straight + across
    left = limits - np.abs(turn)
    if command.speed and (left > 0).all():
        rooms = np.where(travel * turn >= 0, left, limits + np.abs(turn))
        share = np.min(rooms[travel != 0] / np.abs(travel[travel != 0]))
        return f"give it a speed of at most {_rounded_down(share * command.speed)} m/s"
    greatest = _rounded_down(abs(command.turn_rate) * np.min(limits[turn != 0] / np.abs(turn[turn != 0])))
    return f"turning at more than {greatest} rad/s alone is too fast; give it a lower turn rate" + (
        " and speed" if command.speed else ""
    )


def _rounded_down(value: float) -> str:
    """The value with three digits, rounded down."""
    digits = 2 - math.floor(math.log10(value))
    return f"{math.floor(value * 10.0**digits) / 10.0**digits:g}"


def motors_of_wheels(motor: Motor | Sequence[Motor], wheels: int) -> list[Motor]:
    """The motor of each wheel. ConfigError: there are not as many motors as wheels."""
    motors = [motor] * wheels if isinstance(motor, Motor) else list(motor)
    if len(motors) != wheels:
        raise ConfigError(
            f"{plural(len(motors), 'motor')} for {plural(wheels, 'wheel')}; give one for each, or one for all"
        )
    return motors
