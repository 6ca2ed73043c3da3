"""No stamp twice: listeners (tf2 among them) take a repeated stamp for repeated data."""

from __future__ import annotations

from array import array
from bisect import bisect_left


class PublishedStamps:
    """Stamps (ns) that were published, so that none is again when the robot's clock jumps back.

    remembered: how many of the latest are kept at least (8 bytes each); after a clock that jumps back further than
    these reach, a stamp can meet a forgotten one by chance.
    """

    def __init__(self, remembered: int = 120_000) -> None:
        self._remembered = remembered
        self._runs: list[array[int]] = [array("q")]  # each increasing; the last one is being published
        self._count = 0

    def unique(self, stamp: int) -> int:
        """``stamp``, or the next ns that was not published yet; from now on it is."""
        current = self._runs[-1]
        if len(self._runs) > 1 or (current and stamp <= current[-1]):  # the clock has jumped back
            while any(_holds(run, stamp) for run in self._runs):
                stamp += 1
            if current and stamp < current[-1]:
                self._runs.append(array("q"))
        self._runs[-1].append(stamp)
        self._count += 1
        if self._count > 1.25 * self._remembered:  # now and then, many at once
            self._forget(self._count - self._remembered)
        return stamp

    def _forget(self, excess: int) -> None:
        self._count -= excess
        while excess >= len(self._runs[0]) and len(self._runs) > 1:
            excess -= len(self._runs.pop(0))
        del self._runs[0][:excess]


def _holds(run: array[int], stamp: int) -> bool:
    if not run or stamp > run[-1]:
        return False
    return run[bisect_left(run, stamp)] == stamp
