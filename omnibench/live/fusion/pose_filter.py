"""Extended Kalman filter over the pose (x, y, heading), by filterpy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from omnibench.live.estimation.live_odometry import Motion
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import advance

_TURN = 2 * math.pi
_POSE = np.eye(3)  # measurement matrix: SLAM measures the pose itself


class PoseFilter:
    """Pose (3,) and covariance (3, 3); motions predict them, measured poses correct them."""

    def __init__(self, pose: Array, covariance: Array) -> None:
        self._filter: Any = ExtendedKalmanFilter(dim_x=3, dim_z=3)
        self._filter.predict_x = self._predict_pose
        self._filter.Q = np.zeros((3, 3))
        self.set(pose, covariance)

    @property
    def pose(self) -> Array:
        """(3,): m, m, rad; the heading is not wrapped."""
        return self._filter.x

    @property
    def covariance(self) -> Array:
        return self._filter.P

    def set(self, pose: Array, covariance: Array) -> None:
        """Replace pose and covariance."""
        self._filter.x = np.array(pose, dtype=float)
        self._filter.P = np.array(covariance, dtype=float)

    def predict(self, motion: Motion) -> None:
        """Carry pose and covariance along a motion."""
        self._filter.predict(motion)

    def normalised_innovation(self, pose: Array, covariance: Array) -> float:
        """Normalised innovation squared of a measured pose: chi-square with 3 degrees of freedom in theory."""
        innovation = innovation_of(pose, self.pose)
        return float(innovation @ np.linalg.solve(self.covariance + covariance, innovation))

    def correct(self, pose: Array, covariance: Array) -> None:
        """Correct pose and covariance by a measured pose (3,) with its covariance (3, 3)."""
        self._filter.update(pose, lambda _: _POSE, lambda x: x, R=covariance, residual=innovation_of)

    def _predict_pose(self, motion: Motion) -> None:
        """The motion model of odometry in filterpy's prediction: pose, its derivative F and noise Q."""
        before, after = self.pose, advance(self.pose, motion.moved, motion.integration)
        self._filter.x = after
        self._filter.F[0, 2] = before[1] - after[1]
        self._filter.F[1, 2] = after[0] - before[0]
        self._filter.Q[0, 0] = self._filter.Q[1, 1] = motion.position_variance
        self._filter.Q[2, 2] = motion.heading_variance


def innovation_of(measured: Array, expected: Array) -> Array:
    """Innovation (3,): measured minus expected pose, the heading the shortest way."""
    difference: Array = measured - expected
    difference[2] -= _TURN * round(float(difference[2]) / _TURN)
    return difference
