"""Fusing SLAM poses at their own time, whenever they arrive, put where and when they were taken."""

from typing import Self

import numpy as np
import pytest
from drives import EXACT, ORIGIN, PERIOD, SECOND, calibration, drive, fed, motion, odometry, slam, term, with_effects
from hypothesis import given
from hypothesis import strategies as st

from omnibench.live import fusion as pose_fusion
from omnibench.live.health import Counts
from omnibench.live.odometry import Motion
from omnibench.live.tracker import RobotTracker
from omnibench.robot.calibration import Calibration, EffectTerm
from omnibench.robot.kinematics import Array, compose, moved_to
from omnibench.robot.odometry import advance

COVARIANCE = np.array([[0.04, 0.01, -0.02], [0.01, 0.09, 0.03], [-0.02, 0.03, 0.05]])
VARIANCE = 1e-4


@pytest.mark.parametrize("moved", [[0.8, -0.3, 0.4], [0.0, 0.5, 0.0], [0.6, 0.0, -1.0]])
def test_the_predicted_covariance_is_that_of_finite_differences(moved: list[float]) -> None:
    pose, step = np.array([1.0, -2.0, 0.7]), motion(0, np.array(moved), variance=VARIANCE)
    shifts = 1e-6 * np.eye(3)
    jacobian = np.column_stack(
        [
            (advance(pose + shift, step.moved, "arc") - advance(pose - shift, step.moved, "arc")) / 2e-6
            for shift in shifts
        ]
    )
    predicted = pose_fusion.predict(pose_fusion.Estimate(pose, COVARIANCE), step)
    expected = jacobian @ COVARIANCE @ jacobian.T + VARIANCE * np.eye(3)
    np.testing.assert_allclose(predicted.covariance, expected, atol=1e-8)


def test_the_normalised_error_of_sparse_poses_is_that_of_three_degrees_of_freedom() -> None:
    """Mean NEES: its standard deviation is sqrt(6 / 300) = 0.14, so that 3.5 would be 3.5 of these away."""
    rng = np.random.default_rng(4)
    slam = np.diag([0.02, 0.02, 0.03]) ** 2
    normalised = []
    for _ in range(150):
        true = rng.uniform(-3, 3, 3)
        moved = np.array([0.06, rng.uniform(-0.03, 0.03), rng.uniform(-0.02, 0.02)])
        estimate = pose_fusion.Estimate(true + rng.multivariate_normal(np.zeros(3), slam), slam)
        for _ in range(2):
            for _ in range(50):  # 3 m from pose to pose
                step = motion(0, moved, variance=1e-6)
                true = advance(true, moved, "arc") + 1e-3 * rng.standard_normal(3)
                estimate = pose_fusion.predict(estimate, step)
            normalised.append(pose_fusion.squared_distance(true, *estimate))
            estimate = pose_fusion.correct(estimate, true + rng.multivariate_normal(np.zeros(3), slam), slam)
    assert np.mean(normalised) == pytest.approx(3.0, abs=0.5)


class Robot:
    """A robot that drives a bend of radius 1 m at 0.5 m/s, 100 samples a second, and its filter."""

    def __init__(self, **settings: object) -> None:
        self.counts = Counts()
        chosen = pose_fusion.FusionSettings.model_validate(settings)
        self.timeline = pose_fusion.Timeline(chosen.history)
        self.fusion = pose_fusion.Fusion(chosen, self.timeline, self.counts)
        self.truth = [np.zeros(3)]
        self._append(motion(ORIGIN, np.zeros(3), 0.0))

    def drive(self, samples: int) -> Self:
        for _ in range(samples):
            moved = np.array([0.005, 0.0, 0.005])
            self.truth.append(advance(self.truth[-1], moved, "arc"))
            self._append(motion(ORIGIN + len(self.truth) * 10_000_000 - 10_000_000, moved))
        return self

    def _append(self, moved: Motion) -> None:
        estimate = self.fusion.estimate = pose_fusion.predict(self.fusion.estimate, moved)
        self.timeline.append(pose_fusion.Entry(moved.stamp, moved, self.truth[-1], estimate))
        self.fusion.take_waiting()

    def at(self, time: float) -> np.ndarray:
        """The true pose at a time, s."""
        whole = int(time / 0.01 + 1e-9)
        return advance(self.truth[whole], (time / 0.01 - whole) * np.array([0.005, 0.0, 0.005]), "arc")

    def see(self, time: float, error: tuple[float, float, float] = (0, 0, 0), covariance: np.ndarray = EXACT) -> str:
        return self.fusion.correct(pose_fusion.PoseMeasurement(stamp(time), self.at(time) + error, covariance))


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
    np.testing.assert_allclose(late.fusion.estimate.pose, punctual.fusion.estimate.pose, atol=1e-12)
    np.testing.assert_allclose(late.fusion.estimate.covariance, punctual.fusion.estimate.covariance, atol=1e-15)


