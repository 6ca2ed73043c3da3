"""Replay: which messages there are, when they arrive, what they hold, and playing them over real sessions."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import random_dataset
from replayed import DRIVE, ORIGIN, TOPICS, arrivals, config, of, played, same, taken
from sessions import Loopback, until
from timing import PATIENCE

from omnibench.config import parse_yaml, to_yaml, validate
from omnibench.errors import ConfigError
from omnibench.live.replay.concatenated_drive import ConcatenatedDrive, ReplayConfig, concatenate_runs
from omnibench.live.replay.replay_player import Player, PlayReport, ReplayMessages
from omnibench.live.wire.messages import JOINT_STATE, POSE_ESTIMATE
from omnibench.live.wire.topics import GraphNode, KeySpace, Profile
from omnibench.progress import Progress
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

# Events


@given(st.integers(0, 100), st.floats(0, 0.5), st.floats(0, 0.5), st.floats(0, 1), st.floats(0, 1), st.floats(0, 0.5))
def test_events_come_by_time_of_arrival_and_never_before_they_were_taken(
    seed: int, delay: float, jitter: float, drop: float, duplicate: float, period: float
) -> None:
    channel = {"delay": delay, "jitter": jitter, "drop": drop, "duplicate": duplicate}
    played_events = played(seed=seed, wheels=channel, slam=channel | {"period": period})
    assert (np.diff(arrivals(played_events)) >= 0).all()
    assert (arrivals(played_events) - taken(played_events) >= delay - 1e-9).all()


def test_without_jitter_stamps_increase_and_delays_are_as_asked() -> None:
    played_events = played(wheels={"delay": 0.03}, slam={"delay": 0.2, "jitter": 0, "period": 0})
    for topic, delay in (("joint_states", 0.03), ("slam_pose", 0.2)):
        messages = of(played_events, topic)
        assert (np.diff([each.message.stamp for each in messages]) > 0).all()
        np.testing.assert_allclose(arrivals(messages) - taken(messages), delay, atol=1e-8)


def test_every_sample_and_pose_of_the_drive_is_there() -> None:
    played_events = played(slam={"period": 0})
    samples, poses = of(played_events, "joint_states"), of(played_events, "slam_pose")
    poses.sort(key=lambda each: each.message.stamp)
    np.testing.assert_allclose(taken(samples), DRIVE.wheel_times, atol=1e-9)
    np.testing.assert_array_equal([each.message.positions for each in samples], DRIVE.angles)
    np.testing.assert_array_equal([each.message.velocities for each in samples], DRIVE.rates)
    np.testing.assert_allclose(taken(poses), DRIVE.slam_times, atol=1e-9)
    np.testing.assert_array_equal([each.message.pose for each in poses], DRIVE.slam_poses)
    assert {each.message.frame for each in poses} == {"map"}


def test_jitter_is_half_normal() -> None:
    times = 0.01 * np.arange(20_000.0)
    long = replace(DRIVE, wheel_times=times, angles=np.zeros((20_000, 3)), rates=np.zeros((20_000, 3)))
    samples = of(played(long, wheels={"delay": 1.0, "jitter": 0.05}), "joint_states")
    late = arrivals(samples) - taken(samples) - 1.0
    assert late.min() > -1e-9
    assert late.mean() == pytest.approx(0.05 * math.sqrt(2 / math.pi), rel=0.05)
    assert late.std() == pytest.approx(0.05 * math.sqrt(1 - 2 / math.pi), rel=0.05)


def test_jitter_of_more_than_the_period_brings_wheel_samples_out_of_order() -> None:
    stamps = np.array([each.message.stamp for each in of(played(wheels={"jitter": 0.05}), "joint_states")])
    assert np.count_nonzero(np.diff(stamps) < 0) > 10
    assert len(np.unique(stamps)) == len(DRIVE.wheel_times)


def test_the_share_to_drop_is_dropped() -> None:
    samples = of(played(wheels={"drop": 0.3}), "joint_states")
    assert len(samples) == pytest.approx(0.7 * len(DRIVE.wheel_times), rel=0.2)
    assert of(played(slam={"drop": 1}), "slam_pose") == []


def test_the_share_to_duplicate_comes_twice_with_the_same_content() -> None:
    samples = of(played(wheels={"duplicate": 0.3, "jitter": 0.05}), "joint_states")
    counts = Counter(each.message.stamp for each in samples)
    assert set(counts.values()) == {1, 2}
    assert sum(count == 2 for count in counts.values()) == pytest.approx(0.3 * len(DRIVE.wheel_times), rel=0.25)
    stamp = next(stamp for stamp, count in counts.items() if count == 2)
    first, second = (each for each in samples if each.message.stamp == stamp)
    assert same(first.message, second.message)
    assert first.arrival != second.arrival


def test_the_same_seed_gives_the_same_and_another_one_another() -> None:
    channel = {"jitter": 0.01, "drop": 0.1, "duplicate": 0.1}
    first, again, other = (played(seed=seed, wheels=channel, slam=channel) for seed in (3, 3, 4))
    assert [(each.arrival, each.topic, each.message.stamp) for each in first] == [
        (each.arrival, each.topic, each.message.stamp) for each in again
    ]
    assert all(same(one.message, two.message) for one, two in zip(first, again, strict=True))
    assert not np.array_equal(arrivals(first), arrivals(other))


def test_what_befalls_the_slam_does_not_change_the_wheels() -> None:
    wheels = {"jitter": 0.01, "drop": 0.1}
    one = of(played(wheels=wheels), "joint_states")
    two = of(played(wheels=wheels, slam={"drop": 0.5, "period": 1.0}), "joint_states")
    np.testing.assert_array_equal(arrivals(one), arrivals(two))


@pytest.mark.parametrize("period", [0.1, 0.15, 0.25, 1.0])
def test_poses_are_thinned_to_the_period_and_no_more(period: float) -> None:
    times = taken(of(played(slam={"period": period, "jitter": 0}), "slam_pose"))
    assert times[0] == 0
    assert (np.diff(times) >= period - 1e-6).all()
    for before, after in pairwise(times):  # the next one is the first that was far enough
        assert after == pytest.approx(DRIVE.slam_times[DRIVE.slam_times >= before + period - 1e-6][0])


@pytest.mark.parametrize(("use", "held"), [("positions", (1, 0)), ("velocities", (0, 1)), ("both", (1, 1))])
def test_wheel_messages_hold_what_is_asked_for(use: str, held: tuple[int, int]) -> None:
    messages = [each.message for each in of(played(wheels={"use": use}), "joint_states")]
    assert {(m.positions is not None, m.velocities is not None) for m in messages} == {held}


def test_joints_are_the_robots_wheels_or_as_named() -> None:
    assert next(ReplayMessages(DRIVE, config()).stamped_from()).message.names == ("a", "b", "c")
    named = next(ReplayMessages(DRIVE, config(), names=("left", "right", "rear")).stamped_from())
    assert named.message.names == ("left", "right", "rear")
    for names in (("left", "right"), ("left", "left", "rear"), ()):
        with pytest.raises(ConfigError, match="a, b, c"):
            ReplayMessages(DRIVE, config(), names=names)


def test_stamps_begin_with_the_time_of_the_replay_unless_given() -> None:
    before = time.time_ns()
    first = next(ReplayMessages(DRIVE, ReplayConfig()).stamped_from())
    assert before <= first.message.stamp <= time.time_ns()
    assert next(ReplayMessages(DRIVE, config()).stamped_from(5)).message.stamp == 5


# Covariances


def covariances_of(drive: ConcatenatedDrive = DRIVE, noise: Noise | None = None, **slam: Any) -> Array:
    poses = of(played(drive, noise=noise, slam={"period": 0, "jitter": 0} | slam), "slam_pose")
    return np.array([each.message.covariance for each in poses])


def test_covariances_of_the_data_set_come_first() -> None:
    recorded = np.random.default_rng(1).normal(size=(len(DRIVE.slam_times), 3, 3))
    covariances = covariances_of(
        replace(DRIVE, slam_covariances=recorded), Noise(pose_position=1), covariance={"position": 1, "heading": 1}
    )
    np.testing.assert_array_equal(covariances, recorded)


def test_covariances_of_the_config_come_next() -> None:
    covariances = covariances_of(noise=Noise(pose_position=1), covariance={"position": 0.03, "heading": 0.01})
    np.testing.assert_allclose(covariances, np.tile(np.diag([9e-4, 9e-4, 1e-4]), (len(covariances), 1, 1)))


def test_covariances_that_the_noise_model_makes_of_the_time_since_the_run_began_come_last() -> None:
    noise = Noise(
        pose_position=0.03,
        bias_position=0.04,
        walk_position=0.02,
        pose_heading=0.01,
        bias_heading=0,
        walk_heading=0.1,
    )
    covariances = covariances_of(noise=noise)
    since = DRIVE.slam_times - DRIVE.start_times[DRIVE.slam_run]
    assert since.max() == pytest.approx(0.8)
    np.testing.assert_allclose(covariances[:, 0, 0], 0.0025 + 0.0004 * since)
    np.testing.assert_allclose(covariances[:, 1, 1], covariances[:, 0, 0])
    np.testing.assert_allclose(covariances[:, 2, 2], 0.0001 + 0.01 * since)


def test_covariances_that_nothing_states_are_moderate_and_never_singular() -> None:
    np.testing.assert_allclose(covariances_of()[0], np.diag([4e-4, 4e-4, 4e-4]))
    assert np.linalg.eigvalsh(covariances_of(noise=Noise())).min() > 0


# Config


@pytest.mark.parametrize("speed", [0.5, math.inf])
def test_the_config_of_a_replay_comes_back_from_yaml(speed: float) -> None:
    written = ReplayConfig(speed=speed)
    assert validate(ReplayConfig, parse_yaml(to_yaml(written), "test"), "test") == written
    assert config(speed="max").speed == math.inf


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"speed": 1e-300}, "speed"),
        ({"speed": math.nan}, "speed"),
        ({"speed": "fast"}, "speed"),
        ({"pause": -1}, "pause"),
        ({"wheels": {"drop": 1.5}}, r"wheels\.drop"),
        ({"slam": {"delay": math.inf}}, r"slam\.delay"),
        ({"slam": {"period": 1e300}}, r"slam\.period"),
        ({"slam": {"covariance": {"position": 0}}}, r"slam\.covariance\.position"),
        ({"wheels": {"periot": 1}}, r"'wheels\.periot'"),
        ({"sped": 1}, "'speed'"),
    ],
)
def test_a_config_that_cannot_be_is_refused(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        config(**changes)


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
    times = SimpleNamespace(perf_counter=lambda: clock.now, time_ns=time.time_ns, monotonic=time.monotonic)
    monkeypatch.setattr("omnibench.live.replay.replay_player.time", times)
    return clock


class Listener:
    """Takes down what arrives on a robot's inputs, in a session of its own, as a node would."""

    def __init__(self, loopback: Loopback, profile: Profile = "plain", *, work: float = 0, stall: float = 0) -> None:
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


