"""Jobs that keep a processor busy, for studies of the backends; workers import them from here."""

from __future__ import annotations

import time
from dataclasses import dataclass

from omnibench.progress import Reporter


@dataclass(frozen=True)
class Done:
    """Result of a job: its number."""

    number: int


def busy(order: tuple[int, float], _: Reporter) -> Done:
    """Keep the processor busy for so many seconds."""
    number, seconds = order
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        pass
    return Done(number)
