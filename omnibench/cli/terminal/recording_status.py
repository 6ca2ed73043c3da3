"""``omnibench record``: a recorder with a status line, until it is stopped."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Final

import zenoh
from rich.console import Console

from omnibench.cli.terminal.progress_display import ProgressDisplay
from omnibench.errors import DataError
from omnibench.live.network.presence import alive_robots, nothing_received
from omnibench.live.stopping import ticks
from omnibench.live.wire.recorder import Recorder
from omnibench.live.wire.topics import TOPICS, KeySpace
from omnibench.progress import Progress
from omnibench.words import plural

_PERIOD: Final = 0.25  # s between two updates of the line on a terminal; chosen


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

    A line names each robot from which nothing has come after ``patience`` s. Returns the recorder with its counts;
    the file is complete then, and after KeyboardInterrupt too. ConfigError: a robot's name or topic is not valid.
    DataError: the file exists already or cannot be made, or writing failed while recording.
    """
    recorder = Recorder(session, keys, robots, path, topics, on_failure=lambda _: None)
    began = time.monotonic()
    with recorder, ProgressDisplay(console) as status:
        silence_reported = False
        for passed in ticks(stop, _PERIOD, seconds):
            if recorder.failure is not None:
                raise DataError(recorder.failure)
            if not silence_reported and passed >= patience:
                silence_reported = True
                for robot in recorder.silent_robots:
                    status.keep(f"{nothing_received(robot, passed, alive_robots(session))}; recording goes on")
            status(Progress(f"recording {path}", note=_figures(recorder, passed)))
    if recorder.failure is not None:
        raise DataError(recorder.failure)
    seconds_recorded = time.monotonic() - began
    if not silence_reported:
        for robot in recorder.silent_robots:
            status.keep(nothing_received(robot, seconds_recorded, alive_robots(session)))
    status.keep(f"{path}: {_figures(recorder, seconds_recorded)}")
    missed = recorder.missed
    for name in sorted(recorder.counts.keys() | recorder.undecodable.keys() | missed.keys()):
        others = f"{_left_out(recorder.undecodable[name])}{_missed(missed[name])}"
        status.keep(f"  {name}: {recorder.counts[name]:,}{others}")
    return recorder


def _figures(recorder: Recorder, seconds: float) -> str:
    """Messages and bytes that were recorded in ``seconds``."""
    lost = f", {recorder.lost:,} lost because the disk was too slow" if recorder.lost else ""
    missed = _missed(recorder.missed.total())
    return (
        f"{seconds:.1f} s, {plural(recorder.messages, 'message')}, {recorder.bytes / 1e6:.2f} MB"
        f"{_left_out(recorder.undecodable.total())}{missed}{lost}"
    )


def _missed(messages: int) -> str:
    return f", {messages:,} missed on the way" if messages else ""


def _left_out(undecodable: int) -> str:
    return f", {undecodable:,} left out that could not be decoded" if undecodable else ""
