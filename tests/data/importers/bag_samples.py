"""Real bags of a simulated drive: twelve runs with rests between them, wheels at 50 Hz, reference poses at 4 Hz."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer as McapRos2Writer
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from omnibench.data.dataset import Dataset
from omnibench.robot.kinematics import Array, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.slam.import_dataset import import_dataset
from omnibench.testing.synthetic import synthetic_robot, true_robot

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
ROBOT = synthetic_robot()
TRUTH = true_robot(ROBOT).inverse_kinematic_matrix
EPOCH = 1_700_000_000_000_000_000  # ns
PERIOD = 20_000_000  # ns
RUN, REST = 4.0, 1.5  # s
WHEELS, SLAM = "/robot/joint_states", "/robot/slam_pose"
JOINT_STATE, POSE = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseWithCovarianceStamped"


@dataclass(frozen=True)
class Drive:
    """stamps (F + 1,) and pose_stamps (K,): ns. rates (F, 3): rad/s up to each stamp after the first.

    angles (F + 1, 3): rad. poses (K, 3): m, m, rad. begins: when the robot sets off, s since the first stamp.
    """

    stamps: np.ndarray[Any, np.dtype[np.int64]]
    rates: Array
    angles: Array
    pose_stamps: np.ndarray[Any, np.dtype[np.int64]]
    poses: Array
    begins: tuple[float, ...]


def drive() -> Drive:
    """Four directions, straight and turning either way; the robot rests 1.5 s before and after each."""
    still = np.zeros((round(REST * 1e9) // PERIOD, 3))
    parts, begins = [still], []
    for direction, turn in product((0.2, 1.8, 3.3, 4.9), (-0.4, 0.0, 0.4)):
        twist = np.array([0.25 * math.cos(direction), 0.25 * math.sin(direction), turn])
        begins.append(sum(map(len, parts)) * PERIOD / 1e9)
        parts += [np.tile(wheel_equations(ROBOT.wheels) @ twist, (round(RUN * 1e9) // PERIOD, 1)), still]
    rates = np.concatenate(parts)
    stamps = EPOCH + PERIOD * np.arange(len(rates) + 1)
    angles = 0.3 + np.vstack([np.zeros(3), np.cumsum(rates * (PERIOD / 1e9), axis=0)])
    pose_stamps = np.arange(EPOCH + 100_000_000, stamps[-1], 250_000_000)
    log = WheelLog((stamps[1:] - EPOCH) / 1e9, rates, np.array([1.0, -2.0, 3.0]), (pose_stamps - EPOCH) / 1e9)
    (poses,) = OdometryModel(ROBOT, TRUTH, "arc").poses([log])
    return Drive(stamps, rates, angles, pose_stamps, poses, tuple(begins))


@dataclass(frozen=True)
class Sent:
    """A message: its topic, its type, what is in it, when it was recorded (ns)."""

    topic: str
    kind: str
    content: Any
    logged: int


def header(stamp: int, frame: str = "map") -> dict[str, Any]:
    return {"stamp": {"sec": int(stamp) // 10**9, "nanosec": int(stamp) % 10**9}, "frame_id": frame}


def stamp_of(sent: Sent) -> int:
    stamp = sent.content["header"]["stamp"]
    return int(stamp["sec"]) * 10**9 + int(stamp["nanosec"])


def joint_state(
    stamp: int,
    positions: Sequence[float] = (),
    velocities: Sequence[float] = (),
    names: Sequence[str] = ("a", "b", "c"),
) -> Sent:
    content = {
        "header": header(stamp, ""),
        "name": list(names),
        "position": [float(each) for each in positions],
        "velocity": [float(each) for each in velocities],
        "effort": [],
    }
    return Sent(WHEELS, JOINT_STATE, content, int(stamp) + 3_000_000)


def pose(place: Sequence[float]) -> dict[str, Any]:
    x, y, heading = (float(each) for each in place)
    turn = {"x": 0.0, "y": 0.0, "z": math.sin(heading / 2), "w": math.cos(heading / 2)}
    return {"position": {"x": x, "y": y, "z": 0.0}, "orientation": turn}


def transform(place: Sequence[float]) -> dict[str, Any]:
    content = pose(place)
    return {"translation": content["position"], "rotation": content["orientation"]}


def covariance(variances: Sequence[float] = (1e-4, 2e-4, 3e-4)) -> list[float]:
    full = np.zeros((6, 6))
    full[[0, 1, 5], [0, 1, 5]] = variances
    full[0, 5] = full[5, 0] = 1e-5 if variances[0] > 0 else 0.0
    return full.ravel().tolist()


def slam_pose(stamp: int, place: Sequence[float], variances: Sequence[float] = (1e-4, 2e-4, 3e-4)) -> Sent:
    content = {"header": header(stamp), "pose": {"pose": pose(place), "covariance": covariance(variances)}}
    return Sent(SLAM, POSE, content, int(stamp) + 200_000_000)  # it arrives late


def text(word: str, logged: int, topic: str = "/robot/command") -> Sent:
    return Sent(topic, "std_msgs/msg/String", {"data": word}, int(logged))


def messages(driven: Drive, *, velocities: bool = False) -> list[Sent]:
    """The drive as messages, positions or velocities of the joints a, b, c."""
    if velocities:
        rates = np.vstack([driven.rates[:1], driven.rates])
        wheels = [joint_state(stamp, (), row) for stamp, row in zip(driven.stamps, rates, strict=True)]
    else:
        wheels = [joint_state(stamp, row) for stamp, row in zip(driven.stamps, driven.angles, strict=True)]
    return [*wheels, *(slam_pose(stamp, row) for stamp, row in zip(driven.pose_stamps, driven.poses, strict=True))]


def changed(sent: Sent, **content: Any) -> Sent:
    """The message with other content."""
    return replace(sent, content=sent.content | content)


def encoded(sent: Sent, store: Any = ROS2) -> bytes:
    """CDR, or what ROS 1 makes of it; bytes are garbage and stay what they are."""
    if isinstance(sent.content, bytes):
        return sent.content
    made = _made(store, sent.kind, sent.content)
    return bytes(store.serialize_cdr(made, sent.kind) if store is ROS2 else store.serialize_ros1(made, sent.kind))


def _made(store: Any, kind: str, content: dict[str, Any]) -> Any:
    """A message object of rosbags from dicts and lists."""
    values = {}
    for name, (sort, detail) in store.fielddefs[kind][1]:
        given = 7 if name == "seq" else content.get(name)
        if sort.name == "NAME":
            given = _made(store, detail, given or {})
        elif sort.name in ("ARRAY", "SEQUENCE") and detail[0][0].name == "NAME":
            given = [_made(store, detail[0][1], each) for each in given or ()]
        elif sort.name in ("ARRAY", "SEQUENCE") and detail[0][1][0] != "string":
            given = np.array(given if given is not None else np.zeros(detail[1]), dtype=detail[0][1][0])
        elif given is None:
            given = "" if detail[0] == "string" else 0.0
        values[name] = given
    return store.types[kind](**values)


def write_rosbag2(
    path: Path, sent: Sequence[Sent], storage: StoragePlugin = StoragePlugin.SQLITE3, empty: Sequence[str] = ()
) -> Path:
    """A rosbag2 folder; ``empty``: topics of poses on which nothing was recorded."""
    with Rosbag2Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=ROS2)
            for topic, kind in (_topics(sent) | dict.fromkeys(empty, POSE)).items()
        }
        for each in _recorded(sent):
            writer.write(connections[each.topic], each.logged, encoded(each))
    return path


def write_rosbag2_mcap(path: Path, sent: Sequence[Sent]) -> Path:
    return write_rosbag2(path, sent, StoragePlugin.MCAP)


def write_rosbag1(path: Path, sent: Sequence[Sent]) -> Path:
    path = path.with_suffix(".bag")
    with Rosbag1Writer(path) as writer:
        connections = {name: writer.add_connection(name, kind, typestore=ROS1) for name, kind in _topics(sent).items()}
        for each in _recorded(sent):
            writer.write(connections[each.topic], each.logged, encoded(each, ROS1))
    return path


def write_mcap(path: Path, sent: Sequence[Sent], profile: str = "ros2", **others: Any) -> Path:
    """A bare .mcap as mcap's own writer makes it."""
    path = path.with_suffix(".mcap")
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=65536, **others)
        writer.start(profile=profile, library="test")
        channels = {}
        for topic, kind in _topics(sent).items():
            definition, _ = ROS2.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", definition.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for number, each in enumerate(sent):
            writer.add_message(channels[each.topic], each.logged, encoded(each), each.logged, number)
        writer.finish()
    return path


