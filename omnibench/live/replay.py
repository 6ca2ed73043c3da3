"""Replaying a recording on Zenoh as the robot and its SLAM would have sent it, at any speed."""

from __future__ import annotations

import json
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import zenoh

from omnibench.errors import ConfigError, OmnibenchError
from omnibench.live.control import source_of
from omnibench.live.delivery import Delivery, DeliveryError
from omnibench.live.drive import Channel, ConcatenatedDrive, PoseDeviation, ReplayConfig
from omnibench.live.health import anomalies_among
from omnibench.live.presence import alive_robots, checked_robot
from omnibench.live.stopping import answers, wait_until
from omnibench.live.topics import INPUTS, GraphNode
from omnibench.live.wheels import check_joints, joints_of
from omnibench.live.wire import JointState, PoseEstimate
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_LEAST_DEVIATION: Final = 1e-4  # m, rad; least standard deviation, so that no covariance is singular; chosen
_SAME_ARRIVAL: Final = 1e-6  # s; times that differ by less are equal
_SLAM_WAIT: Final = 0.5  # s for a node to subscribe to slam_pose after joint_states; chosen
_LEAST_PATIENCE: Final = 1.0  # s without an acknowledgement until a node is given up, where `wait` is less; chosen
_HEALTH_WAIT: Final = 1.0  # s for the node to answer; chosen
_HOLDING: Final = 0.002  # s between two looks at whether to go on; chosen
_PROGRESS_PERIOD: Final = 0.1  # s between two reports of progress; chosen


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
        drive: ConcatenatedDrive,
        config: ReplayConfig,
        noise: Noise | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        self._drive, self._origin = drive, config.stamp_origin
        self._joints = joints_of(drive.robot).names if names is None else tuple(names)
        check_joints(self._joints, (*drive.robot.wheel_names, *drive.robot.drive.steered), "joints")
        # Joint values (n, N + S): NaN of the joints that state no position, or no velocity, beside others that do.
        self._positions = None if config.wheels.use == "velocities" else drive.angles
        self._velocities = None if config.wheels.use == "positions" else drive.rates
        if drive.steering is not None:
            positions = np.full_like(drive.rates, np.nan) if self._positions is None else self._positions
            self._positions = np.hstack([positions, drive.steering])
            if self._velocities is not None:
                self._velocities = np.hstack([self._velocities, np.full_like(drive.steering, np.nan)])
        # Covariances (m, 3, 3) of the poses: the data set's, else the config's, else the noise model's.
        if drive.slam_covariances is not None:
            self._covariances = drive.slam_covariances
        else:
            if config.slam.covariance is not None or noise is None:
                given = config.slam.covariance or PoseDeviation()
                noise = Noise(pose_position=given.position, pose_heading=given.heading)
            walked = drive.slam_times - drive.start_times[drive.slam_run]  # s
            position = noise.pose_position**2 + noise.bias_position**2 + noise.walk_position**2 * walked
            heading = noise.pose_heading**2 + noise.bias_heading**2 + noise.walk_heading**2 * walked
            variances = np.maximum(np.column_stack([position, position, heading]), _LEAST_DEVIATION**2)
            self._covariances = variances[:, :, None] * np.eye(3)
        # Poses that are at least a period apart, beginning with the first.
        poses, index = list[int](), 0
        while index < len(drive.slam_times):
            poses.append(index)
            later = drive.slam_times[index] + config.slam.period - _SAME_ARRIVAL
            index = max(index + 1, int(np.searchsorted(drive.slam_times, later)))
        # Arrival, index in INPUTS and row of each message. What befalls one topic does not change the other.
        wheel_seed, slam_seed = np.random.SeedSequence(config.seed).spawn(2)
        samples = _arrivals(drive.wheel_times, config.wheels, np.random.default_rng(wheel_seed))
        posed = _arrivals(drive.slam_times[poses], config.slam, np.random.default_rng(slam_seed))
        self._schedule = [(arrival, 0, row) for arrival, row in samples]
        self._schedule += [(arrival, 1, poses[index]) for arrival, index in posed]
        self._schedule.sort()

    def __len__(self) -> int:
        return len(self._schedule)

    def stamped_from(self, origin: int | None = None) -> Iterator[Event]:
        """The messages by time of arrival. origin: stamp of the drive's start, ns (default: the config's, or now)."""
        start, drive = origin or self._origin or time.time_ns(), self._drive
        for arrival, topic, row in self._schedule:
            message: JointState | PoseEstimate
            if topic == 0:
                stamp = start + round(drive.wheel_times[row] * 1e9)
                positions, velocities = (None if v is None else v[row] for v in (self._positions, self._velocities))
                message = JointState(stamp, self._joints, positions, velocities)
            else:
                stamp = start + round(drive.slam_times[row] * 1e9)
                message = PoseEstimate(stamp, "map", drive.slam_poses[row], self._covariances[row])
            yield Event(arrival, INPUTS[topic], message)


