"""No stamp twice: listeners (tf2 among them) take a repeated stamp for repeated data."""

from __future__ import annotations

from array import array
from bisect import bisect_left


class PublishedStamps:
    """Stamps (ns) that were published, so that none is again when the robot's clock jumps back.

    They are kept in runs, each sorted, from the oldest published to the latest. While the clock goes forward the latest
    run grows at its end; whenever it jumps back a new one begins, and neighbours of like length are merged, so that
    however often it jumps there are some twenty runs to look into.

    remembered: how many of the latest are kept at least (8 bytes each); after a clock that jumps back further than
    these reach, a stamp can meet a forgotten one by chance.
    """

    def __init__(self, remembered: int = 120_000) -> None:
        self._remembered = remembered
        self._longest = max(remembered // 4, 1)  # run; the oldest is forgotten as a whole
        self._runs: list[array[int]] = [array("q")]
        self._count = 0
        self._highest: int | None = None
        self._shift = 1  # ns that the last repeated stamp was moved; a recording played in a loop moves all alike

    def unique(self, stamp: int) -> int:
        """``stamp``, or one soon after it (ns) when it was published already; from now on it is."""
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
