"""What was recorded: Table 1 of the paper, with rates and numbers of this recording."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.report.blocks import Cell, Column, Row, Table
from omnibench.report.numbers import NOTHING, count, significant
from omnibench.report.recording.wheel_figures import rate_step
from omnibench.robot.kinematics import Array


def contents_table(dataset: Dataset) -> Table:
    """Each link of the chain from command to SLAM: whether it was recorded, how often, how many."""
    runs = dataset.trajectories
    samples = [run.times for run in runs]
    number = sum(map(len, samples))
    rows = [
        _commands(runs),
        _wheels("Target wheel rates", "(ωMa, ωMb, ωMc)", runs, "targets", "what the controllers were told"),
        _row("Measured wheel rates", "(ωa, ωb, ωc)", number, "samples", _every(samples, first=0.0), _steps(runs)),
        _wheels("Wheel angles", "beyond Table 1", runs, "angles", "absolute, continuous within a session"),
        _row("Odometry", "(x, y, θ)", number, "poses", _every(samples, first=0.0), "computed from the wheel rates"),
        _scans(dataset),
        _reference(runs),
    ]
    return Table(
        caption="What was recorded",
        columns=(
            Column("Recorded", numeric=False),
            Column("Number"),
            Column("Every"),
            Column("Remarks", numeric=False),
        ),
        rows=tuple(rows),
        note="After Table 1 of the paper; small print: its symbols. Every: the median interval, and the middle 98 % of "
        "the intervals where they vary.",
    )


def _commands(runs: Sequence[Trajectory]) -> Row:
    commanded = [run for run in runs if run.omega is not None]
    if not commanded:
        return _missing("Motion command", "(v, α, ω, d)")
    different = len({(run.v, run.alpha, run.omega) for run in commanded})
    limit = "length d" if any(run.distance is not None for run in commanded) else "no length"
    remark = f"{count(different)} different, {limit}" + (", duration" if commanded[0].duration is not None else "")
    return _row("Motion command", "(v, α, ω, d)", len(commanded), "runs", "", remark)


def _wheels(name: str, symbol: str, runs: Sequence[Trajectory], field: str, remark: str) -> Row:
    found = [run for run in runs if getattr(run, field) is not None]
    if not found:
        return _missing(name, symbol)
    times = [run.times for run in found]
    if len(found) < len(runs):
        remark += f"; of {count(len(found))} of {count(len(runs))} runs"
    return _row(name, symbol, sum(map(len, times)), "samples", _every(times, first=0.0), remark)


def _steps(runs: Sequence[Trajectory]) -> str:
    step = rate_step(runs[0])
    return "by encoders" if step is None else f"by encoders, in steps of {significant(step, 3)} rad/s"


def _scans(dataset: Dataset) -> Row:
    if dataset.scans is None:
        return _missing("LIDAR scans", "LIDAR")
    scanner = dataset.scans.scanner
    times = [dataset.scans.times(run) for run in dataset.scans.trajectories]
    turn = np.degrees(abs(scanner.angle_increment) * (scanner.rays - 1))
    name = f"{scanner.name}: " if scanner.name else ""
    remark = f"{name}{count(scanner.rays)} ranges over {significant(float(turn), 3)}°, to {scanner.range_max:g} m"
    if len(times) < len(dataset.trajectories):
        remark += f"; of {count(len(times))} of {count(len(dataset.trajectories))} runs"
    return _row("LIDAR scans", "LIDAR", sum(map(len, times)), "scans", _every(times), remark)


def _reference(runs: Sequence[Trajectory]) -> Row:
    times = [run.pose_times for run in runs]
    with_covariance = sum(run.pose_covariances is not None for run in runs)
    remark = "with covariances" if with_covariance == len(runs) else "without covariances"
    if 0 < with_covariance < len(runs):
        remark = f"with covariances in {count(with_covariance)} of {count(len(runs))} runs"
    name = "Reference poses"
    return _row(name, "(x, y, θ) LIDAR", sum(map(len, times)), "poses", _every(times), remark)


def _every(times: Iterable[Array], first: float | None = None) -> str:
    """The interval between stamps; ``first``: what the first of each run counts from."""
    stamps = times if first is None else [np.append(first, each) for each in times]
    gaps = 1e3 * np.concatenate([np.diff(each) for each in stamps])
    if not len(gaps):
        return NOTHING
    low, middle, high = np.quantile(gaps, [0.01, 0.5, 0.99])
    if high - low < 0.02 * middle:
        return f"{significant(float(middle), 3)} ms"
    return f"{significant(float(middle), 3)} ms ({significant(float(low), 3)} to {significant(float(high), 3)})"


def _row(name: str, symbol: str, number: int, noun: str, every: str, remark: str) -> Row:
    return Row((Cell(name, symbol), Cell(f"{count(number)} {noun}"), Cell(every or NOTHING), Cell(remark)))


def _missing(name: str, symbol: str) -> Row:
    return Row((Cell(name, symbol), Cell("not recorded"), Cell(NOTHING), Cell("")), "muted")
