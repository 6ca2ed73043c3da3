"""Choice of a bag's topics for wheels, reference poses and scans."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from omnibench.data.importers.rosbag.bag import Bag, Topic
from omnibench.errors import ConfigError, DataError

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
    beside = [topic for topic in candidates if _ends_in(topic, "/scan") and _space(topic) == _space(wheels)]
    if len(beside) == 1:
        return beside[0]
    return _only(bag, "scan_topic", candidates, "/scan", SCAN_TYPES) if candidates else None


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
    references = [topic for topic in candidates if topic.messages and not _is_odometry(topic)]
    if not references and (scans is not None or sensors):
        return None
    others = [topic for topic in bag.topics if topic.type in types and topic.messages and not _is_fixed(topic)]
    if not references and others:
        raise ConfigError(
            f"{bag.path}: the only poses are {_listed(others)}, by name or type the robot's own odometry and not a "
            "reference for it; if one is independent of the wheels, set pose_topic to it, or record a reference: "
            f"{_REFERENCES}"
        )
    beside = [topic for topic in references if _ends_in(topic, "slam_pose") and _space(topic) == _space(wheels)]
    if len(beside) == 1:
        return beside[0]
    return _only(bag, "pose_topic", references or candidates, "slam_pose", POSE_TYPES)


def _named(bag: Bag, name: str, key: str, types: Sequence[str], words: str = "") -> Topic:
    topic = bag.topic(name, key)
    if topic.type not in types:
        found = _listed([each for each in bag.topics if each.type in types])
        expected = words or _either(types)
        raise ConfigError(f"{bag.path}: {key}: {topic.name} is {topic.type}, expected {expected}; found: {found}")
    return topic


def _only(bag: Bag, key: str, candidates: Sequence[Topic], ending: str, types: Sequence[str]) -> Topic:
    if not candidates:
        known = ", ".join(map(str, bag.topics)) or "none"
        others = f", nor another reference ({_REFERENCES})" if key == "pose_topic" else ""
        raise DataError(f"{bag.path}: no topic of type {_either(types)}{others}; topics found: {known}")
    filled = [topic for topic in candidates if topic.messages]
    if not filled:
        raise DataError(f"{bag.path}: {_listed(candidates)}: nothing was recorded on it")
    chosen = filled if len(filled) == 1 else [topic for topic in filled if _ends_in(topic, ending)]
    if len(chosen) == 1:
        return chosen[0]
    raise ConfigError(f"{bag.path}: several topics could be the {key}; --set {key}=NAME, one of: {_listed(filled)}")


def _listed(topics: Sequence[Topic]) -> str:
    return ", ".join(map(str, topics)) or "none"


def _either(types: Sequence[str]) -> str:
    return " or ".join(types)


def _ends_in(topic: Topic, ending: str) -> bool:
    return topic.name.endswith(ending)


def _space(topic: Topic) -> str:
    return topic.name.strip("/").rpartition("/")[0]


def _is_fixed(topic: Topic) -> bool:
    return topic.type == TRANSFORMS and topic.name.endswith("tf_static")


def _is_odometry(topic: Topic) -> bool:
    return not {"odom", "odometry"}.isdisjoint(re.split(r"[^a-z]+", topic.name.lower()))
