"""Acknowledged flows: a node takes each message of a replay once and in order, and tells which it expects next.

The rule is go-back-n: a message after a gap is refused, and the sender sends again from the first that is missing. A
node that does not know a flow, since it has just started, expects the lowest number that the sender has no
acknowledgement of. What is sent again to it may have been taken by a node that was killed before it could acknowledge,
and whose odometry is out: it is integrated, but not published a second time.
"""

from __future__ import annotations

import struct
from typing import Final

import zenoh

from omnibench.live.wire.messages import Flow

_ACKNOWLEDGEMENT: Final = struct.Struct("<Q?")
_MOST_FLOWS: Final = 16  # of one robot at once; another one takes the oldest one's place; chosen


def acknowledgement_key(robot: str, flow: int | str) -> str:
    """The key to which a node acknowledges a flow; ``*`` stands for all."""
    return f"omnibench/{robot}/received/{flow if isinstance(flow, str) else format(flow, 'x')}"


def read_acknowledgement(payload: bytes) -> tuple[int, bool]:
    """The number that the node expects next, and whether it refused one after a gap. struct.error: it is damaged."""
    expected, gap = _ACKNOWLEDGEMENT.unpack(payload)
    return expected, gap


class _ReceivedFlow:
    """One flow to a robot.

    expected: number of its next message. gap: one after a gap was refused. inherited: only messages that were sent
    before have come, perhaps to another node.
    """

    def __init__(self, session: zenoh.Session, robot: str, flow: int, expected: int) -> None:
        self.expected = expected
        self.gap = False
        self.inherited = True
        self._publisher = session.declare_publisher(
            acknowledgement_key(robot, flow),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
        )

    def acknowledge(self) -> None:
        self._publisher.put(_ACKNOWLEDGEMENT.pack(self.expected, self.gap))
        self.gap = False

    def close(self) -> None:
        self._publisher.undeclare()


class AcknowledgedFlows:
    """The flows to one robot. For one thread.

    expected: flow -> number of its next message, which outlives the node with the odometry that holds those before it.
    """

    def __init__(self, session: zenoh.Session, robot: str, expected: dict[int, int]) -> None:
        self._session, self._robot = session, robot
        self._expected = expected
        self._flows: dict[int, _ReceivedFlow] = {}
        self._heard: set[_ReceivedFlow] = set()  # flows with messages since the last acknowledgement

    def accepts(self, place: Flow) -> bool:
        """True if a message at this place is the flow's next one, and is to be taken."""
        identity, number, unacknowledged, again = place
        flow = self._flows.get(identity)
        if flow is None:
            expected = self._expected.get(identity, 0)
            flow = self._flows[identity] = _ReceivedFlow(self._session, self._robot, identity, expected)
            if len(self._flows) > _MOST_FLOWS:
                self._forget(next(iter(self._flows)))
        self._heard.add(flow)
        flow.expected = max(flow.expected, unacknowledged)  # the sender does not repeat what another node took
        if number != flow.expected:
            flow.gap |= number > flow.expected
            return False
        flow.expected += 1
        self._expected[identity] = flow.expected
        flow.inherited &= again
        return True

    def inherited(self, place: Flow) -> bool:
        """True if the odometry of a message that was accepted may be out already, published by a node before this."""
        return self._flows[place[0]].inherited

    @property
    def heard(self) -> bool:
        """True if there were messages since the last acknowledgement."""
        return bool(self._heard)

    def acknowledge(self) -> None:
        """Tell the senders of all messages since the last call which number is expected next."""
        for flow in self._heard:
            flow.acknowledge()
        self._heard.clear()

    def close(self) -> None:
        """Acknowledge no more."""
        self._heard.clear()
        for flow in self._flows.values():
            flow.close()
        self._flows.clear()

    def _forget(self, identity: int) -> None:
        flow = self._flows.pop(identity)
        self._expected.pop(identity, None)
        self._heard.discard(flow)
        flow.close()
