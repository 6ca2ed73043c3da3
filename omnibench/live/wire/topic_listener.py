"""Every message of some robots' topics, as it arrives, undecoded: what the recorder and the Foxglove server feed on."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any

import zenoh
from zenoh.handlers import Callback

from omnibench.errors import UnknownNameError
from omnibench.live.network.presence import checked_robot
from omnibench.live.wire.topics import TOPICS, KeySpace, topic_name


@dataclass(frozen=True, slots=True)
class Arrival:
    """A message that came.

    name: its ROS 2 topic with the leading slash, /apr02/odom. topic: as in TOPICS. time: ns of the system's clock when
    it came, never less than that of the arrival before. payload: CDR.
    """

    name: str
    topic: str
    time: int
    payload: bytes


class TopicListener:
    """Hands every message of the robots' topics to ``consume``, one at a time, in Zenoh's thread: it must be quick.

    Raises ConfigError for a topic that is not there or a robot's name that cannot be.
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
        sources = {f"/{topic_name(robot, topic)}": (robot, topic) for robot, topic in _pairs(robots, topics)}
        self.topics = {name: topic for name, (_, topic) in sources.items()}  # tf is everybody's and there once
        self._subscribers: list[zenoh.Subscriber[None]] = []
        for name, (robot, topic) in sources.items():
            direct: Any = Callback(partial(self._arrived, name, topic), indirect=False)
            self._subscribers.append(session.declare_subscriber(keys.expression(robot, topic), direct))

    def close(self) -> None:
        """No message is handed on after this."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        with self._lock:  # the one under way has been handed on
            self._subscribers = []

    def _arrived(self, name: str, topic: str, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        payload = sample.payload.to_bytes()
        with self._lock:
            self._time = max(self._time, time.time_ns())  # readers of recordings want them in order
            self._consume(Arrival(name, topic, self._time, payload))


def _pairs(robots: Sequence[str], topics: Sequence[str]) -> list[tuple[str, str]]:
    for topic in topics:
        if topic not in TOPICS:
            raise UnknownNameError("topic", topic, TOPICS)
    return [(checked_robot(robot), topic) for robot in robots for topic in topics]
