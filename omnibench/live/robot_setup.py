"""A robot's tracker as the config describes it: calibration, joints, frames, and the state that the last run left."""

from __future__ import annotations

import logging
import time

from omnibench.live.config import LiveConfig, RobotConfig
from omnibench.live.estimation.saved_state import RobotMemory
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.robot.calibration import read_calibration

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
