"""Outputs: the topics that a node publishes of every update, one function a topic that makes its message.

To add an output, write its function and its row in OUTPUTS; a message type that is new goes to messages.py.

One robot's messages, in which only stamps and numbers change, have a fast CDR of their own. rosbags encodes or decodes
the first message; for the later ones only the bytes of its stamps and numbers are exchanged, which is several times as
fast.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field, model_validator

from omnibench.config import Model
from omnibench.live.wire.messages import (
    JOINT_STATE,
    ODOMETRY,
    PLANAR_INDICES,
    TRANSFORMS,
    JointState,
    MessageType,
    Odometry,
    Transform,
)
from omnibench.robot.kinematics import Array, correction

_SECOND = 1_000_000_000
_STAMP_AT = 4  # byte at which the stamp begins: after the CDR header
_NUMBERS = 7 + 36 + 6 + 36  # float64 values at the end of an Odometry: pose, covariance, twist, covariance
_TWIST = 7 + 36  # index of the twist among these
_POSE_COVARIANCE = 7 + PLANAR_INDICES
_TWIST_COVARIANCE = _TWIST + 6 + PLANAR_INDICES


class OdometryEncoder:
    """Encodes odometry with constant frames into the same bytes as ``ODOMETRY.encode``."""

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
    """Encodes transforms between constant frames into the same bytes as ``TRANSFORMS.encode``."""

    def __init__(self, frames: Sequence[tuple[str, str]]) -> None:
        marks = [Transform((index + 1) * _SECOND, *pair, np.zeros(3)) for index, pair in enumerate(frames)]
        self._buffer = bytearray(TRANSFORMS.encode(marks))
        self._stamps: list[int] = []
        self._poses: list[Array] = []
        place = _STAMP_AT
        for index in range(len(frames)):
            place = self._buffer.index(struct.pack("<iI", index + 1, 0), place)
            # an identity rotation ends with the values 0, 0, 1, which are the last of the pose's seven
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
    """Decodes one sender's wheel messages, with constant joint names, to the same as ``JOINT_STATE.decode``."""

    def __init__(self) -> None:
        self._length = -1
        self._constant: tuple[tuple[slice, bytes], ...] = ()  # the parts of a payload that do not change
        self._template: JointState | None = None
        self._positions = self._velocities = 0  # bytes at which they begin; 0: there are none
        self._joints = 0

    def decode(self, payload: bytes) -> JointState:
        """The message in a payload. MessageError: as from ``JOINT_STATE.decode``."""
        template = self._template
        if template is None or len(payload) != self._length or any(payload[at] != part for at, part in self._constant):
            return self._learn(payload)
        seconds, nanoseconds = struct.unpack_from("<iI", payload, _STAMP_AT)
        if nanoseconds >= _SECOND:
            return self._learn(payload)  # raises MessageError
        count, positions, velocities = self._joints, self._positions, self._velocities
        return JointState(
            seconds * _SECOND + nanoseconds,
            template.names,
            np.frombuffer(payload, "<f8", count, positions) if positions else None,
            np.frombuffer(payload, "<f8", count, velocities) if velocities else None,
            template.frame,
        )

    def _learn(self, payload: bytes) -> JointState:
        """Decode by rosbags and remember where the numbers are, if the message has no efforts."""
        message = JOINT_STATE.decode(payload)
        self._template = None
        count = len(message.names)
        place = len(payload) - 4  # where the number of efforts begins
        numbers_given = count and (message.positions is not None or message.velocities is not None)
        if payload[:4] != b"\x00\x01\x00\x00" or payload[place:] != bytes(4) or not numbers_given:
            return message
        size = 8 * count
        self._velocities = self._positions = 0
        end = (
            place - 4
        )  # end of the positions: their successor, the number of velocities, takes 4 bytes if there are none
        if message.velocities is not None:
            self._velocities = place - size
            end = self._velocities - 8
        if message.positions is not None:
            self._positions = end - size
        changing = [(_STAMP_AT, _STAMP_AT + 8)]
        changing += [(begin, begin + size) for begin in (self._positions, self._velocities) if begin]
        ends = [0, *(end for _, end in changing)]
        begins = [*(begin for begin, _ in changing), len(payload)]
        constant = (slice(*bounds) for bounds in zip(ends, begins, strict=True))
        self._constant = tuple((at, payload[at]) for at in constant)
        self._length, self._joints = len(payload), count
        self._template = message
        check = self.decode(payload)  # if this does not give the same, rosbags decodes the next message too
        for fast, general in ((check.positions, message.positions), (check.velocities, message.velocities)):
            if fast is not None and (general is None or fast.tobytes() != general.tobytes()):
                self._template = None
        return message


