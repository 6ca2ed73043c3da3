"""A node and senders on Zenoh as robots bring them: late and lost samples, no stamps, poses of no known covariance."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import zenoh
from drives import ORIGIN, PERIOD, SECOND, drive, slam
from nodes import config_of, running
from sessions import until

from omnibench.live.wire.messages import JOINT_STATE, JointState

WHEELS = ("a", "b", "c")
RATES = np.array([2.0, -1.0, -1.0])  # rad/s


def rates(k: int, names: tuple[str, ...] = WHEELS, stamp: int | None = None) -> bytes:
    """The k-th message of a robot that drives straight on and tells rates alone."""
    stamp = ORIGIN + round(k * PERIOD * SECOND) if stamp is None else stamp
    return JOINT_STATE.encode(JointState(stamp, names, None, RATES))


def joint_states(session: zenoh.Session) -> zenoh.Publisher:
    publisher = session.declare_publisher("apr/joint_states")
    until(lambda: publisher.matching_status.matching, "the node's subscriber")
    return publisher


def test_samples_lost_after_a_late_one_are_missing_and_the_way_is_whole(tmp_path: Path) -> None:
    ways = []
    for lossy in (False, True):
        with running(config_of(tmp_path, fusion="none")) as (node, session):
            publisher, began = joint_states(session), time.monotonic()
            for k in [*range(40), *range(60 if lossy else 40, 80)]:
                due = began + k * PERIOD + 0.15 * (lossy and k == 39)
                time.sleep(max(due - time.monotonic(), 0.0))
                publisher.put(rates(k))
            until(lambda count=60 if lossy else 80: node.trackers["apr"].counts.samples == count, "all samples")
            ways.append(float(np.linalg.norm(node.trackers["apr"].pose_at(None).odometry[:2])))
            counts = node.trackers["apr"].counts
            assert (counts.missing, counts.clock_jumps) == (20 * lossy, 0)
    assert ways[1] == pytest.approx(ways[0], rel=1e-6)


def test_stamps_that_stand_still_are_said_and_arrival_takes_the_times_of_arrival(tmp_path: Path) -> None:
    with running(config_of(tmp_path, fusion="none", stale_after=0.2)) as (node, session):
        publisher = joint_states(session)

        def said() -> bool:
            publisher.put(rates(0, stamp=0))
            return "stamps stand still" in node.health("apr").message

        until(said, "health")
        assert "the stamp 0.000 s; `wheels: {stamps: arrival}` takes times of arrival" in node.health("apr").message
        assert node.health("apr").status == "stale"
    robots = [{"name": "apr", "calibration": "calibration.yaml", "wheels": {"stamps": "arrival"}}]
    with running(config_of(tmp_path, fusion="none", robots=robots)) as (node, session):
        publisher = joint_states(session)
        for _ in range(20):
            publisher.put(rates(0, stamp=0))
            time.sleep(PERIOD)
        until(lambda: node.trackers["apr"].counts.samples == 20, "all samples")
        assert node.trackers["apr"].counts.duplicates == 0
        assert abs(node.trackers["apr"].pose_at(None).stamp / SECOND - time.time()) < 30
        assert np.linalg.norm(node.trackers["apr"].pose_at(None).odometry[:2]) > 0


@pytest.mark.parametrize("variance", [1.797e308, 0.0, -1.0, np.nan, np.inf])
def test_poses_of_unknown_covariance_are_fused_with_the_default_which_is_said_once(
    tmp_path: Path, variance: float, caplog: pytest.LogCaptureFixture
) -> None:
    path = drive(0.5)
    with running(config_of(tmp_path, fusion={"pose_sigma": [0.2, 3.0]})) as (node, session):
        publisher, poses = joint_states(session), session.declare_publisher("apr/slam_pose")
        for payload in path.payloads():
            publisher.put(payload)
        until(lambda: node.trackers["apr"].counts.samples == len(path.stamps), "all samples")
        for stamp in path.stamps[-2:]:
            poses.put(slam(stamp, [1.0, 2.0, 0.5], np.diag([variance] * 3)))
        until(lambda: node.trackers["apr"].counts.poses == 2, "the poses")
        counts = node.trackers["apr"].counts
        assert (counts.pose_default_covariance, counts.pose_invalid) == (2, 0)
        assert 0.1 < node.health("apr").position_sigma_m <= 0.2
    messages = [record.getMessage() for record in caplog.records]
    lines = [message for message in messages if "covariance of a pose is unknown" in message]
    assert len(lines) == 1
    assert "standard deviations of 0.2 m and 3 deg count, by pose_sigma" in lines[0]


def test_joints_called_like_the_wheels_are_found_as_in_a_bag(tmp_path: Path) -> None:
    with running(config_of(tmp_path, fusion="none")) as (node, session):
        publisher = joint_states(session)
        for k in range(5):
            publisher.put(rates(k, ("b_wheel_joint", "base/A_wheel", "wheel_c")))
        until(lambda: node.trackers["apr"].counts.samples == 5, "all samples")
        assert node.trackers["apr"].counts.wrong_joints == 0
