"""Unwrapping of reference headings, done once when a recording is read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

TURN = 2 * np.pi  # rad


def unwrap(robot: Robot, logs: Sequence[WheelLog], headings: Sequence[Array]) -> tuple[list[Array], list[int]]:
    """Continuous headings (rad) and the indices of trajectories in which they are ambiguous.

    Every increment gets the whole turns that bring it closest to the design model's odometry. Where the reference is
    dense this is the nearest turn; where it is sparse, the odometry tells how often the robot turned in between. A
    trajectory is ambiguous if the two still differ by more than a quarter turn between two reference poses.
    """
    model = OdometryModel.of_design(robot, "arc")
    unwrapped: list[Array] = []
    ambiguous: list[int] = []
    for index, (odometry, heading) in enumerate(zip(model.poses(logs), headings, strict=True)):
        steps, expected = np.diff(heading), np.diff(odometry[:, 2])
        turns = np.round((expected - steps) / TURN)
        # Added to the headings as recorded, so that continuous ones stay as they are to the bit.
        unwrapped.append(heading + TURN * np.concatenate([[0.0], np.cumsum(turns)]))
        if len(steps) and np.abs(steps + TURN * turns - expected).max() > TURN / 4:
            ambiguous.append(index)
    return unwrapped, ambiguous
