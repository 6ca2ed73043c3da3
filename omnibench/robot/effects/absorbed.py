"""Effects that a change of the matrix reproduces exactly, so that no recording of wheels and poses identifies them."""

from __future__ import annotations

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, ReferenceEffect, Values
from omnibench.robot.effects.per_wheel import of_wheels, one_for_each_wheel
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Complex
from omnibench.robot.robot_class import class_of
from omnibench.robot.signals import Signals

_CENSI = (
    "A. Censi, A. Franchi, L. Marchionni and G. Oriolo, Simultaneous calibration of odometry and sensor parameters "
    "for mobile robots, 2013"
)


def _about_the_start(poses: Array, start: Array, factor: complex) -> Array:
    """Poses (K, 3) whose positions are turned and stretched about the start by a complex factor."""
    path = ((poses[:, 0] - start[0]) + 1j * (poses[:, 1] - start[1])) * factor
    return np.column_stack([start[0] + path.real, start[1] + path.imag, poses[:, 2]])


@effects.register("lidar_lever_arm")
class LidarLeverArm(ReferenceEffect):
    """The reference tracks another point than the robot's centre: p + (R(theta) - R(theta_0)) l."""

    physics = "The LIDAR stands somewhere else on the robot than its mounting says."
    source = _CENSI
    shows_in = "command"
    measurement = "a ruler: how far forward and to the left of the robot's centre the LIDAR stands"
    fixed_parameters = (
        Parameter("x", "m", -0.05, 0.05, "where the tracked point stands, forward of the centre"),
        Parameter("y", "m", -0.05, 0.05, "where the tracked point stands, to the left of the centre"),
    )

    def reported(self, poses: Array, start: Array, values: Values) -> Array:
        return _shifted(poses, _arm(poses, start, values))

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:
        return _shifted(poses, -_arm(poses, start, values))


def _arm(poses: Array, start: Array, values: Values) -> Complex:
    """Displacement of the tracked point by the arm's rotation since the start: x + iy (K,), m."""
    arm: Complex = (np.exp(1j * poses[:, 2]) - np.exp(1j * start[2])) * complex(values["x"], values["y"])
    return arm


def _shifted(poses: Array, shift: Complex) -> Array:
    """Poses (K, 3) with positions displaced by x + iy (K,), m."""
    return np.column_stack([poses[:, 0] + shift.real, poses[:, 1] + shift.imag, poses[:, 2]])


@effects.register("lidar_yaw")
class LidarYaw(ReferenceEffect):
    """The reference's forward is not the robot's: R(beta) v."""

    physics = "The LIDAR is mounted at another angle than its mounting says."
    source = _CENSI
    shows_in = "command"
    measurement = "a wall: drive along it and see by which angle the scan of it is turned"
    fixed_parameters = (Parameter("beta", "rad", -0.035, 0.035, "by how much the reported path is turned"),)

    def reported(self, poses: Array, start: Array, values: Values) -> Array:
        return _about_the_start(poses, start, complex(np.exp(1j * values["beta"])))

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:
        return _about_the_start(poses, start, complex(np.exp(-1j * values["beta"])))


@effects.register("reference_scale")
class ReferenceScale(ReferenceEffect):
    """The reference's metre is not a metre: p (1 + s), from the start on."""

    physics = "The LIDAR's range is off by a factor, and the map with it."
    source = "first principles"
    shows_in = "command"
    measurement = "a tape: the length of a wall or of a driven way against the map's"
    fixed_parameters = (Parameter("s", "1", -0.01, 0.01, "by how much lengths are reported too long"),)

    def reported(self, poses: Array, start: Array, values: Values) -> Array:
        return _about_the_start(poses, start, 1 + values["s"])

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:
        return _about_the_start(poses, start, 1 / (1 + values["s"]))


@effects.register("sample_period_scale")
class SamplePeriodScale(MotionEffect):
    """Wheel rates are wrong by a factor while their stamps are right: omega (1 + s)."""

    stage = "clock"
    physics = "The controller divides encoder counts by a sample period that it does not keep."
    source = "first principles"
    shows_in = "command"
    measurement = "a time stamp of every sample: their mean distance against the nominal period"
    fixed_parameters = (Parameter("s", "1", -0.01, 0.01, "by how much the true rates are higher"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["s"] * signals.rates


@effects.register("wheel_radius")
class WheelRadius(MotionEffect):
    """Wheels are larger or smaller than stated: omega (1 + k_i)."""

    stage = "wheel"
    physics = "Treads are worn, pumped up or pressed flat, and no two wheels are alike."
    source = (
        "J. Borenstein and L. Feng, Measurement and correction of systematic odometry errors in mobile robots, 1996 "
        "(unequal wheel diameters)"
    )
    shows_in = "command"
    measurement = "a tape: the way that each wheel rolls in ten turns under load"
    only_for = "differential and skid-steered robots, tricycles and swerve drives"

    def applies(self, robot: Robot) -> bool:
        return class_of(robot) in ("differential", "skid", "tricycle", "swerve")

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        return one_for_each_wheel(robot, "k", "1", -0.05, 0.05, "by how much the radius is larger")

    def correction(self, signals: Signals, values: Values) -> Array:
        return of_wheels(signals.robot, "k", values) * signals.rates


@effects.register("wheel_position")
class WheelPosition(MotionEffect):
    """Fixed wheels stand farther out than stated: omega + y_i w / r to the left, in the direction of rolling ahead."""

    stage = "wheel"
    physics = "The track is not the one of the drawing: wheels touch the floor at another place of their width."
    source = (
        "J. Borenstein and L. Feng, Measurement and correction of systematic odometry errors in mobile robots, 1996 "
        "(uncertainty about the effective wheelbase)"
    )
    shows_in = "command"
    measurement = "a ruler from wheel to wheel, or better: ten turns on the spot against a mark on the floor"
    only_for = "differential and skid-steered robots"

    def applies(self, robot: Robot) -> bool:
        return class_of(robot) in ("differential", "skid")

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        return one_for_each_wheel(robot, "y", "m", -0.02, 0.02, "by how much farther to the left it stands")

    def correction(self, signals: Signals, values: Values) -> Array:
        robot = signals.robot
        along = np.cos([wheel.rolling for wheel in robot.measured])
        return of_wheels(robot, "y", values) * along / robot.radii * signals.twists[:, 2:]


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
        return tuple(
            Parameter(f"c_{name}", "rad", -0.05, 0.05, f"true angle where 0 is measured, wheel {name}")
            for name in _driven_and_steered(robot)
        )

    def correction(self, signals: Signals, values: Values) -> Array:
        assert signals.steering is not None  # the robot steers
        offsets = [values.get(f"c_{name}", 0.0) for name in signals.robot.drive.steered]
        return np.tile(offsets, (len(signals.steering), 1))


def _driven_and_steered(robot: Robot) -> tuple[str, ...]:
    """Names of the wheels of which both rate and steering angle are measured."""
    return tuple(robot.drive.steered[pair] for pair in robot.drive.pairs if pair >= 0)
