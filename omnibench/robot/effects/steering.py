"""Effects of steering: gears, linkages and servos between the angle that is recorded and the one of the wheels.

A driven wheel whose rate is measured and that steers has two signals, in which an offset of its angle is a change of
the matrix. The wheels of a car that only steer have one, in which an offset is none beyond small angles.

The recorded angle of a car or a tricycle is often the command that its steering servo was given. With u the command
and y the wheel's angle, a servo follows by a first-order lag, or at a limited rate,

    dy/dt = (u - y) / tau,        abs(dy/dt) <= R.                                                    (1)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.effects.textbook import WheelEffect
from omnibench.robot.kinematics import Array, CarDrive, Robot, class_of
from omnibench.robot.signals import SERVO_LAGS, SERVO_RATES, Signals, needed

_KALLASI = (
    "F. Kallasi, D. Lodi Rizzini, F. Oleari, M. Magnani and S. Caselli, A novel calibration method for industrial "
    "AGVs, 2017"
)


@effects.register("driven_steering_offset")
class DrivenSteeringOffset(MotionEffect):
    """Driven wheels that steer do not point straight ahead where the measured angle is 0: phi + c_i, for small c_i."""

    stage = "steering"
    physics = "The zero of each angle's encoder was set by eye or by a switch."
    source = "twist = K u: an offset turns the pair omega cos phi, omega sin phi of signals"
    shows_in = "command"
    measurement = "a straight edge along each wheel's side at a measured angle of 0"
    only_for = "robots with a driven wheel that steers"

    def applies(self, robot: Robot) -> bool:
        return any(pair >= 0 for pair in robot.drive.pairs)

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        driven = [robot.drive.steered[pair] for pair in robot.drive.pairs if pair >= 0]
        return tuple(
            Parameter(f"c_{name}", "rad", -0.05, 0.05, f"true angle where 0 is measured, wheel {name}")
            for name in driven
        )

    def correction(self, signals: Signals, values: Values) -> Array:
        offsets = [values.get(f"c_{name}", 0.0) for name in signals.robot.drive.steered]
        return np.tile(offsets, (len(needed(signals.steering)), 1))


def is_steered_by_servo(robot: Robot) -> bool:
    """True for a car or a tricycle, whose steering angle may be what a servo was told, and not measured."""
    return bool(robot.drive.steered) and class_of(robot) in ("car", "tricycle")


class SteeringEffect(MotionEffect):
    """An effect on the steering angles, the same for all of a robot's."""

    stage = "steering"
    only_for = "robots with a measured steering angle"

    def applies(self, robot: Robot) -> bool:
        return bool(robot.drive.steered)


@effects.register("steering_gain")
class SteeringGain(SteeringEffect):
    """Wheels steer by more than is measured, by a factor: phi (1 + g)."""

    physics = "The ratio of the gear between the angle's encoder and the wheel, or of a linkage, is off."
    source = _KALLASI
    shows_in = "steering angle"
    fixed_parameters = (Parameter("g", "1", -0.1, 0.1, "by how much the true angle is larger"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["g"] * needed(signals.steering)


@effects.register("steering_play")
class SteeringPlay(SteeringEffect):
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
class SteeringLag(SteeringEffect):
    """Wheels follow the measured angle late: phi - tau d(phi)/dt; before it, where the angle is reported late."""

    physics = "A linkage gives way under the torque that turns a wheel on the floor; or a bus delays the angle."
    source = "first principles"
    shows_in = "steering angle"
    fixed_parameters = (Parameter("tau", "s", -0.2, 0.2, "time by which the wheel follows the measured angle"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return -values["tau"] * needed(signals.steering_rates)


@effects.register("steering_offset")
class SteeringOffset(SteeringEffect):
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
class SteeringCoupling(WheelEffect):
    """Turning a module about its steering axis turns its drive encoder as well: omega + k d(phi)/dt."""

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


# rad, half-width of the smoothed sign of a steering angle: above the noise of encoders, below a usual offset; chosen
_STRAIGHT = 0.01


@effects.register("steering_side_gain")
class SteeringSideGain(SteeringEffect):
    """Wheels steer farther to one side than to the other: phi + g abs(phi) + c sign(phi).

    The sign is smoothed over 10 mrad about straight ahead.
    """

    physics = "A servo's arm and its linkage are no parallelogram, and push the wheels farther than they pull them."
    source = "R. N. Jazar, Vehicle Dynamics, 2008 (steering mechanisms: four-bar linkages)"
    shows_in = "steering angle"
    form_covariates = ()
    only_for = "cars and tricycles"
    fixed_parameters = (
        Parameter("g", "1", -0.2, 0.2, "half the relative difference between left and right"),
        Parameter("c", "rad", -0.05, 0.05, "by how much the angle is larger on both sides of straight ahead"),
    )

    def applies(self, robot: Robot) -> bool:
        return is_steered_by_servo(robot)

    def correction(self, signals: Signals, values: Values) -> Array:
        angles = needed(signals.steering)
        return values["g"] * np.abs(angles) + values["c"] * np.tanh(angles / _STRAIGHT)


class _ServoEffect(SteeringEffect):
    """Wheels that follow a commanded angle by Eq. (1): phi + share (y - u), with y between those of two servos."""

    shows_in = "steering angle"
    needs = frozenset({"servo_gaps"})
    form_covariates = ()
    only_for = "cars and tricycles"

    def applies(self, robot: Robot) -> bool:
        return is_steered_by_servo(robot)

    def _behind(self, signals: Signals, first: int, kinds: Sequence[float], kind: float) -> Array:
        """y - u (F, S) of the servo of a kind, rad, from the signals of those of ``kinds``, the first of them at 0."""
        gaps = needed(signals.servo_gaps)[..., first : first + len(kinds)]
        weights = [np.interp(kind, kinds, unit) for unit in np.eye(len(kinds))]
        return gaps @ np.array(weights)


@effects.register("servo_lag")
class ServoLag(_ServoEffect):
    """Wheels follow the commanded angle with a first-order lag: phi + share (y - phi), y of Eq. (1) at rest at first.

    For a lag of a few samples behind a measured angle it is steering_lag.
    """

    physics = "A steering servo closes its loop with a finite bandwidth, and the recorded angle is what it was told."
    source = "L. Lyons, T. Niesten and L. Ferranti, DART: a compact platform for autonomous driving research, 2024"
    fixed_parameters = (
        Parameter("share", "1", 0.0, 1.2, "of the lag that acts; 1: all of it"),
        Parameter("tau", "s", SERVO_LAGS[0], SERVO_LAGS[-1], "time constant", SERVO_LAGS),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["share"] * self._behind(signals, 0, SERVO_LAGS, values["tau"])


@effects.register("servo_rate_limit")
class ServoRateLimit(_ServoEffect):
    """Wheels turn to the commanded angle at a limited rate: phi + share (y - phi), y of Eq. (1)."""

    physics = "A steering servo turns no faster than its motor can, however far the commanded angle has jumped."
    source = "M. Althoff, M. Koschi and S. Manzinger, CommonRoad: composable benchmarks for motion planning, 2017"
    fixed_parameters = (
        Parameter("share", "1", 0.0, 1.2, "of the limit that acts; 1: all of it"),
        Parameter("rate", "rad/s", SERVO_RATES[0], SERVO_RATES[-1], "largest rate of the steering angle", SERVO_RATES),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["share"] * self._behind(signals, len(SERVO_LAGS), SERVO_RATES, values["rate"])
