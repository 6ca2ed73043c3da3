"""Published stamps: none is published twice, since listeners such as tf2 take a repeated stamp for repeated data."""

from __future__ import annotations

from array import array
from bisect import bisect_left


class PublishedStamps:
    """Stamps (ns) that were published, to be told apart from those that come when the robot's clock jumps back.

    The stamps are kept in sorted runs, from the oldest published to the latest. While the clock goes forward the latest
    run grows at its end. When it jumps back a new run begins, and neighbours of similar length are merged, so that
    there are never more than some twenty runs to search.

    remembered: how many of the latest stamps are kept at least (8 bytes each). A stamp older than these can be
    published twice by chance, after a clock that jumped back so far.
    """

    def __init__(self, remembered: int = 120_000) -> None:
        self._remembered = remembered
        self._longest = max(remembered // 4, 1)  # run; the oldest is forgotten as a whole
        self._runs: list[array[int]] = [array("q")]
        self._count = 0
        self._highest: int | None = None
        self._shift = 1  # ns by which the last repeated stamp was moved; a recording in a loop moves all alike

    def unique(self, stamp: int) -> int:
        """``stamp``, or the next free one (ns) if it was published already; the result counts as published."""
        if self._highest is None or stamp > self._highest:
            self._highest = stamp
        elif self._holds(stamp):
            shift = self._shift if not self._holds(stamp + self._shift) else self._free_shift(stamp)
            self._shift = shift
            stamp += shift
            self._highest = max(stamp, self._highest)
        latest = self._runs[-1]
        if latest and (stamp < latest[-1] or len(latest) >= self._longest):
            self._merge()
            self._runs.append(latest := array("q"))
        latest.append(stamp)
        self._count += 1
        while self._count - len(self._runs[0]) >= self._remembered and len(self._runs) > 1:
            self._count -= len(self._runs.pop(0))
        return stamp

    def _holds(self, stamp: int) -> bool:
        return any(run[0] <= stamp <= run[-1] and run[bisect_left(run, stamp)] == stamp for run in self._runs if run)

    def _free_shift(self, stamp: int) -> int:
        shift = self._shift + 1
        while self._holds(stamp + shift):
            shift += 1
        return shift

    def _merge(self) -> None:
        """Merge the latest runs until each is more than twice as long as the next, or would become too long."""
        runs = self._runs
        while len(runs) > 1 and len(runs[-2]) <= 2 * len(runs[-1]) and len(runs[-2]) + len(runs[-1]) <= self._longest:
            latest = runs.pop()
            runs[-1] = array("q", sorted(runs[-1] + latest))
