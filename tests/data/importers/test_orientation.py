"""Headings from quaternions, of which some mean nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from omnibench.data.importers.rosbag.message_streams import planar_headings


@given(heading=st.floats(-math.pi + 1e-9, math.pi - 1e-9), length=st.floats(0.991, 1.009))
def test_a_length_that_is_nearly_one_does_not_change_the_heading(heading: float, length: float) -> None:
    quaternion = length * np.array([0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)])
    found = planar_headings(quaternion[None])
    assert found.headings[0] == pytest.approx(heading, abs=1e-12)
    assert not found.flawed[0]


@pytest.mark.filterwarnings("error")
@given(arrays(float, (3, 4), elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_any_numbers_give_headings_or_a_flaw_in_words(quaternions: np.ndarray) -> None:
    found = planar_headings(quaternions)
    assert np.isfinite(found.headings).all()
    for index in np.flatnonzero(found.flawed):
        assert "expected 1" in found.flaw(index) or "tilted" in found.flaw(index)


def test_each_flaw_is_found_among_good_ones() -> None:
    found = planar_headings(np.array([[0, 0, 0, 1], [0, 0, 0, 0], [0.6, 0, 0, 0.8], [0, 0, 1, 0], [0, 0, np.nan, 1.0]]))
    assert found.flawed.tolist() == [False, True, True, False, True]
    assert found.flaw(1) == "quaternion has length 0, expected 1"
    assert found.flaw(2) == "pose is tilted by 74 degrees; give poses of the robot's body (z up)"
