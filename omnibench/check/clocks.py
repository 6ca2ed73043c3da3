"""Clocks of the reference against the wheels' that stand out of their errors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from omnibench.check.streams import runs_in_words
from omnibench.data.clock_matching import ROUNDS, SEARCH, ClockMatch, Streams, Windows, fitted_together, match_clocks
from omnibench.data.dataset import Trajectory
from omnibench.data.finding import Finding, Severity
from omnibench.data.stored import MOST_DRAWN, drawn_runs
from omnibench.jobs.job import gathered
from omnibench.progress import Reporter
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.stored_odometry import together, workers

# A clock is reported that is off by at least so many s and so many standard errors (chosen: simulated runs, whose
# clocks are right, are below); from _SPOILS, s, on it spoils a fit.
_LEAST_OFF, _ERRORS, _SPOILS = 0.05, 4.0, 0.15
# Runs up to which so many errors hold; ten times as many runs need as many errors again, as one of them is farther off
# by chance (chosen: the farthest of 333, 1,665 and 6,660 simulated runs, whose clocks are right, are 4.2, 6.0 and 7.4
# errors off: about 2.5 errors more for ten times as many runs).
_USUAL = 500

_TOGETHER = 600_000  # wheel samples of the runs by which coefficients of very many are found: 100 of a minute (chosen)


def clocks_of(robot: Robot, runs: Sequence[Trajectory]) -> list[ClockMatch | None]:
    """The clock of every run's reference; None where it does not show.

    Of very many runs those that chance has drawn tell what all have in common, and then each is matched by itself.
    """
    if sum(len(run.times) for run in runs) <= MOST_DRAWN:
        return match_clocks(robot, [Streams.of_run(run) for run in runs])
    drawn = (Windows.of(robot, Streams.of_run(run)) for run in drawn_runs(runs, _TOGETHER))
    usable = [windows for windows in drawn if windows is not None]
    if not usable:
        return [None] * len(runs)
    fitted, _ = fitted_together(usable, SEARCH)
    tasks = [(robot, part, fitted) for part in together(runs)]
    return [clock for part in gathered(workers(), clocks_of_part, tasks) for clock in part]


def clocks_of_part(task: tuple[Robot, Sequence[Trajectory], Sequence[Array]], _: Reporter) -> list[ClockMatch | None]:
    """The clocks of some runs, of which the task names the robot, the runs and the coefficients."""
    robot, runs, fitted = task
    return [_matched(Windows.of(robot, Streams.of_run(run)), fitted) for run in runs]


def _matched(windows: Windows | None, fitted: Sequence[Array]) -> ClockMatch | None:
    """The clock by which a run fits given coefficients best; None where it does not show."""
    if windows is None:
        return None
    return windows.match(fitted, windows.improved(fitted, windows.scanned(SEARCH, fitted), ROUNDS), SEARCH)


def clock_findings(runs: Sequence[Trajectory], clocks: Sequence[ClockMatch | None]) -> Iterator[Finding]:
    """Offsets and drifts that stand out of their errors."""
    offset, drift = [], []
    errors = _ERRORS * max(1.0, 1.0 + math.log10(max(len(runs), 1) / _USUAL))
    for run, clock in zip(runs, clocks, strict=True):
        if clock is None:
            continue
        if abs(clock.middle) > max(_LEAST_OFF, errors * clock.middle_error):
            offset.append((run.id, clock.middle))
        gone = clock.drift * clock.length
        if abs(gone) > max(_LEAST_OFF, errors * clock.drift_error * clock.length):
            drift.append((run.id, gone))
    for kind, found in (("clock_offset", offset), ("clock_drift", drift)):
        if not found:
            continue
        names, values = [name for name, _ in found], np.array([value for _, value in found])
        largest = float(values[np.abs(values).argmax()])
        severity: Severity = "error" if abs(largest) > _SPOILS else "warning"
        if kind == "clock_offset":
            what = f"the stamps of the reference are {_off(values)} in {_count(found, runs)}"
        else:
            slow = "slow" if largest > 0 else "fast"
            what = (
                f"the reference's clock goes too {slow}, by up to {abs(largest):.2f} s a run, in {_count(found, runs)}"
            )
        yield Finding.model_validate(
            {
                "kind": kind,
                "what": what,
                "where": runs_in_words(names, len(runs)) if len(names) < len(runs) else "the reference",
                "severity": severity,
                "changes": {"clocks": "match"},
            }
        )


def _off(values: Array) -> str:
    """Offsets in words: the largest one, or the largest to either side."""
    ways = [f"{size:.2f} s too {way}" for way, size in (("late", -values.min()), ("early", values.max())) if size > 0]
    return " to ".join(ways) if len(ways) > 1 else f"up to {ways[0]}"


def _count(found: Sequence[object], runs: Sequence[Trajectory]) -> str:
    return "every run" if len(found) == len(runs) else f"{len(found)} of {len(runs)} runs"