def _arrivals(times: Array, channel: Channel, rng: np.random.Generator) -> Iterator[tuple[float, int]]:
    """Times of arrival, s, of messages that are sent at times (n,), s, and their indices: some twice, some never."""
    chance, jitter = rng.random((2, len(times))), np.abs(rng.standard_normal((2, len(times))))
    arrives = chance[0] >= channel.drop
    twice = arrives & (chance[1] < channel.duplicate)
    late = times + channel.delay + channel.jitter * jitter
    for passed, arrivals in ((arrives, late[0]), (twice, late[1])):
        yield from zip(arrivals[passed].tolist(), np.flatnonzero(passed).tolist(), strict=True)


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
        drive: ConcatenatedDrive,
        config: ReplayConfig,
        names: Sequence[str] | None = None,
        noise: Noise | None = None,
    ) -> None:
        self._robot = checked_robot(robot)
        self._config = config
        self._messages = ReplayMessages(drive, config, noise, names)
        self._session = graph.session
        self._publishers = {topic: graph.publisher(robot, topic, lossless=True) for topic in INPUTS}

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
        sent, interrupted = dict.fromkeys(INPUTS, 0), False
        begin, arrival, late = time.perf_counter(), 0.0, 0.0
        anomalies, total = Counter[str](), len(self._messages)
        patience = max(self._config.wait, _LEAST_PATIENCE)
        with Delivery(self._session, self._robot, stop, patience) as delivery:
            try:
                # Wait until the wheel samples have a subscriber, and then for a moment for one of the SLAM poses.
                wheels, slam = self._publishers.values()
                wait = self._config.wait
                if wait and not wait_until(lambda: wheels.matched, wait, stop) and not stop.is_set():
                    way = f"start omnibench live for robot {self._robot}, check robot, profile and endpoint of both"
                    raise ConfigError(f"nobody subscribes to {wheels.key} after {wait:g} s; {way}, or wait longer")
                wait_until(lambda: slam.matched, min(wait, _SLAM_WAIT), stop)
                # To the robot's node, if there is one, or else to whoever subscribes.
                delivery.acknowledged = self._robot in alive_robots(self._session, patience, stop)
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
                missing = f"{total - delivery.passed:,} of {plural(total, 'message')}"
                raise DeliveryError(f"{missing} did not reach robot {self._robot!r}: {error}") from None
        wall, interrupted = time.perf_counter() - begin, interrupted or stop.is_set()
        watch(self._progress(sum(sent.values()), arrival))
        late = 0.0 if math.isinf(self._config.speed) else late
        taken = delivery.passed if delivery.acknowledged else None
        return PlayReport(sent, total, taken, delivery.restarts, arrival, wall, late, interrupted, anomalies)

    def _anomalies(self, delivery: Delivery, stop: threading.Event) -> Counter[str]:
        """The counters of the robot's node above 0 of what should not happen; none if there is none, or no answer."""
        if not delivery.acknowledged:
            return Counter()
        key, source = f"omnibench/{self._robot}/health", source_of(self._session)
        healths = answers(lambda do, s: self._session.get(key, do, timeout=s, source_info=source), _HEALTH_WAIT, stop)
        counts = json.loads(healths[0].payload.to_bytes()).get("counts", {}) if healths else {}
        return Counter({name: n for name, n in anomalies_among(counts).items() if name != "irregular"})

    def _progress(self, sent: int, seconds: float) -> Progress:
        """Messages sent, and how many ``seconds`` of the recording they are."""
        note = f"{seconds:.0f} s of the drive"
        return Progress(f"playing as {self._robot}", sent, len(self._messages), "message", note=note)