def write_mcap_ros2(path: Path, sent: Sequence[Sent]) -> Path:
    """A bare .mcap as mcap-ros2-support makes it, with types in their short names."""
    path = path.with_suffix(".mcap")
    with path.open("wb") as file, McapRos2Writer(file, chunk_size=65536) as writer:
        schemas = {}
        for kind in dict.fromkeys(_topics(sent).values()):
            definition, _ = ROS2.generate_msgdef(kind, ros_version=2)
            schemas[kind] = writer.register_msgdef(kind.replace("/msg/", "/"), definition)
        for each in _recorded(sent):
            writer.write_message(each.topic, schemas[each.kind], each.content, each.logged)
    return path


WRITERS: dict[str, Callable[[Path, Sequence[Sent]], Path]] = {
    "rosbag2 sqlite3": write_rosbag2,
    "rosbag2 mcap": write_rosbag2_mcap,
    "mcap": write_mcap,
    "mcap-ros2-support": write_mcap_ros2,
    "ROS 1": write_rosbag1,
}


def _topics(sent: Sequence[Sent]) -> dict[str, str]:
    return {each.topic: each.kind for each in sent}


def _recorded(sent: Sequence[Sent]) -> list[Sent]:
    return sorted(sent, key=lambda each: each.logged)


DRIVE = drive()
FORMATS = pytest.mark.parametrize(
    "write",
    [
        pytest.param(write, id=name, marks=[pytest.mark.slow] if name in ("rosbag2 mcap", "mcap-ros2-support") else [])
        for name, write in WRITERS.items()
    ],
)


