"""Those who listen to robots: ``subscribe``, recorder, Foxglove server and monitor, with real sessions."""

import json
import math
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
import zenoh
from commands import refused
from mcap.reader import make_reader
from nodes import config_of
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from samples import (
    COVARIANCE,
    PERIOD,
    STAMP,
    AnnouncedRobot,
    disk_with_room_for,
    messages_of,
    odometry,
    publishers,
    sample,
    wait_for_subscribers,
)
from sessions import Loopback, free_port, until
from timing import PATIENCE

from omnibench.errors import ConfigError, DataError, UnknownNameError
from omnibench.live.monitor import HealthSummary, RobotMonitor, RobotStatus
from omnibench.live.record import Recorder
from omnibench.live.subscriber import Subscription, subscribe
from omnibench.live.topics import TOPICS, GraphNode, KeySpace, Profile, Publisher
from omnibench.live.viewers import FoxgloveServer, RerunView, foxglove_layout
from omnibench.live.wire import JOINT_STATE, Diagnostic, Diagnostics, Odometry
from omnibench.robot.kinematics import Mount


def odom_publisher(loopback: Loopback, topic: str = "odom", profile: Profile = "plain") -> Publisher[Odometry]:
    return GraphNode(loopback.router, KeySpace(profile), "node").publisher("apr02", topic)


@pytest.fixture
def odom(loopback: Loopback) -> Publisher[Odometry]:
    return odom_publisher(loopback)


@contextmanager
def subscribed(loopback: Loopback, odom: Publisher[Odometry], **options: Any) -> Iterator[Subscription]:
    with subscribe("apr02", connect=loopback.address, **options) as opened:
        until(lambda: odom.matched, "the subscription")
        yield opened


@pytest.fixture
def subscription(loopback: Loopback, odom: Publisher[Odometry]) -> Iterator[Subscription]:
    with subscribed(loopback, odom) as opened:
        yield opened


@pytest.fixture
def lossless(loopback: Loopback, odom: Publisher[Odometry]) -> Iterator[Subscription]:
    with subscribed(loopback, odom, lossless=True) as opened:
        yield opened


def taken(subscription: Subscription, count: int) -> list[Odometry]:
    """The next messages, fewer when they do not come in time: the subscription is closed then."""
    watchdog = threading.Timer(PATIENCE, subscription.close)
    watchdog.start()
    try:
        return [message for _, message in zip(range(count), subscription, strict=False)]
    finally:
        watchdog.cancel()


def next_of(subscription: Subscription) -> Odometry:
    (message,) = taken(subscription, 1)
    return message


@pytest.mark.parametrize("buffer", [1, 3])
def test_a_slow_reader_gets_the_newest_messages(loopback: Loopback, odom: Publisher[Odometry], buffer: int) -> None:
    session = loopback.client()
    with (
        subscribe("apr02", session=session, buffer=buffer) as ring,
        subscribe("apr02", session=session, lossless=True) as every,
    ):
        until(lambda: odom.matched, "the subscriptions")
        for k in range(51):
            odom.put(odometry(k))
        assert len(taken(every, 51)) == 51  # then the ring has had 50 of them at least
        assert odometry(50 - buffer).stamp <= next_of(ring).stamp <= odometry(51 - buffer).stamp
        assert ring.received == 1


def test_a_lossless_reader_gets_every_message_in_order_however_slow(loopback: Loopback, lossless: Subscription) -> None:
    sender = GraphNode(loopback.router, KeySpace(), "burst").publisher("apr02", "odom", lossless=True)
    for k in range(2000):  # at once; a node's own publishers would rather drop some than wait
        sender.put(odometry(k))
    assert [message.stamp for message in taken(lossless, 2000)] == [odometry(k).stamp for k in range(2000)]


def test_latest_waits_hands_out_once_and_gives_up(subscription: Subscription, odom: Publisher[Odometry]) -> None:
    threading.Timer(0.1, odom.put, [odometry(3)]).start()
    message = subscription.latest(60.0)
    assert message.stamp == odometry(3).stamp
    began = time.monotonic()
    assert subscription.latest(0.1) is None
    assert time.monotonic() - began >= 0.1


