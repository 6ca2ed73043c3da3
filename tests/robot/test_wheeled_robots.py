"""Robots on every kind of wheel: design matrices, drive signals, and robots that cannot be."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02, CAR, DIFFERENTIAL, MECANUM, SKID, SWERVE, TRICYCLE, WHEELED

from omnibench.config import to_yaml, validate
from omnibench.errors import ConfigError
from omnibench.robot.kinematics import Array, Mount, Robot, class_of
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog

EVERY = [pytest.param(robot, id=robot.name) for robot in (APR_02, *WHEELED)]
STEERED = [pytest.param(robot, id=robot.name) for robot in (TRICYCLE, CAR, SWERVE)]
SPEEDS = st.floats(-2.0, 2.0)


def a_robot(*wheels: dict[str, Any], **more: Any) -> Robot:
    """A robot by its document, as files give it. ConfigError in one line."""
    return validate(Robot, {"name": "r", "wheels": wheels, **more}, "robot.yaml")


def fixed(name: str, x: float, y: float, **more: Any) -> dict[str, Any]:
    return {"name": name, "type": "fixed", "radius": 0.05, "x": x, "y": y, **more}


def steered(name: str, x: float, y: float, **more: Any) -> dict[str, Any]:
    return {"name": name, "type": "steered", "radius": 0.05, "x": x, "y": y, **more}


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


def test_a_differential_drive_has_the_textbook_matrix() -> None:
    r, track = 0.05, 0.3
    expected = [[r / 2, r / 2], [0, 0], [-r / track, r / track]]
    np.testing.assert_allclose(DIFFERENTIAL.inverse_kinematic_matrix, expected, rtol=0, atol=1e-15)


def test_a_tricycle_has_the_textbook_matrix() -> None:
    expected = [[0.05, 0], [0, 0], [0, 0.05 / 0.5]]
    np.testing.assert_allclose(TRICYCLE.inverse_kinematic_matrix, expected, rtol=0, atol=1e-15)
    assert TRICYCLE.drive.names == ("front_cos", "front_sin")


def test_the_difference_of_a_cars_rear_rates_counts_for_nothing_by_design() -> None:
    expected = [[0.05, 0, 0], [0, 0, 0], [0, 0.05 / 0.5, 0]]
    np.testing.assert_allclose(CAR.inverse_kinematic_matrix, expected, rtol=0, atol=1e-15)
    assert CAR.drive.names == ("mean", "mean_tan", "difference")


def test_mecanum_wheels_at_places_are_those_with_lever_arms() -> None:
    """Forward rates of the left wheels, in the convention of lever arms, are negative: they turn it clockwise."""
    arms = [
        {"name": wheel.name, "radius": 0.05, "distance": 0.35, "angle": math.copysign(math.pi / 2, wheel.position[1])}
        | {"roller_angle": wheel.roller_angle}
        for wheel in MECANUM.wheels
    ]
    signs = [-math.copysign(1.0, wheel.position[1]) for wheel in MECANUM.wheels]
    np.testing.assert_allclose(
        MECANUM.inverse_kinematic_matrix, a_robot(*arms).inverse_kinematic_matrix * signs, rtol=0, atol=1e-15
    )


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
    from omnibench.config import read_model

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


FOUR = [fixed("a", 0.2, 0.2), fixed("b", 0.2, -0.2), fixed("c", -0.2, 0.2), fixed("d", -0.2, -0.2)]


@pytest.mark.parametrize(
    ("wheels", "words"),
    [
        ([fixed("a", 0, 0.1)], "two measured wheels are needed, or one that steers and is measured (measured: a)"),
        (
            FOUR,
            "fixed wheels a, b, c, d would have to slide when it turns; put them on one axle (x, y, angle), or write "
            "skid: true beside the robot's wheels",
        ),
        (
            [fixed("a", 0, 0.1), fixed("b", 0, -0.1), fixed("c", -0.2, 0, measured=False)],
            "fixed wheel c would have to slide when it turns; put it on the others' axle (x, y, angle), or write skid:",
        ),
        (
            [fixed("a", 0, 0.1), fixed("b", 0, -0.1, angle=0.3)],
            "fixed wheels a, b would have to slide when it turns; put them on one axle",
        ),
        ([fixed("a", 0, 0.1), fixed("b", 0, 0.1)], "signals a, b do not determine how the robot moves"),
        ([fixed("a", 0, 0.1), {"name": "b", "type": "fixed", "radius": 0.1, "x": 0}], "y of a fixed wheel is missing"),
        ([steered("a", 0.5, 0, angle=1.0)], "a steered wheel has no angle"),
        ([fixed("a", 0, 0.1, roller_angle=0.7)], "a fixed wheel has no rollers"),
        ([fixed("a", 0, 0.1, distance=0.1)], "a fixed wheel has x and y in the place of distance"),
        (
            [{"name": "a", "type": "mecanum", "radius": 0.1, "x": 0, "y": 1}],
            "roller_angle of a mecanum wheel is missing",
        ),
        (
            [{"name": "a", "radius": 0.1, "x": 0.1, "angle": 0}],
            "y is missing; give distance and angle (of the axle), or x",
        ),
        ([{"name": "a", "radius": 0.1, "distance": 0.1, "x": 0.1, "angle": 0}], "distance and x, y are both given"),
        ([{"name": "a", "radius": 0.1, "distance": 0.1, "angle": 0, "angle_deg": 0}], "angle and angle_deg are both"),
        ([fixed("a", 0, 0.1, angle=90)], "90 cannot be an angle in rad; is it in degrees?"),
        ([fixed("a", 0, 0.1, typ="fixed")], "did you mean 'type'?"),
        (
            [fixed("a", 0, 0.1), fixed("b", 0, -0.1), steered("c", 0.0, 0, driven=False)],
            "steered wheel c must stand ahead of the fixed wheels",
        ),
        (
            [fixed("a", 0, 0.1), steered("b", 0.3, 0.1), steered("c", 0.3, -0.1, driven=False)],
            "say measured: false for c, or driven: true",
        ),
    ],
)
def test_a_robot_that_cannot_be_is_refused_by_name(wheels: list[dict[str, Any]], words: str) -> None:
    with pytest.raises(ConfigError) as refused:
        a_robot(*wheels)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_skid_steering_is_said_of_fixed_wheels_only() -> None:
    a_robot(*FOUR, skid=True)
    with pytest.raises(ConfigError, match="skid: true is for fixed wheels; this robot has none"):
        a_robot(*(steered(name, x, 0.1) for name, x in (("a", 0.2), ("b", -0.2))), skid=True)


def test_a_skid_steered_robot_turns_by_its_track_on_paper() -> None:
    r, track = 0.05, 0.3
    expected = [[r / 4] * 4, [0] * 4, np.array([-1, 1, -1, 1]) * r / (2 * track)]
    np.testing.assert_allclose(SKID.inverse_kinematic_matrix, expected, rtol=0, atol=1e-15)


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
