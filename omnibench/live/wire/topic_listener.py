"""Listening to robots' topics without decoding, for the recorder and the Foxglove server."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Lock

import zenoh

from omnibench.errors import UnknownNameError
from omnibench.live.network.presence import checked_robot
from omnibench.live.stopping import direct
from omnibench.live.wire.messages import MissedMessages
from omnibench.live.wire.topics import TOPICS, KeySpace, topic_name


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
        sources = {f"/{topic_name(robot, topic)}": (robot, topic) for robot, topic in _pairs(robots, topics)}
        self.topics = {name: topic for name, (_, topic) in sources.items()}  # all robots share tf
        self._missed = {name: MissedMessages() for name in sources}
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


def _pairs(robots: Sequence[str], topics: Sequence[str]) -> list[tuple[str, str]]:
    for topic in topics:
        if topic not in TOPICS:
            raise UnknownNameError("topic", topic, TOPICS)
    return [(checked_robot(robot), topic) for robot in robots for topic in topics]
