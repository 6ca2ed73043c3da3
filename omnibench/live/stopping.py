"""Stopping a command that runs until a signal, a time limit or an event, and callbacks of threads meanwhile."""

from __future__ import annotations

import math
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event
from typing import Any, Final, Self

import zenoh
from zenoh.handlers import Callback


class Closing(ABC):
    """Context manager whose end calls ``close``."""

    @abstractmethod
    def close(self) -> None:
        """End the work and release what it holds."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Stop(threading.Event):
    """An event that signals set. number: the first of them."""

    number: int = signal.SIGINT

    def interrupt(self) -> None:
        """Act as that signal usually does: where what waits has nothing yet that could end in order."""
        signal.raise_signal(self.number)


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """An event that Ctrl-C and SIGTERM set instead of ending the process. For the main thread.

    A second signal acts as usual, in case the command does not end.
    """
    stop = Stop()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def handle(number: int, _frame: object) -> None:
        stop.number = number
        # In a thread: the signal may interrupt a method of the event, which holds the lock that set() needs.
        threading.Thread(target=stop.set).start()
        restore()

    for number in before:
        signal.signal(number, handle)
    try:
        yield stop
    finally:
        restore()


def wait_until(
    condition: Callable[[], bool], seconds: float, stop: threading.Event | None = None, period: float = 0.01
) -> bool:
    """True once a condition holds, which is tried every ``period`` s; False after ``seconds`` or if ``stop`` is set."""
    deadline = time.monotonic() + seconds
    stop = stop or threading.Event()
    while not condition():
        if time.monotonic() >= deadline or stop.wait(period):
            return False
    return True


def ticks(stop: threading.Event, period: float, seconds: float | None = None) -> Iterator[float]:
    """The time since the start, s: 0, then every ``period`` s until ``stop`` is set or ``seconds`` have passed."""
    began = time.monotonic()
    end = math.inf if seconds is None else seconds
    passed = 0.0
    while passed < end and not stop.is_set():
        yield passed
        passed = time.monotonic() - began
        stop.wait(min(period, max(end - passed, 0.0)))
        passed = time.monotonic() - began


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
