"""Steering: angles that are measured with a wrong gain, play, lag or zero, and gears that turn the wheel along.

A driven wheel whose rate is measured and that steers has two signals, in which an offset of its angle is a change of
the matrix (wheels.py). The wheels of a car that only steer have one, in which an offset is none beyond small angles.
"""

from __future__ import annotations

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import ActuatorEffect, MotionEffect, Parameter, Values
from omnibench.robot.kinematics import Array, CarDrive, Robot
from omnibench.robot.signals import Signals, needed

_KALLASI = (
    "F. Kallasi, D. Lodi Rizzini, F. Oleari, M. Magnani and S. Caselli, A novel calibration method for industrial "
    "AGVs, 2017"
)


class _SteeringEffect(MotionEffect):
    """An effect on the steering angles, the same for all of a robot's."""

    stage = "steering"
    only_for = "robots with a measured steering angle"

    def applies(self, robot: Robot) -> bool:
        return bool(robot.drive.steered)


@effects.register("steering_gain")
class SteeringGain(_SteeringEffect):
    """Wheels steer by more than is measured, by a factor: phi (1 + g)."""

    physics = "The ratio of the gear between the angle's encoder and the wheel, or of a linkage, is off."
    source = _KALLASI
    shows_in = "steering angle"
    fixed_parameters = (Parameter("g", "1", -0.1, 0.1, "by how much the true angle is larger"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["g"] * needed(signals.steering)


@effects.register("steering_play")
class SteeringPlay(_SteeringEffect):
    """Wheels stay behind when the steering turns back: phi - b s, s the side of the play, from -1 to 1.

    The side changes over 20 mrad of the measured angle, and is not known (0) until the first turn of a run.
    """

    physics = "Gear and linkage have play between the angle's encoder and the wheel, and the floor holds the wheel."
    source = "M. A. Krasnosel'skii and A. V. Pokrovskii, Systems with Hysteresis, 1989 (play operator)"
    shows_in = "steering angle"
    needs = frozenset({"steering_side"})
    fixed_parameters = (Parameter("b", "rad", 0.0, 0.04, "half of the play"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return -values["b"] * needed(signals.steering_side)


@effects.register("steering_lag")
class SteeringLag(_SteeringEffect):
    """Wheels follow the measured angle late: phi - tau d(phi)/dt; before it, where the angle is reported late."""

    physics = "A linkage gives way under the torque that turns a wheel on the floor; or a bus delays the angle."
    source = "first principles"
    shows_in = "steering angle"
    fixed_parameters = (Parameter("tau", "s", -0.2, 0.2, "time by which the wheel follows the measured angle"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return -values["tau"] * needed(signals.steering_rates)


@effects.register("steering_offset")
class SteeringOffset(_SteeringEffect):
    """The wheels of a car do not point straight ahead where the measured angle is 0: phi + c."""

    physics = "The zero of the steering was set by eye, or a linkage was bent or put together anew."
    source = _KALLASI
    shows_in = "steering angle"
    only_for = "cars: on a driven wheel that steers, the matrix holds the offset"
    fixed_parameters = (Parameter("c", "rad", -0.05, 0.05, "true angle where 0 is measured"),)

    def applies(self, robot: Robot) -> bool:
        return isinstance(robot.drive, CarDrive)

    def correction(self, signals: Signals, values: Values) -> Array:
        return np.full(needed(signals.steering).shape, values["c"])


@effects.register("steering_coupling")
class SteeringCoupling(MotionEffect):
    """Turning a module about its steering axis turns its drive encoder as well: omega + k d(phi)/dt."""

    stage = "wheel"
    physics = "The motor drives the wheel by a gear that runs round the steering axis, and rolls on it when it steers."
    source = "CTRE Phoenix 6, SwerveModuleConstants.CouplingGearRatio"
    shows_in = "steering angle"
    only_for = "robots with a driven wheel that steers"
    fixed_parameters = (
        Parameter("k", "1", -0.5, 0.5, "turn of the wheel per turn of the module that is not measured"),
    )

    def applies(self, robot: Robot) -> bool:
        return any(pair >= 0 for pair in robot.drive.pairs)

    def correction(self, signals: Signals, values: Values) -> Array:
        pairs = np.array(signals.robot.drive.pairs)
        return np.where(pairs < 0, 0.0, values["k"] * needed(signals.steering_rates)[:, pairs])


@effects.register("motor_lag")
class MotorLag(ActuatorEffect):
    """Wheels follow their targets with a first-order lag."""

    physics = "Inertia and a controller of finite bandwidth delay what was told."
    source = "first principles"
    shows_in = "acceleration"
    needs = frozenset({"targets"})
    fixed_parameters = (Parameter("tau", "s", 0.0, 0.3, "time constant"),)

    def driven(self, durations: Array, targets: Array, values: Values) -> Array:
        """Means over each sample of the exact solution for targets that are constant within samples."""
        tau = values["tau"]
        if tau <= 0:
            return targets.copy()
        from scipy.linalg.lapack import dtbtrs  # slow to import, and not needed by a live node

        # Rates (F, N) at the beginning of each sample; remaining (F,): share of the distance to the target after one.
        remaining = np.exp(-durations / tau)
        begins = np.zeros(targets.shape)
        if len(targets) > 1:
            bands = np.ones((2, len(targets) - 1))
            bands[1, :-1] = -remaining[1:-1]
            begins[1:] = dtbtrs(bands, (1 - remaining[:-1, None]) * targets[:-1], uplo="L")[0]
        mean_remaining = (-np.expm1(-durations / tau) * tau / durations)[:, None]
        return targets + (begins - targets) * mean_remaining


@effects.register("motor_dead_band")
class MotorDeadBand(ActuatorEffect):
    """Targets below a threshold do not move a wheel, and larger ones are reduced by it."""

    physics = "Static friction takes a part of what drives the motor."
    source = "H. Olsson et al., Friction models and friction compensation, 1998"
    shows_in = "wheel rate"
    needs = frozenset({"targets"})
    fixed_parameters = (Parameter("band", "rad/s", 0.0, 0.1, "half the width of the dead band"),)

    def driven(self, durations: Array, targets: Array, values: Values) -> Array:  # noqa: ARG002
        return np.sign(targets) * np.maximum(np.abs(targets) - values["band"], 0.0)


@effects.register("motor_gain")
class MotorGain(ActuatorEffect):
    """Wheels turn faster or slower than they were told, by a factor."""

    physics = "The controller's scale of counts per turn, or its supply, is off."
    source = "first principles"
    shows_in = "wheel rate"
    needs = frozenset({"targets"})
    fixed_parameters = (Parameter("g", "1", -0.05, 0.05, "by how much wheels turn faster than they were told"),)

    def driven(self, durations: Array, targets: Array, values: Values) -> Array:  # noqa: ARG002
        return (1 + values["g"]) * targets