@pytest.mark.parametrize("profile", ["plain", "rmw", "humble"])
def test_every_profile_is_heard_and_the_fused_odometry_is_another_topic(loopback: Loopback, profile: Profile) -> None:
    odom, fused = (odom_publisher(loopback, topic, profile) for topic in ("odom", "odometry/filtered"))
    with subscribe("apr02", topic="odometry/filtered", connect=loopback.address, profile=profile) as subscription:
        until(lambda: fused.matched, "the subscription")
        odom.put(odometry(1))
        fused.put(odometry(2, "map"))
        message = next_of(subscription)
    assert (message.frame, message.stamp) == ("map", odometry(2).stamp)


def test_an_undecodable_message_is_counted_and_passed_over(lossless: Subscription, odom: Publisher[Odometry]) -> None:
    joints = JOINT_STATE.encode(sample("joint_states"))
    for payload in (b"", b"garbage", joints):
        odom.put_encoded(payload)
    odom.put(odometry(1))
    assert next_of(lossless).stamp == odometry(1).stamp
    assert (lossless.received, lossless.undecodable) == (1, 3)


def test_a_callback_may_raise(loopback: Loopback, odom: Publisher[Odometry], caplog: pytest.LogCaptureFixture) -> None:
    calls: list[int] = []

    def callback(message: Odometry) -> None:
        calls.append(message.stamp)
        if len(calls) > 10:
            raise KeyError("x") if len(calls) % 2 else ZeroDivisionError("y")

    with subscribed(loopback, odom, lossless=True, callback=callback) as subscription:
        for k in range(20):
            odom.put(odometry(k))
        until(lambda: subscription.callback_errors == 10, "all messages")
        assert subscription.received == 20
    assert calls == [odometry(k).stamp for k in range(20)]
    first, second = caplog.messages
    assert ("KeyError" in first, "ZeroDivisionError" in second) == (True, True)


@pytest.mark.parametrize("wait", [list, lambda each: each.latest(120.0) or []], ids=["iterating", "for the latest"])
def test_closing_ends_waiting(subscription: Subscription, wait: Callable[[Subscription], list[Odometry]]) -> None:
    threading.Timer(0.1, subscription.close).start()
    began = time.monotonic()
    assert wait(subscription) == []
    assert time.monotonic() - began < 120.0


def test_several_threads_may_close_at_once(loopback: Loopback) -> None:
    for _ in range(5):
        subscription = subscribe("apr02", connect=loopback.address)
        barrier = threading.Barrier(4)

        def close(subscription: Subscription = subscription, barrier: threading.Barrier = barrier) -> None:
            barrier.wait()
            subscription.close()

        with ThreadPoolExecutor(4) as threads:
            for done in [threads.submit(close) for _ in range(4)]:
                done.result(PATIENCE)


def test_a_callback_may_close_its_subscription(loopback: Loopback, odom: Publisher[Odometry]) -> None:
    closed = threading.Event()

    def callback(_: Odometry) -> None:
        own.close()
        closed.set()

    own = subscribe("apr02", connect=loopback.address, callback=callback)
    until(lambda: odom.matched, "the subscription")
    odom.put(odometry())
    assert closed.wait(PATIENCE)
    until(lambda: not odom.matched, "the subscription to go")
    own.close()


def test_its_own_session_closes_with_it_and_another_stays_open(loopback: Loopback, odom: Publisher[Odometry]) -> None:
    session = loopback.client()
    with subscribe("apr02", session=session):
        pass
    assert not session.is_closed()
    subscription = subscribe("apr02", connect=loopback.address, callback=lambda _: None)
    with pytest.raises(ConfigError, match=r"callback|without"):
        iter(subscription)
    until(lambda: odom.matched, "the subscription")
    subscription.close()
    until(lambda: not odom.matched, "the subscription to go")
    assert subscription._session.is_closed()


@pytest.mark.parametrize(
    ("robot", "options", "named"),
    [
        ("apr02", {"topic": "odm"}, "'odm'; did you mean 'odom'"),
        ("apr02", {"topic": "joint_states"}, "'joint_states'"),
        ("apr02", {"profile": "rmv"}, "'rmv'; did you mean 'rmw'"),
        ("apr02", {"buffer": 0}, "buffer"),
        ("apr02", {"connect": "127.0.0.1:7447"}, "apr02: connect.*protocol/host:port"),
        ("apr02", {"connect": "tcp/127.0.0.1:1"}, "127.0.0.1:1"),  # nothing listens there
        *((robot, {}, "robot") for robot in ("", "apr02/odom", "*", "apr 02")),
    ],
)
def test_an_argument_that_cannot_be_is_named_in_one_line(robot: str, options: dict[str, Any], named: str) -> None:
    with refused(ConfigError, match=named):
        subscribe(robot, **options)


