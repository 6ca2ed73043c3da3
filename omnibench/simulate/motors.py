"""Wheels driven by motors under PID control: their true motion, what encoders measure, which commands they can follow.

Each motor moves its own share of the robot's inertia, independently of the other wheels. Wheel angles are continuous
within a session; between its runs the robot stands.

The inner loop of a wheel's drive is compiled: PID once a sample, motor and friction in exact steps of 0.1 ms. Within a
step the voltage and the sign of the friction are constant, so current, rate and angle follow a linear equation whose
exact solution is a matrix. Only the instant at which a wheel stops or breaks away is found to a step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydantic import Field, model_validator
from scipy.linalg import expm

from omnibench.config import Model, NonNegative, Positive
from omnibench.errors import ConfigError
from omnibench.robot.compiled import compiled
from omnibench.robot.kinematics import Array, Robot
from omnibench.simulate.commands import Command, rounded_down, wheels_of

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


def check_reach(robot: Robot, commands: Sequence[Command], motor: Motor) -> None:
    """ConfigError in one line for a command that needs a higher wheel rate than the motor reaches.

    A tenth of the motor's fastest rate is left to the controller.
    """
    limit = (1 - _RESERVE) * motor.fastest_rate
    for command in commands:
        rates = np.abs(wheels_of(robot, command.twist)[0])
        wheel = int(np.argmax(rates))
        if rates[wheel] > limit:
            raise ConfigError(
                f"command {command.name} (speed {command.speed:g} m/s, direction {math.degrees(command.direction):g} "
                f"deg, turn rate {command.turn_rate:g} rad/s) is faster than the motors can go: wheel "
                f"{robot.wheel_names[wheel]} would need {rates[wheel]:.4g} rad/s, its motor reaches "
                f"{motor.fastest_rate:.4g} rad/s, of which the controller keeps {_RESERVE:.0%}; "
                f"{_way_out(robot, command, limit)}"
            )


def _way_out(robot: Robot, command: Command, limit: float) -> str:
    """Advice: the greatest speed at this rate of turn; if there is none, the greatest rate of turn. limit: rad/s."""
    turning = abs(command.turn_rate)
    if not robot.drive.direct:
        share = limit / float(np.abs(wheels_of(robot, command.twist)[0]).max())
        if not command.speed:
            return f"give it a turn rate of at most {rounded_down(share * turning, 3):g} rad/s"
        speed = rounded_down(share * command.speed, 3)
        return f"give it a speed of at most {speed:g} m/s, and a turn rate as much lower"
    straight, across, turn = (robot.signal_equations * command.twist).T
    travel = straight + across
    left = limit - np.abs(turn)
    if command.speed and (left > 0).all():
        rooms = np.where(travel * turn >= 0, left, limit + np.abs(turn))
        share = float(np.min(rooms[travel != 0] / np.abs(travel[travel != 0])))
        return f"give it a speed of at most {rounded_down(share * command.speed, 3):g} m/s"
    greatest = rounded_down(turning * limit / float(np.abs(turn).max()), 3)
    lower = "turn rate and speed" if command.speed else "turn rate"
    return f"turning at more than {greatest:g} rad/s alone is too fast; give it a lower {lower}"


_INNER = 10  # steps of the motor's equations within TRUE_STEP
_STEP = TRUE_STEP / _INNER
_STANDING = 1e-6  # ticks a sample; a lower target rate is rounding and counts as rest


class MotorSteps(NamedTuple):
    """Transition of a wheel's state in one step of 0.1 ms.

    moving (3, 4): matrix from current (A), rate (rad/s), voltage (V) and friction (N m) to current, rate and angle
    turned (rad). For a wheel that stands, the next current is held times the current plus fed (A/V) times the voltage.
    torque: N m/A. static, coulomb: friction, N m.
    """

    moving: Array
    held: float
    fed: float
    torque: float
    static: float
    coulomb: float


class Pid(NamedTuple):
    """Gains (V per rad/s, V per rad, V per rad/s2) and the greatest voltage, V."""

    proportional: float
    integral: float
    derivative: float
    supply: float


def motor_steps(motor: Motor) -> MotorSteps:
    """Transition of a motor's state. SI units, at the wheel."""
    resistance, inductance, inertia = motor.resistance, motor.inductance, motor.inertia
    torque = motor.wheel_torque_constant
    system = np.zeros((5, 5))  # state: current, rate, angle, voltage, friction; the last two are constant
    system[0, [0, 1, 3]] = [-resistance / inductance, -torque / inductance, 1 / inductance]
    system[1, [0, 1, 4]] = [torque / inertia, -motor.viscous_friction / inertia, -1 / inertia]
    system[2, 1] = 1.0
    moving = np.ascontiguousarray(expm(system * _STEP)[[0, 1, 2]][:, [0, 1, 3, 4]])
    held = math.exp(-resistance / inductance * _STEP)
    return MotorSteps(moving, held, (1 - held) / resistance, torque, motor.static_friction, motor.coulomb_friction)