def _write_pose(numbers: Array, pose: Array) -> None:
    """Write a pose (3,) into the numbers x, y, z and quaternion, of which z, qx and qy stay 0."""
    numbers[0], numbers[1], heading = pose.tolist()
    numbers[5], numbers[6] = math.sin(heading / 2), math.cos(heading / 2)


FrameName = Annotated[str, Field(pattern=r"^[^\s/][^\s]*$", max_length=200)]


class Frames(Model):
    """map: the world as SLAM knows it. odom: where odometry started; it never jumps. base: the robot."""

    map: FrameName = "map"
    odom: FrameName = "odom"
    base: FrameName = "base_link"

    @model_validator(mode="after")
    def _differ(self) -> Frames:
        if len({self.map, self.odom, self.base}) < 3:
            raise ValueError(f"map, odom and base must differ: {self.map}, {self.odom}, {self.base}")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """Estimates after one wheel sample; poses (3,) in m, m, rad, twists (3,) in m/s, m/s, rad/s, covariances (3, 3).

    stamp: ns, never published before. pose, covariance: of the robot in odom. twist, twist_covariance: in the robot's
    frame. in_map: fused pose and its covariance; None without fusion.
    """

    stamp: int
    pose: Array
    covariance: Array
    twist: Array
    twist_covariance: Array
    in_map: tuple[Array, Array] | None = None


@dataclass(frozen=True)
class Output:
    """One topic that is published of every update.

    topic: below the robot's name. message: makes a message from an update. fused: only where SLAM poses are fused.
    encoder: makes, for a robot's frames, a function that encodes messages faster than ``message_type`` does.
    """

    topic: str
    message_type: MessageType[Any]
    message: Callable[[Update, Frames], Any]
    fused: bool = False
    encoder: Callable[[Frames], Callable[[Any], bytes]] | None = None

    def encoding(self, frames: Frames) -> Callable[[Update], bytes]:
        """The function from an update to its payload in CDR, for a robot with these frames."""
        message, encode = self.message, self.encoder(frames) if self.encoder else self.message_type.encode
        return lambda update: encode(message(update, frames))


def odometry(update: Update, frames: Frames) -> Odometry:
    """Pose in odom, which never jumps, and twist."""
    return Odometry(
        update.stamp, frames.odom, frames.base, update.pose, update.covariance, update.twist, update.twist_covariance
    )


def filtered_odometry(update: Update, frames: Frames) -> Odometry:
    """Pose in the map, fused with SLAM, and twist."""
    pose, covariance = _in_map(update)
    return Odometry(update.stamp, frames.map, frames.base, pose, covariance, update.twist, update.twist_covariance)


def transforms(update: Update, frames: Frames) -> tuple[Transform, Transform]:
    """From map to odom, and from odom to the robot."""
    pose, _ = _in_map(update)
    return (
        Transform(update.stamp, frames.map, frames.odom, correction(pose, update.pose)),
        Transform(update.stamp, frames.odom, frames.base, update.pose),
    )


OUTPUTS: Final = (
    Output(
        "odom",
        ODOMETRY,
        odometry,
        encoder=lambda frames: OdometryEncoder(frames.odom, frames.base).encode,
    ),
    Output(
        "odometry/filtered",
        ODOMETRY,
        filtered_odometry,
        fused=True,
        encoder=lambda frames: OdometryEncoder(frames.map, frames.base).encode,
    ),
    Output(
        "tf",
        TRANSFORMS,
        transforms,
        fused=True,
        encoder=lambda frames: TransformsEncoder(((frames.map, frames.odom), (frames.odom, frames.base))).encode,
    ),
)


def _in_map(update: Update) -> tuple[Array, Array]:
    if update.in_map is None:
        raise ValueError("this output needs fusion, and the update has no pose in the map")
    return update.in_map
