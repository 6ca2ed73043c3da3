"""From wheels of any kind to the inverse kinematic matrix and drive signals, and robots that cannot be."""

from __future__ import annotations

import math
from typing import Any

import config_robots
import numpy as np
import pytest
import yaml
from commands import refused
from hypothesis import assume, given
from hypothesis import strategies as st
from sample_robots import APR_02, CAR, DIFFERENTIAL, SKID, SWERVE, TRICYCLE, WHEELED, fixed, steered

from omnibench.config import read_model, to_yaml, validate
from omnibench.errors import ConfigError
from omnibench.robot.kinematics import (
    Array,
    Mount,
    Robot,
    Wheel,
    class_of,
    inverse_kinematic_matrices,
    inverse_kinematic_matrix,
    wheel_equations,
)
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog

# Eq. (7) of the article, as printed.
EQ_7 = np.array(
    [
        [-0.0854478398400646, 0.0000000000000000, 0.0854478398400646],
        [0.04933333333333333, -0.09866666666666667, 0.04933333333333333],
        [0.2529914529914529, 0.2529914529914529, 0.2529914529914529],
    ]
)


def a_wheel(name: str, roller_angle: st.SearchStrategy[float]) -> st.SearchStrategy[Wheel]:
    return st.builds(
        Wheel,
        name=st.just(name),
        radius=st.floats(0.02, 0.5),
        distance=st.floats(0.05, 1.5),
        angle=st.floats(-math.pi, math.pi),
        roller_angle=roller_angle,
    )


def wheels_of(count: int, roller_angle: st.SearchStrategy[float]) -> st.SearchStrategy[tuple[Wheel, ...]]:
    return st.tuples(*(a_wheel(f"w{index}", roller_angle) for index in range(count)))


three_omni_wheels = wheels_of(3, st.just(0.0))
many_wheels = st.integers(4, 8).flatmap(lambda count: wheels_of(count, st.floats(-1.0, 1.0)))


def condition(equations: Array) -> float:
    return float(np.linalg.cond(equations))


def test_the_design_values_give_every_element_of_eq_7_and_m12_is_exactly_zero() -> None:
    matrix = inverse_kinematic_matrix(APR_02.wheels)
    np.testing.assert_allclose(matrix, EQ_7, rtol=0, atol=1e-15)
    assert matrix[0, 1] == 0.0  # so that the paper's box freezes it


@given(wheels=three_omni_wheels)
def test_eq_3_is_the_inverse_and_the_pseudo_inverse_of_the_wheel_equations(wheels: tuple[Wheel, ...]) -> None:
    equations = wheel_equations(wheels)
    assume(condition(equations) < 1e4)
    matrix, expected = inverse_kinematic_matrix(wheels), np.linalg.pinv(equations)
    np.testing.assert_allclose(matrix @ equations, np.eye(3), atol=1e-14 * condition(equations))
    assert np.abs(matrix - expected).max() / np.abs(expected).max() < 1e-14 * condition(equations)


@given(wheels=many_wheels)
def test_the_matrix_of_any_number_of_wheels_gives_the_twist_back(wheels: tuple[Wheel, ...]) -> None:
    equations = wheel_equations(wheels)
    assume(condition(equations) < 1e4)
    product = inverse_kinematic_matrix(wheels) @ equations
    np.testing.assert_allclose(product, np.eye(3), atol=1e-13 * condition(equations))


def test_mecanum_wheels_give_the_matrix_of_the_textbooks() -> None:
    r, lx, ly = 0.05, 0.2, 0.15
    # Front left, front right, rear left, rear right; in textbooks a positive rate drives forward.
    textbook = r / 4 * np.array([[1, 1, 1, 1], [-1, 1, 1, -1], np.array([-1, 1, -1, 1]) / (lx + ly)])
    left, right, rollers = math.pi / 2, -math.pi / 2, math.pi / 4
    wheels = tuple(
        Wheel(name=name, radius=r, distance=lx + ly, angle=angle, roller_angle=roller)
        for name, angle, roller in (
            ("fl", left, rollers),
            ("fr", right, -rollers),
            ("rl", left, -rollers),
            ("rr", right, rollers),
        )
    )
    # Here a positive rate drives counter-clockwise, which is backward on the left.
    np.testing.assert_allclose(inverse_kinematic_matrix(wheels), textbook * [-1, 1, -1, 1], atol=1e-16)


