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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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


class MissedMessages:
    """Counts the messages that were published and did not come, by the gaps in each publisher's numbers.

    count: messages missed so far; one that comes after all is taken off again. Those before a publisher's first message
    to come are not missed. Messages without an attachment, of other programs, tell nothing.
    """

    def __init__(self) -> None:
        self.count = 0
        self._publishers: dict[bytes, tuple[int, set[int]]] = {}  # the highest number to come, those missing below it

    def take(self, attachment: zenoh.ZBytes | bytes | None) -> int | None:
        """The number of messages right before a new one that were published and have not come.

        None if the message is of an acknowledged flow and came before.
        """
        content = attachment.to_bytes() if isinstance(attachment, zenoh.ZBytes) else attachment or b""
        if not _is_numbered(content):
            return 0
        number, _, _, publisher = _HEAD.unpack_from(content)
        highest, missing = self._publishers.get(publisher, (number - 1, set()))
        if number > highest:
            gap = number - highest - 1
            self.count += gap
            missing.update(range(max(highest + 1, number - _MOST_MISSING), number))
            if len(missing) > _MOST_MISSING:
                missing = {each for each in missing if each >= number - _MOST_MISSING}
            self._publishers[publisher] = number, missing
            if len(self._publishers) > _MOST_PUBLISHERS:
                del self._publishers[next(iter(self._publishers))]
            return gap
        if number in missing:
            missing.remove(number)
            self.count -= 1
            return 0
        return 0 if len(content) == _HEAD.size else None  # only what is acknowledged is ever sent again


STORE: Final = get_typestore(Stores.ROS2_JAZZY)

PLANAR_INDICES = np.array([0, 1, 5, 6, 7, 11, 30, 31, 35])  # x, y and yaw in a 6 x 6 covariance's 36 elements
_OUT_OF_PLANE = np.zeros(36)  # covariance with the variances of z (m^2), roll and pitch (rad^2) only
_OUT_OF_PLANE[[14, 21, 28]] = 1e-9
_SECOND = 1_000_000_000  # ns
_LARGEST_TILT = math.radians(10.0)  # rad; a pose that is tilted more is no pose of a wheeled robot; chosen


class MessageError(DataError):
    """A message that is not of its topic's type, or whose values are impossible."""


def _make(name: str, *fields: Any) -> Any:
    """A ROS message of a type, by its fields in order."""
    return STORE.types[name](*fields)


def _header(stamp: int, frame: str) -> Any:
    return _make("std_msgs/msg/Header", _make("builtin_interfaces/msg/Time", *divmod(stamp, _SECOND)), frame)


def _stamp_and_frame(header: Any) -> tuple[int, str]:
    if header.stamp.nanosec >= _SECOND:
        raise MessageError(f"its stamp has {header.stamp.nanosec} ns within a second")
    return int(header.stamp.sec) * _SECOND + int(header.stamp.nanosec), header.frame_id


def _vector(kind: str, x: float, y: float, z: float) -> Any:
    return _make(f"geometry_msgs/msg/{kind}", float(x), float(y), float(z))


