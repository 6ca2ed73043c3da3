"""Parameters of the controllers of ros2_controllers, held against the controllers' own odometry."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from export_samples import (
    BICYCLE,
    CAR,
    DIFF,
    FORKLIFT,
    MECANUM,
    MOUNT,
    ODD_DIFF,
    ORIGIN,
    SKID,
    SWERVE,
    TRICYCLE,
    TRIKE,
    calibration,
    disturbed,
    fixed,
    in_brief,
    mecanum,
    mounted,
    parameters,
    steered,
)
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02
from syrupy.assertion import SnapshotAssertion

from omnibench.errors import ConfigError
from omnibench.robot.calibration import Provenance
from omnibench.robot.export.formats import EXPORT_FORMATS, Export, export_calibration
from omnibench.robot.export.ros2_controllers import RemainingError
from omnibench.robot.kinematics import Array, Mount, Robot, published_matrix

Rates = dict[str, Array]  # of joints, rad/s, and angles of steering joints, rad


def diff_drive(values: dict[str, Any], joints: Rates) -> Array:
    """diff_drive_controller: update of diff_drive_controller.cpp and Odometry::update of odometry.cpp, 2026."""
    left, right = (
        np.mean([joints[name] for name in values[f"{side}_wheel_names"]], axis=0)
        * values[f"{side}_wheel_radius_multiplier"]
        * values["wheel_radius"]
        for side in ("left", "right")
    )
    turn = (right - left) / (values["wheel_separation"] * values["wheel_separation_multiplier"])
    return np.column_stack([(left + right) * 0.5, 0 * turn, turn])


def mecanum_drive(values: dict[str, Any], joints: Rates) -> Array:
    """mecanum_drive_controller: Odometry::update of odometry.cpp, 2026."""
    places = ("front_left", "rear_left", "rear_right", "front_right")
    fl, rl, rr, fr = (joints[values[f"{place}_wheel_command_joint_name"]] for place in places)
    quarter = 0.25 * values["kinematics.wheels_radius"]
    along_x, along_y = quarter * (fl + rl + rr + fr), quarter * (-fl + rl - rr + fr)
    turn = quarter / values["kinematics.sum_of_robot_center_projection_on_X_Y_axis"] * (-fl - rl + rr + fr)
    x, y, theta = (values[f"kinematics.base_frame_offset.{key}"] for key in ("x", "y", "theta"))
    cosine, sine = math.cos(-theta), math.sin(-theta)
    lever_x, lever_y = cosine * -x - sine * -y, sine * -x + cosine * -y
    return np.column_stack(
        [cosine * along_x - sine * along_y + lever_y * turn, sine * along_x + cosine * along_y - lever_x * turn, turn]
    )


def tricycle(values: dict[str, Any], joints: Rates) -> Array:
    """tricycle_controller: Odometry::update of odometry.cpp, 2026."""
    speed = joints[values["traction_joint_name"]] * values["wheel_radius"]
    alpha = joints[values["steering_joint_name"]]
    return np.column_stack([speed * np.cos(alpha), 0 * speed, speed * np.sin(alpha) / values["wheelbase"]])


def steering(values: dict[str, Any], joints: Rates) -> Array:
    """The steering controllers: the functions update_from_velocity of steering_kinematics.cpp, 2026."""
    wheelbase = values["wheelbase"]
    traction = [joints[name] for name in values["traction_joints_names"]]
    angles = [joints[name] for name in values["steering_joints_names"]]
    phi = angles[0]
    if len(angles) == 2:
        right, left, half = np.tan(angles[0]), np.tan(angles[1]), values["steering_track_width"] / 2
        phi = 0.5 * (
            np.arctan(wheelbase * right / (wheelbase - half * right))
            + np.arctan(wheelbase * left / (wheelbase + half * left))
        )
    bend = np.tan(phi) / wheelbase  # the source's 1 / turning_radius
    if len(traction) == 1:
        speed = traction[0] * values["traction_wheel_radius"]
    else:
        half, radius = values["traction_track_width"] * 0.5, values["traction_wheels_radius"]
        speed = 0.5 * radius * (traction[0] / (1 + half * bend) + traction[1] / (1 - half * bend))
    return np.column_stack([speed, 0 * speed, bend * speed])


# The odometry of each controller. The snapshot of its parameters was held against those that it documents
# (src/*_parameter.yaml, 2025 and 2026).
CONTROLLERS: dict[str, Callable[[dict[str, Any], Rates], Array]] = {
    "diff_drive_controller": diff_drive,
    "mecanum_drive_controller": mecanum_drive,
    "tricycle_controller": tricycle,
    "ackermann_steering_controller": steering,
    "tricycle_steering_controller": steering,
    "bicycle_steering_controller": steering,
}
# Robots, and the frame in the robot's whose odometry the controller computes.
ROBOTS = {
    "diff": (DIFF, Mount()),
    "odd": (ODD_DIFF, Mount(x=-0.1, y=0.05)),
    "skid": (SKID, Mount()),
    "mecanum": (MECANUM, Mount()),
    "tricycle": (TRICYCLE, Mount()),
    "forklift": (FORKLIFT, Mount()),
    "car": (CAR, Mount(x=-0.15)),
    "trike": (TRIKE, Mount(x=-0.15)),
    "bicycle": (BICYCLE, Mount()),
}


def controller_of(export: Export) -> str:
    return next(name for name in CONTROLLERS if f"\n{name}:\n" in export.text)


def driven_by(export: Export, robot: Robot, signals: Array) -> Array:
    """Twists (F, 3) that the controller computes of drive signals (F, M), joints reversed as the export says."""
    rates, angles = robot.drive.commands(signals)
    reverse = re.findall(r"reverse the axes of the (steering )?joints of (.*)", "\n".join(export.warnings))
    backwards = {(kind, name) for kind, names in reverse for name in names.split(", ")}
    joints = {
        f"{prefix}_{name}_joint": -values if (kind, name) in backwards else values
        for prefix, kind, names, columns in (
            ("wheel", "", robot.drive.wheels, rates.T),
            ("steering", "steering ", robot.drive.steered, angles.T),
        )
        for name, values in zip(names, columns, strict=True)
    }
    controller = controller_of(export)
    return CONTROLLERS[controller](parameters(export, controller), joints)


def driven_signals(robot: Robot, count: int = 20) -> Array:
    """Random signals (F, M) of wheels that roll as designed, always ahead."""
    rng = np.random.default_rng(8)
    along = rng.uniform(-1, 1, (count, len(robot.motions))) + np.eye(len(robot.motions))[0] * 2
    return along @ robot.motions @ robot.signal_equations.T


def car_matrix(robot: Robot, radius: float, wheelbase: float) -> Array:
    """The matrix (3, M) of a car's centre, from the middle of its rear axle, at x = -0.15 m or 0."""
    matrix = np.zeros((3, len(robot.drive.names)))
    matrix[0, 0], matrix[2, 1] = radius, radius / wheelbase
    rear: Array = np.linalg.inv(ROBOTS[robot.name][1].twist) @ matrix
    return rear


