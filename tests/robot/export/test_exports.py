"""Parameters of the controllers of ros2_controllers, held against the controllers' own odometry."""

import math
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
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
    NOISE,
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
from sample_robots import APR_02
from scipy.optimize import minimize
from syrupy.assertion import SnapshotAssertion

from omnibench.errors import ConfigError
from omnibench.robot.calibration import Provenance, covariance_rows, matrix_rows
from omnibench.robot.export import ros2_controllers
from omnibench.robot.export.formats import EXPORT_FORMATS, Export, export_calibration
from omnibench.robot.kinematics import Array, Mount, Robot, Wheel, published_matrix
from omnibench.robot.odometry import Integration, OdometryStream

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
    controller = next(name for name in CONTROLLERS if f"\n{name}:\n" in export.text)
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
    remains = ros2_controllers.RemainingError(
        float(np.linalg.norm(straight[:, :2], 2)),
        float(np.linalg.norm(straight[:, 2])),
        float(np.linalg.norm(turn[:2])),
        float(abs(turn[2])),
    )
    assert f"that leaves up to {remains};" in export.warnings[1]
    assert max(remains.straight_position, remains.straight_heading, remains.turn_position) > 1e-4


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
    calibration(
        APR_02, published_matrix("palacin2023_eq8"), effects=[{"name": "centripetal_slip", "parameters": {"k": 0.1}}]
    ),
    calibration(mounted(DIFF), noise=None, name="of a tracked point"),
    calibration(DIFF, Mount(x=0.03, y=-0.04).twist @ held_matrix("diff"), name="of a point that nobody stated"),
    calibration(Robot(name="o", wheels=TURNED), name="rollers that form an O"),
    calibration(Robot(name="r", wheels=(*DIFF.wheels, ODOMETER)), name="a wheel that the controller does not read"),
]


def test_parameters_come_with_what_they_cannot_hold_and_what_the_robot_needs(snapshot: SnapshotAssertion) -> None:
    assert "\n".join(in_brief(export_calibration(each, "ros2_controllers")) for each in EXPORTED) == snapshot


def robot(*angles_deg: float) -> Robot:
    wheels = (
        Wheel(name="abcdefgh"[index], radius=0.148, distance=0.195, angle=math.radians(angle))
        for index, angle in enumerate(angles_deg)
    )
    return Robot(name="APR-02", wheels=tuple(wheels))


TWO_LEFT = Robot(name="r", wheels=(*DIFF.wheels, fixed("second", 0, 0.1)))
ASIDE = 0.27**0.5  # m
SIDEWAYS = Robot(name="r", wheels=(fixed("a", ASIDE, -0.3, angle_deg=60), fixed("b", -ASIDE, 0.3, angle_deg=60)))
TURNED_ROLLERS = Robot(
    name="r",
    wheels=tuple(wheel.model_copy(update={"roller_angle": math.pi / 4}) for wheel in MECANUM.wheels[:3])
    + MECANUM.wheels[3:],
)


