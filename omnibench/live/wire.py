"""ROS 2 messages as typed planar objects, to and from CDR (rosbags serialises).

Poses are (x, y, heading) in m, m, rad; twists (vx, vy, w) in m/s, m/s, rad/s in the child frame; stamps are ns.
A planar covariance (3, 3) fills the x, y and yaw entries of ROS 2's 6 x 6 matrix; the variances of z, roll and pitch
are 1e-9 there, so that the matrix can be inverted.

The attachment of a message: its number and its publisher, by which receivers can tell what they missed.

Its 33 bytes are those of rmw_zenoh: number, time of publishing (ns), and the publisher's identity of 16 bytes. Messages
whose delivery is acknowledged add 25 bytes, which ROS 2 passes over: the flow's identity, the message's number in the
flow, the lowest number that the sender has no acknowledgement of, and whether the message was sent before.
"""

from __future__ import annotations

import math
import struct
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar

import numpy as np
import zenoh
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

_HEAD: Final = struct.Struct("<qqB16s")
_IDENTITY_LENGTH: Final = 16  # bytes
_FLOW: Final = struct.Struct("<QQQ?")
_MOST_PUBLISHERS: Final = 1000  # whose numbers are remembered; the first to come are forgotten; chosen
_MOST_MISSING: Final = 10_000  # numbers of a publisher that may still come; chosen

Flow = tuple[int, int, int, bool]
"""A flow's identity, a message's number in it, the lowest number not acknowledged, and if it was sent before."""


def packed(number: int, publisher: bytes, flow: Flow | None = None) -> bytes:
    """The attachment of a message that is published now. publisher: its identity, 16 bytes."""
    head = _HEAD.pack(number, time.time_ns(), _IDENTITY_LENGTH, publisher)
    return head if flow is None else head + _FLOW.pack(*flow)


def flow_of(attachment: bytes | None) -> Flow | None:
    """A message's place in its flow; None if its delivery is not acknowledged."""
    if attachment is None or len(attachment) != _HEAD.size + _FLOW.size or not _is_numbered(attachment):
        return None
    flow, number, unacknowledged, again = _FLOW.unpack_from(attachment, _HEAD.size)
    return flow, number, unacknowledged, again


def _is_numbered(attachment: bytes) -> bool:
    """True for an attachment of rmw_zenoh's form, with a flow or without; those of other programs tell nothing."""
    return len(attachment) in (_HEAD.size, _HEAD.size + _FLOW.size) and attachment[16] == _IDENTITY_LENGTH


@dataclass(slots=True)
class _Numbers:
    """Numbers of one publisher: the highest that came, and those below it that did not, in increasing order."""

    highest: int
    missing: OrderedDict[int, None] = field(default_factory=OrderedDict)


class MissedMessages:
    """Counts the messages that were published and did not come, by the gaps in each publisher's numbers.

    count: messages missed so far; one that comes after all is taken off again. Those before a publisher's first message
    to come are not missed. Messages without an attachment, of other programs, tell nothing.
    """

    def __init__(self) -> None:
        self.count = 0
        self._publishers: dict[bytes, _Numbers] = {}

    def take(self, attachment: zenoh.ZBytes | bytes | None) -> int | None:
        """The number of messages right before a new one that were published and have not come.

        None if the message is of an acknowledged flow and came before.
        """
        content = attachment.to_bytes() if isinstance(attachment, zenoh.ZBytes) else attachment or b""
        if not _is_numbered(content):
            return 0
        number, _, _, publisher = _HEAD.unpack_from(content)
        numbers = self._publishers.get(publisher)
        if numbers is None:
            self._publishers[publisher] = _Numbers(number)
            if len(self._publishers) > _MOST_PUBLISHERS:
                del self._publishers[next(iter(self._publishers))]
            return 0
        gap = number - numbers.highest - 1
        if gap >= 0:
            numbers.highest = number
            if gap:
                self.count += gap
                numbers.missing.update(dict.fromkeys(range(number - min(gap, _MOST_MISSING), number)))
                while len(numbers.missing) > _MOST_MISSING:
                    numbers.missing.popitem(last=False)
            return gap
        if number not in numbers.missing:
            return 0 if len(content) == _HEAD.size else None  # only what is acknowledged is ever sent again
        del numbers.missing[number]
        self.count -= 1
        return 0


