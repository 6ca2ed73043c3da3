"""What goes wrong on a robot, done to real nodes, routers and subscribers."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
import zenoh
from drives import SECOND, calibration, drive, slam
from nodes import Command, as_text, asked, config_of, running, sent, sent_one_by_one, write_node
from sessions import free_port, raw_session, until
from timing import PATIENCE

from omnibench.live.wire.messages import JOINT_STATE, ODOMETRY, JointState, Odometry

_BLOCK: Any = zenoh.CongestionControl.BLOCK
_FROZEN = """
import sys, zenoh
config = zenoh.Config.from_json5(
    '{mode: "client", connect: {endpoints: ["%s"]}, scouting: {multicast: {enabled: false}},'
    ' transport: {link: {tcp: {so_rcvbuf: 16384}}}}' % sys.argv[1]
)
session = zenoh.open(config)
subscriber = session.declare_subscriber("apr/**")
for sample in subscriber:  # the node's diagnostics at first
    print("subscribed", flush=True)
"""


def client(port: int) -> zenoh.Session:
    """A client of whoever listens there, once somebody does."""
    found: list[zenoh.Session] = []

    def connected() -> bool:
        try:
            found.append(raw_session("client", connect=[f"tcp/127.0.0.1:{port}"]))
        except zenoh.ZError:
            return False
        return True

    until(connected, "a router")
    return found[0]


def heard_odometry(session: zenoh.Session) -> list[Odometry]:
    messages: list[Odometry] = []
    session.declare_subscriber("apr/odom", lambda s: messages.append(ODOMETRY.decode(s.payload.to_bytes())))
    return messages


def wheels_of(session: zenoh.Session) -> zenoh.Publisher:
    publisher = session.declare_publisher("apr/joint_states", congestion_control=_BLOCK)  # bursts lose nothing
    until(lambda: publisher.matching_status.matching, "the node's subscription")
    return publisher


def test_a_frozen_subscriber_does_not_delay_the_others(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    (endpoint,) = config.zenoh.listening
    with running(config) as (node, session):
        frozen = subprocess.Popen([sys.executable, "-c", _FROZEN, endpoint], stdout=subprocess.PIPE, text=True)
        try:
            assert frozen.stdout is not None
            assert frozen.stdout.readline() == "subscribed\n"
            os.kill(frozen.pid, signal.SIGSTOP)
            delays: list[float] = []
            sent_at: dict[int, float] = {}

            def came(sample: zenoh.Sample) -> None:
                stamp = ODOMETRY.decode(sample.payload.to_bytes()).stamp
                delays.append(time.perf_counter() - sent_at[stamp])

            session.declare_subscriber("apr/odom", came)
            wheels, path = wheels_of(session), drive(30.0)
            # where the machine is so busy that samples wait, only the newest pose is published
            known: Callable[[], int] = lambda: len(delays) + node.health("apr").counts["unpublished"]  # noqa: E731
            # 6 MB of odometry, filtered and tf, many times what the sockets and queues hold; as fast as the healthy
            # subscriber takes them, so that a busy machine does not delay them
            for index, sample in enumerate(path.samples()[:3000]):
                until(
                    lambda index=index: index - len(delays) < 20 or index - known() < 20,
                    "earlier odometry in the healthy subscriber",
                )
                sent_at[sample.stamp] = time.perf_counter()
                wheels.put(JOINT_STATE.encode(sample))
            until(lambda: known() >= 3000, "every odometry in the healthy subscriber")
        finally:
            frozen.kill()
            frozen.wait()
    assert max(delays) < 2.5  # s; who waits for the frozen one stalls until Zenoh closes its link, after 5 s


def test_a_node_ends_in_order_although_a_subscriber_is_frozen(tmp_path: Path) -> None:
    port = free_port()
    with Command("live", write_node(tmp_path, "apr", port=port)) as node:
        session, endpoint = client(port), f"tcp/127.0.0.1:{port}"
        frozen = subprocess.Popen([sys.executable, "-c", _FROZEN, endpoint], stdout=subprocess.PIPE, text=True)
        try:
            assert frozen.stdout is not None
            assert frozen.stdout.readline() == "subscribed\n"
            os.kill(frozen.pid, signal.SIGSTOP)
            heard, path = heard_odometry(session), drive(30.0)
            sent(wheels_of(session), path.samples())  # 6 MB of odometry, filtered and tf fill its link
            until(lambda: heard and heard[-1].stamp == path.stamps[-1], "the last odometry")
            session.close()
            _, said = node.stop(signal.SIGTERM)
        finally:
            frozen.kill()
            frozen.wait()
    assert node.process.returncode == 0, said
    assert "Traceback" not in said


def test_a_killed_router_is_found_again_when_it_is_back(tmp_path: Path) -> None:
    port = free_port()
    (tmp_path / "router").mkdir()
    router_config = write_node(tmp_path / "router", port=port)
    connected = {"mode": "client", "connect": [f"tcp/127.0.0.1:{port}"], "wait": PATIENCE}
    (tmp_path / "node").mkdir()
    node_config = write_node(tmp_path / "node", "apr", zenoh=connected)
    path = drive(20.0)
    payloads = path.payloads()
    with Command("live", router_config) as router, Command("live", node_config):
        robot, listener = client(port), client(port)
        heard = heard_odometry(listener)
        wheels = wheels_of(robot)
        sent_one_by_one(wheels, path.samples()[:100], heard)
        router.kill()
        with Command("live", router_config):
            # the robot goes on sending all the time; some samples are lost until all three are connected again
            taken = 100

            def again() -> bool:
                nonlocal taken
                wheels.put(payloads[taken])
                taken += 1
                time.sleep(0.02)
                return len(heard) > 105

            until(again, "odometry after")
            for payload in payloads[taken:]:
                wheels.put(payload)

            def last() -> bool:
                wheels.put(payloads[-1])  # once more: of the burst some may be lost, too
                time.sleep(0.02)
                return heard[-1].stamp == path.stamps[-1]

            until(last, "the last odometry")
        # the wheels' angles hold what was lost; one arc in its place is off by the more, the longer the way back took
        turned = heard[-1].pose[2] - path.poses[-1, 2]
        assert abs(math.remainder(turned, 2 * math.pi)) < 1e-6
        robot.close()
        listener.close()


def test_a_killed_node_goes_on_with_its_pose_and_calibration(tmp_path: Path) -> None:
    port = free_port()
    config = write_node(tmp_path, "apr", port=port, state="state")
    path, other = drive(4.0, using=calibration(scale=1.1)), calibration(scale=1.1)
    with Command("live", config) as node:
        session = client(port)
        heard = heard_odometry(session)
        wheels = wheels_of(session)
        poses = session.declare_publisher("apr/slam_pose")
        assert asked(session, "omnibench/apr/swap", as_text(other))["accepted"]
        sent_one_by_one(wheels, path.samples()[:150], heard)
        until(lambda: poses.matching_status.matching, "the node's subscription")
        poses.put(slam(path.stamps[140], [7.0, 8.0, 0.5]))
        until(lambda: asked(session, "omnibench/apr/health")["counts"]["poses"] == 1, "the pose")
        time.sleep(0.15)  # a sample is saved when the last one that was is 0.1 s old, or older
        sent_one_by_one(wheels, path.samples()[150:200], heard)
        saved = tmp_path / "state" / "apr.state.json"
        until(lambda: re.search('"map_pose": ?\\[', saved.read_text(errors="replace")), "the located robot on disk")
        mapped = asked(session, "omnibench/apr/pose")["map"]
        node.kill()
        session.close()
    with Command("live", config):
        session = client(port)
        heard_again = heard_odometry(session)
        wheels = wheels_of(session)
        assert asked(session, "omnibench/apr/info")["calibration"] == "synthetic 1.1"
        sent_one_by_one(wheels, path.samples()[200:], heard_again)
        assert heard_again[0].stamp > heard[-1].stamp
        step = np.linalg.norm(heard_again[0].pose[:2] - heard[-1].pose[:2])
        assert step < 0.02  # m; it went on where it was, and the angles tell what it missed
        np.testing.assert_allclose(heard_again[-1].pose[:2], path.poses[-1, :2], atol=0.01)
        health = asked(session, "omnibench/apr/health")
        assert health["fusion"]["located"]
        after = asked(session, f"omnibench/apr/pose?at={path.stamps[200]}")["map"]
        assert np.hypot(after["x"] - mapped["x"], after["y"] - mapped["y"]) < 0.03
        session.close()


def test_a_stopped_node_says_where_it_was_and_goes_on_exactly_there(tmp_path: Path) -> None:
    port, path = free_port(), drive(2.0)
    config = write_node(tmp_path, "apr", port=port, state="state")
    for first, last in ((0, 100), (100, 201)):
        with Command("live", config) as node:
            session = client(port)
            heard = heard_odometry(session)
            sent_one_by_one(wheels_of(session), path.samples()[first:last], heard)
            session.close()
            _, said = node.stop(signal.SIGTERM)
            assert node.process.returncode == 0
            assert "Traceback" not in said
    assert "apr: goes on at x" in said
    np.testing.assert_allclose(heard[-1].pose[:2], path.poses[-1, :2], atol=1e-9)


def nonsense() -> list[tuple[str, str, bytes, str]]:
    """Topic, what it is, payload, and the counter that counts it."""
    path = drive(3.0)
    whole = path.payloads()[10]
    names = ("a", "b", "c")
    stamp = path.stamps[-1] + 10_000_000
    joints = [
        ("nan", JointState(stamp, names, np.array([np.nan, 0, 0]), None), "not_finite"),
        ("infinity", JointState(stamp, names, np.array([0, np.inf, 0]), None), "not_finite"),
        ("other joints", JointState(stamp, ("x", "y", "z"), np.zeros(3), None), "wrong_joints"),
        ("nothing", JointState(stamp, names), "wrong_joints"),
        ("time backwards", JointState(stamp - 100 * SECOND, names, np.zeros(3), None), "late"),
    ]
    cases = [("joint_states", what, JOINT_STATE.encode(each), counter) for what, each, counter in joints]
    for what, payload in (
        ("garbage", b"\xde\xad\xbe\xef" * 40),
        ("nothing at all", b""),
        ("truncated", whole[:-9]),
        ("a length beyond memory", whole[:44] + b"\xff\xff\xff\x7f" + whole[48:]),
        ("another type", slam(stamp, [0, 0, 0])),
        ("text", b'{"positions": [1, 2, 3]}'),
    ):
        cases.append(("joint_states", what, payload, "undecodable"))
    last = path.stamps[-1]
    for what, payload, counter in (
        ("garbage", b"\xde\xad\xbe\xef" * 40, "pose_undecodable"),
        ("truncated", slam(last, [0, 0, 0])[:100], "pose_undecodable"),
        ("a wheel message", whole, "pose_undecodable"),
        ("nan", slam(last, [np.nan, 0, 0]), "pose_invalid"),
        ("no covariance", slam(last, [0, 0, 0], np.full((3, 3), np.nan)), "pose_default_covariance"),
        ("a kilometre away", slam(last - 20_000_000, [1000, 0, 0]), "pose_rejected"),
        ("of an hour ago", slam(last - 3600 * SECOND, [0, 0, 0]), "pose_too_late"),
        ("of tomorrow", slam(last + 86400 * SECOND, [0, 0, 0]), "pose_ahead"),
    ):
        cases.append(("slam_pose", what, payload, counter))
    return cases


def test_nonsense_on_any_topic_is_counted_and_the_stream_lives(tmp_path: Path) -> None:
    path = drive(3.0)
    with running(config_of(tmp_path)) as (node, session):
        heard = heard_odometry(session)
        wheels, poses = wheels_of(session), session.declare_publisher("apr/slam_pose")
        until(lambda: poses.matching_status.matching, "the node's subscription")
        sent_one_by_one(wheels, path.samples(), heard)
        poses.put(slam(path.stamps[-1], [0, 0, 0]))
        until(lambda: node.health("apr").counts["poses"] == 1, "a pose")
        before = np.array(heard[-1].pose)
        for topic, what, payload, counter in nonsense():
            counted = node.health("apr").counts[counter]
            publisher = wheels if topic == "joint_states" else poses
            publisher.put(payload)
            if what == "time backwards":  # a single stamp is only suspected; the next good one clears it up
                good = JointState(path.stamps[-1] + 5_000_000, ("a", "b", "c"), path.angles[-1], None)
                publisher.put(JOINT_STATE.encode(good))
            until(
                lambda counter=counter, counted=counted: node.health("apr").counts[counter] == counted + 1,
                f"{what} on {topic} to be counted as {counter}",
            )
        assert node.health("apr").counts["failures"] == 0
        angles = path.angles[-1] + [0.01, 0.01, 0.01]
        wheels.put(JOINT_STATE.encode(JointState(path.stamps[-1] + 20_000_000, ("a", "b", "c"), angles, None)))
        until(lambda: heard[-1].stamp == path.stamps[-1] + 20_000_000, "odometry after")
        assert np.linalg.norm(heard[-1].pose[:2] - before[:2]) < 0.01


def test_memory_stays_flat_over_many_samples(tmp_path: Path) -> None:
    """Ten minutes at 100 Hz; tests/studies/live_memory.py takes an hour."""
    path = drive(60.0)
    with running(config_of(tmp_path)) as (node, session):
        wheels, poses = wheels_of(session), session.declare_publisher("apr/slam_pose", congestion_control=_BLOCK)
        sizes = []
        for minute in range(10):
            shift = minute * 60 * SECOND
            for index, sample in enumerate(path.samples()[:-1]):
                turned = JointState(sample.stamp + shift, sample.names, sample.positions + minute * whole(path), None)
                wheels.put(JOINT_STATE.encode(turned))
                if index % 25 == 0:
                    poses.put(slam(sample.stamp + shift, [0, 0, 0], np.eye(3)))
            until(lambda count=6000 * (minute + 1): node.health("apr").counts["samples"] >= count, "samples")
            sizes.append(resident())
        assert node.health("apr").counts["samples"] == 60_000
    assert sizes[-1] - sizes[2] < 8e6, sizes


def whole(path: Any) -> np.ndarray:
    """What the wheels turn in a drive but for its last sample."""
    return path.angles[-1] - path.angles[0]


def resident() -> int:
    """Bytes of this process in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def test_a_port_that_is_taken_is_told_in_one_line(tmp_path: Path) -> None:
    port = free_port()
    router = raw_session("router", listen=[f"tcp/127.0.0.1:{port}"])
    try:
        node = Command("live", write_node(tmp_path, "apr", port=port), cwd=tmp_path)
        out, said = node.ended()
        assert node.process.returncode == 2
        assert said.startswith("error: ")
        assert said.count("\n") == 1
        assert str(port) in said
        assert out == ""
    finally:
        router.close()


