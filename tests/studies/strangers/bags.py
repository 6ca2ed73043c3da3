"""ROS 1 bags with odd joint states, messages of other packages, and covariances that mean "unknown"."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from strangers.motion import TURN, Array, Run

_EPOCH = 1_700_000_000  # s
_SENSOR_STATE = """Header header
uint8 bumper
float32 cliff
float32 sonar
float32 illumination
uint8 led
uint8 button
bool torque
int32 left_encoder
int32 right_encoder
float32 battery
"""
_TICK = "Header header\nint32 data\nuint16 resolution\nuint8 type\n"
_STORE = get_typestore(Stores.ROS1_NOETIC)
_STORE.register(get_types_from_msg(_SENSOR_STATE, "turtlebot3_msgs/msg/SensorState"))
_STORE.register(get_types_from_msg(_TICK, "duckietown_msgs/msg/WheelEncoderStamped"))


def _message(kind: str, **values: Any) -> Any:
    return _STORE.types[kind](**values)


def _header(seconds: float) -> Any:
    whole = math.floor(seconds)
    stamp = _message("builtin_interfaces/msg/Time", sec=_EPOCH + whole, nanosec=int((seconds - whole) * 1e9))
    return _message("std_msgs/msg/Header", seq=0, stamp=stamp, frame_id="map")


def _pose(seconds: float, pose: Array, covariance: float) -> Any:
    x, y, heading = map(float, pose)
    place = _message("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
    half = {"z": math.sin(heading / 2), "w": math.cos(heading / 2)}
    turn = _message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, **half)
    both = _message("geometry_msgs/msg/Pose", position=place, orientation=turn)
    diagonal = np.diag(np.full(6, covariance)).ravel()
    known = _message("geometry_msgs/msg/PoseWithCovariance", pose=both, covariance=diagonal)
    return _message("geometry_msgs/msg/PoseWithCovarianceStamped", header=_header(seconds), pose=known)


def _wheels(run: Run, message: str, positions: str, velocities: str, ticks: int) -> Iterator[tuple[float, str, Any]]:
    """Time, topic and message of each sample."""
    speeds = np.gradient(run.wheels, run.times, axis=0)
    whole = np.floor(run.wheels / TURN * ticks).astype(int).tolist()
    others = {"bumper": 0, "cliff": 0.0, "sonar": 0.0, "illumination": 0.0, "led": 0, "button": 0, "torque": True}
    for row, t in enumerate(run.times.tolist()):
        if message == "joints":
            choices = {"right": run.wheels[row], "nan": np.full(2, np.nan), "zero": np.zeros(2), "none": np.empty(0)}
            values: dict[str, Any] = {"name": ["wheel_left_joint", "wheel_right_joint"], "effort": np.empty(0)}
            values |= {"position": choices[positions], "velocity": speeds[row] * (velocities != "zero")}
            yield t, "/joint_states", _message("sensor_msgs/msg/JointState", header=_header(t), **values)
        elif message == "sensor_state":
            counts = dict(zip(("left_encoder", "right_encoder"), whole[row], strict=True))
            kind = "turtlebot3_msgs/msg/SensorState"
            yield t, "/sensor_state", _message(kind, header=_header(t), battery=12.0, **others, **counts)
        else:
            for count, topic, after in zip(whole[row], ("/left/tick", "/right/tick"), (0.0, 1e-3), strict=True):
                values = {"header": _header(t + after), "data": count, "resolution": ticks, "type": 1}
                yield t + after, topic, _message("duckietown_msgs/msg/WheelEncoderStamped", **values)


def write_bag(
    run: Run, file: Path, message: str = "joints", positions: str = "right", velocities: str = "right",
    disorder: bool = False, covariance: float = 0.0, ticks: int = 0,
) -> None:  # fmt: skip
    """A bag of wheels and poses. disorder: messages are recorded up to 0.12 s late, and every seventh twice."""
    rng = np.random.default_rng(1)
    sent = list(_wheels(run, message, positions, velocities, ticks))
    sent += [(t + 1e-3, topic, again) for t, topic, again in sent[::7]] if disorder else []
    poses = zip(run.pose_times.tolist(), run.poses, strict=True)
    sent += [(t + 0.05, "/amcl_pose", _pose(t, pose, covariance)) for t, pose in poses]
    sent = [(t + disorder * rng.uniform(0, 0.12), topic, each) for t, topic, each in sent]
    with Writer(file) as writer:
        kinds = {topic: each.__msgtype__ for _, topic, each in sent}
        links = {topic: writer.add_connection(topic, kind, typestore=_STORE) for topic, kind in kinds.items()}
        for t, topic, each in sorted(sent, key=lambda entry: entry[0]):
            writer.write(links[topic], round((_EPOCH + t) * 1e9), _STORE.serialize_ros1(each, kinds[topic]))
