"""Every effect of the catalogue: what it says of itself, and its correction against the formula by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, get_args

import numpy as np
import pytest
from effect_samples import APPLIED, EVERY, MOTION, REFERENCE, SESSIONS, a_drive, a_term, built_in
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.registry import effects
from omnibench.robot.effects.effect import (
    ActuatorEffect,
    Effect,
    MotionEffect,
    Need,
    ReferenceEffect,
    Term,
    Values,
    make_term,
)
from omnibench.robot.kinematics import Array
from omnibench.robot.signals import Signals, signals_of

CATALOGUE = {
    "wheel": (
        *("speed_dependent_radius", "direction_dependent_radius", "wheel_dead_zone", "coulomb_creep"),
        *("wheel_eccentricity", "roller_ripple", "thermal_radius_drift", "tyre_wear", "load_transfer"),
        *("light_wheel", "steering_coupling", "wheel_radius", "wheel_position"),
    ),
    "body": (
        *("acceleration_slip", "centripetal_slip", "rotation_translation_coupling", "quadratic_rotation_slip"),
        *("heading_drift", "body_velocity_bias", "start_transient", "icr_shift", "caster_pull"),
    ),
    "steering": (*("steering_gain", "steering_play", "steering_lag", "steering_offset", "driven_steering_offset"),),
    "world": ("floor_drift",),
    "clock": ("sample_period_scale",),
    "reference": (
        *("reference_time_offset", "heading_latency", "reference_clock_drift"),
        *("lidar_lever_arm", "lidar_yaw", "reference_scale"),
    ),
    "actuator": ("motor_lag", "motor_dead_band", "motor_gain"),
}
ABSORBED = {"lidar_lever_arm", "lidar_yaw", "reference_scale", "sample_period_scale"} | {
    *("wheel_radius", "wheel_position", "driven_steering_offset"),
}
COVARIATES = {
    *("command", "elapsed time", "heading", "place", "order of runs", "wheel rate", "wheel angle", "acceleration"),
    *("stamps", "steering angle"),
}
RATES = np.array([[2.0, -1.0, 0.04]])
VX, VY, W = 0.3, -0.2, 0.8
AX, AY = 1.1, 0.7
PHI = np.array([[0.5, 1.2, -2.0]])
SPEED, R = math.hypot(VX, VY), 0.148


def signals(**changes: Any) -> Signals:
    """One sample with numbers that are easy to put into a formula."""
    chosen: dict[str, Any] = {
        "robot": APR_02,
        "durations": np.array([0.01]),
        "rates": RATES,
        "elapsed": np.array([1.5]),
        "twists": np.array([[VX, VY, W]]),
        "accelerations": np.array([[AX, AY, 0.4]]),
        "travelled": np.array([0.1]),
        "wheel_angles": PHI,
        "session_time": np.array([1000.0]),
        "session": "evening",
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
    "start_transient": (
        {"k": 0.2, "length": 0.05},
        [-0.2 * VX * math.exp(-2), -0.2 * VY * math.exp(-2), 0.0],
    ),
    "floor_drift": ({"dx": 0.02, "dy": -0.01}, [0.02 * SPEED, -0.01 * SPEED]),
}


def motion_term(name: str, values: Values) -> tuple[MotionEffect, Values]:
    effect = effects.create(name)
    assert isinstance(effect, MotionEffect)
    return effect, values


@pytest.mark.parametrize("name", MOTION)
def test_a_correction_is_the_formula_of_the_catalogue(name: str) -> None:
    values, expected = BY_HAND[name]
    term = make_term(name, values, APR_02)
    effect, _ = motion_term(name, values)
    # The sign of a rate is smoothed over 0.05 rad/s; at 1 rad/s it is whole to 1e-17.
    np.testing.assert_allclose(effect.correction(signals(), term.values), [expected], rtol=0, atol=1e-14)


def test_the_catalogue_is_complete_and_every_effect_has_its_stage() -> None:
    known = {name: effects.create(name).stage for name in built_in(Effect)}
    assert known == {name: stage for stage, names in CATALOGUE.items() for name in names}


@pytest.mark.parametrize("name", built_in(Effect))
def test_an_effect_says_what_it_is(name: str) -> None:
    effect: Effect = effects.create(name)
    assert effect.shows_in in COVARIATES
    assert effect.physics.endswith(".")
    assert effect.source
    assert bool(effect.measurement) == (name in ABSORBED)
    assert effect.run_nuisance == (name == "reference_clock_drift")
    assert effects.entry(name).summary.endswith(".")


@pytest.mark.parametrize(("name", "robot"), APPLIED)
@given(seed=st.integers(0, 2**32 - 1), factor=st.floats(-3, 3))
def test_a_correction_is_linear_in_its_parameters_and_vanishes_with_them(
    name: str, robot: str, seed: int, factor: float
) -> None:
    chosen, effect = EVERY[robot], effects.create(name)
    log = a_drive(seed, 12, chosen)
    given_signals = signals_of(log, chosen, chosen.inverse_kinematic_matrix, 0.02, effect.needs)
    shapes = {each.name: each.choices[0] for each in effect.parameters(chosen, SESSIONS) if each.choices}
    one, other = (dict(a_term(name, chosen, seed + step).values) | shapes for step in (1, 2))
    mixed = {key: one[key] + factor * other[key] for key in one} | shapes
    found, first, second = (effect.correction(given_signals, values) for values in (mixed, one, other))
    size = max(1.0, float(np.abs(first).max()), float(np.abs(second).max()))
    np.testing.assert_allclose(found, first + factor * second, rtol=0, atol=1e-13 * size)
    assert not effect.correction(given_signals, dict.fromkeys(one, 0.0) | shapes).any()


@pytest.mark.parametrize("name", ["heading_drift", "body_velocity_bias"])
def test_a_drift_acts_only_while_a_wheel_turns(name: str) -> None:
    term = a_term(name, APR_02)
    assert isinstance(term.effect, MotionEffect)
    for rates, acts in (([0.0, 9e-4, 0.0], False), ([0.0, -2e-3, 0.0], True)):
        assert term.effect.correction(signals(rates=np.array([rates])), term.values).any() == acts


@pytest.mark.parametrize("session", ["afternoon", None])
def test_a_session_of_which_no_radius_is_known_is_not_corrected(session: str | None) -> None:
    effect, values = motion_term("tyre_wear", {"radius_evening": 0.01})
    assert not effect.correction(signals(session=session), values).any()


def test_tyre_wear_has_a_radius_for_every_session_but_the_first() -> None:
    found = effects.create("tyre_wear").parameters(APR_02, ("monday", "tuesday", "friday"))
    assert [each.name for each in found] == ["radius_tuesday", "radius_friday"]
    assert not effects.create("tyre_wear").parameters(APR_02)


def test_the_load_of_a_robot_that_turns_at_constant_speed_shifts_inwards() -> None:
    # Driving forward and turning left accelerates to the left: the axles at 60 and 300 deg feel it in opposite ways.
    term = make_term("load_transfer", {"k": 0.1}, APR_02)
    assert isinstance(term.effect, MotionEffect)
    steady = signals(rates=np.ones((1, 3)), twists=np.array([[0.5, 0.0, 1.0]]), accelerations=np.zeros((1, 3)))
    sideways = 0.5 * math.sin(math.radians(60))
    np.testing.assert_allclose(
        term.effect.correction(steady, term.values), [[-0.1 * sideways, 0, 0.1 * sideways]], rtol=0, atol=1e-16
    )


def reference_term(name: str, **values: float) -> tuple[ReferenceEffect, Values]:
    effect = effects.create(name)
    assert isinstance(effect, ReferenceEffect)
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


@pytest.mark.parametrize("name", REFERENCE)
@given(seed=st.integers(0, 2**32 - 1))
def test_what_the_reference_reports_can_be_corrected(name: str, seed: int) -> None:
    poses = np.random.default_rng(seed).normal(0, 3, (5, 3))
    term = a_term(name, APR_02, seed)
    assert isinstance(term.effect, ReferenceEffect)
    reported = term.effect.reported(poses, poses[0], term.values)
    np.testing.assert_allclose(term.effect.corrected(reported, poses[0], term.values), poses, rtol=0, atol=1e-13)


def driven(name: str, durations: Array, targets: Array, **values: float) -> Array:
    effect = effects.create(name)
    assert isinstance(effect, ActuatorEffect)
    return effect.driven(durations, targets, make_term(name, values, APR_02).values)


def test_a_motor_lags_behind_its_target_as_a_first_order_system() -> None:
    ends = np.array([0.05, 0.15, 0.2, 0.5])
    targets = np.array([[2.0, -1.0]] * 4)
    found = driven("motor_lag", np.diff(ends, prepend=0.0), targets, tau=0.1)
    # The mean of 1 - exp(-t / tau) over each sample.
    way = ends - 0.1 * (1 - np.exp(-ends / 0.1))
    expected = np.diff(way, prepend=0.0) / np.diff(ends, prepend=0.0)
    np.testing.assert_allclose(found, expected[:, None] * targets, rtol=0, atol=1e-15)


def test_a_motor_that_lags_forgets_what_it_was_told_before() -> None:
    targets = np.concatenate([np.full((10, 1), 3.0), np.full((200, 1), -1.0)])
    assert driven("motor_lag", np.full(210, 0.01), targets, tau=0.1)[-1, 0] == pytest.approx(-1.0, abs=1e-7)


def test_a_motor_without_a_time_constant_follows_at_once() -> None:
    targets = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_array_equal(driven("motor_lag", np.full(5, 0.1), targets, tau=0.0), targets)


def test_a_dead_band_takes_its_width_off_every_target() -> None:
    found = driven("motor_dead_band", np.ones(1), np.array([[0.05, -0.09, 0.5, -2.0, 0.0]]), band=0.1)
    np.testing.assert_allclose(found, [[0.0, 0.0, 0.4, -1.9, 0.0]], rtol=0, atol=1e-16)


def test_a_gain_scales_every_target() -> None:
    np.testing.assert_allclose(driven("motor_gain", np.ones(1), np.array([[1.0, -2.0]]), g=0.05), [[1.05, -2.1]])


def test_a_term_is_called_by_its_effects_name() -> None:
    assert Term(effects.create("heading_drift"), {"b": 0.0}).name == "heading_drift"


def test_every_need_is_one_of_the_contract() -> None:
    needs = {name: effects.create(name).needs for name in built_in(Effect)}
    every = {need for entry in effects.entries() if entry.origin == "built in" for need in entry.cls.needs}
    assert every == set(get_args(Need))
    assert {name for name, each in needs.items() if "wheel_angles" in each} == {"wheel_eccentricity", "roller_ripple"}