def held_matrix(name: str) -> Array:
    """A matrix (3, M) of the robot's centre that its controller holds: that of another robot of the kind."""
    robots = {
        "diff": (fixed("right", 0, -0.21, radius=0.079), fixed("left", 0, 0.21, radius=0.083)),
        "odd": (fixed("l", -0.1, 0.27, radius=0.083), fixed("r", -0.1, -0.17, radius=0.079, angle=math.pi)),
        "skid": tuple(wheel.model_copy(update={"y": 1.6 * (wheel.y or 0)}) for wheel in SKID.wheels),
        "mecanum": tuple(mecanum(w.name, 1.1 * (w.x or 0), 0.9 * (w.y or 0)) for w in MECANUM.wheels),
        "tricycle": (steered("front", 0.83, 0), *TRICYCLE.wheels[1:]),
        "forklift": (steered("back", -0.95, 0), *FORKLIFT.wheels[1:]),
    }
    if name in robots:
        moved = Mount(x=0.01, y=-0.02, yaw=0.03) if name == "mecanum" else None
        other = Robot(name=name, wheels=robots[name], mount=moved, skid=name == "skid")
        return 1.02 * other.inverse_kinematic_matrix
    return car_matrix(ROBOTS[name][0], 0.083, {"car": 0.37, "trike": -0.47, "bicycle": 1.04}[name])


