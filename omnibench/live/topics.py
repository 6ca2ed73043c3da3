"""The Zenoh keys of a robot's topics, in three profiles for other programs.

plain: the key is the topic's name, as the DDS bridge (zenoh-bridge-ros2dds) maps it. rmw: keys and liveliness tokens of
a ROS 2 node on rmw_zenoh; without tokens ``ros2 topic list`` would not show the topic. humble: rmw with Humble's
placeholder for type hashes. Messages of all profiles carry rmw_zenoh's attachment, without which ROS 2 would drop them.

Outputs: the topics that a node publishes of every update, one function a topic that makes its message.

To add an output, write its function and its row in OUTPUTS; a message type that is new goes to wire.py.

Wheel samples and odometry, the two that come at the wheels' rate, have a fast CDR of their own: rosbags decodes or
encodes the first message, and the later ones differ from it in stamps and numbers only.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from threading import Lock
from typing import Annotated, Any, Final, Generic, Literal, TypeVar

import numpy as np
import xxhash
import zenoh
from pydantic import Field, model_validator

from omnibench.config import Model
from omnibench.errors import require_choice
from omnibench.live import wire
from omnibench.live.presence import checked_robot
from omnibench.live.stopping import direct
from omnibench.robot.kinematics import Array, correction

_SECOND = 1_000_000_000
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"  # the CDR header
_STAMP = struct.Struct("<iI")
_STAMP_AT = 4  # byte at which the stamp begins: after the CDR header
_NUMBERS = 7 + 36 + 6 + 36  # float64 values at the end of an Odometry: pose, covariance, twist, covariance
_TWIST = 7 + 36  # index of the twist among these
_POSE_COVARIANCE = 7 + wire.PLANAR_INDICES
_TWIST_COVARIANCE = _TWIST + 6 + wire.PLANAR_INDICES


class OdometryEncoder:
    """Encodes odometry with constant frames into the same bytes as ``ODOMETRY.encode``."""

    def __init__(self, frame: str, child_frame: str) -> None:
        zeros = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
        self._buffer = bytearray(wire.ODOMETRY.encode(wire.Odometry(0, frame, child_frame, *zeros)))
        begin = len(self._buffer) - 8 * _NUMBERS
        self._numbers = np.frombuffer(self._buffer, "<f8", _NUMBERS, begin)

    def encode(self, message: wire.Odometry) -> bytes:
        """The message in CDR."""
        _STAMP.pack_into(self._buffer, _STAMP_AT, *divmod(message.stamp, _SECOND))
        numbers = self._numbers
        numbers[0], numbers[1], heading = message.pose.tolist()
        numbers[5], numbers[6] = math.sin(heading / 2), math.cos(heading / 2)
        numbers[_POSE_COVARIANCE] = message.pose_covariance.ravel()
        numbers[_TWIST], numbers[_TWIST + 1], numbers[_TWIST + 5] = message.twist.tolist()
        numbers[_TWIST_COVARIANCE] = message.twist_covariance.ravel()
        return bytes(self._buffer)


class JointStateDecoder:
    """Decodes one sender's wheel messages, with constant joint names, to the same as ``JOINT_STATE.decode``."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._frame = ""
        self._constant = b""  # of the last message that rosbags decoded, from its stamp's end: frame and joint names

    def decode(self, payload: bytes) -> wire.JointState:
        """The message in a payload. MessageError: as from ``JOINT_STATE.decode``."""
        begin = _STAMP_AT + _STAMP.size
        at = begin + len(self._constant)
        if self._constant and payload.startswith(_LITTLE_ENDIAN) and payload.startswith(self._constant, begin):
            seconds, nanoseconds = _STAMP.unpack_from(payload, _STAMP_AT)
            sequences: list[Array | None] = []  # positions, velocities, efforts
            for _ in range(3):
                if at + 4 > len(payload):
                    break
                length = int.from_bytes(payload[at : at + 4], "little")
                at += 4
                if not length:
                    sequences.append(None)
                    continue
                at += -(at - _STAMP_AT) % 8
                if length != len(self._names) or at + 8 * length > len(payload):
                    break
                sequences.append(np.frombuffer(payload, "<f8", length, at))
                at += 8 * length
            if len(sequences) == 3 and at == len(payload) and nanoseconds < _SECOND:
                positions, velocities, _ = sequences
                return wire.JointState(seconds * _SECOND + nanoseconds, self._names, positions, velocities, self._frame)
        message = wire.JOINT_STATE.decode(payload)
        self._names, self._frame = message.names, message.frame
        bare = wire.JOINT_STATE.encode(wire.JointState(0, message.names, frame=message.frame))
        self._constant = bare[begin:-12]  # without the three lengths of its sequences
        return message


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
    frame: the field of Frames in which it is, for odometry, which is encoded faster then.
    """

    topic: str
    message_type: wire.MessageType[Any]
    message: Callable[[Update, Frames], Any]
    fused: bool = False
    frame: Literal["odom", "map"] | None = None

    def encoding(self, frames: Frames) -> Callable[[Update], bytes]:
        """The function from an update to its payload in CDR, for a robot with these frames."""
        message, encode = self.message, self.message_type.encode
        if self.frame:
            encode = OdometryEncoder(getattr(frames, self.frame), frames.base).encode
        return lambda update: encode(message(update, frames))


def odometry(update: Update, frames: Frames) -> wire.Odometry:
    """Pose in odom, which never jumps, and twist."""
    return wire.Odometry(
        update.stamp, frames.odom, frames.base, update.pose, update.covariance, update.twist, update.twist_covariance
    )


def filtered_odometry(update: Update, frames: Frames) -> wire.Odometry:
    """Pose in the map, fused with SLAM, and twist."""
    pose, covariance = _in_map(update)
    return wire.Odometry(update.stamp, frames.map, frames.base, pose, covariance, update.twist, update.twist_covariance)


def transforms(update: Update, frames: Frames) -> tuple[wire.Transform, wire.Transform]:
    """From map to odom, and from odom to the robot."""
    pose, _ = _in_map(update)
    return (
        wire.Transform(update.stamp, frames.map, frames.odom, correction(pose, update.pose)),
        wire.Transform(update.stamp, frames.odom, frames.base, update.pose),
    )


OUTPUTS: Final = (
    Output("odom", wire.ODOMETRY, odometry, frame="odom"),
    Output("odometry/filtered", wire.ODOMETRY, filtered_odometry, fused=True, frame="map"),
    Output("tf", wire.TRANSFORMS, transforms, fused=True),
)


def _in_map(update: Update) -> tuple[Array, Array]:
    if update.in_map is None:
        raise ValueError("this output needs fusion, and the update has no pose in the map")
    return update.in_map


Profile = Literal["plain", "rmw", "humble"]
M = TypeVar("M")

INPUTS: Final = ("joint_states", "slam_pose")  # the topics that a node receives; it publishes the others
# A robot's topics, below its name, and their message types; all robots share tf.
TOPICS: Final[dict[str, wire.MessageType[Any]]] = {
    "joint_states": wire.JOINT_STATE,
    "slam_pose": wire.POSE_ESTIMATE,
    **{output.topic: output.message_type for output in OUTPUTS},
    "diagnostics": wire.DIAGNOSTICS,
}

_QOS = "::,10:,:,:,,"  # rmw_zenoh's code of: reliable, volatile, depth 10
_HASH_OF_HUMBLE = "TypeHashNotSupported"
_ENTITIES = count()  # numbers of this process's nodes, publishers and subscribers


def topic_name(robot: str, topic: str) -> str:
    """The ROS 2 name of a robot's topic without its leading slash: ``apr02/odom``; ``tf`` has no robot's name."""
    return topic if topic == "tf" else f"{robot}/{topic}"


def dds_name(message_type: wire.MessageType[Any]) -> str:
    """A type's name as rmw_zenoh writes it: nav_msgs::msg::dds_::Odometry_ of nav_msgs/msg/Odometry."""
    package, kind, name = message_type.name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


