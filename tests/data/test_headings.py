"""Reference headings are unwrapped once, on loading."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.data.dataset import Trajectory, make_dataset
from omnibench.data.headings import unwrap
from omnibench.robot.kinematics import Array, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

TURN = 2 * math.pi


def driven(turn_rates: Array, stamps: Array, start: float = 0.3) -> WheelLog:
    """A run at 0.2 m/s that turns at each rate for 0.1 s."""
    twists = np.column_stack([np.full(len(turn_rates), 0.2), np.zeros(len(turn_rates)), turn_rates])
    times = 0.1 * np.arange(1, len(turn_rates) + 1)
    return WheelLog(times, twists @ wheel_equations(APR_02.wheels).T, np.array([0.0, 0.0, start]), stamps)


def true_headings(log: WheelLog) -> Array:
    return OdometryModel.of_design(APR_02, "arc").poses([log])[0][:, 2]


def wrapped(headings: Array) -> Array:
    return (headings + math.pi) % TURN - math.pi


def unwrapped(log: WheelLog, headings: Array) -> Array:
    (found,), _ = unwrap(APR_02, [log], [headings])
    return found


@pytest.mark.parametrize("rate", [-1.5, 0.0, 0.02, 1.5])
def test_dense_headings_that_wrap_become_continuous(rate: float) -> None:
    log = driven(np.full(300, rate), np.arange(0, 30, 0.25))
    np.testing.assert_allclose(unwrapped(log, wrapped(true_headings(log))), true_headings(log), atol=1e-9)


def test_headings_that_wrap_at_a_full_turn_become_continuous_too() -> None:
    log = driven(np.full(300, -1.1), np.arange(0, 30, 0.25))
    np.testing.assert_allclose(unwrapped(log, true_headings(log) % TURN), true_headings(log), atol=1e-9)


@pytest.mark.parametrize("rate", [-1.5, -0.7, 0.7, 1.5])
def test_the_odometry_decides_where_only_start_and_end_are_known(rate: float) -> None:
    log = driven(np.full(100, rate), np.array([0.0, 10.0]))
    assert abs(true_headings(log)[1] - true_headings(log)[0]) > TURN
    np.testing.assert_allclose(unwrapped(log, wrapped(true_headings(log))), true_headings(log), atol=1e-9)


def test_the_odometry_may_be_a_little_wrong_where_it_decides() -> None:
    log = driven(np.full(100, 1.5), np.array([0.0, 10.0]))
    truth = true_headings(log) * [1.0, 1.05]  # the robot turned by 5 % more than designed
    np.testing.assert_allclose(unwrapped(log, wrapped(truth)), truth, atol=1e-9)


def test_dense_headings_are_right_even_if_the_odometry_is_far_off() -> None:
    log = driven(np.full(300, 1.0), np.arange(0, 30, 0.25))
    slipping = 0.3 + (true_headings(log) - 0.3) * 0.4  # the odometry turns 2.5 times as far
    np.testing.assert_allclose(unwrapped(log, wrapped(slipping)), slipping, atol=1e-9)


@given(seed=st.integers(0, 2**16), gap=st.sampled_from([0.1, 0.5, 3.0]))
def test_continuous_headings_stay_as_they_are_to_the_bit(seed: int, gap: float) -> None:
    rng = np.random.default_rng(seed)
    log = driven(rng.normal(0, 2, 100), np.arange(0, 10, gap))
    headings = true_headings(log) + rng.normal(0, 0.05, len(log.stamps))
    assert unwrapped(log, headings).tobytes() == headings.tobytes()


@given(seed=st.integers(0, 2**16), gap=st.sampled_from([0.1, 0.5, 3.0]))
def test_whole_turns_in_a_recording_change_nothing(seed: int, gap: float) -> None:
    rng = np.random.default_rng(seed)
    log = driven(rng.normal(0, 2, 100), np.arange(0, 10, gap))
    headings = true_headings(log) + rng.normal(0, 0.05, len(log.stamps))
    whole_turns = TURN * rng.integers(-3, 4, len(headings))
    found = unwrapped(log, headings + whole_turns)
    np.testing.assert_allclose(found - found[0], headings - headings[0], atol=1e-9)


def test_the_start_heading_stays_as_recorded() -> None:
    log = driven(np.full(50, 1.0), np.arange(0, 5, 0.5), start=-2.0)
    assert unwrapped(log, wrapped(true_headings(log)))[0] == wrapped(true_headings(log))[0]


def test_headings_that_odometry_does_not_confirm_are_doubtful() -> None:
    sound = driven(np.full(100, 1.5), np.array([0.0, 10.0]))
    off = true_headings(sound) * [1.0, 1.12]  # 1.8 rad more than the odometry
    _, doubtful = unwrap(APR_02, [sound, sound], [true_headings(sound), wrapped(off)])
    assert doubtful == [1]


def test_a_data_set_holds_unwrapped_headings_and_warns_of_doubtful_ones() -> None:
    stamps = np.array([0.0, 10.0])
    log = driven(np.full(100, 1.5), stamps)
    poses = OdometryModel.of_design(APR_02, "arc").poses([log])[0]
    truth = poses[:, 2]
    sound = Trajectory("sound", "train", log.times, log.rates, stamps, np.column_stack([poses[:, :2], wrapped(truth)]))
    odd = replace(sound, id="odd", poses=np.column_stack([poses[:, :2], wrapped(truth * [1.0, 1.12])]))
    dataset = make_dataset("turns", APR_02, 0.1, [sound, odd])
    np.testing.assert_allclose(dataset.trajectories[0].poses[:, 2], truth, atol=1e-9)
    assert dataset.warnings == ("headings of 1 trajectory may be unwrapped wrongly (reference too sparse): odd",)
