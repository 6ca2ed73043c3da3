"""The node on Zenoh, with real sessions: what it takes, publishes, records and answers, and which orders it obeys."""

import gc
import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from drives import ORIGIN, SECOND, calibration, drive, slam
from mcap.reader import make_reader
from nodes import (
    Command,
    ReceivedMessages,
    asked,
    config_of,
    peak_memory,
    running,
    sent,
    sent_one_by_one,
    wheels_of,
    write_node,
)
from recordings import random_dataset
from sessions import Loopback, free_port, raw_session, until
from timing import PATIENCE

from omnibench.config import to_yaml
from omnibench.errors import ConfigError, DataError
from omnibench.live.config import LiveConfig
from omnibench.live.control import (
    MOST_WAITING,
    QueryServer,
    Request,
    RequestQueue,
    source_of,
    swap_calibration,
)
from omnibench.live.drive import ReplayConfig, concatenate_runs
from omnibench.live.health import Health
from omnibench.live.node import Intake, LiveNode
from omnibench.live.presence import alive_robots
from omnibench.live.record import Recorder
from omnibench.live.replay import Player
from omnibench.live.stopping import RateLimiter, stop_on_signals, ticks
from omnibench.live.topics import TOPICS, GraphNode, KeySpace
from omnibench.live.tracker import RobotTracker
from omnibench.live.wire import DIAGNOSTICS, JOINT_STATE, ODOMETRY, TRANSFORMS, Odometry, packed
from omnibench.robot.calibration import write_calibration


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
    status, guard = last.statuses
    assert (guard.name, guard.level) == ("omnibench: apr guard", 0)
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
    logged = [line for line in caplog.messages if line.startswith("apr: wheel ")]
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
    with pytest.raises(ConfigError, match=r'pip install "omnibench\[foxglove\]"'):
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
        def __init__(self, session: zenoh.Session, *others: Any, **options: Any) -> None:
            alive.append(alive_robots(session, 1.0))
            super().__init__(session, *others, **options)

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


def test_turns_that_take_most_of_the_time_are_run_in_a_thread_of_their_own() -> None:
    with Intake() as intake:
        time.sleep(0.05)
        intake.run(lambda: None)
        assert not intake.busy
        for _ in range(20):
            intake.run(lambda: time.sleep(0.01))
        assert intake.busy
        threads: list[str] = []
        intake.queue(lambda: 1 / 0)  # an error ends no other turn
        intake.queue(lambda: threads.append(threading.current_thread().name))
        until(lambda: threads, "the turn that was queued")
    assert threads == ["intake"]


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


# What a node answers and which orders it takes, with real sessions, and requests made to exhaust it.

EVERY_REPLY = zenoh.QueryConsolidation(zenoh.ConsolidationMode.NONE)


