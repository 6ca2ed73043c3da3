"""The heading of a robot on the floor from an orientation quaternion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array

_LARGEST_TILT = np.radians(20)  # rad; a larger tilt is that of another frame than the robot's body (chosen)
_LENGTH_TOLERANCE = 0.01  # largest deviation of a quaternion's length from 1 (chosen)


@dataclass(frozen=True, eq=False)
class PlanarHeadings:
    """Yaw of K orientations, and whether they are those of a robot on the floor.

    headings (K,): rad, within a turn. lengths (K,): the quaternions' lengths, 1 for a rotation. tilts (K,): rad,
    between the z axes of body and world. flawed (K,): the length is not 1 (to 1 %), or the tilt above 20 degrees: then
    it is another frame than the robot's body (z up), for example a camera's.
    """

    headings: Array
    lengths: Array
    tilts: Array
    flawed: NDArray[np.bool_]

    def flaw(self, index: int) -> str:
        """The flaw of an orientation in words."""
        if not abs(self.lengths[index] - 1) <= _LENGTH_TOLERANCE:
            return f"quaternion has length {self.lengths[index]:.3g}, expected 1"
        return f"pose is tilted by {np.degrees(self.tilts[index]):.0f} degrees; give poses of the robot's body (z up)"


def planar_headings(quaternions: Array) -> PlanarHeadings:
    """The yaw of quaternions (K, 4) in the order x, y, z, w; roll and pitch are left out."""
    with np.errstate(over="ignore", invalid="ignore"):  # recorded rubbish
        lengths = np.linalg.norm(quaternions, axis=1)
    rotation = np.abs(lengths - 1) <= _LENGTH_TOLERANCE  # False for NaN, too
    x, y, z, w = np.where(rotation, quaternions.T, [[0.0], [0.0], [0.0], [1.0]]) / np.where(rotation, lengths, 1.0)
    headings = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    tilts = np.arccos(np.clip(1 - 2 * (x**2 + y**2), -1, 1))
    return PlanarHeadings(headings, lengths, tilts, ~(rotation & (tilts <= _LARGEST_TILT)))