def read(source: Path, **options: Any) -> Dataset:
    return import_dataset("rosbag", source, {"robot": ROBOT.model_dump()} | options)


def part(seconds: float, sent: Sequence[Sent] | None = None) -> list[Sent]:
    """What was recorded in the first so many seconds of the drive."""
    return [each for each in sent or messages(DRIVE) if each.logged < EPOCH + seconds * 1e9]


def odometry_error(data: Dataset, model: OdometryModel | None = None) -> float:
    """Largest difference of a model's odometry (the true one's) from the reference at any pose of any run."""
    chosen = model or OdometryModel(ROBOT, TRUTH, "arc")
    return max(float(np.abs(chosen.poses([run.reference_log])[0] - run.poses[1:]).max()) for run in data.trajectories)


def stamped(topic: str, kind: str, stamps: Array, contents: Sequence[dict[str, Any]], late: int = 0) -> list[Sent]:
    """Messages with headers, which are recorded ``late`` ns after their stamps."""
    return [
        Sent(topic, kind, {"header": header(stamp)} | content, int(stamp) + late)
        for stamp, content in zip(stamps, contents, strict=True)
    ]


def odometry(poses: Array, stamps: Array, topic: str = "/tracker") -> list[Sent]:
    return stamped(topic, "nav_msgs/msg/Odometry", stamps, [{"pose": {"pose": pose(place)}} for place in poses])


def edited(sent: Sequence[Sent], topic: str, edit: Callable[[Sent], Sent | None], every: int = 1) -> list[Sent]:
    """The messages with every so-many-th of a topic edited, or taken out."""
    result, count = [], 0
    for each in sent:
        count += each.topic == topic
        new = edit(each) if each.topic == topic and count % every == 0 else each
        if new is not None:
            result.append(new)
    return result
