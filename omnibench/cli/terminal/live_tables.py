"""Output of the commands of the live runtime."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console

from omnibench.cli.terminal.tables import print_table
from omnibench.live.estimation.counts import anomalies_in_words
from omnibench.report.blocks import Column, Row, Table
from omnibench.words import plural

if TYPE_CHECKING:
    from omnibench.live.replay.demonstration import Demonstration
    from omnibench.live.replay.replay_player import PlayReport


class LogLines(logging.Handler):
    """Log messages as lines of a console, above a progress bar if there is one."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console
        self.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._console.print(self.format(record), soft_wrap=True)
        except Exception:  # a terminal that has gone must not stop the node
            self.handleError(record)


@contextmanager
def node_log(console: Console, warnings_only: bool = False) -> Iterator[logging.Logger]:
    """The node's log, whose lines go to ``console`` as long as the context lasts."""
    log = logging.getLogger("omnibench.live")
    lines = LogLines(console)
    log.setLevel(logging.WARNING if warnings_only else logging.INFO)
    log.addHandler(lines)
    try:
        yield log
    finally:
        log.removeHandler(lines)


def print_played(console: Console, report: PlayReport, simulated: bool) -> None:
    """Print how much of a recording was played, and how long it took."""
    kind = "simulated" if simulated else "recorded"
    console.print(
        f"{plural(report.sent['joint_states'], 'wheel sample')} and "
        f"{plural(report.sent['slam_pose'], 'SLAM pose')} ({kind}), "
        f"{report.data_seconds:.1f} s of the drive in {report.wall_seconds:.1f} s; {_delivered(report)}",
        soft_wrap=True,
    )
    if not report.complete:
        console.print(f"stopped after {sum(report.sent.values())} of {plural(report.total, 'message')}", soft_wrap=True)


def print_counted(console: Console, report: PlayReport) -> None:
    """Print what the node could not use of what it took, or of what others sent it meanwhile."""
    if report.anomalies:
        console.print(f"meanwhile the node counted {anomalies_in_words(report.anomalies)}", soft_wrap=True)


def _delivered(report: PlayReport) -> str:
    """How many of the messages sent are known to have arrived."""
    if report.taken is None:
        return "delivery not confirmed, since no omnibench node runs the robot"
    sent = sum(report.sent.values())
    again = f", which started again {plural(report.restarts, 'time')} on the way" if report.restarts else ""
    return f"{'all' if report.taken == sent else f'{report.taken:,} of {sent:,}'} taken by the node{again}"


def print_demonstration(console: Console, shown: Demonstration) -> None:
    """Print what was played to a node, its errors against the reference, and its agreement with the batch odometry."""
    print_played(console, shown.report, shown.simulated)
    if shown.report.taken != sum(shown.report.sent.values()) or not shown.report.sent["joint_states"]:
        return  # after a signal; what the node would have made of the rest is not known
    print_table(console, _deviation_table(shown))
    console.print(
        f"odom against the batch odometry: {shown.batch_difference:.1e} (m, rad) at most; 0 messages of odom lost",
        soft_wrap=True,
    )
    counts = {name: value for name, value in shown.health.counts.items() if value}
    console.print("counted: " + ", ".join(f"{value} {name}" for name, value in counts.items()), soft_wrap=True)


def _figure(value: float, decimals: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{decimals}f}"  # nothing was compared yet


def _deviation_table(shown: Demonstration) -> Table:
    estimates = (
        ("odometry of the design matrix", shown.theoretical),
        (f"odom: {shown.calibration}", shown.calibrated),
        ("odometry/filtered: fused with SLAM", shown.fused),
    )
    rows = (
        Row.of(label, _figure(of.position, 4), _figure(math.degrees(of.heading), 2), _figure(of.final_position, 4))
        for label, of in estimates
        if of is not None
    )
    columns = (
        Column("estimate", numeric=False),
        Column("position, RMS", "m"),
        Column("heading, RMS", "deg"),
        Column("position at the end", "m"),
    )
    return Table(f"{shown.robot} against {shown.against}", columns, tuple(rows))
