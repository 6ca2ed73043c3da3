"""Forms of an effect: families with the textbook's form as a member, the same in a stream as in a batch."""

from __future__ import annotations

import numpy as np
import pytest
from effect_samples import EVERY, EVERY_MOTION, PERIOD, SESSIONS, a_drive, at_every_sample, model, streamed, that_apply
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.errors import UnknownNameError
from omnibench.registry import effects
from omnibench.robot.effects.effect import Forms, MotionEffect, Term, correction_of, form_in_words, forms_of, make_term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import WheelLog
from omnibench.robot.signals import Signals, signals_of

FORMED = [(name, robot) for robot in EVERY for name in that_apply(EVERY_MOTION, EVERY[robot])]
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
    assert isinstance(effect, MotionEffect)
    forms, _ = family(effect, signals_in(a_drive(seed, 40, robot), robot))
    varied = {each.name: float(rng.uniform(each.low, each.high)) for each in forms.parameters}
    return make_term(name, textbook(effect, robot) | varied | dict(forms.scales), robot, sessions=SESSIONS)


@pytest.mark.parametrize(("name", "robot"), FORMED)
@given(seed=seeds, samples=st.integers(1, 30))
def test_a_stream_equals_a_batch_in_every_form(name: str, robot: str, seed: int, samples: int) -> None:
    log = at_every_sample(a_drive(seed, samples, EVERY[robot]))
    chosen = model(a_member(name, EVERY[robot], seed), robot=EVERY[robot])
    stream = chosen.stream(log.start, log.session, log.started_at or 0.0)
    np.testing.assert_allclose(streamed(stream, log), chosen.poses([log])[0], rtol=0, atol=1e-12)


@given(seed=seeds)
def test_a_form_leaves_the_textbooks_parameter_as_it_is_without(seed: int) -> None:
    effect = effects.create("centripetal_slip")
    assert isinstance(effect, MotionEffect)
    signals = signals_in(a_drive(seed, 200), APR_02)
    forms, corrections = family(effect, signals)
    values = {"k": 0.1} | dict(forms.scales) | {each.name: 0.05 for each in forms.parameters}
    of_family, of_textbook = correction_of(effect, signals, values), corrections["k"]
    assert float((of_family * of_textbook).sum() / np.square(of_textbook).sum()) == pytest.approx(0.1, rel=1e-9)


def test_a_slip_that_saturates_is_a_member_of_the_family() -> None:
    effect = effects.create("centripetal_slip")
    assert isinstance(effect, MotionEffect)
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


def test_a_form_that_the_effect_has_not_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="k:placing:1"):
        make_term("centripetal_slip", {"k": 0.05, "k:placing:1": 0.1}, APR_02)
    with pytest.raises(UnknownNameError, match="k:wheel:a"):
        make_term("centripetal_slip", {"k": 0.05, "k:wheel:a": 0.1}, APR_02)


def test_scales_may_be_as_large_as_a_session_is_long() -> None:
    scales = {"session time:low": 0.0, "session time:high": 2e4, "session time:mean_1": 0.0}
    assert make_term("heading_drift", {"b": 0.001, "b:session time:1": 1e-4} | scales, APR_02).values["b"] == 0.001
