"""Progress of long work: events that tell the state of a task, and the callable that they are given to.

Whatever works long takes a reporter and calls it when a task begins, while it goes on and when it ends. Several tasks
may go on at the same time; a task is known by its name.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import partial


@dataclass(frozen=True)
class Progress:
    """State of a task: ``done`` of ``total`` steps (None: not known beforehand), each a ``unit`` in the singular.

    best: lowest cost so far, of a task that lowers one. note: remark in words. result: None while the task goes on; its
    outcome in words when it has ended, empty if there is nothing to say.
    """

    task: str
    done: int = 0
    total: int | None = None
    unit: str = "step"
    best: float | None = None
    note: str = ""
    result: str | None = None

    @property
    def over(self) -> bool:
        """True if the task has ended or all its steps are done."""
        return self.result is not None or self.done == self.total


Reporter = Callable[[Progress], None]

_PERIOD = 0.2  # s between two reports of reading, at least; chosen


def no_progress(event: Progress) -> None:
    """Ignore the progress."""


def renamed(report: Reporter, task: str) -> Reporter:
    """A reporter that passes events on under the name ``task``; it can be pickled if ``report`` can."""
    return partial(_report_as, report, task)


def _report_as(report: Reporter, task: str, event: Progress) -> None:
    report(replace(event, task=task))


class _Reading:
    """Counts of the samples, or of the parts by workers, that were read of data sets that do not fit in memory.

    done, expected: by unit, how many have been read, and how many one pass reads.
    """

    def __init__(self, report: Reporter) -> None:
        self.report = report
        self.done: dict[str, int] = {}
        self.expected: dict[str, int] = {}
        self.reported_at = time.monotonic()


_READING: ContextVar[_Reading | None] = ContextVar("reading", default=None)


@contextmanager
def reading_told_to(report: Reporter) -> Iterator[None]:
    """Report what is read of data sets larger than memory while the block is open; of others nothing is said."""
    before = _READING.set(_Reading(report))
    try:
        yield
    finally:
        reading = _READING.get()
        _READING.reset(before)
        for unit in reading.done if reading else ():
            report(Progress(f"reading {unit}s", result=""))


def expect_reading(count: int, unit: str) -> None:
    """So many samples, or other things, are read from now on, perhaps in several passes."""
    if (reading := _READING.get()) is not None:
        reading.done[unit], reading.expected[unit] = 0, count


def tell_reading(count: int, unit: str) -> None:
    """Samples, or other things, have been read."""
    reading = _READING.get()
    if reading is None or unit not in reading.expected:
        return
    reading.done[unit] += count
    if time.monotonic() - reading.reported_at > _PERIOD:
        reading.reported_at = time.monotonic()
        passes, done = divmod(reading.done[unit], reading.expected[unit])
        note = f"pass {passes + 1}" if passes and done else ""
        reading.report(Progress(f"reading {unit}s", done, reading.expected[unit], unit, note=note))


class Stages:
    """Tasks one after the other: each ends when the next begins."""

    def __init__(self, report: Reporter) -> None:
        self._report = report
        self._current: Progress | None = None

    def begin(self, task: str) -> None:
        """End the task that is going on, and begin the next."""
        self.end()
        self._current = Progress(task)
        self._report(self._current)

    def end(self) -> None:
        """End the task that is going on, if there is one."""
        if self._current is not None:
            self._report(replace(self._current, result=""))
            self._current = None
