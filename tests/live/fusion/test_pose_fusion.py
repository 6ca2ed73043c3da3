"""Fusing SLAM poses at their own time, whenever they arrive."""

from __future__ import annotations

import numpy as np
import pytest
from drives import ORIGIN, SECOND, motion
from hypothesis import given
from hypothesis import strategies as st

from omnibench.live.estimation.counts import Counts
from omnibench.live.estimation.live_odometry import Motion
from omnibench.live.fusion.pose_fusion import Fusion, FusionSettings
from omnibench.live.fusion.timeline import Entry, PoseMeasurement, Timeline
from omnibench.robot.odometry import advance

R = np.diag([1e-4, 1e-4, 1e-4])


class Robot:
    """A robot that drives a bend of radius 1 m at 0.5 m/s, 100 samples a second, and its filter."""

    def __init__(self, **settings: object) -> None:
        self.counts = Counts()
        chosen = FusionSettings.model_validate(settings)
        self.timeline = Timeline(chosen.history)
        self.fusion = Fusion(chosen, self.timeline, self.counts)
        self.truth = [np.zeros(3)]
        self._append(motion(ORIGIN, np.zeros(3), 0.0))

    def drive(self, samples: int) -> Robot:
        for _ in range(samples):
            moved = np.array([0.005, 0.0, 0.005])
            self.truth.append(advance(self.truth[-1], moved, "arc"))
            self._append(motion(ORIGIN + len(self.truth) * 10_000_000 - 10_000_000, moved))
        return self

    def _append(self, moved: Motion) -> None:
        pose, covariance = self.fusion.predict(moved)
        self.timeline.append(Entry(moved.stamp, moved, self.truth[-1], pose, covariance))
        self.fusion.take_waiting()

    def at(self, time: float) -> np.ndarray:
        """The true pose at a time, s."""
        whole = int(time / 0.01 + 1e-9)
        return advance(self.truth[whole], (time / 0.01 - whole) * np.array([0.005, 0.0, 0.005]), "arc")

    def see(self, time: float, error: tuple[float, float, float] = (0, 0, 0), covariance: np.ndarray = R) -> str:
        return self.fusion.correct(PoseMeasurement(stamp(time), self.at(time) + error, covariance))


def stamp(time: float) -> int:
    return ORIGIN + round(time * SECOND)


@given(st.data())
def test_poses_may_come_late_and_in_any_order_and_the_result_is_the_same(data: st.DataObject) -> None:
    times = [0.1, 0.303, 0.555, 0.555001, 0.8, 1.0]
    errors = [(0.01 * k, -0.005 * k, 0.004 * (-1) ** k) for k in range(len(times))]
    punctual, late = Robot(gate=0.999999), Robot(gate=0.999999)
    done = 0
    for time, error in zip(times, errors, strict=True):
        samples = int(np.ceil(time / 0.01 - 1e-9))
        punctual.drive(samples - done)
        done = samples
        punctual.see(time, error)
    late.drive(100)
    order = data.draw(st.permutations(range(1, len(times))))
    for index in (0, *order):
        late.see(times[index], errors[index])
    assert punctual.counts.poses == late.counts.poses == len(times)
    np.testing.assert_allclose(late.fusion.pose, punctual.fusion.pose, atol=1e-12)
    np.testing.assert_allclose(late.fusion.covariance, punctual.fusion.covariance, atol=1e-15)


def test_the_first_pose_says_where_the_robot_is() -> None:
    robot = Robot().drive(50)
    offset = np.array([3.0, -2.0, 0.0])
    assert robot.fusion.correct(PoseMeasurement(stamp(0.3), robot.at(0.3) + offset, R)) == "located"
    np.testing.assert_allclose(robot.fusion.pose, robot.truth[-1] + offset, atol=1e-12)


def test_a_pose_older_than_the_history_is_counted_and_changes_nothing() -> None:
    robot = Robot(history=2.0).drive(10)
    robot.see(0.1)
    robot.drive(990)
    before = robot.fusion.pose.copy()
    assert robot.see(0.15) == "too late"
    assert robot.counts.pose_too_late == 1
    np.testing.assert_array_equal(robot.fusion.pose, before)


