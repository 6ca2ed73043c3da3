"""Limiting how often a message of the same kind is logged."""

from __future__ import annotations

import threading
import time
from typing import Final

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