@pytest.mark.parametrize("name", ROBOTS)
def test_a_controller_that_can_hold_a_calibration_computes_its_twist(name: str) -> None:
    robot, base = ROBOTS[name]
    matrix = held_matrix(name)
    export = export_calibration(calibration(mounted(robot), MOUNT.twist @ matrix), "ros2_controllers")
    signals = driven_signals(robot)
    expected = signals @ (base.twist @ matrix).T
    np.testing.assert_allclose(driven_by(export, robot, signals), expected, rtol=0, atol=1e-9)
    assert "that leaves up to 0.0 mm and 0.00 deg a metre, 0.0 deg and 0.0 mm a full turn;" in export.warnings[1]


@pytest.mark.parametrize("name", ROBOTS)
def test_what_is_said_to_remain_is_what_the_controller_computes_wrongly(name: str) -> None:
    robot, base = ROBOTS[name]
    matrix = disturbed(robot)
    export = export_calibration(calibration(mounted(robot), MOUNT.twist @ matrix), "ros2_controllers")
    true, possible = base.twist @ matrix, robot.motions @ robot.signal_equations.T
    coordinates = [0, 1, 2] if name == "mecanum" else [0, 2]  # vx, vy, w of the base frame, as the robot can drive
    units = np.linalg.solve((possible @ true.T)[:, coordinates].T, np.eye(len(coordinates))).T @ possible
    units[1:] += units[0]  # a car cannot turn on the spot
    errors = driven_by(export, robot, units) - units @ true.T
    errors[1:] -= errors[0]
    straight, turn = errors[:-1], errors[-1]
    remains = RemainingError(
        float(np.linalg.norm(straight[:, :2], 2)),
        float(np.linalg.norm(straight[:, 2])),
        float(np.linalg.norm(turn[:2])),
        float(abs(turn[2])),
    )
    assert f"that leaves up to {remains};" in export.warnings[1]
    assert max(remains.straight_position, remains.straight_heading, remains.turn_position) > 1e-4


@given(
    left=st.floats(0.02, 0.3),
    right=st.floats(0.02, 0.3),
    separation=st.floats(0.05, 2),
    wheels=st.sampled_from([DIFF, SKID]),
)
def test_multipliers_give_radii_and_track_back(left: float, right: float, separation: float, wheels: Robot) -> None:
    on_left = np.array([(wheel.y or 0) > 0 for wheel in wheels.wheels])
    radii = np.where(on_left, left, right) * 2 / len(on_left)
    matrix = np.array([radii / 2, 0 * radii, radii / separation * np.where(on_left, -1, 1)])
    found = parameters(export_calibration(calibration(wheels, matrix), "ros2_controllers"), "diff_drive_controller")
    for side, radius in (("left", left), ("right", right)):
        assert found["wheel_radius"] * found[f"{side}_wheel_radius_multiplier"] == pytest.approx(radius, rel=1e-9)
    assert found["wheel_separation"] * found["wheel_separation_multiplier"] == pytest.approx(separation, rel=1e-9)


