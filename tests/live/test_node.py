"""The node on Zenoh, with real sessions: what goes in, what comes out, how it starts and ends."""

from __future__ import annotations

import gc
import math
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import zenoh
from drives import SECOND, drive, slam
from nodes import asked, config_of, running, sent, sent_one_by_one
from received_messages import ReceivedMessages
from recordings import random_dataset
from sessions import until

from omnibench.errors import ConfigError, DataError
from omnibench.live.config import LiveConfig, read_live_config
from omnibench.live.node import LiveNode
from omnibench.live.replay.concatenated_drive import ReplayConfig, concatenate_runs
from omnibench.live.replay.replay_player import Player
from omnibench.live.stopping import RateLimiter
from omnibench.live.wire.messages import DIAGNOSTICS, ODOMETRY, TRANSFORMS, Odometry
from omnibench.live.wire.topics import GraphNode, KeySpace


def test_wheel_samples_become_the_batch_odometry_on_every_topic(tmp_path: Path) -> None:
    path = drive(1.0)
    with running(config_of(tmp_path)) as (_, session):
        heard = ReceivedMessages(session, apr__odom=ODOMETRY, apr__odometry__filtered=ODOMETRY, tf=TRANSFORMS)
        wheels = session.declare_publisher("apr/joint_states")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        sent_one_by_one(wheels, path.samples(), heard["apr__odom"])
        until(lambda: len(heard["tf"]) == len(heard["apr__odometry__filtered"]) == 101, "the last of the others")
    odometry: list[Odometry] = heard["apr__odom"]
    assert [each.stamp for each in odometry] == path.stamps
    poses = np.array([each.pose for each in odometry])
    np.testing.assert_allclose(poses[:, :2], path.poses[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * poses[:, 2]), np.exp(1j * path.poses[:, 2]), atol=1e-9)


def test_slam_poses_locate_the_robot_in_the_map(tmp_path: Path) -> None:
    path = drive(1.0)
    with running(config_of(tmp_path)) as (node, session):
        heard = ReceivedMessages(session, apr__odometry__filtered=ODOMETRY)
        wheels, poses = (session.declare_publisher(f"apr/{topic}") for topic in ("joint_states", "slam_pose"))
        until(lambda: wheels.matching_status.matching and poses.matching_status.matching, "subscriptions")
        sent(wheels, path.samples()[:80])
        until(lambda: node.health("apr").counts["samples"] == 80, "the samples")
        poses.put(slam(path.stamps[60], path.poses[60] + [2.0, 0, 0]))
        until(lambda: node.health("apr").counts["poses"] == 1, "the pose")
        sent_one_by_one(wheels, path.samples()[80:], heard["apr__odometry__filtered"])
    last: Odometry = heard["apr__odometry__filtered"][-1]
    np.testing.assert_allclose(last.pose[:2], path.poses[-1, :2] + [2.0, 0], atol=1e-6)
    assert last.frame == "map"


def test_without_fusion_slam_and_tf_are_left_alone(tmp_path: Path) -> None:
    with running(config_of(tmp_path, fusion="none")) as (_, session):
        publisher = session.declare_publisher("apr/slam_pose")
        wheels = session.declare_publisher("apr/joint_states")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        assert not publisher.matching_status.matching


def test_without_fusion_a_replay_with_poses_is_taken_whole(tmp_path: Path) -> None:
    played = concatenate_runs(random_dataset(1))
    with running(config_of(tmp_path, fusion="none")) as (node, session):
        graph = GraphNode(session, KeySpace(), "replay")
        report = Player(graph, "apr", played, ReplayConfig(speed=math.inf)).play()
        assert report.taken == report.total > len(played.wheel_times)
        assert node.health("apr").counts["samples"] == len(played.wheel_times)


def test_diagnostics_come_once_a_second_with_the_counters(tmp_path: Path) -> None:
    with running(config_of(tmp_path)) as (_, session):
        heard = ReceivedMessages(session, apr__diagnostics=DIAGNOSTICS)
        session.put("apr/joint_states", b"garbage")
        until(lambda: len(heard["apr__diagnostics"]) >= 3, "three diagnostics")
    first, *_, last = heard["apr__diagnostics"]
    assert (last.stamp - first.stamp) / SECOND / (len(heard["apr__diagnostics"]) - 1) > 0.8
    (status,) = last.statuses
    assert status.name == "omnibench: apr odometry"
    assert status.level == 1
    assert dict(status.values)["undecodable"] == "1"