WAITING_PROCESS = """
import sys
from omnibench.live.subscriber import subscribe
with subscribe("apr02", connect=sys.argv[1]) as subscription:
    try:
        print("waits", flush=True)
        for message in subscription:
            pass
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""


@pytest.mark.slow
def test_ctrl_c_ends_a_reader_that_waits_at_once(loopback: Loopback) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", WAITING_PROCESS, loopback.address], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout.readline() == "waits\n"
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=PATIENCE)[0] == "interrupted\n"
        assert process.returncode == 0
    finally:
        process.kill()
        process.communicate()


def test_losses_are_told(lossless: Subscription, odom: Publisher[Odometry], caplog: pytest.LogCaptureFixture) -> None:
    odom.put(odometry(0))
    odom.next_number()  # of a message that is lost
    odom.put(odometry(2))
    assert [message.stamp for message in taken(lossless, 2)] == [odometry(k).stamp for k in (0, 2)]
    assert lossless.missed == 1
    assert "1 message of apr02/odom lost on the way" in caplog.text


KEYS = KeySpace()


@pytest.fixture
def recorder(loopback: Loopback, tmp_path: Path) -> Iterator[Recorder]:
    with Recorder(loopback.client(), KEYS, ["apr02"], tmp_path / "run.mcap") as started:
        yield started


def test_a_recording_holds_every_payload_of_every_topic_as_it_was_sent(loopback: Loopback, recorder: Recorder) -> None:
    each = publishers(loopback)
    wait_for_subscribers(*each.values())
    sent: dict[str, list[bytes]] = {}
    for topic, publisher in each.items():
        name = "/tf" if topic == "tf" else f"/apr02/{topic}"
        sent[name] = [TOPICS[topic].encode(sample(topic, k)) for k in range(50)]
        for payload in sent[name]:
            publisher.put_encoded(payload)
    until(lambda: recorder.messages == 50 * len(TOPICS), "all messages")
    recorder.close()
    assert messages_of(recorder.path) == sent
    assert dict(recorder.counts) == dict.fromkeys(sent, 50)
    assert recorder.bytes == recorder.path.stat().st_size


def test_times_in_a_recording_are_those_of_header_and_arrival(loopback: Loopback, recorder: Recorder) -> None:
    odom = publishers(loopback)["odom"]
    wait_for_subscribers(odom)
    before = time.time_ns()
    odom.put(sample("odom", 7))
    odom.put(sample("odom", 8))
    until(lambda: recorder.messages == 2, "all messages")
    recorder.close()
    with recorder.path.open("rb") as file:
        first, second = [message for _, _, message in make_reader(file).iter_messages()]
    assert [first.publish_time, second.publish_time] == [STAMP + 7 * PERIOD, STAMP + 8 * PERIOD]
    assert before < first.log_time <= second.log_time < time.time_ns()


def test_payloads_that_cannot_be_decoded_are_counted_and_left_out(loopback: Loopback, recorder: Recorder) -> None:
    odom = publishers(loopback)["odom"]
    wait_for_subscribers(odom)
    whole = TOPICS["odom"].encode(sample("odom"))
    joints = TOPICS["joint_states"].encode(sample("joint_states"))
    for broken in (b"", b"garbage", whole[:100], whole + b"more", joints):
        odom.put_encoded(broken)
    odom.put_encoded(whole)
    until(lambda: recorder.messages, "the message that can")
    recorder.close()
    assert messages_of(recorder.path) == {"/apr02/odom": [whole]}
    assert recorder.undecodable == {"/apr02/odom": 5}


def test_several_robots_are_in_one_file_though_the_session_has_closed(loopback: Loopback, tmp_path: Path) -> None:
    session, first, second = loopback.client(), publishers(loopback, "apr02"), publishers(loopback, "apr03")
    with Recorder(session, KEYS, ["apr02", "apr03"], tmp_path / "fleet.mcap") as recorder:
        for each in (first, second):
            wait_for_subscribers(each["odom"], each["tf"])
            each["odom"].put(sample("odom"))
            each["tf"].put(sample("tf"))
        until(lambda: recorder.messages >= 4, "all messages")
        session.close()
    assert recorder.counts == {"/apr02/odom": 1, "/apr03/odom": 1, "/tf": 2}
    assert {name: len(payloads) for name, payloads in messages_of(recorder.path).items()} == recorder.counts


def test_only_the_topics_that_were_asked_for_are_recorded(loopback: Loopback, tmp_path: Path) -> None:
    each = publishers(loopback)
    with Recorder(loopback.client(), KEYS, ["apr02"], tmp_path / "some.mcap", ["joint_states", "odom"]) as recorder:
        wait_for_subscribers(each["odom"], each["joint_states"])
        for topic in reversed(TOPICS):
            each[topic].put(sample(topic))
        until(lambda: recorder.messages >= 2, "the two messages")
    assert recorder.counts == {"/apr02/odom": 1, "/apr02/joint_states": 1}
    with Recorder(loopback.client(), KEYS, ["apr02"], tmp_path / "empty.mcap"):
        pass
    assert messages_of(tmp_path / "empty.mcap") == {}


@pytest.mark.parametrize(
    ("file", "robot", "topics", "named"),
    [
        ("run.mcap", "apr02", None, r"run\.mcap: exists already"),
        ("run.mcap/run.mcap", "apr02", None, "run.mcap"),
        ("other.mcap", "apr02", ["odm"], "'odom'"),
        ("other.mcap", "**", None, r"robot '\*\*'"),
    ],
    ids=["exists", "no folder", "topic", "robot"],
)
def test_what_cannot_be_recorded_is_named_and_no_file_changes(
    loopback: Loopback, tmp_path: Path, file: str, robot: str, topics: list[str] | None, named: str
) -> None:
    (tmp_path / "run.mcap").write_text("precious")
    with pytest.raises((DataError, ConfigError, UnknownNameError), match=named):
        Recorder(loopback.client(), KEYS, [robot], tmp_path / file, *([topics] if topics else []))
    assert [each.read_text() for each in tmp_path.iterdir()] == ["precious"]


def fill(recorder: Recorder, publisher: Publisher[Any]) -> None:
    """Publish what does not compress until the disk is full."""
    wait_for_subscribers(publisher)
    publisher.put(sample("joint_states"))
    kind, k = TOPICS["joint_states"], 0

    def full() -> bool:
        nonlocal k
        for _ in range(200):
            k += 1
            message = sample("joint_states", k)
            noise = os.urandom(600).hex()
            publisher.put_encoded(kind.encode(type(message)(message.stamp, (noise, "b", "c"), message.positions)))
        return recorder.failure is not None

    until(full, "the disk to be full")


def test_a_full_disk_ends_the_recording_with_one_line_and_a_readable_file(loopback: Loopback, tmp_path: Path) -> None:
    failures: list[str] = []
    path = tmp_path / "run.mcap"
    recorder = Recorder(loopback.client(), KEYS, ["apr02"], path, on_failure=failures.append)
    joints = publishers(loopback)["joint_states"]
    with recorder, disk_with_room_for(1_500_000):
        fill(recorder, joints)
    assert failures == [recorder.failure]
    assert "run.mcap: cannot be written" in failures[0]
    assert "\n" not in failures[0]
    recorded = messages_of(path)["/apr02/joint_states"]
    assert 0 < len(recorded) <= recorder.counts["/apr02/joint_states"]
    assert TOPICS["joint_states"].encode(sample("joint_states")) == recorded[0]
    joints.put(sample("joint_states"))  # who publishes does not notice


def test_a_repeated_message_is_recorded_once_and_lost_ones_counted(loopback: Loopback, recorder: Recorder) -> None:
    odom = publishers(loopback)["odom"]
    wait_for_subscribers(odom)
    for number in (1, 2, 2, 1, 3, 11):
        odom.put_numbered(TOPICS["odom"].encode(sample("odom", number)), number, (7, number, 1, False))
    until(lambda: recorder.messages == 4, "the four messages")
    recorder.close()
    sent = [TOPICS["odom"].encode(sample("odom", number)) for number in (1, 2, 3, 11)]
    assert messages_of(recorder.path) == {"/apr02/odom": sent}
    assert recorder.missed == {"/apr02/odom": 7}


@pytest.fixture
def server(loopback: Loopback) -> Iterator[FoxgloveServer]:
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
    with FoxgloveServer(port=0) as started:
        started.forward(loopback.client(), KEYS, ["apr02"])
        yield started


def connected(server: FoxgloveServer) -> Any:
    client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
    return client.connect(server.address, subprotocols=["foxglove.sdk.v1"], close_timeout=0.5)


def advertised(socket: Any) -> dict[str, dict[str, Any]]:
    """The channels that the server offers, by topic."""
    channels: dict[str, dict[str, Any]] = {}
    while len(channels) < len(TOPICS):
        message = json.loads(socket.recv(timeout=PATIENCE))
        if message["op"] == "advertise":
            channels.update({channel["topic"]: channel for channel in message["channels"]})
    return channels


def test_every_topic_is_offered_with_its_type_on_loopback_only(server: FoxgloveServer) -> None:
    with connected(server) as socket:
        channels = advertised(socket)
    assert {name: channel["schemaName"] for name, channel in channels.items()} == {
        "/tf" if topic == "tf" else f"/apr02/{topic}": kind.name for topic, kind in TOPICS.items()
    }
    assert {channel["encoding"] for channel in channels.values()} == {"cdr"}
    assert {channel["schemaEncoding"] for channel in channels.values()} == {"ros2msg"}
    port = int(server.address.rsplit(":", 1)[1])
    with open("/proc/net/tcp") as table:
        listening = [line.split()[1] for line in table if line.split()[3] == "0A"]
    assert [address for address in listening if address.endswith(f":{port:04X}")] == [f"0100007F:{port:04X}"]


def test_a_message_comes_through_with_its_numbers(loopback: Loopback, server: FoxgloveServer) -> None:
    odom = GraphNode(loopback.router, KEYS, "node").publisher("apr02", "odom")
    until(lambda: odom.matched, "the server's subscription")
    with connected(server) as socket:
        channel = advertised(socket)["/apr02/odom"]
        socket.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": channel["id"]}]}))
        before, messages = time.time_ns(), []

        def comes_through() -> bool:
            odom.put(odometry(3))
            with suppress(TimeoutError):  # the server does not say when it serves a new subscription
                messages.append(socket.recv(timeout=0.1))
            return bool(messages)

        until(comes_through, "the message")
    (message,) = messages
    opcode, subscription, stamp = struct.unpack_from("<BIQ", message)
    assert (opcode, subscription) == (1, 7)
    assert before <= stamp <= time.time_ns()
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(channel["schema"], channel["schemaName"]))  # by what the channel itself says
    content: Any = store.deserialize_cdr(message[13:], channel["schemaName"])
    assert (content.pose.pose.position.x, content.pose.pose.position.y) == (1.28, -2.5)
    assert content.twist.twist.angular.z == 0.45
    np.testing.assert_array_equal(content.pose.covariance.reshape(6, 6)[:2, :2], COVARIANCE[:2, :2])


def test_the_port_of_a_closed_server_can_be_used_at_once_and_robots_added_while_it_serves(loopback: Loopback) -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
    port = free_port()
    for _ in range(3):
        with FoxgloveServer(port=port) as server, connected(server) as application:
            server.forward(loopback.client(), KEYS, ["apr02"])
            advertised(application)
            server.forward(loopback.client(), KEYS, ["apr03"], ["odom"])
            message = json.loads(application.recv(timeout=PATIENCE))
            assert [channel["topic"] for channel in message["channels"]] == ["/apr03/odom"]


def test_ports_hosts_and_topics_that_cannot_be_are_named(loopback: Loopback, server: FoxgloveServer) -> None:
    port = int(server.address.rsplit(":", 1)[1])
    for host, wanted, named in (
        ("127.0.0.1", port, f"127.0.0.1:{port}: .*in use"),
        ("127.0.0.1", 80000, "port 80000"),
        ("192.0.2.1", free_port(), r"192\.0\.2\.1:"),
    ):
        with pytest.raises(ConfigError, match=named):
            FoxgloveServer(host, wanted)
    with pytest.raises(UnknownNameError, match="'odom'"):
        server.forward(loopback.router, KEYS, ["apr02"], ["odm"])


def test_a_client_that_does_not_read_holds_up_nobody(loopback: Loopback, server: FoxgloveServer) -> None:
    joints = GraphNode(loopback.router, KEYS, "node").publisher("apr02", "joint_states")
    until(lambda: joints.matched, "the server's subscription")
    message = sample("joint_states")
    payload = TOPICS["joint_states"].encode(replace(message, names=("a" * 10_000, "b", "c")))
    with connected(server) as frozen, connected(server) as reader:
        for each in (frozen, reader):
            channel = advertised(each)["/apr02/joint_states"]["id"]
            each.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel}]}))

            def arrives(to: Any = each) -> bool:
                joints.put_encoded(payload)
                with suppress(TimeoutError):
                    return bool(to.recv(timeout=0.05))
                return False

            until(arrives, "a first message")
        for _ in range(1500):  # 15 MB: more than the sockets and the backlog of the frozen client hold
            joints.put_encoded(payload)
            assert reader.recv(timeout=PATIENCE)


def test_a_layout_for_foxglove_holds_panels_of_each_robots_topics(tmp_path: Path) -> None:
    config = config_of(tmp_path, "apr02", "apr03", foxglove=True)
    layout = json.loads(foxglove_layout(config))
    panels, topics = layout["configById"], set(TOPICS) - {"tf", "joint_states"}
    tabs = {tab["title"]: tab["layout"] for tab in panels[layout["layout"]]["tabs"]}
    for robot, tree in tabs.items():
        shown = panels_of(tree)
        text = json.dumps([panels[name] for name in shown])
        assert {topic for topic in topics if f"/{robot}/{topic}" in text} == topics
        assert panels[f"3D!{robot}"]["followTf"] == "map"
    assert panels.keys() == {"Tab!robots"}.union(*map(panels_of, tabs.values()))
    assert list(tabs) == ["apr02", "apr03"]


def panels_of(tree: str | dict[str, Any]) -> set[str]:
    """The names of the panels in a layout's tree."""
    return {tree} if isinstance(tree, str) else panels_of(tree["first"]) | panels_of(tree["second"])


