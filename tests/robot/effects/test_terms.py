"""Terms of the model: their parameters and forms, the same in a stream as in a batch, and what is wrong with them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from effect_samples import (
    APPLIED,
    EVERY,
    EVERY_MOTION,
    PERIOD,
    SESSIONS,
    a_drive,
    at_every_sample,
    built_in,
    model,
    streamed,
)
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.errors import DataError, OmnibenchError, UnknownNameError
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
from omnibench.robot.odometry import WheelLog
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
    with pytest.raises(OmnibenchError) as refusal:
        make_term(name, parameters, APR_02, "cal.yaml")
    assert str(refusal.value).startswith("cal.yaml: ")
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert isinstance(refusal.value, UnknownNameError if "unknown" in words else DataError)


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