@given(wheels=many_wheels, angle=st.floats(-3, 3))
def test_a_robot_with_turned_wheels_drives_in_the_turned_direction(wheels: tuple[Wheel, ...], angle: float) -> None:
    turned = tuple(wheel.model_copy(update={"angle": wheel.angle + angle}) for wheel in wheels)
    rotation = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    np.testing.assert_allclose(wheel_equations(turned) @ rotation, wheel_equations(wheels), rtol=1e-9, atol=1e-10)


@given(wheels=many_wheels, turn=st.floats(-3, 3))
def test_a_pure_turn_needs_lever_arm_over_radius_of_every_wheel(wheels: tuple[Wheel, ...], turn: float) -> None:
    rates = wheel_equations(wheels) @ [0.0, 0.0, turn]
    np.testing.assert_allclose(rates, [turn * wheel.distance / wheel.radius for wheel in wheels], atol=1e-300)


@pytest.mark.parametrize("rollers", [np.zeros(3), np.zeros(5), np.array([0.7, -0.7, -0.7, 0.7])])
def test_many_geometries_at_once_equal_one_at_a_time(rollers: Array) -> None:
    rng = np.random.default_rng(4)
    shape = (20, len(rollers))
    radius, distance = rng.uniform(0.03, 0.2, shape), rng.uniform(0.1, 0.5, shape)
    angle = 2 * math.pi * np.arange(len(rollers)) / len(rollers) + rng.uniform(-0.1, 0.1, shape)
    together = inverse_kinematic_matrices(radius, distance, angle, rollers)
    alone = [
        inverse_kinematic_matrix(
            tuple(
                Wheel(name=f"w{i}", radius=r, distance=R, angle=d, roller_angle=g)
                for i, (r, R, d, g) in enumerate(zip(*rows, rollers, strict=True))
            )
        )
        for rows in zip(radius, distance, angle, strict=True)
    ]
    np.testing.assert_allclose(together, alone, rtol=1e-12, atol=1e-16)


@pytest.mark.parametrize("wheels", [3, 4])
@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_a_geometry_without_a_matrix_spoils_no_other(wheels: int, value: float) -> None:
    angle = np.tile(2 * math.pi * np.arange(wheels) / wheels, (2, 1))
    radius, distance = np.full((2, wheels), 0.05), np.full((2, wheels), 0.2)
    distance[1] = value  # a robot whose wheels cannot turn it, or nonsense
    radius[1] = 0.05 if value == 0 and wheels == 3 else value
    with np.errstate(all="ignore"):
        bad, good = inverse_kinematic_matrices(radius[::-1], distance[::-1], angle)
    assert not np.isfinite(bad).all()
    assert np.isfinite(good).all()


PLACES = {"fl": (0.2, 0.15), "fr": (0.2, -0.15), "rl": (-0.2, 0.15), "rr": (-0.2, -0.15)}
BY_PLACES = Robot(
    name="mecanum", wheels=[Wheel(name=n, type="mecanum", radius=0.05, x=x, y=y) for n, (x, y) in PLACES.items()]
)


def test_it_is_the_robot_that_lever_arms_and_angles_describe_and_its_file_says_its_rollers() -> None:
    by_angles = config_robots.robot("mecanum").inverse_kinematic_matrix
    # By angles a positive rate turns the robot counter-clockwise, by x and y it drives forward.
    np.testing.assert_allclose(BY_PLACES.inverse_kinematic_matrix, by_angles * [-1, 1, -1, 1], atol=1e-12)
    written = yaml.safe_load(yaml.safe_dump(BY_PLACES.model_dump(mode="json")))
    assert [wheel["roller_angle"] > 0 for wheel in written["wheels"]] == [True, False, False, True]
    assert Robot.model_validate(written) == BY_PLACES


def test_rollers_that_are_given_stay_and_a_wheel_on_an_axis_has_to_say_them() -> None:
    wheel = Wheel(name="fl", type="mecanum", radius=0.05, x=0.2, y=0.15, roller_angle=-math.pi / 4)
    assert wheel.roller_angle == -math.pi / 4
    assert Wheel(name="a", radius=0.05, x=0.2, y=0.15, angle=0.3).kind == "omni"
    with pytest.raises(ConfigError, match="roller_angle"):
        Wheel(name="ahead", type="mecanum", radius=0.05, x=0.2, y=0.0)


EVERY = [pytest.param(robot, id=robot.name) for robot in (APR_02, *WHEELED)]
STEERED = [pytest.param(robot, id=robot.name) for robot in (TRICYCLE, CAR, SWERVE)]
SPEEDS = st.floats(-2.0, 2.0)


