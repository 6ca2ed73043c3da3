"""What the commands of the live runtime print."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from omnibench.cli.terminal.calibration_tables import make_console

if TYPE_CHECKING:
    from omnibench.live.estimation.health import Health
    from omnibench.live.replay.demonstration import Demonstration, Deviation
    from omnibench.live.replay.replay_player import PlayReport
    from omnibench.live.replay.replay_player import Progress as Played


class LogLines(logging.Handler):
    """What the node has to say, a line each, above whatever the console shows."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console
        self.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._console.print(self.format(record), soft_wrap=True)
        except Exception:  # a terminal that has gone must not stop the node
            self.handleError(record)


class ReplayBar:
    """How far a replay is, on a terminal; a line every ten seconds when piped."""

    _PERIOD = 10.0  # s

    def __init__(self, title: str) -> None:
        self.console = make_console(error=True)
        self._progress = Progress(
            TextColumn(title),
            BarColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        self._task = self._progress.add_task("", total=None, note="")
        self._title = title
        self._told = 0.0

    def __enter__(self) -> ReplayBar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def __call__(self, played: Played, health: Health | None = None) -> None:
        note = f"{played.data_seconds:.0f} s of the drive"
        if health is not None:
            note += f", {health.rate_hz:.0f} samples/s, {health.counts['poses']} poses fused"
        self._progress.update(self._task, total=played.total, completed=played.done, note=note)
        if not self.console.is_terminal and played.wall_seconds - self._told >= self._PERIOD:
            self._told = played.wall_seconds
            self.console.print(f"{self._title}: {played.done} of {played.total} messages, {note}")


def print_played(console: Console, report: PlayReport, simulated: bool) -> None:
    """What was played."""
    kind = "simulated" if simulated else "recorded"
    console.print(
        f"{report.sent['joint_states']} wheel samples and {report.sent['slam_pose']} SLAM poses ({kind}), "
        f"{report.data_seconds:.1f} s of the drive in {report.wall_seconds:.1f} s",
        soft_wrap=True,
    )
    if not report.complete:
        console.print(f"stopped after {sum(report.sent.values())} of {report.total} messages", soft_wrap=True)


def print_demonstration(console: Console, shown: Demonstration) -> None:
    """What a replay to a node showed."""
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
        f"{shown.lost} messages of odom lost",
        soft_wrap=True,
    )
    counts = {name: value for name, value in shown.health.counts.items() if value}
    console.print("counted: " + ", ".join(f"{value} {name}" for name, value in counts.items()), soft_wrap=True)
