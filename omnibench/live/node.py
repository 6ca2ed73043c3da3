"""The node: robots' trackers behind one Zenoh session."""

from __future__ import annotations

import gc
import logging
import math
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

from omnibench.environment import package_versions
from omnibench.errors import ConfigError, one_line
from omnibench.live.config import LiveConfig, RobotConfig
from omnibench.live.control.query_server import QueryServer
from omnibench.live.estimation.health import Health
from omnibench.live.estimation.saved_state import RobotMemory
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.network.presence import alive_robots
from omnibench.live.network.rate_limiter import RateLimiter
from omnibench.live.network.session import open_session
from omnibench.live.robot_service import RobotService
from omnibench.live.wire.topics import TOPICS, GraphNode, KeySpace
from omnibench.registry import load_plugins
from omnibench.robot.calibration import Calibration, read_calibration

LOG = logging.getLogger("omnibench.live")
_TICK = 1.0  # s
_TURN = 0.0005  # s that a thread has the interpreter while others wait
_LOOKING = 0.5  # s, for other robots on the network


class LiveNode:
    """Runs from its making until ``close``. ConfigError or DataError when it cannot start; then nothing stays open.

    remember: use the config's ``state``, if it has one; a replay starts afresh.
    """

    def __init__(self, config: LiveConfig, *, remember: bool = True) -> None:
        self.config = config
        self.keys = KeySpace(config.profile, config.domain)
        self._memories: dict[str, RobotMemory] = {}
        self._services: list[RobotService] = []
        self._rate_limiter = RateLimiter(math.inf)
        self._stop = threading.Event()
        load_effects(config)
        with ExitStack() as started:  # what is last started is first closed
            if remember and config.state is not None:
                for robot in config.robots:
                    self._memories[robot.name] = memory = RobotMemory(config.state, robot.name)
                    started.callback(memory.close)
            self.trackers = {robot.name: self._tracker(robot) for robot in config.robots}
            self.session = open_session(config.zenoh, f"node {config.name}")
            started.callback(self.session.close)
            self._look_around()
            self.graph = GraphNode(self.session, self.keys, config.name)
            for robot in config.robots:
                fusing = config.fusion_of(robot) is not None
                service = RobotService(self.graph, self.trackers[robot.name], fusing=fusing)
                self._services.append(service)
                started.callback(service.close)
            query_server = QueryServer(self.session, self.trackers, self._info, self._memories)
            started.callback(query_server.close)
            self._ticking = threading.Thread(target=self._tick, name="diagnostics", daemon=True)
            self._ticking.start()
            started.callback(self._stop_ticking)
            started.enter_context(_undisturbed())
            self._started = started.pop_all()

    def close(self) -> None:
        """Take no more orders, then no more messages; write states down; leave."""
        self._started.close()

    def __enter__(self) -> LiveNode:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def health(self, robot: str) -> Health:
        """How a robot's stream is, now."""
        return self.trackers[robot].health(time.monotonic())

    def _tracker(self, robot: RobotConfig) -> RobotTracker:
        memory = self._memories.get(robot.name)
        calibration = self._calibration(robot, memory)
        _check_joints(robot, calibration)
        tracker = RobotTracker(
            robot.name,
            calibration,
            wheels=robot.wheels,
            fusion=self.config.fusion_of(robot),
            frames=self.config.frames_of(robot),
            stale_after=self.config.stale_after,
            memory=memory,
        )
        saved = memory.load() if memory is not None else None
        if saved is not None:
            tracker.resume(saved, time.monotonic(), time.time())
            x, y, _ = saved.pose
            LOG.info("%s: goes on at x %.3f m, y %.3f m of odom", robot.name, x, y)
        return tracker

    def _calibration(self, robot: RobotConfig, memory: RobotMemory | None) -> Calibration:
        if memory is None:
            return read_calibration(robot.calibration)
        return memory.calibration(robot.calibration)

    def _info(self, tracker: RobotTracker) -> Mapping[str, Any]:
        robot = next(each for each in self.config.robots if each.name == tracker.name)
        return {
            "robot": tracker.name,
            "node": self.config.name,
            "wheels": tracker.calibration.robot.wheel_names,
            "calibration": tracker.calibration.name,
            "integration": tracker.calibration.integration,
            "profile": self.config.profile,
            "domain": self.config.domain,
            "topics": {topic: self.keys.key(tracker.name, topic) for topic in TOPICS},
            "frames": self.config.frames_of(robot),
            "fusion": self.config.fusion_of(robot),
            "versions": package_versions(),
        }

    def _look_around(self) -> None:
        """Who else is there. Two nodes for one robot would publish every stamp twice: ConfigError.

        tf is everybody's, and two robots on frames of the same names tear one another's apart: a warning.
        """
        others = set(alive_robots(self.session, _LOOKING))
        for name in self.trackers:
            if name in others:
                raise ConfigError(
                    f"robot {name!r} is run by another node already; stop that, or give this one's another name"
                )
        common = self.config.on_common_frames()
        if others and common:
            LOG.warning(
                "robot %s publishes tf between map, odom and base_link, and so may %s on the same network; "
                "`frames: prefixed` makes them %s/odom and %s/base_link",
                *(common[0], ", ".join(sorted(others)), common[0], common[0]),
            )

    def _tick(self) -> None:
        while not self._stop.wait(_TICK):
            for service in self._services:
                try:
                    service.tick()
                except Exception as error:  # of one robot; the others' go on
                    name = service.tracker.name
                    if self._rate_limiter.allows(f"{name} {type(error).__name__}"):
                        LOG.error("%s: diagnostics: %s: %s", name, type(error).__name__, one_line(str(error)))

    def _stop_ticking(self) -> None:
        self._stop.set()
        self._ticking.join()


def load_effects(config: LiveConfig) -> None:
    """Load the plug-ins whose effects calibrations may name; one that cannot be imported is told in the log."""
    for failure in load_plugins(config.plugins):
        LOG.warning("plug-in %s cannot be imported: %s", failure.origin, failure.error)


def _check_joints(robot: RobotConfig, calibration: Calibration) -> None:
    joints, wheels = robot.wheels.joints, calibration.robot.wheel_names
    if joints is not None and (len(joints) != len(wheels) or len(set(joints)) < len(joints)):
        raise ConfigError(
            f"robot {robot.name!r}: wheels.joints: {', '.join(joints) or 'none'}; name one joint, and a different one, "
            f"for each of the wheels {', '.join(wheels)}"
        )


_running = 0  # nodes of this process
_running_lock = threading.Lock()
_usual_turn = sys.getswitchinterval()


@contextmanager
def _undisturbed() -> Iterator[None]:
    """While any node of this process runs, nothing else keeps the interpreter from a sample for long.

    The collector need not look at what was there at the start, and a thread that works on and on (the query server
    on a large calibration) gives way after 0.5 ms in place of 5.
    """
    global _running
    with _running_lock:
        _running += 1
        gc.collect()
        gc.freeze()
        sys.setswitchinterval(_TURN)
    try:
        yield
    finally:
        with _running_lock:
            _running -= 1
            if not _running:
                gc.unfreeze()
                sys.setswitchinterval(_usual_turn)