def test_many_robots_in_one_node_do_not_meet(tmp_path: Path) -> None:
    names = ("apr1", "apr2", "apr3")
    paths = {name: drive(0.5, seed=number) for number, name in enumerate(names)}
    with running(config_of(tmp_path, *names)) as (node, session):
        heard = ReceivedMessages(session, **{f"{name}__odom": ODOMETRY for name in names})
        for name in names:
            publisher = session.declare_publisher(f"{name}/joint_states")
            until(lambda each=publisher: each.matching_status.matching, "a subscription")
            sent(publisher, paths[name].samples())
        for name in names:
            came, last = heard[f"{name}__odom"], paths[name].samples()[-1].stamp  # of late ones only the newest comes
            until(lambda came=came, last=last: came and came[-1].stamp == last, "the last odometry")
            np.testing.assert_allclose(came[-1].pose[:2], paths[name].poses[-1, :2], atol=1e-9)
            assert heard[f"{name}__odom"][-1].frame == f"{name}/odom"
        assert set(node.trackers) == set(names)


def test_a_robots_token_comes_and_goes_with_the_node(tmp_path: Path) -> None:
    def alive(session: zenoh.Session) -> list[str]:
        replies = session.liveliness().get("omnibench/*/alive", timeout=2.0)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

    router = {"mode": "router", "listen": config_of(tmp_path).zenoh.listening}
    with running(config_of(tmp_path, "apr", zenoh=router)) as (_, session):
        other = {"mode": "client", "connect": list(router["listen"])}
        with LiveNode(config_of(tmp_path, "bob", zenoh=other)):
            until(lambda: alive(session) == ["omnibench/apr/alive", "omnibench/bob/alive"], "both tokens")
        until(lambda: alive(session) == ["omnibench/apr/alive"], "one token")


@pytest.mark.parametrize("profile", ["rmw", "humble"])
def test_ros_2_finds_topics_under_its_own_keys(tmp_path: Path, profile: str) -> None:
    path = drive(0.1)
    with running(config_of(tmp_path, profile=profile, domain=7)) as (_, session):
        key = asked(session, "omnibench/apr/info")["topics"]["odom"]
        assert key.startswith("7/apr/odom/nav_msgs::msg::dds_::Odometry_/")
        heard: list[zenoh.Sample] = []
        session.declare_subscriber("7/apr/odom/**", heard.append)
        # whatever hash the sender has
        wheels = session.declare_publisher("7/apr/joint_states/sensor_msgs::msg::dds_::JointState_/RIHS01_other")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        sent(wheels, path.samples())
        until(lambda: len(heard) == 11, "the odometry")
        attachment = heard[1].attachment
        assert attachment is not None
        content = attachment.to_bytes()
        assert len(content) == 33
        assert int.from_bytes(content[:8], "little") == 2  # counted from 1
        assert content[16] == 16


def test_a_config_is_refused_in_one_line(tmp_path: Path) -> None:
    for changes, message in (
        ({"robots": [{"name": "a b", "calibration": "c.yaml"}]}, r"robots\.0\.name"),
        ({"robots": [{"name": "a", "calibration": "c.yaml"}] * 2}, "names must differ: a, a"),
        ({"fusion": "kalman"}, r"fusion\.name: Input should be 'none' or 'ekf'"),
        ({"fusion": {"gate": 2}}, r"fusion\.settings\.gate: Input should be less than 1"),
        ({"fusion": {"gat": 0.9}}, r"unknown key 'fusion\.settings\.gat'; did you mean 'gate'"),
        ({"record": "."}, "name a file that ends in .mcap"),
        ({"robots": [{"name": "a", "calibration": "c.yaml", "frames": {"odom": "map"}}]}, "must differ: map, map"),
        ({"profil": "rmw"}, "unknown key 'profil'; did you mean 'profile'"),
        ({"robots": [], "zenoh": {"mode": "client"}}, "without robots a node can only be a router"),
    ):
        with pytest.raises(ConfigError, match=message):
            config_of(tmp_path, **changes)