STORE: Final = get_typestore(Stores.ROS2_JAZZY)

PLANAR_INDICES = np.array([0, 1, 5, 6, 7, 11, 30, 31, 35])  # x, y and yaw in a 6 x 6 covariance's 36 elements
_OUT_OF_PLANE = np.zeros(36)  # covariance with the variances of z (m^2), roll and pitch (rad^2) only
_OUT_OF_PLANE[[14, 21, 28]] = 1e-9
_SECOND = 1_000_000_000  # ns
_LARGEST_TILT = math.radians(10.0)  # rad; a pose that is tilted more is no pose of a wheeled robot; chosen


class MessageError(DataError):
    """A message that is not of its topic's type, or whose values are impossible."""


@dataclass(frozen=True, slots=True, eq=False)
class JointState:
    """sensor_msgs/JointState. names (N,); positions (N,) rad and velocities (N,) rad/s, None if not sent."""

    stamp: int
    names: tuple[str, ...]
    positions: Array | None = None
    velocities: Array | None = None
    frame: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """geometry_msgs/PoseWithCovarianceStamped. pose (3,), covariance (3, 3)."""

    stamp: int
    frame: str
    pose: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """nav_msgs/Odometry. pose (3,) of child_frame in frame, twist (3,) in child_frame; covariances (3, 3)."""

    stamp: int
    frame: str
    child_frame: str
    pose: Array
    pose_covariance: Array
    twist: Array
    twist_covariance: Array

    @property
    def seconds(self) -> float:
        """The stamp in s."""
        return self.stamp / _SECOND


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """One transform of a tf2_msgs/TFMessage: pose (3,) of ``child_frame`` in ``frame``."""

    stamp: int
    frame: str
    child_frame: str
    pose: Array


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """One status of a diagnostic_msgs/DiagnosticArray. level: 0 ok, 1 warn, 2 error, 3 stale."""

    name: str
    level: int
    message: str
    hardware: str
    values: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """diagnostic_msgs/DiagnosticArray."""

    stamp: int
    statuses: tuple[Diagnostic, ...]


_CLOCKS_APART: Final = time.time_ns() - time.monotonic_ns()  # ns, once: stamps by arrival never jump


def arrival_stamp(arrival: float) -> int:
    """The stamp (ns, unix time) of a message that came at a time of the monotonic clock, s."""
    return _CLOCKS_APART + round(arrival * _SECOND)


M = TypeVar("M")


@dataclass(frozen=True)
class MessageType(Generic[M]):
    """A ROS 2 message type with its conversion to and from one of the classes above.

    name: ROS 2's name of the type, as sensor_msgs/msg/JointState.
    """

    name: str
    _to_ros: Callable[[M], Any]
    _from_ros: Callable[[Any], M]

    @property
    def hash(self) -> str:
        """The type hash (REP-2011), RIHS01_..."""
        return STORE.hash_rihs01(self.name)

    @property
    def definition(self) -> str:
        """The definition with those of the types it contains, in the format ros2msg of recordings and Foxglove."""
        return STORE.generate_msgdef(self.name, ros_version=2)[0]

    def encode(self, message: M) -> bytes:
        """The message in CDR, little-endian, with its header of four bytes."""
        return bytes(STORE.serialize_cdr(self._to_ros(message), self.name))

    def decode(self, payload: bytes) -> M:
        """The message in a payload. MessageError: the payload is not of this type, or a value is impossible."""
        return self._from_ros(self.parse(payload))

    def parse(self, payload: bytes) -> Any:
        """The message in a payload as rosbags' object, values unchecked. MessageError: it is not of this type."""
        try:
            return STORE.deserialize_cdr(payload, self.name)  # checks that all bytes are used
        except (SerdeError, UnicodeError, ValueError, OverflowError, MemoryError) as error:
            raise MessageError(f"not a {self.name} of {len(payload)} bytes: {error}") from None


