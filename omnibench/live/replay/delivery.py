"""Delivery of a replay's messages: a bounded number is under way at any speed, and it is known what arrived.

An omnibench node acknowledges what it has taken (``acknowledged_flows``): what is lost with a link or with a node that
starts again is sent once more, and a node that is gone is waited for. Other subscribers acknowledge nothing: there a
round trip to the next Zenoh router, behind the messages, bounds how many are under way, and empties the queue at the
end.
"""

from __future__ import annotations

import math
import secrets
import struct
import threading
import time
from abc import abstractmethod
from collections import deque
from typing import Any, Final

import zenoh

from omnibench.errors import OmnibenchError
from omnibench.live.acknowledged_flows import acknowledgement_key, read_acknowledgement
from omnibench.live.network.session import is_connected
from omnibench.live.stopping import Closing, direct
from omnibench.live.wire.topics import Publisher

WINDOW: Final = 256  # messages under way at most, some 90 kB: less than Zenoh's queue holds; chosen
_POLL_PERIOD: Final = 0.05  # s between two looks at whether a signal came; chosen
_LONGEST_POLL: Final = 0.5  # s; a look that takes longer is one at which this process stood still; chosen
_FIRST_RETRY: Final = 0.5  # s without an acknowledgement after which messages are sent again; chosen
_LAST_RETRY: Final = 4.0  # s, to which this time doubles; chosen
_GAP_RETRY: Final = 0.1  # s in which one gap is reported by many acknowledgements; chosen


class DeliveryError(OmnibenchError):
    """Messages did not reach their receiver."""

    exit_code = 1


class Delivery(Closing):
    """Publishes messages and waits where too many are under way.

    paused: s that it has waited for a receiver. restarts: how often another node went on in the receiver's place.
    stop: ends any waiting. wait: s without any sign of the receiver after which it is given up, of which those do not
    count in which this process itself was suspended.
    """

    def __init__(self, stop: threading.Event, wait: float) -> None:
        self.paused = 0.0
        self.restarts = 0
        self._stop, self._patience = stop, wait
        self._heard = threading.Event()
        self._waited = 0.0  # s without any sign of the receiver

    def _poll(self, sign: threading.Event) -> bool:
        """Wait for a sign of the receiver for a moment; True if there is one."""
        began = time.monotonic()
        there = sign.wait(_POLL_PERIOD)
        self._waited += min(time.monotonic() - began, _LONGEST_POLL)
        return there

    @property
    @abstractmethod
    def taken(self) -> int | None:
        """Messages that the receiver has taken; None where that is not known."""

    @property
    @abstractmethod
    def passed(self) -> int:
        """Messages that are known to have reached the receiver or, where that is not known, the next router."""

    @abstractmethod
    def put(self, publisher: Publisher[Any], payload: bytes) -> bool:
        """Publish a payload as soon as there is room for it; False if ``stop`` was set before.

        DeliveryError: the receiver is given up.
        """

    @abstractmethod
    def finish(self) -> None:
        """Wait until all has arrived, or a short time if ``stop`` is set. DeliveryError: the receiver is given up."""