@pytest.fixture(scope="module")
def driven_node(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A node that has taken a drive of a second."""
    path = drive(1.0)
    with running(config_of(tmp_path_factory.mktemp("driven"))) as (node, session):
        wheels = wheels_of(session)
        sent(wheels, path.samples())
        until(lambda: node.health("apr").counts["samples"] == 101, "the samples")
        yield node, session, path


def test_info_health_and_calibration_say_what_runs(driven_node: Any) -> None:
    info, health, given = (asked(driven_node[1], f"omnibench/apr/{each}") for each in ("info", "health", "calibration"))
    assert (info["calibration"], info["wheels"]) == ("synthetic 1", ["a", "b", "c"])
    assert info["topics"]["odom"] == "apr/odom"
    assert health["counts"]["samples"] == 101
    assert health["status"] in ("degraded", "stale")
    assert given["matrix"][0] == list(calibration().matrix[0])


@pytest.mark.parametrize("form", ["{0}.505", "{0}505000000"])
def test_the_pose_at_a_time_is_interpolated(driven_node: Any, form: str) -> None:
    _, session, path = driven_node
    answer = asked(session, "omnibench/apr/pose?at=" + form.format(ORIGIN // SECOND))
    assert answer["at_ns"] == ORIGIN + 505_000_000
    assert answer["odom"]["theta"] == pytest.approx(path.poses[50:52, 2].mean(), abs=1e-9)


@pytest.mark.parametrize(
    ("selector", "payload", "named"),
    [
        ("pose?at=yesterday", None, "'yesterday' is not a time"),
        *((f"pose?at={number}", None, "is not a time") for number in ("1e400", "1e3000000", "1e19", "-1e19")),
        *((f"pose?at={number}", None, "is not a time") for number in ("nan", "snan", "-inf", "")),
        ("pose?at=" + "7" * 5000, None, "777...' is not a time"),
        ("pose?at=12", None, "at: 12.000000 s"),
        ("set_pose", '{"x": 1}', "'y' and 'theta'"),
        ("set_pose", '{"x": 1, "y": 2, "theta": 3, "z": 4}', "'z'"),
        ("set_pose", b"\xff\xfe", "not text"),
        ("calibration", "format: something", "omnibench/apr/swap"),
        ("swap", "format: something", "'omnibench-calibration/1'"),
        ("swap", b"\xff\xfe", "UTF-8"),
        ("swap", "- " * 30_000, "nested too deeply"),
        ("swap", "a: [" + "1, " * 20_000 + "1]", "5000 values"),
        ("swap", "#" * 140_000, "140000 bytes"),
        ("swap", "#" * 10_000_000, "10000000 bytes"),
        ("health?" + "x" * 140_000, None, "140000 bytes"),
    ],
)
def test_a_bad_order_is_refused_with_the_reason(driven_node: Any, selector: str, payload: Any, named: str) -> None:
    assert named in asked(driven_node[1], f"omnibench/apr/{selector}", payload)["error"]


def test_a_pose_can_be_set_and_reset(driven_node: Any) -> None:
    _, session, _ = driven_node
    assert asked(session, "omnibench/apr/set_pose", json.dumps({"x": 3, "y": 4, "theta": 1}))["done"] == "set_pose"
    answer = asked(session, "omnibench/apr/pose")
    assert (answer["map"]["x"], answer["map"]["y"], answer["map"]["theta"]) == (3, 4, 1)
    assert asked(session, "omnibench/apr/reset")["done"] == "reset"
    assert not asked(session, "omnibench/apr/health")["fusion"]["located"]


@pytest.mark.parametrize("order", ["reset", "swap", "set_pose"])
@pytest.mark.parametrize("robot", ["*", "a$*", "**"])
def test_a_wildcard_orders_nobody(driven_node: Any, robot: str, order: str) -> None:
    node, session, _ = driven_node
    before = node.health("apr").counts
    assert list(session.get(f"omnibench/{robot}/{order}", payload="{x: 1, y: 2, theta: 3}", timeout=2.0)) == []
    assert node.health("apr").counts == before


def test_each_robot_and_service_that_a_question_is_for_answers_it_once(tmp_path: Path) -> None:
    names = [f"r{number}" for number in range(10)]
    answers = {"*/health": 10, "*/*": 40, "**": 40, "r1/*": 4, "r1/info": 1, "*/reset": 0}
    with running(config_of(tmp_path, *names, fusion="none")) as (_, session):
        for selector, expected in answers.items():
            replies = list(session.get(f"omnibench/{selector}", consolidation=EVERY_REPLY, timeout=PATIENCE))
            keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
            assert len(replies) == expected, selector
            assert len(set(keys)) == len(keys)


def test_a_failure_of_its_own_is_one_line_and_logged(loopback: Loopback, caplog: pytest.LogCaptureFixture) -> None:
    def failing(_: RobotTracker) -> dict[str, Any]:
        raise RuntimeError("a bug\nof two lines")

    query_server = QueryServer(loopback.client(), {"apr": RobotTracker("apr", calibration())}, failing, {})
    session = loopback.client()
    until(lambda: list(session.get("omnibench/apr/health", timeout=1.0)), "the query server")
    answer = asked(session, "omnibench/apr/info")
    again = asked(session, "omnibench/apr/health")
    query_server.close()
    assert answer["error"] == "omnibench/apr/info: RuntimeError: a bug of two lines"
    assert again["status"] == "waiting"
    assert "a request failed: RuntimeError: a bug of two lines" in caplog.text


def test_more_requests_than_the_server_holds_are_refused_and_the_stream_goes_on(tmp_path: Path) -> None:
    path = drive(1.0)
    with running(config_of(tmp_path, "apr", "bob")) as (node, session):
        received = ReceivedMessages(session, bob__odom=ODOMETRY)
        wheels = wheels_of(session, "bob")
        with node.trackers["apr"]._state_lock:  # the query server is held up by the first
            waiting = [session.get("omnibench/apr/health", timeout=PATIENCE) for _ in range(200)]
            sent_one_by_one(wheels, path.samples(), received["bob__odom"])
        replies = [reply for each in waiting for reply in each]
    refused = [json.loads(reply.err.payload.to_bytes())["error"] for reply in replies if reply.err is not None]
    assert len(replies) == 200
    assert 200 - 2 * 64 <= len(refused) < 200 - 64  # 64 wait, and as many may be under way
    assert set(refused) == {"omnibench/apr/health: 64 requests are waiting; ask again later"}


_FLOODER = """
import sys, zenoh
from sessions import raw_session
session, replies = raw_session("client", connect=[sys.argv[1]]), []
def take(reply):
    if reply.ok is not None and not replies:
        replies.append(reply)
        print("answered", flush=True)
while True:
    session.get("omnibench/apr/" + sys.argv[2], zenoh.handlers.Callback(take, indirect=False), timeout=5.0)
"""


@pytest.mark.slow
@pytest.mark.parametrize("flooded", ["health", "info"])
def test_a_flood_of_questions_gets_its_share_and_others_get_answers_meanwhile(tmp_path: Path, flooded: str) -> None:
    with Command("live", write_node(tmp_path, "apr", "bob")) as node:
        until(lambda: "Ctrl-C ends it" in node.said(), "the node")
        endpoint = next(word for word in node.said().split() if word.startswith("tcp/")).rstrip(";")
        flooder = subprocess.Popen(
            [sys.executable, "-c", _FLOODER, endpoint, flooded],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
            stdout=subprocess.PIPE,
            text=True,
        )
        session = raw_session("client", connect=[endpoint])
        try:
            assert flooder.stdout.readline() == "answered\n"
            until(lambda: "requests refused so far" in node.said(), "so many questions that some are refused")
            for _ in range(30):
                # one who says who asks has a turn of its own; who does not has it for other robots and services
                named = list(session.get(f"omnibench/apr/{flooded}", timeout=PATIENCE, source_info=source_of(session)))
                assert [reply.ok is not None for reply in named] == [True]
                assert asked(session, "omnibench/bob/health")["status"] == "waiting"
            assert flooder.poll() is None
        finally:
            flooder.kill()
            flooder.communicate()
            session.close()


def request(client: str, refused: list[str]) -> Request:
    return Request(client, lambda: None, lambda _: refused.append(client))


def test_clients_are_served_in_turn_and_who_has_most_requests_waiting_gives_way() -> None:
    requests = RequestQueue()
    flood = [request("flooder", []) for _ in range(MOST_WAITING)]
    assert [requests.put(each) for each in flood] == [None] * MOST_WAITING
    assert requests.put(late := request("flooder", [])) is late
    assert requests.put(other := request("other", [])) is flood[-1]
    assert requests.put(second := request("other", [])) is flood[-2]
    taken = requests.take()
    assert taken[:4] == [flood[0], other, flood[1], second]
    assert len(taken) == MOST_WAITING


def test_strangers_with_a_new_name_each_time_take_nobodys_place() -> None:
    requests = RequestQueue()
    honest = request("honest", [])
    requests.put(honest)
    refused = [requests.put(request(f"name {number}", [])) for number in range(2 * MOST_WAITING)]
    assert honest not in refused
    assert honest in requests.take()


def test_a_closed_queue_gives_out_what_waits_and_takes_no_more() -> None:
    requests = RequestQueue()
    requests.put(before := request("a", []))
    requests.close()
    assert requests.put(late := request("a", [])) is late
    assert requests.take() == [before]
    assert requests.take() == []


def test_a_file_that_is_no_calibration_by_its_size_is_not_sent(loopback: Loopback, tmp_path: Path) -> None:
    file = tmp_path / "recording.yaml"
    file.write_bytes(b"- 1\n" * 2_500_000)
    with pytest.raises(DataError, match="10,000,000 bytes"):
        swap_calibration(loopback.client(), "apr", file)


def test_a_swap_that_nobody_answers_names_access_rights_as_a_possible_cause(loopback: Loopback, tmp_path: Path) -> None:
    token = loopback.router.liveliness().declare_token("omnibench/apr/alive")
    queryable = loopback.router.declare_queryable("omnibench/apr/swap", lambda _: None)
    write_calibration(calibration(), tmp_path / "calibration.yaml")
    session = loopback.client()
    until(lambda: alive_robots(session) == ("apr",), "the token")
    with pytest.raises(DataError, match="`access`"):
        swap_calibration(session, "apr", tmp_path / "calibration.yaml", timeout=0.2)
    queryable.undeclare()
    token.undeclare()


def test_a_calibration_that_is_put_runs(tmp_path: Path) -> None:
    with running(config_of(tmp_path)) as (node, session):
        session.put("omnibench/apr/calibration", to_yaml(calibration(scale=1.2)))
        until(lambda: node.health("apr").counts["swaps"] == 1, "the swap")
        assert asked(session, "omnibench/apr/info")["calibration"] == "synthetic 1.2"


@pytest.mark.parametrize(
    ("put", "named"),
    [
        (to_yaml(calibration(wheels=4)), "fl, fr, rl, rr"),
        ("#" * 140_000, "140000 bytes"),
        ("format: something", "format"),
    ],
    ids=["another robot", "too long", "no calibration"],
)
def test_refused_swaps_stand_in_health(tmp_path: Path, caplog: pytest.LogCaptureFixture, put: str, named: str) -> None:
    with running(config_of(tmp_path)) as (node, session):
        for _ in range(10):
            session.put("omnibench/apr/calibration", put, congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: node.health("apr").counts["swaps_refused"] == 10, "the refusals")
        swap = asked(session, "omnibench/apr/health")["last_swap"]
        assert not swap["accepted"]
        assert named in swap["reason"]
        assert asked(session, "omnibench/apr/info")["calibration"] == "synthetic 1"
    assert len([each for each in caplog.messages if "refused" in each]) == 1


@pytest.mark.parametrize(("state", "named"), [("state", "apr.calibration.yaml"), (None, "no `state`")])
def test_a_lost_swap_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture, state: str | None, named: str) -> None:
    with running(config_of(tmp_path, state=state)) as (node, session):
        (tmp_path / "state" / "apr.calibration.yaml").mkdir(parents=True)
        answer = asked(session, "omnibench/apr/swap", to_yaml(calibration(scale=1.1)))
        assert node.trackers["apr"].calibration.name == "synthetic 1.1"
    assert (answer["accepted"], answer["kept"]) == (True, False)
    assert named in answer["reason"]
    assert ("'synthetic 1.1' runs, but not after a restart" in caplog.text) == (state is not None)


# Eight levels of aliases, nine values each, stand for 10^8; libyaml does not take this directive, Python's parser did.
_LEVELS = " ".join(f"&a{level} [{', '.join([f'*a{level - 1}'] * 9)}]," for level in range(1, 9))
BOMB = f"%YAML 1.3\n---\nx: [&a0 [1, 1, 1, 1, 1, 1, 1, 1, 1], {_LEVELS}]\ny: 0\ntheta: 0\n"
_SECONDS = 1.0  # on a busy machine; such a request took 22 s and more


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[int, zenoh.Session, list[float]]]:
    """The process of a node that takes samples at 100 Hz, a client's session, and when its odometry arrived."""
    port, arrivals, over = free_port(), list[float](), threading.Event()
    file = write_node(tmp_path_factory.mktemp("node"), "apr", port=port)
    with Command("live", file) as command:
        until(lambda: "apr" in command.said(), "the node's start")
        session = raw_session("client", connect=[f"tcp/127.0.0.1:{port}"])
        asked(session, "omnibench/apr/info")
        subscriber = session.declare_subscriber("apr/odom", lambda _: arrivals.append(time.monotonic()))
        publisher = session.declare_publisher("apr/joint_states")

        def drives() -> None:
            for sample in drive(60.0).samples():
                publisher.put(JOINT_STATE.encode(sample))
                if over.wait(0.01):
                    return

        driving = threading.Thread(target=drives)
        driving.start()
        until(lambda: len(arrivals) > 50, "odometry")
        yield command.process.pid, session, arrivals
        over.set()
        driving.join()
        subscriber.undeclare()
        session.close()


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="memory is read from /proc")
@pytest.mark.parametrize("service", ["set_pose", "swap"])
@pytest.mark.parametrize("payload", [BOMB, BOMB.partition("---\n")[2]], ids=["with a directive", "plain"])
def test_a_node_refuses_a_bomb_and_goes_on(node: Any, service: str, payload: str) -> None:
    process, session, arrivals = node
    memory, count, began = peak_memory(process), len(arrivals), time.monotonic()
    answer = asked(session, f"omnibench/apr/{service}", payload)
    refused = time.monotonic()
    until(lambda: len(arrivals) > count + 50, "odometry after the request")
    assert "not valid YAML" in answer["error"]
    assert refused - began < _SECONDS
    gaps = np.diff(arrivals[count - 1 :])
    assert max(gaps) < _SECONDS
    assert peak_memory(process) - memory < 20
