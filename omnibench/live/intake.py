"""Intake: what arrives for a node's robots is queued in Zenoh's threads, and worked off in one thread of the node.

Zenoh's threads are then free to receive, and what waits can be seen: a robot whose samples wait for long gets all of
them integrated at its turn and only the newest pose published (``robot_service``). Where the thread is busy it pauses
for a moment between turns, so that messages come together: to hand the interpreter over for each one costs as much as
to take it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from queue import SimpleQueue
from typing import Final

from omnibench.errors import one_line
from omnibench.live.closing import Closing

LOG = logging.getLogger("omnibench.live")
_PAUSE: Final = 0.002  # s between turns while the thread is busy; chosen
_BUSY: Final = 0.5  # share of the time in which it works, from which on it pauses; chosen
_SMOOTHING: Final = 0.1  # share of the latest turn in the mean; chosen


class Intake(Closing):
    """Runs the work that is handed to ``ready``, in turn, in a thread of its own until ``close``."""

    def __init__(self) -> None:
        self._work: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="intake", daemon=True)
        self._thread.start()

    def ready(self, work: Callable[[], object]) -> None:
        """Queue a piece of work, which must not raise. From any thread."""
        self._work.put(work)

    def close(self) -> None:
        """Do what is queued, and no more."""
        self._work.put(None)
        self._thread.join()

    def _run(self) -> None:
        worked = spent = 0.0  # s, recent turns weighing most
        last = time.perf_counter()
        while (work := self._work.get()) is not None:
            began = time.perf_counter()
            try:
                work()
            except Exception as error:  # one robot must not silence the others
                LOG.error("intake: %s: %s", type(error).__name__, one_line(str(error)))
            now = time.perf_counter()
            worked += _SMOOTHING * (now - began - worked)
            spent += _SMOOTHING * (now - last - spent)
            last = now
            if worked > _BUSY * spent:
                time.sleep(_PAUSE)
