"""Choice of a bag's topics for wheels, reference poses and scans, and of the joints that are the robot's wheels."""

from __future__ import annotations

import re
from collections.abc import Sequence

from omnibench.data.importers.rosbag.bag import Bag, Topic
from omnibench.errors import ConfigError, DataError, nearest
from omnibench.robot.kinematics import Robot

WHEEL_TYPES = ("sensor_msgs/msg/JointState",)
POSE_TYPES = (
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PoseStamped",
    "nav_msgs/msg/Odometry",
)
SCAN_TYPES = ("sensor_msgs/msg/LaserScan",)
# Words in the names of joints besides the wheel's own name: front_left_wheel_joint, drive/wheel_a.
_USUAL = {"wheel", "wheels", "joint", "motor", "drive", "link", "axle", "hub"}


def wheel_topic(bag: Bag, name: str | None) -> Topic:
    """The topic of the wheels: the one named, the only one of its type, or the only one that ends in joint_states."""
    if name is not None:
        return _named(bag, name, "wheel_topic", WHEEL_TYPES)
    candidates = [topic for topic in bag.topics if topic.type in WHEEL_TYPES]
    return _only(bag, "wheel_topic", candidates, "joint_states", WHEEL_TYPES)


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


def pose_topic(bag: Bag, name: str | None, wheels: Topic, scans: Topic | None = None) -> Topic | None:
    """The topic of the reference poses: the one named, the only one, or the only one that ends in slam_pose.

    Among several that do, the one of the wheels' namespace. Odometry is never taken unasked: a calibration against the
    robot's own odometry would find nothing wrong. None: there is none, but there are ``scans``, from which poses can be
    made.
    """
    if name is not None:
        return _named(bag, name, "pose_topic", POSE_TYPES)
    candidates = [topic for topic in bag.topics if topic.type in POSE_TYPES]
    references = [topic for topic in candidates if topic.messages and not _is_odometry(topic)]
    if not references and scans is not None:
        return None
    if not references and any(topic.messages for topic in candidates):
        raise ConfigError(
            f"{bag.path}: the only poses are {_listed(candidates)}, by name the robot's own odometry and not a "
            "reference for it; if it is one, set pose_topic"
        )
    beside = [topic for topic in references if _ends_in(topic, "slam_pose") and _space(topic) == _space(wheels)]
    if len(beside) == 1:
        return beside[0]
    return _only(bag, "pose_topic", references or candidates, "slam_pose", POSE_TYPES)


def wheel_joints(robot: Robot, asked: Sequence[str], found: Sequence[str]) -> tuple[int, ...] | None:
    """Indices of the robot's wheels in a JointState with the names ``found``; None when not all of them are there.

    asked: joints in the robot's wheel order. Without them joints are chosen by the wheels' names: equal ones, else
    those that are equal but for words such as ``wheel`` and ``joint``, case, and text before a slash.
    """
    wanted = asked or robot.wheel_names
    if all(found.count(name) == 1 for name in wanted):
        return tuple(found.index(name) for name in wanted)
    if asked:
        return None
    cores = [_core(name) for name in found]
    places = [[place for place, core in enumerate(cores) if core == _core(wheel)] for wheel in robot.wheel_names]
    if not all(len(each) == 1 for each in places) or len({each[0] for each in places}) < len(places):
        return None
    return tuple(each[0] for each in places)


def no_joints(bag: Bag, topic: Topic, robot: Robot, asked: Sequence[str], found: Sequence[str]) -> ConfigError:
    """The error of a topic whose messages never hold all wheels; it lists the joints found."""
    shown = ", ".join(found) or "none (the messages name no joints)"
    place = f"{bag.path}: topic {topic.name}"
    missing = next((name for name in asked if name not in found), None)
    if missing is not None:
        return ConfigError(f"{place}: joints: no joint {missing!r}; {nearest(missing, found)}found: {shown}")
    if asked:
        return ConfigError(f"{place}: no message holds all of {', '.join(asked)} once; joints found: {shown}")
    return ConfigError(
        f"{place}: cannot tell which joints are the wheels {', '.join(robot.wheel_names)}; set joints, in that order; "
        f"joints found: {shown}"
    )


def _named(bag: Bag, name: str, key: str, types: Sequence[str]) -> Topic:
    topic = bag.topic(name, key)
    if topic.type not in types:
        found = _listed([each for each in bag.topics if each.type in types])
        raise ConfigError(f"{bag.path}: {key}: {topic.name} is {topic.type}, expected {_either(types)}; found: {found}")
    return topic


def _only(bag: Bag, key: str, candidates: Sequence[Topic], ending: str, types: Sequence[str]) -> Topic:
    if not candidates:
        known = ", ".join(map(str, bag.topics)) or "none"
        raise DataError(f"{bag.path}: no topic of type {_either(types)}; topics found: {known}")
    filled = [topic for topic in candidates if topic.messages]
    if not filled:
        raise DataError(f"{bag.path}: {_listed(candidates)}: nothing was recorded on it")
    chosen = filled if len(filled) == 1 else [topic for topic in filled if _ends_in(topic, ending)]
    if len(chosen) == 1:
        return chosen[0]
    raise ConfigError(f"{bag.path}: several topics could be the {key}; set {key} to one of: {_listed(filled)}")


def _listed(topics: Sequence[Topic]) -> str:
    return ", ".join(map(str, topics)) or "none"


def _either(types: Sequence[str]) -> str:
    return " or ".join(types)


def _ends_in(topic: Topic, ending: str) -> bool:
    return topic.name.endswith(ending)


def _space(topic: Topic) -> str:
    return topic.name.strip("/").rpartition("/")[0]


def _is_odometry(topic: Topic) -> bool:
    return not {"odom", "odometry"}.isdisjoint(re.split(r"[^a-z]+", topic.name.lower()))


def _core(name: str) -> str:
    words = re.findall(r"[a-z]+|[0-9]+", name.lower().rpartition("/")[2])
    return " ".join(word for word in words if word not in _USUAL) or " ".join(words)
