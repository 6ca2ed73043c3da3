"""Counters of wheels between two readings, by themselves."""

from __future__ import annotations

import numpy as np
import pytest

from omnibench.live.estimation.counts import Counts
from omnibench.live.wheels.wheel_input import WheelAngles


@pytest.mark.parametrize(("turned", "believed"), [(2.0, True), (4.0, False)])
def test_a_slow_robot_may_have_turned_its_wheels_by_half_a_turn_in_a_silence(turned: float, believed: bool) -> None:
    """At 0.1 rad/s so far, 1 s may hold 1.5 x 0.1 rad and half a turn to get going; more is a counter set anew."""
    counts = Counts()
    angles = WheelAngles(2, None, 50.0, counts)
    angles.begin(np.array([20.0, 30.0]))
    angles.turned(np.array([20.05, 30.05]), np.full(2, 0.1), 0.5)
    unseen, whole = angles.turned_unseen(np.array([20.05, 30.05]) + turned, 1.0)
    assert unseen == pytest.approx([turned * believed] * 2)
    assert (whole, counts.counter_restarts) == (believed, int(not believed))
