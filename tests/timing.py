"""Processor time of a call, which other processes do not lengthen as they do wall time, waiting, and load."""

import os
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PATIENCE = 300.0  # s: who waits longer for an event waits in vain, however busy the machine is (chosen)


def processor_time(call: Callable[[], object], repetitions: int = 3) -> float:
    """The least processor time, s, of this thread that a call took in some repetitions."""
    times = []
    for _ in range(repetitions):
        began = time.thread_time()
        call()
        times.append(time.thread_time() - began)
    return min(times)


@contextmanager
def load(loops: int) -> Iterator[None]:
    """So many loops for each core, which keep the machine busy."""
    running = [subprocess.Popen(["/bin/sh", "-c", "while :; do :; done"]) for _ in range(loops * (os.cpu_count() or 1))]
    try:
        yield
    finally:
        for each in running:
            each.kill()
            each.wait()


def until(condition: Callable[[], object], what: str) -> None:
    """Wait until ``condition`` holds; the test fails, saying ``what`` was waited for, when it does not in time."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"waited {PATIENCE} s in vain for {what}"
        time.sleep(0.005)
