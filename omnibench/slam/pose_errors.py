"""Covariance of the poses of SLAM and of the map that they made: a Schmidt-Kalman (consider) filter.

The error of a pose is made of the errors of the keyframes that it was matched to, of the noise of both scans, and,
along directions that the scan does not determine, of the errors of the pose before it and of the motion since. Errors
of keyframes and of the motion are kept with their correlations and never corrected. Each is a small motion (3,) of the
whole run's frame, m, m, rad.
"""

from __future__ import annotations

import numpy as np

from omnibench.robot.kinematics import Array
from omnibench.slam.matching.scan_matching import Match

FLOOR: Array = np.diag([1e-4, 1e-4, 1e-5]) ** 2  # m^2, m^2, rad^2; least covariance that is stated (chosen)


class PoseErrors:
    """The joint covariance of the motion's error, of every keyframe and of the last pose.

    start (3,): the first pose. moved (3,): standard deviations of the motion until then, in the robot's frame, m, m,
    rad; default: the first pose is exact.
    """

    def __init__(self, start: Array, moved: Array | None = None) -> None:
        # Errors of the motion, of every keyframe and of the last pose, three rows each. The motion's error, in units of
        # its standard deviation, is the same in the whole run.
        self._joint = np.zeros((6, 6))
        self._joint[:3, :3] = np.eye(3)
        self._pose = start
        if moved is not None:
            row = np.linalg.solve(_deviation(start), _turn(start) * moved)
            self._joint[-3:, :3], self._joint[:3, -3:] = row, row.T
            self._joint[-3:, -3:] = _square(row)

    def step(self, match: Match, moved: Array, skew: Array) -> Array:
        """Go on to the pose of a match, and return its covariance (3, 3).

        moved (3,): standard deviations of the motion from the last pose to the start, in the robot's frame, m, m, rad.
        skew (3,): standard deviations of the twist within the scan, m/s, m/s, rad/s.
        """
        before, here = _deviation(self._pose), _deviation(match.pose)
        rest = np.eye(3) - match.gain
        row = np.zeros((3, len(self._joint)))
        row[:, :3] = rest @ here @ np.linalg.solve(before, _turn(self._pose) * moved)
        row[:, -3:] = rest @ here
        for keyframe, part in match.by_keyframe.items():
            row[:, 3 + 3 * keyframe : 6 + 3 * keyframe] += match.weight @ part @ here
        noise = match.weight @ match.scatter @ match.weight.T + _square(
            match.weight @ match.delayed @ (_turn(match.pose) * skew)
        )
        covariance = row @ self._joint @ row.T + noise
        back = np.linalg.inv(here)
        across = back @ row @ self._joint[:, :-3]
        self._joint[-3:, :-3], self._joint[:-3, -3:] = across, across.T
        self._joint[-3:, -3:] = back @ covariance @ back.T
        self._pose = match.pose
        return covariance + FLOOR

    @property
    def covariance(self) -> Array:
        """Covariance of the last pose (3, 3)."""
        here = _deviation(self._pose)
        return here @ self._joint[-3:, -3:] @ here.T + FLOOR

    @property
    def keyframes(self) -> int:
        """Number of keyframes."""
        return len(self._joint) // 3 - 2

    def keep(self, skewed: Array | None = None) -> None:
        """Make the last pose a keyframe.

        skewed (3,): standard deviations of the shift of what its scan saw, along the robot's axes, m, m, rad; default:
        none.
        """
        size = len(self._joint)
        every = np.concatenate([np.arange(size), np.arange(size - 3, size)])
        self._joint = self._joint[np.ix_(every, every)]
        if skewed is not None:
            kept = slice(size - 3, size)
            self._joint[kept, kept] += _square(np.linalg.solve(_deviation(self._pose), _turn(self._pose) * skewed))

    def merge_oldest(self) -> None:
        """Remove keyframe 0; the next one, whose error is larger, stands for it."""
        others = np.delete(np.arange(len(self._joint)), [3, 4, 5])
        self._joint = self._joint[np.ix_(others, others)]


def _square(matrix: Array) -> Array:
    return matrix @ matrix.T


def _turn(pose: Array) -> Array:
    """Rotation (3, 3) from the robot's axes to those of the run's frame."""
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _deviation(pose: Array) -> Array:
    """Derivative (3, 3) of a pose with respect to a small motion of the run's frame."""
    return np.array([[1.0, 0.0, -pose[1]], [0.0, 1.0, pose[0]], [0.0, 0.0, 1.0]])
