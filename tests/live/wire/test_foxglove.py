"""The Foxglove server, seen by a real WebSocket client."""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from samples import COVARIANCE, odometry, sample
from sessions import Loopback, free_port, until
from timing import PATIENCE

from omnibench.errors import ConfigError, UnknownNameError
from omnibench.live.wire.foxglove import FoxgloveServer
from omnibench.live.wire.topics import TOPICS, GraphNode, KeySpace

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")

KEYS = KeySpace()


@pytest.fixture
def server(loopback: Loopback) -> Iterator[FoxgloveServer]:
    with FoxgloveServer(port=0) as started:
        started.forward(loopback.client(), KEYS, ["apr02"])
        yield started


def connected(server: FoxgloveServer) -> Any:
    return client.connect(server.address, subprotocols=["foxglove.sdk.v1"], close_timeout=0.5)


def advertised(socket: Any) -> dict[str, dict[str, Any]]:
    """The channels that the server offers, by topic."""
    channels: dict[str, dict[str, Any]] = {}
    while len(channels) < len(TOPICS):
        message = json.loads(socket.recv(timeout=PATIENCE))
        if message["op"] == "advertise":
            channels.update({channel["topic"]: channel for channel in message["channels"]})
    return channels


def test_every_topic_is_offered_with_its_type(server: FoxgloveServer) -> None:
    with connected(server) as socket:
        channels = advertised(socket)
    assert {name: channel["schemaName"] for name, channel in channels.items()} == {
        "/tf" if topic == "tf" else f"/apr02/{topic}": kind.name for topic, kind in TOPICS.items()
    }
    assert {channel["encoding"] for channel in channels.values()} == {"cdr"}
    assert {channel["schemaEncoding"] for channel in channels.values()} == {"ros2msg"}


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


def test_robots_can_be_added_while_it_serves(loopback: Loopback, server: FoxgloveServer) -> None:
    with connected(server) as socket:
        advertised(socket)
        server.forward(loopback.client(), KEYS, ["apr03"], ["odom"])
        message = json.loads(socket.recv(timeout=PATIENCE))
    assert [channel["topic"] for channel in message["channels"]] == ["/apr03/odom"]


def test_it_listens_on_loopback_only(server: FoxgloveServer) -> None:
    port = int(server.address.rsplit(":", 1)[1])
    with open("/proc/net/tcp") as table:
        listening = [line.split()[1] for line in table if line.split()[3] == "0A"]
    assert [address for address in listening if address.endswith(f":{port:04X}")] == [f"0100007F:{port:04X}"]


def test_a_port_in_use_is_one_line() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"127.0.0.1:{port}: .*in use.*another.* port"):
            FoxgloveServer(port=port)


def test_the_port_of_a_closed_server_can_be_used_at_once(loopback: Loopback) -> None:
    port = free_port()
    for _ in range(20):
        with FoxgloveServer(port=port) as server, connected(server) as application:
            server.forward(loopback.client(), KEYS, ["apr02"])
            advertised(application)


def test_a_host_that_is_not_this_machine_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r"Foxglove server on 192\.0\.2\.1:"):
        FoxgloveServer("192.0.2.1", free_port())


def test_a_port_that_cannot_be_is_one_line() -> None:
    with pytest.raises(ConfigError, match="port 80000: expected 0 to 65535"):
        FoxgloveServer(port=80000)


def test_without_the_package_the_line_says_how_to_install_it() -> None:
    program = (
        "import sys; sys.modules['foxglove'] = None\n"  # what an absent package looks like
        "from omnibench.live.wire.foxglove import FoxgloveServer\n"
        "from omnibench.errors import ConfigError\n"
        "try: FoxgloveServer(port=0)\n"
        "except ConfigError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == 'the Foxglove server needs the package foxglove-sdk: pip install "foxglove-sdk"\n'


def test_a_misspelt_topic_is_answered_with_the_nearest(loopback: Loopback, server: FoxgloveServer) -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'odom'"):
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


def test_messages_that_never_came_are_counted(loopback: Loopback, server: FoxgloveServer) -> None:
    odom = GraphNode(loopback.router, KeySpace(), "robot").publisher("apr02", "odom", lossless=True)
    until(lambda: odom.matched, "the server's subscription")
    odom.put(odometry(0))
    odom.next_number()  # of a message that is lost

    def counted() -> bool:
        odom.put(odometry(1))
        return server.missed == 1

    until(counted, "the count")
