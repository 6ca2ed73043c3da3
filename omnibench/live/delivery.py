"""Delivery of a replay: a bounded number of messages is under way at any speed, and it is known how many arrived.

A node takes each message of a flow once and in order, and acknowledges which one it expects next. The rule is
go-back-n: a message after a gap is refused, and the sender sends again from the first that is missing, also where a
link was lost or a node started again. A node that does not know a flow, since it has just started, expects the lowest
number that the sender has no acknowledgement of. What is sent again to it may have been taken by a node that was killed
before it could acknowledge, and whose odometry is out: it is integrated, but not published a second time.

Other subscribers acknowledge nothing. In the place of acknowledgements comes a round trip to the next Zenoh router: it
closes a query that nobody answers once all messages before the query have passed.
"""

from __future__ import annotations

import math
import secrets
import struct
import threading
import time
from collections import deque
from typing import Any, Final

import zenoh

from omnibench.errors import OmnibenchError
from omnibench.live.network import is_connected
from omnibench.live.stopping import Closing, direct, wait_until
from omnibench.live.topics import Publisher
from omnibench.live.wire import Flow

WINDOW: Final = 256  # messages under way at most, some 90 kB: less than Zenoh's queue holds; chosen
_POLL_PERIOD: Final = 0.05  # s between two looks at whether a signal came; chosen
_LONGEST_POLL: Final = 0.5  # s; a look that takes longer is one at which this process stood still; chosen
_FIRST_RETRY: Final = 0.5  # s without an acknowledgement after which messages are sent again; chosen
_LAST_RETRY: Final = 4.0  # s, to which this time doubles; chosen
_GAP_RETRY: Final = 0.1  # s in which one gap is reported by many acknowledgements; chosen
_MOST_FLOWS: Final = 16  # to one robot at once; another one takes the oldest one's place; chosen
_ACKNOWLEDGEMENT: Final = struct.Struct("<Q?")  # number that is expected next, and if a message after a gap was refused


class DeliveryError(OmnibenchError):
    """Messages did not reach their receiver."""

    exit_code = 1


