"""Replays over real sessions: all messages arrive, at their pace, until the end or a stop."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from recordings import random_dataset
from replayed import DRIVE, ORIGIN, TOPICS, config, of, played, same
from sessions import Loopback, until
from timing import PATIENCE

from omnibench.errors import ConfigError
from omnibench.live.replay.concatenated_drive import ConcatenatedDrive, concatenate_runs
from omnibench.live.replay.replay_player import Player, PlayReport
from omnibench.live.wire.messages import JOINT_STATE, POSE_ESTIMATE
from omnibench.live.wire.topics import GraphNode, KeySpace, Profile
from omnibench.progress import Progress

OVERSLEPT = 0.002  # s


class Clock(threading.Event):
    """The event that stops a replay; waiting for it takes no time, but moves the replay's clock on.

    now: s. Every wait takes OVERSLEPT longer than asked, as on a real machine, but never more.
    """

    def __init__(self) -> None:
        super().__init__()
        self.now = 1000.0

    def wait(self, timeout: float | None = None) -> bool:
        time.sleep(1e-5)  # lets Zenoh's threads run
        self.now += (timeout or 0.0) + OVERSLEPT
        return self.is_set()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock by which replays run in this test."""
    clock = Clock()
    times = SimpleNamespace(perf_counter=lambda: clock.now, time_ns=time.time_ns)
    monkeypatch.setattr("omnibench.live.replay.replay_player.time", times)
    return clock


class Listener:
    """Takes down what arrives on a robot's inputs, in a session of its own, as a node would."""

    def __init__(
        self, loopback: Loopback, profile: Profile = "plain", *, work: float = 0.0, stall: float = 0.0
    ) -> None:
        self._work = work  # s that it takes for a message
        self._stall = stall  # s more for the first one
        self._payloads: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
        node = GraphNode(loopback.client(), KeySpace(profile), "listener")
        self._subscribers = [node.subscribe("apr02", topic, self._take(topic)) for topic in TOPICS]

    @property
    def count(self) -> int:
        return sum(len(each) for each in self._payloads.values())

    def messages(self, topic: str) -> list[Any]:
        decode = {"joint_states": JOINT_STATE, "slam_pose": POSE_ESTIMATE}[topic].decode
        return [decode(payload) for payload in self._payloads[topic]]

    def _take(self, topic: str) -> Callable[[Any], None]:
        def take(sample: Any) -> None:
            self._payloads[topic].append(sample.payload.to_bytes())
            seconds, self._stall = self._work + self._stall, 0.0
            if seconds:
                time.sleep(seconds)

        return take


def player(loopback: Loopback, drive: ConcatenatedDrive = DRIVE, profile: Profile = "plain", **changes: Any) -> Player:
    return Player(GraphNode(loopback.client(), KeySpace(profile), "replay"), "apr02", drive, config(**changes))


