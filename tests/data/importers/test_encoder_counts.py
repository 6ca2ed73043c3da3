"""Counters that begin again, absolute encoders and repeated readings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.importers.wheel_samples import (
    POWERS_OF_TWO,
    about_zero,
    counted_on,
    recognised_register,
    recognised_wrap,
    repeated_readings,
    turns_restored,
)
from omnibench.robot.kinematics import Array


def drive(seed: int, longest: float) -> Array:
    """Counts of a wheel that turns both ways, in steps of at most ``longest``."""
    speeds = np.convolve(np.random.default_rng(seed).normal(size=400), np.ones(30), "same")
    return np.cumsum(np.round(longest * speeds / np.abs(speeds).max()))


@given(st.integers(0, 10**6), st.integers(8, 48), st.floats(0.01, 0.24), st.booleans(), st.floats(0, 1))
def test_a_counter_of_any_bits_is_recognised_and_counted_on(
    seed: int, bits: int, longest: float, signed: bool, start: float
) -> None:
    wrap = 2.0**bits
    counts = drive(seed, longest * wrap) + np.round(start * wrap)
    shown = counts % wrap - (wrap / 2 if signed else 0)
    wrapped = bool((np.abs(np.diff(shown)) > wrap / 2).any())
    assert recognised_wrap(shown, POWERS_OF_TWO) == (wrap if wrapped else None)
    np.testing.assert_array_equal(np.diff(counted_on(shown, wrap)), np.diff(counts))


def late_drive(seed: int, late: int) -> tuple[Array, Array, Array]:
    """Times, and true and shown counts of a wheel of 200,000 ticks a second by a driver whose register has 16 bits.

    Every so often it reads a quarter of a second late, so that the step loses a turn of the register.
    """
    rng = np.random.default_rng(seed)
    times = 0.04 * np.arange(2000) + rng.uniform(0, 0.01, 2000)
    counts = np.round(200_000 * (times + 0.2 * np.sin(times)) + rng.normal(0, 500, 2000))
    for begin in rng.choice(np.arange(100, 1900, 60), late, replace=False):
        counts[begin : begin + 5] = counts[begin - 1]
    steps = np.diff(counts)
    shown = np.concatenate([counts[:1], counts[0] + np.cumsum(steps - 2**16 * np.round(steps / 2**16))])
    return times, counts, shown


@given(st.integers(0, 10**6), st.integers(1, 5))
def test_turns_that_a_register_lost_are_restored(seed: int, late: int) -> None:
    times, counts, shown = late_drive(seed, late)
    lost = not np.array_equal(counts, shown)
    assert recognised_register(shown, times, POWERS_OF_TWO) == (2**16 if lost else None)
    np.testing.assert_array_equal(turns_restored(shown, times, 2**16), counts)


@given(st.integers(0, 10**6), st.integers(8, 20), st.floats(0.01, 0.24))
def test_a_wheel_that_turns_back_has_lost_no_turns(seed: int, bits: int, longest: float) -> None:
    counts = drive(seed, longest * 2.0**bits)
    assert recognised_register(counts, 0.05 * np.arange(len(counts)), POWERS_OF_TWO) is None


@given(st.integers(0, 10**6), st.integers(300, 10**6))
def test_a_counter_that_is_set_to_zero_does_not_begin_again(seed: int, before: int) -> None:
    counts = np.abs(drive(seed, 3.0))
    assert recognised_wrap(np.concatenate([before + counts, counts]), POWERS_OF_TWO) in (None, power_near(before))


def power_near(number: int) -> float | None:
    """The power of two that a step of this many cannot be told from, if there is one."""
    power = 2.0 ** round(np.log2(number))
    return power if abs(power - number) < 0.05 * power else None


@pytest.mark.parametrize("before", [8_000, 8_100])
def test_a_counter_that_is_set_to_zero_while_its_wheel_turns_has_lost_no_turn(before: int) -> None:
    counts = np.append(np.arange(0, before, 290), np.arange(0, 30_000, 290)).astype(float)
    assert recognised_register(counts, 0.03 * np.arange(len(counts)), POWERS_OF_TWO) is None


def test_steps_of_a_third_of_the_range_are_not_unambiguous() -> None:
    assert recognised_wrap(np.arange(0, 40000.0, 85) % 256, POWERS_OF_TWO) is None


@pytest.mark.parametrize("start", [0.0, 100.0, 8191.0])
def test_an_absolute_encoder_that_counts_from_zero_is_read_about_zero(start: float) -> None:
    angle = 2000 * np.sin(np.linspace(0, 20, 300) + start)
    np.testing.assert_allclose(about_zero(angle % 8192, 8192), angle, atol=1e-9)


def test_an_absolute_encoder_that_counts_both_ways_stays_as_it_is() -> None:
    angle = np.linspace(-3, 3.1, 50)
    np.testing.assert_array_equal(about_zero(angle, 2 * np.pi), angle)


def test_a_potentiometer_that_passes_half_a_turn_makes_no_jump() -> None:
    shown = 512 + 400 * np.sin(np.linspace(0, 6, 100))
    np.testing.assert_array_equal(about_zero(shown, 1229), shown)


def test_only_readings_logged_again_in_the_middle_of_a_drive_are_repeated() -> None:
    steps = np.array([0, 0, 100, 120, 0, 110, 100, 0, 0, 100, 100, 0, 0])
    angles = np.append(0, np.cumsum(steps)).astype(float)[:, None]
    times = np.arange(len(angles), dtype=float)
    assert np.flatnonzero(repeated_readings(times, angles, None)).tolist() == [5]
    steers = np.zeros_like(angles)
    steers[5:] = 0.1  # the steering encoder was read anew
    assert not repeated_readings(times, angles, steers).any()
    rest = times + 3 * (times >= 5)
    assert not repeated_readings(rest, angles, None).any()


def test_a_wheel_that_creeps_from_tick_to_tick_repeats_nothing() -> None:
    angles = np.floor(np.arange(100) * 0.7)[:, None]
    assert not repeated_readings(np.arange(100.0), angles, None).any()
