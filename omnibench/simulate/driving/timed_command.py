"""Motion commands with their durations."""

from __future__ import annotations

from dataclasses import dataclass

from omnibench.simulate.command import Command
from omnibench.simulate.variation import STEADY, Variation


@dataclass(frozen=True)
class TimedCommand:
    """A motion command with its duration, s.

    ramp: time at its start and its end in which the speed changes, s. variation: of the command within the run.
    """

    command: Command
    duration: float
    ramp: float = 0.0
    variation: Variation = STEADY
