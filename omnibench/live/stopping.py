"""Ending a command that runs until it is told to stop."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set, in place of ending the process. For the main thread.

    A second signal acts as it would without this: nobody has to wait for a command that cannot end.
    """
    stop = threading.Event()
    watched = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in watched}

    def restore() -> None:
        for number in watched:
            signal.signal(number, before[number])

    def heard(_number: int, _frame: object) -> None:
        # In a thread, because the signal may find us inside the event, holding the lock that setting it takes.
        threading.Thread(target=stop.set).start()
        restore()

    for number in watched:
        signal.signal(number, heard)
    try:
        yield stop
    finally:
        restore()


def ticks(stop: threading.Event, period: float, seconds: float | None = None) -> Iterator[float]:
    """Times since the start, s: 0, then one every ``period`` s until ``stop`` is set or ``seconds`` are over."""
    began = time.monotonic()
    end = math.inf if seconds is None else seconds
    passed = 0.0
    while passed < end and not stop.is_set():
        yield passed
        passed = time.monotonic() - began
        stop.wait(min(period, max(end - passed, 0.0)))
        passed = time.monotonic() - began