def test_poses_within_the_history_are_never_too_late() -> None:
    robot = Robot(history=2.0).drive(1000)
    assert robot.see(8.0) == "located"
    assert robot.see(8.01) == "fused"


def test_a_pose_that_comes_before_its_wheel_sample_waits_for_it() -> None:
    robot = Robot().drive(10)
    robot.see(0.05)
    ahead = PoseMeasurement(stamp(0.15), np.array([0.0749, 0.0028, 0.075]), R)
    assert robot.fusion.correct(ahead) == "waiting"
    before = robot.counts.poses
    robot.drive(4)
    assert robot.counts.poses == before
    robot.drive(1)
    assert robot.counts.poses == before + 1


def test_a_pose_of_the_far_future_is_refused() -> None:
    robot = Robot(ahead=1.0).drive(10)
    assert robot.fusion.correct(PoseMeasurement(stamp(5.0), np.zeros(3), R)) == "ahead"
    assert robot.counts.pose_ahead == 1


def test_the_same_pose_twice_counts_once() -> None:
    robot = Robot().drive(50)
    robot.see(0.2)
    robot.see(0.3)
    assert robot.see(0.3) == "duplicate"
    assert robot.counts.poses == 2


def test_a_pose_a_kilometre_away_is_rejected_and_the_pose_stays() -> None:
    robot = Robot().drive(50)
    robot.see(0.2)
    before = robot.fusion.pose.copy()
    assert robot.see(0.3, (1000, 0, 0)) == "rejected"
    np.testing.assert_array_equal(robot.fusion.pose, before)
    assert robot.counts.pose_rejected == 1