@pytest.mark.parametrize(
    ("robot", "named"),
    [
        (SWERVE, "m0, m1, m2"),
        (TWO_LEFT, "found 2 and 1"),
        (SIDEWAYS, "a, b"),
        (Robot(name="r", wheels=CAR.wheels[1:]), "sl, sr .*rr"),
        (TURNED_ROLLERS, "rollers"),
        (robot(30, 150, 270, 330), r"30 degrees off \(30, 150, 270, 330 deg\)"),
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


# Export formats, and parameters of omni_wheel_drive_controller.


NODE = "omni_wheel_drive_controller"


def exported(machine: Robot) -> Export:
    return export_calibration(calibration(machine), "ros2_controllers")


def controller_twist(values: dict[str, Any], velocities: Array) -> Array:
    """The twist that omni_wheel_drive_controller computes from joint velocities (Odometry::compute_robot_velocity)."""
    count = len(velocities)
    theta = values["wheel_offset"] + 2 * math.pi * np.arange(count) / count
    system = np.column_stack([np.sin(theta), -np.cos(theta), np.full(count, -values["robot_radius"])])
    twist: Array = np.linalg.lstsq(system, velocities * values["wheel_radius"], rcond=None)[0]
    return twist


# Ros2 controllers


@pytest.mark.parametrize(
    "angles", [(60, 180, 300), (300, 60, 180), (60, 300, 180), (-60, 60, 180), (0, 90, 180, 270), (45, 315, 225, 135)]
)
def test_the_controller_drives_a_design_robot_exactly(angles: tuple[float, ...]) -> None:
    machine = robot(*angles)
    values = parameters(exported(machine), NODE)
    names = [name.removeprefix("wheel_").removesuffix("_joint") for name in values["wheel_names"]]
    rates = np.linalg.pinv(machine.inverse_kinematic_matrix) @ [0.3, -0.2, 0.7]
    by_name = dict(zip(machine.wheel_names, -rates, strict=True))  # its positive rate is clockwise
    twist = controller_twist(values, np.array([by_name[name] for name in names]))
    np.testing.assert_allclose(twist, [0.3, -0.2, 0.7], atol=1e-10)
    assert (values["robot_radius"], values["wheel_radius"]) == pytest.approx((0.195, 0.148), abs=1e-11)


def test_no_other_parameters_are_closer_to_a_calibrated_matrix() -> None:
    matrix = published_matrix("palacin2023_eq8")
    values = ros2_controllers.omni_wheel_drive(APR_02, matrix).values
    order = [
        APR_02.wheel_names.index(name.removeprefix("wheel_").removesuffix("_joint")) for name in values["wheel_names"]
    ]

    def distance(vector: Array) -> float:
        return float(np.square(ros2_controllers.omni_wheel_matrix(order, *vector) - matrix).sum())

    start = (0.195, 0.148, math.pi / 3)
    search = minimize(distance, start, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-18})
    found = [values[name] for name in ("robot_radius", "wheel_radius", "wheel_offset")]
    np.testing.assert_allclose(found, search.x, atol=1e-6)
    assert distance(np.array(found)) <= search.fun + 1e-15


def test_a_wheel_that_turns_the_robot_clockwise_keeps_its_sign() -> None:
    inward = [wheel.model_copy(update={"angle": wheel.axle + math.pi}) for wheel in APR_02.wheels]
    places = [wheel.position for wheel in APR_02.wheels]
    b = Wheel(name="b", radius=0.148, type="omni", angle=inward[1].angle, x=places[1][0], y=places[1][1])
    machine = Robot(name="r", wheels=(APR_02.wheels[0], b, APR_02.wheels[2]))
    export = exported(machine)
    assert parameters(export, NODE) == parameters(exported(APR_02), NODE)
    assert "reverse the joints' axes, but not of b" in " | ".join(export.warnings)
    matrix = machine.inverse_kinematic_matrix
    np.testing.assert_allclose(ros2_controllers.omni_wheel_drive(machine, matrix).matrix, matrix, atol=1e-12)


@pytest.mark.parametrize(("robot", "turn"), [(DIFF, "7.20 deg a turn, "), (CAR, "mm and 7.20 deg circle")])
def test_a_controller_without_effects_comes_with_what_a_live_node_gains(robot: Robot, turn: str) -> None:
    matrix = robot.inverse_kinematic_matrix
    fitted = calibration(robot, matrix, plain=matrix_rows(1.02 * matrix), effects=LOST)
    exact = calibration(robot, matrix, plain=matrix_rows(1.02 * matrix), effects=[{**LOST[0], "parameters": {"c": 0}}])
    (gain,) = (warning for warning in export_calibration(exact, "ros2_controllers").warnings if "live node" in warning)
    assert "the matrix was fitted without them: wheel_dead_zone" in gain
    assert "differs by 20.0 mm and 0.00 deg a metre ahead" in gain
    assert turn in gain
    held = driven_by(export_calibration(fitted, "ros2_controllers"), robot, driven_signals(robot))
    np.testing.assert_allclose(
        held, driven_by(export_calibration(exact, "ros2_controllers"), robot, driven_signals(robot))
    )


def test_an_unknown_format_is_refused_with_the_nearest_and_all() -> None:
    known = "c_header, robot_localization, ros2_controllers"
    with pytest.raises(ConfigError, match=rf"'c_heder'; did you mean 'c_header'\? known: {known}"):
        export_calibration(calibration(APR_02), "c_heder")


# Covariances for robot_localization: what the filter makes of them, and what is said of what is not known.

_PLANAR = [0, 1, 5, 6, 7, 11]  # x, y, yaw, vx, vy, vyaw of the filter's 15 states


def filtered_variances(twist: Array, process: Array, period: float, seconds: float) -> Array:
    """Variances (3,) of x, y, yaw after a time by ekf.cpp (2020): P = F P F^T + dt Q, then the velocities measured."""
    covariance, motion = 1e-9 * np.eye(6), np.eye(6)
    motion[:3, 3:] += period * np.eye(3)  # standing, heading 0
    noise = period * process[np.ix_(_PLANAR, _PLANAR)]
    measured = np.eye(6)[3:]
    for _ in range(round(seconds / period)):
        covariance = motion @ covariance @ motion.T + noise
        gain = covariance @ measured.T @ np.linalg.inv(measured @ covariance @ measured.T + np.diag(twist))
        covariance = (np.eye(6) - gain @ measured) @ covariance
    return np.diag(covariance)[:3]


def test_the_filters_pose_grows_by_the_walk_of_the_calibration() -> None:
    export = export_calibration(calibration(DIFF), "robot_localization")
    found = parameters(export, "ekf_filter_node")
    twist = np.array(parameters(export, "diff_drive_controller")["twist_covariance_diagonal"])[[0, 1, 5]]
    process = np.array(found["process_noise_covariance"]).reshape(15, 15)
    grown = filtered_variances(twist, process, 0.02, 11) - filtered_variances(twist, process, 0.02, 1)
    walk = np.square([NOISE.walk_position, NOISE.walk_position, NOISE.walk_heading])
    np.testing.assert_allclose(grown, 10 * walk, rtol=0.02)
    assert [index for index, used in enumerate(found["odom0_config"]) if used] == [6, 7, 11]
    assert found["odom0"] == "/diff_drive_controller/odom"
    assert (found["two_d_mode"], found["odom0_differential"]) == (True, False)


def test_the_robots_centre_walks_with_the_lever_arm_of_the_tracked_point() -> None:
    text = export_calibration(calibration(mounted(DIFF)), "ros2_controllers")
    found = parameters(text, "diff_drive_controller")["pose_covariance_diagonal"]
    position, heading = NOISE.walk_position**2, NOISE.walk_heading**2
    expected = [position + MOUNT.y**2 * heading, position + MOUNT.x**2 * heading, 0, 0, 0, heading]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("robot", "node", "topic"),
    [
        (APR_02, "omni_wheel_drive_controller", "odom"),
        (SKID, "diff_drive_controller", "odom"),
        (MECANUM, "mecanum_drive_controller", "odometry"),
    ],
    ids=["omni", "skid", "mecanum"],
)
def test_the_controller_gets_the_same_covariances(robot: Robot, node: str, topic: str) -> None:
    exports = [export_calibration(calibration(robot), name) for name in ("robot_localization", "ros2_controllers")]
    ours, theirs = (parameters(export, node) for export in exports)
    assert len(ours) == 2
    assert ours.items() <= theirs.items()
    assert parameters(exports[0], "ekf_filter_node")["odom0"] == f"/{node}/{topic}"


