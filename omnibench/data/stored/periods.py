"""The usual period of many wheel samples, also of more than fit in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from omnibench.robot.kinematics import Array

_TOGETHER = 5_000_000  # periods whose median is taken at once; of more it is found bit by bit (chosen)
_BITS = 20  # bits that are counted at a time: twice, which leaves 2^-29 of the median open (chosen)
_MASK = (1 << _BITS) - 1


class Sampled(Protocol):
    """A run, or a log, of which the ends of the wheel samples are known."""

    @property
    def times(self) -> Array: ...


def median_period(runs: Sequence[Sampled]) -> float:
    """The median time between the wheel samples of runs, the start being the first, s.

    It is robust to jitter and gaps. Of very many samples it is one of the middle periods, to 2e-9 of itself.
    """
    count = sum(len(run.times) for run in runs)
    if count <= _TOGETHER:
        return float(np.median(np.concatenate(list(_periods(runs)))))
    prefix, rank = 0, count // 2
    for shift in (63 - _BITS, 63 - 2 * _BITS):  # positive floats are ordered as their bits are
        counts = np.zeros(1 << _BITS, dtype=np.int64)
        for periods in _joined(_periods(runs)):
            bits = np.maximum(periods, 0.0).view(np.int64) >> shift
            counts += np.bincount(bits[bits >> _BITS == prefix] & _MASK, minlength=len(counts))
        place = int(np.searchsorted(np.cumsum(counts), rank, side="right"))
        prefix, rank = prefix << _BITS | place, rank - int(counts[:place].sum())
    return float(np.array(prefix << shift, dtype=np.int64).view(float))


def _joined(parts: Iterator[Array]) -> Iterator[Array]:
    """Values in larger parts, beside which the counts of one part are few."""
    kept, count = list[Array](), 0
    for part in parts:
        kept, count = [*kept, part], count + len(part)
        if count > 1 << _BITS:
            yield np.concatenate(kept)
            kept, count = [], 0
    if kept:
        yield np.concatenate(kept)


def _periods(runs: Sequence[Sampled]) -> Iterator[Array]:
    """The periods (F,) of each run, s."""
    for run in runs:
        yield np.diff(run.times, prepend=0.0)
