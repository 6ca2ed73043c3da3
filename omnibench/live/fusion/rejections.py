"""Poses that the gate rejected one after another; when they agree with each other, it is the filter that errs."""

from __future__ import annotations

from collections import deque

import numpy as np

from omnibench.live.fusion.pose_filter import innovation_of
from omnibench.live.fusion.timeline import PoseMeasurement
from omnibench.robot.kinematics import Array
from omnibench.robot.planar import compose, relative

# Covariance of odometry's error from one rejected pose to another, m, rad; chosen.
_DRIFT = np.diag([0.1**2, 0.1**2, 0.1**2])


class Rejections:
    """The latest rejected poses, with odometry's poses at their times.

    enough: number of poses that have to agree. limit: of the squared Mahalanobis distance of two poses that agree.
    in_a_row: poses rejected since one was fused.
    """

    def __init__(self, enough: int, limit: float) -> None:
        self._enough = enough
        self._limit = limit
        self._poses: deque[tuple[PoseMeasurement, Array]] = deque(maxlen=enough)
        self.in_a_row = 0

    def clear(self) -> None:
        """Forget them: a pose was fused, or the map's frame or the clock has changed."""
        self._poses.clear()
        self.in_a_row = 0

    def known(self, stamp: int) -> bool:
        """True if a pose of this time was rejected already."""
        return any(measurement.stamp == stamp for measurement, _ in self._poses)

    def add(self, measurement: PoseMeasurement, odometry: Array) -> bool:
        """Add a rejected pose; True if enough agree on where the robot is. odometry (3,): pose in odom at its time."""
        self.in_a_row += 1
        self._poses.append((measurement, odometry))
        return len(self._poses) == self._enough and all(
            self._agrees(*each, measurement, odometry) for each in self._poses
        )

    def _agrees(self, earlier: PoseMeasurement, before: Array, measurement: PoseMeasurement, odometry: Array) -> bool:
        """True if the earlier pose, moved on by odometry from ``before``, is the later one."""
        carried = compose(earlier.pose, relative(before, odometry))
        innovation = innovation_of(measurement.pose, carried)
        spread = measurement.covariance + earlier.covariance + _DRIFT
        return float(innovation @ np.linalg.solve(spread, innovation)) <= self._limit