class KeySpace:
    """The keys of one profile and ROS domain."""

    def __init__(self, profile: Profile = "plain", domain: int = 0) -> None:
        self.profile: Profile = profile
        self.domain = domain

    def key(self, robot: str, topic: str) -> str:
        """The key to which a robot's topic is published."""
        name, kind = topic_name(robot, topic), TOPICS[topic]
        return name if self.profile == "plain" else f"{self.domain}/{name}/{dds_name(kind)}/{self.type_hash(kind)}"

    def expression(self, robot: str, topic: str) -> str:
        """The key expression that matches a robot's topic with any version of its type."""
        name, kind = topic_name(robot, topic), TOPICS[topic]
        return name if self.profile == "plain" else f"{self.domain}/{name}/{dds_name(kind)}/*"

    def type_hash(self, message_type: wire.MessageType[Any]) -> str:
        """The type hash in keys and tokens."""
        return _HASH_OF_HUMBLE if self.profile == "humble" else message_type.hash


class GraphNode:
    """Makes a session's publishers and subscribers, and the session a node of the ROS graph if the profile has one.

    Closing the session undeclares all of them. name: the node's name, as ``ros2 node list`` shows it.
    """

    def __init__(self, session: zenoh.Session, keys: KeySpace, name: str) -> None:
        self.session = session
        self.keys = keys
        self._name = name
        self._tokens: list[zenoh.LivelinessToken] = []  # kept, because a token without a reference is undeclared
        self._token("NN", next(_ENTITIES))

    def publisher(self, robot: str, topic: str, *, lossless: bool = False) -> Publisher[Any]:
        """A publisher of a robot's topic."""
        token = self._token("MP", next(_ENTITIES), robot, topic)
        return Publisher(self.session, TOPICS[topic], self.keys.key(robot, topic), token, lossless=lossless)

    def subscribe(self, robot: str, topic: str, callback: Callable[[zenoh.Sample], None]) -> zenoh.Subscriber[None]:
        """Call ``callback`` with each sample of a robot's topic, in Zenoh's thread: it must be quick."""
        self._token("MS", next(_ENTITIES), robot, topic)
        return self.session.declare_subscriber(self.keys.expression(robot, topic), direct(callback))

    def _token(self, kind: str, number: int, robot: str = "", topic: str = "") -> str:
        """Declare a liveliness token of rmw_zenoh, but in the profile ``plain``, and return its key."""
        zid = self.session.zid()
        key = f"@ros2_lv/{self.keys.domain}/{zid}/0/{number}/{kind}/%/%/{self._name}"
        if topic:
            message_type = TOPICS[topic]
            name = "%" + topic_name(robot, topic).replace("/", "%")
            key += f"/{name}/{dds_name(message_type)}/{self.keys.type_hash(message_type)}/{_QOS}"
        if self.keys.profile != "plain":
            self._tokens.append(self.session.liveliness().declare_token(key))
        return key


