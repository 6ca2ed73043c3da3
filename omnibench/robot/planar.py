"""Algebra of planar poses (x, y, heading), m, m, rad. Headings are not wrapped."""

from __future__ import annotations

import math

import numpy as np

from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import advance


def compose(first: Array, second: Array) -> Array:
    """Composition (3,) of two poses: ``second``, given in the frame ``first``, in the frame of ``first``'s parent."""
    return advance(first, second, "euler")


def relative(first: Array, second: Array) -> Array:
    """``second`` as seen from ``first`` (3,), the inverse of composition: compose(first, relative) is ``second``."""
    x, y, heading = (second - first).tolist()
    cosine, sine = math.cos(first[2]), math.sin(first[2])
    return np.array([cosine * x + sine * y, -sine * x + cosine * y, heading])


def moved_to(start: Array, poses: Array) -> Array:
    """A path (K, 3), K >= 1, moved rigidly so that it begins at the pose ``start`` (3,)."""
    first, turn = poses[0], start[2] - poses[0, 2]
    path = ((poses[:, 0] - first[0]) + 1j * (poses[:, 1] - first[1])) * np.exp(1j * turn)
    return np.column_stack([start[0] + path.real, start[1] + path.imag, poses[:, 2] + turn])


def unit_twist(motion: Array) -> Array:
    """The constant twist that makes a motion in unit time: the logarithm map of SE(2).

    motion (..., 3): the pose after it as seen from before, m, m, rad. ``advance`` by arcs is the inverse. Beyond half a
    turn the twist grows without bound towards a whole turn; it is limited to the length of half a turn.
    """
    half = motion[..., 2] / 2
    longer = 1 / np.sinc(np.minimum(np.abs(half), np.pi / 2) / np.pi)
    way = (motion[..., 0] + 1j * motion[..., 1]) * longer * np.exp(-1j * half)
    return np.stack([way.real, way.imag, motion[..., 2]], axis=-1)


def correction(in_map: Array, in_odom: Array) -> Array:
    """Pose (3,) of frame odom in frame map, from the robot's pose (3,) in both (REP-105)."""
    x, y, heading = in_map.tolist()
    odom_x, odom_y, odom_heading = in_odom.tolist()
    turned = heading - odom_heading
    cosine, sine = math.cos(turned), math.sin(turned)
    return np.array([x - cosine * odom_x + sine * odom_y, y - sine * odom_x - cosine * odom_y, turned])
