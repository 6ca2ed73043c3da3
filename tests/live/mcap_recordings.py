"""MCAP recordings for tests: what is recorded, what a file holds, and a disk that is full."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from sessions import Loopback, until

from omnibench.live.wire.topics import TOPICS, GraphNode, KeySpace, Publisher


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


@contextmanager
def disk_with_room_for(size: int) -> Iterator[None]:
    """Files of this process cannot grow beyond ``size`` bytes: writing more fails, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
