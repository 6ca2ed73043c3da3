"""The node: every step from a config to robots whose samples become odometry on a Zenoh session.

While it runs, the interpreter's garbage collector and thread switching are set for wheel samples of low latency, and
the diagnostics of all its robots are published once a second.
"""

from __future__ import annotations

import gc
import logging
import math
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

from omnibench.environment import package_versions
from omnibench.errors import one_line, require_type
from omnibench.live.config import LiveConfig, RobotConfig, robot_called
from omnibench.live.control.query_server import QueryServer
from omnibench.live.estimation.health import Health
from omnibench.live.estimation.saved_state import RobotMemory
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.network.presence import Claim
from omnibench.live.network.session import close_session, open_session
from omnibench.live.robot_service import Intake, RobotService
from omnibench.live.stopping import Closing, RateLimiter, Stop
from omnibench.live.wire.recorder import PORT, FoxgloveServer, Recorder, free_path
from omnibench.live.wire.topics import TOPICS, GraphNode, KeySpace
from omnibench.registry import load_plugins
from omnibench.robot.calibration import read_calibration
from omnibench.words import plural

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


LOG = logging.getLogger("omnibench.live")


def make_tracker(config: LiveConfig, robot: RobotConfig, memory: RobotMemory | None) -> RobotTracker:
    """The tracker of one robot; with a memory it goes on where the last run stopped.

    ConfigError or DataError: the calibration cannot be read, or the joints are not one for each wheel.
    """
    calibration = read_calibration(robot.calibration) if memory is None else memory.calibration(robot.calibration)
    tracker = RobotTracker(
        robot.name,
        calibration,
        wheels=robot.wheels,
        fusion=config.fusion_of(robot),
        frames=config.frames_of(robot),
        stale_after=config.stale_after,
        memory=memory,
    )
    saved = None if memory is None else memory.load()
    if saved is not None:
        tracker.resume(saved, time.monotonic(), time.time())
        x, y, _ = saved.pose
        LOG.info("%s: goes on at x %.3f m, y %.3f m of odom", robot.name, x, y)
    return tracker


_PERIOD = 1.0  # s, as ROS 2's diagnostics usually come


class DiagnosticsTimer:
    """Calls the services' ``publish_diagnostics`` once a second, in a thread of its own, until ``close``.

    A robot whose diagnostics fail does not stop those of the others; each kind of its errors is logged once.
    """

    def __init__(self, services: Sequence[RobotService]) -> None:
        self._services = services
        self._log_limiter = RateLimiter(math.inf)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="diagnostics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Publish no more."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD):
            for service in self._services:
                try:
                    service.publish_diagnostics()
                except Exception as error:
                    name, kind = service.tracker.name, type(error).__name__
                    if self._log_limiter.allows(f"{name} {kind}"):
                        LOG.error("%s: diagnostics: %s: %s", name, kind, one_line(str(error)))


_PRESENCE_TIMEOUT = 2.0  # s, at most, for the tokens of other nodes' robots, which mostly come at once; chosen


class LiveNode(Closing):
    """Runs from its construction until ``close``; does all that its config says, ``record`` and ``foxglove`` included.

    remember: use the config's ``state``, if it has one; a replay starts afresh. stop: ends the waiting for a router.
    ConfigError or DataError: it cannot
    start; what was started before the error is closed again.
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
            self.trackers = {
                robot.name: make_tracker(config, robot, memories.get(robot.name)) for robot in config.robots
            }
            self.session = open_session(config.zenoh, f"node {config.name}", stop)
            started.callback(close_session, self.session)
            # Refuse a robot that another node runs, and warn of tf frames that another node may publish too.
            claim = Claim(self.session, self.trackers.keys(), _PRESENCE_TIMEOUT)
            started.callback(claim.close)
            # All robots share the topic tf: two on frames of the same names overwrite each other's transforms.
            robots = config.on_common_frames()
            if robots and claim.others:
                name = robots[0]
                LOG.warning(
                    "robot %s publishes tf between map, odom and base_link, and so may %s on the same network; "
                    "`frames: prefixed` makes them %s/odom and %s/base_link",
                    *(name, ", ".join(claim.others), name, name),
                )
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
            if config.foxglove is not False:
                server = listeners.enter_context(
                    FoxgloveServer(port=PORT if config.foxglove is True else config.foxglove)
                )
                server.forward(self.session, self.keys, list(self.trackers))
                listeners.callback(lambda: _tell_missed("Foxglove", server.missed))
                LOG.warning("Foxglove: open %s", server.address)
            if config.record is not None:  # in a new file where the config's is there already
                path = free_path(config.record)
                recorder = Recorder(self.session, self.keys, list(self.trackers), path, on_failure=LOG.error)
                listeners.enter_context(recorder)
                listeners.callback(lambda: _tell_missed(f"the recording {path}", recorder.missed.total()))
                LOG.warning("recording to %s", path)
            queries = QueryServer(self.session, self.trackers, partial(robot_info, config, self.keys), memories)
            started.callback(queries.close)
            started.callback(DiagnosticsTimer(services).close)
            started.enter_context(low_latency())
            self._started = started.pop_all()

    def close(self) -> None:
        """Take no more requests, then no more messages; write the robots' states; complete the recording; leave."""
        self._started.close()

    def health(self, robot: str) -> Health:
        """A robot's health now."""
        return self.trackers[robot].health(time.monotonic())


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
