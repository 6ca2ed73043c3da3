"""The node: every step from a config to robots whose samples become odometry on a Zenoh session.

While it runs, the interpreter's garbage collector and thread switching are set for wheel samples of low latency, and
the diagnostics of all its robots are published once a second. Each robot's service holds its inputs, its outputs, and
the token that shows that it is alive.
"""

from __future__ import annotations

import gc
import logging
import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from queue import SimpleQueue
from typing import Any, Final, NamedTuple

import zenoh

from omnibench.environment import package_versions
from omnibench.errors import one_line, require_type
from omnibench.live.config import LiveConfig, RobotConfig, robot_called
from omnibench.live.control import QueryServer
from omnibench.live.delivery import AcknowledgedFlows
from omnibench.live.health import Counts, Health, anomalies_in_words, diagnostics
from omnibench.live.network import close_session, open_session
from omnibench.live.presence import Claim
from omnibench.live.record import Recorder, free_path
from omnibench.live.state import RobotMemory
from omnibench.live.stopping import Closing, RateLimiter, Stop
from omnibench.live.topics import OUTPUTS, TOPICS, GraphNode, KeySpace, Update
from omnibench.live.tracker import RobotTracker
from omnibench.live.viewers import PORT, FoxgloveServer, RerunView
from omnibench.live.wire import Diagnostics, Flow, MissedMessages, flow_of
from omnibench.registry import load_plugins
from omnibench.robot.calibration import read_calibration
from omnibench.words import plural

LOG = logging.getLogger("omnibench.live")
_PAUSE: Final = 0.002  # s between turns while the thread is busy; chosen
_BUSY: Final = 0.5  # share of the time in which it works, from which on it pauses; chosen
_SMOOTHING: Final = 0.1  # share of the latest turn in the mean; chosen


