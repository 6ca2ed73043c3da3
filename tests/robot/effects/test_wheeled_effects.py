"""Effects of robots that steer, skid, roll on casters or stand on four wheels: by hand, and to whom they apply."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from effect_samples import EVERY, PERIOD, a_drive, a_term, model
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02, CAR, DIFFERENTIAL, MECANUM, SKID, SWERVE, TRICYCLE

from omnibench.errors import DataError
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Values, make_term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.robot.signals import signals_of

seeds = st.integers(0, 2**32 - 1)
ONLY_FOR = {
    "steering_gain": {"tricycle", "car", "swerve"},
    "steering_play": {"tricycle", "car", "swerve"},
    "steering_lag": {"tricycle", "car", "swerve"},
    "steering_offset": {"car"},
    "steering_coupling": {"tricycle", "swerve"},
    "driven_steering_offset": {"tricycle", "swerve"},
    "icr_shift": {"skid"},
    "caster_pull": {"diff"},
    "light_wheel": {"four", "skid", "mecanum", "swerve"},
    "wheel_radius": {"diff", "skid", "tricycle", "swerve"},
    "wheel_position": {"diff", "skid"},
    "roller_ripple": {"three", "four", "mecanum"},
    "coulomb_creep": {"three", "four", "mecanum"},
}


def corrected(name: str, robot: Robot, log: WheelLog, **values: float) -> Array:
    effect = effects.create(name)
    assert isinstance(effect, MotionEffect)
    term = make_term(name, values, robot)
    signals = signals_of(log, robot, robot.inverse_kinematic_matrix, PERIOD, effect.needs)
    return effect.correction(signals, term.values)


def steered(robot: Robot, angles: Array, period: float = 0.1, rate: float = 2.0) -> WheelLog:
    """A run with all steering angles (F,) alike at the samples' ends, rad."""
    count, drive = len(angles), robot.drive
    rates = np.full((count, len(drive.wheels)), rate)
    steering = np.repeat(angles[:, None], len(drive.steered), axis=1)
    return WheelLog(period * np.arange(1, count + 1), rates, np.zeros(3), np.ones(1), steering=steering, drive=drive)


@pytest.mark.parametrize("name", [entry.name for entry in effects.entries() if entry.origin == "built in"])
def test_an_effect_applies_to_the_robots_that_have_what_it_acts_on(name: str) -> None:
    found = {label for label, robot in EVERY.items() if effects.create(name).applies(robot)}
    assert found == ONLY_FOR.get(name, set(EVERY))
    assert bool(effects.create(name).only_for) == (name in ONLY_FOR)


@pytest.mark.parametrize(
    ("name", "values", "robot"),
    [
        ("steering_gain", {"g": 0.1}, DIFFERENTIAL),
        ("steering_offset", {"c": 0.1}, TRICYCLE),
        ("icr_shift", {"x": 0.1}, DIFFERENTIAL),
        ("caster_pull", {"k": 0.1}, CAR),
        ("light_wheel", {"k_a": 0.1}, APR_02),
    ],
)
def test_an_effect_on_another_kind_of_robot_is_refused_in_one_line(name: str, values: Values, robot: Robot) -> None:
    with pytest.raises(DataError) as refusal:
        make_term(name, values, robot, "cal.yaml")
    words = f"cal.yaml: effect '{name}' is for {effects.create(name).only_for}; robot {robot.name} is none, leave"
    assert str(refusal.value).startswith(words)
    assert "\n" not in str(refusal.value)


def test_gain_lag_and_offset_change_the_angle_in_the_middle_of_a_sample() -> None:
    log = steered(CAR, np.array([0.1, 0.3, 0.3]))
    for name, parameter, expected in (
        ("steering_gain", "g", [0.1, 0.2, 0.3]),
        ("steering_lag", "tau", [0.0, -2.0, 0.0]),
        ("steering_offset", "c", [1.0, 1.0, 1.0]),
    ):
        found = corrected(name, CAR, log, **{parameter: 0.01})
        np.testing.assert_allclose(found, 0.01 * np.repeat([expected], 2, axis=0).T, atol=1e-15)


def test_a_gear_with_play_takes_the_wheel_along_once_it_is_taken_up() -> None:
    ends = np.array([0.0, 0.0, 0.01, 0.2, 0.4, 0.38, 0.2, 0.2])  # middles: 0, 0, .005, .105, .3, .39, .29, .2
    found = corrected("steering_play", TRICYCLE, steered(TRICYCLE, ends), b=0.02)[:, 0]
    np.testing.assert_allclose(found, -0.02 * np.array([0, 0, 0.5, 1, 1, 1, -1, -1]), atol=1e-12)


def test_turning_a_module_turns_its_drive_encoder() -> None:
    found = corrected("steering_coupling", SWERVE, steered(SWERVE, np.array([0.1, 0.3, 0.2])), k=0.2)
    np.testing.assert_allclose(found, np.repeat([[0.0], [0.4], [-0.2]], 4, axis=1), atol=1e-12)


def test_a_skid_steered_robot_turns_about_a_point_ahead_the_faster_the_farther() -> None:
    for turn in (0.5, -0.5, 1.0):
        rates = np.tile(SKID.signal_equations @ [0.3, 0.0, turn], (3, 1))
        log = WheelLog(0.1 * np.arange(1, 4), rates, np.zeros(3), np.ones(1))
        np.testing.assert_allclose(
            corrected("icr_shift", SKID, log, x=0.1), [[0.0, -0.1 * turn * abs(turn), 0.0]] * 3, atol=1e-12
        )