def test_a_robot_without_a_controller_gets_the_variances_of_its_messages() -> None:
    text = export_calibration(calibration(SWERVE), "robot_localization").text
    assert "# twist.covariance of the messages: [0] 1.800000e-03, [7] 1.800000e-03 m2/s2, [35] 5.000000e-03" in text
    assert "odom0: /odom\n" in text


def test_the_error_of_the_matrix_is_told_and_not_taken_for_noise() -> None:
    sigma = 1e-5  # of every element, m and rad: of 1/r rad by each wheel for a metre, of 0.2/r rad for a radian
    known = calibration(DIFF, covariance=covariance_rows(sigma**2 * np.eye(6)))
    metre, radian = math.sqrt(2) * sigma / 0.08, 0.2 * math.sqrt(2) * sigma / 0.08
    said = (
        f"{1e3 * math.sqrt(2) * metre:.1f} mm and {math.degrees(metre):.2f} deg a metre, "
        f"{360 * radian:.1f} deg and {2000 * math.pi * math.sqrt(2) * radian:.1f} mm a full turn (1 sigma)"
    )
    export = export_calibration(known, "robot_localization")
    assert any(said in warning for warning in export.warnings)
    unknown = export_calibration(calibration(DIFF), "robot_localization")
    assert any("has no covariance of its matrix" in warning for warning in unknown.warnings)
    node = "diff_drive_controller"
    assert parameters(export, node) == parameters(unknown, node)