class Intake(Closing):
    """Runs the turns of all robots: at once, in the caller's thread, or one after another in a thread of its own.

    To hand the interpreter to another thread costs as much as to take a message, so that Zenoh's threads take it
    themselves. Where turns take most of the time, they run in the intake's thread until ``close``: Zenoh's threads are
    then free to receive, what waits can be seen, and a pause between turns lets messages come together.
    """

    def __init__(self) -> None:
        self._turns: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._worked = self._spent = 0.0  # s in turns and in all, recent turns weighing most
        self._last = time.perf_counter()
        self._thread = threading.Thread(target=self._run_queued, name="intake", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """True if turns take most of the time."""
        return self._worked > _BUSY * self._spent

    def queue(self, turn: Callable[[], object]) -> None:
        """Run a turn after those that are queued. From any thread."""
        self._turns.put(turn)

    def run(self, turn: Callable[[], object]) -> None:
        """Run a turn now; an error is logged."""
        began = time.perf_counter()
        try:
            turn()
        except Exception as error:  # one robot must not silence the others
            LOG.error("intake: %s: %s", type(error).__name__, one_line(str(error)))
        now = time.perf_counter()
        self._worked += _SMOOTHING * (now - began - self._worked)
        self._spent += _SMOOTHING * (now - self._last - self._spent)
        self._last = now

    def close(self) -> None:
        """Do what is queued, and no more."""
        self._turns.put(None)
        self._thread.join()

    def _run_queued(self) -> None:
        while (turn := self._turns.get()) is not None:
            self.run(turn)
            if self.busy:
                time.sleep(_PAUSE)


LATE: Final = 0.1  # s that a sample has waited; chosen
_FAST: Final = 2.0  # time by the stamps per time of arrival, from which on samples are those of a replay; chosen
_SECOND: Final = 1e9  # ns


class LateUpdates:
    """The late updates of one robot that are not published yet.

    Only the newest one of a robot in real time is published, and all of a replay. A late pose of a robot is of use to
    nobody once a newer one is known, and to publish it makes the node later still. The samples of a replay are late by
    themselves, and whoever plays them wants every pose.
    """

    def __init__(self, publish: Callable[[Update], None], counts: Counts) -> None:
        self._publish = publish
        self._counts = counts
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

    def publish(self, on_time: Sequence[Update] = ()) -> None:
        """Publish what waits, at the end of a turn, or before updates that are on time."""
        if self._waiting and not self._replayed:
            last = len(self._waiting) - (not on_time)
            self._counts.unpublished += last
            del self._waiting[:last]
        updates, self._waiting = [*self._waiting, *on_time], []
        for update in updates:
            self._publish(update)
        if on_time:
            self._first = None


_LONGEST_QUEUE: Final = 20_000  # messages that wait for one robot, 200 s at 100 Hz; chosen
_LARGEST_QUEUE: Final = 32_000_000  # bytes that wait for one robot: 20,000 messages of 60 wheels; chosen
_BATCH: Final = 500  # messages of one robot until the others have their turn; chosen


class _Message(NamedTuple):
    """A message that waits. arrival: s, monotonic. flow: its place in an acknowledged flow, whose sender waits."""

    is_pose: bool
    arrival: float
    payload: bytes
    attachment: bytes | None
    flow: Flow | None


class RobotService:
    """Subscribes to a robot's wheels and SLAM, hands them to its tracker, and publishes the updates.

    Messages are queued in Zenoh's threads, and taken in the order in which they came by the turns of ``intake``: in the
    same thread at once, unless others wait or much is to be done. Where they come faster than they can be taken, all
    are integrated and only the newest of the late ones is published (`LateUpdates`), but for those of an acknowledged
    flow, whose sender waits. A message that fails is counted and logged.
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
        self._late = LateUpdates(self._publish, tracker.counts)
        self._missed = MissedMessages()  # among the robot's own wheel messages, which are in no flow
        self._flows = AcknowledgedFlows(graph.session, name, tracker.flows)
        self._rate_limiter = RateLimiter()
        self._logged_anomalies: dict[str, int] = {}
        self._logged_refusals = 0
        self._logged_status = ""
        self._outputs = [
            (graph.publisher(name, output.topic).put_encoded, output.encoding(tracker.frames))
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
        statuses = diagnostics(health, hardware=self.tracker.calibration.robot.name)
        self._diagnostics.put(Diagnostics(time.time_ns(), statuses))
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
        for news in self.tracker.watch():  # last, since it may take long
            LOG.warning("%s: guard: %s", self.tracker.name, news)

    def close(self) -> None:
        """Take what waits, nothing more, and leave."""
        for subscriber in list(self._inputs.values()):
            subscriber.undeclare()
        while self._waiting:
            self._take_turn()
        with self._working:  # a turn that is under way ends first
            self.tracker.close()
        self._token.undeclare()

    def _receive_poses(self) -> None:
        """Subscribe to the poses of SLAM: without fusion only because a replay counts them in its flow."""
        if "slam_pose" not in self._inputs:
            self._inputs["slam_pose"] = self._graph.subscribe(
                self.tracker.name, "slam_pose", partial(self._queue, True)
            )

    def _queue(self, is_pose: bool, sample: zenoh.Sample) -> None:
        """Queue a message, and take it at once where nothing else is to be done; in Zenoh's thread."""
        arrival, payload, attachment = time.monotonic(), sample.payload.to_bytes(), sample.attachment
        with self._counting:
            full = len(self._waiting) >= _LONGEST_QUEUE or self._waiting_bytes + len(payload) > _LARGEST_QUEUE
            self._waiting_bytes += 0 if full else len(payload)
        if full:
            self.tracker.count("overflow")
            return
        content = None if attachment is None else attachment.to_bytes()
        flow = flow_of(content)
        self._waiting.append(_Message(is_pose, arrival, payload, content, flow))
        if self._scheduled:
            return
        self._scheduled = True
        # Messages of a flow are taken together, so that one saved state and one acknowledgement stand for many.
        if flow is None and not self._intake.busy and self._working.acquire(blocking=False):
            try:
                self._intake.run(self._take_waiting)
            finally:
                self._working.release()
        else:
            self._intake.queue(self._take_turn)

    def _waiting_since(self) -> float | None:
        """When the oldest message that waits came, s, monotonic; None if none waits, or if its sender waits, too."""
        try:
            oldest = self._waiting[0]
        except IndexError:
            return None
        return oldest.arrival if oldest.flow is None else None

    def _take_turn(self) -> None:
        with self._working:
            self._take_waiting()

    def _take_waiting(self) -> None:
        """Take the messages that wait, at most a batch; by who holds ``_working``."""
        if self.tracker.closed:  # what is still on its way must not be acknowledged: the state is written
            return
        self._scheduled = False  # before the first look: what comes from now on may schedule a turn in vain
        behind = 0.0
        for _ in range(min(len(self._waiting), _BATCH)):
            message = self._waiting.popleft()
            with self._counting:
                self._waiting_bytes -= len(message.payload)
            if message.flow is None:
                waited = time.monotonic() - message.arrival
                behind = max(behind, waited)
                skipped = 0 if message.is_pose else self._missed.take(message.attachment) or 0
                self._take(message, skipped, late=waited > LATE)
                continue
            self._receive_poses()
            if self._flows.accepts(message.flow):
                self._take(message, published=self._flows.inherited(message.flow))
        self._late.publish()
        if self._flows.heard:  # the sender forgets what is acknowledged: the state has to hold it before
            self.tracker.save()
            self._flows.acknowledge()
        self.tracker.record_backlog(behind)
        if self._waiting and not self._scheduled:
            self._scheduled = True
            self._intake.queue(self._take_turn)

    def _take(self, message: _Message, skipped: int = 0, *, late: bool = False, published: bool = False) -> None:
        """Take a message, and publish its updates unless it is late, or they may be published already.

        skipped: messages before it that never came, by the sender's numbers.
        """
        replayed = message.flow is not None
        try:
            if message.is_pose:
                self.tracker.take_pose(message.payload, message.arrival, replayed=replayed)
                return
            updates = self.tracker.take_wheels(message.payload, message.arrival, skipped, replayed=replayed)
            if published:
                self.tracker.counts.unpublished += len(updates)
            elif late:
                self._late.take(message.arrival, updates)
            elif updates:
                self._late.publish(updates)
        except Exception as error:  # the stream has to go on
            input_name = "pose" if message.is_pose else "wheels"
            self.tracker.count("failures")
            if self._rate_limiter.allows(input_name):
                LOG.error("%s: a %s message failed: %s: %s", self.tracker.name, input_name, type(error).__name__, error)

    def _publish(self, update: Update) -> None:
        for put, encoded in self._outputs:
            put(encoded(update))


_SWITCH_INTERVAL = 0.0005  # s that a busy thread keeps the interpreter while others wait; Python's own is 0.005

_running = 0  # nodes of this process
_lock = threading.Lock()
_usual_interval = sys.getswitchinterval()


@contextmanager
def low_latency() -> Iterator[None]:
    """While any node of this process is in this context, nothing else keeps the interpreter from a sample for long.

    The garbage collector passes over the objects that are there at the start, and a busy thread (the query server with
    a large calibration) gives way after 0.5 ms.
    """
    global _running
    with _lock:
        _running += 1
        gc.collect()
        gc.freeze()
        sys.setswitchinterval(_SWITCH_INTERVAL)
    try:
        yield
    finally:
        with _lock:
            _running -= 1
            if not _running:
                gc.unfreeze()
                sys.setswitchinterval(_usual_interval)


_PERIOD = 1.0  # s, as ROS 2's diagnostics usually come


def publish_diagnostics(services: Sequence[RobotService], stop: threading.Event) -> None:
    """Publish the services' diagnostics once a second until stopped.

    A robot whose diagnostics fail does not stop those of the others; each kind of its errors is logged once.
    """
    log_limiter = RateLimiter(math.inf)
    while not stop.wait(_PERIOD):
        for service in services:
            try:
                service.publish_diagnostics()
            except Exception as error:
                name, kind = service.tracker.name, type(error).__name__
                if log_limiter.allows(f"{name} {kind}"):
                    LOG.error("%s: diagnostics: %s: %s", name, kind, one_line(str(error)))


_PRESENCE_TIMEOUT = 2.0  # s, at most, for the tokens of other nodes' robots, which mostly come at once; chosen


class LiveNode(Closing):
    """Runs from its construction until ``close``; does all that its config says, ``record`` and ``foxglove`` included.

    remember: use the config's ``state``, if it has one; a replay starts afresh. stop: ends the waiting for a router.
    ConfigError or DataError: it cannot start; what was started before the error is closed again.
    """

    def __init__(self, config: LiveConfig, *, remember: bool = True, stop: Stop | None = None) -> None:
        require_type(config, LiveConfig, "read_live_config")
        self.config = config
        self.keys = KeySpace(config.profile, config.domain)
        load_effects(config)
        with ExitStack() as started:  # closes the parts in reverse order of their start
            # Each robot's memory: the files of its saved state, locked for this node; none without a ``state`` folder.
            memories: dict[str, RobotMemory] = {}
            if remember and config.state is not None:
                for robot in config.robots:
                    memories[robot.name] = memory = RobotMemory(config.state, robot.name)
                    started.callback(memory.close)
            self.trackers = {robot.name: self._tracker(robot, memories.get(robot.name)) for robot in config.robots}
            self.session = open_session(config.zenoh, f"node {config.name}", stop)
            started.callback(close_session, self.session)
            self._claim_robots(started)
            intake = Intake()
            started.callback(intake.close)
            listeners = started.enter_context(ExitStack())  # closed after the services, to have their last messages
            graph = GraphNode(self.session, self.keys, self.config.name)
            services = []
            for tracker in self.trackers.values():
                services.append(service := RobotService(graph, tracker, intake))
                started.callback(service.close)
            self._services = services
            # after the services: a replay begins with the first subscriber, and the samples are for these
            self._serve_foxglove(listeners)
            self._show_in_rerun(listeners)
            self._record(listeners)
            queries = QueryServer(self.session, self.trackers, partial(robot_info, config, self.keys), memories)
            started.callback(queries.close)
            stopped = threading.Event()
            arguments = services, stopped
            diagnostics = threading.Thread(target=publish_diagnostics, args=arguments, name="diagnostics", daemon=True)
            diagnostics.start()
            started.callback(diagnostics.join)
            started.callback(stopped.set)
            started.enter_context(low_latency())
            self._started = started.pop_all()

    def close(self) -> None:
        """Take no more requests, then no more messages; write the robots' states; complete the recording; leave."""
        self._started.close()

    def health(self, robot: str) -> Health:
        """A robot's health now."""
        return self.trackers[robot].health(time.monotonic())

    def _tracker(self, robot: RobotConfig, memory: RobotMemory | None) -> RobotTracker:
        """The tracker of one robot; with a memory it goes on where the last run stopped."""
        tracker = RobotTracker(
            robot.name,
            read_calibration(robot.calibration) if memory is None else memory.calibration(robot.calibration),
            wheels=robot.wheels,
            fusion=self.config.fusion_of(robot),
            frames=self.config.frames_of(robot),
            guard=self.config.guard,
            stale_after=self.config.stale_after,
            memory=memory,
        )
        if memory is not None and (saved := memory.load()) is not None:
            tracker.resume(saved, time.monotonic(), time.time())
            LOG.info("%s: goes on at x %.3f m, y %.3f m of odom", robot.name, *saved.pose[:2])
        return tracker

    def _claim_robots(self, started: ExitStack) -> None:
        """Refuse a robot that another node runs, and warn of tf frames that another node may publish too."""
        claim = Claim(self.session, self.trackers.keys(), _PRESENCE_TIMEOUT)
        started.callback(claim.close)
        # All robots share the topic tf: two on frames of the same names overwrite each other's transforms.
        robots = self.config.on_common_frames()
        if robots and claim.others:
            name = robots[0]
            LOG.warning(
                "robot %s publishes tf between map, odom and base_link, and so may %s on the same network; "
                "`frames: prefixed` makes them %s/odom and %s/base_link",
                *(name, ", ".join(claim.others), name, name),
            )

    def _serve_foxglove(self, listeners: ExitStack) -> None:
        """Serve the robots' topics to Foxglove, if the config asks for it."""
        if self.config.foxglove is False:
            return
        port = PORT if self.config.foxglove is True else self.config.foxglove
        server = listeners.enter_context(FoxgloveServer(port=port))
        server.forward(self.session, self.keys, list(self.trackers))
        listeners.callback(lambda: _tell_missed("Foxglove", server.missed))
        LOG.warning("Foxglove: open %s", server.address)

    def _show_in_rerun(self, listeners: ExitStack) -> None:
        """Show the robots in Rerun, if the config asks for it; in a new file where the config's is there already."""
        if self.config.rerun is False:
            return
        file = None if self.config.rerun is True else free_path(self.config.rerun)
        mounts = {name: tracker.calibration.robot.mount for name, tracker in self.trackers.items()}
        listeners.enter_context(RerunView(self.session, self.keys, mounts, file))
        LOG.warning("Rerun: %s", file or "the viewer is open")

    def _record(self, listeners: ExitStack) -> None:
        """Record the robots' topics, if the config asks for it; in a new file where the config's is there already."""
        if self.config.record is None:
            return
        path = free_path(self.config.record)
        recorder = Recorder(self.session, self.keys, list(self.trackers), path, on_failure=LOG.error)
        listeners.enter_context(recorder)
        listeners.callback(lambda: _tell_missed(f"the recording {path}", recorder.missed.total()))
        LOG.warning("recording to %s", path)


def load_effects(config: LiveConfig) -> None:
    """Load the plug-ins whose effects calibrations may name; one that cannot be imported is a warning in the log."""
    for failure in load_plugins(config.plugins):
        LOG.warning("plug-in %s cannot be imported: %s", failure.origin, failure.error)


def _tell_missed(where: str, messages: int) -> None:
    if messages:
        LOG.warning("%s lacks %s, lost on the way", where, plural(messages, "message"))


def robot_info(config: LiveConfig, keys: KeySpace, tracker: RobotTracker) -> Mapping[str, Any]:
    """Wheels, calibration, topics' keys, frames, fusion settings and versions of a robot of the node ``config``."""
    robot, drive = robot_called(config, tracker.name), tracker.calibration.robot.drive
    return {
        "robot": tracker.name,
        "node": config.name,
        "wheels": drive.wheels,
        "steered": drive.steered,
        "signals": drive.names,
        "mount": tracker.calibration.robot.mount,
        "calibration": tracker.calibration.name,
        "integration": tracker.calibration.integration,
        "profile": config.profile,
        "domain": config.domain,
        "topics": {topic: keys.key(tracker.name, topic) for topic in TOPICS},
        "frames": config.frames_of(robot),
        "fusion": config.fusion_of(robot),
        "versions": package_versions(),
    }
