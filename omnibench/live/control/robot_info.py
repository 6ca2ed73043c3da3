"""Answer to the query ``info``: what a node knows of one of its robots that does not change while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omnibench.environment import package_versions
from omnibench.live.config import LiveConfig, robot_called
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.wire.topics import TOPICS, KeySpace


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
