"""Effects that a change of the matrix reproduces exactly, so that no recording of wheels and poses identifies them."""

from __future__ import annotations

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, ReferenceEffect, Values
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex
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