@pytest.mark.parametrize(("command", "number"), [("listen", signal.SIGTERM), ("live", signal.SIGINT)])
def test_a_signal_ends_the_wait_for_a_router_that_stands_still(tmp_path: Path, command: str, number: int) -> None:
    port = free_port()
    (tmp_path / "node").mkdir()
    to = {"mode": "client", "connect": [f"tcp/127.0.0.1:{port}"], "wait": 600.0}
    node = write_node(tmp_path / "node", "apr", zenoh=to)
    (tmp_path / "client.yaml").write_text(yaml.safe_dump({"zenoh": to}))
    with Command("live", write_node(tmp_path, port=port)) as router:
        client(port).close()
        os.kill(router.process.pid, signal.SIGSTOP)
        what = ("live", node) if command == "live" else ("listen", "apr", "--config", tmp_path / "client.yaml")
        with Command(*what) as waiting:
            until(lambda: linked(waiting.process.pid, port), "its link")
            _, said = waiting.stop(number)
        os.kill(router.process.pid, signal.SIGCONT)
    assert waiting.process.returncode == 128 + number
    assert "interrupted" in said


def linked(pid: int, port: int) -> bool:
    """True if a process has a TCP connection to a port of this machine."""
    rows = [line.split() for line in Path(f"/proc/{pid}/net/tcp").read_text().splitlines()[1:]]
    links = {f"socket:[{row[9]}]" for row in rows if int(row[2].rpartition(":")[2], 16) == port and row[3] == "01"}
    for file in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # closed meanwhile
            if str(file.readlink()) in links:
                return True
    return False


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_node_ends_at_once_and_without_a_word_too_many_when_told(tmp_path: Path, number: int) -> None:
    port = free_port()
    with Command("live", write_node(tmp_path, "apr", port=port)) as node:
        client(port).close()
        _, said = node.stop(number)
        assert node.process.returncode == 0
        assert "Traceback" not in said
