"""Messages with numbers that no default has, robots that publish them, and recordings of them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from commands import disk_that_takes as disk_with_room_for  # noqa: F401 (for those who import it from here)
from rosbags.highlevel import AnyReader
from sessions import Loopback, until

from omnibench.live.health import Counts
from omnibench.live.topics import TOPICS, GraphNode, KeySpace, Profile, Publisher
from omnibench.live.wire import Diagnostic, Diagnostics, JointState, Odometry, PoseEstimate, Transform

STAMP = 1_700_000_000_123_456_789
PERIOD = 10_000_000  # ns
COVARIANCE = np.array([[4e-4, 1e-5, 2e-5], [1e-5, 9e-4, 3e-5], [2e-5, 3e-5, 1.6e-3]])


def odometry(k: int = 0, frame: str = "odom") -> Odometry:
    """The k-th message of a robot that moves."""
    return Odometry(
        STAMP + k * PERIOD,
        frame,
        "base_link",
        np.array([1.25 + 0.01 * k, -2.5, 0.7 + 0.001 * k]),
        COVARIANCE,
        np.array([0.31, -0.12, 0.45]),
        2 * COVARIANCE,
    )


def sample(topic: str, k: int = 0) -> Any:
    """The k-th message of any topic of TOPICS."""
    stamp = STAMP + k * PERIOD
    messages: dict[str, Any] = {
        "joint_states": JointState(
            stamp, ("a", "b", "c"), np.array([0.1, 0.2, 0.3]) * (k + 1), np.array([1.5, -2.5, 3.5])
        ),
        "slam_pose": PoseEstimate(stamp, "map", np.array([3.5, -1.25, -2.1]), COVARIANCE),
        "odom": odometry(k),
        "odometry/filtered": odometry(k, "map"),
        "diagnostics": Diagnostics(
            stamp, (Diagnostic("odometry", 1, "late samples", "apr02", (("late", "3"), ("rate_hz", "99.8"))),)
        ),
        "tf": (
            Transform(stamp, "map", "odom", np.array([0.5, 0.25, 0.125])),
            Transform(stamp, "odom", "base_link", np.array([1.0, 2.0, -3.0])),
        ),
    }
    return messages[topic]


class AnnouncedRobot:
    """A robot's liveliness token, its topics and its answer to queries for its health."""

    def __init__(self, session: zenoh.Session, name: str, profile: Profile = "plain") -> None:
        node = GraphNode(session, KeySpace(profile), f"node_of_{name}")
        self.name = name
        self.odom = node.publisher(name, "odom", lossless=True)
        self.filtered = node.publisher(name, "odometry/filtered", lossless=True)
        self.diagnostics = node.publisher(name, "diagnostics")
        self.token = session.liveliness().declare_token(f"omnibench/{name}/alive")
        self._session = session

    def answer_health(self, status: str, message: str, **counts: int) -> None:
        document = json.dumps(
            {"robot": self.name, "status": status, "message": message, "counts": Counts(**counts).as_dict()}
        )
        self._queryable = self._session.declare_queryable(
            f"omnibench/{self.name}/health", lambda query: query.reply(f"omnibench/{self.name}/health", document)
        )

    def wait_for_subscribers(self) -> None:
        until(lambda: self.odom.matched and self.filtered.matched, "the monitor's subscriptions")


def publishers(loopback: Loopback, robot: str = "apr02") -> dict[str, Publisher[Any]]:
    """A publisher for each topic of a robot; bursts lose nothing."""
    node = GraphNode(loopback.router, KeySpace(), "node")
    return {topic: node.publisher(robot, topic, lossless=True) for topic in TOPICS}


def wait_for_subscribers(*publishers: Publisher[Any]) -> None:
    """Wait until each publisher has a subscriber."""
    until(lambda: all(publisher.matched for publisher in publishers), "the recorder's subscriptions")


def messages_of(path: Path) -> dict[str, list[bytes]]:
    """The payloads in a file, as rosbags reads them, by ROS topic."""
    payloads: dict[str, list[bytes]] = {}
    with AnyReader([path]) as reader:
        for connection, _, payload in reader.messages():
            payloads.setdefault(connection.topic, []).append(bytes(payload))
    return payloads
