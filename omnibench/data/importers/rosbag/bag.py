"""Bags (MCAP, rosbag2 and ROS 1) read with rosbags: the importer's options, and the choice of topics by them.

Every fault is one line.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field, model_validator

from omnibench.config import NonNegative, Positive, read_yaml
from omnibench.data.importers.wheel_samples import EncoderOptions, Signs, WheelUnit
from omnibench.data.scans import Mount
from omnibench.data.splits import Names
from omnibench.errors import ConfigError, DataError, UnknownNameError
from omnibench.files import check_file
from omnibench.words import plural

Use = Literal["auto", "positions", "velocities"]


class RosbagOptions(EncoderOptions):
    """The robot, topics and joints, how the recording is cut into runs, and which of these train and validate."""

    group: ClassVar[str] = "Topics, joints and cuts"

    name: str = Field("rosbag", min_length=1, description="name of the data set")
    wheel_unit: WheelUnit = Field(
        "rad",
        description="of positions and (per second) velocities: rad, deg, rev, ticks; rpm; or increments rad/sample",
    )
    wheel_topic: Names = Field(
        (),
        description="sensor_msgs/JointState or std_msgs numbers, of all wheels or a list of one each; default: the "
        "only JointState, or the one ending in joint_states",
    )
    steering_topic: Names = Field((), description="of all steering angles, or a list of one each; default: the wheels'")
    pose_topic: str | None = Field(
        None,
        min_length=1,
        description="PoseWithCovarianceStamped, PoseStamped or TransformStamped, default: the only one, or the one "
        "ending in slam_pose; or, if independent of the wheels, Odometry or tf",
    )
    pose_frames: Names = Field((), description="with a tf pose_topic: frame of the reference, and the tracked one")
    pose_sigma: tuple[Positive, Positive] | None = Field(
        None,
        description="m and deg, standard deviations of poses whose covariance is unknown (0, negative, NaN, huge); "
        "default: if one is, no pose's counts",
    )
    references: Names = Field(
        (),
        description="sensor_msgs/NavSatFix and Imu that are references, as [/fix,/imu]; default: those that there are, "
        "where there are neither poses nor scans",
    )
    imu: Literal["auto", "gyro"] = Field(
        "auto", description="gyro: its rates of turn; auto: its headings, where it tells them (orientation)"
    )
    fix_sigma: Positive | None = Field(None, description="m, standard deviation of a fix; default: its covariance's")
    heading_sigma_deg: Positive | None = Field(
        None, description="deg, standard deviation of an Imu's heading; default: its covariance's"
    )
    gyro_noise_deg: Positive = Field(
        0.1, description="deg per sqrt(s), by which the angle of a gyro wanders; its offset at rest is taken off"
    )
    gyro_offset_deg: Positive | None = Field(
        None, description="deg/s, standard deviation of a gyro's offset where the robot never rests; else by its rests"
    )
    reference_period: Positive = Field(1.0, description="s; one fix, heading or turn is taken in each")
    scan_topic: str | None = Field(
        None, min_length=1, description="sensor_msgs/LaserScan; default: the only one, or the one ending in /scan"
    )
    scans: bool = Field(True, description="false: leave the scans out")
    scanner_mount: Mount | None = Field(
        None,
        description="x, y (m), yaw (rad) of the scanner on the robot; default: by /tf_static, else the robot's middle",
    )
    slam: dict[str, Any] = Field(
        {}, description="options of omnibench slam, for bags whose reference poses are made from their scans"
    )
    joints: Names = Field(
        (),
        description="in the robot's wheel order, or numbers of elements from 0; default: those called like the wheels",
    )
    joint_signs: Signs = Field((), description="-1 for joints that count the other way round")
    steering_joints: Names = Field((), description="in the order of the wheels that steer; default: by their names")
    recorded_stamps: Names = Field(
        (), description="topics whose header stamps are missing or by another clock: the times of recording count"
    )
    use: Use = Field("auto", description="positions or velocities of the joints; auto: positions, if they are there")
    cut: Literal["rests", "topic", "windows", "none"] = Field(
        "rests", description="where one run ends and another begins"
    )
    least_rest: Positive = Field(0.5, description="s; shorter rests do not cut")
    rest_rate: Positive = Field(0.05, description="rad/s; wheels that turn slower, over least_rest, rest")
    least_run: NonNegative = Field(1.0, description="s; shorter drives are left out")
    cut_topic: str | None = Field(
        None, min_length=1, description="each message begins a run; a std_msgs/String names its command"
    )
    window: Positive | None = Field(None, description="s; length of the runs of cut: windows")

    @model_validator(mode="after")
    def _fits_together(self) -> RosbagOptions:
        self.require_one_each("joints", "joint_signs", "steering_joints")
        self.require_one_each("wheel_topic", "steering_topic", or_one=True)
        if not self.scans and (self.scan_topic is not None or self.scanner_mount is not None):
            raise ValueError("scans=false leaves the scans out; leave scan_topic and scanner_mount out, too")
        if len(set(self.joints)) < len(self.joints):
            raise ValueError("joints names one joint twice; name another one for each wheel")
        if isinstance(self.wraps_at, float) and self.use == "velocities":
            raise ValueError("wraps_at is for positions; leave it out with use=velocities")
        if self.quantity == {"positions": "rates", "velocities": "increments"}.get(self.use):
            raise ValueError(f"wheel_unit {self.wheel_unit} is not one of {self.use}; leave use out")
        if len(self.pose_frames) not in (0, 2):
            raise ValueError(f"pose_frames has {plural(len(self.pose_frames), 'value')}, expected 2: [world, robot]")
        for key, cut in (("cut_topic", "topic"), ("window", "windows")):
            if (getattr(self, key) is not None) != (self.cut == cut):
                raise ValueError(f"cut={cut} and {key} belong together; give both or none")
        return self

    @property
    def signs(self) -> Signs:
        return self.joint_signs

    @property
    def still(self) -> float:
        """Largest angle, rad, by which a resting wheel moves within ``least_rest`` s."""
        return self.rest_rate * self.least_rest


if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader


_SUFFIXES = (".mcap", ".db3", ".bag")
_METADATA = "metadata.yaml"
_REPAIR = {
    ".mcap": "if the recording broke off, `mcap recover` saves what is there",
    ".bag": "if the recording broke off, `rosbag reindex` saves what is there",
}


@dataclass(frozen=True)
class Topic:
    """A topic of a bag. type: as ``sensor_msgs/msg/JointState``, also where the bag writes it shorter.

    recorded: the times of recording count, not the stamps of the headers.
    """

    name: str
    type: str
    messages: int
    recorded: bool = False

    def __str__(self) -> str:
        return f"{self.name} ({self.type}, {plural(self.messages, 'message')})"


@dataclass(frozen=True)
class Record:
    """A recorded message. number: in its topic, from 1. logged: time of recording, ns. message: None if undecodable."""

    number: int
    logged: int
    message: Any


class Bag:
    """An open bag; see :func:`open_bag`."""

    def __init__(self, path: Path, reader: AnyReader, recorded: Sequence[str] = ()) -> None:
        self.path = path
        self._reader = reader
        counts: Counter[tuple[str, str]] = Counter()
        for connection in reader.connections:
            counts[connection.topic, _full_type(connection.msgtype)] += connection.msgcount
        self.topics = tuple(Topic(*names, count) for names, count in sorted(counts.items()))
        unstamped = {self.topic(name, "recorded_stamps").name for name in recorded}
        self.topics = tuple(replace(topic, recorded=topic.name in unstamped) for topic in self.topics)

    def topic(self, name: str, key: str) -> Topic:
        """The topic that the option ``key`` names, with or without its leading slash. UnknownNameError, DataError."""
        wanted = "/" + name.strip("/")
        named = [topic for topic in self.topics if "/" + topic.name.strip("/") == wanted]
        if not named:
            raise UnknownNameError("topic", name, {topic.name for topic in self.topics}, f"{self.path}: {key}")
        chosen = max(named, key=lambda topic: topic.messages)
        if chosen.messages == 0:
            raise DataError(f"{self.path}: {key}: topic {chosen.name} has no messages; record it, or name another one")
        return chosen

    def records(self, topic: Topic, first: int | None = None, last: int | None = None) -> Iterator[Record]:
        """The messages of a topic in the order in which they were recorded. DataError: the bag is damaged.

        first, last: times of recording, ns, between which messages are read; numbers then count from the first of
        these.
        """
        connections = [
            connection
            for connection in self._reader.connections
            if (connection.topic, _full_type(connection.msgtype)) == (topic.name, topic.type)
        ]
        number = 0
        with _damage_as_error(self.path):
            stop = None if last is None else last + 1
            for number, (connection, logged, data) in enumerate(self._reader.messages(connections, first, stop), 1):
                yield Record(number, logged, self._decoded(data, _full_type(connection.msgtype)))
        if first is None and last is None and number < topic.messages:  # an MCAP without its message indexes
            raise DataError(
                f"{self.path}: only {number} of {plural(topic.messages, 'message')} on {topic.name} can be found; "
                f"its index is damaged; {_repair(self.path)}"
            )

    def _decoded(self, data: bytes, kind: str) -> Any | None:
        try:
            return self._reader.deserialize(data, kind)
        except Exception:  # garbage fails in many ways
            return None


@contextmanager
def open_bag(path: Path, recorded: Sequence[str] = ()) -> Iterator[Bag]:
    """Open a bag for reading. DataError in one line: it is no bag, it is cut off, or it is damaged.

    recorded: names of topics of which the times of recording count. UnknownNameError: there is no such topic.
    """
    # Imported here, since they load slowly and `omnibench list` does without.
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if path.is_dir() and (path / _METADATA).exists():
        try:
            read_yaml(path / _METADATA)  # within limits, which rosbags has not
        except ConfigError as error:
            raise DataError(str(error)) from None
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not file.is_dir():
            check_file(file)
    with _damage_as_error(path):
        # Bags before ROS 2 Iron do not hold the definitions of their types; those used here never changed.
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    try:
        yield Bag(path, reader, recorded)
    finally:
        reader.close()


def find_bags(source: Path) -> dict[str, Path]:
    """Bags by name: the file or rosbag2 folder ``source``, or all bags below the folder ``source``. DataError."""
    if source.is_file() or (source / _METADATA).is_file():
        return {source.resolve().stem if source.is_file() else source.resolve().name: source}
    if not source.is_dir():
        raise DataError(f"{source}: no such file or folder")
    folders = [file.parent for file in source.rglob(_METADATA)]
    files = [file for file in source.rglob("*") if file.suffix in _SUFFIXES and file.is_file()]
    bags = [*folders, *(file for file in files if not any(file.is_relative_to(folder) for folder in folders))]
    if not bags:
        raise DataError(f"{source}: no bag below it; name an .mcap or .bag file, or the folder of a rosbag2 recording")
    return {_name(path, source): path for path in sorted(bags)}


def _name(path: Path, source: Path) -> str:
    relative = path.relative_to(source)
    return (relative if path.is_dir() else relative.with_suffix("")).as_posix()


def _full_type(name: str) -> str:
    package, _, rest = name.partition("/")
    return f"{package}/msg/{rest}" if rest and "/" not in rest else name


def _repair(path: Path) -> str:
    return _REPAIR.get(path.suffix, "if the recording broke off, `ros2 bag reindex` may repair it")


@contextmanager
def _damage_as_error(path: Path) -> Iterator[None]:
    """Turn any error of rosbags on a file that is no bag, or a damaged one, into a DataError."""
    try:
        yield
    except PermissionError:
        raise DataError(f"{path}: cannot be read: permission denied") from None
    except Exception as error:  # struct.error, TypeError, KeyError, ...: rosbags trusts what it reads
        reason = str(error) if type(error).__module__.startswith("rosbags.") else f"{type(error).__name__}: {error}"
        raise DataError(f"{path}: cannot be read as a bag: {reason.rstrip('.')}; {_repair(path)}") from None


JOINT_TYPES = ("sensor_msgs/msg/JointState",)
NUMBER_TYPES = tuple(
    f"std_msgs/msg/{sort}{array}"
    for array in ("", "MultiArray")
    for sort in ("Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64", "Float32", "Float64")
)
POSE_TYPES = (
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/TransformStamped",
)
ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
FIX, IMU = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
SENSOR_TYPES = (FIX, IMU)
SCAN_TYPES = ("sensor_msgs/msg/LaserScan",)
_REFERENCES = "poses, sensor_msgs/LaserScan, NavSatFix or Imu"
_NUMBERS = "std_msgs numbers (Int32, Float64MultiArray ...)"


@dataclass(frozen=True)
class JointTopics:
    """The topics of the wheels and, of robots that steer, of the steering angles: one of all, or one of each."""

    wheels: tuple[Topic, ...]
    steering: tuple[Topic, ...]


def joint_topics(bag: Bag, wheels: Sequence[str], steering: Sequence[str], steers: bool) -> JointTopics:
    """The topics that are named; else of the wheels the only JointState, or the only one that ends in joint_states.

    Steering angles come by the topic of the wheels if theirs is not named, and a robot ``steers``.
    """
    types = (*JOINT_TYPES, *NUMBER_TYPES)
    named = tuple(_named(bag, name, "wheel_topic", types, f"{JOINT_TYPES[0]} or {_NUMBERS}") for name in wheels)
    if not named:
        candidates = [topic for topic in bag.topics if topic.type in JOINT_TYPES]
        numbers = [topic for topic in bag.topics if topic.type in NUMBER_TYPES and topic.messages]
        if not candidates and numbers:
            raise ConfigError(
                f"{bag.path}: no topic of type {JOINT_TYPES[0]}; --set wheel_topic=NAME of plain numbers, or a list "
                f"of one for each wheel: {_listed(numbers)}"
            )
        named = (_only(bag, "wheel_topic", candidates, "joint_states", JOINT_TYPES),)
    angles = tuple(_named(bag, name, "steering_topic", types, f"{JOINT_TYPES[0]} or {_NUMBERS}") for name in steering)
    if steers and not angles and len(named) > 1:
        raise ConfigError(f"{bag.path}: every wheel has its own topic; --set steering_topic=[...], too")
    return JointTopics(named, (angles or named) if steers else ())


def scan_topic(bag: Bag, name: str | None, wheels: Topic) -> Topic | None:
    """The topic of the scans: the one named, the only one, or the only one that ends in /scan; None: there is none.

    Among several that do, the one of the wheels' namespace.
    """
    if name is not None:
        return _named(bag, name, "scan_topic", SCAN_TYPES)
    candidates = [topic for topic in bag.topics if topic.type in SCAN_TYPES and topic.messages]
    return _only(bag, "scan_topic", candidates, "/scan", SCAN_TYPES, wheels) if candidates else None


def sensor_topics(bag: Bag, names: Sequence[str]) -> tuple[Topic, ...]:
    """The topics of fixes and inertial sensors: those that are named, else the only one of each type, if any.

    ConfigError: there are several of a type.
    """
    if names:
        return tuple(_named(bag, name, "references", SENSOR_TYPES) for name in names)
    by_type = [[topic for topic in bag.topics if topic.type == kind and topic.messages] for kind in SENSOR_TYPES]
    if several := next((topics for topics in by_type if len(topics) > 1), None):
        shown = ",".join(topic.name for topic in several[:1])
        raise ConfigError(
            f"{bag.path}: several topics could be the reference: {_listed(several)}; say which: "
            f"--set references=[{shown}]"
        )
    return tuple(topic for topics in by_type for topic in topics)


def has_sensors(bag: Bag) -> bool:
    """True if the bag holds fixes, or messages of an inertial sensor."""
    return any(topic.type in SENSOR_TYPES and topic.messages for topic in bag.topics)


def pose_topic(
    bag: Bag, name: str | None, wheels: Topic, scans: Topic | None = None, *, sensors: bool = False
) -> Topic | None:
    """The topic of the reference poses: the one named, the only one, or the only one that ends in slam_pose.

    Among several that do, the one of the wheels' namespace. Odometry and transforms are never taken unasked: a
    calibration against the robot's own odometry would find nothing wrong. None: there is none, but there are ``scans``,
    from which poses can be made, or ``sensors``, which are references themselves.
    """
    types = (*POSE_TYPES, ODOMETRY, TRANSFORMS)
    if name is not None:
        return _named(bag, name, "pose_topic", types)
    candidates = [topic for topic in bag.topics if topic.type in POSE_TYPES]
    references = [
        topic
        for topic in candidates
        if topic.messages and {"odom", "odometry"}.isdisjoint(re.split(r"[^a-z]+", topic.name.lower()))
    ]
    if not references and (scans is not None or sensors):
        return None
    others = [
        topic
        for topic in bag.topics
        if topic.type in types
        and topic.messages
        and not (topic.type == TRANSFORMS and topic.name.endswith("tf_static"))
    ]
    if not references and others:
        raise ConfigError(
            f"{bag.path}: the only poses are {_listed(others)}, by name or type the robot's own odometry and not a "
            "reference for it; if one is independent of the wheels, set pose_topic to it, or record a reference: "
            f"{_REFERENCES}"
        )
    return _only(bag, "pose_topic", references or candidates, "slam_pose", POSE_TYPES, wheels)


def _named(bag: Bag, name: str, key: str, types: Sequence[str], words: str = "") -> Topic:
    topic = bag.topic(name, key)
    if topic.type not in types:
        found = _listed([each for each in bag.topics if each.type in types])
        expected = words or _either(types)
        raise ConfigError(f"{bag.path}: {key}: {topic.name} is {topic.type}, expected {expected}; found: {found}")
    return topic


def _only(
    bag: Bag, key: str, candidates: Sequence[Topic], ending: str, types: Sequence[str], wheels: Topic | None = None
) -> Topic:
    """The only topic with messages, or the only one of them with this ending, at best in the wheels' namespace."""
    if not candidates:
        known = ", ".join(map(str, bag.topics)) or "none"
        others = f", nor another reference ({_REFERENCES})" if key == "pose_topic" else ""
        raise DataError(f"{bag.path}: no topic of type {_either(types)}{others}; topics found: {known}")
    filled = [topic for topic in candidates if topic.messages]
    if not filled:
        raise DataError(f"{bag.path}: {_listed(candidates)}: nothing was recorded on it")
    named = [topic for topic in filled if topic.name.endswith(ending)]
    beside = [topic for topic in named if wheels is not None and _space(topic) == _space(wheels)]
    for chosen in (beside, filled, named):
        if len(chosen) == 1:
            return chosen[0]
    raise ConfigError(f"{bag.path}: several topics could be the {key}; --set {key}=NAME, one of: {_listed(filled)}")


def _listed(topics: Sequence[Topic]) -> str:
    return ", ".join(map(str, topics)) or "none"


def _either(types: Sequence[str]) -> str:
    return " or ".join(types)


def _space(topic: Topic) -> str:
    return topic.name.strip("/").rpartition("/")[0]
