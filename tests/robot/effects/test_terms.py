"""Terms of the model: their parameters and forms, the same in a stream as in a batch, and what is wrong with them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from commands import refused
from effect_samples import (
    APPLIED,
    EVERY,
    EVERY_MOTION,
    PERIOD,
    SESSIONS,
    a_drive,
    a_term,
    at_every_sample,
    built_in,
    model,
    streamed,
)
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.errors import DataError, UnknownNameError
from omnibench.registry import effects
from omnibench.robot.effects.effect import (
    Effect,
    Forms,
    MotionEffect,
    Term,
    correction_of,
    form_in_words,
    forms_of,
    make_term,
)
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import WheelLog, advance
from omnibench.robot.signals import Signals, signals_of


@pytest.mark.parametrize("value", [1, np.float64(1.0), np.int64(1)])
def test_any_real_number_is_a_parameter(value: float) -> None:
    found = make_term("heading_drift", {"b": value}, APR_02).values["b"]
    assert (found, type(found)) == (1.0, float)


@pytest.mark.parametrize("name", built_in(Effect))
def test_every_effect_takes_its_own_parameters(name: str) -> None:
    for robot in filter(effects.create(name).applies, EVERY.values()):
        known = effects.create(name).parameters(robot, ("x", "y"))
        given = {each.name: each.choices[-1] if each.choices else each.high for each in known}
        assert dict(make_term(name, given, robot, sessions=("x", "y")).values) == given


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
    "infinity": ("heading_drift", {"b": -math.inf}, "parameter 'b' is -inf"),
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


def test_tyre_wear_takes_the_radius_of_any_session_or_none() -> None:
    assert dict(make_term("tyre_wear", {"radius_2023-01-12": 0.01}, APR_02).values) == {"radius_2023-01-12": 0.01}
    assert not make_term("tyre_wear", {}, APR_02).values


seeds = st.integers(0, 2**32 - 1)


def signals_in(log: WheelLog, robot: Robot) -> Signals:
    needs = {"poses", "steering_side", "caster_rates"}
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


@pytest.mark.parametrize("name", EVERY_MOTION)
@given(seed=seeds, data=st.data(), samples=st.integers(1, 30))
def test_a_stream_equals_a_batch_in_every_form(name: str, seed: int, data: st.DataObject, samples: int) -> None:
    robot = EVERY[data.draw(st.sampled_from([robot for applied, robot in APPLIED if applied == name]))]
    log = at_every_sample(a_drive(seed, samples, robot))
    chosen = model(a_member(name, robot, seed), robot=robot)
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


def test_a_motion_that_takes_no_time_moves_the_uncorrected_path_as_well() -> None:
    chosen = model(make_term("smooth_heading", usual("smooth_heading") | {"along_sin1": 0.1}, APR_02))
    stream, quarter = chosen.stream(), np.linalg.solve(chosen.matrix, [0.0, 0.0, math.pi / 2])
    stream.drive(quarter, 0.0)
    stream.drive(np.linalg.solve(chosen.matrix, [0.05, 0.0, 0.0]), 0.1)
    np.testing.assert_allclose(stream.moved, [0.055, 0.0, 0.0], atol=1e-12)


def usual(name: str) -> dict[str, float]:
    return {
        each.name: each.choices[0] if each.choices else 0.0
        for each in effects.create(name).parameters(APR_02, SESSIONS)
    }


def test_the_heading_is_the_references_in_a_stream_whose_frame_is_turned() -> None:
    chosen = model(make_term("smooth_heading", usual("smooth_heading") | {"along_sin1": 0.1}, APR_02))
    stream = chosen.stream()
    stream.frame_heading = math.pi / 2
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