@pytest.mark.parametrize("robot", [SKID, MECANUM], ids=lambda robot: robot.name)
def test_a_light_wheel_slips_by_the_acceleration_along_its_drive(robot: Robot) -> None:
    speeds = np.outer(0.1 * np.arange(1, 30), [1.0, 0.0, 0.0])  # 1 m/s2 ahead, at 10 samples a second
    log = WheelLog(0.1 * np.arange(1, 30), speeds @ robot.signal_equations.T, np.zeros(3), np.ones(1))
    values = {f"k_{name}": 0.1 * (name == "front_left") for name in robot.wheel_names}
    term = make_term("light_wheel", values, robot)
    assert isinstance(term.effect, MotionEffect)
    found = term.effect.correction(signals_of(log, robot, robot.inverse_kinematic_matrix, 0.1), term.values)
    # r omega cos g is the speed along the force, e: e.x = cos(-g), so that the rate lost is k a / r for any rollers.
    np.testing.assert_allclose(found[-1], [-0.1 / 0.05, 0, 0, 0], atol=1e-6)


def driven(robot: Robot, twists: Array, period: float = 0.02) -> WheelLog:
    times = period * np.arange(1, len(twists) + 1)
    return WheelLog(times, twists @ robot.signal_equations.T, np.zeros(3), times)


@pytest.mark.parametrize("turn", [0.2, -0.4, 1.0])
def test_a_caster_swings_round_once_when_the_robot_turns_back(turn: float) -> None:
    ahead, back = np.tile([0.3, 0.0, turn], (100, 1)), np.tile([-0.3, 0.0, turn], (300, 1))
    added = corrected("caster_pull", DIFFERENTIAL, driven(DIFFERENTIAL, np.vstack([ahead, back])), k=0.01)
    assert not added[:, :2].any()
    # The pivot's direction turns from atan2(-l w, v) to atan2(-l w, -v); what a caster that trails a curve swings to
    # make up for the robot's own turn is there before and after, and is taken off.
    steady = added[99, 2]
    swung = float((added[100:, 2] - steady).sum() * 0.02)
    course = math.atan2(0.15 * turn, 0.3)
    assert swung == pytest.approx(-0.01 * math.copysign(math.pi - 2 * abs(course), turn), rel=0.15)


def test_a_robot_that_goes_straight_or_stands_has_no_pull() -> None:
    twists = np.vstack([np.tile([0.3, 0, 0], (50, 1)), np.zeros((20, 3)), np.tile([-0.3, 0, 0], (50, 1))])
    assert np.abs(corrected("caster_pull", DIFFERENTIAL, driven(DIFFERENTIAL, twists), k=0.05)).max() < 1e-12


def rescaled(robot: Robot, matrix: Array, values: Values) -> Array:
    """Columns of the signals of each wheel, in the ratio of the radii."""
    pairs = [2 if pair >= 0 else 1 for pair in robot.drive.pairs]
    return matrix * (1 + np.repeat([values[f"k_{name}"] for name in robot.wheel_names], pairs))


def moved_wheels(robot: Robot, matrix: Array, values: Values) -> Array:
    """K' with omega + y_i w / r in the place of omega, w = m3.omega."""
    out = np.array([values[f"y_{name}"] for name in robot.wheel_names]) / robot.radii
    return matrix + np.outer(matrix @ out, matrix[2])


def turned_pairs(robot: Robot, matrix: Array, values: Values) -> Array:
    turned = matrix.copy()
    for number, name in enumerate(robot.wheel_names):
        c, s = math.cos(values[f"c_{name}"]), math.sin(values[f"c_{name}"])
        pair = slice(2 * number, 2 * number + 2)
        turned[:, pair] = matrix[:, pair] @ np.array([[c, -s], [s, c]])
    return turned


ABSORBED_BY: dict[str, Callable[[Robot, Array, Values], Array]] = {
    "wheel_radius": rescaled,
    "wheel_position": moved_wheels,
    "driven_steering_offset": turned_pairs,
}


@pytest.mark.parametrize("name", ABSORBED_BY)
@given(seed=seeds, data=st.data())
def test_another_matrix_absorbs_the_effect(name: str, seed: int, data: st.DataObject) -> None:
    robot = EVERY[data.draw(st.sampled_from(sorted(ONLY_FOR[name])))]
    log, term = a_drive(seed, 60, robot), a_term(name, robot, seed)
    matrix = ABSORBED_BY[name](robot, robot.inverse_kinematic_matrix, term.values)
    (found,) = model(term, robot=robot).reported([log])
    (expected,) = OdometryModel(robot, matrix, "arc").poses([log])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@given(seed=seeds)
def test_a_stream_takes_steering_angles_that_take_no_time(seed: int) -> None:
    log = a_drive(seed, 20, TRICYCLE)
    assert log.steering is not None
    stream = model(a_term("steering_lag", TRICYCLE, seed), robot=TRICYCLE).stream()
    before = stream.drive(log.rates[0] * 0.1, 0.1, steering=log.steering[0])
    np.testing.assert_array_equal(stream.drive(np.zeros(1), 0.0, steering=log.steering[1]), before)
    plain = replace(log, times=np.array([0.1]), rates=log.rates[:1], steering=log.steering[:1], stamps=np.array([0.1]))
    expected = OdometryModel(TRICYCLE, TRICYCLE.inverse_kinematic_matrix, "arc").poses(
        [replace(plain, start=np.zeros(3))]
    )
    np.testing.assert_allclose(before, expected[0][0], atol=1e-12)  # nothing is known of a rate in the first sample