def _ros(name: str) -> Any:
    return STORE.types[name]


_Header, _Time = _ros("std_msgs/msg/Header"), _ros("builtin_interfaces/msg/Time")
_Point, _Vector, _Quaternion = (_ros(f"geometry_msgs/msg/{name}") for name in ("Point", "Vector3", "Quaternion"))
_Pose, _PoseCovariance = _ros("geometry_msgs/msg/Pose"), _ros("geometry_msgs/msg/PoseWithCovariance")
_Twist, _TwistCovariance = _ros("geometry_msgs/msg/Twist"), _ros("geometry_msgs/msg/TwistWithCovariance")
_Transform, _TransformStamped = _ros("geometry_msgs/msg/Transform"), _ros("geometry_msgs/msg/TransformStamped")
_Status, _KeyValue = _ros("diagnostic_msgs/msg/DiagnosticStatus"), _ros("diagnostic_msgs/msg/KeyValue")
_NOTHING = np.zeros(0)


def _header(stamp: int, frame: str) -> Any:
    return _Header(_Time(stamp // _SECOND, stamp % _SECOND), frame)


def _stamp(header: Any) -> int:
    if header.stamp.nanosec >= _SECOND:
        raise MessageError(f"its stamp has {header.stamp.nanosec} ns within a second")
    return int(header.stamp.sec) * _SECOND + int(header.stamp.nanosec)


def _quaternion(heading: float) -> Any:
    return _Quaternion(0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


def _heading(quaternion: Any) -> float:
    """The yaw of a quaternion, rad. MessageError: its length is not 1, or it tilts by more than _LARGEST_TILT."""
    x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not abs(length - 1) < 0.01:
        raise MessageError(f"its quaternion has length {length:.3g}, expected 1")
    upright = 1 - 2 * (x * x + y * y) / length**2
    if not upright > math.cos(_LARGEST_TILT):
        raise MessageError(f"its pose is tilted by {math.degrees(math.acos(max(upright, -1.0))):.0f} degrees")
    return math.atan2(2 * (w * z + x * y), length**2 - 2 * (y * y + z * z))


def _covariance_36(covariance: Array) -> Array:
    full = _OUT_OF_PLANE.copy()
    full[PLANAR_INDICES] = np.ravel(covariance)
    return full


def _plane_pose(pose: Any) -> Array:
    return np.array([pose.position.x, pose.position.y, _heading(pose.orientation)])


def _plane_covariance(covariance: Array) -> Array:
    return np.asarray(covariance[PLANAR_INDICES], dtype=float).reshape(3, 3)


def _ros_pose(pose: Array) -> Any:
    x, y, heading = pose.tolist()
    return _Pose(_Point(x, y, 0.0), _quaternion(heading))


def _joint_state_to_ros(message: JointState) -> Any:
    positions = _NOTHING if message.positions is None else np.ascontiguousarray(message.positions, dtype=float)
    velocities = _NOTHING if message.velocities is None else np.ascontiguousarray(message.velocities, dtype=float)
    return _ros("sensor_msgs/msg/JointState")(
        _header(message.stamp, message.frame), list(message.names), positions, velocities, _NOTHING
    )


def _joint_state_from_ros(content: Any) -> JointState:
    names = tuple(content.name)
    for what, values in (("positions", content.position), ("velocities", content.velocity)):
        if len(values) not in (0, len(names)):
            raise MessageError(f"it has {len(names)} names and {len(values)} {what}")
    return JointState(
        _stamp(content.header),
        names,
        content.position if len(content.position) else None,
        content.velocity if len(content.velocity) else None,
        content.header.frame_id,
    )


def _pose_to_ros(message: PoseEstimate) -> Any:
    return _ros("geometry_msgs/msg/PoseWithCovarianceStamped")(
        _header(message.stamp, message.frame),
        _PoseCovariance(_ros_pose(message.pose), _covariance_36(message.covariance)),
    )


def _pose_from_ros(content: Any) -> PoseEstimate:
    return PoseEstimate(
        _stamp(content.header),
        content.header.frame_id,
        _plane_pose(content.pose.pose),
        _plane_covariance(content.pose.covariance),
    )


def _odometry_to_ros(message: Odometry) -> Any:
    vx, vy, w = message.twist.tolist()
    return _ros("nav_msgs/msg/Odometry")(
        _header(message.stamp, message.frame),
        message.child_frame,
        _PoseCovariance(_ros_pose(message.pose), _covariance_36(message.pose_covariance)),
        _TwistCovariance(_Twist(_Vector(vx, vy, 0.0), _Vector(0.0, 0.0, w)), _covariance_36(message.twist_covariance)),
    )


def _odometry_from_ros(content: Any) -> Odometry:
    twist = content.twist.twist
    return Odometry(
        _stamp(content.header),
        content.header.frame_id,
        content.child_frame_id,
        _plane_pose(content.pose.pose),
        _plane_covariance(content.pose.covariance),
        np.array([twist.linear.x, twist.linear.y, twist.angular.z]),
        _plane_covariance(content.twist.covariance),
    )


def _transforms_to_ros(transforms: Sequence[Transform]) -> Any:
    return _ros("tf2_msgs/msg/TFMessage")(
        [
            _TransformStamped(
                _header(transform.stamp, transform.frame),
                transform.child_frame,
                _Transform(
                    _Vector(float(transform.pose[0]), float(transform.pose[1]), 0.0),
                    _quaternion(float(transform.pose[2])),
                ),
            )
            for transform in transforms
        ]
    )


def _transforms_from_ros(content: Any) -> tuple[Transform, ...]:
    return tuple(
        Transform(
            _stamp(item.header),
            item.header.frame_id,
            item.child_frame_id,
            np.array(
                [
                    item.transform.translation.x,
                    item.transform.translation.y,
                    _heading(item.transform.rotation),
                ]
            ),
        )
        for item in content.transforms
    )


def _diagnostics_to_ros(message: Diagnostics) -> Any:
    statuses = [
        _Status(
            status.level, status.name, status.message, status.hardware, [_KeyValue(*pair) for pair in status.values]
        )
        for status in message.statuses
    ]
    return _ros("diagnostic_msgs/msg/DiagnosticArray")(_header(message.stamp, ""), statuses)


def _diagnostics_from_ros(content: Any) -> Diagnostics:
    statuses = tuple(
        Diagnostic(
            status.name,
            int(status.level),
            status.message,
            status.hardware_id,
            tuple((pair.key, pair.value) for pair in status.values),
        )
        for status in content.status
    )
    return Diagnostics(_stamp(content.header), statuses)


JOINT_STATE: Final = MessageType[JointState]("sensor_msgs/msg/JointState", _joint_state_to_ros, _joint_state_from_ros)
POSE_ESTIMATE: Final = MessageType[PoseEstimate](
    "geometry_msgs/msg/PoseWithCovarianceStamped", _pose_to_ros, _pose_from_ros
)
ODOMETRY: Final = MessageType[Odometry]("nav_msgs/msg/Odometry", _odometry_to_ros, _odometry_from_ros)
TRANSFORMS: Final = MessageType[Sequence[Transform]]("tf2_msgs/msg/TFMessage", _transforms_to_ros, _transforms_from_ros)
DIAGNOSTICS: Final = MessageType[Diagnostics](
    "diagnostic_msgs/msg/DiagnosticArray", _diagnostics_to_ros, _diagnostics_from_ros
)
