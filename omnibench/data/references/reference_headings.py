"""Headings of compasses and gyros, which may be wrapped, made continuous once, when a recording is read."""

from __future__ import annotations

import numpy as np

from omnibench.data.references.run_references import References
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

TURN = 2 * np.pi  # rad


def with_whole_turns(robot: Robot, log: WheelLog, references: References) -> References:
    """The references with the whole turns added to headings that bring each step closest to the design's odometry.

    log: of the run, from its start pose. Turned angles stay as they are: three turns are 18.85 rad.
    """
    values = references.values.copy()
    absolute = references.fixed_frame & (references.kinds == "heading")
    counted = (references.kinds == "heading") & ~absolute
    for chosen, known, first in ((absolute, references.start_known, log.start[2]), (counted, True, 0.0)):
        if chosen.any():
            stamps, headings = references.t1[chosen], values[chosen, 0]
            driven = _turned(robot, log, stamps)
            before = (first, 0.0) if known else (headings[0], driven[0])
            steps = np.diff(headings, prepend=before[0])
            turns = np.round((np.diff(driven, prepend=before[1]) - steps) / TURN)
            values[chosen, 0] = headings + TURN * np.cumsum(turns)
    return references.with_values(values)


def _turned(robot: Robot, log: WheelLog, stamps: Array) -> Array:
    """Angles (S,) that the design robot has turned by at stamps (S,), rad."""
    wanted = WheelLog(log.times, log.rates, np.zeros(3), stamps, steering=log.steering, drive=log.drive)
    (poses,) = OdometryModel.of_design(robot, "arc").poses([wanted])
    turned: Array = poses[:, 2]
    return turned
