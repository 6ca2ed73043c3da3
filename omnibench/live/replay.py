"""Replaying a recording on Zenoh as the robot and its SLAM would have sent it, at any speed.

A bounded number of messages is under way at any speed, and it is known what arrived. An omnibench node acknowledges
what it has taken (``AcknowledgedFlows``): what is lost with a link or with a node that starts again is sent once more,
and a node that is gone is waited for. Other subscribers acknowledge nothing: there a round trip to the next Zenoh
router, behind the messages, bounds how many are under way, and empties the queue at the end.
"""

from __future__ import annotations

import json
import math
import secrets
import struct
import threading
import time
from abc import abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import zenoh

from omnibench.errors import ConfigError, OmnibenchError
from omnibench.live import drive as drives
from omnibench.live.control import source_of
from omnibench.live.health import anomalies_among
from omnibench.live.network import is_connected
from omnibench.live.presence import alive_robots, checked_robot
from omnibench.live.stopping import Closing, answers, direct, wait_until
from omnibench.live.topics import GraphNode, Publisher, acknowledgement_key, read_acknowledgement
from omnibench.live.wheels import check_joints, joints_of
from omnibench.live.wire import JointState, PoseEstimate
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.words import plural

WINDOW: Final = 256  # messages under way at most, some 90 kB: less than Zenoh's queue holds; chosen
_POLL_PERIOD: Final = 0.05  # s between two looks at whether a signal came; chosen
_LONGEST_POLL: Final = 0.5  # s; a look that takes longer is one at which this process stood still; chosen
_FIRST_RETRY: Final = 0.5  # s without an acknowledgement after which messages are sent again; chosen
_LAST_RETRY: Final = 4.0  # s, to which this time doubles; chosen
_GAP_RETRY: Final = 0.1  # s in which one gap is reported by many acknowledgements; chosen


class DeliveryError(OmnibenchError):
    """Messages did not reach their receiver."""

    exit_code = 1


class Delivery(Closing):
    """Publishes messages and waits where too many are under way.

    taken: messages that the receiver has taken; None where that is not known. passed: messages that are known to have
    reached the receiver or, where that is not known, the next router. paused: s that it has waited for a receiver.
    restarts: how often another node went on in the receiver's place.
    stop: ends any waiting. wait: s without any sign of the receiver after which it is given up, of which those do not
    count in which this process itself was suspended.
    """

    def __init__(self, stop: threading.Event, wait: float) -> None:
        self.taken: int | None = None
        self.passed = 0
        self.paused = 0.0
        self.restarts = 0
        self._stop, self._patience = stop, wait
        self._heard = threading.Event()
        self._waited = 0.0  # s without any sign of the receiver

    def _poll(self, sign: threading.Event) -> bool:
        """Wait for a sign of the receiver for a moment; True if there is one."""
        began = time.monotonic()
        there = sign.wait(_POLL_PERIOD)
        self._waited += min(time.monotonic() - began, _LONGEST_POLL)
        return there

    @abstractmethod
    def put(self, publisher: Publisher[Any], payload: bytes) -> bool:
        """Publish a payload as soon as there is room for it; False if ``stop`` was set before.

        DeliveryError: the receiver is given up.
        """

    @abstractmethod
    def finish(self) -> None:
        """Wait until all has arrived, or a short time if ``stop`` is set. DeliveryError: the receiver is given up."""


