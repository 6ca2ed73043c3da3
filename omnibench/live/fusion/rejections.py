"""Poses that the gate rejected: when they agree with each other, it is the filter that errs."""

from __future__ import annotations

from collections import deque

import numpy as np

from omnibench.live.fusion.pose_filter import innovation_of
from omnibench.live.fusion.timeline import PoseMeasurement
from omnibench.robot.kinematics import Array
from omnibench.robot.planar import compose, relative

_DRIFT = np.diag([0.1**2, 0.1**2, 0.1**2])  # m, rad: by which odometry may err from one rejected pose to another


class Rejections:
    """The poses that were rejected one after another, and where odometry saw the robot at their times.

    enough: after so many that agree, SLAM is believed. limit: squared Mahalanobis distance of poses that agree.
    """

    def __init__(self, enough: int, limit: float) -> None:
        self._enough = enough
        self._limit = limit
        self._poses: deque[tuple[PoseMeasurement, Array]] = deque(maxlen=enough)
        self.in_a_row = 0

    def clear(self) -> None:
        """A pose was fused, or what was rejected has no meaning any more."""
        self._poses.clear()
        self.in_a_row = 0

    def known(self, stamp: int) -> bool:
        """Whether a pose of this time was rejected already."""
        return any(measurement.stamp == stamp for measurement, _ in self._poses)

    def add(self, measurement: PoseMeasurement, odometry: Array) -> bool:
        """Another one; whether the last ones agree on where the robot is. odometry (3,): pose in odom at its time."""
        self.in_a_row += 1
        self._poses.append((measurement, odometry))
        return len(self._poses) == self._enough and all(
            self._agrees(*each, measurement, odometry) for each in self._poses
        )

    def _agrees(self, earlier: PoseMeasurement, seen: Array, measurement: PoseMeasurement, odometry: Array) -> bool:
        """Whether the earlier pose, carried along by odometry, is the later one."""
        carried = compose(earlier.pose, relative(seen, odometry))
        innovation = innovation_of(measurement.pose, carried)
        spread = measurement.covariance + earlier.covariance + _DRIFT
        return float(innovation @ np.linalg.solve(spread, innovation)) <= self._limit
