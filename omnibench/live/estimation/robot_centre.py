"""Robot's centre, whose pose a node publishes, from the tracked point, whose twist a calibration's matrix gives."""

from __future__ import annotations

import numpy as np

from omnibench.robot.kinematics import Array, Mount, compose, relative


class RobotCentre:
    """The centre of a robot whose tracked point lies elsewhere.

    start (3,): pose of the tracked point when the centre is at the origin, m, m, rad. of_twist (3, 3): makes the
    centre's twist of the tracked point's.
    """

    def __init__(self, mount: Mount) -> None:
        self.start = np.array([mount.x, mount.y, mount.yaw])
        self.of_twist: Array = np.linalg.inv(mount.twist)
        self._back = relative(self.start, np.zeros(3))

    def pose(self, tracked: Array) -> Array:
        """Pose (..., 3) of the centre, from that of the tracked point."""
        return compose(tracked, self._back)

    def tracked(self, centre: Array) -> Array:
        """Pose (..., 3) of the tracked point, from that of the centre."""
        return compose(centre, self.start)


def carried(covariance: Array, lever: Array) -> Array:
    """Covariance (3, 3) of the pose of another point of the same body, ``lever`` (2,), m, away in the poses' frame."""
    carry = np.eye(3)
    carry[0, 2], carry[1, 2] = -lever[1], lever[0]
    moved: Array = carry @ covariance @ carry.T
    return moved
