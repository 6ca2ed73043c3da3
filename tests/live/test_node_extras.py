"""A node from Python does what its config says of recording and Foxglove, and leaves nothing open when it cannot."""

from __future__ import annotations

import json
import socket
import sys
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

import pytest
import zenoh
from drives import drive
from mcap.reader import make_reader
from nodes import asked, config_of, running, sent
from sessions import free_port, until
from timing import PATIENCE

from omnibench.errors import ConfigError, DataError
from omnibench.live.config import LiveConfig
from omnibench.live.network.presence import alive_robots
from omnibench.live.node import LiveNode
from omnibench.live.wire.recorder import Recorder
from omnibench.live.wire.topics import TOPICS


def driven(config: LiveConfig, seconds: float = 0.5) -> None:
    """Run the node of a config and send it the wheel samples of a drive."""
    path = drive(seconds)
    with running(config) as (node, session):
        wheels = session.declare_publisher("apr/joint_states")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        sent(wheels, path.samples())
        until(lambda: node.health("apr").counts["samples"] == len(path.stamps), "the last sample")


def recorded(file: Path) -> dict[str, int]:
    """Messages in a complete recording, by ROS topic."""
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    return {channel.topic: counts[number] for number, channel in summary.channels.items()}


def assert_nothing_is_open(config: LiveConfig) -> None:
    """The same robots start again on the same port, with the same state."""
    usual = config.model_copy(update={"record": None, "foxglove": False})
    with running(usual) as (_, session):
        assert asked(session, "omnibench/apr/health")["status"] == "waiting"


def test_a_config_with_record_writes_the_mcap_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    config = config_of(tmp_path, record="recordings/run.mcap")
    driven(config)
    file = tmp_path / "recordings" / "run.mcap"
    counts = recorded(file)
    counts.pop("/apr/diagnostics", None)  # once a second: one more where the machine is busy
    assert counts == {"/apr/joint_states": 51, "/apr/odom": 51, "/apr/odometry/filtered": 51, "/tf": 51}
    assert f"recording to {file}" in caplog.text


def test_a_recording_that_exists_already_is_kept_and_another_one_written(tmp_path: Path) -> None:
    config = config_of(tmp_path, record="run.mcap")
    driven(config, 0.1)
    first = (tmp_path / "run.mcap").read_bytes()
    driven(config, 0.2)
    (second,) = tmp_path.glob("run-*.mcap")
    assert (tmp_path / "run.mcap").read_bytes() == first
    assert recorded(second)["/apr/odom"] == 21


def test_a_recording_that_cannot_be_written_is_one_line_and_nothing_stays_open(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    config = config_of(tmp_path, record="file/run.mcap", state="state")
    with pytest.raises(DataError, match=r"file: exists already|run\.mcap: cannot be written"):
        LiveNode(config)
    assert_nothing_is_open(config)


def test_a_foxglove_port_that_is_taken_is_one_line_and_nothing_stays_open(tmp_path: Path) -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
    with closing(socket.socket()) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        config = config_of(tmp_path, foxglove=taken.getsockname()[1], record="run.mcap", state="state")
        with pytest.raises(ConfigError, match=r"^Foxglove server on 127.0.0.1:\d+: .*in use.*$"):
            LiveNode(config)
    assert not (tmp_path / "run.mcap").exists()
    assert_nothing_is_open(config)


def test_without_foxglove_sdk_the_line_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)  # what an absent package looks like
    config = config_of(tmp_path, foxglove=True)
    with pytest.raises(
        ConfigError, match=r'^the Foxglove server needs the package foxglove-sdk: pip install "foxglove-sdk"$'
    ):
        LiveNode(config)
    assert_nothing_is_open(config)


def test_what_has_started_is_closed_in_reverse_order_when_a_later_step_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_a_replay_that_waits_for_a_subscriber_finds_the_node_before_its_recorder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
