"""Parameters of the steering controllers of ros2_controllers for cars that come closest to a calibrated matrix.

With the rates l and r of the wheels that do not steer, wheel_radius R, wheelbase L, the track widths B of these wheels
and D of the steered ones, the controllers compute, in the middle of the rear axle,

    tan phi of each steered wheel's  L tan phi_j / (L +- (D / 2) tan phi_j),  + on the left, and phi their mean,
    v = (R / 2) (l / (1 - q) + r / (1 + q)),  q = B tan phi / (2 L),    w = v tan phi / L                 (1)

(steering_kinematics.cpp of steering_controllers_library, 2025 and 2026). If the wheels roll as designed, q is what the
rates differ by, and v = R m, w = (R / L) m tan phi with their mean m: on the signals of a car the matrix has the
elements R and R / L and else zeros, which are the closest parameters. The calibration takes tan phi by the design's
wheelbase L_0; the track widths of the design times L / L_0 make the controller's the same at every angle.
"""

from __future__ import annotations

import math

import numpy as np

from omnibench.errors import ConfigError
from omnibench.robot.export.controller import Controller, Parameter, joint_name, reversed_joints
from omnibench.robot.export.remaining import as_read
from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.wheels.drive import CarDrive

_ALIKE = 1e-3  # m, by which wheels may stand off where the controller has them; chosen


def car(robot: Robot, matrix: Array) -> Controller:
    """The controller closest to a matrix (3, M) of the robot's centre. ConfigError: none can describe this robot."""
    drive = robot.drive
    assert isinstance(drive, CarDrive)
    name, rear, track, front, steering_track = _axles(robot, drive)
    ahead = float(np.mean([along for along, _ in drive.ahead]))
    x, y = np.mean([wheel.position for wheel in robot.measured], axis=0).tolist()
    base = Mount(x=x, y=y)
    reading = np.eye(2, len(drive.names)) * [[1.0], [math.copysign(1.0, ahead)]]
    seen = base.twist @ as_read(robot, matrix, reading)
    radius, turn = float(seen[0, 0]), float(seen[2, 1])
    if radius <= 0 or turn <= 0:
        raise ConfigError(
            "ros2_controllers: the matrix does not drive this robot ahead and turn it counter-clockwise; check the "
            "signs of the wheels and of the steering angles"
        )
    wheelbase = radius / turn
    share = wheelbase / abs(ahead)
    widths = [("traction_track_width", track), ("steering_track_width", steering_track)]
    return Controller(
        name,
        (
            Parameter("traction_joints_names", tuple(map(joint_name, rear)), "right, left" if len(rear) > 1 else ""),
            Parameter(
                "steering_joints_names",
                tuple(f"steering_{wheel}_joint" for wheel in front),
                "right, left" if len(front) > 1 else "",
            ),
            Parameter("wheelbase", wheelbase, "m"),
            *(Parameter(key, width * share, "m") for key, width in widths if width),
            Parameter("traction_wheel_radius" if len(rear) == 1 else "traction_wheels_radius", radius, "m"),
            Parameter("open_loop", "false"),
        ),
        np.diag([radius, 0.0, turn])[:, [0, 2]] @ reading,
        "one wheel radius and one wheelbase",
        "traction_joints_names and steering_joints_names",
        notes=(
            *reversed_joints(list(drive.steered) if ahead < 0 else [], "steering "),
            "the parameters' names are those of ROS 2 Jazzy and later; the wheels are taken to roll as designed",
            "the controller takes the steering angle at a sample's end, the calibration in its middle",
        ),
        base=base,
        topic="odometry",
    )


def _axles(robot: Robot, drive: CarDrive) -> tuple[str, list[str], float, list[str], float]:
    """Controller, wheels of the rear axle from the right and their track width, those that steer and theirs, m."""
    across = [wheel.position[1] for wheel in robot.measured]
    rear = [name for _, name in sorted(zip(across, drive.wheels, strict=True))]
    front = [name for _, name in sorted(zip([y for _, y in drive.ahead], drive.steered, strict=True))]
    name = {
        (2, 2): "ackermann_steering_controller",
        (2, 1): "tricycle_steering_controller",
        (1, 1): "bicycle_steering_controller",
    }.get((len(rear), len(front)))
    along, beside = np.array(drive.ahead).T
    if name is None or np.ptp(along) > _ALIKE or abs(beside.sum()) > _ALIKE:
        raise ConfigError(
            f"ros2_controllers: no controller holds a car that steers by {', '.join(drive.steered)} and measures "
            f"{', '.join(drive.wheels)} there; it needs as many on the left as on the right of them, or one and one in "
            "the middle; use c_header"
        )
    return name, rear, float(np.ptp(across)), front, float(np.ptp(beside))