@compiled
def drive_wheel(
    motor: MotorSteps, pid: Pid, tick: float, targets: Array, start: float, sample_steps: int
) -> tuple[Array, Array, Array]:
    """One run of one wheel from rest at the angle ``start`` (rad) towards target rates (F,), rad/s.

    tick: angle of an encoder tick, rad. sample_steps: milliseconds of a sample. Returns true angles (sample_steps F +
    1,) at every millisecond, rad; the encoder's count (F,) at the end of every sample; voltages (F,), V.
    """
    samples = len(targets)
    period = sample_steps * TRUE_STEP
    angles = np.empty(samples * sample_steps + 1)
    counts, voltages = np.empty(samples), np.empty(samples)
    angles[0] = angle = start
    seen = math.floor(start / tick)
    current = rate = integral = measured = before = 0.0
    for sample in range(samples):
        if abs(targets[sample]) * period < _STANDING * tick and abs(measured) * period < 1.5 * tick:
            # The motor brakes: a controller that answers to single ticks would never let it rest.
            voltage, integral = 0.0, 0.0
        else:
            voltage, integral = _controlled(pid, targets[sample], measured, before, integral, period)
        for step in range(sample_steps):
            for _ in range(_INNER):
                current, rate, turned = _stepped(motor, current, rate, voltage)
                angle += turned
            angles[sample * sample_steps + step + 1] = angle
        count = math.floor(angle / tick)
        measured, before, seen = (count - seen) * tick / period, measured, count
        counts[sample], voltages[sample] = count, voltage
    return angles, counts, voltages


@compiled
def _controlled(
    pid: Pid, target: float, measured: float, before: float, integral: float, period: float
) -> tuple[float, float]:
    """Voltage of the next sample, V, and the integral, rad, which does not grow while the voltage is at its limit."""
    error = target - measured
    grown = integral + error * period
    voltage = pid.proportional * error + pid.integral * grown - pid.derivative * (measured - before) / period
    if abs(voltage) <= pid.supply:
        return voltage, grown
    return math.copysign(pid.supply, voltage), grown if error * voltage < 0.0 else integral


@compiled
def _stepped(motor: MotorSteps, current: float, rate: float, voltage: float) -> tuple[float, float, float]:
    """Current, A, and rate, rad/s, after one step, and the angle turned in it, rad."""
    direction = 0.0  # sign of the motion, against which friction acts
    if rate != 0.0:
        direction = math.copysign(1.0, rate)
    elif abs(motor.torque * current) > motor.static:
        direction = math.copysign(1.0, current)
    elif motor.static > 0.0:
        return motor.held * current + motor.fed * voltage, 0.0, 0.0
    friction = direction * motor.coulomb
    by = motor.moving
    flowing = by[0, 0] * current + by[0, 1] * rate + by[0, 2] * voltage + by[0, 3] * friction
    after = by[1, 0] * current + by[1, 1] * rate + by[1, 2] * voltage + by[1, 3] * friction
    if motor.static > 0.0 and after * direction < 0.0:  # it stops within the step; friction turns no wheel round
        return flowing, 0.0, 0.5 * rate * _STEP * rate / (rate - after)
    return flowing, after, by[2, 0] * current + by[2, 1] * rate + by[2, 2] * voltage + by[2, 3] * friction


@dataclass(frozen=True, eq=False)
class DrivenRun:
    """Motion of the N wheels in a run of F samples, true and measured.

    wheel_angles (M F + 1, N): true absolute angles every millisecond, rad; a sample takes M ms. rates (F, N): measured
    mean rates, rad/s. angles (F, N): measured absolute angles at the samples' ends, rad. voltages (F, N): motors, V.
    """

    wheel_angles: Array
    rates: Array
    angles: Array
    voltages: Array


def drive_session(
    motor: Motor,
    controller: Controller,
    encoder: Encoder,
    targets: Sequence[Array],
    sample_period: float,
    start_angles: Array,
) -> list[DrivenRun]:
    """The runs of a session, each from rest at the wheel angles where the one before has ended.

    motor: of every wheel. targets: rates of each run (F, N), rad/s. sample_period: a whole number of milliseconds, s.
    start_angles: (N,), rad.
    """
    steps = round(sample_period / TRUE_STEP)
    pid = Pid(controller.proportional, controller.integral, controller.derivative, motor.supply_voltage)
    drive = motor_steps(motor), pid
    angles, runs = np.asarray(start_angles, float), []
    for rates in targets:
        wheels = [
            drive_wheel(*drive, encoder.tick, np.ascontiguousarray(wheel_rates, float), angle, steps)
            for wheel_rates, angle in zip(rates.T, angles, strict=True)
        ]
        true, counts, voltages = (np.column_stack(columns) for columns in zip(*wheels, strict=True))
        seen = np.vstack([np.floor(angles / encoder.tick), counts])
        measured = np.diff(seen, axis=0) * encoder.tick / sample_period
        runs.append(DrivenRun(true, measured, counts * encoder.tick, voltages))
        angles = true[-1]
    return runs
