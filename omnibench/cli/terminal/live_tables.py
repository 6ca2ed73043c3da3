"""Output of the commands of the live runtime."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from omnibench.words import plural

if TYPE_CHECKING:
    from omnibench.live.replay.demonstration import Demonstration, Deviation
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
        f"{report.data_seconds:.1f} s of the drive in {report.wall_seconds:.1f} s",
        soft_wrap=True,
    )
    if not report.complete:
        console.print(f"stopped after {sum(report.sent.values())} of {plural(report.total, 'message')}", soft_wrap=True)


def print_demonstration(console: Console, shown: Demonstration) -> None:
    """Print what was played to a node, its errors against the reference, and its agreement with the batch odometry."""
    print_played(console, shown.report, shown.simulated)
    table = Table(title=f"{shown.robot} against {shown.against}", title_justify="left")
    for heading in ("estimate", "position RMS", "heading RMS", "position at the end"):
        table.add_column(heading, justify="left" if heading == "estimate" else "right")
    rows: list[tuple[str, Deviation | None]] = [
        ("odometry of the design matrix", shown.theoretical),
        (f"odom: {shown.calibration}", shown.calibrated),
        ("odometry/filtered: fused with SLAM", shown.fused),
    ]
    for label, deviation in rows:
        if deviation is not None:
            table.add_row(
                label,
                f"{deviation.position:.4f} m",
                f"{math.degrees(deviation.heading):.2f} deg",
                f"{deviation.final_position:.4f} m",
            )
    console.print(table)
    console.print(
        f"odom against the batch odometry: {shown.batch_difference:.1e} (m, rad) at most; "
        f"{plural(shown.lost, 'message')} of odom lost",
        soft_wrap=True,
    )
    counts = {name: value for name, value in shown.health.counts.items() if value}
    console.print("counted: " + ", ".join(f"{value} {name}" for name, value in counts.items()), soft_wrap=True)
