"""Wheels driven by motors under PID control: true motion of the wheels, and what their encoders measure.

Each motor moves its own share of the robot's inertia, independently of the other wheels. Wheel angles are continuous
within a session; between its runs the robot stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.errors import ConfigError
from omnibench.robot.kinematics import Array
from omnibench.simulate.chain.motor_loop import MotorSteps, Pid, drive_wheel, motor_steps
from omnibench.simulate.chain.motors import TRUE_STEP, Controller, Encoder, Motor, motors_of_wheels


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
    motor: Motor | Sequence[Motor],
    controller: Controller,
    encoder: Encoder,
    targets: Sequence[Array],
    sample_period: float,
    start_angles: Array,
) -> list[DrivenRun]:
    """The runs of a session, each from rest at the wheel angles where the one before has ended.

    motor: one for all wheels, or one for each. targets: rates of each run (F, N), rad/s. start_angles: (N,), rad.
    ConfigError: a sample period that is not a whole number of milliseconds, or not as many motors as wheels.
    """
    steps = round(sample_period / TRUE_STEP)
    if steps < 1 or abs(sample_period - steps * TRUE_STEP) > 1e-9:
        raise ConfigError(f"sample_period {sample_period:g} s: the motors need a whole number of milliseconds")
    drives = [(_steps_of(each), _pid_of(controller, each)) for each in motors_of_wheels(motor, len(start_angles))]
    angles, runs = np.asarray(start_angles, float), []
    for rates in targets:
        wheels = [
            drive_wheel(*drive, encoder.tick, wheel_rates, angle, steps)
            for drive, wheel_rates, angle in zip(drives, rates.T, angles, strict=True)
        ]
        true, counts, voltages = (np.column_stack(columns) for columns in zip(*wheels, strict=True))
        seen = np.vstack([np.floor(angles / encoder.tick), counts])
        measured = np.diff(seen, axis=0) * encoder.tick / sample_period
        runs.append(DrivenRun(true, measured, counts * encoder.tick, voltages))
        angles = true[-1]
    return runs


def _steps_of(motor: Motor) -> MotorSteps:
    return motor_steps(
        motor.resistance,
        motor.inductance,
        motor.wheel_torque_constant,
        motor.inertia,
        motor.static_friction,
        motor.coulomb_friction,
        motor.viscous_friction,
    )


def _pid_of(controller: Controller, motor: Motor) -> Pid:
    return Pid(controller.proportional, controller.integral, controller.derivative, motor.supply_voltage)
