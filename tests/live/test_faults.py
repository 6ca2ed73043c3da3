"""What goes wrong on a robot, done to real nodes, routers and subscribers."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
import yaml
import zenoh
from chaos.run import run
from drives import SECOND, calibration, drive, slam
from nodes import Command, asked, config_of, connected, running, sent, sent_one_by_one, wheels_of, write_node
from sessions import free_port, until
from timing import PATIENCE

from omnibench.config import to_yaml
from omnibench.live.node import LiveNode
from omnibench.live.wire import JOINT_STATE, ODOMETRY, JointState, Odometry

pytestmark = pytest.mark.slow  # processes that are killed, stopped or frozen

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


def heard_odometry(session: zenoh.Session) -> list[Odometry]:
    messages: list[Odometry] = []
    session.declare_subscriber("apr/odom", lambda s: messages.append(ODOMETRY.decode(s.payload.to_bytes())))
    return messages


@contextmanager
def frozen_subscriber(endpoint: str) -> Iterator[None]:
    """Another process that subscribes to all of the robot and reads nothing."""
    frozen = subprocess.Popen([sys.executable, "-c", _FROZEN, endpoint], stdout=subprocess.PIPE, text=True)
    try:
        assert frozen.stdout.readline() == "subscribed\n"
        os.kill(frozen.pid, signal.SIGSTOP)
        yield
    finally:
        frozen.kill()
        frozen.communicate()


def test_a_frozen_subscriber_does_not_delay_the_others(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    (endpoint,) = config.zenoh.listening
    with running(config) as (node, session), frozen_subscriber(endpoint):
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
    assert max(delays) < 2.5  # s; who waits for the frozen one stalls until Zenoh closes its link, after 5 s


def test_a_node_ends_in_order_although_a_subscriber_is_frozen(tmp_path: Path) -> None:
    port = free_port()
    with Command("live", write_node(tmp_path, "apr", port=port)) as node:
        session = connected(port)
        with frozen_subscriber(f"tcp/127.0.0.1:{port}"):
            heard, path = heard_odometry(session), drive(30.0)
            sent(wheels_of(session), path.samples())  # 6 MB of odometry, filtered and tf fill its link
            until(lambda: heard and heard[-1].stamp == path.stamps[-1], "the last odometry")
            session.close()
            _, said = node.stop(signal.SIGTERM)
    assert node.process.returncode == 0, said
    assert "Traceback" not in said


def test_a_killed_node_goes_on_with_its_pose_and_calibration(tmp_path: Path) -> None:
    port = free_port()
    config = write_node(tmp_path, "apr", port=port, state="state")
    path, other = drive(4.0, using=calibration(scale=1.1)), calibration(scale=1.1)
    with Command("live", config) as node:
        session = connected(port)
        heard = heard_odometry(session)
        wheels = wheels_of(session)
        poses = wheels_of(session, topic="slam_pose")
        swapped = {"robot": "apr", "accepted": True, "calibration": "synthetic 1.1", "kept": True}
        assert asked(session, "omnibench/apr/swap", to_yaml(other)) == swapped
        sent_one_by_one(wheels, path.samples()[:150], heard)
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
        session = connected(port)
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


def test_a_node_goes_on_once_its_router_that_was_killed_is_back(tmp_path: Path) -> None:
    port, payloads = free_port(), iter(drive(100.0).payloads())
    for name in ("router", "node"):
        (tmp_path / name).mkdir()
    router = write_node(tmp_path / "router", port=port)
    to_router = {"mode": "client", "connect": [f"tcp/127.0.0.1:{port}"], "wait": PATIENCE}
    with (
        Command("live", router) as killed,
        LiveNode(config_of(tmp_path / "node", zenoh=to_router)) as node,
        connected(port) as robot,
    ):
        wheels, heard = wheels_of(robot), heard_odometry(robot)
        until(lambda: wheels.put(next(payloads)) or heard, "the first odometry")
        killed.kill()
        taken = node.health("apr").counts["samples"]
        heard.clear()
        with Command("live", router):
            until(lambda: wheels.put(next(payloads)) or heard, "odometry by way of the router that is back")
            assert asked(robot, "omnibench/apr/health")["counts"]["samples"] > taken


def test_memory_stays_flat_over_many_samples(tmp_path: Path) -> None:
    """Ten minutes at 100 Hz; tests/studies/live_memory.py takes an hour."""
    path = drive(60.0)
    whole = path.angles[-1] - path.angles[0]  # what the wheels turn but for the last sample
    with running(config_of(tmp_path)) as (node, session):
        wheels, poses = wheels_of(session), wheels_of(session, topic="slam_pose")
        sizes = []
        for minute in range(10):
            shift = minute * 60 * SECOND
            for index, sample in enumerate(path.samples()[:-1]):
                turned = JointState(sample.stamp + shift, sample.names, sample.positions + minute * whole, None)
                wheels.put(JOINT_STATE.encode(turned))
                if index % 25 == 0:
                    poses.put(slam(sample.stamp + shift, [0, 0, 0], np.eye(3)))
            until(lambda count=6000 * (minute + 1): node.health("apr").counts["samples"] >= count, "samples")
            sizes.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"))
        assert node.health("apr").counts["samples"] == 60_000
    assert sizes[-1] - sizes[2] < 8e6, sizes


@pytest.mark.parametrize(("command", "number"), [("listen", signal.SIGTERM), ("live", signal.SIGINT)])
def test_a_signal_ends_the_wait_for_a_router_that_stands_still(tmp_path: Path, command: str, number: int) -> None:
    port = free_port()
    (tmp_path / "node").mkdir()
    to = {"mode": "client", "connect": [f"tcp/127.0.0.1:{port}"], "wait": 600.0}
    node = write_node(tmp_path / "node", "apr", zenoh=to)
    (tmp_path / "client.yaml").write_text(yaml.safe_dump({"zenoh": to}))
    with Command("live", write_node(tmp_path, port=port)) as router:
        connected(port).close()
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


def test_every_sample_is_accounted_for_through_random_faults() -> None:
    said: list[str] = []
    assert run(15.0, 5, said.append), "\n".join(said)