class AcknowledgedDelivery(Delivery):
    """Delivery to the omnibench node of a robot."""

    def __init__(self, session: zenoh.Session, robot: str, stop: threading.Event, wait: float) -> None:
        super().__init__(stop, wait)
        self._robot = robot
        self._flow = secrets.randbits(64)
        self._lock = threading.Lock()
        self._under_way: deque[tuple[Publisher[Any], bytes, int]] = deque()  # from number _taken on
        self._sent = self._taken = 0
        self._gap = False
        self._node: str | None = None  # the node's session, as its acknowledgements name it
        self._progress_at = self._sent_again_at = -math.inf
        self._retry = _FIRST_RETRY
        key = acknowledgement_key(robot, self._flow)
        self._subscriber = session.declare_subscriber(key, direct(self._acknowledged))

    @property
    def taken(self) -> int:
        return self._taken

    @property
    def passed(self) -> int:
        return self._taken

    def put(self, publisher: Publisher[Any], payload: bytes) -> bool:
        self._wait_for_room()
        if self._stop.is_set():
            return False
        number = publisher.next_number()
        with self._lock:
            if not self._under_way:
                self._progress_at, self._waited = time.monotonic(), 0.0
            self._under_way.append((publisher, payload, number))
            place = self._flow, self._sent, self._taken, False
            self._sent += 1
        publisher.put_numbered(payload, number, place)
        return True

    def finish(self) -> None:
        while self._under_way and not self._stop.is_set():
            self._wait()
        end = time.monotonic() + _FIRST_RETRY
        while self._under_way and time.monotonic() < end:  # after a stop what is under way may still arrive
            self._heard.wait(_POLL_PERIOD)
            self._heard.clear()

    def close(self) -> None:
        self._subscriber.undeclare()

    def _wait_for_room(self) -> None:
        """Wait while the window is full, or while the node has been silent for long."""
        if len(self._under_way) < WINDOW and (not self._under_way or self._silence() < _FIRST_RETRY) and not self._gap:
            return
        began = time.monotonic()
        while not self._stop.is_set() and (
            len(self._under_way) >= WINDOW or self._gap or (bool(self._under_way) and self._silence() >= _FIRST_RETRY)
        ):
            self._wait()
        waited = time.monotonic() - began
        self.paused += waited if waited > _FIRST_RETRY else 0.0

    def _silence(self) -> float:
        """Time since the last progress, s."""
        return time.monotonic() - self._progress_at

    def _wait(self) -> None:
        """Wait for an acknowledgement, and send again what seems lost. DeliveryError: none came for too long."""
        self._poll(self._heard)
        self._heard.clear()
        silence, now = self._silence(), time.monotonic()
        if self._waited > self._patience:
            key = acknowledgement_key(self._robot, "*")
            rights = "" if self._taken else f" (may this session read {key}?)"
            raise DeliveryError(f"its node has taken nothing for {silence:.0f} s{rights}; `wait` says how long to wait")
        again = now - self._sent_again_at
        if (self._gap and again > _GAP_RETRY) or (silence > self._retry and again > self._retry):
            self._retry = min(2 * self._retry, _LAST_RETRY) if silence > self._retry else self._retry
            self._send_again()

    def _send_again(self) -> None:
        """Send all that is under way once more."""
        with self._lock:
            self._gap = False
            first, messages = self._taken, list(self._under_way)
        self._sent_again_at = time.monotonic()
        for place, (publisher, payload, number) in enumerate(messages, first):
            if self._stop.is_set():
                return
            publisher.put_numbered(payload, number, (self._flow, place, self._taken, True))

    def _acknowledged(self, sample: zenoh.Sample) -> None:
        try:
            expected, gap = read_acknowledgement(sample.payload.to_bytes())
        except struct.error:
            return
        with self._lock:
            expected = min(expected, self._taken + len(self._under_way))
            if expected > self._taken:
                for _ in range(expected - self._taken):
                    self._under_way.popleft()
                self._taken = expected
                self._progress_at, self._waited = time.monotonic(), 0.0
                self._retry = _FIRST_RETRY
            self._gap |= gap and bool(self._under_way)
            if sample.timestamp is not None and (node := str(sample.timestamp.get_id())) != self._node:
                self.restarts += self._node is not None
                self._node = node
        self._heard.set()


class UnconfirmedDelivery(Delivery):
    """Delivery to subscribers that acknowledge nothing."""

    def __init__(self, session: zenoh.Session, robot: str, stop: threading.Event, wait: float) -> None:
        super().__init__(stop, wait)
        self._session = session
        self._key = acknowledgement_key(robot, "nobody")
        self._arrived = threading.Event()  # the round trip under way has come back
        self._arrived.set()
        self._linked = is_connected(session)  # otherwise all subscribers are in this session
        self._sent = 0
        self._before = 0  # messages before the last round trip
        self._passed = 0

    @property
    def taken(self) -> None:
        return None

    @property
    def passed(self) -> int:
        return self._passed

    def put(self, publisher: Publisher[Any], payload: bytes) -> bool:
        if self._sent - self._before >= WINDOW:
            self._round_trip_over()
            self._begin_round_trip()
        if self._stop.is_set():
            return False
        publisher.put_encoded(payload)
        self._sent += 1
        return True

    def finish(self) -> None:
        self._round_trip_over()
        self._begin_round_trip()
        self._round_trip_over()

    def close(self) -> None:
        pass

    def _begin_round_trip(self) -> None:
        """Query a key that nobody answers: the router closes the query once all messages before it have passed."""
        self._before = self._sent
        self._arrived.clear()
        handler: Any = zenoh.handlers.Callback(lambda _: None, self._arrived.set, indirect=False)
        # Zenoh closes the query at its timeout too, which must come after our patience
        self._session.get(self._key, handler, timeout=2 * self._patience, priority=zenoh.Priority.BACKGROUND)

    def _round_trip_over(self) -> None:
        began, self._waited = time.monotonic(), 0.0
        while not self._poll(self._arrived) and not self._stop.is_set():
            if self._waited > self._patience:
                raise DeliveryError(f"the router has taken nothing for {self._patience:g} s")
        if self._arrived.is_set() and not self._stop.is_set() and self._linked and not is_connected(self._session):
            raise DeliveryError("the link to the router was lost")  # which closes a query, too
        if self._arrived.is_set():
            self._passed = self._before
        waited = time.monotonic() - began
        self.paused += waited if waited > _FIRST_RETRY else 0.0
