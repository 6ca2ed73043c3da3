"""Effects: what each does to a robot's motion, its terms in a file, and what is refused."""

import math
import pickle
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from commands import refused
from effect_samples import (
    APPLIED,
    EVERY,
    EVERY_MOTION,
    MOTION,
    PERIOD,
    ROBOTS,
    SESSIONS,
    SMOOTH_MOTION,
    a_drive,
    a_term,
    at_every_sample,
    built_in,
    model,
    streamed,
    term,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_robots import APR_02, CAR, DIFFERENTIAL, MECANUM, SKID, SWERVE, TRICYCLE

from omnibench.errors import DataError, UnknownNameError
from omnibench.registry import effects
from omnibench.robot.effects.effect import (
    Effect,
    Forms,
    MotionEffect,
    ReferenceEffect,
    Term,
    Values,
    correction_of,
    form_in_words,
    forms_of,
    make_term,
)
from omnibench.robot.kinematics import Array, Robot, rotation, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog, advance
from omnibench.robot.signals import Signals, signals_of

VX, VY, W = 0.3, -0.2, 0.8
AX, AY = 1.1, 0.7
SPEED, R = math.hypot(VX, VY), 0.148


def signals(**changes: Any) -> Signals:
    """One sample with numbers that are easy to put into a formula."""
    chosen: dict[str, Any] = {
        "robot": APR_02,
        "durations": np.array([0.01]),
        "rates": np.array([[2.0, -1.0, 0.04]]),
        "elapsed": np.array([1.5]),
        "twists": np.array([[VX, VY, W]]),
        "accelerations": np.array([[AX, AY, 0.4]]),
        "travelled": np.array([0.1]),
        "wheel_angles": np.array([[0.5, 1.2, -2.0]]),
        "session_time": np.array([1000.0]),
        "session": "evening",
        "poses": np.array([[0.5, 0.5, 0.1]]),
    }
    return Signals(**(chosen | changes))


def towards(angle: float) -> float:
    """The body's acceleration along an axle at this angle, deg."""
    delta = math.radians(angle)
    return (AX - W * VY) * math.cos(delta) + (AY + W * VX) * math.sin(delta)


def ripple(harmonic: int) -> list[float]:
    """What the wheels turn too far within the sample, over its duration: an integral of cosine and sine."""
    sizes = zip((2.0, -1.0, 0.04), (0.01, 0.02, 0.03), (0.04, 0.05, 0.06), (0.5, 1.2, -2.0), strict=True)
    means = []
    for rate, a, b, phi in sizes:
        begin, end = (harmonic * (phi + side * rate * 0.01 / 2) for side in (-1, 1))
        too_far = a * (math.sin(end) - math.sin(begin)) - b * (math.cos(end) - math.cos(begin))
        means.append(too_far / harmonic / 0.01)
    return means


AMPLITUDES = {"a_a": 0.01, "a_b": 0.02, "a_c": 0.03, "b_a": 0.04, "b_b": 0.05, "b_c": 0.06}
BY_HAND: dict[str, tuple[dict[str, float], list[float]]] = {
    "speed_dependent_radius": ({"k": 0.02}, [0.02 * 2 * 2, -0.02 * 1 * 1, 0.02 * 0.04 * 0.04]),
    "direction_dependent_radius": ({"k_a": 0.01, "k_b": 0.02, "k_c": -0.5}, [0.02, 0.02, -0.02]),
    "wheel_dead_zone": ({"c": 0.01}, [0.01, -0.01, 0.01 * math.tanh(0.8)]),
    "coulomb_creep": ({"c": 0.02}, [0.02 * SPEED / R * sign for sign in (1, -1, math.tanh(0.8))]),
    "wheel_eccentricity": (AMPLITUDES, ripple(1)),
    "roller_ripple": (AMPLITUDES | {"rollers": 9}, ripple(9)),
    "missed_pulses": ({"k": 0.5, "rate": 1.5}, [0.25, 0.0, 0.0]),
    # Around the robot come a at 60 deg, b at 180 and c at 300.
    "cross_wheel_coupling": (
        {"k_next": 0.1, "k_previous": 0.01, "k_both": 0.001},
        [
            -0.2 * 1.0 - 0.02 * 0.04 - 0.001 * 0.04,
            0.1 * 0.04 + 0.01 * 2.0 + 0.001 * 0.08,
            -0.004 * 2.0 - 0.0004 * 1.0 - 0.001 * 2.0 * math.tanh(0.8),
        ],
    ),
    "thermal_radius_drift": ({"k": 1e-5}, [0.02, -0.01, 0.0004]),
    "tyre_wear": ({"radius_noon": 0.5, "radius_evening": 0.01}, [0.02, -0.01, 0.0004]),
    "load_transfer": ({"k": 0.1}, [-0.1 * towards(60) * 2, 0.1 * towards(180), -0.1 * towards(300) * 0.04]),
    "sample_period_scale": ({"s": 0.01}, [0.02, -0.01, 0.0004]),
    "acceleration_slip": ({"k": 0.1}, [-0.11, -0.07, 0.0]),
    "centripetal_slip": ({"k": 0.1}, [-0.1 * W * VY, 0.1 * W * VX, 0.0]),
    "rotation_translation_coupling": ({"kx": 0.3, "ky": 0.1}, [0.0, 0.0, W * (0.3 * VX + 0.1 * VY)]),
    "quadratic_rotation_slip": ({"k": 0.1}, [0.0, 0.0, -0.1 * W * W]),
    "heading_drift": ({"b": 0.005}, [0.0, 0.0, 0.005]),
    "body_velocity_bias": ({"bx": 0.005, "by": -0.003}, [0.005, -0.003, 0.0]),
    "start_transient": ({"k": 0.2, "length": 0.05}, [-0.2 * VX * math.exp(-2), -0.2 * VY * math.exp(-2), 0.0]),
    "floor_drift": ({"dx": 0.02, "dy": -0.01}, [0.02 * SPEED, -0.01 * SPEED]),
    # On grid point 22; its neighbour's spline has a quarter of its peak there.
    "floor_map": (
        {f"{mode}_{x}{y}": 0.0 for mode in ("along", "rotation") for x in range(3) for y in range(3)}
        | {"along_22": 0.08, "along_12": 0.04, "rotation_22": 0.1, "centre_x": 0, "centre_y": 0, "spacing": 0.5},
        [0.09 * VX, 0.09 * VY, 0.1 * W],
    ),
}


@pytest.mark.parametrize("name", [*MOTION, "floor_map"])
def test_a_correction_is_the_formula_of_the_catalogue(name: str) -> None:
    values, expected = BY_HAND[name]
    term = make_term(name, values, APR_02)
    # The sign of a rate is smoothed over 0.05 rad/s; at 1 rad/s it is whole to 1e-17.
    np.testing.assert_allclose(term.effect.correction(signals(), term.values), [expected], rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", built_in(Effect))
def test_an_effect_that_another_matrix_absorbs_says_how_it_is_measured(name: str) -> None:
    effect: Effect = effects.create(name)
    assert bool(effect.measurement) == (name in ABSORBED_BY)
    assert effect.run_nuisance == (name == "reference_clock_drift")


@pytest.mark.parametrize("name", ["heading_drift", "body_velocity_bias"])
def test_a_drift_acts_only_while_a_wheel_turns(name: str) -> None:
    term = a_term(name, APR_02)
    for rates, acts in (([0.0, 9e-4, 0.0], False), ([0.0, -2e-3, 0.0], True)):
        assert term.effect.correction(signals(rates=np.array([rates])), term.values).any() == acts


@pytest.mark.parametrize("session", ["afternoon", None])
def test_a_session_of_which_no_radius_is_known_is_not_corrected(session: str | None) -> None:
    assert not effects.create("tyre_wear").correction(signals(session=session), {"radius_evening": 0.01}).any()


def test_tyre_wear_has_a_radius_for_every_session_but_the_first() -> None:
    found = effects.create("tyre_wear").parameters(APR_02, ("monday", "tuesday", "friday"))
    assert [each.name for each in found] == ["radius_tuesday", "radius_friday"]
    assert not effects.create("tyre_wear").parameters(APR_02)


def reference_term(name: str, **values: float) -> tuple[ReferenceEffect, Values]:
    effect = effects.create(name)
    return effect, make_term(name, values, APR_02).values


POSES = np.array([[1.0, 2.0, math.pi / 2], [1.0, 3.0, math.pi], [4.0, 2.0, 0.5]])


@pytest.mark.parametrize(
    ("name", "values", "position", "heading"),
    [
        ("reference_time_offset", {"tau": 0.1}, [0.1, 0.1], [0.1, 0.1]),
        ("heading_latency", {"tau": 0.05}, [0.0, 0.0], [0.05, 0.05]),
        ("reference_clock_drift", {"offset": 0.1, "slope": 0.01}, [0.11, 0.13], [0.11, 0.13]),
    ],
)
def test_a_pose_is_taken_earlier_than_its_stamp_says(
    name: str, values: dict[str, float], position: list[float], heading: list[float]
) -> None:
    effect, own = reference_term(name, **values)
    found = effect.delays(np.array([1.0, 3.0]), own)
    np.testing.assert_allclose(found, [position, heading], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(effect.reported(POSES, POSES[0], own), POSES)


REPORTED: dict[str, tuple[dict[str, float], Callable[[Array], Array]]] = {
    # (R(theta) - R(90 deg)) (0.1, 0.02), R(90 deg) l = (-0.02, 0.1) and R(180 deg) l = (-0.1, -0.02)
    "lidar_lever_arm": ({"x": 0.1, "y": 0.02}, lambda at_pi: at_pi + np.array([-0.1 + 0.02, -0.02 - 0.1, 0.0])),
    "lidar_yaw": ({"beta": 0.3}, lambda at_pi: np.array([1 - math.sin(0.3), 2 + math.cos(0.3), at_pi[2]])),
    "reference_scale": ({"s": 0.01}, lambda at_pi: at_pi + np.array([0.0, 0.01, 0.0])),
}


@pytest.mark.parametrize("name", REPORTED)
def test_what_the_reference_reports_is_the_formula_of_the_catalogue(name: str) -> None:
    values, expected = REPORTED[name]
    effect, own = reference_term(name, **values)
    found = effect.reported(POSES, POSES[0], own)
    np.testing.assert_allclose(found[0], POSES[0], rtol=0, atol=1e-15)  # the start is where it is said to be
    np.testing.assert_allclose(found[1], expected(POSES[1]), rtol=0, atol=1e-15)


def actuated(name: str, durations: Array, targets: Array, **values: float) -> Array:
    effect = effects.create(name)
    return effect.driven(durations, targets, make_term(name, values, APR_02).values)


def test_a_motor_lags_behind_its_target_as_a_first_order_system() -> None:
    ends = np.array([0.05, 0.15, 0.2, 0.5])
    targets = np.array([[2.0, -1.0]] * 4)
    found = actuated("motor_lag", np.diff(ends, prepend=0.0), targets, tau=0.1)
    # The mean of 1 - exp(-t / tau) over each sample.
    way = ends - 0.1 * (1 - np.exp(-ends / 0.1))
    expected = np.diff(way, prepend=0.0) / np.diff(ends, prepend=0.0)
    np.testing.assert_allclose(found, expected[:, None] * targets, rtol=0, atol=1e-15)


def test_a_motor_that_lags_forgets_what_it_was_told_before_and_without_a_time_constant_follows_at_once() -> None:
    targets = np.concatenate([np.full((10, 1), 3.0), np.full((200, 1), -1.0)])
    assert actuated("motor_lag", np.full(210, 0.01), targets, tau=0.1)[-1, 0] == pytest.approx(-1.0, abs=1e-7)
    np.testing.assert_array_equal(actuated("motor_lag", np.full(210, 0.1), targets, tau=0.0), targets)


def test_a_dead_band_takes_its_width_off_every_target_and_a_gain_scales_it() -> None:
    found = actuated("motor_dead_band", np.ones(1), np.array([[0.05, -0.09, 0.5, -2.0, 0.0]]), band=0.1)
    np.testing.assert_allclose(found, [[0.0, 0.0, 0.4, -1.9, 0.0]], rtol=0, atol=1e-16)
    np.testing.assert_allclose(actuated("motor_gain", np.ones(1), np.array([[1.0, -2.0]]), g=0.05), [[1.05, -2.1]])


def constant(twist: list[float], seconds: float, heading: float = 0.0, period: float = 0.01) -> WheelLog:
    """A run at constant wheel rates, one pose wanted at its end."""
    times = period * np.arange(1, round(seconds / period) + 1)
    rates = np.tile(wheel_equations(APR_02.wheels) @ twist, (len(times), 1))
    angles = np.cumsum(rates * period, axis=0)
    return WheelLog(times, rates, np.array([0.0, 0.0, heading]), times[-1:], angles, 0.0, "morning")


@pytest.mark.parametrize(("name", "harmonic"), [("wheel_eccentricity", 1), ("roller_ripple", 9)])
def test_long_samples_tell_of_a_ripple_what_short_ones_tell(name: str, harmonic: int) -> None:
    shape = {"rollers": float(harmonic)} if name == "roller_ripple" else {}
    ripple = term(name, **{f"{part}_{wheel}": 0.02 for part in "ab" for wheel in "abc"}, **shape)
    stamps = 0.05 * np.arange(1, 100)
    short, long = (
        model(ripple).poses([replace(constant([0.0, 0.0, 2.0], 5.0, period=period), stamps=stamps)])[0][:, 2]
        for period in (0.001, 0.05)
    )
    np.testing.assert_allclose(long, short, rtol=0, atol=1e-9)


seeds = st.integers(0, 2**32 - 1)
ONLY_FOR = {
    "steering_gain": {"tricycle", "car", "swerve"},
    "steering_play": {"tricycle", "car", "swerve"},
    "steering_lag": {"tricycle", "car", "swerve"},
    "steering_offset": {"car"},
    "steering_side_gain": {"tricycle", "car"},
    "servo_lag": {"tricycle", "car"},
    "servo_rate_limit": {"tricycle", "car"},
    "understeer": {"car"},
    "understeer_limit": {"car"},
    "turn_slip": {"diff", "tricycle"},
    "icr_curvature": {"skid"},
    "cross_wheel_coupling": {"three", "four", "mecanum"},
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


def test_an_effect_on_another_kind_of_robot_is_refused_in_one_line() -> None:
    only_for = effects.create("steering_gain").only_for
    with refused(DataError, "cal.yaml", "'steering_gain'", only_for, DIFFERENTIAL.name):
        make_term("steering_gain", {"g": 0.1}, DIFFERENTIAL, "cal.yaml")


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
    found = term.effect.correction(signals_of(log, robot, robot.inverse_kinematic_matrix, 0.1), term.values)
    # r omega cos g is the speed along the force, e: e.x = cos(-g), so that the rate lost is k a / r for any rollers.
    np.testing.assert_allclose(found[-1], [-0.1 / 0.05, 0, 0, 0], atol=1e-6)


def told(rng: np.random.Generator, samples: int = 60) -> tuple[Array, Array]:
    """Commanded angles (F,) at the samples' ends, rad, with jumps among them, and durations (F,), s."""
    jumps = np.where(rng.random(samples) < 0.2, rng.normal(0, 0.5, samples), rng.normal(0, 0.02, samples))
    return 0.2 + np.append(0.0, np.cumsum(jumps)[1:]), 0.02 * rng.uniform(0.5, 2.0, samples)


@pytest.mark.parametrize(
    ("name", "shape", "slope"),
    [
        ("servo_lag", {"tau": 0.2}, lambda ahead: ahead / 0.2),
        ("servo_rate_limit", {"rate": 2.0}, lambda ahead: np.clip(ahead / 1e-6, -2.0, 2.0)),
    ],
)
def test_a_servo_follows_its_command_as_its_differential_equation_says(
    name: str, shape: dict[str, float], slope: Callable[[float], float]
) -> None:
    ends, durations = told(np.random.default_rng(3))
    log = replace(steered(CAR, ends), times=np.cumsum(durations))
    found = corrected(name, CAR, log, share=1.0, **shape)[:, 0]
    wheel, before, means = ends[0], ends[0], []
    for end, duration in zip(ends, durations, strict=True):
        behind, steps = 0.0, 2000
        for step in range(steps):
            angle = before + (end - before) * (step + 0.5) / steps
            ahead = (angle if name == "servo_lag" else end) - wheel  # a limit is told the angle a sample early
            turned = float(np.clip(slope(ahead) * duration / steps, -abs(ahead), abs(ahead)))
            behind += (wheel + turned / 2 - angle) / steps
            wheel += turned
        means.append(behind)
        before = end
    # The angle that a servo reaches within a sample is taken to be reached at its end.
    np.testing.assert_allclose(found, means, atol=1e-4 if name == "servo_lag" else 0.02)


def test_servos_between_two_of_the_catalogue_are_between_their_paths() -> None:
    ends, _ = told(np.random.default_rng(4))
    quick, between, slow = (
        corrected("servo_lag", CAR, steered(CAR, ends, 0.02), share=1.0, tau=tau) for tau in (0.1, 0.15, 0.2)
    )
    np.testing.assert_allclose(between, (quick + slow) / 2, atol=1e-12)


def test_wheels_steer_farther_to_one_side() -> None:
    found = corrected("steering_side_gain", CAR, steered(CAR, np.array([0.3, 0.3, -0.3, -0.3])), g=0.1, c=0.02)
    np.testing.assert_allclose(found[[1, 3], 0], [0.03 + 0.02, 0.03 - 0.02], atol=1e-12)


def curves(robot: Robot, *twists: tuple[float, float, float]) -> WheelLog:
    """A sample of each twist of a car or another robot."""
    rates, steering = robot.drive.commands(np.array(twists) @ robot.signal_equations.T)
    times, held = 0.1 * np.arange(1, len(twists) + 1), np.repeat(steering, 2, axis=0)
    if not steering.shape[1]:
        return WheelLog(times, rates, np.zeros(3), times)
    times = 0.1 * np.arange(1, 2 * len(twists) + 1)
    return WheelLog(times, np.repeat(rates, 2, axis=0), np.zeros(3), times, steering=held, drive=robot.drive)


def test_a_car_understeers_by_its_characteristic_speed_and_slides_at_the_limit() -> None:
    log = curves(CAR, (3.0, 0.0, 0.5), (1.0, 0.0, -0.5))
    turned = corrected("understeer", CAR, log, k=1 / 9, b=0.01, u=3.0)[1::2]
    # Eq. (T1): half of the turn is left at the characteristic speed, 0.9 of it at a third.
    np.testing.assert_allclose(turned[:, 2], [-0.25, 0.05], rtol=1e-9)
    np.testing.assert_allclose(turned[:, 1], [-0.01 * 9 * 0.25, 0.01 * 0.45], rtol=1e-9)
    beyond = corrected("understeer_limit", CAR, curves(CAR, (3.0, 0.0, 20.0), (0.1, 0.0, 0.1)), s=1.0, a=4.0)[1::2, 2]
    assert 3.0 * (20.0 + beyond[0]) == pytest.approx(4.0, rel=1e-6)
    assert abs(beyond[1]) < 1e-6


def test_tyres_lose_less_of_tight_turns_and_skid_steering_more() -> None:
    spot, wide, ahead = (0.0, 0.0, 1.0), (1.0, 0.0, 0.5), (1.0, 0.0, 0.0)
    gained = corrected("turn_slip", DIFFERENTIAL, curves(DIFFERENTIAL, spot, wide, ahead), k=0.1, c0=1.0)[:, 2]
    half = DIFFERENTIAL.wheels[0].y
    assert half is not None
    np.testing.assert_allclose(gained, [0.1 / (1 + half), 0.05 / 3, 0.0], rtol=1e-6, atol=1e-12)
    lost = corrected("icr_curvature", SKID, curves(SKID, spot, wide, ahead), k=0.3, x=0.1, R0=1.0)
    np.testing.assert_allclose(lost[:, 2], [-0.3, -0.15 / 5, 0.0], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(lost[:, 1], [-0.1, -0.05 / 5, 0.0], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("robot", [MECANUM, ROBOTS["four"]], ids=lambda robot: robot.name)
def test_neighbours_are_those_around_a_mecanum_robot(robot: Robot) -> None:
    rates = np.array([[1.0, 10.0, 100.0, 1000.0]])  # front left and right, rear left and right
    one = WheelLog(np.array([0.1]), rates, np.zeros(3), np.array([0.1]))
    next_one = corrected("cross_wheel_coupling", robot, one, k_next=1.0, k_previous=0.0, k_both=0.0)
    np.testing.assert_allclose(-next_one / rates, [[100.0, 1.0, 1000.0, 10.0]])


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
    "lidar_lever_arm": lambda _, matrix, v: matrix + np.outer([-v["y"], v["x"], 0.0], matrix[2]),
    "lidar_yaw": lambda _, matrix, values: rotation(values["beta"]) @ matrix,
    "reference_scale": lambda _, matrix, values: np.diag([1 + values["s"], 1 + values["s"], 1.0]) @ matrix,
    "sample_period_scale": lambda _, matrix, values: (1 + values["s"]) * matrix,
    "wheel_radius": rescaled,
    "wheel_position": moved_wheels,
    "driven_steering_offset": turned_pairs,
}


@pytest.mark.parametrize("name", ABSORBED_BY)
@given(seed=seeds, data=st.data())
def test_another_matrix_absorbs_the_effect(name: str, seed: int, data: st.DataObject) -> None:
    robot = EVERY[data.draw(st.sampled_from(sorted(ONLY_FOR.get(name, ROBOTS))))]
    log, term = a_drive(seed, 60, robot), a_term(name, robot, seed)
    matrix = ABSORBED_BY[name](robot, robot.inverse_kinematic_matrix, term.values)
    (found,) = model(term, robot=robot).reported([log])
    (expected,) = OdometryModel(robot, matrix, "arc").poses([log])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@given(seed=seeds)
def test_a_stream_takes_steering_angles_that_take_no_time(seed: int) -> None:
    log = a_drive(seed, 20, TRICYCLE)
    stream = model(a_term("steering_lag", TRICYCLE, seed), robot=TRICYCLE).stream()
    before = stream.drive(log.rates[0] * 0.1, 0.1, steering=log.steering[0])
    np.testing.assert_array_equal(stream.drive(np.zeros(1), 0.0, steering=log.steering[1]), before)
    plain = replace(log, times=np.array([0.1]), rates=log.rates[:1], steering=log.steering[:1], stamps=np.array([0.1]))
    expected = OdometryModel.of_design(TRICYCLE, "arc").poses([replace(plain, start=np.zeros(3))])
    np.testing.assert_allclose(before, expected[0][0], atol=1e-12)  # nothing is known of a rate in the first sample


# Terms of the model: their parameters and forms, the same in a stream as in a batch, and what is wrong with them.


@pytest.mark.parametrize("value", [1, np.float64(1.0), np.int64(1)])
def test_any_real_number_is_a_parameter(value: float) -> None:
    found = make_term("heading_drift", {"b": value}, APR_02).values["b"]
    assert (found, type(found)) == (1.0, float)


REFUSED: dict[str, tuple[str, Mapping[str, Any], str]] = {  # wrong types among them
    "an unknown effect": ("heading_drif", {}, "unknown effect 'heading_drif'; did you mean 'heading_drift'?"),
    "an unknown parameter": ("rotation_translation_coupling", {"kx": 0.1, "kz": 0.1}, "unknown parameter 'kz'"),
    "a parameter of another robot's wheel": (
        "direction_dependent_radius",
        {"k_a": 0.0, "k_b": 0.0, "k_fl": 0.0},
        "unknown parameter 'k_fl'",
    ),
    "a missing parameter": ("floor_drift", {"dx": 0.1}, "parameter 'dy' (1) is missing"),
    "NaN": ("heading_drift", {"b": math.nan}, "parameter 'b' is nan"),
    "a text": ("heading_drift", {"b": "0"}, "parameter 'b' is '0'"),
    "a truth value": ("heading_drift", {"b": True}, "parameter 'b' is True"),
    "what no robot does": ("heading_drift", {"b": 10.0}, "parameter 'b' is 10"),
    "a shape that cannot be": ("start_transient", {"k": 0.1, "length": 0.0}, "parameter 'length' is 0"),
    "NaN for a session's radius": ("tyre_wear", {"radius_x": math.nan}, "parameter 'radius_x' is nan"),
    "a radius larger than any": ("tyre_wear", {"radius_x": 1e300}, "parameter 'radius_x' is 1e+300"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_wrong_is_told_in_one_line(case: str) -> None:
    name, parameters, words = REFUSED[case]
    with refused(UnknownNameError if "unknown" in words else DataError, words, start="cal.yaml: "):
        make_term(name, parameters, APR_02, "cal.yaml")


def signals_in(log: WheelLog, robot: Robot) -> Signals:
    needs = {"poses", "steering_side", "servo_gaps", "caster_rates"}
    return signals_of(log, robot, robot.inverse_kinematic_matrix, PERIOD, needs)


def textbook(effect: MotionEffect, robot: Robot) -> dict[str, float]:
    """The textbook's form with parameters of the largest plausible size."""
    parameters = effect.parameters(robot, SESSIONS)
    return {each.name: each.choices[0] if each.choices else each.largest for each in parameters}


def family(effect: MotionEffect, signals: Signals) -> tuple[Forms, dict[str, Array]]:
    """The forms of an effect on some signals, and the textbook's corrections by 1 of each parameter."""
    values = textbook(effect, signals.robot)
    linear = [each.name for each in effect.parameters(signals.robot, SESSIONS) if not each.choices]
    zero = values | dict.fromkeys(linear, 0.0)
    corrections = {name: effect.correction(signals, zero | {name: 1.0}) for name in linear}
    return forms_of(effect, signals, corrections), corrections


def a_member(name: str, robot: Robot, seed: int) -> Term:
    """A random member of an effect's family."""
    rng, effect = np.random.default_rng(seed), effects.create(name)
    forms, _ = family(effect, signals_in(a_drive(seed, 40, robot), robot))
    varied = {each.name: float(rng.uniform(each.low, each.high)) for each in forms.parameters}
    return make_term(name, textbook(effect, robot) | varied | dict(forms.scales), robot, sessions=SESSIONS)


@pytest.mark.parametrize("name", [*EVERY_MOTION, *SMOOTH_MOTION])
@settings(max_examples=15)
@given(seed=seeds, data=st.data(), samples=st.integers(1, 60), integration=st.sampled_from(["euler", "arc"]))
def test_a_stream_equals_a_batch_with_every_effect_in_every_form(
    name: str, integration: Integration, seed: int, data: st.DataObject, samples: int
) -> None:
    robots = ROBOTS if name in SMOOTH_MOTION else [robot for applied, robot in APPLIED if applied == name]
    robot = EVERY[data.draw(st.sampled_from(sorted(robots)))]
    log = at_every_sample(a_drive(seed, samples, robot))
    member = a_term(name, robot, seed) if name in SMOOTH_MOTION else a_member(name, robot, seed)
    chosen = model(member, robot=robot, integration=integration)
    stream = chosen.stream(log.start, log.session, log.started_at or 0.0)
    np.testing.assert_allclose(streamed(stream, log), chosen.poses([log])[0], rtol=0, atol=1e-12)


@given(seed=seeds)
def test_a_form_leaves_the_textbooks_parameter_as_it_is_without(seed: int) -> None:
    effect = effects.create("centripetal_slip")
    signals = signals_in(a_drive(seed, 200), APR_02)
    forms, corrections = family(effect, signals)
    values = {"k": 0.1} | dict(forms.scales) | {each.name: 0.05 for each in forms.parameters}
    of_family, of_textbook = correction_of(effect, signals, values), corrections["k"]
    assert float((of_family * of_textbook).sum() / np.square(of_textbook).sum()) == pytest.approx(0.1, rel=1e-9)


def test_a_slip_that_saturates_is_a_member_of_the_family() -> None:
    effect = effects.create("centripetal_slip")
    signals = signals_in(a_drive(5, 400), APR_02)
    forms, corrections = family(effect, signals)
    size = np.linalg.norm(corrections["k"], axis=1, keepdims=True)
    saturating = corrections["k"] / (1 + size / np.quantile(size, 0.8))
    zero = {"k": 0.0} | dict.fromkeys((each.name for each in forms.parameters), 0.0) | dict(forms.scales)
    of_forms = [correction_of(effect, signals, zero | {each.name: 1.0}).ravel() for each in forms.parameters]
    alone, together = (
        np.linalg.lstsq(np.column_stack(columns), saturating.ravel(), rcond=None)[1][0]
        for columns in ([corrections["k"].ravel()], [corrections["k"].ravel(), *of_forms])
    )
    assert together < 0.15 * alone


def test_the_form_is_said_in_words() -> None:
    scales = {"turning:low": 0.0, "turning:high": 1.0, "turning:mean_1": 0.0, "turning:mean_2": 0.3}
    assert form_in_words({"k": 0.05}) == "as in the textbook"
    assert form_in_words({"k": 0.05, "k:turning:1": -0.025} | scales) == (
        "0.33 times as large at fast turning as at the other end"
    )
    assert form_in_words({"c": 0.01, "c:wheel:a": 0.002}) == "not the same for all wheels"


@pytest.mark.parametrize("name", ["k:placing:1", "k:wheel:a"])
def test_a_form_that_the_effect_has_not_is_refused(name: str) -> None:
    with pytest.raises(UnknownNameError, match=name):
        make_term("centripetal_slip", {"k": 0.05, name: 0.1}, APR_02)


def test_scales_may_be_as_large_as_a_session_is_long() -> None:
    scales = {"session time:low": 0.0, "session time:high": 2e4, "session time:mean_1": 0.0}
    assert make_term("heading_drift", {"b": 0.001, "b:session time:1": 1e-4} | scales, APR_02).values["b"] == 0.001


# Smooth functions without a name: what they add, where they end, and the same in a stream as in a batch.


def one_sample(**changes: Array) -> Signals:
    """One sample of an APR-02, standing at the origin but for what is said."""
    log = replace(a_drive(1, 1), rates=np.zeros((1, 3)), start=np.zeros(3))
    return replace(signals_of(log, APR_02, APR_02.inverse_kinematic_matrix, PERIOD, {"poses"}), **changes)


def added(name: str, given_signals: Signals, **values: float) -> Array:
    """The correction of a sample; all that is not said is 0, or as usual if it shapes the function."""
    return effects.create(name).correction(given_signals, usual(name) | values)[0]


def driving(vx: float, vy: float, omega: float) -> Array:
    return np.array([[vx, vy, omega]])


def at(x: float, y: float, heading: float = 0.0) -> Array:
    return np.array([[x, y, heading]])


@given(seed=seeds, samples=st.integers(1, 60))
def test_poses_are_those_of_the_uncorrected_path_in_the_middle_of_the_samples(seed: int, samples: int) -> None:
    log, pose = a_drive(seed, samples), np.zeros(3)
    found = signals_of(log, APR_02, APR_02.inverse_kinematic_matrix, PERIOD, {"poses"})
    pose = log.start
    for twist, duration, expected in zip(found.twists, found.durations, found.poses, strict=True):
        after = advance(pose, twist * duration, "arc")
        np.testing.assert_allclose((pose + after) / 2, expected, rtol=0, atol=1e-12)
        pose = after


def test_a_stream_that_is_put_elsewhere_has_its_poses_from_there_on() -> None:
    log = at_every_sample(a_drive(3))
    chosen = model(a_term("smooth_place", APR_02, 3))
    stream = chosen.stream(np.zeros(3), log.session, log.started_at or 0.0)
    stream.drive(np.full(3, 0.1), 0.1)
    stream.pose = log.start.copy()
    np.testing.assert_allclose(streamed(stream, log), chosen.poses([log])[0], rtol=0, atol=1e-12)


def usual(name: str) -> dict[str, float]:
    return {
        each.name: each.choices[0] if each.choices else 0.0
        for each in effects.create(name).parameters(APR_02, SESSIONS)
    }


def test_the_heading_turns_with_the_frame_of_a_stream_and_with_a_motion_that_takes_no_time() -> None:
    chosen = model(make_term("smooth_heading", usual("smooth_heading") | {"along_sin1": 0.1}, APR_02))
    framed, moved = chosen.stream(), chosen.stream()
    framed.frame_heading = math.pi / 2
    moved.drive(np.linalg.solve(chosen.matrix, [0.0, 0.0, math.pi / 2]), 0.0)
    for stream in (framed, moved):
        stream.drive(np.linalg.solve(chosen.matrix, [0.05, 0.0, 0.0]), 0.1)
        np.testing.assert_allclose(stream.moved, [0.055, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "last", "later"),
    [
        ("smooth_time_wave", {"elapsed": np.array([5.0])}, {"elapsed": np.array([7.3])}),
        ("smooth_session_wave", {"session_time": np.array([3600.0])}, {"session_time": np.array([5e3])}),
        ("smooth_place_wave", {"poses": at(2.0, 0.0)}, {"poses": at(3.7, 0.0)}),
    ],
)
def test_waves_end_with_what_was_seen(name: str, last: dict[str, Array], later: dict[str, Array]) -> None:
    there, beyond = (
        added(name, one_sample(twists=driving(0.3, 0.0, 0.0), **place), along_cos=0.1, along_sin=0.05)
        for place in (last, later)
    )
    np.testing.assert_allclose(beyond, there, rtol=1e-12)


@pytest.mark.parametrize(
    ("mode", "expected"),
    [("along", [0.03, 0.04, 0.0]), ("across", [-0.04, 0.03, 0.0]), ("turn", [0.0, 0.0, 0.1 * (0.6 + 0.5 / 0.195)])],
)
def test_a_share_changes_the_motion_along_across_and_in_turning(mode: str, expected: list[float]) -> None:
    found = added("smooth_elapsed_time", one_sample(twists=driving(0.3, 0.4, -0.6)), **{f"{mode}_0": 0.1})
    np.testing.assert_allclose(found, expected, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "column", "number", "duration", "within", "expected"),
    [
        ("smooth_elapsed_time", "elapsed", {"along_3": 0.1}, 2.0, 0.5, 0.1 * math.cos(3 * math.pi / 4)),
        ("smooth_elapsed_time", "elapsed", {"along_3": 0.1}, 2.0, 2.0, -0.1),
        ("smooth_order_of_runs", "session_time", {"rotation_2": 0.1}, 100.0, 75.0, 0.1 * (2 * 0.5**2 - 1)),
        ("smooth_order_of_runs", "session_time", {"rotation_2": 0.1}, 100.0, 100.0, 0.1),
    ],
)
def test_functions_of_the_time_end_with_the_longest_run_or_session_and_are_held(
    name: str, column: str, number: dict[str, float], duration: float, within: float, expected: float
) -> None:
    def after(time: float) -> float:
        one = one_sample(**{column: np.array([time])}, twists=driving(1.0, 0.0, 1.0))
        return float(added(name, one, **number, duration=duration)[0 if "along_3" in number else 2])

    assert after(within) == pytest.approx(expected)
    assert after(1e6) == after(duration)


def test_polynomials_of_the_place_are_held_beyond_the_places_that_were_seen() -> None:
    area = {"centre_x": 1.0, "centre_y": -1.0, "reach": 2.0}

    def here(x: float, y: float) -> float:
        return float(added("smooth_place", one_sample(poses=at(x, y), twists=driving(1.0, 0.0, 0.0)), along_xxy=0.1,
                           **area)[0])  # fmt: skip

    assert here(2.0, 0.0) == pytest.approx(0.1 * 0.5**3)
    assert here(101.0, 99.0) == pytest.approx(0.1 * math.sqrt(0.5) ** 3)


@pytest.mark.parametrize("away", [0.0, 0.5, 5.0])
def test_a_patch_fades_to_zero(away: float) -> None:
    one = one_sample(poses=at(1.0, away - 2.0), twists=driving(1.0, 0.0, 0.0))
    found = added("smooth_patch", one, along_bump=0.1, centre_x=1.0, centre_y=-2.0, radius=0.5)
    assert found[0] == pytest.approx(0.1 * math.exp(-((away / 0.5) ** 2)))


def test_other_motions_than_the_commands_are_hardly_changed() -> None:
    near = {"along_bump": 0.1, "vx": 0.3, "vy": 0.0, "omega": 1.0, "width": 0.05}
    assert added("smooth_command", one_sample(twists=driving(0.3, 0.0, 1.0)), **near)[0] == pytest.approx(0.03)
    turned = added("smooth_command", one_sample(twists=driving(0.3, 0.0, 2.0)), **near)[0]
    assert turned == pytest.approx(0.03 * math.exp(-((0.195 / 0.05) ** 2) / 2))


def test_a_push_in_the_world_turns_with_the_robot() -> None:
    one = one_sample(poses=at(0.0, 0.0, math.pi / 2), twists=driving(0.3, 0.4, 0.0))
    np.testing.assert_allclose(added("smooth_course", one, east=0.1), [0.0, -0.05, 0.0], atol=1e-15)


def test_the_course_is_heading_and_direction_of_travel() -> None:
    one = one_sample(poses=at(0.0, 0.0, 0.4), twists=driving(0.0, 0.5, 0.0))
    found = added("smooth_course", one, along_sin2=0.1)
    np.testing.assert_allclose(found, [0.0, 0.05 * math.sin(2 * (0.4 + math.pi / 2)), 0.0], atol=1e-15)


@pytest.mark.parametrize(("name", "knots"), [("smooth_wheel_rate", 8), ("smooth_common_rate", 33)])
def test_a_function_of_the_wheel_rate_is_linear_between_knots_held_beyond_and_0_at_rest(name: str, knots: int) -> None:
    each = ("_a", "_b", "_c") if name == "smooth_wheel_rate" else ("",)
    spread = {f"change_{knot}{wheel}": 0.01 * (2 * knot / (knots - 1) - 1) for knot in range(knots) for wheel in each}
    found = added(name, one_sample(rates=np.array([[1.3, -50.0, 5e-4]])), top=2.0, **spread)
    np.testing.assert_allclose(found, [0.01 * 1.3 / 2, -0.01, 0.0], atol=1e-15)


def test_a_wave_of_the_wheel_angle_is_its_mean_over_the_sample() -> None:
    found = added("smooth_wheel_angle", one_sample(rates=np.array([[2.0, 0.0, 0.0]]), durations=np.array([0.1]),
                  wheel_angles=np.array([[0.3, 0.0, 0.0]])), b_a=0.02, harmonic=2.5)  # fmt: skip
    begin, end = 0.3 - 0.1, 0.3 + 0.1
    np.testing.assert_allclose(found, [0.02 * (math.cos(2.5 * begin) - math.cos(2.5 * end)) / 2.5 / 0.1, 0, 0])


def test_changes_by_acceleration_end_with_the_largest_that_was_seen() -> None:
    fast, twist = np.array([[6.0, 8.0, -9.0]]), driving(0.3, 0.4, 2.0)
    one = one_sample(accelerations=fast, twists=twist)
    seen = {"top": 5.0, "top_turning": 4.0}
    np.testing.assert_allclose(added("smooth_acceleration", one, straight=0.1, **seen), [0.3, 0.4, 0.0])
    np.testing.assert_allclose(added("smooth_acceleration", one, aside=0.1, **seen), [-0.4, 0.3, 0.0])
    turning = added("smooth_acceleration", one, about_x=0.1, about_omega=0.01, about_size=0.2, **seen)
    np.testing.assert_allclose(turning, [0.0, 0.0, 0.3 - 0.04 + 1.0])
    np.testing.assert_allclose(added("smooth_acceleration", one, rotation=0.1, **seen), [0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("name", "values", "poses", "expected"),
    [
        (
            "smooth_map",
            {"y_xx": 0.01, "centre_x": 0.0, "centre_y": 0.0, "reach": 2.0},
            [[1.0, 0.0, 0.3], [2.0, 0.0, 0.4], [9.0, 0.0, 0.5]],
            [[0, 0, 0], [0, 0.0075, 0], [0, 0.0075, 0]],
        ),
        (
            "smooth_map_patch",
            {"x_bump": 0.01, "centre_x": 1.0, "centre_y": 0.0, "radius": 0.5},
            [[9.0, 0.0, 0.0], [1.0, 0.0, 0.1], [1.5, 0.0, 0.2]],
            [[0, 0, 0], [0.01, 0, 0], [0.01 / math.e, 0, 0]],
        ),
    ],
)
def test_a_bent_map_agrees_at_the_start_is_held_beyond_what_was_seen_and_a_patch_fades(
    name: str, values: dict[str, float], poses: list[list[float]], expected: list[list[float]]
) -> None:
    places = np.array(poses)
    shift = effects.create(name).reported(places, places[0], usual(name) | values) - places
    np.testing.assert_allclose(shift, expected, atol=1e-15)


def test_delays_alternate_grow_and_swing_with_the_stamps() -> None:
    stamps = np.array([0.25, 0.5, 8.0])
    stamped, wave = effects.create("smooth_stamps"), effects.create("smooth_stamp_wave")
    values = usual("smooth_stamps") | {"position_late": 0.1, "heading_alternating": 0.05, "duration": 1, "period": 0.25}
    position, heading = stamped.delays(stamps, values)
    np.testing.assert_allclose(position, [0.025, 0.05, 0.1])
    np.testing.assert_allclose(heading, [-0.05, 0.05, 0.05])
    position, heading = wave.delays(stamps, {"cos": 0.0, "sin": 0.01, "frequency": 1.0})
    np.testing.assert_allclose(position, [0.01, 0.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(position, heading)


def test_a_term_goes_to_other_processes_and_its_values_stay_as_they_are() -> None:
    term = make_term("wheel_dead_zone", {"c": 0.01}, APR_02)
    there = pickle.loads(pickle.dumps(term))
    assert (there.name, dict(there.values), there.weights) == ("wheel_dead_zone", {"c": 0.01}, None)
    with pytest.raises(TypeError):
        term.values["c"] = 0.02  # type: ignore[index]
