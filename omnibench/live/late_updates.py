"""Updates of samples that had to wait: of a robot in real time only the newest is published, of a replay all are.

A late pose of a robot is of use to nobody once a newer one is known, and to publish it makes the node later still. The
samples of a replay are late by themselves, and whoever plays them wants every pose.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from omnibench.live.estimation.update import Update

LATE: Final = 0.1  # s that a sample has waited; chosen
_FAST: Final = 2.0  # time by the stamps per time of arrival, from which on samples are those of a replay; chosen
_SECOND: Final = 1e9  # ns


class LateUpdates:
    """The late updates of one robot that are not published yet. unpublished: those that never will be, so far."""

    def __init__(self, publish: Callable[[Update], None]) -> None:
        self.unpublished = 0
        self._publish = publish
        self._waiting: list[Update] = []
        self._first: tuple[float, int] | None = None  # arrival (s) and stamp (ns) of the first since one was on time
        self._replayed = False  # since then samples have come much faster than they were measured

    def take(self, arrival: float, updates: list[Update]) -> None:
        """Keep the updates of a late sample. arrival: s, monotonic."""
        for update in updates:
            if self._first is None:
                self._first = arrival, update.stamp
            measured = (update.stamp - self._first[1]) / _SECOND
            self._replayed = measured > _FAST * (arrival - self._first[0])
            self._waiting.append(update)

    def on_time(self) -> None:
        """Publish what waits before an update that is on time."""
        self._publish_waiting(newer_follows=True)
        self._first = None

    def end_turn(self) -> None:
        """Publish what waits."""
        self._publish_waiting(newer_follows=False)

    def _publish_waiting(self, *, newer_follows: bool) -> None:
        waiting, self._waiting = self._waiting, []
        if waiting and not self._replayed:
            last = len(waiting) - (not newer_follows)
            self.unpublished += last
            waiting = waiting[last:]
        for update in waiting:
            self._publish(update)
