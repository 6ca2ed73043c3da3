"""The contents of a recording as a table after Table 1 of the paper: quantities, numbers, intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.stored.stored_rows import MOST_IN_MEMORY
from omnibench.report.blocks import Cell, Column, Row, Table
from omnibench.report.numbers import NOTHING, count, significant
from omnibench.report.recording.wheel_figures import rate_step
from omnibench.robot.kinematics import Array


def contents_table(dataset: Dataset) -> Table:
    """A table of the quantities from motion command to SLAM pose: recorded or not, how many, at what interval."""
    runs = dataset.trajectories
    samples = [run.times for run in runs]
    number = sum(map(len, samples))
    rows = [
        _commands(runs),
        _sent(runs),
        _wheels("Target wheel rates", _rates("ωM", dataset), runs, "targets", "what the motor controllers were told"),
        _row("Measured wheel rates", _rates("ω", dataset), number, "samples", _every(samples, first=0.0), _steps(runs)),
        _wheels("Wheel angles", "φ", runs, "angles", "absolute, continuous within a session"),
        *_steering(runs),
        _wheels("Odometry of the robot", "(x, y, θ)", runs, "odometry", "as it computed it"),
        _scans(dataset),
        _reference(dataset),
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
        note="Small print: symbols. Every: the median interval; where they "
        "vary, in brackets the range that holds 98 % of them.",
    )


def _rates(symbol: str, dataset: Dataset) -> str:
    """The paper's symbols of wheel rates; those of wheels with longer names than its a, b, c as words."""
    names = dataset.robot.wheel_names
    if all(len(name) == 1 for name in names):
        return f"({', '.join(symbol + name for name in names)})"
    return f"{symbol} of {', '.join(names)}"


def _commands(runs: Sequence[Trajectory]) -> Row:
    commanded = [run for run in runs if run.omega is not None]
    if not commanded:
        return _missing("Motion command", "(v, α, ω, d)")
    different = len({(run.v, run.alpha, run.omega) for run in commanded})
    limit = "length d" if any(run.distance is not None for run in commanded) else "no length"
    remark = f"{count(different)} different, {limit}" + (", duration" if commanded[0].duration is not None else "")
    return _row("Motion command", "(v, α, ω, d)", len(commanded), "runs", "", remark)


def _sent(runs: Sequence[Trajectory]) -> Row:
    sent = [run.sent for run in runs if run.sent is not None and len(run.sent)]
    if not sent:
        return _missing("Sent commands", "(v, α, ω, t_r)")
    number, longest = sum(map(len, sent)), max(float(commands[:, 4].max()) for commands in sent)
    every = _every([commands[:, 0] for commands in sent])
    return _row("Sent commands", "(v, α, ω, t_r)", number, "commands", every, f"valid for up to {longest:g} s")


def _wheels(name: str, symbol: str, runs: Sequence[Trajectory], field: str, remark: str) -> Row:
    recorded = [run for run in runs if getattr(run, field) is not None]
    if not recorded:
        return _missing(name, symbol)
    times = [run.times for run in recorded]
    if len(recorded) < len(runs):
        remark += f"; in {count(len(recorded))} of {count(len(runs))} runs"
    return _row(name, symbol, sum(map(len, times)), "samples", _every(times, first=0.0), remark)


def _steering(runs: Sequence[Trajectory]) -> list[Row]:
    if runs[0].steering is None:
        return []
    return [_wheels("Steering angles", "steer", runs, "steering", "at the samples' ends")]


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
        remark += f"; in {count(len(times))} of {count(len(dataset.trajectories))} runs"
    return _row("LIDAR scans", "LIDAR", sum(map(len, times)), "scans", _every(times), remark)


def _reference(dataset: Dataset) -> Row:
    runs = dataset.trajectories
    times = [run.pose_times for run in runs]
    with_covariance = sum(run.pose_covariances is not None for run in runs)
    remark = "with covariances" if with_covariance == len(runs) else "without covariances"
    if 0 < with_covariance < len(runs):
        remark = f"with covariances in {count(with_covariance)} of {count(len(runs))} runs"
    symbol = "(x, y, θ)" if dataset.scans is None else "(x, y, θ) LIDAR"
    return _row("Reference poses", symbol, sum(map(len, times)), "poses", _every(times), remark)


def _every(times: Sequence[Array], first: float | None = None) -> str:
    """The interval between stamps in words, of very many by some of the runs from first to last.

    first: the time from which the first interval of a run counts, s.
    """
    some = times[:: -(-sum(map(len, times)) // MOST_IN_MEMORY) or 1]
    stamps = some if first is None else [np.append(first, run) for run in some]
    gaps = 1e3 * np.concatenate([np.diff(run) for run in stamps])
    if not len(gaps):
        return NOTHING
    low, middle, high = np.quantile(gaps, [0.01, 0.5, 0.99])
    if high - low < 0.02 * middle:
        return f"{significant(float(middle), 3)} ms"
    return f"{significant(float(middle), 3)} ms ({significant(float(low), 3)} to {significant(float(high), 3)})"


def _row(name: str, symbol: str, number: int, noun: str, every: str, remark: str) -> Row:
    return Row.of(Cell(name, symbol), f"{count(number)} {noun}", every or NOTHING, remark)


def _missing(name: str, symbol: str) -> Row:
    return Row.of(Cell(name, symbol), "not recorded", NOTHING, "", role="muted")