class Publisher(Generic[M]):
    """Publishes messages of one topic, numbered; a subscriber that is too slow loses messages and delays no other.

    token: the text by which its messages tell it from others. lossless: a slow subscriber delays the publisher, up to
    Zenoh's limit (5 s), instead of losing messages, for replays of recordings.
    """

    def __init__(
        self, session: zenoh.Session, message_type: wire.MessageType[M], key: str, token: str, *, lossless: bool = False
    ) -> None:
        self.message_type = message_type
        self.key = key
        self._publisher = session.declare_publisher(
            key,
            encoding=f"application/cdr;{message_type.name}",
            congestion_control=zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
        )
        self._numbers = count(1)
        # XXH3-128 hash of the token: the low 64 bits, then the high ones, little-endian
        self._identity = xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")

    @property
    def matched(self) -> bool:
        """True if the topic has a subscriber now."""
        status: Any = self._publisher.matching_status  # an object that is always true, against zenoh's stubs
        return bool(getattr(status, "matching", status))

    def put(self, message: M) -> None:
        """Encode and publish."""
        self.put_encoded(self.message_type.encode(message))

    def put_encoded(self, payload: bytes) -> None:
        """Publish a payload that is encoded already."""
        self.put_numbered(payload, self.next_number())

    def next_number(self) -> int:
        """The number of the next message, for ``put_numbered``."""
        return next(self._numbers)

    def put_numbered(self, payload: bytes, number: int, flow: wire.Flow | None = None) -> None:
        """Publish a payload under a number, a second time under the same. flow: its place, if it is acknowledged."""
        self._publisher.put(payload, attachment=wire.packed(number, self._identity, flow))


@dataclass(frozen=True, slots=True)
class Arrival:
    """A received message.

    name: its ROS 2 topic with the leading slash, /apr02/odom. topic: its key in TOPICS. time: ns of the system's clock
    at its arrival, never before the previous arrival's. payload: CDR.
    """

    name: str
    topic: str
    time: int
    payload: bytes


class TopicListener:
    """Calls ``consume`` with each message of the robots' topics, one at a time, in Zenoh's thread: it must be quick.

    topics: ROS 2 name -> key in TOPICS. A message that its sender sent again, and that came before, is left out.
    ConfigError: no such topic, or a robot's name is not valid.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: KeySpace,
        robots: Sequence[str],
        topics: Sequence[str],
        consume: Callable[[Arrival], None],
    ) -> None:
        self._consume = consume
        self._time = 0
        self._lock = Lock()
        for topic in topics:
            require_choice("topic", topic, TOPICS)
        pairs = ((checked_robot(robot), topic) for robot in robots for topic in topics)
        sources = {f"/{topic_name(robot, topic)}": (robot, topic) for robot, topic in pairs}
        self.topics = {name: topic for name, (_, topic) in sources.items()}  # all robots share tf
        self._missed = {name: wire.MissedMessages() for name in sources}
        self._subscribers: list[zenoh.Subscriber[None]] = []
        for name, (robot, topic) in sources.items():
            expression, take = keys.expression(robot, topic), partial(self._take, name, topic)
            self._subscribers.append(session.declare_subscriber(expression, direct(take)))

    @property
    def missed(self) -> dict[str, int]:
        """Messages that were published and did not come, by ROS 2 name; for publishers that number theirs."""
        return {name: messages.count for name, messages in self._missed.items() if messages.count}

    def close(self) -> None:
        """Stop listening; ``consume`` is not called after this."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        with self._lock:  # waits for a call of consume that is under way
            self._subscribers = []

    def _take(self, name: str, topic: str, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        payload = sample.payload.to_bytes()
        with self._lock:
            if self._missed[name].take(sample.attachment) is None:
                return
            self._time = max(self._time, time.time_ns())  # readers of recordings expect increasing times
            self._consume(Arrival(name, topic, self._time, payload))