class AcknowledgedDelivery(Delivery):
    """Delivery to the omnibench node of a robot."""

    def __init__(self, session: zenoh.Session, robot: str, stop: threading.Event, wait: float) -> None:
        super().__init__(stop, wait)
        self._robot = robot
        self._flow = secrets.randbits(64)
        self._lock = threading.Lock()
        self._under_way: deque[tuple[Publisher[Any], bytes, int]] = deque()  # from number ``passed`` on
        self._sent = self.taken = 0
        self._gap = False
        self._node: str | None = None  # the node's session, as its acknowledgements name it
        self._progress_at = self._sent_again_at = -math.inf
        self._retry = _FIRST_RETRY
        key = acknowledgement_key(robot, self._flow)
        self._subscriber = session.declare_subscriber(key, direct(self._acknowledged))

    def put(self, publisher: Publisher[Any], payload: bytes) -> bool:
        # Wait while the window is full, or while the node has been silent for long.
        began = time.monotonic()
        while not self._stop.is_set() and (
            len(self._under_way) >= WINDOW or self._gap or (bool(self._under_way) and self._silence() >= _FIRST_RETRY)
        ):
            self._wait()
        waited = time.monotonic() - began
        self.paused += waited if waited > _FIRST_RETRY else 0.0
        if self._stop.is_set():
            return False
        number = publisher.next_number()
        with self._lock:
            if not self._under_way:
                self._progress_at, self._waited = time.monotonic(), 0.0
            self._under_way.append((publisher, payload, number))
            place = self._flow, self._sent, self.passed, False
            self._sent += 1
        publisher.put_numbered(payload, number, place)
        return True

    def finish(self) -> None:
        while self._under_way and not self._stop.is_set():
            self._wait()
        end = time.monotonic() + _FIRST_RETRY
        while self._under_way and time.monotonic() < end:  # after a stop what is under way may still arrive
            self._heard.wait(_POLL_PERIOD)
            self._heard.clear()

    def close(self) -> None:
        self._subscriber.undeclare()

    def _silence(self) -> float:
        """Time since the last progress, s."""
        return time.monotonic() - self._progress_at

    def _wait(self) -> None:
        """Wait for an acknowledgement, and send again what seems lost. DeliveryError: none came for too long."""
        self._poll(self._heard)
        self._heard.clear()
        silence, now = self._silence(), time.monotonic()
        if self._waited > self._patience:
            key = acknowledgement_key(self._robot, "*")
            rights = "" if self.passed else f" (may this session read {key}?)"
            raise DeliveryError(f"its node has taken nothing for {silence:.0f} s{rights}; `wait` says how long to wait")
        again = now - self._sent_again_at
        if (self._gap and again > _GAP_RETRY) or (silence > self._retry and again > self._retry):
            self._retry = min(2 * self._retry, _LAST_RETRY) if silence > self._retry else self._retry
            # Send all that is under way once more.
            with self._lock:
                self._gap = False
                first, messages = self.passed, list(self._under_way)
            self._sent_again_at = time.monotonic()
            for place, (publisher, payload, number) in enumerate(messages, first):
                if self._stop.is_set():
                    return
                publisher.put_numbered(payload, number, (self._flow, place, self.passed, True))

    def _acknowledged(self, sample: zenoh.Sample) -> None:
        try:
            expected, gap = read_acknowledgement(sample.payload.to_bytes())
        except struct.error:
            return
        with self._lock:
            expected = min(expected, self.passed + len(self._under_way))
            if expected > self.passed:
                for _ in range(expected - self.passed):
                    self._under_way.popleft()
                self.taken = self.passed = expected
                self._progress_at, self._waited = time.monotonic(), 0.0
                self._retry = _FIRST_RETRY
            self._gap |= gap and bool(self._under_way)
            if sample.timestamp is not None and (node := str(sample.timestamp.get_id())) != self._node:
                self.restarts += self._node is not None
                self._node = node
        self._heard.set()