def a_robot(*wheels: dict[str, Any], **more: Any) -> Robot:
    """A robot by its document, as files give it. ConfigError in one line."""
    return validate(Robot, {"name": "r", "wheels": wheels, **more}, "robot.yaml")


def velocity(twist: Array, x: float, y: float) -> Array:
    """Velocity (2,) of a point of a rigid body."""
    return np.array([twist[0] - twist[2] * y, twist[1] + twist[2] * x])


@pytest.mark.parametrize("robot", EVERY)
@given(amounts=st.tuples(SPEEDS, SPEEDS, SPEEDS))
def test_signals_of_a_motion_without_sliding_give_it_back(robot: Robot, amounts: tuple[float, float, float]) -> None:
    twist = np.array(amounts[: len(robot.motions)]) @ robot.motions
    back = robot.inverse_kinematic_matrix @ robot.signal_equations @ twist
    np.testing.assert_allclose(back, twist, rtol=0, atol=1e-12)


@pytest.mark.parametrize("robot", STEERED)
@given(amounts=st.tuples(SPEEDS, SPEEDS, SPEEDS))
def test_wheels_that_are_steered_as_commanded_do_not_slide(robot: Robot, amounts: tuple[float, float, float]) -> None:
    twist = np.array(amounts[: len(robot.motions)]) @ robot.motions
    if robot is CAR:  # it needs speed to turn
        twist[0] = math.copysign(max(abs(twist[0]), 0.3 + 0.5 * abs(twist[2])), twist[0])
    rates, steering = robot.drive.commands((robot.signal_equations @ twist)[None])
    angles = dict(zip(robot.drive.steered, steering[0], strict=True))
    of_wheels = dict(zip(robot.wheel_names, rates[0], strict=True))
    for wheel in robot.wheels:
        at_wheel = velocity(twist, *wheel.position)
        angle = angles.get(wheel.name, 0.0)
        along, across = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
        assert across @ at_wheel == pytest.approx(0.0, abs=1e-12)
        if wheel.name in of_wheels and robot is not CAR:
            assert along @ at_wheel == pytest.approx(wheel.radius * of_wheels[wheel.name], abs=1e-12)