def test_a_robot_that_another_node_runs_already_is_refused(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    with running(config):
        client = {"mode": "client", "connect": list(config.zenoh.listening)}
        with pytest.raises(ConfigError, match="robot 'apr' is run by another node already; stop that"):
            LiveNode(config_of(tmp_path, zenoh=client))


def test_a_missing_calibration_is_named(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    (tmp_path / "calibration.yaml").unlink()
    with pytest.raises(DataError, match=r"calibration\.yaml: no such file"):
        LiveNode(config)


@pytest.mark.parametrize("joints", [["a", "b"], ["a", "b", "c", "d"], ["a", "b", "a"], []])
def test_joints_that_are_not_one_for_each_wheel_are_refused(tmp_path: Path, joints: list[str]) -> None:
    robot = {"name": "apr", "calibration": "calibration.yaml", "wheels": {"joints": joints}}
    given = ", ".join(joints) or "none"
    with pytest.raises(ConfigError, match=f"robot 'apr': wheels.joints: {given}; .* each of the wheels a, b, c$"):
        LiveNode(config_of(tmp_path, robots=[robot]))


def test_a_node_that_fails_to_start_leaves_port_and_state_to_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_of(tmp_path, state="state")

    def failing(*_: object) -> None:
        raise zenoh.ZError("no more queryables")

    with monkeypatch.context() as patch:
        patch.setattr("omnibench.live.node.QueryServer", failing)
        with pytest.raises(zenoh.ZError, match="no more queryables"):
            LiveNode(config)
    with running(config) as (_, session):
        assert asked(session, "omnibench/apr/health")["status"] == "waiting"


def test_the_interpreter_is_the_streams_until_the_last_node_of_a_process_has_gone(tmp_path: Path) -> None:
    usual = sys.getswitchinterval()
    (tmp_path / "one").mkdir()
    (tmp_path / "other").mkdir()
    with LiveNode(config_of(tmp_path / "one")):
        with LiveNode(config_of(tmp_path / "other")):
            pass
        assert gc.get_freeze_count() > 0
        assert sys.getswitchinterval() < usual
    assert gc.get_freeze_count() == 0
    assert sys.getswitchinterval() == usual


def test_a_robot_whose_diagnostics_fail_does_not_end_those_of_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with running(config_of(tmp_path, "apr", "bob")) as (node, session):
        failed: list[int] = []

        def failing() -> None:
            failed.append(1)
            "\ud800".encode()

        monkeypatch.setattr(node._services[0], "publish_diagnostics", failing)
        heard = ReceivedMessages(session, bob__diagnostics=DIAGNOSTICS)
        until(lambda: len(failed) >= 2 and len(heard["bob__diagnostics"]) >= 2, "diagnostics after a failure")
    assert caplog.text.count("apr: diagnostics: UnicodeEncodeError: ") == 1


def test_a_sample_on_its_way_while_the_node_closes_is_no_failure(tmp_path: Path) -> None:
    with running(config_of(tmp_path)) as (node, session):
        samples: list[zenoh.Sample] = []
        session.declare_subscriber("apr/joint_states", samples.append)
        sent(session.declare_publisher("apr/joint_states"), drive(0.01).samples())
        until(lambda: samples, "a sample")
    taken = node.health("apr").counts["samples"]
    node._services[0]._queue(False, samples[0])
    node._services[0]._take_turn()
    assert node.health("apr").counts["failures"] == 0
    assert node.health("apr").counts["samples"] == taken


def test_a_reason_of_refusals_is_logged_again_only_with_new_ones(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running(config_of(tmp_path)) as (node, _):
        service, tracker = node._services[0], node._services[0].tracker
        monkeypatch.setattr(service, "_rate_limiter", RateLimiter(0.0))
        for _ in range(2):
            tracker.take_wheels(b"junk", time.monotonic())
            service.publish_diagnostics()
        tracker.counts.missing += 1
        service.publish_diagnostics()
    logged = [line for line in caplog.messages if line.startswith("apr: 1 wheel ")]
    assert ["; the last: " in line for line in logged] == [True, True, False]


def test_frames_of_a_single_robot_can_carry_its_name(tmp_path: Path) -> None:
    robot = {"name": "apr", "calibration": "calibration.yaml", "frames": "prefixed"}
    path = drive(0.1)
    with running(config_of(tmp_path, robots=[robot])) as (_, session):
        heard = ReceivedMessages(session, apr__odom=ODOMETRY, tf=TRANSFORMS)
        wheels = session.declare_publisher("apr/joint_states")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        sent_one_by_one(wheels, path.samples(), heard["apr__odom"])
        until(lambda: len(heard["tf"]) == 11, "the last transform")
    assert (heard["apr__odom"][0].frame, heard["apr__odom"][0].child_frame) == ("apr/odom", "apr/base_link")
    assert [(each.frame, each.child_frame) for each in heard["tf"][0]] == [
        ("map", "apr/odom"),
        ("apr/odom", "apr/base_link"),
    ]


@pytest.mark.parametrize(
    ("frames", "fusion", "told"), [(None, "ekf", True), ("prefixed", "ekf", False), (None, "none", False)]
)
def test_a_node_whose_frames_meet_those_of_another_is_warned(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, frames: str | None, fusion: str, told: bool
) -> None:
    router = {"mode": "router", "listen": config_of(tmp_path).zenoh.listening}
    other = {"mode": "client", "connect": list(router["listen"])}
    robots = [{"name": "bob", "calibration": "calibration.yaml", "frames": frames}]
    with LiveNode(config_of(tmp_path, "apr", zenoh=router)):
        assert "publishes tf" not in caplog.text
        with LiveNode(config_of(tmp_path, robots=robots, zenoh=other, fusion=fusion)):
            pass
    warning = "robot bob publishes tf between map, odom and base_link, and so may apr on the same network"
    assert (warning in caplog.text) == told


def test_the_configs_of_the_project_are_valid() -> None:
    folder = Path(__file__).resolve().parents[2] / "configs"
    for file in (folder / "live.yaml", folder / "live_fleet.yaml"):
        config: LiveConfig = read_live_config(file)
        for robot in config.robots:
            assert robot.calibration.is_file()
