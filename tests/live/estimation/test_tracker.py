"""One robot, message by message: what is published, what is refused, what is remembered."""

from __future__ import annotations

import math
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drives import NOISE, ORIGIN, SECOND, calibration, drive, slam
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from omnibench.errors import ConfigError, DataError
from omnibench.live.estimation.saved_state import RobotMemory, SavedState
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.fusion.pose_fusion import FusionSettings
from omnibench.live.wire.messages import JOINT_STATE, JointState
from omnibench.live.wire.outputs import Update
from omnibench.robot.calibration import EffectTerm, matrix_rows
from omnibench.robot.odometry import Integration


def tracker(**options: Any) -> RobotTracker:
    return RobotTracker("apr", calibration(), **{"fusion": FusionSettings(), **options})


def fed(robot: RobotTracker, payloads: list[bytes], begin: float = 0.0) -> list[Update]:
    return [
        update for index, payload in enumerate(payloads) for update in robot.take_wheels(payload, begin + 0.01 * index)
    ]


def poses(updates: list[Update]) -> np.ndarray:
    return np.array([update.pose for update in updates])


@pytest.mark.parametrize("integration", ["euler", "arc"])
@pytest.mark.parametrize("wheels", [3, 4])
def test_odom_is_the_batch_odometry(integration: Integration, wheels: int) -> None:
    path = drive(5.0, using=calibration(integration=integration, wheels=wheels))
    robot = RobotTracker("apr", path.calibration)
    np.testing.assert_allclose(poses(fed(robot, path.payloads())), path.poses, atol=1e-9)


def test_stamps_are_those_of_the_wheel_samples() -> None:
    path = drive(0.2)
    assert [update.stamp for update in fed(tracker(), path.payloads())] == path.stamps


def test_there_are_no_updates_after_closing() -> None:
    path = drive(0.2)
    robot = tracker()
    assert len(fed(robot, path.payloads()[:10])) == 10
    robot.close()
    assert robot.take_wheels(path.payloads()[10], 0.1) == []
    assert robot.counts.samples == 10


def test_covariances_come_from_the_calibration() -> None:
    path = drive(1.0, using=calibration(deviation=None))
    last = fed(RobotTracker("apr", path.calibration), path.payloads())[-1]
    assert last.covariance[2, 2] == pytest.approx(NOISE.walk_heading**2 * 1.0, rel=1e-6)
    assert last.twist_covariance[2, 2] == pytest.approx(NOISE.walk_heading**2 / 0.01, rel=1e-6)


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_odom_never_jumps_and_no_stamp_comes_twice_whatever_happens(data: st.DataObject) -> None:
    """Swaps, poses from anywhere, clocks that jump, messages lost, doubled and late, angles or rates."""
    path, rates = drive(1.0), data.draw(st.booleans())
    robot, shift = tracker(), 0
    updates: list[Update] = []
    arrivals: list[float] = []
    samples = path.samples()
    for index, sample in enumerate(samples):
        event = data.draw(
            st.sampled_from(["none"] * 12 + ["swap", "slam", "far", "jump", "lose", "twice", "late", "set", "reset"])
        )
        arrival = 0.01 * index
        if event == "swap":
            robot.swap(calibration(scale=data.draw(st.floats(0.7, 1.3))))
        elif event in ("slam", "far"):
            error = 1000.0 if event == "far" else data.draw(st.floats(-0.5, 0.5))
            robot.take_pose(slam(sample.stamp + shift - 5_000_000, [error, 1.0, 0.2]), arrival)
        elif event == "jump":
            shift += int(data.draw(st.sampled_from([-7200, -30, -2, -0.9, -0.15, 0.15, 0.5, 0.9, 2, 3600])) * SECOND)
        elif event == "set" and updates:
            robot.set_pose(np.array([9.0, 9.0, 1.0]), 0.01 * np.eye(3))
        elif event == "reset" and updates:
            robot.reset()
        sent = {"lose": [], "twice": [sample, sample], "late": [sample, samples[max(index - 3, 0)]]}.get(
            event, [sample]
        )
        for each in sent:
            chosen = replace(each, stamp=each.stamp + shift, positions=None if rates else each.positions)
            new = robot.take_wheels(JOINT_STATE.encode(chosen), arrival)
            updates += new
            arrivals += [arrival] * len(new)
    stamps = [update.stamp for update in updates]
    assert len(set(stamps)) == len(stamps)
    # No wheel turns faster than 3 rad/s: 0.3 m/s and 1.6 rad/s, times the largest scale, bound the robot's motion
    # in the time since the message before; 0.05 s for samples that wait until a clock's jump is confirmed.
    moved = np.diff(poses(updates), axis=0) if len(updates) > 1 else np.zeros((0, 3))
    elapsed = np.diff(arrivals) + 0.05 if len(updates) > 1 else np.zeros(0)
    assert (np.hypot(moved[:, 0], moved[:, 1]) < 0.3 * 1.3 * elapsed).all()
    assert (np.abs(moved[:, 2]) < 1.6 * 1.3 * elapsed).all()


