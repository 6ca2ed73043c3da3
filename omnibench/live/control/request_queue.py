"""Fair queue of requests: every client has a lane of its own, and the lanes are served in turn."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, zip_longest
from typing import Final

import zenoh

MOST_WAITING: Final = 64  # requests that wait; chosen


def source_of(session: zenoh.Session) -> zenoh.SourceInfo:
    """What a request carries so that the node knows its client; Zenoh itself does not say who asks."""
    return zenoh.SourceInfo(session.id, 0)


def client_of(message: zenoh.Query | zenoh.Sample, unnamed: str) -> str:
    """The client that a request names (``source_info``), or else ``unnamed``."""
    return unnamed if message.source_info is None else str(message.source_info.source_id.zid)


@dataclass(frozen=True)
class Request:
    """A request that waits. client: its lane; answer: serve it; refuse: answer with a reason instead."""

    client: str
    answer: Callable[[], None]
    refuse: Callable[[str], None]


class RequestQueue:
    """At most ``MOST_WAITING`` requests. When it is full the client with the most of them loses its last one.

    Safe to call from any thread.
    """

    def __init__(self) -> None:
        self._lanes: dict[str, deque[Request]] = {}
        self._count = 0
        self._closed = False
        self._changed = threading.Condition()

    def put(self, request: Request) -> Request | None:
        """Queue a request; the one that has to be refused for it, which may be itself, or None."""
        with self._changed:
            if self._closed:
                return request
            excess = None
            if self._count >= MOST_WAITING:
                longest = max(self._lanes, key=lambda client: len(self._lanes[client]))
                if len(self._lanes[longest]) - len(self._lanes.get(request.client, ())) <= 1:
                    return request
                excess = self._lanes[longest].pop()
                self._count -= 1
            self._lanes.setdefault(request.client, deque()).append(request)
            self._count += 1
            self._changed.notify()
            return excess

    def take(self) -> list[Request]:
        """All requests that wait, each client's first before anybody's second; empty when the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._count or self._closed)
            lanes, self._lanes, self._count = list(self._lanes.values()), {}, 0
        return [request for request in chain.from_iterable(zip_longest(*lanes)) if request is not None]

    def close(self) -> None:
        """Take no more requests; those that wait are still given out."""
        with self._changed:
            self._closed = True
            self._changed.notify()
