"""Published stamps: none is published twice, since listeners such as tf2 take a repeated stamp for repeated data."""

from __future__ import annotations

from collections import deque
from itertools import count


class PublishedStamps:
    """Stamps (ns) that were published, to be told apart from those that come when the robot's clock jumps back.

    remembered: how many of the latest stamps are kept (some 80 bytes each). A stamp older than these can be published
    twice by chance, after a clock that jumped back so far.
    """

    def __init__(self, remembered: int = 120_000) -> None:
        self._remembered = remembered
        self._order: deque[int] = deque()
        self._known: set[int] = set()  # the stamps of _order, for looking up
        self._shift = 1  # ns by which the last repeated stamp was moved; a recording in a loop moves all alike

    def __len__(self) -> int:
        return len(self._order)

    def unique(self, stamp: int) -> int:
        """``stamp``, or the next free one (ns) if it was published already; the result counts as published."""
        if stamp in self._known:
            if stamp + self._shift in self._known:
                longer = count(self._shift + 1)
                self._shift = next(shift for shift in longer if stamp + shift not in self._known)
            stamp += self._shift
        if len(self._order) == self._remembered:
            self._known.remove(self._order.popleft())
        self._order.append(stamp)
        self._known.add(stamp)
        return stamp
