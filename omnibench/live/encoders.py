"""Encoding for one robot's own messages, of which only stamps and numbers change: several times as fast as in general.

The first message is encoded by rosbags; later ones are that one with other numbers in the same places.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import numpy as np

from omnibench.live.messages import FLAT, ODOMETRY, TRANSFORMS, Odometry, Transform
from omnibench.robot.kinematics import Array

_SECOND = 1_000_000_000
_STAMP_AT = 4  # bytes: after the CDR header
_NUMBERS = 7 + 36 + 6 + 36  # at the end of an Odometry: pose, its covariance, twist, its covariance
_TWIST = 7 + 36
_POSE_COVARIANCE = 7 + FLAT
_TWIST_COVARIANCE = _TWIST + 6 + FLAT


class OdometryEncoder:
    """Encodes odometry whose frames are always the same; the bytes are those of ``ODOMETRY.encode``."""

    def __init__(self, frame: str, child_frame: str) -> None:
        zeros = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
        self._buffer = bytearray(ODOMETRY.encode(Odometry(0, frame, child_frame, *zeros)))
        begin = len(self._buffer) - 8 * _NUMBERS
        self._numbers = np.frombuffer(self._buffer, "<f8", _NUMBERS, begin)

    def encode(self, message: Odometry) -> bytes:
        """The message in CDR."""
        struct.pack_into("<iI", self._buffer, _STAMP_AT, message.stamp // _SECOND, message.stamp % _SECOND)
        numbers = self._numbers
        _write_pose(numbers, message.pose)
        numbers[_POSE_COVARIANCE] = message.pose_covariance.ravel()
        numbers[_TWIST], numbers[_TWIST + 1], numbers[_TWIST + 5] = message.twist.tolist()
        numbers[_TWIST_COVARIANCE] = message.twist_covariance.ravel()
        return bytes(self._buffer)


class TransformsEncoder:
    """Encodes the transforms of always the same frames; the bytes are those of ``TRANSFORMS.encode``."""

    def __init__(self, frames: Sequence[tuple[str, str]]) -> None:
        marks = [Transform((index + 1) * _SECOND, *pair, np.zeros(3)) for index, pair in enumerate(frames)]
        self._buffer = bytearray(TRANSFORMS.encode(marks))
        self._stamps: list[int] = []
        self._poses: list[Array] = []
        place = _STAMP_AT
        for index in range(len(frames)):
            place = self._buffer.index(struct.pack("<iI", index + 1, 0), place)
            # the next rotation by nothing ends the seven numbers of this pose
            pose = self._buffer.index(struct.pack("<ddd", 0.0, 0.0, 1.0), place) - 4 * 8
            self._stamps.append(place)
            self._poses.append(np.frombuffer(self._buffer, "<f8", 7, pose))
            place = pose + 7 * 8

    def encode(self, transforms: Sequence[Transform]) -> bytes:
        """The transforms in CDR."""
        for place, numbers, transform in zip(self._stamps, self._poses, transforms, strict=True):
            struct.pack_into("<iI", self._buffer, place, transform.stamp // _SECOND, transform.stamp % _SECOND)
            _write_pose(numbers, transform.pose)
        return bytes(self._buffer)


def _write_pose(numbers: Array, pose: Array) -> None:
    """x, y, z and the quaternion."""
    numbers[0], numbers[1], heading = pose.tolist()
    numbers[5], numbers[6] = math.sin(heading / 2), math.cos(heading / 2)
