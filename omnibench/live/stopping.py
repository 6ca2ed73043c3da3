"""Stopping a command that runs until a signal, a time limit or an event."""

from __future__ import annotations

import math
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self


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
    signals = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in signals}

    def restore() -> None:
        for number in signals:
            signal.signal(number, before[number])

    def handle(number: int, _frame: object) -> None:
        stop.number = number
        # In a thread: the signal may interrupt a method of the event, which holds the lock that set() needs.
        threading.Thread(target=stop.set).start()
        restore()

    for number in signals:
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
