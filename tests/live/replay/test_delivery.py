"""Delivery of a replay to a real node, whatever befalls it: all is taken, or it is said how much is missing."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from drives import calibration, drive
from nodes import Command, asked, config_of, connected, running, wheels_of, write_node
from recordings import random_dataset
from replayed import config
from sessions import free_port, raw_session, until
from timing import load

from omnibench.data.storage import save_dataset
from omnibench.live.config import read_live_config
from omnibench.live.replay.concatenated_drive import concatenate_runs
from omnibench.live.replay.replay_player import WINDOW, DeliveryError, Player
from omnibench.live.wire.messages import JOINT_STATE, packed
from omnibench.live.wire.topics import GraphNode, KeySpace
from omnibench.robot.kinematics import relative

LONG = concatenate_runs(random_dataset(7, 5, samples=2000), pause=0.1)  # 10,000 samples: many times the window
ALIVE = "omnibench/apr/alive"
PART = 1000  # messages that are played before the test does something


def counts(session: zenoh.Session) -> dict[str, int]:
    """What the node has counted."""
    return asked(session, "omnibench/apr/health")["counts"]


def player(session: zenoh.Session, **changes: Any) -> Player:
    return Player(GraphNode(session, KeySpace(), "replay"), "apr", LONG, config(speed="max", **changes))


class Gate:
    """Lets a part of a recording pass, and the rest once it is open."""

    def __init__(self) -> None:
        self.open = threading.Event()
        self._passed = 0

    def holds(self) -> bool:
        self._passed += 1
        return self._passed > PART and not self.open.is_set()


class Replay:
    """A replay that runs beside the test, which lets all but a part of it pass by ``go_on``."""

    def __init__(self, session: zenoh.Session, pool: ThreadPoolExecutor, **changes: Any) -> None:
        self._gate, self.stop = Gate(), threading.Event()
        self._report = pool.submit(player(session, **changes).play, self.stop, hold=self._gate.holds)
        self.done, self.report = self._report.done, self._report.result
        self.go_on = self._gate.open.set


@contextmanager
def playing(session: zenoh.Session, **changes: Any) -> Iterator[Replay]:
    """A replay of which a part has been taken."""
    with ThreadPoolExecutor(1) as pool:
        replay = Replay(session, pool, **changes)
        try:
            yield replay
        finally:
            replay.stop.set()


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def folder(tmp_path: Path, port: int) -> Path:
    """A folder with node.yaml, a node of robot apr."""
    write_node(tmp_path, "apr", port=port)
    return tmp_path


@pytest.fixture
def node(folder: Path, port: int) -> Iterator[Command]:
    with Command("live", folder / "node.yaml") as command:
        connected(port, ALIVE).close()
        yield command


@contextmanager
def replaying(folder: Path, port: int, *options: object) -> Iterator[Command]:
    """The command of a replay, of which a part has been taken."""
    if not (folder / "data").exists():
        save_dataset(random_dataset(7, 5, samples=2000), folder / "data")
    to = ("--robot", "apr", "--connect", f"tcp/127.0.0.1:{port}", *options)
    with connected(port, ALIVE) as session, Command("replay", folder / "data", *to) as replay:
        until(lambda: counts(session)["samples"] > 100, "a part of the recording")
        yield replay


class TestToANode:
    @pytest.mark.parametrize("busy", [False, pytest.param(True, marks=pytest.mark.slow)])
    def test_the_tail_is_taken_when_the_session_closes_right_after(self, tmp_path: Path, busy: bool) -> None:
        chosen = config_of(tmp_path)
        (endpoint,) = chosen.zenoh.listening
        with running(chosen) as (node, _):
            with load(2) if busy else nullcontext(), raw_session("client", connect=[endpoint]) as session:
                report = player(session).play()
            assert node.health("apr").counts["samples"] == report.sent["joint_states"]
        assert report.taken == report.total

    def test_a_node_that_starts_again_gets_the_rest(self, node: Command, folder: Path, port: int) -> None:
        with connected(port) as session, playing(session, wait=600) as replay:
            until(lambda: counts(session)["samples"] > PART / 2, "a part of the recording")
            node.kill()
            replay.go_on()
            with running(read_live_config(folder / "node.yaml")) as (again, _):
                report = replay.report()
                rest = again.health("apr").counts
        assert (report.taken, report.restarts) == (report.total, 1)
        assert rest["missing"] == 0
        assert rest["samples"] < report.sent["joint_states"]

    def test_what_a_killed_node_may_have_published_is_taken_and_not_published_again(self, tmp_path: Path) -> None:
        path, came = drive(1.0), []
        with running(config_of(tmp_path)) as (node, session):
            session.declare_subscriber("apr/odom", lambda sample: came.append(sample.payload.to_bytes()[4:12]))
            wheels = wheels_of(session)
            for number, payload in enumerate(path.payloads()[50:60], 50):  # 50 to 52 were on their way to another node
                wheels.put(payload, attachment=packed(number, bytes(16), (7, number, 50, number < 53)))
            until(lambda: node.health("apr").counts["samples"] == 10, "all samples")
            until(lambda: len(came) == 7, "the odometry of the others")
            wheels.put(path.payloads()[60], attachment=packed(60, bytes(16), (7, 60, 60, True)))  # a gap, to this node
            until(lambda: len(came) == 8, "its odometry")
            assert node.health("apr").counts["unpublished"] == 3
        assert came == [payload[4:12] for payload in path.payloads()[53:61]]

    def test_a_node_counts_the_numbered_samples_of_a_robot_that_never_came(self, tmp_path: Path) -> None:
        payloads = drive(4.0).payloads()
        with running(config_of(tmp_path)) as (node, session):
            wheels = wheels_of(session)
            for number in [*range(100), *range(150, 400, 2)]:
                wheels.put(payloads[number], attachment=packed(number, bytes(16)))
            until(lambda: node.health("apr").counts["samples"] == 225, "all samples")
            counted = node.health("apr").counts
        assert (counted["missing"], counted["clock_jumps"]) == (50 + 124, 0)

    @pytest.mark.slow
    @pytest.mark.parametrize("from_the_beginning", [False, True])
    def test_a_node_that_stands_still_misses_nothing(self, node: Command, port: int, from_the_beginning: bool) -> None:
        with connected(port) as session, ThreadPoolExecutor(1) as pool:
            wheels_of(session).undeclare()
            if from_the_beginning:
                os.kill(node.process.pid, signal.SIGSTOP)
            replay = Replay(session, pool, wait=600)
            if not from_the_beginning:
                until(lambda: counts(session)["samples"] > PART / 2, "a part of the recording")
                os.kill(node.process.pid, signal.SIGSTOP)
            replay.go_on()
            time.sleep(2.0)  # longer than the replay waits until it sends again
            assert not replay.done()
            os.kill(node.process.pid, signal.SIGCONT)
            report = replay.report()
            counted = counts(session)
        assert report.taken == report.total
        assert (counted["samples"], counted["duplicates"], counted["missing"]) == (report.sent["joint_states"], 0, 0)

    @pytest.mark.slow
    def test_no_more_than_the_window_is_under_way(self, node: Command, port: int) -> None:
        with connected(port) as session, playing(session, wait=600) as replay:
            until(lambda: counts(session)["samples"] > PART / 2, "a part of the recording")
            os.kill(node.process.pid, signal.SIGSTOP)
            replay.go_on()
            time.sleep(2.0)
            replay.stop.set()
            report = replay.report()  # although nothing is taken any more
            os.kill(node.process.pid, signal.SIGCONT)
        assert 0 < sum(report.sent.values()) - report.taken <= WINDOW

    @pytest.mark.slow
    def test_nodes_with_a_state_that_are_killed_integrate_all_of_it_once(self, tmp_path: Path, port: int) -> None:
        config = write_node(tmp_path, "apr", port=port, state="state", fusion="none")
        batch = calibration().model.poses([LONG.log()])[0]
        with ThreadPoolExecutor(1) as pool:
            node = Command("live", config)
            session, stop = connected(port, ALIVE), threading.Event()
            replay = player(session, wait=600, wheels={"use": "velocities"})  # from rates nothing lost can be made good
            report = pool.submit(replay.play, stop)
            try:
                for _ in range(2):
                    with connected(port, ALIVE) as client:
                        until(lambda: counts(client)["samples"] > PART, "a part of the recording")
                        node.kill()
                    node = Command("live", config)
                assert report.result().restarts == 2
                with connected(port, ALIVE) as client:
                    pose = asked(client, "omnibench/apr/pose")["odom"]
            finally:
                stop.set()
                node.kill()
                session.close()
        assert report.result().taken == report.result().total
        np.testing.assert_allclose([pose["x"], pose["y"]], relative(batch[0], batch[-1])[:2], atol=1e-6)

    @pytest.mark.slow
    def test_a_node_that_stays_away_is_one_line_with_the_number_that_is_missing(self, node: Command, port: int) -> None:
        with connected(port) as session, playing(session, wait=1) as replay:
            until(lambda: counts(session)["samples"] > PART / 2, "a part of the recording")
            node.kill()
            replay.go_on()
            with pytest.raises(DeliveryError, match="'apr'") as failure:
                replay.report()
        words = str(failure.value).replace(",", "").split()
        assert 0 < int(words[0]) < int(words[2])


@pytest.mark.slow
class TestTheCommand:
    @pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
    def test_without_its_node_it_exits_with_1(self, node: Command, folder: Path, port: int, number: int) -> None:
        with replaying(folder, port, "--speed", "20", "--set", "wait=2") as replay:
            os.kill(node.process.pid, number)
            out, said = replay.ended()
        if number == signal.SIGSTOP:
            os.kill(node.process.pid, signal.SIGCONT)
        assert (replay.process.returncode, out) == (1, "")
        assert "'apr'" in said.splitlines()[-1]
        assert "Traceback" not in said

    def test_a_signal_ends_it_while_the_node_stands_still(self, node: Command, folder: Path, port: int) -> None:
        with replaying(folder, port, "--set", "wait=3600") as replay:
            os.kill(node.process.pid, signal.SIGSTOP)
            out, _ = replay.stop(signal.SIGTERM)
        os.kill(node.process.pid, signal.SIGCONT)
        assert replay.process.returncode == 130
        assert "taken by the node" in out

    def test_suspended_itself_it_does_not_give_its_node_up(self, node: Command, folder: Path, port: int) -> None:
        with replaying(folder, port, "--set", "wait=3", "--speed", "100") as replay:
            os.kill(node.process.pid, signal.SIGSTOP)  # so that messages are under way
            time.sleep(0.2)
            os.kill(replay.process.pid, signal.SIGSTOP)
            os.kill(node.process.pid, signal.SIGCONT)
            time.sleep(4.0)  # longer than `wait`
            os.kill(replay.process.pid, signal.SIGCONT)
            out, said = replay.ended()
        assert replay.process.returncode == 0, said
        assert "all taken by the node" in out

    @pytest.mark.usefixtures("node")
    def test_it_ends_after_the_seconds_that_were_asked_for(self, folder: Path, port: int) -> None:
        with replaying(folder, port, "--speed", "20", "--seconds", "2") as replay:
            out, _ = replay.ended()
        assert replay.process.returncode == 0
        assert "all taken by the node" in out
        assert "stopped after" in out

    @pytest.mark.usefixtures("node")
    def test_two_replays_to_one_robot_say_what_the_node_could_not_use(self, folder: Path, port: int) -> None:
        with replaying(folder, port, "--speed", "20") as first, replaying(folder, port, "--speed", "20") as second:
            said = [first.ended()[0], second.ended()[0]]
        assert any("meanwhile the node counted" in out and "wheel sample" in out.split("counted")[1] for out in said)


class TestToOthers:
    @pytest.mark.slow
    def test_that_delivery_is_not_confirmed_is_said(self, tmp_path: Path, port: int) -> None:
        save_dataset(random_dataset(7), tmp_path / "data")
        came: list[object] = []
        with raw_session("router", listen=[f"tcp/127.0.0.1:{port}"]) as router:
            router.declare_subscriber("apr/joint_states", came.append)
            to = ("--robot", "apr", "--connect", f"tcp/127.0.0.1:{port}", "--speed", "max")
            with Command("replay", tmp_path / "data", *to) as replay:
                out, _ = replay.ended()
        assert replay.process.returncode == 0
        assert "delivery not confirmed" in out
        assert f"{len(came):,} wheel samples" in out

    @pytest.mark.slow
    def test_a_router_that_takes_nothing_any_more_is_told(self, tmp_path: Path, port: int) -> None:
        with (
            Command("live", write_node(tmp_path, port=port)) as router,
            connected(port) as listener,
            connected(port) as session,
        ):
            came: list[object] = []
            listener.declare_subscriber("apr/joint_states", came.append)
            with playing(session, wait=2) as replay:
                until(lambda: len(came) > PART / 2, "a part of the recording")
                os.kill(router.process.pid, signal.SIGSTOP)
                replay.go_on()
                with pytest.raises(DeliveryError, match=r"'apr': the (router|link)"):
                    replay.report()
                os.kill(router.process.pid, signal.SIGCONT)


@pytest.mark.slow
def test_two_nodes_for_one_robot_that_start_at_once_do_not_both_run(tmp_path: Path, port: int) -> None:
    to = {"mode": "client", "connect": [f"tcp/127.0.0.1:{port}"], "wait": 300.0}
    for name in ("first", "second", "router"):
        (tmp_path / name).mkdir()
    nodes = [Command("live", write_node(tmp_path / name, "apr", zenoh=to)) for name in ("first", "second")]
    # both wait for the router, and so start in the same moment
    with nodes[0], nodes[1], Command("live", write_node(tmp_path / "router", port=port)):
        until(lambda: any(each.process.poll() is not None for each in nodes), "the end of one")
        refused, other = sorted(nodes, key=lambda each: each.process.poll() is None)
        _, said = refused.ended()
        with connected(port, ALIVE) as session:
            wheels_of(session).put(JOINT_STATE.encode(drive(0.01).samples()[0]))
            until(lambda: counts(session)["samples"] == 1, "the sample in the node that runs")
        other.stop()
    assert refused.process.returncode == 2
    assert "error: robot 'apr' is " in said
