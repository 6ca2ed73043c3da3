"""Low latency for wheel samples: the interpreter's garbage collector and thread switching, while a node runs."""

from __future__ import annotations

import gc
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_SWITCH_INTERVAL = 0.0005  # s that a busy thread keeps the interpreter while others wait; Python's own is 0.005

_running = 0  # nodes of this process
_lock = threading.Lock()
_usual_interval = sys.getswitchinterval()


@contextmanager
def low_latency() -> Iterator[None]:
    """While any node of this process is in this context, nothing else keeps the interpreter from a sample for long.

    The garbage collector passes over the objects that are there at the start, and a busy thread (the query server with
    a large calibration) gives way after 0.5 ms.
    """
    global _running
    with _lock:
        _running += 1
        gc.collect()
        gc.freeze()
        sys.setswitchinterval(_SWITCH_INTERVAL)
    try:
        yield
    finally:
        with _lock:
            _running -= 1
            if not _running:
                gc.unfreeze()
                sys.setswitchinterval(_usual_interval)