# Player


@pytest.mark.parametrize("profile", ["plain", "rmw", "humble"])
def test_everything_arrives_as_it_was_sent_and_in_that_order(loopback: Loopback, profile: Profile) -> None:
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
def test_a_replay_keeps_the_pace(loopback: Loopback, clock: Clock, speed: float) -> None:
    node = Listener(loopback)
    drive = concatenate_runs(random_dataset(2, 5), pause=3.0)
    report = player(loopback, drive, speed=speed, slam={"delay": 0}).play(clock)
    until(lambda: node.count == report.total, "all messages")
    assert report.wall_seconds == pytest.approx(report.data_seconds / speed, abs=2 * OVERSLEPT)
    assert 0 < report.late <= 2 * OVERSLEPT


def test_a_replay_catches_up_after_a_hiccup(loopback: Loopback, clock: Clock) -> None:
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


@pytest.mark.slow
def test_nothing_is_lost_at_the_highest_speed_on_a_subscriber_that_stalls(loopback: Loopback) -> None:
    node = Listener(loopback, stall=1.5)  # in which the buffers on the way fill up, with some 25,000 messages
    drive = concatenate_runs(random_dataset(3, 10, samples=5000), pause=0.1)
    report = player(loopback, drive, speed="max").play()
    assert report.complete
    assert report.total > 50_000
    until(lambda: node.count == report.total, "all messages")
    stamps = [message.stamp for message in node.messages("joint_states")]
    assert (np.diff(stamps) > 0).all()