def _quaternion(heading: float) -> Any:
    return _make("geometry_msgs/msg/Quaternion", 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


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


def _with_covariance(kind: str, content: Any, covariance: Array) -> Any:
    """PoseWithCovariance or TwistWithCovariance."""
    full = _OUT_OF_PLANE.copy()
    full[PLANAR_INDICES] = np.ravel(covariance)
    return _make(f"geometry_msgs/msg/{kind}WithCovariance", content, full)


def _planar_covariance(message: Any) -> Array:
    return np.asarray(message.covariance[PLANAR_INDICES], dtype=float).reshape(3, 3)


def _pose_with_covariance(pose: Array, covariance: Array) -> Any:
    x, y, heading = pose.tolist()
    position = _vector("Point", x, y, 0.0)
    return _with_covariance("Pose", _make("geometry_msgs/msg/Pose", position, _quaternion(heading)), covariance)


def _planar_pose(message: Any) -> tuple[Array, Array]:
    """Pose (3,) and covariance (3, 3) of a PoseWithCovariance."""
    position, heading = message.pose.position, _heading(message.pose.orientation)
    return np.array([position.x, position.y, heading]), _planar_covariance(message)


@dataclass(frozen=True, slots=True, eq=False)
class JointState:
    """sensor_msgs/JointState. names (N,); positions (N,) rad and velocities (N,) rad/s, None if not sent."""

    stamp: int
    names: tuple[str, ...]
    positions: Array | None = None
    velocities: Array | None = None
    frame: str = ""

    def to_ros(self) -> Any:
        positions, velocities = (
            np.zeros(0) if values is None else np.ascontiguousarray(values, dtype=float)
            for values in (self.positions, self.velocities)
        )
        header = _header(self.stamp, self.frame)
        return _make("sensor_msgs/msg/JointState", header, list(self.names), positions, velocities, np.zeros(0))

    @classmethod
    def from_ros(cls, content: Any) -> JointState:
        names = tuple(content.name)
        for what, values in (("positions", content.position), ("velocities", content.velocity)):
            if len(values) not in (0, len(names)):
                raise MessageError(f"it has {len(names)} names and {len(values)} {what}")
        stamp, frame = _stamp_and_frame(content.header)
        positions, velocities = (each if len(each) else None for each in (content.position, content.velocity))
        return cls(stamp, names, positions, velocities, frame)


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """geometry_msgs/PoseWithCovarianceStamped. pose (3,), covariance (3, 3)."""

    stamp: int
    frame: str
    pose: Array
    covariance: Array

    def to_ros(self) -> Any:
        pose = _pose_with_covariance(self.pose, self.covariance)
        return _make("geometry_msgs/msg/PoseWithCovarianceStamped", _header(self.stamp, self.frame), pose)

    @classmethod
    def from_ros(cls, content: Any) -> PoseEstimate:
        return cls(*_stamp_and_frame(content.header), *_planar_pose(content.pose))


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

    @property
    def position_sigma(self) -> float:
        """Standard deviation of the position along an axis, m: the root of the mean of x's and y's variances."""
        return math.sqrt(max(float(self.pose_covariance[0, 0] + self.pose_covariance[1, 1]) / 2, 0.0))

    @property
    def heading_sigma(self) -> float:
        """Standard deviation of the heading, rad."""
        return math.sqrt(max(float(self.pose_covariance[2, 2]), 0.0))

    def to_ros(self) -> Any:
        vx, vy, w = self.twist.tolist()
        twist = _make("geometry_msgs/msg/Twist", _vector("Vector3", vx, vy, 0.0), _vector("Vector3", 0.0, 0.0, w))
        return _make(
            "nav_msgs/msg/Odometry",
            _header(self.stamp, self.frame),
            self.child_frame,
            _pose_with_covariance(self.pose, self.pose_covariance),
            _with_covariance("Twist", twist, self.twist_covariance),
        )

    @classmethod
    def from_ros(cls, content: Any) -> Odometry:
        head, pose = _stamp_and_frame(content.header), _planar_pose(content.pose)
        twist = content.twist.twist
        velocities = np.array([twist.linear.x, twist.linear.y, twist.angular.z])
        return cls(*head, content.child_frame_id, *pose, velocities, _planar_covariance(content.twist))


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """One transform of a tf2_msgs/TFMessage: pose (3,) of ``child_frame`` in ``frame``."""

    stamp: int
    frame: str
    child_frame: str
    pose: Array

    def to_ros(self) -> Any:
        x, y, heading = self.pose.tolist()
        transform = _make("geometry_msgs/msg/Transform", _vector("Vector3", x, y, 0.0), _quaternion(heading))
        header = _header(self.stamp, self.frame)
        return _make("geometry_msgs/msg/TransformStamped", header, self.child_frame, transform)

    @classmethod
    def from_ros(cls, content: Any) -> Transform:
        moved, heading = content.transform.translation, _heading(content.transform.rotation)
        return cls(*_stamp_and_frame(content.header), content.child_frame_id, np.array([moved.x, moved.y, heading]))


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """One status of a diagnostic_msgs/DiagnosticArray. level: 0 ok, 1 warn, 2 error, 3 stale."""

    name: str
    level: int
    message: str
    hardware: str
    values: tuple[tuple[str, str], ...]

    def to_ros(self) -> Any:
        values = [_make("diagnostic_msgs/msg/KeyValue", *pair) for pair in self.values]
        texts = self.name, self.message, self.hardware
        return _make("diagnostic_msgs/msg/DiagnosticStatus", self.level, *texts, values)

    @classmethod
    def from_ros(cls, content: Any) -> Diagnostic:
        values = tuple((pair.key, pair.value) for pair in content.values)
        return cls(content.name, int(content.level), content.message, content.hardware_id, values)


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """diagnostic_msgs/DiagnosticArray."""

    stamp: int
    statuses: tuple[Diagnostic, ...]

    def to_ros(self) -> Any:
        statuses = [status.to_ros() for status in self.statuses]
        return _make("diagnostic_msgs/msg/DiagnosticArray", _header(self.stamp, ""), statuses)

    @classmethod
    def from_ros(cls, content: Any) -> Diagnostics:
        stamp, _ = _stamp_and_frame(content.header)
        return cls(stamp, tuple(Diagnostic.from_ros(status) for status in content.status))


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


JOINT_STATE: Final = MessageType("sensor_msgs/msg/JointState", JointState.to_ros, JointState.from_ros)
POSE_ESTIMATE: Final = MessageType(
    "geometry_msgs/msg/PoseWithCovarianceStamped", PoseEstimate.to_ros, PoseEstimate.from_ros
)
ODOMETRY: Final = MessageType("nav_msgs/msg/Odometry", Odometry.to_ros, Odometry.from_ros)
TRANSFORMS: Final = MessageType[Sequence[Transform]](
    "tf2_msgs/msg/TFMessage",
    lambda transforms: _make("tf2_msgs/msg/TFMessage", [each.to_ros() for each in transforms]),
    lambda content: tuple(Transform.from_ros(each) for each in content.transforms),
)
DIAGNOSTICS: Final = MessageType("diagnostic_msgs/msg/DiagnosticArray", Diagnostics.to_ros, Diagnostics.from_ros)
