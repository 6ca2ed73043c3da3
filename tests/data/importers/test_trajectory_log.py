"""What odometry is given of a trajectory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Trajectory

RUN = Trajectory(
    id="1",
    split="train",
    times=np.array([0.1, 0.2]),
    rates=np.ones((2, 3)),
    pose_times=np.array([0.0, 0.1, 0.2]),
    poses=np.arange(9.0).reshape(3, 3),
    session="morning",
    started_at=60.0,
    angles=np.array([[0.1] * 3, [0.2] * 3]),
)


def test_a_log_has_all_that_effects_need() -> None:
    log = RUN.log([0.15])
    assert log.times is RUN.times
    assert log.rates is RUN.rates
    assert log.wheel_angles is RUN.angles
    assert (log.started_at, log.session) == (60.0, "morning")
    np.testing.assert_array_equal(log.start, [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(log.stamps, [0.15])


def test_logs_up_to_the_reference_have_it_too() -> None:
    for log, stamps in ((RUN.final_log, [0.2]), (RUN.reference_log, [0.1, 0.2])):
        assert log.wheel_angles is RUN.angles
        np.testing.assert_array_equal(log.stamps, stamps)


def test_what_is_not_known_of_a_trajectory_is_not_in_its_log() -> None:
    log = replace(RUN, angles=None, started_at=None, session=None).log([0.1])
    assert (log.wheel_angles, log.started_at, log.session) == (None, None, None)
