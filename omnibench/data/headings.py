"""Unwrapping reference headings, once, when a recording is read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

TURN = 2 * np.pi


def unwrap(robot: Robot, logs: Sequence[WheelLog], headings: Sequence[Array]) -> tuple[list[Array], list[int]]:
    """Continuous headings (rad) and the indices of trajectories in which they are doubtful.

    Increments go to the nearest turn; where the reference is so sparse that the design model's odometry turned by
    another whole turn meanwhile, the odometry decides. Doubtful: the two still differ by more than a quarter turn
    within one gap of the reference.
    """
    model = OdometryModel.of_design(robot, "arc")
    unwrapped, doubtful = [], []
    for index, (odometry, heading) in enumerate(zip(model.poses(logs), headings, strict=True)):
        expected = np.diff(odometry[:, 2])
        steps = np.diff(heading)
        nearest = steps - TURN * np.round(steps / TURN)
        chosen = nearest + TURN * np.round((expected - nearest) / TURN)
        unwrapped.append(heading[0] + np.concatenate([[0.0], np.cumsum(chosen)]))
        if len(chosen) and np.abs(chosen - expected).max() > TURN / 4:
            doubtful.append(index)
    return unwrapped, doubtful
