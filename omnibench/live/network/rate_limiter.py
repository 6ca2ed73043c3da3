"""A log that a flood of mistakes does not flood."""

from __future__ import annotations

import math
import threading
import time
from typing import Final

PATIENCE: Final = 10.0  # s between two lines of the same kind


class RateLimiter:
    """Lets a line of each kind through, and the next one ``patience`` s later (infinity: never). Any thread may ask."""

    def __init__(self, patience: float = PATIENCE) -> None:
        self._patience = patience
        self._told: dict[str, float] = {}
        self._lock = threading.Lock()

    def allows(self, kind: str) -> bool:
        """Whether a line of this kind, of which there are few, is due; then it counts as told."""
        now = time.monotonic()
        with self._lock:
            if now - self._told.get(kind, -math.inf) < self._patience:
                return False
            self._told[kind] = now
            return True
