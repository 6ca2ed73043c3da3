"""``omnibench.subscribe(robot)``: a robot's odometry in a user's program, as an iterator or by callback."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Final, get_args

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from omnibench.config import validate
from omnibench.errors import ConfigError, require_choice
from omnibench.live.network import SessionConfig, close_session, open_session
from omnibench.live.presence import checked_robot
from omnibench.live.stopping import Closing, RateLimiter
from omnibench.live.topics import TOPICS, KeySpace, Profile
from omnibench.live.wire import ODOMETRY, MessageError, MissedMessages, Odometry
from omnibench.words import plural

ADDRESS: Final = "tcp/127.0.0.1:7447"  # where a node listens by default
_FIFO_CAPACITY: Final = 10_000  # messages, 100 s at 100 Hz; chosen
_POLL_PERIOD: Final = 0.001  # s; Zenoh's channels wait either for ever or not at all

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
    """Subscribe to a robot's odometry.

    topic: ``odom`` or, if the node fuses SLAM poses, ``odometry/filtered``. connect: the endpoint on which the node
    listens, or a whole session config (certificate, password). session: an open session to use, which stays open; by
    default one is opened and closed with the subscription. profile, domain: as in the node's config.

    callback: called with each message in a thread of its own, instead of iterating. buffer: how many messages wait for
    a slow reader; by default only the newest. With ``lossless`` up to 10,000 messages wait, in order; only when these
    are full does the sender drop messages, which ``missed`` counts and the log tells once.

    ConfigError: a name is not valid, or nothing listens at ``connect``. ::

        with omnibench.subscribe("apr02") as odometry:
            for message in odometry:
                print(message.seconds, message.pose)
    """
    odometry_topics = [name for name, kind in TOPICS.items() if kind is ODOMETRY]
    require_choice("odometry topic", topic, odometry_topics)
    require_choice("profile", profile, get_args(Profile))
    size = (_FIFO_CAPACITY if lossless else 1) if buffer is None else buffer
    if size < 1:
        raise ConfigError(f"buffer: expected a number of messages of at least 1, found {buffer}")
    key = KeySpace(profile, domain).expression(checked_robot(robot), topic)
    channel: FifoChannel[zenoh.Sample] | RingChannel[zenoh.Sample]
    channel = FifoChannel(size) if lossless else RingChannel(size)
    own_session = None
    if session is None:
        if isinstance(connect, str):
            connect = validate(SessionConfig, {"mode": "client", "connect": connect}, f"subscribing to {robot}")
        session = own_session = open_session(connect, f"subscribing to {robot}")
    return Subscription(session.declare_subscriber(key, channel), callback, own_session, lossless)


class Subscription(Closing):
    """A stream of odometry messages: iterate over it, or get the ``latest``; a context manager.

    received: messages decoded so far. missed: messages published since the first and not received, because they were
    lost on the way or newer ones took their place before they were read. undecodable: messages skipped because they
    were not odometry. callback_errors: how often the callback raised; each kind of exception is logged once, and the
    stream goes on.
    """

    def __init__(
        self,
        subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]],
        callback: Callable[[Odometry], object] | None,
        session: zenoh.Session | None,
        lossless: bool,
    ) -> None:
        self.received = self.undecodable = self.callback_errors = 0
        self._subscriber = subscriber
        self._channel = subscriber.handler  # readers wait in the channel, so that the subscriber can be closed
        self._session = session
        self._lossless = lossless
        self._numbers = MissedMessages()
        self._log_limiter = RateLimiter(math.inf)
        self._closing = threading.Lock()  # Zenoh does not allow two threads to close at once
        self._closed = False
        self._thread: threading.Thread | None = None
        if callback is not None:
            self._thread = threading.Thread(
                target=self._call, args=(callback,), name="omnibench-subscribe", daemon=True
            )
            self._thread.start()

    @property
    def missed(self) -> int:
        """Messages published since the first and not received."""
        return self._numbers.count

    def __iter__(self) -> Iterator[Odometry]:
        if self._thread is not None:
            raise ConfigError("this subscription hands its messages to a callback; iterate over one without")
        return self._messages()

    def latest(self, timeout: float = 1.0) -> Odometry | None:
        """The newest message that was not returned before; waits up to ``timeout`` s, then None."""
        deadline = time.monotonic() + timeout
        newest = None
        with suppress(zenoh.ZError):  # the subscription was closed
            while True:
                sample = self._channel.try_recv()
                if sample is not None:
                    newest = self._decoded(sample) or newest
                elif newest is not None or time.monotonic() >= deadline:
                    break
                else:
                    time.sleep(_POLL_PERIOD)
        return newest

    def close(self) -> None:
        """End the stream, also for a reader that waits for a message. Closing twice does no harm."""
        with self._closing:
            if not self._closed:
                self._closed = True
                self._subscriber.undeclare()
                if self._session is not None:
                    close_session(self._session)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _messages(self) -> Iterator[Odometry]:
        with suppress(zenoh.ZError):  # the subscription was closed
            while True:
                message = self._decoded(self._channel.recv())
                if message is not None:
                    yield message

    def _decoded(self, sample: zenoh.Sample) -> Odometry | None:
        if sample.kind != zenoh.SampleKind.PUT:
            return None
        skipped = self._numbers.take(sample.attachment)
        if skipped is None:
            return None
        if self._lossless and skipped and self._log_limiter.allows("missed"):
            _log.warning(
                "%s of %s lost on the way; `missed` counts them", plural(self.missed, "message"), sample.key_expr
            )
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
            except Exception as error:  # the user's code may raise anything
                self.callback_errors += 1
                if self._log_limiter.allows(kind := type(error).__name__):
                    _log.exception("the callback raised; further %s are only counted", kind)
