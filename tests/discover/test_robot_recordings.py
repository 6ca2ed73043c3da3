"""Recordings with a real chain's artefacts (late motors, encoder ticks, a late reference) do not mislead discover."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chain_study import config_of, false_names
from discovery_samples import COUPLING, simulated
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.discover.discover import discover_effects
from omnibench.discover.selection.screening import quantisation_steps
from omnibench.simulate.simulate import simulate_dataset

FEW: dict[str, Any] = {
    "commands": {"speeds": [0.2], "directions_deg": [0, 120, 240], "turn_rates": [-0.35, 0.0, 0.35]},
    "repetitions": 2,
}


def recorded(variant: str) -> Dataset:
    return simulate_dataset(config_of(variant, 5, **FEW), variant).dataset


@pytest.mark.slow
def test_no_effect_is_named_that_the_simulated_robot_does_not_have() -> None:
    found = discover_effects(recorded("coarse"))
    assert not false_names(found)
    assert {effect.stage for effect in found.effects} <= {"actuator"}
    assert all(place.stage == "actuator" or place.within_ticks for place in found.left if place.p_value < 0.002)


def test_a_late_lidar_is_named_as_the_offset_of_the_reference() -> None:
    found = discover_effects(recorded("latency"))
    assert not false_names(found)
    (offset,) = [effect for effect in found.effects if effect.name == "reference_time_offset"]
    assert offset.weight > 0.95
    assert offset.parameters[0].value == pytest.approx(0.03, abs=0.002)


def trajectory(steps: np.ndarray) -> Trajectory:
    times = 0.01 * np.arange(1, len(steps) + 1)
    return Trajectory("run", "train", times, steps / 0.01, times[[0, -1]], np.zeros((2, 3)))


@given(
    tick=st.floats(1e-5, 0.05),
    seed=st.integers(0, 2**32 - 1),
    most=st.integers(1, 200),
)
def test_the_size_of_a_tick_is_found(tick: float, seed: int, most: int) -> None:
    counts = np.random.default_rng(seed).integers(-most, most + 1, size=(400, 3))
    counts[:2] = [[most] * 3, [most - 1] * 3]
    np.testing.assert_allclose(quantisation_steps([trajectory(tick * counts)]), tick, rtol=1e-9)


@given(seed=st.integers(0, 2**32 - 1))
def test_rates_that_are_no_whole_ticks_have_none(seed: int) -> None:
    steps = np.random.default_rng(seed).normal(size=(400, 3))
    assert not quantisation_steps([trajectory(steps)]).any()


def test_rounding_to_ticks_is_told_apart_from_an_effect_many_times_as_large() -> None:
    made = simulated(COUPLING)
    tick, period = 2 * np.pi / 3200, made.sample_period
    runs = []
    for run in made.trajectories:
        angles = tick * np.floor(np.vstack([np.zeros(3), np.cumsum(run.rates, axis=0) * period]) / tick)
        runs.append(replace(run, rates=np.diff(angles, axis=0) / period, angles=angles[1:]))
    found = discover_effects(make_dataset("ticks", made.robot, period, runs, simulated=True))
    assert [effect.name for effect in found.effects] == ["rotation_translation_coupling"]
