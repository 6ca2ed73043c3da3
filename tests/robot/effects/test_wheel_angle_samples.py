"""Effects by wheel angle of one sample at a time, which have their own arithmetic, against many at once."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from effect_samples import PERIOD, ROBOTS, a_drive, a_term
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.robot.effects.effect import MotionEffect
from omnibench.robot.kinematics import Array
from omnibench.robot.signals import Signals, signals_of

EFFECTS = ("wheel_eccentricity", "roller_ripple")


def one(signals: Signals, sample: int) -> Signals:
    """One sample of many."""
    own: dict[str, Any] = {}
    for item in fields(signals):
        value = getattr(signals, item.name)
        own[item.name] = value[sample : sample + 1] if isinstance(value, np.ndarray) else value
    return replace(signals, **own)


def corrections(name: str, robot: str, seed: int) -> tuple[Array, Array]:
    """Of all samples at once, and one after another."""
    chosen = ROBOTS[robot]
    term = a_term(name, chosen, seed)
    assert isinstance(term.effect, MotionEffect)
    signals = signals_of(a_drive(seed, robot=chosen), chosen, chosen.inverse_kinematic_matrix, PERIOD)
    single = [term.effect.correction(one(signals, sample), term.values) for sample in range(len(signals.rates))]
    assert {each.shape for each in single} == {(1, len(chosen.wheels))}
    return term.effect.correction(signals, term.values), np.concatenate(single)


@given(st.sampled_from(EFFECTS), st.sampled_from(sorted(ROBOTS)), st.integers(0, 10_000))
def test_samples_that_come_singly_are_corrected_as_in_batch(name: str, robot: str, seed: int) -> None:
    together, singly = corrections(name, robot, seed)
    assert np.abs(together).max() > 1e-3
    np.testing.assert_allclose(singly, together, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", EFFECTS)
def test_without_amplitude_nothing_is_added(name: str) -> None:
    term = a_term(name, APR_02, 1, scale=0.0)
    assert isinstance(term.effect, MotionEffect)
    signals = signals_of(a_drive(1), APR_02, APR_02.inverse_kinematic_matrix, PERIOD)
    assert not term.effect.correction(one(signals, 3), term.values).any()
