"""The attachment of a message: its number and its publisher, by which receivers can tell what they missed.

Its 33 bytes are those of rmw_zenoh: number, time of publishing (ns), and the publisher's identity of 16 bytes. Messages
whose delivery is acknowledged add 25 bytes, which ROS 2 passes over: the flow's identity, the message's number in the
flow, the lowest number that the sender has no acknowledgement of, and whether the message was sent before.
"""

from __future__ import annotations

import struct
import time
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Final

import zenoh

_HEAD: Final = struct.Struct("<qqB16s")
_IDENTITY_LENGTH: Final = 16  # bytes
_FLOW: Final = struct.Struct("<QQQ?")
_MOST_PUBLISHERS: Final = 1000  # whose numbers are remembered; the first to come are forgotten; chosen
_MOST_MISSING: Final = 10_000  # numbers of a publisher that may still come; chosen

Flow = tuple[int, int, int, bool]
"""A flow's identity, a message's number in it, the lowest number not acknowledged, and if it was sent before."""


def packed(number: int, publisher: bytes, flow: Flow | None = None) -> bytes:
    """The attachment of a message that is published now. publisher: its identity, 16 bytes."""
    head = _HEAD.pack(number, time.time_ns(), _IDENTITY_LENGTH, publisher)
    return head if flow is None else head + _FLOW.pack(*flow)


def flow_of(attachment: bytes | None) -> Flow | None:
    """A message's place in its flow; None if its delivery is not acknowledged."""
    if attachment is None or len(attachment) != _HEAD.size + _FLOW.size or not _is_numbered(attachment):
        return None
    flow, number, unacknowledged, again = _FLOW.unpack_from(attachment, _HEAD.size)
    return flow, number, unacknowledged, again


def _is_numbered(attachment: bytes) -> bool:
    """True for an attachment of rmw_zenoh's form, with a flow or without; those of other programs tell nothing."""
    return len(attachment) in (_HEAD.size, _HEAD.size + _FLOW.size) and attachment[16] == _IDENTITY_LENGTH


@dataclass(slots=True)
class _Numbers:
    """Numbers of one publisher: the highest that came, and those below it that did not, in increasing order."""

    highest: int
    missing: OrderedDict[int, None] = field(default_factory=OrderedDict)


class MissedMessages:
    """Counts the messages that were published and did not come, by the gaps in each publisher's numbers.

    count: messages missed so far; one that comes after all is taken off again. Those before a publisher's first message
    to come are not missed. Messages without an attachment, of other programs, tell nothing.
    """

    def __init__(self) -> None:
        self.count = 0
        self._publishers: dict[bytes, _Numbers] = {}

    def take(self, attachment: zenoh.ZBytes | bytes | None) -> int | None:
        """The number of messages right before a new one that were published and have not come.

        None if the message is of an acknowledged flow and came before.
        """
        content = attachment.to_bytes() if isinstance(attachment, zenoh.ZBytes) else attachment or b""
        if not _is_numbered(content):
            return 0
        number, _, _, publisher = _HEAD.unpack_from(content)
        numbers = self._publishers.get(publisher)
        if numbers is None:
            self._publishers[publisher] = _Numbers(number)
            if len(self._publishers) > _MOST_PUBLISHERS:
                del self._publishers[next(iter(self._publishers))]
            return 0
        gap = number - numbers.highest - 1
        if gap >= 0:
            numbers.highest = number
            if gap:
                self.count += gap
                numbers.missing.update(dict.fromkeys(range(number - min(gap, _MOST_MISSING), number)))
                while len(numbers.missing) > _MOST_MISSING:
                    numbers.missing.popitem(last=False)
            return gap
        if number not in numbers.missing:
            return 0 if len(content) == _HEAD.size else None  # only what is acknowledged is ever sent again
        del numbers.missing[number]
        self.count -= 1
        return 0