class Delivery(Closing):
    """The sender: publishes messages to a robot's topics, and waits where too many are under way.

    passed: messages that are known to have reached the node or, without one, the next router. paused: s that the sender
    has waited for a receiver. restarts: how often another node went on in the place of one that had gone.
    acknowledged: an omnibench node runs the robot; to be set before the first message. stop: ends any waiting.
    patience: s without any sign of the receiver after which it is given up, of which those do not count in which this
    process itself was suspended.
    """

    def __init__(self, session: zenoh.Session, robot: str, stop: threading.Event, patience: float) -> None:
        self.passed = self.restarts = 0
        self.paused = 0.0
        self.acknowledged = False
        self._session, self._robot = session, robot
        self._stop, self._patience = stop, patience
        self._lock = threading.Lock()
        self._under_way: deque[tuple[Publisher[Any], bytes, int]] = deque()  # from number ``passed`` on
        self._sign = threading.Event()  # of the receiver, since the last look
        self._waited = 0.0  # s without any sign of the receiver
        self._progress_at = self._sent_again_at = -math.inf
        self._retry = _FIRST_RETRY
        self._gap = False
        self._node: str | None = None  # the node's session, as its acknowledgements name it
        self._flow = secrets.randbits(64)
        self._subscriber = session.declare_subscriber(_key(robot, self._flow), direct(self._take_acknowledgement))

    def put(self, publisher: Publisher[Any], payload: bytes) -> bool:
        """Publish a payload as soon as there is room for it; False if ``stop`` was set before.

        DeliveryError: the receiver is given up.
        """
        began = time.monotonic()
        # Wait while the window is full, or while the node has been silent for long.
        while not self._stop.is_set() and (
            self._look(WINDOW) >= WINDOW or self._gap or (self.acknowledged and self._silence() >= _FIRST_RETRY)
        ):
            self._wait(self._sign)
        waited = time.monotonic() - began
        self.paused += waited if waited > _FIRST_RETRY else 0.0
        if self._stop.is_set():
            return False
        number = publisher.next_number()
        with self._lock:
            if not self._under_way:
                self._progress_at, self._waited = time.monotonic(), 0.0
            place = self._flow, self.passed + len(self._under_way), self.passed, False
            self._under_way.append((publisher, payload, number))
        publisher.put_numbered(payload, number, place if self.acknowledged else None)
        return True

    def finish(self) -> None:
        """Wait until all has arrived, or a short time if ``stop`` is set. DeliveryError: the receiver is given up."""
        while self._look(1) and not self._stop.is_set():
            self._wait(self._sign)
        # After a stop what is under way may still arrive.
        wait_until(lambda: not (self._under_way and self.acknowledged), _FIRST_RETRY)

    def close(self) -> None:
        """Take no more acknowledgements."""
        self._subscriber.undeclare()

    def _silence(self) -> float:
        """Time since the last progress of what is under way, s."""
        return time.monotonic() - self._progress_at if self._under_way else 0.0

    def _wait(self, sign: threading.Event) -> None:
        """Wait for a sign of the receiver for a moment. DeliveryError: there was none for too long."""
        began = time.monotonic()
        sign.wait(_POLL_PERIOD)
        self._sign.clear()
        self._waited += min(time.monotonic() - began, _LONGEST_POLL)
        if self._waited > self._patience:
            who, rights = "its node" if self.acknowledged else "the router", ""
            if self.acknowledged and not self.passed:
                rights = f" (may this session read {_key(self._robot, '*')}?)"
            silence = f"{who} has taken nothing for {self._silence():.0f} s"
            raise DeliveryError(f"{silence}{rights}; `wait` says how long to wait")

    def _look(self, least: int) -> int:
        """Number of messages under way, after what seems lost was sent again, or ``least`` made a round trip."""
        if self.acknowledged:
            self._send_again()
        elif len(self._under_way) >= least:
            self._make_round_trip()
        return len(self._under_way)

    def _send_again(self) -> None:
        """Send all that is under way once more if some of it seems lost."""
        again = time.monotonic() - self._sent_again_at
        overdue = min(self._silence(), again) > self._retry
        if not overdue and not (self._gap and again > _GAP_RETRY):
            return
        self._retry = min(2 * self._retry, _LAST_RETRY) if overdue else self._retry
        with self._lock:
            self._gap = False
            first, messages = self.passed, list(self._under_way)
        self._sent_again_at = time.monotonic()
        for place, (publisher, payload, number) in enumerate(messages, first):
            if self._stop.is_set():
                return
            publisher.put_numbered(payload, number, (self._flow, place, self.passed, True))

    def _make_round_trip(self) -> None:
        """Wait until the router closes a query that follows all messages. DeliveryError: it does not, or it is gone."""
        linked, closed = is_connected(self._session), threading.Event()
        handler: Any = zenoh.handlers.Callback(lambda _: None, closed.set, indirect=False)
        # Zenoh closes the query at its timeout too, which must come after our patience
        options: dict[str, Any] = {"timeout": 2 * self._patience, "priority": zenoh.Priority.BACKGROUND}
        self._session.get(_key(self._robot, "nobody"), handler, **options)
        while not closed.is_set() and not self._stop.is_set():
            self._wait(closed)
        if linked and not is_connected(self._session) and not self._stop.is_set():
            raise DeliveryError("the link to the router was lost")  # which closes a query, too
        if closed.is_set():
            self._pass(self.passed + len(self._under_way))

    def _take_acknowledgement(self, sample: zenoh.Sample) -> None:
        """Note what the node expects next; in Zenoh's thread."""
        try:
            expected, gap = _ACKNOWLEDGEMENT.unpack(sample.payload.to_bytes())
        except struct.error:
            return
        self._pass(expected)
        if gap and self._under_way:
            self._gap = True
        if sample.timestamp is not None and (node := str(sample.timestamp.get_id())) != self._node:
            self.restarts += self._node is not None
            self._node = node
        self._sign.set()

    def _pass(self, number: int) -> None:
        """Forget the messages before ``number``, which have arrived."""
        with self._lock:
            passed = min(number - self.passed, len(self._under_way))
            for _ in range(passed):
                self._under_way.popleft()
            if passed > 0:
                self.passed += passed
                self._progress_at, self._waited, self._retry = time.monotonic(), 0.0, _FIRST_RETRY


class AcknowledgedFlows:
    """The receiver: the flows to one robot. For one thread.

    expected: flow -> number of its next message, which outlives the node with the odometry that holds those before it.
    """

    def __init__(self, session: zenoh.Session, robot: str, expected: dict[int, int]) -> None:
        self._session, self._robot = session, robot
        self._expected = expected
        self._gaps: dict[int, bool] = {}  # flow -> a message after a gap came, since the last acknowledgement
        self._begun: set[int] = set()  # flows of which a message was taken that its sender sent for the first time

    def accepts(self, place: Flow) -> bool:
        """True if a message at this place is the flow's next one, and is to be taken."""
        flow, number, unacknowledged, again = place
        expected = max(self._expected.get(flow, 0), unacknowledged)  # the sender does not repeat what another node took
        accepted = number == expected
        self._expected[flow] = expected + accepted
        self._gaps[flow] = self._gaps.get(flow, False) or number > expected
        if accepted and not again:
            self._begun.add(flow)
        if len(self._expected) > _MOST_FLOWS:
            oldest = next(iter(self._expected))
            del self._expected[oldest]
            self._gaps.pop(oldest, None)
            self._begun.discard(oldest)
        return accepted

    def inherited(self, place: Flow) -> bool:
        """True if the odometry of a message that was accepted may be out already, published by a node before this."""
        return place[0] not in self._begun

    @property
    def heard(self) -> bool:
        """True if there were messages since the last acknowledgement."""
        return bool(self._gaps)

    def acknowledge(self) -> None:
        """Tell the senders of all messages since the last call which number is expected next."""
        for flow, gap in self._gaps.items():
            self._session.put(
                _key(self._robot, flow),
                _ACKNOWLEDGEMENT.pack(self._expected[flow], gap),
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
            )
        self._gaps.clear()


def _key(robot: str, flow: int | str) -> str:
    """The key to which a node acknowledges a flow; ``*`` stands for all."""
    return f"omnibench/{robot}/received/{flow if isinstance(flow, str) else format(flow, 'x')}"
