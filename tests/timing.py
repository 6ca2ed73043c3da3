"""Processor time of a call, which other processes on the machine do not lengthen as they do wall time."""

from __future__ import annotations

import time
from collections.abc import Callable


def processor_time(call: Callable[[], object], repetitions: int = 3) -> float:
    """The least processor time, s, of this thread that a call took in some repetitions."""
    times = []
    for _ in range(repetitions):
        began = time.thread_time()
        call()
        times.append(time.thread_time() - began)
    return min(times)