def test_a_correction_of_slam_moves_the_filtered_pose_and_leaves_odom_alone() -> None:
    path = drive(1.0)
    robot = tracker()
    before = fed(robot, path.payloads()[:60])[-1]
    robot.take_pose(slam(path.stamps[50], [4.0, 5.0, 2.0]), 0.6)
    (after,) = fed(robot, path.payloads()[60:61], 0.6)
    np.testing.assert_allclose(after.pose, path.poses[60], atol=1e-9)
    assert before.in_map is not None
    assert after.in_map is not None
    assert np.linalg.norm(after.in_map[0][:2] - before.in_map[0][:2]) > 1


def test_time_backwards_is_counted_and_the_stream_goes_on() -> None:
    path = drive(1.0)
    robot = tracker()
    fed(robot, path.payloads()[:50])
    back = [JOINT_STATE.encode(replace(each, stamp=each.stamp - 100 * SECOND)) for each in path.samples()[50:]]
    updates = fed(robot, back, 0.5)
    assert robot.counts.clock_jumps == 1
    np.testing.assert_allclose(updates[-1].pose, path.poses[-1], atol=1e-9)
    assert robot.take_pose(slam(path.stamps[-1] - 100 * SECOND, path.poses[-1]), 1.0) == "located"


@pytest.mark.parametrize("payload", [b"", b"garbage", b"\x00\x01\x00\x00", bytes(4000)])
def test_garbage_is_counted_and_the_stream_goes_on(payload: bytes) -> None:
    path = drive(0.1)
    robot = tracker()
    fed(robot, path.payloads()[:5])
    assert robot.take_wheels(payload, 0.05) == []
    assert robot.take_pose(payload, 0.05) is None
    assert (robot.counts.undecodable, robot.counts.pose_undecodable) == (1, 1)
    assert len(fed(robot, path.payloads()[5:], 0.05)) == 6


def test_a_pose_of_another_frame_or_without_sense_is_refused_with_the_reason() -> None:
    path = drive(0.1)
    robot = tracker()
    fed(robot, path.payloads())
    for payload, reason in (
        (slam(path.stamps[5], [0, 0, 0], frame="odom"), "frame 'odom', not in 'map'"),
        (slam(path.stamps[5], [math.nan, 0, 0]), "not finite"),
    ):
        assert robot.take_pose(payload, 0.1) is None
        assert reason in robot.health(0.1).last_refusal
    assert robot.counts.pose_invalid == 2


def test_a_pose_without_covariance_takes_that_of_the_calibrations_noise() -> None:
    path = drive(0.1)
    robot = tracker()
    fed(robot, path.payloads())
    assert robot.take_pose(slam(path.stamps[-1], [1, 2, 3], np.zeros((3, 3))), 0.1) == "located"
    in_map = robot.pose_at().in_map
    assert in_map is not None
    assert in_map[1][0, 0] == pytest.approx(NOISE.pose_position**2)


def test_a_calibration_of_another_robot_is_refused_and_the_old_one_runs_on() -> None:
    robot = tracker()
    running = robot.calibration
    for other, reason in (
        (calibration(wheels=4), "is for wheels fl, fr, rl, rr, this robot has a, b, c"),
        (calibration(scale=30.0), "off the design of robot"),
    ):
        with pytest.raises(DataError, match=reason):
            robot.swap(other)
        assert robot.calibration is running
    health = robot.health(0.0)
    assert health.last_swap is not None
    assert not health.last_swap.accepted
    assert robot.counts.swaps_refused == 2


def test_a_calibration_of_a_larger_robot_with_the_same_wheels_is_refused() -> None:
    robot = tracker()
    larger = calibration().robot
    wheels = tuple(each.model_copy(update={"radius": 5 * each.radius}) for each in larger.wheels)
    larger = larger.model_copy(update={"wheels": wheels, "name": "giant"})
    other = calibration().model_copy(
        update={"robot": larger, "matrix": matrix_rows(larger.inverse_kinematic_matrix), "name": "giant"}
    )
    with pytest.raises(DataError, match="off the design of robot 'synthetic omni'"):
        robot.swap(other)
    assert robot.calibration.name == "synthetic 1"


