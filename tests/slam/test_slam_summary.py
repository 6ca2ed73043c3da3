"""How far two references of the same runs are apart."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.dataset import Dataset
from omnibench.slam.slam_request import distances
from omnibench.testing.synthetic import synthetic_dataset

DATA = synthetic_dataset()


def moved(data: Dataset, by: tuple[float, float, float], turns: int = 0) -> Dataset:
    """Every pose but the first of each run moved, and the headings of all by whole turns."""
    whole = [0.0, 0.0, 2 * math.pi * turns]
    runs = [
        replace(run, poses=run.poses + np.where(run.pose_times[:, None] > 0, by, 0.0) + whole)
        for run in data.trajectories
    ]
    return replace(data, trajectories=tuple(runs))


def thinned(data: Dataset, kept: slice) -> Dataset:
    runs = [replace(run, pose_times=run.pose_times[kept], poses=run.poses[kept]) for run in data.trajectories]
    return replace(data, trajectories=tuple(runs))


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-9, 9), st.integers(-2, 2))
def test_a_shift_is_found_whatever_turns_headings_begin_with(x: float, y: float, turn: float, turns: int) -> None:
    found = distances(DATA, moved(DATA, (x, y, turn), turns))
    assert found is not None
    assert found.poses == sum(len(run.poses) - 1 for run in DATA.trajectories)
    assert found.position_mean_m == pytest.approx(math.hypot(x, y), abs=1e-9)
    assert found.position_p95_m == pytest.approx(math.hypot(x, y), abs=1e-9)
    assert found.heading_mean_rad == pytest.approx(abs(turn), abs=1e-9)
    assert found.heading_p95_rad == pytest.approx(abs(turn), abs=1e-9)


def test_the_sparser_reference_says_where_they_are_compared() -> None:
    sparse = moved(thinned(DATA, slice(None, None, 5)), (0.03, 0.04, 0.0))
    expected = sum(len(run.poses) - 1 for run in sparse.trajectories)
    for one, other in ((DATA, sparse), (sparse, DATA)):
        found = distances(one, other)
        assert found is not None
        assert found.poses == expected
        assert found.position_mean_m == pytest.approx(0.05)


def test_what_has_no_times_in_common_is_not_compared() -> None:
    assert distances(thinned(DATA, slice(0, 1)), DATA) is None
