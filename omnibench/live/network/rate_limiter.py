"""Limiting how often a message of the same kind is logged."""

from __future__ import annotations

import math
import threading
import time
from typing import Final

PERIOD: Final = 10.0  # s between two lines of the same kind; chosen


class RateLimiter:
    """Allows one line of each kind every ``period`` s (infinity: one in all). Safe to call from any thread."""

    def __init__(self, period: float = PERIOD) -> None:
        self._period = period
        self._last: dict[str, float] = {}  # kind -> when a line was last allowed
        self._lock = threading.Lock()

    def allows(self, kind: str) -> bool:
        """True if a line of this kind may be logged now, which then counts as logged. Kinds are kept for ever."""
        now = time.monotonic()
        with self._lock:
            if now - self._last.get(kind, -math.inf) < self._period:
                return False
            self._last[kind] = now
            return True
