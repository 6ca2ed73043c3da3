"""References that are not of the runs that they stand beside: of other times, or of other drives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from omnibench.data.checks.finding import Finding
from omnibench.data.checks.misread_search import Recorded
from omnibench.data.checks.motion_fit import Windows
from omnibench.data.dataset import Trajectory
from omnibench.words import plural

_REACHED = 0.05  # share of a run's time after which its last pose comes at least; chosen
# Share of the runs' turns (squares of the whole runs') that the best matrix leaves: at most 0.005 on OptiOdom's
# recordings, and 0.68 to 1.45 where the poses of each run were given to one of another command.
_LEFT = 0.25
_TURNED = 0.5  # rad, root mean square of the runs' turns: less of it tells nothing; chosen
_FEWEST = 3  # runs whose turns a matrix of a few numbers cannot all follow; chosen


def foreign_reference(recording: Recorded, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """The finding that the poses of most runs are of other times, or of other drives, than the wheels."""
    early = [run for run in runs if run.references is None and run.pose_times[-1] < _REACHED * run.times[-1]]
    if 2 * len(early) > len(runs):
        seen, driven = early[0].pose_times[-1], early[0].times[-1]
        yield Finding(
            kind="reference_foreign",
            what=f"the poses of {plural(len(early), 'run')} end long before the wheels, as after {seen:.2g} s of "
            f"{driven:.3g} s",
            where="the reference",
            severity="error",
            fix="say the unit of the poses' times (pose_time_unit), or record poses to the end of each run",
        )
    elif (left := _turns_left(recording)) is not None and left > _LEFT:
        yield Finding(
            kind="reference_foreign",
            what=f"the wheels explain {max(0.0, 1 - left):.0%} of how the reference turns",
            where="the reference",
            severity="error",
            fix="see whether wheels and poses of each run are of the same drive, and name the robot's wheels right",
        )


def _turns_left(recording: Recorded) -> float | None:
    """Share of the squares of the runs' turns that the best matrix does not explain; None: they turn too little."""
    some = recording.some()
    windows = Windows.of(some.logs, some.poses)
    fit = None if windows is None else windows.fit()
    if windows is None or fit is None or len(some.logs) < _FEWEST:
        return None
    turned = np.bincount(windows.run, windows.turned)
    if np.sqrt(np.mean(turned**2)) < _TURNED:
        return None
    missed = turned - np.bincount(windows.run, windows.driven @ fit.matrix[2])
    return float((missed**2).sum() / (turned**2).sum())
