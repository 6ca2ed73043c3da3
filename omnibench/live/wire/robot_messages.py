"""CDR for one robot's own messages, of which only stamps and numbers change: several times as fast as in general.

The first message goes through rosbags; later ones are that one with other numbers in the same places.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import numpy as np

from omnibench.live.wire.messages import (
    JOINT_STATE,
    ODOMETRY,
    PLANAR_INDICES,
    TRANSFORMS,
    JointState,
    Odometry,
    Transform,
)
from omnibench.robot.kinematics import Array

_SECOND = 1_000_000_000
_STAMP_AT = 4  # bytes: after the CDR header
_NUMBERS = 7 + 36 + 6 + 36  # at the end of an Odometry: pose, its covariance, twist, its covariance
_TWIST = 7 + 36
_POSE_COVARIANCE = 7 + PLANAR_INDICES
_TWIST_COVARIANCE = _TWIST + 6 + PLANAR_INDICES


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


class JointStateDecoder:
    """Decodes the wheel messages of one sender, whose joints are always the same; as ``JOINT_STATE.decode`` does."""

    def __init__(self) -> None:
        self._length = -1
        self._known: tuple[tuple[slice, bytes], ...] = ()  # what does not change
        self._template: JointState | None = None
        self._positions = self._velocities = 0  # bytes to where they begin; 0: there are none
        self._joints = 0

    def decode(self, payload: bytes) -> JointState:
        """The message. MessageError says what is wrong of one that is none."""
        like = self._template
        if like is None or len(payload) != self._length or any(payload[at] != was for at, was in self._known):
            return self._learn(payload)
        seconds, nanoseconds = struct.unpack_from("<iI", payload, _STAMP_AT)
        if nanoseconds >= _SECOND:
            return self._learn(payload)  # which refuses it
        count, positions, velocities = self._joints, self._positions, self._velocities
        return JointState(
            seconds * _SECOND + nanoseconds,
            like.names,
            np.frombuffer(payload, "<f8", count, positions) if positions else None,
            np.frombuffer(payload, "<f8", count, velocities) if velocities else None,
            like.frame,
        )

    def _learn(self, payload: bytes) -> JointState:
        """Decode in general, and remember the places if nothing else stands at the end, as efforts would."""
        message = JOINT_STATE.decode(payload)
        self._template = None
        count = len(message.names)
        place = len(payload) - 4  # of the number of efforts
        numbers_given = count and (message.positions is not None or message.velocities is not None)
        if payload[:4] != b"\x00\x01\x00\x00" or payload[place:] != bytes(4) or not numbers_given:
            return message
        size = 8 * count
        self._velocities = self._positions = 0
        end = place - 4  # of what comes before the number of velocities, if there are none
        if message.velocities is not None:
            self._velocities = place - size
            end = self._velocities - 8
        if message.positions is not None:
            self._positions = end - size
        changing = [(_STAMP_AT, _STAMP_AT + 8)]
        changing += [(begin, begin + size) for begin in (self._positions, self._velocities) if begin]
        ends = [0, *(end for _, end in changing)]
        begins = [*(begin for begin, _ in changing), len(payload)]
        known = (slice(*each) for each in zip(ends, begins, strict=True))
        self._known = tuple((at, payload[at]) for at in known)
        self._length, self._joints = len(payload), count
        self._template = message
        again = self.decode(payload)  # by the places; they are right, or it is left to rosbags
        for mine, theirs in ((again.positions, message.positions), (again.velocities, message.velocities)):
            if mine is not None and (theirs is None or mine.tobytes() != theirs.tobytes()):
                self._template = None
        return message


def _write_pose(numbers: Array, pose: Array) -> None:
    """x, y, z and the quaternion."""
    numbers[0], numbers[1], heading = pose.tolist()
    numbers[5], numbers[6] = math.sin(heading / 2), math.cos(heading / 2)
