"""From wheels of any kind to the inverse kinematic matrix and drive signals, robots that cannot be, and odometry."""

import math
from dataclasses import replace
from typing import Any

import config_robots
import numpy as np
import pytest
import yaml
from commands import refused
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sample_robots import APR_02, CAR, DIFFERENTIAL, SKID, SWERVE, TRICYCLE, WHEELED, fixed, steered
from wheeled_samples import driven

import omnibench
from omnibench.config import read_model, to_yaml, validate
from omnibench.errors import ConfigError, OmnibenchError
from omnibench.robot.kinematics import (
    Array,
    Mount,
    Robot,
    Wheel,
    class_of,
    compose,
    correction,
    interpolated,
    inverse_kinematic_matrices,
    inverse_kinematic_matrix,
    moved_to,
    published_matrix,
    relative,
    unit_twist,
    wheel_equations,
    wrapped,
)
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch, OdometryStream, WheelLog, advance

# Eq. (7) of the article, as printed.
EQ_7 = np.array(
    [
        [-0.0854478398400646, 0.0000000000000000, 0.0854478398400646],
        [0.04933333333333333, -0.09866666666666667, 0.04933333333333333],
        [0.2529914529914529, 0.2529914529914529, 0.2529914529914529],
    ]
)


def wheels_of(count: int, roller_angle: st.SearchStrategy[float]) -> st.SearchStrategy[tuple[Wheel, ...]]:
    numbers = {"radius": st.floats(0.02, 0.5), "distance": st.floats(0.05, 1.5), "angle": st.floats(-math.pi, math.pi)}
    names = [st.just(f"w{index}") for index in range(count)]
    return st.tuples(*(st.builds(Wheel, name=name, roller_angle=roller_angle, **numbers) for name in names))


three_omni_wheels = wheels_of(3, st.just(0.0))
many_wheels = st.integers(4, 8).flatmap(lambda count: wheels_of(count, st.floats(-1.0, 1.0)))


def condition(equations: Array) -> float:
    return float(np.linalg.cond(equations))


def test_the_design_values_give_every_element_of_eq_7_and_m12_is_exactly_zero() -> None:
    matrix = inverse_kinematic_matrix(APR_02.wheels)
    np.testing.assert_allclose(matrix, EQ_7, rtol=0, atol=1e-15)
    assert matrix[0, 1] == 0.0  # so that the paper's box freezes it


@given(wheels=three_omni_wheels | many_wheels)
def test_eq_3_is_the_inverse_and_the_pseudo_inverse_of_the_wheel_equations(wheels: tuple[Wheel, ...]) -> None:
    equations = wheel_equations(wheels)
    assume(condition(equations) < 1e4)
    matrix, expected = inverse_kinematic_matrix(wheels), np.linalg.pinv(equations)
    np.testing.assert_allclose(matrix @ equations, np.eye(3), atol=1e-13 * condition(equations))
    assert np.abs(matrix - expected).max() / np.abs(expected).max() < 1e-13 * condition(equations)


