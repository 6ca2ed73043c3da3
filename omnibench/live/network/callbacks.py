"""Callbacks in Zenoh's own threads, answers to a query collected by them, and a rate limiter of log lines."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from threading import Event
from typing import Any, Final

import zenoh
from zenoh.handlers import Callback

from omnibench.live.stopping import wait_until

PERIOD: Final = 10.0  # s between two lines of the same kind; chosen


class RateLimiter:
    """Allows one line of each kind in ``period`` s (infinity: one in all). Safe to call from any thread."""

    def __init__(self, period: float = PERIOD) -> None:
        self._period = period
        self._last: dict[str, float] = {}  # kind -> when a line was allowed, within the period
        self._lock = threading.Lock()

    def allows(self, kind: str) -> bool:
        """True if a line of this kind may be logged now, which then counts as logged."""
        now = time.monotonic()
        with self._lock:
            self._last = {other: at for other, at in self._last.items() if now - at < self._period}
            if kind in self._last:
                return False
            self._last[kind] = now
            return True


_LOOK: Final = 0.002  # s between two looks at whether all have answered; chosen


def direct(callback: Callable[[Any], None]) -> Any:
    """A handler that calls ``callback`` with each message in the thread that receives it: it must be quick."""
    return Callback(callback, indirect=False)


def answers(get: Callable[[Any, float], object], timeout: float, stop: Event | None = None) -> list[zenoh.Sample]:
    """The answers to a query, but for refusals, as soon as all are there; ``stop`` ends the waiting.

    get: begins the query, given a handler and the timeout (s).
    """
    came: list[zenoh.Sample] = []
    over = Event()

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            came.append(reply.ok)

    get(Callback(take, over.set, indirect=False), timeout)
    wait_until(over.is_set, 2 * timeout, stop, _LOOK)
    return came
