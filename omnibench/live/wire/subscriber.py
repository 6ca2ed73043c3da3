"""``omnibench.subscribe(robot)``: a robot's odometry in somebody's program, as an iterator or by callback."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Final, get_args

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from omnibench.config import validate
from omnibench.errors import ConfigError, UnknownNameError
from omnibench.live.network.presence import checked_robot
from omnibench.live.network.session import open_session
from omnibench.live.network.session_config import SessionConfig
from omnibench.live.wire.messages import ODOMETRY, MessageError, Odometry
from omnibench.live.wire.topics import TOPICS, KeySpace, Profile

ADDRESS: Final = "tcp/127.0.0.1:7447"
_FIFO_CAPACITY: Final = 10_000
_LOOK_AGAIN: Final = 0.001  # s; Zenoh's channels wait for ever or not at all

_log = logging.getLogger(__name__)


def subscribe(
    robot: str,
    *,
    topic: str = "odom",
    connect: str | SessionConfig = ADDRESS,
    session: zenoh.Session | None = None,
    profile: Profile = "plain",
    domain: int = 0,
    callback: Callable[[Odometry], object] | None = None,
    buffer: int | None = None,
    lossless: bool = False,
) -> Subscription:
    """A robot's odometry as it comes.

    topic: ``odom`` or, where the node fuses SLAM poses, ``odometry/filtered``. connect: where the node listens, or all
    the settings of a session (certificate, password). session: one that is open already, and stays open; else one is
    opened and closed with the subscription. profile, domain: as in the node's config.

    callback: called with each message, in a thread of its own, in place of iterating. buffer: how many messages wait
    for a slow reader: one, and the newest wins, unless said otherwise; with ``lossless`` 10,000 in order, and only
    when these are full are messages lost, at the sender.

    ConfigError: a name that cannot be or nothing listens at ``connect``. ::

        with omnibench.subscribe("apr02") as odometry:
            for message in odometry:
                print(message.seconds, message.pose)
    """
    known = [name for name, kind in TOPICS.items() if kind is ODOMETRY]
    if topic not in known:
        raise UnknownNameError("odometry topic", topic, known)
    if profile not in get_args(Profile):
        raise UnknownNameError("profile", profile, get_args(Profile))
    size = (_FIFO_CAPACITY if lossless else 1) if buffer is None else buffer
    if size < 1:
        raise ConfigError(f"buffer: expected a number of messages of at least 1, found {buffer}")
    key = KeySpace(profile, domain).expression(checked_robot(robot), topic)
    channel: FifoChannel[zenoh.Sample] | RingChannel[zenoh.Sample]
    channel = FifoChannel(size) if lossless else RingChannel(size)
    own = None
    if session is None:
        if isinstance(connect, str):
            connect = validate(SessionConfig, {"mode": "client", "connect": connect}, f"subscribing to {robot}")
        session = own = open_session(connect, f"subscribing to {robot}")
    return Subscription(session.declare_subscriber(key, channel), callback, own)


class Subscription:
    """Odometry messages as they come: iterate, or ask for the ``latest``; a context manager.

    received: messages decoded so far. undecodable: messages that were not odometry, passed over. callback_errors: how
    often the callback raised; each kind of exception is logged once, and the stream goes on.
    """

    def __init__(
        self,
        subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]],
        callback: Callable[[Odometry], object] | None,
        session: zenoh.Session | None,
    ) -> None:
        self.received = 0
        self.undecodable = 0
        self.callback_errors = 0
        self._subscriber = subscriber
        self._channel = subscriber.handler  # a reader that waits in it does not hold the subscriber, which can close
        self._session = session
        self._callback = callback
        self._kinds: set[type[Exception]] = set()
        self._closing = threading.Lock()  # two threads may close at once, which Zenoh does not bear
        self._closed = False
        self._thread: threading.Thread | None = None
        if callback is not None:
            self._thread = threading.Thread(
                target=self._call, args=(callback,), name="omnibench-subscribe", daemon=True
            )
            self._thread.start()

    def __iter__(self) -> Iterator[Odometry]:
        if self._callback is not None:
            raise ConfigError("this subscription hands its messages to a callback; iterate over one without")
        return self._messages()

    def latest(self, timeout: float = 1.0) -> Odometry | None:
        """The newest message that was not handed out yet, waiting for one up to ``timeout`` s; None if none came."""
        deadline = time.monotonic() + timeout
        newest = None
        try:
            while True:
                sample = self._channel.try_recv()
                if sample is not None:
                    newest = self._decoded(sample) or newest
                elif newest is not None or time.monotonic() >= deadline:
                    return newest
                else:
                    time.sleep(_LOOK_AGAIN)
        except zenoh.ZError:  # closed
            return newest

    def close(self) -> None:
        """End the stream, for whoever waits for a message too. Closing twice does no harm."""
        with self._closing:
            if not self._closed:
                self._closed = True
                self._subscriber.undeclare()
                if self._session is not None:
                    self._session.close()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def __enter__(self) -> Subscription:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _messages(self) -> Iterator[Odometry]:
        while True:
            try:
                sample = self._channel.recv()
            except zenoh.ZError:  # closed
                return
            message = self._decoded(sample)
            if message is not None:
                yield message

    def _decoded(self, sample: zenoh.Sample) -> Odometry | None:
        if sample.kind != zenoh.SampleKind.PUT:
            return None
        try:
            message = ODOMETRY.decode(sample.payload.to_bytes())
        except MessageError:
            self.undecodable += 1
            return None
        self.received += 1
        return message

    def _call(self, callback: Callable[[Odometry], object]) -> None:
        for message in self._messages():
            try:
                callback(message)
            except Exception as error:  # the user's own code may raise anything
                self.callback_errors += 1
                if type(error) not in self._kinds:
                    self._kinds.add(type(error))
                    _log.exception("the callback raised; further %s are only counted", type(error).__name__)