def test_a_calibration_with_an_effect_that_nobody_knows_is_refused() -> None:
    robot = tracker()
    other = calibration().model_copy(update={"effects": (EffectTerm(name="heading_drft", parameters={"b": 0.1}),)})
    with pytest.raises(DataError, match=r"unknown effect 'heading_drft'; did you mean 'heading_drift'\?"):
        robot.swap(other)
    assert robot.counts.swaps_refused == 1
    path = drive(0.5)
    np.testing.assert_allclose(poses(fed(robot, path.payloads())), path.poses, atol=1e-9)


def test_after_a_silence_of_a_sender_of_rates_the_twist_is_true_and_the_pose_uncertain() -> None:
    robot = tracker(fusion=None)
    names = ("a", "b", "c")
    rates = np.array([2.0, -1.0, 0.5])
    times = [*np.arange(0, 1, 0.01), *np.arange(20, 20.05, 0.01)]
    updates = []
    for time in times:
        payload = JOINT_STATE.encode(JointState(ORIGIN + round(float(time) * SECOND), names, None, rates))
        updates += robot.take_wheels(payload, float(time))
    twist = calibration().matrix_array @ rates
    for update in updates[1:]:
        np.testing.assert_allclose(update.twist, twist, atol=1e-9)
    before, after = updates[99].covariance, updates[100].covariance
    driven = float(np.hypot(*twist[:2])) * 19
    assert np.sqrt(after[0, 0] - before[0, 0]) > 0.25 * driven


@contextmanager
def no_room_in_files() -> Iterator[None]:
    """No file of this process can grow; /dev/full would be one file for all processes of the machine."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_full_disk_costs_the_state_and_no_odometry(tmp_path: Path) -> None:
    path = drive(1.0)
    robot = tracker(memory=RobotMemory(tmp_path, "apr"))
    with no_room_in_files():
        updates = fed(robot, path.payloads())
    assert len(updates) == 101
    assert robot.counts.failures > 0
    assert "the state could not be written: File too large" in robot.health(1.0).last_refusal


def test_poses_that_wait_and_are_then_rejected_are_told() -> None:
    """SLAM whose stamps are always a little ahead of the wheels', a kilometre off."""
    path = drive(3.0)
    robot = tracker()
    for index, payload in enumerate(path.payloads()):
        robot.take_wheels(payload, 0.01 * index)
        if index % 25 == 0:
            away = [1000.0 if index > 50 else 0.0, 0, 0]
            robot.take_pose(slam(path.stamps[index] + 10_000_000, path.poses[min(index + 1, 300)] + away), 0.01 * index)
    health = robot.health(3.0)
    assert health.status == "degraded"
    assert health.fusion is not None
    assert health.fusion.rejected_in_a_row == health.counts["pose_rejected"] > 5
    assert health.fusion.last_outcome in ("rejected", "waiting")


def test_every_pose_that_waits_in_vain_is_counted() -> None:
    path = drive(1.0)
    robot = tracker()
    fed(robot, path.payloads()[:50])
    for number in range(40):
        robot.take_pose(slam(path.stamps[50] + 10_000_000 * number, [0, 0, 0]), 0.5)
    fed(robot, path.payloads()[50:], 0.5)
    counts = robot.counts
    assert counts.poses + counts.pose_rejected + counts.pose_ahead == 40


@pytest.mark.parametrize("pose", [[1.7e308, 0.5e308, 0.1], [1e9, 0, 0]])
def test_a_pose_beyond_the_world_is_refused(pose: list[float]) -> None:
    path = drive(0.5)
    robot = tracker()
    fed(robot, path.payloads())
    tilted = np.array([[1, 0.9, 0], [0.9, 1, 0], [0, 0, 1.0]])
    robot.take_pose(slam(path.stamps[10], [0, 0, 0]), 0.5)
    assert robot.take_pose(slam(path.stamps[20], pose, tilted), 0.5) is None
    assert robot.counts.pose_invalid == 1


