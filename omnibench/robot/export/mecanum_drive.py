"""Parameters of mecanum_drive_controller (ros2_controllers) that come closest to a calibrated matrix.

With the rates f, g, h and j of the front left, rear left, rear right and front right wheel, and

    a = (f + g + h + j) / 4,    b = (-f + g - h + j) / 4,    c = (-f - g + h + j) / 4,                (1)

the controller has the twist (r a, r b, (r / k) c) of the wheels' centre, r = kinematics.wheels_radius and k =
kinematics.sum_of_robot_center_projection_on_X_Y_axis, and makes of it that of its base frame, whose pose in the wheels'
centre is kinematics.base_frame_offset (x, y, theta) (odometry.cpp of the package, 2023 to 2026). As x + iy, the columns
of a, b and c in rows 1 and 2 of its matrix are r e^(-i theta), i r e^(-i theta) and i e^(-i theta) (x + iy) r / k, and
row 3 is (0, 0, r / k): so the closest parameters in the sum of squares are found in closed form.
"""

from __future__ import annotations

import cmath

import numpy as np

from omnibench.errors import ConfigError
from omnibench.robot.export.controller import Controller, Parameter, joint_name, reversed_joints
from omnibench.robot.export.remaining import as_read
from omnibench.robot.kinematics import Array, Mount, Robot

# Of the wheels in the controller's order: signs in a, b and c of Eq. (1).
_SLOTS = {
    "front_left": (1, -1, -1),
    "rear_left": (1, 1, -1),
    "rear_right": (1, -1, 1),
    "front_right": (1, 1, 1),
}


def mecanum_drive(robot: Robot, matrix: Array) -> Controller:
    """The controller closest to a matrix (3, N) of the robot's centre. ConfigError: it cannot describe this robot."""
    wheels, signs = _slots(robot)
    reading = np.zeros((3, len(robot.measured)))
    for slot, index in wheels.items():
        reading[:, index] = signs[index] * np.array(_SLOTS[slot]) / 4
    seen = as_read(robot, matrix, reading)
    a, b, c = (seen[0] + 1j * seen[1]).tolist()
    along, turn = (a - 1j * b) / 2, float(seen[2, 2])
    if turn <= 0 or not along:
        raise ConfigError("ros2_controllers: the matrix does not turn this robot counter-clockwise; check wheel signs")
    radius, theta = abs(along), -cmath.phase(along)
    offset = c / (1j * cmath.exp(-1j * theta) * turn)
    twist = Mount(x=offset.real, y=offset.imag, yaw=theta).twist
    names = {slot: joint_name(robot.wheel_names[index]) for slot, index in wheels.items()}
    return Controller(
        "mecanum_drive_controller",
        (
            *(Parameter(f"{slot}_wheel_command_joint_name", name) for slot, name in names.items()),
            Parameter("kinematics.base_frame_offset.x", offset.real, "m"),
            Parameter("kinematics.base_frame_offset.y", offset.imag, "m"),
            Parameter("kinematics.base_frame_offset.theta", theta, "rad"),
            Parameter("kinematics.wheels_radius", radius, "m"),
            Parameter("kinematics.sum_of_robot_center_projection_on_X_Y_axis", radius / turn, "m"),
        ),
        twist @ np.diag([radius, radius, turn]) @ reading,
        "one wheel radius, one sum of distances and one pose of the base frame",
        "joint names",
        notes=(
            *reversed_joints([name for name, sign in zip(robot.wheel_names, signs, strict=True) if sign < 0]),
            *_elsewhere(robot, wheels),
        ),
        integration="every step along the heading at its end",
        topic="odometry",
    )


def _elsewhere(robot: Robot, wheels: dict[str, int]) -> tuple[str, ...]:
    """The note on wheels that do not stand where the controller's names say; none for none."""
    wrong = []
    for slot, index in wheels.items():
        wheel = robot.measured[index]
        x, y = wheel.position
        if wheel.x is not None and (x > 0, y > 0) != (slot.startswith("front"), slot.endswith("left")):
            wrong.append(f"{slot} is {wheel.name}")
    return (f"the rollers form an O seen from above, so that {', '.join(wrong)}",) if wrong else ()


def _slots(robot: Robot) -> tuple[dict[str, int], list[float]]:
    """The wheel (index) in each place of the controller, and the sign (N,) of each wheel's rate driving forward."""
    equations = robot.signal_equations
    signs = np.sign(equations[:, 0])
    found = {}
    for index, (sign, row) in enumerate(zip(signs, equations, strict=True)):
        place = next((slot for slot, pattern in _SLOTS.items() if (sign * np.sign(row) == pattern).all()), None)
        if place is not None and robot.measured[index].kind == "mecanum":
            found[place] = index
    if len(found) < 4 or len(robot.measured) > 4:
        raise ConfigError(
            "ros2_controllers: mecanum_drive_controller needs one mecanum wheel in each corner, with rollers that form "
            f"an X or an O seen from above; {', '.join(robot.wheel_names)} do not; check roller angles, or use c_header"
        )
    return {slot: found[slot] for slot in _SLOTS}, signs.tolist()
