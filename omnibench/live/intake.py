"""Intake: what arrives for a node's robots is queued in Zenoh's threads, and worked off in one thread of the node.

Zenoh's threads are then free to receive, and what waits can be seen: a robot whose samples wait for long gets all of
them integrated at its turn and only the newest pose published (``robot_service``).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue

from omnibench.live.closing import Closing


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
        while (work := self._work.get()) is not None:
            work()
