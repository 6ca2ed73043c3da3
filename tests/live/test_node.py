"""The node on Zenoh, with real sessions: what goes in, comes out, is recorded and served, its start and its end."""

from __future__ import annotations

import gc
import json
import math
import os
import signal
import socket
import sys
import threading
import time
from contextlib import closing
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from drives import SECOND, drive, slam
from mcap.reader import make_reader
from nodes import ReceivedMessages, asked, config_of, running, sent, sent_one_by_one, wheels_of
from recordings import random_dataset
from sessions import free_port, until
from timing import PATIENCE

from omnibench.errors import ConfigError, DataError
from omnibench.live.config import LiveConfig
from omnibench.live.estimation.health import Health
from omnibench.live.network.presence import alive_robots
from omnibench.live.node import LiveNode
from omnibench.live.replay.concatenated_drive import ReplayConfig, concatenate_runs
from omnibench.live.replay.replay_player import Player
from omnibench.live.stopping import RateLimiter, stop_on_signals, ticks
from omnibench.live.wire.messages import DIAGNOSTICS, JOINT_STATE, ODOMETRY, TRANSFORMS, Odometry, packed
from omnibench.live.wire.recorder import Recorder
from omnibench.live.wire.topics import TOPICS, GraphNode, KeySpace


def test_wheel_samples_become_the_batch_odometry_on_every_topic(tmp_path: Path) -> None:
    path = drive(1.0)
    with running(config_of(tmp_path)) as (_, session):
        heard = ReceivedMessages(session, apr__odom=ODOMETRY, apr__odometry__filtered=ODOMETRY, tf=TRANSFORMS)
        wheels = wheels_of(session)
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
        wheels, poses = wheels_of(session), wheels_of(session, topic="slam_pose")
        sent(wheels, path.samples()[:80])
        until(lambda: node.health("apr").counts["samples"] == 80, "the samples")
        poses.put(slam(path.stamps[60], path.poses[60] + [2.0, 0, 0]))
        until(lambda: node.health("apr").counts["poses"] == 1, "the pose")
        sent_one_by_one(wheels, path.samples()[80:], heard["apr__odometry__filtered"])
    last: Odometry = heard["apr__odometry__filtered"][-1]
    np.testing.assert_allclose(last.pose[:2], path.poses[-1, :2] + [2.0, 0], atol=1e-6)
    assert last.frame == "map"