def test_a_walk_that_was_not_seen_is_named_and_a_calibration_without_noise_refused() -> None:
    still = NOISE.model_copy(update={"walk_heading": 0.0})
    warnings = export_calibration(calibration(DIFF, noise=still), "robot_localization").warnings
    assert any("no random walk of heading" in warning for warning in warnings)
    with pytest.raises(ConfigError, match="calibration 'diff'"):
        export_calibration(calibration(DIFF, noise=None), "robot_localization")


def test_an_error_of_the_tracked_points_matrix_moves_the_centre_as_a_rigid_body() -> None:
    """With the covariance e e' the matrix errs by e times one number: the deviations are those of that one error."""
    error = 1e-3 * np.random.default_rng(3).standard_normal((3, 2))
    known = calibration(mounted(DIFF), covariance=covariance_rows(np.outer(error, error)))
    deviations = ros2_controllers.matrix_deviations(known, Mount())
    for stated, rates in zip(deviations, ([1 / 0.08, 1 / 0.08], [0.2 / 0.08, -0.2 / 0.08]), strict=True):  # 1 m, 1 rad
        along, aside, turned = error @ rates  # of the tracked point, along its own axes
        ahead = along * math.cos(MOUNT.yaw) - aside * math.sin(MOUNT.yaw) + turned * MOUNT.y
        left = along * math.sin(MOUNT.yaw) + aside * math.cos(MOUNT.yaw) - turned * MOUNT.x
        np.testing.assert_allclose(stated, np.abs([ahead, left, turned]), rtol=1e-9)


# Export of a calibration as a C header, compiled and compared with the stream.

COMPILER = shutil.which("cc") or shutil.which("gcc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler (cc or gcc) on this machine")
START = np.array([1.0, -2.0, 3.0])


PROGRAM = """\
#include <stdio.h>
#include "{header}"

int main(void)
{{
    double pose[3] = {{ 1.0, -2.0, 3.0 }};
    double inputs[{count}];
{state}\
    for (;;) {{
        for (int input = 0; input < {count}; ++input) {{
            if (scanf("%lf", &inputs[input]) != 1) {{
                return input;
            }}
        }}
        {stem}_odometry_step(pose, {arguments}, inputs[{count} - 1]);
        printf("%.17g %.17g %.17g\\n", pose[0], pose[1], pose[2]);
    }}
}}
"""


def run_header(export: Export, folder: Path, stem: str, samples: Array, wheels: int) -> Array:
    """Poses (F, 3) that a program with the header computes from rows of rates, steering angles and duration."""
    steers = samples.shape[1] > wheels + 1
    text = PROGRAM.format(
        header=export.file_name,
        count=samples.shape[1],
        stem=stem,
        state=f"    {stem}_odometry_state state = {{ {{ 0.0 }}, 0 }};\n" if steers else "",
        arguments=f"&state, inputs, inputs + {wheels}" if steers else "inputs",
    )
    (folder / export.file_name).write_text(export.text)
    source, program = folder / "main.c", folder / "main"
    source.write_text(text)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]
    subprocess.run([COMPILER, *flags, str(source), "-o", str(program), "-lm"], check=True, capture_output=True)
    lines = "\n".join(" ".join(repr(float(value)) for value in row) for row in samples)
    done = subprocess.run([str(program)], input=lines, capture_output=True, text=True, check=True)
    return np.array([[float(value) for value in line.split()] for line in done.stdout.splitlines()])


STEERING = [{"name": "steering_gain", "parameters": {"g": 4.8}}, {"name": "steering_offset", "parameters": {"c": 0.02}}]
LOST = [{"name": "wheel_dead_zone", "parameters": {"c": -0.3}}]