def test_a_steering_offset_is_told_with_the_parameters_that_go_with_it() -> None:
    offset, signals = math.radians(2), driven_signals(TRICYCLE)
    turned = np.array([[math.cos(offset), -math.sin(offset)], [math.sin(offset), math.cos(offset)]])
    matrix = held_matrix("tricycle") @ turned
    export = export_calibration(calibration(TRICYCLE, matrix), "ros2_controllers")
    note = next(warning for warning in export.warnings if "its zero in the driver" in warning)
    found = re.search(r"with (\S+) deg added .* wheelbase (\S+) and wheel_radius (\S+) would leave 0.0 mm", note)
    degrees, wheelbase, radius = map(float, found.groups())
    rates, angles = TRICYCLE.drive.commands(signals)
    values = {"traction_joint_name": "t", "steering_joint_name": "s", "wheelbase": wheelbase, "wheel_radius": radius}
    twists = tricycle(values, {"t": rates[:, 0], "s": angles[:, 0] + math.radians(degrees)})
    np.testing.assert_allclose(twists, signals @ matrix.T, atol=1e-5)  # six digits are told


TURNED = tuple(wheel.model_copy(update={"roller_angle": -wheel.roller_angle}) for wheel in MECANUM.wheels)
ODOMETER = fixed("odometer", 0, 0.0).model_copy(update={"type": "omni", "angle": 0.0})
EXPORTED = [
    *(calibration(robot, integration="euler") for robot, _ in ROBOTS.values()),
    calibration(APR_02, published_matrix("palacin2023_eq8"), effects=[{"name": "slip", "parameters": {"k": 0.1}}]),
    calibration(mounted(DIFF), noise=None, name="of a tracked point"),
    calibration(DIFF, Mount(x=0.03, y=-0.04).twist @ held_matrix("diff"), name="of a point that nobody stated"),
    calibration(Robot(name="o", wheels=TURNED), name="rollers that form an O"),
    calibration(Robot(name="r", wheels=(*DIFF.wheels, ODOMETER)), name="a wheel that the controller does not read"),
]


def test_parameters_come_with_what_they_cannot_hold_and_what_the_robot_needs(snapshot: SnapshotAssertion) -> None:
    assert "\n".join(in_brief(export_calibration(each, "ros2_controllers")) for each in EXPORTED) == snapshot


TWO_LEFT = Robot(name="r", wheels=(*DIFF.wheels, fixed("second", 0, 0.1)))
SIDEWAYS = Robot(
    name="r", wheels=(fixed("a", 0.27**0.5, -0.3, angle_deg=60), fixed("b", -(0.27**0.5), 0.3, angle_deg=60))
)
TURNED_ROLLERS = Robot(
    name="r",
    wheels=tuple(wheel.model_copy(update={"roller_angle": math.pi / 4}) for wheel in MECANUM.wheels[:3])
    + MECANUM.wheels[3:],
)
ONE_REAR = Robot(name="r", wheels=CAR.wheels[1:])


@pytest.mark.parametrize(
    ("robot", "named"),
    [
        (SWERVE, "m0, m1, m2"),
        (TWO_LEFT, "found 2 and 1"),
        (SIDEWAYS, "a, b"),
        (ONE_REAR, "sl, sr .*rr"),
        (TURNED_ROLLERS, "rollers"),
    ],
)
def test_a_robot_that_no_controller_holds_is_refused(robot: Robot, named: str) -> None:
    with pytest.raises(ConfigError, match=f"^ros2_controllers: .*{named}"):
        export_calibration(calibration(robot), "ros2_controllers")


@pytest.mark.parametrize("robot", [APR_02, DIFF, MECANUM, TRICYCLE, CAR], ids=lambda robot: robot.name)
def test_a_matrix_that_drives_the_wrong_way_is_refused(robot: Robot) -> None:
    with pytest.raises(ConfigError, match="counter-clockwise"):
        export_calibration(calibration(robot, -robot.inverse_kinematic_matrix), "ros2_controllers")


@pytest.mark.parametrize("form", EXPORT_FORMATS)
@pytest.mark.parametrize("simulated", [False, True])
def test_every_export_of_a_simulated_calibration_says_so(form: str, simulated: bool) -> None:
    origin = Provenance(**ORIGIN, simulated=simulated)
    export = export_calibration(calibration(DIFF, provenance=origin), form)
    assert ("simulated" in export.text.splitlines()[0]) == simulated
    assert ("simulated" in " ".join(export.warnings)) == simulated
