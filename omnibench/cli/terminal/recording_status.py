"""``omnibench record``: a recorder with a status line, until told to stop."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Final

import zenoh
from rich.console import Console
from rich.live import Live
from rich.text import Text

from omnibench.errors import DataError
from omnibench.live.network.presence import alive_robots, nothing_received
from omnibench.live.stopping import ticks
from omnibench.live.wire.recorder import Recorder
from omnibench.live.wire.topics import TOPICS, KeySpace

_PERIOD: Final = 0.25  # s, of the line on a terminal
_PIPED_PERIOD: Final = 10.0  # s, of the lines when piped


def record(
    session: zenoh.Session,
    keys: KeySpace,
    robots: Sequence[str],
    path: Path,
    console: Console,
    stop: Event,
    *,
    seconds: float | None = None,
    topics: Sequence[str] = tuple(TOPICS),
    patience: float = 3.0,
) -> Recorder:
    """Record the robots' topics into the MCAP file ``path`` until ``stop`` is set or ``seconds`` have passed.

    A robot from which nothing has come after ``patience`` s is told. Returns the recorder with its counts; the file is
    complete then, and after KeyboardInterrupt too. ConfigError: a name that cannot be. DataError: the file exists
    already or cannot be made, or the disk refused while recording.
    """
    recorder = Recorder(session, keys, robots, path, topics, on_failure=lambda _: None)
    status = _Status(console)
    began = time.monotonic()
    with recorder, status:
        silence_told = False
        for passed in ticks(stop, _PERIOD, seconds):
            if recorder.failure is not None:
                raise DataError(recorder.failure)
            if not silence_told and passed >= patience:
                silence_told = True
                for robot in _silent(recorder, robots):
                    status.tell(f"{nothing_received(robot, passed, alive_robots(session))}; recording goes on")
            status.show(status_line(recorder, passed), passed)
    if recorder.failure is not None:
        raise DataError(recorder.failure)
    seconds_recorded = time.monotonic() - began
    if not silence_told:
        for robot in _silent(recorder, robots):
            status.tell(nothing_received(robot, seconds_recorded, alive_robots(session)))
    status.tell(status_line(recorder, seconds_recorded))
    for name in sorted(recorder.counts.keys() | recorder.undecodable.keys()):
        status.tell(f"  {name}: {recorder.counts[name]:,}{_left_out(recorder.undecodable[name])}")
    return recorder


def status_line(recorder: Recorder, seconds: float) -> str:
    """What was recorded in ``seconds``, in one line."""
    lost = f", {recorder.lost:,} lost to a slow disk" if recorder.lost else ""
    return (
        f"{recorder.path}: {seconds:.1f} s, {recorder.messages:,} messages, {recorder.bytes / 1e6:.2f} MB"
        f"{_left_out(recorder.undecodable.total())}{lost}"
    )


class _Status:
    """A line that is kept up to date on a terminal; when piped, one now and then."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._next = _PIPED_PERIOD

    def __enter__(self) -> None:
        if self._live:
            self._live.start()

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def tell(self, line: str) -> None:
        """Print a line that stays."""
        self._console.print(Text(line), soft_wrap=True)

    def show(self, line: str, passed: float) -> None:
        """The state after ``passed`` s."""
        if self._live:
            self._live.update(Text(line), refresh=True)
        elif passed >= self._next:
            self._next = passed + _PIPED_PERIOD
            self.tell(line)


def _left_out(undecodable: int) -> str:
    return f", {undecodable:,} left out that could not be decoded" if undecodable else ""


def _silent(recorder: Recorder, robots: Sequence[str]) -> list[str]:
    heard = recorder.counts.keys() | recorder.undecodable.keys()
    return [robot for robot in robots if not any(name.startswith(f"/{robot}/") for name in heard)]