def test_nothing_is_lost_when_the_session_closes_right_after(loopback: Loopback) -> None:
    node = Listener(loopback, work=2e-5)
    session = loopback.client()
    drive = concatenate_runs(random_dataset(4, 5, samples=1000))
    report = Player(GraphNode(session, KeySpace(), "replay"), "apr02", drive, config(speed="max")).play()
    session.close()
    until(lambda: node.count == report.total, "all messages")


def test_a_replay_starts_when_a_subscriber_is_there_and_loses_nothing(loopback: Loopback) -> None:
    reports: list[PlayReport] = []
    waiting = player(loopback, speed="max")
    thread = threading.Thread(target=lambda: reports.append(waiting.play()))
    thread.start()
    time.sleep(0.2)  # it would have played all of it by now
    node = Listener(loopback)
    thread.join(PATIENCE)
    until(lambda: node.count == reports[0].total, "all messages")
    assert min(message.stamp for message in node.messages("joint_states")) == ORIGIN


def test_nobody_who_subscribes_is_one_line_unless_nobody_is_waited_for(loopback: Loopback) -> None:
    begin = time.perf_counter()
    with pytest.raises(ConfigError, match=r"apr02/joint_states after 0\.3 s"):
        player(loopback, wait=0.3).play()
    assert time.perf_counter() - begin >= 0.3
    assert player(loopback, wait=0, speed="max").play().complete


def test_a_robot_that_cannot_be_part_of_a_key_is_refused(loopback: Loopback) -> None:
    with pytest.raises(ConfigError, match="robot 'a/\\*'"):
        Player(GraphNode(loopback.client(), KeySpace(), "replay"), "a/*", DRIVE, config())


class TestStopping:
    @pytest.fixture
    def progress(self) -> list[Progress]:
        return []

    @pytest.fixture
    def node(self, loopback: Loopback) -> Listener:
        return Listener(loopback)

    @pytest.mark.usefixtures("node")
    def test_progress_tells_messages_and_time(self, loopback: Loopback, clock: Clock, progress: list[Progress]) -> None:
        report = player(loopback, speed=4).play(clock, watch=progress.append)
        assert len(progress) >= 5
        done = [each.done for each in progress]
        assert done == sorted(done)
        note = f"{report.data_seconds:.0f} s of the drive"
        assert progress[-1] == Progress("playing as apr02", report.total, report.total, "message", note=note)
        times = [float(each.note.split()[0]) for each in progress]
        assert times == sorted(times)

    def test_it_is_stopped(self, loopback: Loopback, clock: Clock, node: Listener, progress: list[Progress]) -> None:
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