def test_mecanum_wheels_give_the_matrix_of_the_textbooks() -> None:
    r, lx, ly = 0.05, 0.2, 0.15
    # Front left, front right, rear left, rear right; a positive rate drives forward.
    textbook = r / 4 * np.array([[1, 1, 1, 1], [-1, 1, 1, -1], np.array([-1, 1, -1, 1]) / (lx + ly)])
    np.testing.assert_allclose(BY_PLACES.inverse_kinematic_matrix, textbook, atol=1e-15)


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
# Omni wheels by name, x, y and axle, all of which roll through the centre.
NO_TURN = [("a", 0, 0.1, 0), ("b", 0, -0.1, 0), ("c", -0.1, 0, math.pi / 2)]
CANNOT_BE: list[tuple[list[dict[str, Any]], str]] = [
    (omni(0, 0, math.pi), "every direction"),
    ([rolling(side, name) for side, name in zip((1, -1, 1, -1), "abcd", strict=True)], "every direction"),
    ([fixed(name, x, y, type="omni", angle=d) for name, x, y, d in NO_TURN], "every direction"),
    (omni(0, math.pi / 2), "wheels"),
    (omni(60, 180, 300), "60 cannot be an angle in rad; is it in degrees?"),
    (omni(0, 2, 4, roller_angle=45), "wheels.0.roller_angle"),
    (omni(0, 2, 4, name="a"), "names must differ: a, a, a"),
    (omni(0, 2, 4, name="front left"), "wheels.0.name"),
    (omni(0, 2, 4, radius=0), "wheels.0.radius"),
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


def test_a_row_of_zeros_has_the_scale_of_the_other_direction_of_driving() -> None:
    """Of a differential drive, radius r and track 2 b: r / 2 ahead and aside, r / 2b for turning."""
    sideways = DIFFERENTIAL.model_copy(update={"mount": Mount(yaw=math.pi / 2)})  # zeros to rounding in row 1 then
    for robot in (DIFFERENTIAL, sideways):
        np.testing.assert_allclose(robot.row_scales, [0.05 / 2, 0.05 / 2, 0.05 / 0.3], rtol=1e-12)


# Odometry: Eq. (1) and (2), exact arcs, batches, streams, derivatives, of arrays, and poses of the plane.

BOTH: tuple[Integration, ...] = ("euler", "arc")
MATRIX = published_matrix("palacin2023_eq8")


def a_log(seed: int, samples: int = 40, stamps: int = 7, wheels: int = 3) -> WheelLog:
    """Random rates, irregular samples, and stamps anywhere from 0 on, some of them within one sample."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.002, 0.2, samples))
    inside = np.sort(rng.uniform(0, times[-1], stamps - 2))
    return WheelLog(
        times=times,
        rates=rng.normal(0, 4, (samples, wheels)),
        start=rng.normal(0, 2, 3),
        stamps=np.concatenate([[0.0], inside, times[-1:]]),
    )


def at_the_end(log: WheelLog) -> WheelLog:
    return replace(log, stamps=log.times[-1:])


def on_the_circle(twist: Array, stamps: Array, start: Array) -> Array:
    """Poses (S, 3) of a robot that keeps its twist."""
    vx, vy, w = twist
    turned = w * stamps
    # The integral of exp(i w t); its limit for w = 0 is t.
    arc = stamps if w == 0 else np.expm1(1j * turned) / (1j * w)
    path = (vx + 1j * vy) * arc * np.exp(1j * start[2])
    return np.column_stack([start[0] + path.real, start[1] + path.imag, start[2] + turned])


def streamed(log: WheelLog, matrix: Array, integration: Integration) -> Array:
    """Poses (S, 3) at the stamps, sample by sample; a stamp within a sample is a shorter sample."""
    poses = []
    for stamp in log.stamps:
        stream, before = OdometryStream(matrix, integration, log.start), 0.0
        for time, rates in zip(log.times, log.rates, strict=True):
            stream.drive(rates * (min(time, stamp) - before))
            before = min(time, stamp)
        poses.append(stream.pose)
    return np.array(poses)


@pytest.mark.parametrize("integration", BOTH)
@given(
    seed=st.integers(0, 2**32 - 1),
    samples=st.integers(1, 60),
    stamps=st.integers(2, 12),
    wheels=st.sampled_from([3, 4, 6]),
)
def test_a_batch_equals_a_stream(integration: Integration, seed: int, samples: int, stamps: int, wheels: int) -> None:
    log = a_log(seed, samples, stamps, wheels)
    matrix = MATRIX if wheels == 3 else np.random.default_rng(5).normal(0, 0.1, (3, wheels))
    poses = OdometryBatch([log], integration).poses(matrix[None])[0]
    np.testing.assert_allclose(poses, streamed(log, matrix, integration), rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0, 1))
def test_one_stamp_within_the_last_sample_equals_a_stream(integration: Integration, seed: int, share: float) -> None:
    log = a_log(seed, samples=12)
    log = replace(log, stamps=log.times[-2:-1] + share * np.diff(log.times[-2:]))
    poses = OdometryBatch([log], integration).poses(MATRIX[None])[0]
    np.testing.assert_allclose(poses, streamed(log, MATRIX, integration), rtol=0, atol=1e-12)


@given(
    velocity=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    turn=st.floats(-3, 3).filter(lambda w: w == 0 or abs(w) > 1e-100),
    seed=st.integers(0, 2**32 - 1),
    samples=st.integers(1, 30),
)
def test_arcs_lie_on_the_circle_whatever_the_sampling(
    velocity: tuple[float, float], turn: float, seed: int, samples: int
) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 0.5, samples))
    stamps = np.sort(rng.uniform(0, times[-1], 5))
    start, twist = rng.normal(0, 1, 3), np.array([*velocity, turn])
    log = WheelLog(times, np.tile(np.linalg.solve(MATRIX, twist), (samples, 1)), start, stamps)
    poses = OdometryBatch([log], "arc").poses(MATRIX[None])[0]
    np.testing.assert_allclose(poses, on_the_circle(twist, stamps, start), rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@pytest.mark.parametrize("final_only", [True, False])
def test_trajectories_of_any_lengths_share_a_batch(integration: Integration, final_only: bool) -> None:
    logs = [a_log(seed, samples, stamps=3 + seed) for seed, samples in enumerate((3, 200, 1, 57))]
    logs = [at_the_end(log) for log in logs] if final_only else logs
    together = OdometryBatch(logs, integration)
    poses = together.poses(MATRIX[None])[0]
    for index, log in enumerate(logs):
        alone = OdometryBatch([log], integration).poses(MATRIX[None])[0]
        np.testing.assert_allclose(poses[together.trajectory == index], alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@pytest.mark.parametrize("final_only", [True, False])
def test_a_population_is_evaluated_as_one_at_a_time(integration: Integration, final_only: bool) -> None:
    logs = [a_log(seed, samples=900) for seed in range(8)]
    batch = OdometryBatch([at_the_end(log) for log in logs] if final_only else logs, integration)
    population = MATRIX * np.random.default_rng(0).uniform(0.9, 1.1, (50, 3, 3))  # several blocks
    one_at_a_time = np.concatenate([batch.poses(matrix[None]) for matrix in population])
    np.testing.assert_allclose(batch.poses(population), one_at_a_time, rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@pytest.mark.parametrize("final_only", [True, False])
def test_a_stamp_after_the_last_sample_has_the_pose_at_its_end(integration: Integration, final_only: bool) -> None:
    log = a_log(6)
    late = replace(log, stamps=log.times[-1:] + 5.0 if final_only else np.append(log.stamps, log.times[-1] + 5.0))
    pose = OdometryBatch([late], integration).poses(MATRIX[None])[0, -1]
    np.testing.assert_allclose(pose, streamed(at_the_end(log), MATRIX, integration)[0], rtol=0, atol=1e-12)


def test_a_stamp_at_zero_has_the_start_pose_and_driven_angles_add_up_to_each_stamp() -> None:
    log = a_log(7)
    batch = OdometryBatch([log], "arc")
    np.testing.assert_array_equal(batch.poses(MATRIX[None])[0, 0], log.start)
    within = np.clip(log.stamps[:, None] - np.append(0.0, log.times[:-1]), 0.0, np.diff(log.times, prepend=0.0))
    np.testing.assert_allclose(batch.driven, within @ log.rates, rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@pytest.mark.parametrize("final_only", [True, False])
@pytest.mark.parametrize("wheels", [3, 4])
def test_the_jacobian_equals_central_differences(integration: Integration, final_only: bool, wheels: int) -> None:
    logs = [a_log(seed, samples=30, wheels=wheels) for seed in range(3)]
    logs[1] = replace(logs[1], rates=np.zeros((30, wheels)))  # the arc of a robot at rest has its own branch
    batch = OdometryBatch([at_the_end(log) for log in logs] if final_only else logs, integration)
    matrix = np.random.default_rng(1).normal(0, 0.1, (3, wheels))
    step = 1e-5
    shifts = step * np.eye(3 * wheels).reshape(-1, 3, wheels)
    differences = (batch.poses(matrix + shifts) - batch.poses(matrix - shifts)) / (2 * step)
    expected = np.moveaxis(differences, 0, -1).reshape(-1, 3, 3, wheels)
    np.testing.assert_allclose(batch.jacobian(matrix), expected, rtol=0, atol=1e-7)


@given(turn=st.floats(1e-9, 0.1))
def test_the_jacobian_of_an_arc_has_no_seam_near_straight_runs(turn: float) -> None:
    # sinc's slope is a series below half turns of 1e-2 rad and a quotient above.
    log = WheelLog(np.array([1.0]), np.linalg.solve(MATRIX, [0.3, 0.1, turn])[None], np.zeros(3), np.array([1.0]))
    batch = OdometryBatch([log], "arc")
    step = 1e-4
    shift = np.zeros((3, 3))
    shift[2, 0] = step
    expected = (batch.poses((MATRIX + shift)[None]) - batch.poses((MATRIX - shift)[None]))[0, 0] / (2 * step)
    np.testing.assert_allclose(batch.jacobian(MATRIX)[0, :, 2, 0], expected, rtol=0, atol=1e-7)


def test_positions_are_linear_in_rows_1_and_2_once_the_headings_are_known() -> None:
    logs = [a_log(seed, samples) for seed, samples in ((1, 40), (2, 7))]
    batch = OdometryBatch(logs, "euler")
    headings = [
        log.start[2] + np.append(0.0, np.cumsum(log.rates @ MATRIX[2] * np.diff(log.times, prepend=0.0))[:-1])
        for log in logs
    ]
    path = batch.position_design(headings) @ (MATRIX[0] + 1j * MATRIX[1])
    starts = np.array([log.start for log in logs])[batch.trajectory]
    positions = starts[:, :2] + np.column_stack([path.real, path.imag])
    np.testing.assert_allclose(positions, batch.poses(MATRIX[None])[0, :, :2], rtol=0, atol=1e-12)


def test_a_models_stream_starts_at_the_origin_unless_told_and_does_not_change_the_start() -> None:
    model, start = OdometryModel.of_design(APR_02, "arc"), np.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(model.stream().pose, np.zeros(3))
    stream = model.stream(start)
    np.testing.assert_array_equal(stream.pose, [1.0, 2.0, 3.0])
    stream.drive(np.ones(3))
    np.testing.assert_array_equal(start, [1.0, 2.0, 3.0])


T = np.arange(1, 51) * 0.02


def test_it_is_the_odometry_of_data_sets() -> None:
    dataset = driven(TRICYCLE)
    run = dataset.trajectories[0]
    (wanted,) = OdometryModel.of_design(TRICYCLE, "arc").poses([run.log(run.pose_times)])
    given_arrays = {"steering": run.steering, "start": run.start, "stamps": run.pose_times}
    assert run.steering is not None
    np.testing.assert_array_equal(omnibench.odometry(TRICYCLE, run.times, run.rates, **given_arrays), wanted)


def test_a_calibration_brings_its_matrix_and_integration() -> None:
    run = driven(DIFFERENTIAL).trajectories[0]
    calibration = omnibench.calibrate(driven(DIFFERENTIAL), integration="euler").calibration
    (wanted,) = calibration.model.poses([run.log(run.times)])
    np.testing.assert_array_equal(omnibench.odometry(calibration, run.times, run.rates, start=run.start), wanted)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rates": np.ones((50, 3))}, r"rates .*\(50, 2\): .*left, right"),
        ({"rates": np.ones(50)}, r"rates .*\(50,\)"),
        ({"rates": [["fast"] * 2] * 50}, "rates"),
        ({"rates": np.r_[np.ones((3, 2)), np.full((47, 2), np.nan)]}, "rates, row 4"),
        ({"times": T - 0.02}, "times, row 1"),
        ({"times": T[::-1]}, "times, row 2"),
        ({"stamps": [-1.0]}, "stamps, row 1"),
        ({"start": [0, 0]}, r"start .*\(2,\)"),
        ({"robot": "robot.yaml"}, "'robot.yaml'"),
        ({"robot": TRICYCLE, "rates": np.ones((50, 1))}, "steering .*front"),
    ],
)
def test_what_does_not_fit_is_named(given: dict[str, Any], message: str) -> None:
    call: dict[str, Any] = {"robot": DIFFERENTIAL, "times": T, "rates": np.ones((50, 2))} | given
    with pytest.raises(OmnibenchError, match=message):
        omnibench.odometry(**call)


POSES = arrays(float, 3, elements=st.floats(-10, 10))


@given(POSES, POSES)
def test_the_relative_pose_leads_from_the_first_to_the_second(first: np.ndarray, second: np.ndarray) -> None:
    np.testing.assert_allclose(compose(first, relative(first, second)), second, atol=1e-9)


@given(POSES, POSES)
def test_the_correction_takes_odom_to_the_map(in_map: np.ndarray, in_odom: np.ndarray) -> None:
    np.testing.assert_allclose(compose(correction(in_map, in_odom), in_odom), in_map, atol=1e-9)


@given(POSES, arrays(float, (4, 3), elements=st.floats(-10, 10)))
def test_a_path_that_is_moved_begins_there_and_keeps_its_shape(start: np.ndarray, path: np.ndarray) -> None:
    moved = moved_to(start, path)
    np.testing.assert_allclose(moved[0], start, atol=1e-9)
    for one, other in ((0, 1), (1, 3)):
        np.testing.assert_allclose(relative(moved[one], moved[other]), relative(path[one], path[other]), atol=1e-9)


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-np.pi, np.pi))
def test_the_twist_of_a_motion_makes_it_along_an_arc(x: float, y: float, turn: float) -> None:
    motion = np.array([x, y, turn])
    np.testing.assert_allclose(advance(np.zeros(3), unit_twist(motion), "arc"), motion, atol=1e-12)
    np.testing.assert_allclose(unit_twist(np.stack([motion, motion]))[1], unit_twist(motion), atol=1e-12)


@given(st.floats(-20, 20))
def test_the_twist_of_whole_turns_is_finite(turn: float) -> None:
    assert np.isfinite(unit_twist(np.array([1.0, -1.0, turn]))).all()


def test_rows_are_interpolated_by_straight_lines_and_held_beyond_their_stamps() -> None:
    rows = np.array([[0.0, 1.0, 0.0], [2.0, 1.0, -4.0]])
    found = interpolated(np.array([-1.0, 1.5, 9.0]), np.array([1.0, 2.0]), rows)
    np.testing.assert_array_equal(found, [[0.0, 1.0, 0.0], [1.0, 1.0, -2.0], [2.0, 1.0, -4.0]])


def test_wrapped_angles_differ_by_whole_turns() -> None:
    np.testing.assert_allclose(wrapped(np.array([0.1, np.pi, -np.pi, 7.0])), [0.1, -np.pi, -np.pi, 7.0 - 2 * np.pi])