def test_a_pose_older_than_the_history_is_counted_and_changes_nothing() -> None:
    robot = Robot(history=2.0).drive(1000)
    assert robot.see(8.0) == "located"
    before = robot.fusion.estimate.pose.copy()
    assert robot.see(0.15) == "too late"
    assert robot.counts.pose_too_late == 1
    np.testing.assert_array_equal(robot.fusion.estimate.pose, before)
    assert robot.see(8.01) == "fused"


def test_a_pose_that_comes_before_its_wheel_sample_waits_for_it() -> None:
    robot = Robot().drive(10)
    robot.see(0.05)
    ahead = pose_fusion.PoseMeasurement(stamp(0.15), np.array([0.0749, 0.0028, 0.075]), EXACT)
    assert robot.fusion.correct(ahead) == "waiting"
    before = robot.counts.poses
    robot.drive(4)
    assert robot.counts.poses == before
    robot.drive(1)
    assert robot.counts.poses == before + 1


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


@pytest.mark.parametrize(
    ("seen", "outcomes"),
    [
        ([(0.2 + 0.1 * k, 5, 0) for k in range(4)], ["rejected"] * 3 + ["reacquired"]),
        ([(0.2, 1000, 0)] * 20, ["rejected"] + ["duplicate"] * 19),
        ([(0.2 + 0.01 * k, 100.0 * (k + 1), -50.0 * k) for k in range(20)], ["rejected"] * 20),
        ([(0.2 + 0.1 * k, 5 * (k != 3), 0) for k in range(6)], ["rejected"] * 3 + ["fused"] + ["rejected"] * 2),
    ],
    ids=["that agree", "one repeated", "that contradict each other", "with a good one between"],
)
def test_four_poses_that_agree_are_believed(seen: list[tuple[float, float, float]], outcomes: list[str]) -> None:
    robot = Robot(reacquire_after=4).drive(100)
    robot.see(0.1)
    assert [robot.see(time, (x, y, 0)) for time, x, y in seen] == outcomes
    away = [5, 0, 0] if outcomes[-1] == "reacquired" else [0, 0, 0]
    np.testing.assert_allclose(robot.fusion.estimate.pose, robot.truth[-1] + away, atol=1e-9)


def test_a_sender_with_nonsense_for_stamps_does_not_fill_the_memory() -> None:
    timeline = pose_fusion.Timeline(2.0)
    for number in range(20_000):
        moved = motion(ORIGIN + 1000 * number, np.zeros(3), 1e-6)
        timeline.append(pose_fusion.Entry(moved.stamp, moved, np.zeros(3), pose_fusion.Estimate(np.zeros(3), EXACT)))
    assert len(timeline.entries) <= 8000


def test_a_pose_that_was_set_holds_against_poses_measured_before() -> None:
    robot = Robot().drive(50)
    robot.see(0.2)
    robot.fusion.set_pose(np.array([7.0, 8.0, 1.0]), EXACT)
    np.testing.assert_allclose(robot.fusion.estimate.pose, [7.0, 8.0, 1.0])
    assert robot.see(0.4) == "too late"
    robot.drive(10)
    expected = advance(np.array([7.0, 8.0, 1.0]), 10 * np.array([0.005, 0.0, 0.005]), "arc")
    np.testing.assert_allclose(robot.fusion.estimate.pose, expected, atol=1e-12)


def test_after_a_reset_the_next_pose_says_where_the_robot_is() -> None:
    robot = Robot().drive(50)
    robot.see(0.2)
    robot.fusion.reset()
    assert not robot.fusion.located
    robot.drive(20)
    assert robot.see(0.6, (100, 0, 0)) == "located"
    np.testing.assert_allclose(robot.fusion.estimate.pose, robot.truth[-1] + [100, 0, 0], atol=1e-9)


def test_a_heading_beyond_half_a_turn_is_the_same_heading() -> None:
    robot = Robot().drive(100)
    robot.see(0.5)
    assert robot.see(0.6, (0, 0, 2 * np.pi)) == "fused"
    np.testing.assert_allclose(robot.fusion.estimate.pose, robot.truth[-1], atol=1e-9)


@given(st.floats(0.0, 0.5))
def test_the_pose_at_a_time_lies_on_the_path_and_asking_changes_nothing(time: float) -> None:
    robot = Robot().drive(50)
    robot.see(0.1)
    before = robot.fusion.estimate.pose.copy()
    found = robot.fusion.at(stamp(time))
    np.testing.assert_allclose(found[0][:2], robot.at(time)[:2] if time >= 0.1 else found[0][:2], atol=1e-9)
    np.testing.assert_allclose(robot.timeline.odometry_at(stamp(time)), robot.at(time), atol=1e-9)
    np.testing.assert_array_equal(robot.fusion.estimate.pose, before)


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
    assert robot.fusion.estimate.covariance[2, 2] == pytest.approx(predicted * 1e-4 / (predicted + 1e-4), rel=1e-3)