@pytest.mark.parametrize("robot", EVERY)
def test_commands_give_the_signals_that_were_asked_for(robot: Robot) -> None:
    rates, steering = robot.drive.commands((robot.motions @ robot.signal_equations.T + 1.0)[:1])
    again = robot.drive.signals(rates, steering)
    np.testing.assert_allclose(again, (robot.motions @ robot.signal_equations.T + 1.0)[:1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("robot", STEERED)
def test_slopes_of_signals_are_their_derivatives(robot: Robot) -> None:
    rng, step = np.random.default_rng(3), 1e-6
    rates = rng.normal(0.0, 5.0, (4, len(robot.wheel_names)))
    steering = rng.normal(0.0, 0.4, (4, len(robot.drive.steered)))
    by_rate, by_angle = robot.drive.slopes(rates, steering)
    for slopes, moved in ((by_rate, 0), (by_angle, 1)):
        for column in range(slopes.shape[2]):
            change = np.zeros(slopes.shape[2])
            change[column] = step
            up, down = ([rates, steering], [rates, steering])
            up[moved], down[moved] = up[moved] + change, down[moved] - change
            found = (robot.drive.signals(*up) - robot.drive.signals(*down)) / (2 * step)
            np.testing.assert_allclose(slopes[..., column], found, rtol=0, atol=1e-8)


TRACK, RADIUS = 0.3, 0.05  # m
TEXTBOOK = [
    (DIFFERENTIAL, [[RADIUS / 2] * 2, [0] * 2, [-RADIUS / TRACK, RADIUS / TRACK]], ("left", "right")),
    (SKID, [[RADIUS / 4] * 4, [0] * 4, [sign * RADIUS / (2 * TRACK) for sign in (-1, 1, -1, 1)]], SKID.wheel_names),
    (TRICYCLE, [[RADIUS, 0], [0, 0], [0, RADIUS / 0.5]], ("front_cos", "front_sin")),
    (CAR, [[RADIUS, 0, 0], [0, 0, 0], [0, RADIUS / 0.5, 0]], ("mean", "mean_tan", "difference")),
]


@pytest.mark.parametrize(("robot", "expected", "signals"), TEXTBOOK, ids=lambda value: getattr(value, "name", ""))
def test_a_robot_has_the_textbook_matrix(robot: Robot, expected: Any, signals: tuple[str, ...]) -> None:
    """A skid base turns by its track on paper, and the difference of a car's rear rates counts for nothing."""
    np.testing.assert_allclose(robot.inverse_kinematic_matrix, expected, rtol=0, atol=1e-15)
    assert tuple(robot.drive.names) == tuple(signals)


def test_a_matrix_is_that_of_the_tracked_point() -> None:
    mount = {"x": 0.4, "y": -0.1, "yaw": 0.3}
    turned = TRICYCLE.model_copy(update={"mount": Mount.model_validate(mount)})
    twist = np.array([0.5, 0.0, 0.7])
    moved = velocity(twist, 0.4, -0.1)
    seen = turned.inverse_kinematic_matrix @ turned.signal_equations @ twist
    cosine, sine = math.cos(0.3), math.sin(0.3)
    expected = [cosine * moved[0] + sine * moved[1], -sine * moved[0] + cosine * moved[1], 0.7]
    np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-12)


def test_the_class_of_a_robot_is_that_of_its_measured_wheels() -> None:
    found = [class_of(robot) for robot in (APR_02, *WHEELED)]
    assert found == ["omni", "differential", "skid", "mecanum", "tricycle", "car", "swerve"]


@pytest.mark.parametrize("robot", EVERY)
def test_a_document_of_a_robot_is_read_back(robot: Robot, tmp_path: Any) -> None:
    (tmp_path / "robot.yaml").write_text(to_yaml(robot))
    assert read_model(Robot, tmp_path / "robot.yaml") == robot


def test_the_document_of_omni_wheels_is_what_it_was_before_there_were_others() -> None:
    assert [list(wheel) for wheel in APR_02.model_dump()["wheels"]] == [
        ["name", "radius", "distance", "angle", "roller_angle"]
    ] * 3
    assert list(APR_02.model_dump()) == ["name", "wheels"]


def test_degrees_may_be_given_under_keys_that_say_so() -> None:
    wheels = [
        {"name": name, "radius": 0.1, "distance": 0.2, "angle_deg": angle}
        for name, angle in zip("abc", (60, 180, 300), strict=True)
    ]
    assert a_robot(*wheels).wheels[1].angle == pytest.approx(math.pi)


def omni(*angles: float, **more: Any) -> list[dict[str, Any]]:
    shared = {"radius": 0.05, "distance": 0.2, **more}
    return [{"name": f"w{index}", "angle": angle, **shared} for index, angle in enumerate(angles)]


def rolling(side: int, name: str) -> dict[str, Any]:
    """A mecanum wheel on the left (1) or right (-1) whose rollers slip ahead."""
    (wheel,) = omni(side * math.pi / 2, roller_angle=side * math.pi / 4)
    return wheel | {"name": name}


FOUR = [fixed("a", 0.2, 0.2), fixed("b", 0.2, -0.2), fixed("c", -0.2, 0.2), fixed("d", -0.2, -0.2)]


LEFT, RIGHT = fixed("a", 0, 0.1), fixed("b", 0, -0.1)
CANNOT_BE: list[tuple[list[dict[str, Any]], str]] = [
    (omni(0, 0, math.pi), "every direction"),
    ([rolling(side, name) for side, name in zip((1, -1, 1, -1), "abcd", strict=True)], "every direction"),
    (omni(0, math.pi / 2), "wheels"),
    (omni(60, 180, 300), "60 cannot be an angle in rad; is it in degrees?"),
    (omni(0, 2, 4, roller_angle=45), "wheels.0.roller_angle"),
    (omni(0, 2, 4, name="a"), "names must differ: a, a, a"),
    (omni(0, 2, 4, name="front left"), "wheels.0.name"),
    (omni(0, 2, 4, radius=0), "wheels.0.radius"),
    (omni(0, 2, 4, radius=math.nan), "wheels.0.radius"),
    (omni(0, 2, 4, distance=-0.2), "wheels.0.distance"),
    (omni(math.inf, 2, 4), "wheels.0.angle"),
    (omni(0, 2, 4, angel=1.0), "did you mean 'angle'?"),
    ([LEFT], "measured: a"),
    (FOUR, "fixed wheels a, b, c, d would have to slide"),
    ([LEFT, RIGHT, fixed("c", -0.2, 0, measured=False)], "fixed wheel c would have to slide"),
    ([LEFT, fixed("b", 0, -0.1, angle=0.3)], "fixed wheels a, b would have to slide"),
    ([LEFT, fixed("b", 0, 0.1)], "signals a, b do not determine"),
    ([LEFT, {"name": "b", "type": "fixed", "radius": 0.1, "x": 0}], "y of a fixed wheel"),
    ([steered("a", 0.5, 0, angle=1.0)], "angle"),
    ([fixed("a", 0, 0.1, roller_angle=0.7)], "rollers"),
    ([fixed("a", 0, 0.1, distance=0.1)], "distance"),
    ([{"name": "a", "type": "mecanum", "radius": 0.1, "x": 0, "y": 1}], "roller_angle"),
    ([{"name": "a", "radius": 0.1, "x": 0.1, "angle": 0}], "y is missing"),
    ([{"name": "a", "radius": 0.1, "distance": 0.1, "x": 0.1, "angle": 0}], "distance and x, y"),
    ([{"name": "a", "radius": 0.1, "distance": 0.1, "angle": 0, "angle_deg": 0}], "angle and angle_deg"),
    ([fixed("a", 0, 0.1, angle=90)], "is it in degrees?"),
    ([fixed("a", 0, 0.1, typ="fixed")], "'type'"),
    ([LEFT, RIGHT, steered("c", 0.0, 0, driven=False)], "steered wheel c"),
    ([LEFT, steered("b", 0.3, 0.1), steered("c", 0.3, -0.1, driven=False)], "measured: false for c"),
]


@pytest.mark.parametrize(("wheels", "words"), CANNOT_BE, ids=[words for _, words in CANNOT_BE])
def test_a_robot_that_cannot_be_is_refused_by_name(wheels: list[dict[str, Any]], words: str) -> None:
    with refused(ConfigError, words, start="robot.yaml: "):
        a_robot(*wheels)


def test_skid_steering_is_said_of_fixed_wheels_only() -> None:
    a_robot(*FOUR, skid=True)
    with pytest.raises(ConfigError, match="skid: true is for fixed wheels; this robot has none"):
        a_robot(*(steered(name, x, 0.1) for name, x in (("a", 0.2), ("b", -0.2))), skid=True)


def test_a_robot_whose_wheels_roll_sideways_moves_along_y() -> None:
    robot = a_robot(*(fixed(name, x, 0.0, angle_deg=90) for name, x in (("a", 0.15), ("b", -0.15))))
    np.testing.assert_allclose(robot.motions, [[0, 1, 0], [0, 0, 1]], rtol=0, atol=1e-12)


def test_a_swerve_base_averages_its_modules() -> None:
    matrix = SWERVE.inverse_kinematic_matrix
    np.testing.assert_allclose(matrix[0, ::2], 0.05 / 4, rtol=0, atol=1e-15)
    np.testing.assert_allclose(matrix[1, 1::2], 0.05 / 4, rtol=0, atol=1e-15)
    assert len(SWERVE.drive.names) == 8


@pytest.mark.parametrize("robot", EVERY)
@given(seed=st.integers(0, 2**32 - 1), integration=st.sampled_from(["euler", "arc"]))
def test_a_stream_drives_as_a_batch(robot: Robot, seed: int, integration: Integration) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 0.1, 40))
    rates = rng.normal(0.0, 5.0, (40, len(robot.wheel_names)))
    steering = rng.normal(0.0, 0.4, (40, len(robot.drive.steered))) if robot.drive.steered else None
    model = OdometryModel.of_design(robot, integration)
    log = WheelLog(times, rates, np.array([1.0, -2.0, 0.5]), times, steering=steering, drive=robot.drive)
    stream = model.stream(log.start)
    for sample, duration in enumerate(np.diff(times, prepend=0.0)):
        stream.drive(rates[sample] * duration, steering=None if steering is None else steering[sample])
    np.testing.assert_allclose(stream.pose, model.poses([log])[0][-1], rtol=0, atol=1e-12)


def test_a_row_of_zeros_has_the_scale_of_the_other_direction_of_driving() -> None:
    """Of a differential drive, radius r and track 2 b: r / 2 ahead and aside, r / 2b for turning."""
    sideways = DIFFERENTIAL.model_copy(update={"mount": Mount(yaw=math.pi / 2)})  # zeros to rounding in row 1 then
    for robot in (DIFFERENTIAL, sideways):
        np.testing.assert_allclose(robot.row_scales, [0.05 / 2, 0.05 / 2, 0.05 / 0.3], rtol=1e-12)
