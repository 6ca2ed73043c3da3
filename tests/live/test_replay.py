"""Replay: which messages there are, when they arrive, what they hold, and their delivery to nodes that fail."""

import math
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh
from drives import calibration, drive
from hypothesis import given
from hypothesis import strategies as st
from nodes import Command, asked, config_of, connected, running, wheels_of, write_node
from recordings import random_dataset
from replayed import DRIVE, ORIGIN, TOPICS, arrivals, config, of, played, same, taken
from sessions import Loopback, free_port, raw_session, until
from timing import PATIENCE, load

from omnibench.cli.terminal.live_tables import PlayedResult
from omnibench.config import parse_yaml, to_yaml, validate
from omnibench.data.storage import save_dataset
from omnibench.errors import ConfigError
from omnibench.live.config import read_live_config
from omnibench.live.delivery import WINDOW, DeliveryError
from omnibench.live.drive import ConcatenatedDrive, ReplayConfig, concatenate_runs
from omnibench.live.replay import Player, PlayReport, ReplayMessages
from omnibench.live.topics import GraphNode, KeySpace, Profile
from omnibench.live.wire import JOINT_STATE, POSE_ESTIMATE, packed
from omnibench.progress import Progress
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array, relative

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
        pose_position=0.03, bias_position=0.04, walk_position=0.02, pose_heading=0.01, bias_heading=0, walk_heading=0.1
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
    monkeypatch.setattr("omnibench.live.replay.time", times)
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


# Delivery of a replay to a real node, whatever befalls it: all is taken, or it is said how much is missing.

LONG = concatenate_runs(random_dataset(7, 5, samples=2000), pause=0.1)  # 10,000 samples: many times the window
ALIVE = "omnibench/apr/alive"
PART = 1000  # messages that are played before the test does something


def counts(session: zenoh.Session) -> dict[str, int]:
    """What the node has counted."""
    return asked(session, "omnibench/apr/health")["counts"]


def long_player(session: zenoh.Session, **changes: Any) -> Player:
    return Player(GraphNode(session, KeySpace(), "replay"), "apr", LONG, config(speed="max", **changes))


class Replay:
    """A replay that runs beside the test, which lets all but a part of it pass by ``go_on``."""

    def __init__(self, session: zenoh.Session, pool: ThreadPoolExecutor, **changes: Any) -> None:
        self.stop, self._open, self._passed = threading.Event(), threading.Event(), 0
        self._report = pool.submit(long_player(session, **changes).play, self.stop, hold=self._holds)
        self.done, self.report, self.go_on = self._report.done, self._report.result, self._open.set

    def _holds(self) -> bool:
        self._passed += 1
        return self._passed > PART and not self._open.is_set()


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


@pytest.mark.parametrize("busy", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_tail_is_taken_when_the_session_closes_right_after(tmp_path: Path, busy: bool) -> None:
    chosen = config_of(tmp_path)
    (endpoint,) = chosen.zenoh.listening
    with running(chosen) as (node, _):
        with load(2) if busy else nullcontext(), raw_session("client", connect=[endpoint]) as session:
            report = long_player(session).play()
        assert node.health("apr").counts["samples"] == report.sent["joint_states"]
    assert report.taken == report.total


def test_a_node_that_starts_again_gets_the_rest(node: Command, folder: Path, port: int) -> None:
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


def test_what_a_killed_node_may_have_published_is_taken_and_not_published_again(tmp_path: Path) -> None:
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


def test_a_node_counts_the_numbered_samples_of_a_robot_that_never_came(tmp_path: Path) -> None:
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
def test_a_node_that_stands_still_misses_nothing(node: Command, port: int, from_the_beginning: bool) -> None:
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
def test_no_more_than_the_window_is_under_way(node: Command, port: int) -> None:
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
def test_nodes_with_a_state_that_are_killed_integrate_all_of_it_once(tmp_path: Path, port: int) -> None:
    config = write_node(tmp_path, "apr", port=port, state="state", fusion="none")
    batch = calibration().model.poses([LONG.log()])[0]
    with ThreadPoolExecutor(1) as pool:
        node = Command("live", config)
        session, stop = connected(port, ALIVE), threading.Event()
        replay = long_player(
            session, wait=600, wheels={"use": "velocities"}
        )  # from rates nothing lost can be made good
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
def test_a_node_that_stays_away_is_one_line_with_the_number_that_is_missing(node: Command, port: int) -> None:
    with connected(port) as session, playing(session, wait=1) as replay:
        until(lambda: counts(session)["samples"] > PART / 2, "a part of the recording")
        node.kill()
        replay.go_on()
        with pytest.raises(DeliveryError, match="'apr'") as failure:
            replay.report()
    words = str(failure.value).replace(",", "").split()
    assert 0 < int(words[0]) < int(words[2])


@pytest.mark.slow
@pytest.mark.parametrize(("taken", "share"), [(100, "all"), (90, "90 of 100"), (0, "0 of 100")])
def test_what_a_node_took_is_told_alike_below_the_numbers_and_at_the_end(taken: int, share: str) -> None:
    report = PlayReport({"joint_states": 95, "slam_pose": 5}, 100, taken, 0, 2.0, 2.0, 0.0, False, Counter())
    shown = PlayedResult(report, simulated=False, robot="apr")
    assert f"; {share} taken by the node" in shown.remarks()[0].text
    assert shown.next_step().outcome == f"the recording was played, and {share} was taken by the node"


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


@pytest.mark.slow
def test_that_delivery_is_not_confirmed_is_said(tmp_path: Path, port: int) -> None:
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
def test_a_router_that_takes_nothing_any_more_is_told(tmp_path: Path, port: int) -> None:
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