class UnconfirmedDelivery(Delivery):
    """Delivery to subscribers that acknowledge nothing."""

    def __init__(self, session: zenoh.Session, robot: str, stop: threading.Event, wait: float) -> None:
        super().__init__(stop, wait)
        self._session = session
        self._key = acknowledgement_key(robot, "nobody")
        self._arrived = threading.Event()  # the round trip under way has come back
        self._arrived.set()
        self._linked = is_connected(session)  # otherwise all subscribers are in this session
        self._sent = 0
        self._before = 0  # messages before the last round trip

    def put(self, publisher: Publisher[Any], payload: bytes) -> bool:
        if self._sent - self._before >= WINDOW:
            self._round_trip_over()
            self._begin_round_trip()
        if self._stop.is_set():
            return False
        publisher.put_encoded(payload)
        self._sent += 1
        return True

    def finish(self) -> None:
        self._round_trip_over()
        self._begin_round_trip()
        self._round_trip_over()

    def close(self) -> None:
        pass

    def _begin_round_trip(self) -> None:
        """Query a key that nobody answers: the router closes the query once all messages before it have passed."""
        self._before = self._sent
        self._arrived.clear()
        handler: Any = zenoh.handlers.Callback(lambda _: None, self._arrived.set, indirect=False)
        # Zenoh closes the query at its timeout too, which must come after our patience
        self._session.get(self._key, handler, timeout=2 * self._patience, priority=zenoh.Priority.BACKGROUND)

    def _round_trip_over(self) -> None:
        began, self._waited = time.monotonic(), 0.0
        while not self._poll(self._arrived) and not self._stop.is_set():
            if self._waited > self._patience:
                raise DeliveryError(f"the router has taken nothing for {self._patience:g} s")
        if self._arrived.is_set() and not self._stop.is_set() and self._linked and not is_connected(self._session):
            raise DeliveryError("the link to the router was lost")  # which closes a query, too
        if self._arrived.is_set():
            self.passed = self._before
        waited = time.monotonic() - began
        self.paused += waited if waited > _FIRST_RETRY else 0.0


MAP = "map"
_LEAST_DEVIATION = 1e-4  # m, rad; least standard deviation, so that no covariance is singular; chosen
_SLAM_WAIT = 0.5  # s for a node to subscribe to slam_pose after joint_states; chosen
_LEAST_PATIENCE = 1.0  # s without an acknowledgement until a node is given up, where `wait` is less; chosen
_HEALTH_WAIT = 1.0  # s for the node to answer; chosen
_HOLDING = 0.002  # s between two looks at whether to go on; chosen
_PROGRESS_PERIOD = 0.1  # s between two reports of progress; chosen


@dataclass(frozen=True, slots=True)
class Event:
    """A message and its time of arrival, s of the recording. Its stamp is the time at which it was measured."""

    arrival: float
    topic: str
    message: JointState | PoseEstimate


