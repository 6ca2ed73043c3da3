"""The signals that corrections are made from, each against its definition."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from effect_samples import PERIOD, ROBOTS, a_drive
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.robot.odometry import WheelLog
from omnibench.robot.signals import Signals, SignalStream, signals_of, smoothing_share

MATRIX = APR_02.inverse_kinematic_matrix


def of(log: WheelLog) -> Signals:
    return signals_of(log, APR_02, MATRIX, PERIOD)


def test_times_and_angles_are_those_in_the_middle_of_the_sample() -> None:
    log = WheelLog(
        times=np.array([1.0, 3.0]),
        rates=np.array([[1.0, 2.0, 3.0], [-1.0, 0.0, 0.5]]),
        start=np.zeros(3),
        stamps=np.array([3.0]),
        wheel_angles=np.array([[11.0, 12.0, 13.0], [9.0, 12.0, 14.0]]),
        started_at=100.0,
        session="morning",
    )
    found = of(log)
    np.testing.assert_array_equal(found.durations, [1.0, 2.0])
    np.testing.assert_array_equal(found.elapsed, [0.5, 2.0])
    np.testing.assert_array_equal(found.session_time, [100.5, 102.0])
    np.testing.assert_array_equal(found.wheel_angles, [[10.5, 11.0, 11.5], [10.0, 12.0, 13.5]])
    assert found.session == "morning"


def test_what_was_not_recorded_is_not_made_up() -> None:
    found = of(replace(a_drive(1), wheel_angles=None, started_at=None, session=None))
    assert (found.wheel_angles, found.session_time, found.session) == (None, None, None)


def test_an_acceleration_is_the_slope_of_the_smoothed_twist() -> None:
    log, share = a_drive(2), 1 - math.exp(-PERIOD / 0.05)
    found, smoothed = of(log), np.zeros(3)
    for sample, (rates, duration) in enumerate(zip(log.rates, np.diff(log.times, prepend=0.0), strict=True)):
        before, smoothed = smoothed, smoothed + share * (MATRIX @ rates - smoothed)
        np.testing.assert_allclose(found.accelerations[sample], (smoothed - before) / duration, rtol=0, atol=1e-11)


def test_a_steady_acceleration_is_seen_as_it_is() -> None:
    times = PERIOD * np.arange(1, 101)
    direction = np.linalg.solve(MATRIX, [0.5, -0.2, 1.0])
    found = of(WheelLog(times, (times - PERIOD / 2)[:, None] * direction, np.zeros(3), times[-1:]))
    np.testing.assert_allclose(found.accelerations[-1], [0.5, -0.2, 1.0], rtol=1e-9)


def test_the_way_is_counted_from_the_last_rest() -> None:
    forward = np.linalg.solve(MATRIX, [0.5, 0.0, 0.0])
    rates = np.array([forward, forward, 0 * forward, 9e-4 * np.ones(3), forward, -forward])
    found = of(WheelLog(np.arange(1.0, 7.0), rates, np.zeros(3), np.ones(1)))
    np.testing.assert_allclose(found.travelled, [0.25, 0.75, 0.0, 0.0, 0.25, 0.75], rtol=0, atol=1e-12)


@pytest.mark.parametrize("period", [1e-6, 0.01, 0.05, 10.0])
def test_smoothing_takes_a_share_that_depends_on_the_period(period: float) -> None:
    assert smoothing_share(period) == pytest.approx(1 - math.exp(-period / 0.05), rel=1e-9)


@pytest.mark.parametrize("robot", ROBOTS)
@given(seed=st.integers(0, 2**32 - 1), samples=st.integers(1, 60))
def test_a_stream_has_the_signals_of_a_batch(robot: str, seed: int, samples: int) -> None:
    chosen = ROBOTS[robot]
    log, matrix = a_drive(seed, samples, chosen), chosen.inverse_kinematic_matrix
    assert log.wheel_angles is not None
    assert log.started_at is not None
    batch = signals_of(log, chosen, matrix, PERIOD)
    stream = SignalStream(chosen, matrix, PERIOD, log.session, log.started_at)
    for sample, duration in enumerate(np.diff(log.times, prepend=0.0)):
        found = stream.next(log.rates[sample], duration, log.wheel_angles[sample])
        assert (found.robot, found.session) == (batch.robot, batch.session)
        for name in ("durations", "rates", "elapsed", "twists", "travelled", "wheel_angles", "session_time"):
            expected = getattr(batch, name)[sample : sample + 1]
            assert getattr(found, name).shape == expected.shape
            np.testing.assert_allclose(getattr(found, name), expected, rtol=1e-15, atol=1e-12)
        gained = batch.accelerations[sample : sample + 1] * duration
        np.testing.assert_allclose(found.accelerations * duration, gained, rtol=0, atol=1e-12)


def test_a_stream_counts_angles_that_it_is_not_told_from_zero_on() -> None:
    stream = SignalStream(APR_02, MATRIX, PERIOD)
    for expected in ([0.5, -1.0, 0.0], [1.5, -3.0, 0.0]):
        found = stream.next(np.array([1.0, -2.0, 0.0]), 1.0)
        np.testing.assert_array_equal(found.wheel_angles, [expected])


def test_a_stream_counts_on_from_the_last_angles_that_it_was_told() -> None:
    stream = SignalStream(APR_02, MATRIX, PERIOD)
    stream.next(np.ones(3), 1.0, np.array([7.0, 8.0, 9.0]))
    np.testing.assert_array_equal(stream.next(np.ones(3), 1.0).wheel_angles, [[7.5, 8.5, 9.5]])
