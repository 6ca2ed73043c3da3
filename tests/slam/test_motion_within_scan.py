"""The motion within a scan: a smooth function of time, whatever the odometry's ticks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omnibench.robot.kinematics import Array, compose, relative
from omnibench.robot.odometry import advance
from omnibench.slam.motion_prior import LastPosePrior, OdometryPrior, smoothed
from omnibench.slam.slam_options import SlamOptions

TIMES = np.array([1.0, 1.25, 1.5])


class Path:
    """Odometry of a constant twist."""

    def __init__(self, twist: Array, start: Array) -> None:
        self._twist, self._start = twist, start

    def __call__(self, times: Array) -> Array:
        return np.array([advance(self._start, self._twist * time, "arc") for time in times])


def circle(speed: float, turn_rate: float, start: Array | None = None) -> Path:
    return Path(np.array([speed, 0.0, turn_rate]), np.zeros(3) if start is None else start)


@given(
    speed=st.floats(-1, 1), turn_rate=st.floats(-2, 2), heading=st.floats(-4, 4), duration=st.sampled_from([0.02, 0.2])
)
def test_a_steady_twist_is_found_as_it_is(speed: float, turn_rate: float, heading: float, duration: float) -> None:
    path = circle(speed, turn_rate, np.array([1.0, 2.0, heading]))
    (_, within, _), coarse = smoothed(path, TIMES, duration)
    np.testing.assert_allclose(within.mean, [speed, 0.0, turn_rate], atol=1e-6)
    np.testing.assert_allclose(within.at(np.array([duration])), [duration * within.mean], atol=1e-9)
    np.testing.assert_allclose([coarse, within.deviations], 0.0, atol=1e-6)


def test_a_robot_that_speeds_up_is_followed_through_the_scan() -> None:
    def speeding(times: Array) -> Array:
        return np.column_stack([0.25 * times**2, 0.05 * times**2, 0 * times])

    (_, within, _), _ = smoothed(speeding, TIMES, 0.2)
    delays = np.linspace(0.0, 0.2, 5)
    expected = speeding(1.25 + delays) - speeding(np.array([1.25]))
    np.testing.assert_allclose(within.at(delays), expected, atol=1e-9)


def test_a_scan_without_ticks_is_as_uncertain_as_scans_are_in_the_mean() -> None:
    """A robot that stands at first shows no ticks then, and has them all the same."""

    def ticking_later(times: Array) -> Array:
        return np.column_stack([0.002 * np.floor(0.137 * np.maximum(times - 2.0, 0.0) / 0.002), 0 * times, 0 * times])

    motions, _ = smoothed(ticking_later, np.array([1.0, 3.0, 3.5]), 0.2)
    still, *moving = (motion.deviations[0] ** 2 for motion in motions)
    assert still > 0
    assert sum(moving) / 3 <= still <= min(moving) * (1 + 1e-9)


def test_ticks_are_smoothed_out_and_what_they_hide_is_said() -> None:
    tick = 0.002

    def ticking(times: Array) -> Array:
        return np.column_stack([tick * np.floor(0.137 * times / tick), 0 * times, 0 * times])

    times = 1.0 + 0.23 * np.arange(40)
    found, coarse = smoothed(ticking, times, 0.02)
    assert coarse[0] == pytest.approx(tick / np.sqrt(12), rel=0.2)
    missed = np.array([within.mean[0] - 0.137 for within in found])
    assert np.abs(missed).max() < 0.02  # while the ticks within 20 ms tell 0.1 or 0.2 m/s
    assert (np.abs(missed) < 3 * np.array([within.deviations[0] for within in found])).all()


def test_a_scanner_without_delays_needs_no_motion() -> None:
    found, coarse = smoothed(circle(0.3, 1.0), TIMES, 0.0)
    assert not np.any([within.mean for within in found])
    assert not coarse.any()


class TestCorrected:
    """What the pose found tells of an odometry that is wrong in scale."""

    LAST = np.array([0.4, -0.3, 1.0])

    def test_odometry_that_is_short_is_put_right_within_the_scan(self) -> None:
        motion = OdometryPrior(circle(0.27, 0.9), TIMES, 0.1, SlamOptions())  # of 0.3 m/s and 1 rad/s
        found = compose(self.LAST, advance(np.zeros(3), np.array([0.3, 0.0, 1.0]) * 0.25, "arc"))
        twist, deviations = motion.correct(1, self.LAST, found, np.array([0.03, 0.0, 0.1]))
        np.testing.assert_allclose(twist, [0.03, 0.0, 0.1], rtol=0.05, atol=1e-6)
        assert (deviations < [0.01, 0.01, 0.05]).all()

    def test_of_a_robot_that_only_now_begins_to_move_nothing_is_known_but_the_odometrys_error(self) -> None:
        def begins(times: Array) -> Array:
            return np.column_stack([0.5 * np.maximum(times - 1.25, 0.0) ** 2, 0 * times, 0 * times])

        motion = OdometryPrior(begins, TIMES, 0.2, SlamOptions(odometry_error=0.1))
        twist, deviations = motion.correct(1, self.LAST, compose(self.LAST, np.array([1e-3, 0.0, 0.0])), np.zeros(3))
        speed = motion.predict(1, self.LAST).within.mean[0]
        assert 0.05 < speed < 0.15
        assert np.abs(twist).max() < 1e-3
        assert deviations[0] > 0.1 * speed

    def test_a_twist_between_scans_is_that_of_the_arc_and_not_of_its_chord(self) -> None:
        motion = LastPosePrior(TIMES, 0.1, SlamOptions())
        path = circle(0.3, 1.0)(TIMES)
        assert motion.predict(1, path[0]).within.mean == pytest.approx(0.0)
        twist, _ = motion.correct(1, path[0], path[1], np.zeros(3))
        then = motion.predict(2, path[1]).within.mean
        np.testing.assert_allclose(then, [0.3, 0.0, 1.0], atol=1e-12)
        twist, _ = motion.correct(2, path[1], path[2], np.zeros(3))
        np.testing.assert_allclose(twist, 0.0, atol=1e-12)
        assert abs(relative(path[0], path[1])[1]) > 0.009  # m, which a chord would take for a motion to the left