def test_the_timeline_keeps_what_it_promises_and_little_more() -> None:
    robot = Robot(history=3.0).drive(5000)
    held = (robot.timeline.newest - robot.timeline.oldest) / SECOND
    assert 3.0 <= held <= 6.1


LATE = term("reference_time_offset", tau=0.12)


def seen(using: Calibration, tau: tuple[float, float], arm: Array | None = None) -> tuple[Array, int]:
    """What a node with a calibration makes of SLAM poses: the largest errors of fused ones (3,), and how many it took.

    tau: by how much earlier positions and headings were taken than their stamps say, s. arm (2,): where the LIDAR is.
    """
    path = drive(6.0, using=calibration())
    start = np.array([2.0, -1.0, 0.7])
    truth = moved_to(start, path.poses)
    robot = RobotTracker("apr", using, fusion=pose_fusion.FusionSettings(gate=0.999999))
    errors = []
    for index, payload in enumerate(path.payloads()):
        updates = robot.take_wheels(payload, 0.01 * index)
        if index % 25 == 0:
            taken, heading = (min(max(index - round(each / PERIOD), 0), 600) for each in tau)
            pose = np.append(truth[taken, :2], truth[heading, 2])
            if arm is not None:
                for sign, angle in ((1, pose[2]), (-1, start[2])):
                    pose[:2] += sign * compose(np.array([0, 0, angle]), np.append(arm, 0.0))[:2]
            robot.take_pose(slam(path.stamps[index], pose, 1e-2 * EXACT), 0.01 * index)
        if updates and updates[0].in_map is not None and index > 300:
            errors.append(updates[0].in_map[0] - truth[index])
    return np.abs(errors).max(axis=0), robot.health(6.0).counts["poses"]


ARM = np.array([0.05, -0.03])
TAKEN_OFF = term("lidar_lever_arm", x=0.05, y=-0.03)


@pytest.mark.parametrize(
    ("terms", "tau", "arm", "poses"),
    [
        ((LATE,), (0.12, 0.12), None, 24),  # the first was taken before there were wheel samples
        ((term("reference_time_offset", tau=-0.1),), (-0.1, -0.1), None, 24),  # the last one's time has not come
        ((term("heading_latency", tau=0.08),), (0.0, 0.08), None, 24),
        ((term("heading_latency", tau=-0.08),), (0.0, -0.08), None, 24),
        ((TAKEN_OFF,), (0.0, 0.0), ARM, 25),
        ((LATE, term("heading_latency", tau=-0.05), TAKEN_OFF), (0.12, 0.07), ARM, 24),
    ],
    ids=["late", "early", "late heading", "early heading", "lever arm", "all together"],
)
def test_poses_are_put_where_and_when_they_were_taken(
    terms: tuple[EffectTerm, ...], tau: tuple[float, float], arm: Array | None, poses: int
) -> None:
    uncorrected, _ = seen(calibration(), tau, arm)
    corrected, taken = seen(with_effects(*terms), tau, arm)
    assert uncorrected.max() > 0.01
    assert corrected.max() < 1e-6
    assert taken == poses


def test_odom_does_not_know_of_them() -> None:
    path = drive(1.0)
    updates = fed(RobotTracker("apr", with_effects(LATE), fusion=pose_fusion.FusionSettings()), path.payloads())
    np.testing.assert_allclose(odometry(updates), path.poses, atol=1e-9)


def test_a_swap_brings_its_own() -> None:
    robot = RobotTracker("apr", calibration(), fusion=pose_fusion.FusionSettings())
    path = drive(1.0)
    fed(robot, path.payloads()[:51])
    assert robot.take_pose(slam(path.stamps[50], path.poses[50]), 0.5) == "located"
    robot.swap(with_effects(LATE))
    assert robot.take_pose(slam(path.stamps[50], path.poses[38]), 0.5) == "fused"  # another time: no duplicate


def test_the_floor_carries_the_robot_along_the_axes_of_the_map() -> None:
    using = with_effects(term("floor_drift", dx=0.02, dy=0.0))
    path = drive(2.0, using=using)
    robot = RobotTracker("apr", using, fusion=pose_fusion.FusionSettings())
    payloads = path.payloads()
    fed(robot, payloads[:1])
    robot.take_pose(slam(ORIGIN, [0.0, 0.0, 1.2]), 0.0)
    carried = odometry(fed(robot, payloads[1:]))[-1]
    plain = odometry(fed(RobotTracker("apr", calibration()), payloads))[-1]
    along = compose(np.array([0.0, 0.0, 1.2]), carried - plain)
    assert along[0] > 0.005
    assert abs(along[1]) < 1e-6
