"""Processor time of a call, which other processes do not lengthen as they do wall time, and how long to wait."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE = 300.0  # s: who waits longer for an event waits in vain, however busy the machine is (chosen)


def processor_time(call: Callable[[], object], repetitions: int = 3) -> float:
    """The least processor time, s, of this thread that a call took in some repetitions."""
    times = []
    for _ in range(repetitions):
        began = time.thread_time()
        call()
        times.append(time.thread_time() - began)
    return min(times)
