"""Bringing wheel samples and reference poses to a common t = 0."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.clock_matching import align, median_period

WHEELS = 0.01 * np.arange(1, 101)


def poses_at(times: np.ndarray) -> np.ndarray:
    """A robot at constant speed, turning through +-pi."""
    heading = 3.0 + 2.0 * times
    return np.column_stack([0.2 * times, -0.1 * times, (heading + math.pi) % (2 * math.pi) - math.pi])


@given(epoch=st.floats(-1e6, 1e6), first=st.floats(-0.2, 0.5), period=st.floats(0.05, 0.3))
def test_the_epoch_of_the_clock_does_not_matter(epoch: float, first: float, period: float) -> None:
    stamps = np.arange(first, 1.2, period)
    here = align(0.0, WHEELS, stamps, poses_at(stamps))
    there = align(epoch, WHEELS + epoch, stamps + epoch, poses_at(stamps))
    assert here is not None
    assert there is not None
    assert there.zero - epoch == pytest.approx(here.zero, abs=1e-8)
    np.testing.assert_allclose(there.pose_times, here.pose_times, atol=1e-8)


@given(first=st.floats(-0.3, -1e-3), period=st.floats(0.05, 0.3))
def test_the_start_pose_is_interpolated_through_the_heading_s_wrap(first: float, period: float) -> None:
    stamps = np.arange(first, 1.0, period)
    aligned = align(0.0, WHEELS, stamps, poses_at(stamps))
    assert aligned is not None
    assert aligned.zero == 0.0
    np.testing.assert_allclose(aligned.poses[0, :2], [0, 0], atol=1e-9)
    assert math.remainder(aligned.poses[0, 2] - 3.0, 2 * math.pi) == pytest.approx(0, abs=1e-9)


def test_a_pose_at_the_wheels_begin_is_taken_as_it_is() -> None:
    stamps = np.array([-0.1, 0.0, 0.5])
    aligned = align(0.0, WHEELS, stamps, poses_at(stamps))
    assert aligned is not None
    assert aligned.poses[0].tolist() == poses_at(stamps)[1].tolist()
    assert aligned.pose_times.tolist() == [0.0, 0.5]


@pytest.mark.parametrize("stamps", [[5.0, 6.0], [-6.0, -5.0], [0.5, 3.0], [-1.0, 2.0], [0.5]])
def test_streams_that_share_no_two_poses_are_told(stamps: list[float]) -> None:
    times = np.array(stamps)
    assert align(0.0, WHEELS, times, poses_at(times)) is None


def test_the_inputs_stay_as_they_are() -> None:
    stamps = np.array([-0.1, 0.4, 0.5])
    poses = poses_at(stamps)
    align(0.0, WHEELS, stamps, poses)
    assert poses.tolist() == poses_at(stamps).tolist()


def test_the_median_period_ignores_gaps_and_rounding() -> None:
    times = np.concatenate([0.01 * np.arange(1, 50), [3.0]])
    assert median_period([times, times + 1e-9]) == 0.01