def test_without_fusion_slam_is_left_alone_and_a_replay_with_poses_is_taken_whole(tmp_path: Path) -> None:
    played = concatenate_runs(random_dataset(1))
    with running(config_of(tmp_path, fusion="none")) as (node, session):
        wheels_of(session).undeclare()
        assert not session.declare_publisher("apr/slam_pose").matching_status.matching
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
            sent(wheels_of(session, name), paths[name].samples())
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
        content = attachment.to_bytes()
        assert len(content) == 33
        assert int.from_bytes(content[:8], "little") == 2  # counted from 1
        assert content[16] == 16


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"robots": [{"name": "a b", "calibration": "c.yaml"}]}, r"robots\.0\.name"),
        ({"robots": [{"name": "a", "calibration": "c.yaml"}] * 2}, "a, a"),
        ({"fusion": "kalman"}, r"fusion\.name: .*'none' or 'ekf'"),
        ({"fusion": {"gate": 2}}, r"fusion\.settings\.gate"),
        ({"fusion": {"gat": 0.9}}, r"'fusion\.settings\.gat'.*'gate'"),
        ({"record": "."}, ".mcap"),
        ({"robots": [{"name": "a", "calibration": "c.yaml", "frames": {"odom": "map"}}]}, "map, map"),
        ({"profil": "rmw"}, "'profil'.*'profile'"),
        ({"robots": [], "zenoh": {"mode": "client"}}, "without robots"),
    ],
)
def test_a_config_that_cannot_be_is_refused(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        config_of(tmp_path, **changes)


def test_a_robot_that_another_node_runs_already_is_refused(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    with running(config):
        client = {"mode": "client", "connect": list(config.zenoh.listening)}
        with pytest.raises(ConfigError, match="'apr' is run by another node"):
            LiveNode(config_of(tmp_path, zenoh=client))


@pytest.mark.parametrize("joints", [["a", "b"], ["a", "b", "c", "d"], ["a", "b", "a"], []])
def test_joints_other_than_one_a_wheel_and_a_missing_calibration_are_named(tmp_path: Path, joints: list[str]) -> None:
    robot = {"name": "apr", "calibration": "calibration.yaml", "wheels": {"joints": joints}}
    config = config_of(tmp_path, robots=[robot])
    with pytest.raises(ConfigError, match=rf"'apr': wheels\.joints: {', '.join(joints) or 'none'};"):
        LiveNode(config)
    (tmp_path / "calibration.yaml").unlink()
    with pytest.raises(DataError, match=r"calibration\.yaml: no such file"):
        LiveNode(config)


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


def test_diagnostics_may_fail(
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


def test_reasons_come_once(tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.parametrize(
    ("frames", "fusion", "told"), [(None, "ekf", True), ("prefixed", "ekf", False), (None, "none", False)]
)
def test_frames_of_two_nodes_that_meet_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, frames: str | None, fusion: str, told: bool
) -> None:
    router = {"mode": "router", "listen": config_of(tmp_path).zenoh.listening}
    other = {"mode": "client", "connect": list(router["listen"])}
    robots = [{"name": "bob", "calibration": "calibration.yaml", "frames": frames}]
    with LiveNode(config_of(tmp_path, "apr", zenoh=router)):
        assert "publishes tf" not in caplog.text
        with LiveNode(config_of(tmp_path, robots=robots, zenoh=other, fusion=fusion)):
            pass
    assert ("robot bob publishes tf between map, odom and base_link" in caplog.text) == told


def driven(config: LiveConfig, seconds: float = 0.5) -> None:
    """Run the node of a config and send it the wheel samples of a drive."""
    path = drive(seconds)
    with running(config) as (node, session):
        wheels = wheels_of(session)
        sent(wheels, path.samples())
        until(lambda: node.health("apr").counts["samples"] == len(path.stamps), "the last sample")


def recorded(file: Path) -> dict[str, int]:
    """Messages in a complete recording, by ROS topic."""
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    counts = summary.statistics.channel_message_counts
    return {channel.topic: counts[number] for number, channel in summary.channels.items()}


def assert_nothing_is_open(config: LiveConfig) -> None:
    """The same robots start again on the same port, with the same state."""
    usual = config.model_copy(update={"record": None, "foxglove": False})
    with running(usual) as (_, session):
        assert asked(session, "omnibench/apr/health")["status"] == "waiting"


def test_a_config_with_record_writes_the_mcap_file_beside_one_that_exists_already(tmp_path: Path) -> None:
    config = config_of(tmp_path, record="recordings/run.mcap")
    driven(config)
    file = tmp_path / "recordings" / "run.mcap"
    counts, first = recorded(file), file.read_bytes()
    counts.pop("/apr/diagnostics", None)  # once a second: one more where the machine is busy
    assert counts == {"/apr/joint_states": 51, "/apr/odom": 51, "/apr/odometry/filtered": 51, "/tf": 51}
    driven(config, 0.2)
    (second,) = file.parent.glob("run-*.mcap")
    assert file.read_bytes() == first
    assert recorded(second)["/apr/odom"] == 21


def test_a_recorder_or_server_that_cannot_begin_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("not a folder")
    with closing(socket.socket()) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        for changes, named in (
            ({"record": "file/run.mcap"}, r"file: exists already|run\.mcap: cannot be written"),
            ({"record": "run.mcap", "foxglove": taken.getsockname()[1]}, r"127\.0\.0\.1:\d+: .*in use|foxglove-sdk"),
        ):
            config = config_of(tmp_path, state="state", **changes)
            with pytest.raises((DataError, ConfigError), match=named):
                LiveNode(config)
            assert not (tmp_path / "run.mcap").exists()
            assert_nothing_is_open(config)
    monkeypatch.setitem(sys.modules, "foxglove", None)  # what an absent package looks like
    with pytest.raises(ConfigError, match='pip install "foxglove-sdk"'):
        LiveNode(config_of(tmp_path, foxglove=True))


def test_what_has_started_is_closed_when_a_later_step_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    foxglove = port if find_spec("foxglove") else False
    config = config_of(tmp_path, record="run.mcap", foxglove=foxglove, state="state")

    def failing(*_: object) -> None:
        raise zenoh.ZError("no more queryables")

    with monkeypatch.context() as patch:
        patch.setattr("omnibench.live.node.QueryServer", failing)
        with pytest.raises(zenoh.ZError, match="no more queryables"):
            LiveNode(config)
    assert recorded(tmp_path / "run.mcap") == {}  # complete, with its index
    with closing(socket.socket()) as again:
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", port))
    assert_nothing_is_open(config)


def test_a_waiting_replay_finds_the_node_before_its_recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alive: list[tuple[str, ...]] = []

    class LateRecorder(Recorder):
        def start(self) -> None:
            alive.append(alive_robots(self._session, 1.0))
            super().start()

    monkeypatch.setattr("omnibench.live.node.Recorder", LateRecorder)
    driven(config_of(tmp_path, record="run.mcap"), 0.1)
    assert alive == [("apr",)]
    assert recorded(tmp_path / "run.mcap")["/apr/odom"] == 11


def test_a_config_with_foxglove_serves_the_robots_topics(tmp_path: Path) -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
    client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
    port = free_port()
    offered: dict[str, str] = {}
    with (
        running(config_of(tmp_path, foxglove=port)),
        client.connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], close_timeout=0.5) as viewer,
    ):
        while len(offered) < len(TOPICS):
            message = json.loads(viewer.recv(timeout=PATIENCE))
            if message["op"] == "advertise":
                offered |= {channel["topic"]: channel["schemaName"] for channel in message["channels"]}
    assert offered["/apr/odom"] == "nav_msgs/msg/Odometry"
    with pytest.raises(OSError, match="refused"):
        client.connect(f"ws://127.0.0.1:{port}", open_timeout=1)


SAMPLES = 60


def sent_while_the_intake_waits(
    tmp_path: Path, attachments: list[bytes | None], period: float
) -> tuple[list[Odometry], Health, Health]:
    """Odometry of samples, one for each attachment, all but the first of which wait for the last.

    And the health, while they wait and afterwards.
    """
    path = drive(2.0)
    with running(config_of(tmp_path)) as (node, session):
        heard = ReceivedMessages(session, apr__odom=ODOMETRY)
        service = node._services[0]
        wheels = wheels_of(session)
        samples, last = path.samples(), len(attachments) - 1
        wheels.put(JOINT_STATE.encode(samples[0]), attachment=attachments[0])
        until(lambda: heard["apr__odom"], "the first odometry")
        with service._working:  # as if the machine had no time for it
            for sample, attachment in zip(samples[1:], attachments[1:], strict=False):
                wheels.put(JOINT_STATE.encode(sample), attachment=attachment)
                time.sleep(period)
            until(lambda: len(service._waiting) == last, "all samples in the queue")
            time.sleep(0.15)  # all of them are late now
            meanwhile = node.health("apr")
        until(lambda: heard["apr__odom"][-1].stamp == path.stamps[last], "the newest odometry")
        with service._working:  # the turn that published it counts at its end
            health = node.health("apr")
        np.testing.assert_allclose(heard["apr__odom"][-1].pose, path.poses[last], atol=1e-9)
        return list(heard["apr__odom"]), meanwhile, health


def test_late_samples_are_all_integrated_and_only_the_newest_pose_is_published(tmp_path: Path) -> None:
    odometry, meanwhile, health = sent_while_the_intake_waits(tmp_path, [None] * SAMPLES, 0.01)
    assert len(odometry) < SAMPLES / 2
    assert health.counts["samples"] == SAMPLES
    assert health.counts["unpublished"] == SAMPLES - len(odometry)
    for each in (meanwhile, health):  # not "stale" while samples wait
        assert each.status == "degraded"
        assert each.message.startswith("behind by ")
        assert each.behind_s > 0.7


FLOW = [packed(number + 1, bytes(16), (1, number, 0, False)) for number in range(SAMPLES)]


@pytest.mark.parametrize(("attachments", "period"), [([None] * 180, 0.0), (FLOW, 0.01)], ids=["replay", "who waits"])
def test_samples_of_replays_are_all_published(tmp_path: Path, attachments: list[bytes | None], period: float) -> None:
    odometry, _, health = sent_while_the_intake_waits(tmp_path, attachments, period)
    assert len(odometry) == len(attachments)
    assert health.counts["unpublished"] == 0
    assert health.behind_s == 0.0 or attachments is not FLOW  # no backlog


@pytest.mark.parametrize(("size", "sent", "overflow"), [(500_000, 100, 36), (4, 20_100, 100)])
def test_messages_that_wait_are_bounded(tmp_path: Path, size: int, sent: int, overflow: int) -> None:
    with running(config_of(tmp_path)) as (node, session):
        service, wheels = node._services[0], wheels_of(session)
        with service._working:
            for _ in range(sent):
                wheels.put(bytes(size))
            until(lambda: node.health("apr").counts["overflow"] == overflow, "the messages that had no place")
        until(lambda: node.health("apr").counts["undecodable"] == sent - overflow, "the messages that had")
        wheels.put(JOINT_STATE.encode(drive(1.0).samples()[0]))  # and there is room again
        until(lambda: node.health("apr").counts["samples"] == 1, "a sample")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_sets_the_event_and_acts_as_before_when_it_is_over(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stop_on_signals() as stop:
        os.kill(os.getpid(), number)
        assert stop.wait(PATIENCE)
    assert signal.getsignal(number) == before


def interrupted_twice() -> None:
    with stop_on_signals() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.wait(PATIENCE)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)


def test_a_second_ctrl_c_interrupts() -> None:
    with pytest.raises(KeyboardInterrupt):
        interrupted_twice()


def test_ticks_come_at_once_and_then_every_period_until_the_time_is_over() -> None:
    began = time.monotonic()
    passed = list(ticks(threading.Event(), 0.1, 0.35))
    assert passed[0] == 0.0
    assert 1 <= len(passed) <= 4  # fewer when the machine is busy
    assert all(later - earlier >= 0.1 for earlier, later in pairwise(passed))
    assert passed[-1] < 0.35 <= time.monotonic() - began


def test_ticks_end_when_stopped() -> None:
    stop, seen = threading.Event(), []
    for passed in ticks(stop, 0.01):
        seen.append(passed)
        if len(seen) == 3:
            stop.set()
    assert len(seen) == 3
