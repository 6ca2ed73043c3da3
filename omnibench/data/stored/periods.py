"""The usual period of many wheel samples, also of more than fit in memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from omnibench.data.stored.stored_rows import MOST_IN_MEMORY, noted
from omnibench.robot.kinematics import Array


class Sampled(Protocol):
    """A run, or a log, of which the ends of the wheel samples are known."""

    @property
    def times(self) -> Array: ...


def median_period(runs: Sequence[Sampled]) -> float:
    """The median time between the wheel samples of runs, the start being the first, s.

    It is robust to jitter and gaps. Of very many samples it is the period of the run in the middle: the median of the
    runs' medians, each of which counts as often as it has samples.
    """
    counts = np.array([len(run.times) for run in runs])
    if counts.sum() <= MOST_IN_MEMORY:
        return float(np.median(np.concatenate([_periods(run) for run in runs])))
    medians = np.array([period_of(run) for run in runs])
    order = np.argsort(medians, kind="stable")
    passed = np.cumsum(counts[order])
    return float(medians[order][np.searchsorted(passed, passed[-1] / 2)])


def period_of(run: Sampled) -> float:
    """The median time between the wheel samples of a run, s."""
    return noted(run.times, "period", lambda: float(np.median(_periods(run))))


def _periods(run: Sampled) -> Array:
    """The periods (F,) of a run, s."""
    periods: Array = np.diff(run.times, prepend=0.0)
    return periods
