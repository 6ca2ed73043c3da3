"""Motion commands with their durations."""

from __future__ import annotations

from dataclasses import dataclass

from omnibench.simulate.command import Command


@dataclass(frozen=True)
class TimedCommand:
    """A motion command with its duration, s. ramp: time at its start and its end in which the speed changes, s."""

    command: Command
    duration: float
    ramp: float = 0.0
