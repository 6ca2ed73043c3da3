"""Algebra of planar poses (x, y, heading), m, m, rad. Headings are not wrapped.

Functions of two arrays (..., 3) take every pose with its counterpart, by NumPy's rules of broadcasting.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array

# Standard deviations of measured poses, m and rad, beyond which a covariance means that it is unknown (chosen).
_LEAST_SIGMA, _LARGEST_SIGMA = 1e-7, 1e7


def rotation(angle: float) -> Array:
    """Matrix (3, 3) that turns a pose's or a twist's (x, y, heading) counter-clockwise by an angle, rad."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def rotated(vectors: Array, angles: Array | float) -> Array:
    """Vectors (..., 2), turned counter-clockwise by angles (...), rad; of vectors (..., 3) the first two elements."""
    cosine, sine = np.cos(angles), np.sin(angles)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def placed(pose: Array, points: Array) -> Array:
    """Points (..., 2) given in the frame of a pose (..., 3), in the frame of the pose's parent."""
    return pose[..., :2] + rotated(points, pose[..., 2])


def seen_from(pose: Array, points: Array) -> Array:
    """Points (..., 2) as seen from a pose (..., 3): the inverse of ``placed``."""
    return rotated(points[..., :2] - pose[..., :2], -pose[..., 2])


def compose(first: Array, second: Array) -> Array:
    """Composition (..., 3) of poses: ``second``, given in the frame ``first``, in the frame of ``first``'s parent."""
    return np.concatenate([placed(first, second), (first + second)[..., 2:]], axis=-1)


def relative(first: Array, second: Array) -> Array:
    """``second`` (..., 3) as seen from ``first``, so that compose(first, relative(first, second)) is ``second``."""
    return np.concatenate([seen_from(first, second), (second - first)[..., 2:]], axis=-1)


def moved_to(start: Array, poses: Array) -> Array:
    """A path (K, 3), K >= 1, moved rigidly so that it begins at the pose ``start`` (3,)."""
    return compose(start, relative(poses[0], poses))


def interpolated(times: Array | float, stamps: Array, rows: Array) -> Array:
    """Rows (..., n) at times (...), s, by straight lines between the rows (K, n) at the stamps (K,); held beyond."""
    return np.stack([np.interp(times, stamps, column) for column in rows.T], axis=-1)


def wrapped(angles: Array) -> Array:
    """Angles in [-pi, pi), rad, that differ from the given ones by whole turns."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def unit_twist(motion: Array) -> Array:
    """The constant twist that makes a motion in unit time: the logarithm map of SE(2).

    motion (..., 3): the pose after it as seen from before, m, m, rad. ``advance`` by arcs is the inverse. Beyond half a
    turn the twist grows without bound towards a whole turn; it is limited to the length of half a turn.
    """
    half = motion[..., 2:] / 2
    longer = 1 / np.sinc(np.minimum(np.abs(half), np.pi / 2) / np.pi)
    return np.concatenate([rotated(motion, -half[..., 0]) * longer, motion[..., 2:]], axis=-1)


def correction(in_map: Array, in_odom: Array) -> Array:
    """Pose (3,) of frame odom in frame map, from the robot's pose (3,) in both (REP-105)."""
    x, y, heading = in_map.tolist()
    odom_x, odom_y, odom_heading = in_odom.tolist()
    turned = heading - odom_heading
    cosine, sine = math.cos(turned), math.sin(turned)
    return np.array([x - cosine * odom_x + sine * odom_y, y - sine * odom_x - cosine * odom_y, turned])


def pose_covariance(position_sigma: float, heading_sigma_deg: float) -> Array:
    """Covariance (3, 3) of a pose by its standard deviations, m and deg."""
    return np.diag([position_sigma, position_sigma, math.radians(heading_sigma_deg)]) ** 2


def usable_covariances(covariances: Array) -> NDArray[np.bool_]:
    """True for poses' covariances (..., 3, 3), m and rad; False for what senders write where they do not know them."""
    possible = np.asarray((np.abs(covariances) <= _LARGEST_SIGMA**2).all(axis=(-2, -1)))
    filled = np.where(possible[..., None, None], covariances, np.eye(3))
    symmetric = np.isclose(filled, np.swapaxes(filled, -2, -1)).all(axis=(-2, -1))
    usable: NDArray[np.bool_] = possible & symmetric & (np.linalg.eigvalsh(filled)[..., 0] >= _LEAST_SIGMA**2)
    return usable