@needs_compiler
@pytest.mark.parametrize(
    ("robot", "effects"),
    [(APR_02, []), (TRICYCLE, []), (CAR, []), (SWERVE, []), (CAR, STEERING), (CAR, [*STEERING, *LOST]), (DIFF, LOST)],
    ids=lambda value: str(value)[:16],
)
@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_the_compiled_step_equals_the_stream(
    tmp_path: Path, robot: Robot, effects: list[dict[str, Any]], integration: Integration
) -> None:
    """A fitted gain and zero of the steering, and the rate that wheels lose, are in the header, too."""
    matrix = published_matrix("palacin2023_eq8") if robot is APR_02 else disturbed(robot)
    document = calibration(robot, matrix, integration=integration, effects=effects)
    rng, drive = np.random.default_rng(2), robot.drive
    rates = rng.normal(0, 4, (300, len(drive.wheels)))
    rates[100:130] = 0  # standing still
    rates[130:160] = 1e-3 * (-1.0) ** np.arange(len(drive.wheels))  # hardly turning
    steering = np.cumsum(rng.normal(0, 0.02 / (1 + 5 * bool(effects)), (300, len(drive.steered))), axis=0)
    durations = rng.uniform(0.005, 0.05, 300)
    export = export_calibration(document, "c_header")
    stem = export.file_name.removesuffix("_odometry.h")
    poses = run_header(export, tmp_path, stem, np.column_stack([rates, steering, durations]), len(drive.wheels))
    stream = document.model.stream(START)
    ends = steering if drive.steered else [None] * len(rates)
    expected = [stream.drive(a * d, d, steering=s) for a, s, d in zip(rates, ends, durations, strict=True)]
    np.testing.assert_allclose(poses, expected, rtol=0, atol=1e-12)
    assert drive.direct or all(f"/* {name} */" in export.text for name in drive.names)
    assert "left out" not in " ".join((export.text, *export.warnings))


def test_a_header_says_where_its_matrix_comes_from_and_what_it_leaves_out(snapshot: SnapshotAssertion) -> None:
    origin = Provenance(**ORIGIN | {"dataset_hash": "f00", "training_cost": 0.0215}, simulated=True)
    slip = [{"name": "slip", "parameters": {"k": 0.1}}]
    exported = (
        calibration(APR_02, published_matrix("palacin2023_eq8"), provenance=origin, effects=slip),
        calibration(mounted(DIFF)),
    )
    assert "\n".join(in_brief(export_calibration(each, "c_header")) for each in exported) == snapshot
    assert export_calibration(calibration(APR_02), "c_header").warnings == ()


@needs_compiler
def test_any_number_of_wheels_and_any_name_compiles(tmp_path: Path) -> None:
    origin = Provenance(**ORIGIN | {"dataset": "a */ b"})
    document = calibration(MECANUM, name="4-wheeler: *Größe* */ #1", sample_period=1.0, provenance=origin)
    export = export_calibration(document, "c_header")
    assert export.file_name == "robot_4_wheeler_gr_e_1_odometry.h"
    poses = run_header(export, tmp_path, "robot_4_wheeler_gr_e_1", np.array([[1.0, 2, 3, 4, 0.5]]), 4)
    stream = OdometryStream(MECANUM.inverse_kinematic_matrix, "arc", START)
    np.testing.assert_allclose(poses[0], stream.drive(np.array([0.5, 1, 1.5, 2])), rtol=0, atol=1e-12)


def test_without_its_effects_the_matrix_is_the_one_that_was_fitted_without_them() -> None:
    plain, slip = APR_02.inverse_kinematic_matrix, {"name": "centripetal_slip", "parameters": {"k": 0.1}}
    spread = {"covariance": np.eye(10).tolist(), "driven": [[0.1, 0.0, 0.0]], "plain": matrix_rows(plain)}
    document = calibration(APR_02, 1.1 * plain, effects=[slip], **spread)
    export, of_plain = export_calibration(document, "c_header"), export_calibration(calibration(APR_02), "c_header")
    table = of_plain.text[of_plain.text.index("_matrix[3]") : of_plain.text.index("};")]
    assert table in export.text
    assert "the matrix was fitted without them" in export.warnings[0]