def test_a_stale_stream_says_so_and_is_less_and_less_certain() -> None:
    path = drive(1.0)
    robot = tracker(fusion=None, stale_after=0.5)
    assert robot.health(0.0).status == "waiting"
    fed(robot, path.payloads())
    healths = [robot.health(1.0 + seconds) for seconds in (0.1, 1.0, 5.0)]
    assert [health.status for health in healths] == ["ok", "stale", "stale"]
    sigmas = [health.position_sigma_m for health in healths]
    assert sigmas[0] < sigmas[1] < sigmas[2]


def test_health_says_when_slam_is_silent() -> None:
    path = drive(3.0)
    robot = tracker()
    fed(robot, path.payloads()[:10])
    assert robot.health(0.1).message == "no pose of SLAM yet"
    robot.take_pose(slam(path.stamps[5], [0, 0, 0]), 0.1)
    assert robot.health(0.1).status == "ok"
    fed(robot, path.payloads()[10:], 0.1)
    assert robot.health(3.0).status == "degraded"


def test_poses_between_samples_are_at_constant_twist_and_others_are_refused() -> None:
    path = drive(1.0)
    robot = tracker()
    with pytest.raises(DataError, match="has sent no wheel sample yet"):
        robot.pose_at()
    fed(robot, path.payloads())
    middle = robot.pose_at(ORIGIN + round(0.505 * SECOND)).odometry
    np.testing.assert_allclose(middle[2], path.poses[50:52, 2].mean(), atol=1e-9)
    with pytest.raises(DataError, match=r"is not within 1800000000\.\d+ to 1800000001\.000000 s"):
        robot.pose_at(ORIGIN - SECOND)


def test_without_fusion_there_is_no_pose_to_set() -> None:
    robot = tracker(fusion=None)
    with pytest.raises(DataError, match="runs without fusion, and odom itself never jumps"):
        robot.set_pose(np.zeros(3), np.eye(3))
    with pytest.raises(DataError, match="reset: robot 'apr'"):
        robot.reset()


def test_a_robot_goes_on_where_it_was_after_its_node_was_killed(tmp_path: Path) -> None:
    path = drive(2.0)
    memory = RobotMemory(tmp_path, "apr")
    robot = tracker(memory=memory)
    fed(robot, path.payloads()[:100])
    robot.take_pose(slam(path.stamps[90], path.poses[90] + [3, 0, 0]), 1.0)
    fed(robot, path.payloads()[100:111], 1.0)
    memory.close()  # no word of farewell: what was saved by then, 0.1 s apart, is all there is

    memory = RobotMemory(tmp_path, "apr")
    again, saved = tracker(memory=memory), memory.load()
    assert saved is not None
    again.resume(saved, now=1.3, wall=saved.wall + 0.2)
    updates = fed(again, path.payloads()[130:], 1.3)
    # the wheels' angles bridge what nobody saw, as one arc
    np.testing.assert_allclose(updates[-1].pose, path.poses[-1], atol=0.01)
    assert updates[-1].in_map is not None
    np.testing.assert_allclose(updates[-1].in_map[0], path.poses[-1] + [3, 0, 0], atol=0.02)
    assert updates[0].stamp == path.stamps[130]
    memory.close()


def test_a_state_torn_by_a_crash_leaves_the_one_before(tmp_path: Path) -> None:
    memory = RobotMemory(tmp_path, "apr")
    rows = {"positions": (0.0,) * 3, "pose": (0.0,) * 3, "covariance": tuple(np.eye(3).ravel())}
    for stamp in (1, 2, 3):
        memory.save(SavedState(stamp=stamp, wall=0.0, **rows))
    file = tmp_path / "apr.state.json"
    memory.close()
    content = bytearray(file.read_bytes())
    content[4096 + 20 : 4096 + 60] = b"\xff" * 40  # slot of the third
    file.write_bytes(content)
    memory = RobotMemory(tmp_path, "apr")
    loaded = memory.load()
    assert loaded is not None
    assert loaded.stamp == 2
    memory.close()


def test_two_nodes_cannot_share_a_robots_memory(tmp_path: Path) -> None:
    memory = RobotMemory(tmp_path, "apr")
    with pytest.raises(ConfigError, match=r"apr\.state\.json: another node is using it for robot 'apr'"):
        RobotMemory(tmp_path, "apr")
    memory.close()


def test_a_message_with_rates_alone_is_enough() -> None:
    path = drive(0.5)
    robot = tracker()
    payloads = [JOINT_STATE.encode(JointState(s.stamp, s.names, None, s.velocities)) for s in path.samples()]
    np.testing.assert_allclose(poses(fed(robot, payloads)), path.poses, atol=1e-9)
