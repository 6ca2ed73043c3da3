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
        self._waiting: list[tuple[float, Update]] = []
        self._on_time = True  # no update was late before those that wait

    def take(self, arrival: float, updates: list[Update]) -> None:
        """Keep the updates of a late sample. arrival: s, monotonic."""
        self._waiting += [(arrival, update) for update in updates]

    def on_time(self, in_real_time: bool) -> None:
        """Publish what waits before an update that is on time."""
        self._publish_waiting(in_real_time, newer_follows=True)
        self._on_time = True

    def end_turn(self, in_real_time: bool) -> None:
        """Publish what waits. in_real_time: the samples came about as fast as they were measured, for some seconds."""
        if self._waiting:
            self._publish_waiting(in_real_time, newer_follows=False)
            self._on_time = False

    def _publish_waiting(self, in_real_time: bool, *, newer_follows: bool) -> None:
        waiting, self._waiting = self._waiting, []
        if waiting and in_real_time and not (self._on_time and _came_at_once(waiting)):
            last = len(waiting) - (not newer_follows)
            self.unpublished += last
            waiting = waiting[last:]
        for _, update in waiting:
            self._publish(update)


def _came_at_once(waiting: list[tuple[float, Update]]) -> bool:
    """True if samples came much faster than they were measured."""
    (first_arrival, first), (last_arrival, last) = waiting[0], waiting[-1]
    return (last.stamp - first.stamp) / _SECOND > _FAST * (last_arrival - first_arrival)
