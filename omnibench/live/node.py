"""The node: robots' trackers behind one Zenoh session."""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections.abc import Mapping
from typing import Any

import zenoh

from omnibench.environment import package_versions
from omnibench.live.desk import Desk
from omnibench.live.health import Health
from omnibench.live.live_config import LiveConfig, RobotConfig
from omnibench.live.memory import RobotMemory
from omnibench.live.service import RobotService
from omnibench.live.session import open_session
from omnibench.live.topics import TOPICS, GraphNode, KeySpace
from omnibench.live.tracker import RobotTracker
from omnibench.robot.calibration import Calibration, read_calibration

LOG = logging.getLogger("omnibench.live")
_TICK = 1.0  # s


class LiveNode:
    """Runs from its making until ``close``. ConfigError or DataError when it cannot start.

    remember: use the config's ``state``, if it has one; a replay starts afresh.
    """

    def __init__(self, config: LiveConfig, *, remember: bool = True) -> None:
        self.config = config
        self.keys = KeySpace(config.profile, config.domain)
        self._memories: dict[str, RobotMemory] = {}
        try:
            if remember and config.state is not None:
                for robot in config.robots:
                    self._memories[robot.name] = RobotMemory(config.state, robot.name)
            self.trackers = {robot.name: self._tracker(robot) for robot in config.robots}
            self.session = open_session(config.zenoh, f"node {config.name}")
        except BaseException:
            for memory in self._memories.values():
                memory.close()
            raise
        self.graph = GraphNode(self.session, self.keys, config.name)
        self._services = [
            RobotService(self.graph, tracker, fusing=config.fusion_of(robot) is not None)
            for robot, tracker in zip(config.robots, self.trackers.values(), strict=True)
        ]
        files = {robot.name: robot.calibration for robot in config.robots}
        self._desk = Desk(self.session, self.trackers, self._info, self._memories, files)
        self._stop = threading.Event()
        self._ticking = threading.Thread(target=self._tick, name="diagnostics", daemon=True)
        self._ticking.start()
        gc.freeze()  # what is there now stays: the collector need not look at it between two samples

    def close(self) -> None:
        """Stop taking messages, write states down, leave."""
        if self._stop.is_set():
            return
        self._stop.set()
        self._ticking.join()
        for service in self._services:
            service.close()
        self._desk.close()
        self.session.close()
        gc.unfreeze()

    def __enter__(self) -> LiveNode:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def health(self, robot: str) -> Health:
        """How a robot's stream is, now."""
        return self.trackers[robot].health(time.monotonic())

    def _tracker(self, robot: RobotConfig) -> RobotTracker:
        memory = self._memories.get(robot.name)
        tracker = RobotTracker(
            robot.name,
            self._calibration(robot, memory),
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

    def _tick(self) -> None:
        while not self._stop.wait(_TICK):
            for service in self._services:
                try:
                    service.tick()
                except zenoh.ZError as error:
                    LOG.error("%s: diagnostics: %s", service.tracker.name, error)