def test_the_gate_rejects_true_poses_as_seldom_as_it_says() -> None:
    rng = np.random.default_rng(4)
    rejected, count = 0, 3000
    for _ in range(count // 30):
        robot = Robot(gate=0.9, reacquire_after=1000).drive(1)
        robot.see(0.01, tuple(0.01 * rng.standard_normal(3)))
        for k in range(2, 32):
            robot.drive(1)
            rejected += robot.see(0.01 * k, tuple(0.01 * rng.standard_normal(3))) == "rejected"
    assert 0.08 < rejected / count < 0.13


def test_after_so_many_rejections_slam_is_believed() -> None:
    robot = Robot(reacquire_after=4).drive(100)
    robot.see(0.1)
    outcomes = [robot.see(0.2 + 0.1 * k, (5, 0, 0)) for k in range(4)]
    assert outcomes == ["rejected", "rejected", "rejected", "reacquired"]
    np.testing.assert_allclose(robot.fusion.pose, robot.truth[-1] + [5, 0, 0], atol=1e-9)


def test_one_outlier_that_is_repeated_is_not_believed() -> None:
    robot = Robot(reacquire_after=4).drive(100)
    robot.see(0.1)
    assert [robot.see(0.2, (1000, 0, 0)) for _ in range(20)] == ["rejected"] + ["duplicate"] * 19


def test_outliers_that_contradict_each_other_are_not_believed() -> None:
    robot = Robot(reacquire_after=4).drive(100)
    robot.see(0.1)
    outcomes = [robot.see(0.2 + 0.01 * k, (100.0 * (k + 1), -50.0 * k, 0)) for k in range(20)]
    assert set(outcomes) == {"rejected"}


def test_a_robot_that_was_carried_away_is_found_while_it_drives_on() -> None:
    robot = Robot(reacquire_after=5).drive(10)
    robot.see(0.1)
    outcomes = []
    for k in range(1, 8):
        robot.drive(20)
        outcomes.append(robot.see(0.1 + 0.2 * k, (3.0, -2.0, 0.0)))
    assert outcomes[:5] == ["rejected"] * 4 + ["reacquired"]
    assert outcomes[5:] == ["fused", "fused"]


def test_a_sender_with_nonsense_for_stamps_does_not_fill_the_memory() -> None:
    timeline = Timeline(2.0)
    for number in range(20_000):
        moved = motion(ORIGIN + 1000 * number, np.zeros(3), 1e-6)
        timeline.append(Entry(moved.stamp, moved, np.zeros(3), np.zeros(3), R))
    assert len(timeline.entries) <= 8000


def test_one_good_pose_ends_the_count_of_rejections() -> None:
    robot = Robot(reacquire_after=3).drive(100)
    robot.see(0.1)
    outcomes = [robot.see(0.2 + 0.1 * k, (5 * (k != 2), 0, 0)) for k in range(5)]
    assert outcomes == ["rejected", "rejected", "fused", "rejected", "rejected"]


def test_a_pose_that_was_set_holds_against_poses_measured_before() -> None:
    robot = Robot().drive(50)
    robot.see(0.2)
    robot.fusion.set_pose(np.array([7.0, 8.0, 1.0]), R)
    np.testing.assert_allclose(robot.fusion.pose, [7.0, 8.0, 1.0])
    assert robot.see(0.4) == "too late"
    robot.drive(10)
    expected = advance(np.array([7.0, 8.0, 1.0]), 10 * np.array([0.005, 0.0, 0.005]), "arc")
    np.testing.assert_allclose(robot.fusion.pose, expected, atol=1e-12)


def test_after_a_reset_the_next_pose_says_where_the_robot_is() -> None:
    robot = Robot().drive(50)
    robot.see(0.2)
    robot.fusion.reset()
    assert not robot.fusion.located
    robot.drive(20)
    assert robot.see(0.6, (100, 0, 0)) == "located"
    np.testing.assert_allclose(robot.fusion.pose, robot.truth[-1] + [100, 0, 0], atol=1e-9)


def test_a_heading_beyond_half_a_turn_is_the_same_heading() -> None:
    robot = Robot().drive(100)
    robot.see(0.5)
    assert robot.see(0.6, (0, 0, 2 * np.pi)) == "fused"
    np.testing.assert_allclose(robot.fusion.pose, robot.truth[-1], atol=1e-9)


@given(st.floats(0.0, 0.5))
def test_the_pose_at_a_time_lies_on_the_path(time: float) -> None:
    robot = Robot().drive(50)
    robot.see(0.1)
    found = robot.fusion.at(stamp(time))
    assert found is not None
    np.testing.assert_allclose(found[0][:2], robot.at(time)[:2] if time >= 0.1 else found[0][:2], atol=1e-9)
    odometry = robot.timeline.odometry_at(stamp(time))
    np.testing.assert_allclose(odometry, robot.at(time), atol=1e-9)


def test_asking_for_the_past_changes_nothing() -> None:
    robot = Robot().drive(50)
    robot.see(0.1)
    before = robot.fusion.pose.copy()
    robot.fusion.at(stamp(0.123))
    np.testing.assert_array_equal(robot.fusion.pose, before)


@pytest.mark.parametrize("time", [-1.0, 0.51])
def test_nothing_is_said_of_times_outside_the_history(time: float) -> None:
    robot = Robot().drive(50)
    assert robot.fusion.at(stamp(time)) is None
    assert robot.timeline.odometry_at(stamp(time)) is None


def test_the_covariance_is_that_of_a_kalman_filter_in_one_dimension() -> None:
    robot = Robot().drive(1)
    robot.see(0.01)
    robot.drive(1)
    robot.see(0.02)
    # heading: variance 1e-4, then 1e-6 of a sample's noise, then fused with another 1e-4
    predicted = 1e-4 + 1e-6
    assert robot.fusion.covariance[2, 2] == pytest.approx(predicted * 1e-4 / (predicted + 1e-4), rel=1e-3)


def test_the_timeline_keeps_what_it_promises_and_little_more() -> None:
    robot = Robot(history=3.0).drive(5000)
    held = (robot.timeline.newest - robot.timeline.oldest) / SECOND
    assert 3.0 <= held <= 6.1
