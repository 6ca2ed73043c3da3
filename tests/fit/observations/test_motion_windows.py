"""Runs in steps, and windows whose motion is compared."""

from __future__ import annotations

import math

import numpy as np
import pytest

from omnibench.data.dataset import Trajectory
from omnibench.fit.motion_windows import MotionWindows, motions_in_windows

RADIUS, TURN = 2.0, 0.5  # m, rad/s


def on_a_circle(seconds: float, name: str = "run") -> Trajectory:
    """A run whose only wheel turns as fast as it drives, in m, on a circle to the left."""
    times, stamps = 0.02 * np.arange(1, round(seconds / 0.02) + 1), np.append(np.arange(0.0, seconds, 0.1), seconds)
    heading = 0.3 + TURN * stamps
    poses = np.column_stack([RADIUS * np.sin(heading), -RADIUS * np.cos(heading), heading])
    return Trajectory(name, "train", times, np.full((len(times), 1), RADIUS * TURN), stamps, poses)


def test_motions_by_exact_arcs_are_the_references_own() -> None:
    windows = MotionWindows.of([on_a_circle(5.0), on_a_circle(3.03, "b")], (2.0, math.inf), 0.25, 1000)
    twists = windows.drive @ np.array([[1.0, 0.0, 1 / RADIUS]])
    moved = motions_in_windows(twists, windows.durations, windows.windows)
    np.testing.assert_allclose(moved, windows.motions, atol=1e-12)
    angle = TURN * 5.0
    whole = windows.motions[(windows.lengths == 1) & (windows.windows[:, 0] == 0)]
    np.testing.assert_allclose(whole, [[RADIUS * math.sin(angle), RADIUS * (1 - math.cos(angle)), angle]], atol=1e-12)


def test_windows_are_as_long_as_wanted_and_begin_every_half_of_it() -> None:
    windows = MotionWindows.of([on_a_circle(5.0)], (2.0,), 0.1, 1000)
    edges = np.append(0.0, np.cumsum(windows.durations[0]))
    np.testing.assert_allclose(edges[windows.windows[:, 1]], [0, 1, 2, 3], atol=1e-9)
    np.testing.assert_allclose(edges[windows.windows[:, 2]], [2, 3, 4, 5], atol=1e-9)


@pytest.mark.parametrize(("step", "most", "count"), [(0.1, 1000, 50), (0.5, 1000, 10), (0.1, 10, 10)])
def test_steps_are_as_long_as_wanted_or_as_few_as_allowed(step: float, most: int, count: int) -> None:
    assert MotionWindows.of([on_a_circle(5.0)], (math.inf,), step, most).drive.shape == (1, count, 1)
