"""Jobs that keep a processor busy, for studies of the backends; workers import them from here."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.progress import Progress, Reporter


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


@dataclass(frozen=True)
class Drawn:
    """Result of a job that draws from data: its number, and the mean of what it drew."""

    number: int
    mean: float


def draw(order: tuple[int, float, NDArray[np.float64]], report: Reporter) -> Drawn:
    """Keep the processor busy for so many seconds, then draw from the data by a seed of the job's own."""
    number, seconds, data = order
    end = time.perf_counter() + seconds
    while (left := end - time.perf_counter()) > 0:
        report(Progress("drawing", int(1000 * (seconds - left))))
        np.sort(data)
    return Drawn(number, float(np.random.default_rng(number).choice(data, 10_000).mean()))