def test_rerun_gets_paths_covariances_innovations_and_health(loopback: Loopback, tmp_path: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
    each, mount = publishers(loopback), Mount(x=0.1, y=0.0, yaw=0.0)
    file = tmp_path / "shown" / "drive.rrd"
    with RerunView(loopback.client(), KEYS, {"apr02": mount}, file) as view:
        wait_for_subscribers(*(each[topic] for topic in ("odom", "odometry/filtered", "slam_pose", "diagnostics")))
        each["odometry/filtered"].put(replace(odometry(-10), pose_covariance=1e4 * np.eye(3)))  # not located yet
        for k in range(0, 100, 10):
            each["odom"].put(odometry(k))
            fused = odometry(k, "map")
            each["odometry/filtered"].put(replace(fused, pose=np.array([0.0, 0.1 * k, np.pi / 2])))
        each["slam_pose"].put_encoded(b"garbage")
        pose = np.array([0.03, 9.0 + 0.031 + 0.1 - 0.05, np.pi / 2])  # 0.1 s after the last fused pose, which moves on
        each["diagnostics"].put(sample("diagnostics"))
        each["slam_pose"].put(replace(sample("slam_pose"), stamp=STAMP + 100 * PERIOD, pose=pose))
        until(lambda: "apr02/slam_pose" in view._shown, "the last message")
    columns: dict[str, list[Any]] = {}
    for part in chunk.RrdReader(str(file)).stream().to_chunks():
        batch = part.to_record_batch().to_pydict()
        for name, values in batch.items():
            columns.setdefault(f"{part.entity_path} {name.rpartition(':')[2]}", []).extend(values)
    innovation = [columns[f"/apr02/innovation/{each} scalars"] for each in ("position/x", "position/y", "heading")]
    np.testing.assert_allclose(innovation, [[[0.03 - 0.012]], [[-0.05]], [[-math.degrees(0.045)]]], atol=1e-9)
    paths = {name: np.array(columns[f"/apr02/{name} strips"])[:, 0, :, :2] for name in ("odom", "filtered")}
    np.testing.assert_allclose(paths["filtered"][1:, 1] - paths["filtered"][1:, 0], [[0.0, 2.0]] * 4, atol=1e-6)
    assert np.array_equal(paths["odom"][1:, 0], paths["odom"][:-1, 1])  # without gaps
    (ellipse,) = np.array(columns["/apr02/filtered/ellipse strips"])[:, 0, :, :2]
    distances = np.einsum("ni,ij,nj->n", ellipse, np.linalg.inv(COVARIANCE[:2, :2]), ellipse)
    np.testing.assert_allclose(distances, 5.991, rtol=1e-4)
    deviations = [columns[f"/apr02/sigma/{each}/odom scalars"][0] for each in ("position", "heading")]
    np.testing.assert_allclose(deviations, [[math.sqrt(6.5e-4)], [math.degrees(0.04)]])
    ((turned,),) = columns["/apr02/odom rotation_axis_angle"]  # of odom's frame, to lie on the fused path
    assert turned["angle"] == pytest.approx(np.pi / 2 - 0.7)
    assert columns["/apr02/diagnostics/odometry text"] == [["late samples"]]
    ((table,),) = columns["/apr02/health text"]
    assert "| rate_hz | 99.8 |" in table


def test_what_rerun_cannot_begin_with_is_named(
    loopback: Loopback, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(DataError, match=r"drive\.rrd: cannot be written"):
        RerunView(loopback.router, KEYS, {"apr02": None}, tmp_path / "file" / "drive.rrd")
    monkeypatch.setattr(sys, "executable", "/bin/false")  # a viewer on a machine without a screen
    with refused(ConfigError, match=r"viewer does not open.*FILE\.rrd"):
        RerunView(loopback.router, KEYS, {"apr02": None}, None)
    monkeypatch.setitem(sys.modules, "rerun", None)  # what an absent package looks like
    with refused(ConfigError, match=r'pip install "omnibench\[rerun\]"'):
        RerunView(loopback.router, KEYS, {"apr02": None}, None)


@pytest.fixture
def apr02(loopback: Loopback) -> AnnouncedRobot:
    return AnnouncedRobot(loopback.router, "apr02")


@pytest.fixture
def monitor(loopback: Loopback) -> Iterator[RobotMonitor]:
    with RobotMonitor(loopback.client(), KEYS, None) as opened:
        yield opened


def status_of(monitor: RobotMonitor, robot: str) -> RobotStatus | None:
    return next((each for each in monitor.statuses() if each.robot == robot), None)


def until_status(monitor: RobotMonitor, robot: str, what: str, **expected: Any) -> RobotStatus:
    """The status of a robot as soon as its fields are as expected (... : anything but None)."""
    statuses: list[RobotStatus] = []

    def arrived() -> bool:
        status = status_of(monitor, robot)
        if status is None:
            return False
        statuses.append(status)
        return all(
            getattr(status, name) is not None if value is ... else getattr(status, name) == value
            for name, value in expected.items()
        )

    until(arrived, what)
    return statuses[-1]


def test_the_newest_odometry_of_both_topics_is_known(monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    apr02.wait_for_subscribers()
    for k in range(20):
        apr02.odom.put(odometry(k))
        apr02.filtered.put(odometry(k, "map"))
    status = until_status(monitor, "apr02", "odometry", filtered=..., odom=..., presence="alive")
    until(lambda: status_of(monitor, "apr02").odom.message.stamp == odometry(19).stamp, "the last odometry")
    status = status_of(monitor, "apr02")
    np.testing.assert_allclose(status.odom.message.pose, odometry(19).pose, atol=1e-15)
    assert status.filtered.message.frame == "map"


def test_the_rate_is_that_of_arrival(monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    apr02.wait_for_subscribers()
    before_first = time.monotonic()
    apr02.odom.put(odometry(0))
    until_status(monitor, "apr02", "odometry", odom=...)
    after_first = time.monotonic()
    for k in range(1, 50):
        apr02.odom.put(odometry(k))
        time.sleep(0.005)
    before_last = time.monotonic()
    apr02.odom.put(odometry(50))
    rates: list[float | None] = []

    def last_came() -> bool:
        status = status_of(monitor, "apr02")
        rates.append(status.odom.rate)
        return status.odom.message.stamp == odometry(50).stamp

    until(last_came, "the last message")
    slowest, fastest = 50 / (time.monotonic() - before_first), 50 / (before_last - after_first)
    assert slowest <= rates[-1] <= fastest


@pytest.mark.parametrize("agree", [True, False])
def test_the_stamps_age_is_told_if_clocks_agree(monitor: RobotMonitor, apr02: AnnouncedRobot, agree: bool) -> None:
    apr02.wait_for_subscribers()
    stamped = time.time_ns() - 200_000_000
    apr02.odom.put(replace(odometry(), stamp=stamped) if agree else odometry())  # of 2023
    status = until_status(monitor, "apr02", "odometry", odom=...)
    assert (status.odom.stamp_age is not None) == agree
    if status.odom.stamp_age is not None:
        assert 0.2 <= status.odom.stamp_age <= (time.time_ns() - stamped) / 1e9
        assert 0.0 <= status.odom.age < status.odom.stamp_age


def test_a_robot_leaves_and_another_is_seen(loopback: Loopback, monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    until_status(monitor, "apr02", "the token", presence="alive")
    apr02.token.undeclare()
    until_status(monitor, "apr02", "the token to go", presence="left")
    publisher = GraphNode(loopback.router, KEYS, "bridge").publisher("other", "odom")
    until(lambda: publisher.matched, "the monitor's subscription")
    publisher.put(odometry())
    assert until_status(monitor, "other", "odometry", odom=...).presence == "no token"


def test_health_is_asked_for_and_tells_counters_above_zero(monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    apr02.answer_health("degraded", "poses are refused", samples=100, late=3, pose_rejected=2)
    status = until_status(monitor, "apr02", "an answer", health=...)
    assert status.health == HealthSummary("degraded", "poses are refused", {"late": 3, "pose_rejected": 2})


def test_a_robot_that_is_mute_tells_its_health_by_diagnostics(monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    until(lambda: apr02.diagnostics.matched, "the monitor's subscription")
    values = (("rate_hz", "99.8"), ("samples", "500"), ("late", "7"))
    apr02.diagnostics.put(Diagnostics(1, (Diagnostic("odometry", 1, "late samples", "apr02", values),)))
    status = until_status(monitor, "apr02", "diagnostics", health=...)
    assert status.health == HealthSummary("warning", "late samples", {"late": 7})


def test_nonsense_for_health_is_passed_over(loopback: Loopback, monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    asked = Event()

    def nonsense(query: zenoh.Query) -> None:
        for document in (b"\xff{", b"[1, 2]", b'{"status": "ok", "message": "", "counts": {"late": "?"}}'):
            query.reply(f"omnibench/{apr02.name}/health", document)
        asked.set()

    _queryable = loopback.router.declare_queryable("omnibench/apr02/health", nonsense)
    until(lambda: status_of(monitor, "apr02") and asked.is_set(), "a question")
    assert until_status(monitor, "apr02", "the robot", presence="alive").health is None


def test_undecodable_and_lost_odometry_is_counted(monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    def counted(undecodable: int, missed: int) -> bool:
        status = status_of(monitor, "apr02")
        return bool(status and status.odom) and (status.odom.undecodable, status.odom.missed) == (undecodable, missed)

    apr02.wait_for_subscribers()
    apr02.odom.put(odometry())
    until_status(monitor, "apr02", "odometry", odom=...)
    apr02.odom.put_encoded(b"garbage")
    until(lambda: counted(1, 0), "the count of what cannot be decoded")
    status = status_of(monitor, "apr02")
    np.testing.assert_array_equal(status.odom.message.pose, odometry().pose)
    for _ in range(5):
        apr02.odom.next_number()  # of a message that is lost
    apr02.odom.put(odometry(6))
    until(lambda: counted(1, 5), "the count of what never came")


@pytest.mark.parametrize("profile", ["plain", "rmw", "humble"])
def test_robots_of_every_profile_are_named_by_their_keys(loopback: Loopback, profile: Profile) -> None:
    robot = AnnouncedRobot(loopback.router, "apr07", profile)
    with RobotMonitor(loopback.client(), KeySpace(profile), None) as monitor:
        robot.wait_for_subscribers()
        robot.odom.put(odometry())
        until_status(monitor, "apr07", "odometry", odom=...)


def test_only_the_robot_that_was_asked_for_is_shown(loopback: Loopback, apr02: AnnouncedRobot) -> None:
    other = AnnouncedRobot(loopback.router, "apr03")
    with RobotMonitor(loopback.client(), KEYS, "apr02") as monitor:
        apr02.wait_for_subscribers()
        other.odom.put(odometry())
        apr02.odom.put(odometry())
        until_status(monitor, "apr02", "odometry", odom=...)
        assert [status.robot for status in monitor.statuses()] == ["apr02"]
        assert monitor.alive == ("apr02", "apr03")