class TestPlayer:
    @pytest.mark.parametrize("profile", ["plain", "rmw", "humble"])
    def test_everything_arrives_as_it_was_sent_and_in_that_order(self, loopback: Loopback, profile: Profile) -> None:
        node = Listener(loopback, profile)
        channel = {"jitter": 0.05, "drop": 0.1, "duplicate": 0.1}
        changes = {"wheels": channel, "slam": channel | {"period": 0}}
        report = player(loopback, profile=profile, speed="max", **changes).play()
        expected = played(**changes)
        until(lambda: node.count == len(expected), "all messages")
        for topic in TOPICS:
            sent = of(expected, topic)
            assert report.sent[topic] == len(sent)
            pairs = zip(node.messages(topic), sent, strict=True)
            assert all(same(message, event.message) for message, event in pairs)
        assert report.complete
        assert report.data_seconds == expected[-1].arrival

    @pytest.mark.parametrize("speed", [4, 20])
    def test_it_keeps_the_pace(self, loopback: Loopback, clock: Clock, speed: float) -> None:
        node = Listener(loopback)
        drive = concatenate_runs(random_dataset(2, 5), pause=3.0)
        report = player(loopback, drive, speed=speed, slam={"delay": 0}).play(clock)
        until(lambda: node.count == report.total, "all messages")
        assert report.wall_seconds == pytest.approx(report.data_seconds / speed, abs=2 * OVERSLEPT)
        assert 0 < report.late <= 2 * OVERSLEPT

    def test_after_a_hiccup_it_catches_up(self, loopback: Loopback, clock: Clock) -> None:
        node = Listener(loopback)
        stalled: list[Progress] = []

        def stall_once(progress: Progress) -> None:
            if not stalled:
                clock.now += 0.3
            stalled.append(progress)

        report = player(loopback, speed=4).play(clock, watch=stall_once)
        until(lambda: node.count == report.total, "all messages")
        assert report.wall_seconds == pytest.approx(report.data_seconds / 4, abs=2 * OVERSLEPT)
        assert report.late > 0.2

    def test_nothing_is_lost_at_the_highest_speed_on_a_subscriber_that_stalls(self, loopback: Loopback) -> None:
        node = Listener(loopback, stall=1.5)  # in which the buffers on the way fill up, with some 25,000 messages
        drive = concatenate_runs(random_dataset(3, 10, samples=5000), pause=0.1)
        report = player(loopback, drive, speed="max").play()
        assert report.complete
        assert report.total > 50_000
        until(lambda: node.count == report.total, "all messages")
        stamps = [message.stamp for message in node.messages("joint_states")]
        assert (np.diff(stamps) > 0).all()

    def test_nothing_is_lost_when_the_session_closes_right_after(self, loopback: Loopback) -> None:
        node = Listener(loopback, work=2e-5)
        session = loopback.client()
        drive = concatenate_runs(random_dataset(4, 5, samples=1000))
        report = Player(GraphNode(session, KeySpace(), "replay"), "apr02", drive, config(speed="max")).play()
        session.close()
        until(lambda: node.count == report.total, "all messages")

    def test_it_starts_when_a_subscriber_is_there_and_loses_nothing_of_the_beginning(self, loopback: Loopback) -> None:
        reports: list[PlayReport] = []
        waiting = player(loopback, speed="max")
        thread = threading.Thread(target=lambda: reports.append(waiting.play()))
        thread.start()
        time.sleep(0.2)  # it would have played all of it by now
        node = Listener(loopback)
        thread.join(PATIENCE)
        until(lambda: node.count == reports[0].total, "all messages")
        assert min(message.stamp for message in node.messages("joint_states")) == ORIGIN

    def test_a_node_without_fusion_is_enough(self, loopback: Loopback) -> None:
        node = GraphNode(loopback.client(), KeySpace(), "wheels only")
        samples: list[Any] = []
        subscriber = node.subscribe("apr02", "joint_states", samples.append)
        report = player(loopback, speed="max").play()
        until(lambda: len(samples) == report.sent["joint_states"], "all wheel samples")
        subscriber.undeclare()

    def test_nobody_who_subscribes_is_one_line(self, loopback: Loopback) -> None:
        begin = time.perf_counter()
        with pytest.raises(ConfigError, match=r"nobody subscribes to apr02/joint_states after 0\.3 s; start omnibench"):
            player(loopback, wait=0.3).play()
        assert time.perf_counter() - begin >= 0.3

    def test_without_waiting_it_plays_to_nobody(self, loopback: Loopback) -> None:
        report = player(loopback, wait=0, speed="max").play()
        assert report.complete

    def test_a_robot_that_cannot_be_part_of_a_key_is_refused(self, loopback: Loopback) -> None:
        with pytest.raises(ConfigError, match="robot 'a/\\*': a robot's name is one word"):
            Player(GraphNode(loopback.client(), KeySpace(), "replay"), "a/*", DRIVE, config())


class TestStopping:
    @pytest.fixture
    def progress(self) -> list[Progress]:
        return []

    @pytest.fixture
    def node(self, loopback: Loopback) -> Listener:
        return Listener(loopback)

    @pytest.mark.usefixtures("node")
    def test_progress_tells_messages_and_seconds_of_the_recording(
        self, loopback: Loopback, clock: Clock, progress: list[Progress]
    ) -> None:
        report = player(loopback, speed=4).play(clock, watch=progress.append)
        assert len(progress) >= 5
        done = [each.done for each in progress]
        assert done == sorted(done)
        note = f"{report.data_seconds:.0f} s of the drive"
        assert progress[-1] == Progress("playing as apr02", report.total, report.total, "message", note=note)
        times = [float(each.note.split()[0]) for each in progress]
        assert times == sorted(times)

    def test_it_stops_at_once_when_asked(
        self, loopback: Loopback, clock: Clock, node: Listener, progress: list[Progress]
    ) -> None:
        def stop_after_half_a_second(now: Progress) -> None:
            progress.append(now)
            if len(progress) == 5:  # they come ten times a second
                clock.set()

        report = player(loopback, speed=1).play(clock, stop_after_half_a_second)
        assert 0.5 <= report.wall_seconds <= 0.65
        assert not report.complete
        assert progress[-1].done == sum(report.sent.values()) < report.total
        until(lambda: node.count == progress[-1].done, "what was sent")

    def test_it_stops_at_once_at_ctrl_c(self, loopback: Loopback, node: Listener) -> None:
        main = threading.main_thread().ident
        assert main is not None

        def interrupt_once_it_plays() -> None:
            until(lambda: node.count > 3, "a few messages")
            signal.pthread_kill(main, signal.SIGINT)

        thread = threading.Thread(target=interrupt_once_it_plays)
        thread.start()
        report = player(loopback, speed=0.05).play()
        thread.join()
        assert not report.complete
        assert node.count > 0

    def test_it_stops_while_it_waits_for_a_subscriber(self, loopback: Loopback) -> None:
        stop = threading.Event()
        timer = threading.Timer(0.2, stop.set)
        timer.start()
        report = player(loopback, wait=600).play(stop)
        assert (sum(report.sent.values()), report.complete) == (0, False)
