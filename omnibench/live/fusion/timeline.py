"""The last seconds of a robot: its motions, and the poses after them."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

from omnibench.live.estimation.live_odometry import Motion
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import advance

_SECOND = 1e9  # ns
_MOST_A_SECOND = 2000  # samples; a sender with nonsense for stamps shall not fill the memory


@dataclass(frozen=True, slots=True, eq=False)
class PoseMeasurement:
    """A pose in the map at its own time.

    arrival: s, monotonic. absolute: it replaces what the filter believes, instead of correcting it. heading_stamp: when
    its heading was taken, if that is another time.
    """

    stamp: int
    pose: Array
    covariance: Array
    arrival: float = 0.0
    absolute: bool = False
    heading_stamp: int | None = None

    @property
    def latest(self) -> int:
        """The time from which on all of it can be placed."""
        return self.stamp if self.heading_stamp is None else max(self.stamp, self.heading_stamp)

    @property
    def earliest(self) -> int:
        """The time since which motions must be known to place all of it."""
        return self.stamp if self.heading_stamp is None else min(self.stamp, self.heading_stamp)


@dataclass(slots=True, eq=False)
class Entry:
    """What is known at one wheel sample: the motion up to it, odometry's pose after it, and the filter's.

    measurements: poses in the map whose time lies within the motion, by time.
    """

    stamp: int
    motion: Motion
    odometry: Array
    pose: Array
    covariance: Array
    measurements: tuple[PoseMeasurement, ...] = ()


class Timeline:
    """Entries of at least the last ``seconds`` (up to 2 kHz), by stamp; one at least, once one was added."""

    def __init__(self, seconds: float) -> None:
        self._length = int(seconds * _SECOND)
        self._most = int(seconds * _MOST_A_SECOND)
        self.entries: list[Entry] = []
        self._stamps: list[int] = []

    @property
    def oldest(self) -> int:
        return self._stamps[0]

    @property
    def newest(self) -> int:
        return self._stamps[-1]

    def append(self, entry: Entry) -> None:
        """Add the newest entry and forget what is too old."""
        self.entries.append(entry)
        self._stamps.append(entry.stamp)
        first = 0
        if self._stamps[0] < entry.stamp - 2 * self._length:  # now and then, many at once
            first = bisect_left(self._stamps, entry.stamp - self._length) - 1
        elif len(self._stamps) > 2 * self._most:
            first = self._most
        if first > 0:
            del self.entries[:first], self._stamps[:first]

    def restart(self, stamp: int) -> None:
        """Keep the newest entry alone, at another time: the clock jumped, or all before has no meaning any more."""
        newest = self.entries[-1]
        newest.stamp, newest.measurements = stamp, ()
        self.entries, self._stamps = [newest], [stamp]

    def index(self, stamp: int) -> int:
        """The first entry at or after ``stamp``; as many as there are entries where there is none."""
        return bisect_left(self._stamps, stamp)

    def share(self, index: int, stamp: int) -> float:
        """How much of an entry's motion lies before ``stamp``."""
        begin, end = self._stamps[index - 1], self._stamps[index]
        return (stamp - begin) / (end - begin)

    def odometry_at(self, stamp: int) -> Array | None:
        """Odometry's pose (3,) at a time, between samples at constant twist; None outside of what is remembered."""
        index = self.index(stamp)
        if not self.entries or index == len(self.entries) or stamp < self.oldest:
            return None
        entry = self.entries[index]
        if entry.stamp == stamp:
            return np.array(entry.odometry)
        part = entry.motion.part(self.share(index, stamp))
        return advance(self.entries[index - 1].odometry, part.moved, part.integration)
