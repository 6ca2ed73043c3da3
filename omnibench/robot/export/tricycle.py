"""Parameters of tricycle_controller (ros2_controllers) that come closest to a calibrated matrix.

With the rate omega and the angle alpha of its one driven and steered wheel the controller computes, in the middle of
the axle of the wheels that do not steer,

    v = r omega cos alpha,    w = r omega sin alpha / L,    r = wheel_radius, L = wheelbase             (1)

(odometry.cpp of the package, 2022 to 2026). On the signals (omega cos alpha, omega sin alpha) its matrix has the
elements r and r / L and else zeros, which are the closest parameters. It has no offset of the steering angle: if the
wheel stands at alpha + beta, the columns of row 1 are r (cos beta, -sin beta) and those of row 3 (r / L) (sin beta,
cos beta), so that z1 = k_11 - i k_12 and z3 = k_32 + i k_31 have the phase beta. Where the joint's zero can be turned,
the offset that makes (Re z1 e^(-i beta))^2 + (L Re z3 e^(-i beta))^2 largest comes closest.          (2)
"""

from __future__ import annotations

import cmath
import math

import numpy as np

from omnibench.errors import ConfigError
from omnibench.robot.export.controller import Controller, Parameter, joint_name, reversed_joints
from omnibench.robot.export.remaining import as_read, driven_motions, remaining_error
from omnibench.robot.kinematics import Array, Mount, Robot

_NEGLIGIBLE = math.radians(0.01)  # rad per m, of straight driving; chosen
_WORTH_IT = 0.5  # of the heading error in straight driving: an offset that leaves more is not noted; chosen


def tricycle(robot: Robot, matrix: Array) -> Controller:
    """The controller closest to a matrix (3, M) of the robot's centre. ConfigError: it cannot describe this robot."""
    name, base, wheelbase = _steered(robot)
    forward = math.copysign(1.0, wheelbase)
    signals = robot.drive.names
    reading = np.zeros((2, len(signals)))
    reading[0, signals.index(f"{name}_cos")], reading[1, signals.index(f"{name}_sin")] = 1.0, forward
    seen = base.twist @ as_read(robot, matrix, reading)
    radius, turn = float(seen[0, 0]), float(seen[2, 1])
    if radius <= 0 or turn <= 0:
        raise ConfigError(
            "ros2_controllers: the matrix does not drive this robot ahead and turn it counter-clockwise; check the "
            "signs of the wheel and of its steering angle"
        )
    offset = _offset(robot, seen, reading, base, abs(wheelbase))
    unread = [wheel for wheel in robot.wheel_names if wheel != name]
    return Controller(
        "tricycle_controller",
        (
            Parameter("traction_joint_name", joint_name(name)),
            Parameter("steering_joint_name", f"steering_{name}_joint"),
            Parameter("wheelbase", radius / turn, "m"),
            Parameter("wheel_radius", radius, "m"),
            Parameter("open_loop", "false"),
        ),
        _held(radius, turn, 0.0) @ reading,
        "one wheel radius and one wheelbase",
        "traction_joint_name and steering_joint_name",
        notes=(
            *reversed_joints([name] if forward < 0 else [], "steering "),
            *offset,
            *([f"the controller does not read {', '.join(unread)}"] if unread else []),
            "the controller takes the steering angle at a sample's end, the calibration in its middle",
        ),
        base=base,
        lever=not offset,
    )


def _steered(robot: Robot) -> tuple[str, Mount, float]:
    """The steered wheel, the base frame in the middle of the axle, and the wheel's distance ahead of it, m."""
    steered = [wheel for wheel in robot.measured if wheel.has_steering]
    if len(robot.motions) == 3 or len(steered) > 1:
        names = ", ".join(wheel.name for wheel in steered)
        raise ConfigError(
            "ros2_controllers: no released controller of ros2_controllers holds this robot, which drives by the "
            f"steered wheels {names}; c_header does"
        )
    wheel = steered[0]
    x, y = wheel.position
    motions, _ = driven_motions(robot)
    base = Mount(x=-float(motions[-1, 1]), y=y)
    return wheel.name, base, x - base.x


def _held(radius: float, turn: float, offset: float) -> Array:
    """The controller's matrix (3, 2), Eq. (1), if the wheel's angle is larger by an offset, rad."""
    cosine, sine = math.cos(offset), math.sin(offset)
    return np.array([[radius * cosine, -radius * sine], [0.0, 0.0], [turn * sine, turn * cosine]])


def _offset(robot: Robot, seen: Array, reading: Array, base: Mount, wheelbase: float) -> tuple[str, ...]:
    """The note on a steering offset, Eq. (2), that would leave less; none for none."""
    ahead, turning = complex(seen[0, 0], -seen[0, 1]), complex(seen[2, 1], seen[2, 0])
    offset = cmath.phase(ahead**2 + (wheelbase * turning) ** 2) / 2
    back = cmath.exp(-1j * offset)
    radius, turn = (ahead * back).real, (turning * back).real
    before, left = (
        remaining_error(robot, held @ reading, seen @ reading, base)
        for held in (_held(seen[0, 0], seen[2, 1], 0.0), _held(radius, turn, offset))
    )
    if before.straight_heading < _NEGLIGIBLE or left.straight_heading > _WORTH_IT * before.straight_heading:
        return ()
    return (
        f"with {math.degrees(offset):+.3f} deg added to the angle of the steering joint (its zero in the driver), "
        f"wheelbase {radius / turn:.6f} and wheel_radius {radius:.6f} would leave {left}",
    )