class ReplayMessages:
    """All messages of a drive without stamps, prepared so that a replay starts without delay.

    noise: noise model of the reference, for poses whose covariance neither the data set nor the config gives. names
    (N + S,): names of the joints, those that steer after those of the wheels; default: the usual ones.
    """

    def __init__(
        self,
        drive: drives.ConcatenatedDrive,
        config: drives.ReplayConfig,
        noise: Noise | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        self._drive = drive
        self._origin = config.stamp_origin
        self._joints = joints_of(drive.robot).names if names is None else tuple(names)
        check_joints(self._joints, (*drive.robot.wheel_names, *drive.robot.drive.steered), "joints")
        self._schedule = drives.make_schedule(drive, config)
        self._sampled, self._posed = (
            np.round(times * 1e9).astype(np.int64) for times in (drive.wheel_times, drive.slam_times)
        )
        self._covariances = _pose_covariances(drive, config.slam, noise)
        self._positions, self._velocities = _joint_values(drive, config.wheels.use)

    def __len__(self) -> int:
        return len(self._schedule)

    def stamped_from(self, origin: int | None = None) -> Iterator[Event]:
        """The messages by time of arrival. origin: stamp of the drive's start, ns (default: the config's, or now)."""
        start, schedule = origin or self._origin or time.time_ns(), self._schedule
        for arrival, topic, row in zip(schedule.arrivals, schedule.topics, schedule.rows, strict=True):
            message: JointState | PoseEstimate
            if topic == drives.WHEELS:
                positions = None if self._positions is None else self._positions[row]
                velocities = None if self._velocities is None else self._velocities[row]
                message = JointState(start + int(self._sampled[row]), self._joints, positions, velocities)
            else:
                stamp, pose = start + int(self._posed[row]), self._drive.slam_poses[row]
                message = PoseEstimate(stamp, MAP, pose, self._covariances[row])
            yield Event(float(arrival), drives.TOPICS_PLAYED[topic], message)


@dataclass(frozen=True)
class PlayReport:
    """Result of a replay.

    sent: messages by topic; total: messages in all; taken: messages that a node acknowledged, None where nobody does.
    restarts: how often another node went on in the place of one that had gone; without ``state`` its odometry begins
    anew. interrupted: by a signal. late: largest delay in sending, s, in which a pause for a receiver that was gone
    does not count. anomalies: what the node counted meanwhile of what should not happen, by counter; of irregular
    samples, which recordings have, it is silent.
    """

    sent: dict[str, int]
    total: int
    taken: int | None
    restarts: int
    data_seconds: float
    wall_seconds: float
    late: float
    interrupted: bool
    anomalies: Counter[str]

    @property
    def complete(self) -> bool:
        """True if all messages were sent."""
        return sum(self.sent.values()) == self.total

    @property
    def acknowledged(self) -> bool:
        """True if a node acknowledged every message that was sent."""
        return self.taken == sum(self.sent.values())

    @property
    def rate(self) -> float:
        """Messages sent per second."""
        return sum(self.sent.values()) / max(self.wall_seconds, 1e-9)


class Player:
    """Replays a drive as one robot. Closing the session of ``graph`` closes its publishers.

    A node that runs the robot acknowledges what it takes: nothing is lost at any speed, the node is waited for while it
    is gone, and is given up after the config's ``wait``. Other subscribers confirm nothing; a slow one delays the
    replay. names, noise: as for ``ReplayMessages``. ConfigError: the robot's name is not valid, or the names are not
    one for each wheel.
    """

    def __init__(
        self,
        graph: GraphNode,
        robot: str,
        drive: drives.ConcatenatedDrive,
        config: drives.ReplayConfig,
        names: Sequence[str] | None = None,
        noise: Noise | None = None,
    ) -> None:
        self._robot = checked_robot(robot)
        self._config = config
        self._messages = ReplayMessages(drive, config, noise, names)
        self._session = graph.session
        self._publishers = {topic: graph.publisher(robot, topic, lossless=True) for topic in drives.TOPICS_PLAYED}

    def play(
        self,
        stop: threading.Event | None = None,
        watch: Reporter = no_progress,
        hold: Callable[[], bool] = lambda: False,
        seconds: float = math.inf,
    ) -> PlayReport:
        """Send all messages, or those of the first ``seconds``, or stop when ``stop`` is set or Ctrl-C is pressed.

        Waits for a subscriber first; ConfigError: none comes in time. DeliveryError: the robot's node, or the next
        router to other subscribers, does not take the messages any more. watch: told the messages sent ten times a
        second and at the end. hold: while it is true, nothing is sent.
        """
        stop = stop or threading.Event()
        sent, interrupted = dict.fromkeys(drives.TOPICS_PLAYED, 0), False
        begin, arrival, late = time.perf_counter(), 0.0, 0.0
        delivery: Delivery | None = None
        before, anomalies = Counter[str](), Counter[str]()
        try:
            self._wait_for_subscriber(stop)
            # To the robot's node, if there is one, or else to whoever subscribes.
            patience = max(self._config.wait, _LEAST_PATIENCE)
            running = self._robot in alive_robots(self._session, patience, stop)
            kind = AcknowledgedDelivery if running else UnconfirmedDelivery
            delivery = kind(self._session, self._robot, stop, patience)
            before = self._anomalies(delivery, stop)
            begin = reported_at = time.perf_counter()
            for number, event in enumerate(self._messages.stamped_from(), 1):
                due = begin + delivery.paused + event.arrival / self._config.speed
                now = time.perf_counter()
                if due > now:
                    stop.wait(min(due, begin + seconds) - now)
                    now = time.perf_counter()
                if now - begin >= seconds:
                    break
                while hold() and not stop.is_set():
                    stop.wait(_HOLDING)
                if stop.is_set():
                    break
                publisher = self._publishers[event.topic]
                if not delivery.put(publisher, publisher.message_type.encode(event.message)):
                    break
                sent[event.topic] += 1
                arrival, late = event.arrival, max(late, now - due)
                if now - reported_at >= _PROGRESS_PERIOD:
                    reported_at = now
                    watch(self._progress(number, arrival))
            delivery.finish()
            if not delivery.restarts:
                anomalies = self._anomalies(delivery, stop) - before
        except KeyboardInterrupt:
            interrupted = True
        except zenoh.ZError as error:
            if not stop.is_set():  # otherwise the session was closed after stopping
                raise OmnibenchError(f"replay of {self._robot}: cannot publish any more: {error}") from None
        except DeliveryError as error:
            total = len(self._messages)
            missing = f"{total - (0 if delivery is None else delivery.passed):,} of {plural(total, 'message')}"
            raise DeliveryError(f"{missing} did not reach robot {self._robot!r}: {error}") from None
        finally:
            if delivery is not None:
                delivery.close()
        wall, interrupted = time.perf_counter() - begin, interrupted or stop.is_set()
        watch(self._progress(sum(sent.values()), arrival))
        taken, restarts = (None, 0) if delivery is None else (delivery.taken, delivery.restarts)
        late = 0.0 if math.isinf(self._config.speed) else late
        return PlayReport(sent, len(self._messages), taken, restarts, arrival, wall, late, interrupted, anomalies)

    def _anomalies(self, delivery: Delivery, stop: threading.Event) -> Counter[str]:
        """The counters of the robot's node above 0 of what should not happen; none if there is none, or no answer."""
        if delivery.taken is None:
            return Counter()
        key, source = f"omnibench/{self._robot}/health", source_of(self._session)
        healths = answers(lambda do, s: self._session.get(key, do, timeout=s, source_info=source), _HEALTH_WAIT, stop)
        counts = json.loads(healths[0].payload.to_bytes()).get("counts", {}) if healths else {}
        return Counter({name: n for name, n in anomalies_among(counts).items() if name != "irregular"})

    def _progress(self, sent: int, seconds: float) -> Progress:
        """Messages sent, and how many ``seconds`` of the recording they are."""
        note = f"{seconds:.0f} s of the drive"
        return Progress(f"playing as {self._robot}", sent, len(self._messages), "message", note=note)

    def _wait_for_subscriber(self, stop: threading.Event) -> None:
        """Wait until the wheel samples have a subscriber, and then up to _SLAM_WAIT s for one of the SLAM poses."""
        wheels, slam = (self._publishers[topic] for topic in drives.TOPICS_PLAYED)
        wait = self._config.wait
        if wait and not wait_until(lambda: wheels.matched, wait, stop) and not stop.is_set():
            raise ConfigError(
                f"nobody subscribes to {wheels.key} after {wait:g} s; start omnibench live for robot "
                f"{self._robot}, check robot, profile and endpoint of both, or wait longer"
            )
        wait_until(lambda: slam.matched, min(wait, _SLAM_WAIT), stop)


def _joint_values(drive: drives.ConcatenatedDrive, use: str) -> tuple[Array | None, Array | None]:
    """Positions and velocities (n, N + S) of the joints; NaN of those that tell none beside others that do."""
    angles = None if use == "velocities" else drive.angles
    rates = None if use == "positions" else drive.rates
    if drive.steering is None:
        return angles, rates
    positions = np.hstack([np.full_like(drive.rates, np.nan) if angles is None else angles, drive.steering])
    return positions, None if rates is None else np.hstack([rates, np.full_like(drive.steering, np.nan)])


def _pose_covariances(drive: drives.ConcatenatedDrive, slam: drives.SlamChannel, noise: Noise | None) -> Array:
    """Covariances (m, 3, 3) of the SLAM poses' errors."""
    if drive.slam_covariances is not None:
        return drive.slam_covariances
    count = len(drive.slam_times)
    if slam.covariance is None and noise is not None:
        seconds = drive.slam_times - drive.start_times[drive.slam_run]  # duration of the random walk
        position = np.sqrt(noise.pose_position**2 + noise.bias_position**2 + noise.walk_position**2 * seconds)
        heading = np.sqrt(noise.pose_heading**2 + noise.bias_heading**2 + noise.walk_heading**2 * seconds)
    else:
        given = slam.covariance or drives.PoseDeviation()
        position, heading = np.full(count, given.position), np.full(count, given.heading)
    deviations = np.maximum(np.column_stack([position, position, heading]), _LEAST_DEVIATION)
    covariances: Array = deviations[:, :, None] ** 2 * np.eye(3)
    return covariances
