"""Clocks of the references against the wheels', of all runs together or of very many each by itself."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.data.clock_matching import ROUNDS, SEARCH, ClockMatch, Streams, Windows, fitted_together, match_clocks
from omnibench.data.dataset import Trajectory
from omnibench.data.stored import MOST_DRAWN, drawn_runs
from omnibench.jobs.job import gathered
from omnibench.progress import Reporter
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.stored_odometry import together, workers

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
