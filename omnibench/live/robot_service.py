"""One robot on Zenoh: its inputs, its outputs, and the token that shows that it is alive."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from queue import SimpleQueue
from typing import Final

import zenoh

from omnibench.errors import one_line
from omnibench.live.estimation.health import anomalies_in_words, diagnostic
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.stopping import Closing, RateLimiter
from omnibench.live.wire.messages import Diagnostics, MissedMessages, flow_of
from omnibench.live.wire.outputs import OUTPUTS, Update
from omnibench.live.wire.topics import AcknowledgedFlows, GraphNode

LOG = logging.getLogger("omnibench.live")
_PAUSE: Final = 0.002  # s between turns while the thread is busy; chosen
_BUSY: Final = 0.5  # share of the time in which it works, from which on it pauses; chosen
_SMOOTHING: Final = 0.1  # share of the latest turn in the mean; chosen


class Intake(Closing):
    """Runs the work that is handed to ``ready``, in turn, in a thread of its own until ``close``.

    Zenoh's threads are then free to receive, and what waits can be seen. Where the thread is busy it pauses for a
    moment between turns, so that messages come together: to hand the interpreter over for each one costs as much as
    to take it.
    """

    def __init__(self) -> None:
        self._work: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="intake", daemon=True)
        self._thread.start()

    def ready(self, work: Callable[[], object]) -> None:
        """Queue a piece of work, which must not raise. From any thread."""
        self._work.put(work)

    def close(self) -> None:
        """Do what is queued, and no more."""
        self._work.put(None)
        self._thread.join()

    def _run(self) -> None:
        worked = spent = 0.0  # s, recent turns weighing most
        last = time.perf_counter()
        while (work := self._work.get()) is not None:
            began = time.perf_counter()
            try:
                work()
            except Exception as error:  # one robot must not silence the others
                LOG.error("intake: %s: %s", type(error).__name__, one_line(str(error)))
            now = time.perf_counter()
            worked += _SMOOTHING * (now - began - worked)
            spent += _SMOOTHING * (now - last - spent)
            last = now
            if worked > _BUSY * spent:
                time.sleep(_PAUSE)


LATE: Final = 0.1  # s that a sample has waited; chosen
_FAST: Final = 2.0  # time by the stamps per time of arrival, from which on samples are those of a replay; chosen
_SECOND: Final = 1e9  # ns


class LateUpdates:
    """The late updates of one robot that are not published yet. unpublished: those that never will be, so far.

    Only the newest one of a robot in real time is published, and all of a replay. A late pose of a robot is of use to
    nobody once a newer one is known, and to publish it makes the node later still. The samples of a replay are late by
    themselves, and whoever plays them wants every pose.
    """

    def __init__(self, publish: Callable[[Update], None]) -> None:
        self.unpublished = 0
        self._publish = publish
        self._waiting: list[Update] = []
        self._first: tuple[float, int] | None = None  # arrival (s) and stamp (ns) of the first since one was on time
        self._replayed = False  # since then samples have come much faster than they were measured

    def take(self, arrival: float, updates: list[Update]) -> None:
        """Keep the updates of a late sample. arrival: s, monotonic."""
        for update in updates:
            if self._first is None:
                self._first = arrival, update.stamp
            measured = (update.stamp - self._first[1]) / _SECOND
            self._replayed = measured > _FAST * (arrival - self._first[0])
            self._waiting.append(update)

    def on_time(self) -> None:
        """Publish what waits before an update that is on time."""
        self.publish_waiting(newer_follows=True)
        self._first = None

    def publish_waiting(self, *, newer_follows: bool = False) -> None:
        """Publish what waits, at the end of a turn or before a newer update."""
        waiting, self._waiting = self._waiting, []
        if waiting and not self._replayed:
            last = len(waiting) - (not newer_follows)
            self.unpublished += last
            waiting = waiting[last:]
        for update in waiting:
            self._publish(update)


_LONGEST_QUEUE: Final = 20_000  # messages that wait for one robot, 200 s at 100 Hz; chosen
_LARGEST_QUEUE: Final = 32_000_000  # bytes that wait for one robot: 20,000 messages of 60 wheels; chosen
_BATCH: Final = 500  # messages of one robot until the others have their turn; chosen


@dataclass(frozen=True, slots=True)
class _Message:
    """A message that waits. arrival: s, monotonic."""

    is_pose: bool
    arrival: float
    payload: bytes
    attachment: bytes | None


class RobotService:
    """Subscribes to a robot's wheels and SLAM, hands them to its tracker, and publishes the updates.

    Messages are queued in Zenoh's threads and taken in that of ``intake``, in the order in which they came. Where they
    come faster than they can be taken, all are integrated and only the newest of the late ones is published
    (`LateUpdates`), but for those of an acknowledged flow, whose sender waits. A message that fails is counted and
    logged.
    """

    def __init__(self, graph: GraphNode, tracker: RobotTracker, intake: Intake) -> None:
        name = tracker.name
        self.tracker = tracker
        tracker.waiting_since = self._waiting_since
        self._intake = intake
        self._waiting: deque[_Message] = deque()
        self._waiting_bytes = 0
        self._counting = threading.Lock()  # held while those bytes change
        self._scheduled = False  # a turn is queued, or has not yet looked at what waits
        self._working = threading.Lock()  # held while messages are taken
        self._late = LateUpdates(self._publish)
        self._missed = MissedMessages()  # among the robot's own wheel messages, which are in no flow
        self._flows = AcknowledgedFlows(graph.session, name, tracker.flows)
        self._rate_limiter = RateLimiter()
        self._logged_anomalies: dict[str, int] = {}
        self._logged_refusals = 0
        self._logged_status = ""
        self._outputs = [
            (graph.publisher(name, output.topic), output.encoding(tracker.frames))
            for output in OUTPUTS
            if tracker.fusing or not output.fused
        ]
        self._diagnostics = graph.publisher(name, "diagnostics")
        self._graph = graph
        # before the inputs, by which a replay knows that it may begin, and then looks for the token
        self._token = graph.session.liveliness().declare_token(f"omnibench/{name}/alive")
        self._inputs: dict[str, zenoh.Subscriber[None]] = {}
        if tracker.fusing:
            self._receive_poses()
        self._inputs["joint_states"] = graph.subscribe(name, "joint_states", partial(self._queue, False))

    def publish_diagnostics(self) -> None:
        """Publish the diagnostics and log what has changed; called once a second."""
        health = self.tracker.health(time.monotonic())
        status = diagnostic(health, hardware=self.tracker.calibration.robot.name)
        self._diagnostics.put(Diagnostics(time.time_ns(), (status,)))
        # Log a new status, and anomalies that were counted since they were last logged.
        if health.status != self._logged_status:
            self._logged_status = health.status
            LOG.info("%s: %s (%s)", health.robot, health.status, health.message)
        anomalies = self.tracker.counts.anomalies()
        new = {kind: count - self._logged_anomalies.get(kind, 0) for kind, count in anomalies.items()}
        in_words = anomalies_in_words({kind: count for kind, count in new.items() if count})
        if in_words and self._rate_limiter.allows("anomalies"):
            self._logged_anomalies = anomalies
            refused = self.tracker.refusals != self._logged_refusals
            self._logged_refusals = self.tracker.refusals
            last = f"; the last: {health.last_refusal}" if refused and health.last_refusal else ""
            LOG.warning("%s: %s%s", health.robot, in_words, last)

    def close(self) -> None:
        """Take what waits, nothing more, and leave."""
        for subscriber in list(self._inputs.values()):
            subscriber.undeclare()
        while self._waiting:
            self._take_turn()
        with self._working:  # a turn that is under way ends first
            self.tracker.close()
            self._flows.close()
        self._token.undeclare()

    def _receive_poses(self) -> None:
        """Subscribe to the poses of SLAM: without fusion only because a replay counts them in its flow."""
        if "slam_pose" not in self._inputs:
            self._inputs["slam_pose"] = self._graph.subscribe(
                self.tracker.name, "slam_pose", partial(self._queue, True)
            )

    def _queue(self, is_pose: bool, sample: zenoh.Sample) -> None:
        """Queue a message; in Zenoh's thread."""
        size = len(sample.payload)
        with self._counting:
            full = len(self._waiting) >= _LONGEST_QUEUE or self._waiting_bytes + size > _LARGEST_QUEUE
            self._waiting_bytes += 0 if full else size
        if full:
            self.tracker.count_overflow()
            return
        attachment = sample.attachment
        content = None if attachment is None else attachment.to_bytes()
        self._waiting.append(_Message(is_pose, time.monotonic(), sample.payload.to_bytes(), content))
        if not self._scheduled:
            self._scheduled = True
            self._intake.ready(self._take_turn)

    def _waiting_since(self) -> float | None:
        """When the oldest message that waits came, s, monotonic; None if none waits, or if its sender waits, too."""
        try:
            oldest = self._waiting[0]
        except IndexError:
            return None
        return oldest.arrival if flow_of(oldest.attachment) is None else None

    def _take_turn(self) -> None:
        """Take the messages that wait, at most a batch."""
        with self._working:
            self._scheduled = False  # before the first look: what comes from now on may schedule a turn in vain
            behind, unpublished = 0.0, self._late.unpublished
            for _ in range(min(len(self._waiting), _BATCH)):
                message = self._waiting.popleft()
                with self._counting:
                    self._waiting_bytes -= len(message.payload)
                flow = flow_of(message.attachment)
                if flow is None:
                    waited = time.monotonic() - message.arrival
                    behind = max(behind, waited)
                    skipped = 0 if message.is_pose else self._missed.take(message.attachment) or 0
                    self._take(message, late=waited > LATE, skipped=skipped)
                    continue
                self._receive_poses()
                if self._flows.accepts(flow):
                    self._take(message, late=False, published=self._flows.inherited(flow), replayed=True)
            self._late.publish_waiting()
            if self._flows.heard:  # the sender forgets what is acknowledged: the state has to hold it before
                self.tracker.save()
                self._flows.acknowledge()
            self.tracker.record_backlog(behind, self._late.unpublished - unpublished)
            if self._waiting and not self._scheduled:
                self._scheduled = True
                self._intake.ready(self._take_turn)

    def _take(
        self, message: _Message, *, late: bool, published: bool = False, skipped: int = 0, replayed: bool = False
    ) -> None:
        """Take a message, and publish its updates unless it is late, or they may be published already.

        skipped: messages before it that never came, by the sender's numbers. replayed: it comes in a flow.
        """
        try:
            if message.is_pose:
                self.tracker.take_pose(message.payload, message.arrival, replayed=replayed)
                return
            updates = self.tracker.take_wheels(message.payload, message.arrival, skipped, replayed=replayed)
            if published:
                self._late.unpublished += len(updates)
            elif late:
                self._late.take(message.arrival, updates)
            elif updates:
                self._late.on_time()
                for update in updates:
                    self._publish(update)
        except Exception as error:  # the stream has to go on
            input_name = "pose" if message.is_pose else "wheels"
            self.tracker.count_failure()
            if self._rate_limiter.allows(input_name):
                LOG.error("%s: a %s message failed: %s: %s", self.tracker.name, input_name, type(error).__name__, error)

    def _publish(self, update: Update) -> None:
        for publisher, encoded in self._outputs:
            publisher.put_encoded(encoded(update))
