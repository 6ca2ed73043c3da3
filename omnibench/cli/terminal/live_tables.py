"""Output of the commands of the live runtime."""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Final

import zenoh
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from omnibench.cli.terminal.progress_display import ProgressDisplay
from omnibench.errors import DataError, one_line
from omnibench.live.health import anomalies_in_words
from omnibench.live.monitor import OdometryStatus, RobotMonitor, RobotStatus, json_document
from omnibench.live.presence import alive_robots, nothing_received
from omnibench.live.record import Recorder
from omnibench.live.stopping import ticks
from omnibench.live.topics import TOPICS, KeySpace
from omnibench.progress import Progress
from omnibench.report.blocks import Column, Row, RowRole, Table
from omnibench.report.numbers import fixed
from omnibench.report.result import NextStep, Remark, Result
from omnibench.report.terminal import render_table
from omnibench.words import plural

if TYPE_CHECKING:
    from omnibench.live.demonstration import Demonstration
    from omnibench.live.replay import PlayReport


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


class PlayedResult(Result):
    """How much of a recording was played to a robot's node, and how long it took."""

    def __init__(self, report: PlayReport, simulated: bool, robot: str) -> None:
        self.report, self.simulated, self.robot = report, simulated, robot

    def remarks(self) -> Sequence[Remark]:
        report, sent = self.report, sum(self.report.sent.values())
        delivered = "delivery not confirmed, since no omnibench node runs the robot"
        if report.taken is not None:
            again = f", which started again {plural(report.restarts, 'time')} on the way" if report.restarts else ""
            delivered = f"{self._share} taken by the node{again}"
        messages = f"{plural(report.sent['joint_states'], 'wheel sample')} and "
        messages += plural(report.sent["slam_pose"], "SLAM pose")
        kind, seconds = "simulated" if self.simulated else "recorded", f"{report.data_seconds:.1f} s of the drive"
        lines = [f"{messages} ({kind}), {seconds} in {report.wall_seconds:.1f} s; {delivered}"]
        if not report.complete:
            lines.append(f"stopped after {sent} of {plural(report.total, 'message')}")
        if report.anomalies:
            lines.append(f"meanwhile the node counted {anomalies_in_words(report.anomalies)}")
        return list(map(Remark, lines))

    @property
    def _share(self) -> str:
        """The messages that a node acknowledged: all, or so many of those sent."""
        report = self.report
        return "all" if report.acknowledged else f"{report.taken or 0:,} of {sum(report.sent.values()):,}"

    def next_step(self) -> NextStep:
        heard = "no omnibench node said that it took anything"
        if self.report.taken is not None:
            heard = f"{self._share} was taken by the node"
        command = ("omnibench", "listen", self.robot)
        return NextStep(f"the recording was played, and {heard}", "listen while it plays", command)


class DemonstrationResult(Result):
    """A recording as it was played to a node: its errors, and their agreement with the batch odometry.

    file: the node's config.
    """

    def __init__(self, shown: Demonstration, file: Path) -> None:
        self.shown, self.file = shown, file

    def opening(self) -> Sequence[Remark]:
        return PlayedResult(self.shown.report, self.shown.simulated, self.shown.robot).remarks()

    @property
    def _judged(self) -> bool:
        """False after a signal: what the node would have made of the rest is not known."""
        report = self.shown.report
        return report.acknowledged and bool(report.sent["joint_states"])

    def tables(self) -> Sequence[Table]:
        shown, rows = self.shown, []
        for label, errors in (
            ("odometry of the design matrix", shown.theoretical),
            (f"odom: {shown.calibration}", shown.calibrated),
            ("odometry/filtered: fused with SLAM", shown.fused),
        ):
            if errors is not None:
                figures = ((errors.position, 4), (math.degrees(errors.heading), 2), (errors.final_position, 4))
                rows.append(Row.of(label, *(fixed(value, decimals) for value, decimals in figures)))
        numeric = (Column("position, RMS", "m"), Column("heading, RMS", "deg"), Column("position at the end", "m"))
        columns = (Column("estimate", numeric=False), *numeric)
        return [Table(f"{shown.robot} against {shown.against}", columns, tuple(rows))] if self._judged else []

    def remarks(self) -> Sequence[Remark]:
        if not self._judged:
            return ()
        counts = ", ".join(f"{value} {name}" for name, value in self.shown.health.counts.items() if value)
        largest = f"{self.shown.batch_difference:.1e} (m, rad) at most; 0 messages of odom lost"
        return [Remark(f"odom against the batch odometry: {largest}"), Remark(f"counted: {counts}")]

    def next_step(self) -> NextStep:
        command = ("omnibench", "live", self.file)
        return NextStep("the node computed what the batch odometry computes", "run it for the robot", command)


_PERIOD: Final = 0.25  # s between two updates of the line on a terminal; chosen


def record(
    session: zenoh.Session,
    keys: KeySpace,
    robots: Sequence[str],
    path: Path,
    console: Console,
    stop: Event,
    *,
    seconds: float | None = None,
    topics: Sequence[str] = tuple(TOPICS),
    patience: float = 3.0,
) -> Recorder:
    """Record the robots' topics into the MCAP file ``path`` until ``stop`` is set or ``seconds`` have passed.

    A line names each robot from which nothing has come after ``patience`` s. Returns the recorder with its counts;
    the file is complete then, and after KeyboardInterrupt too. ConfigError: a robot's name or topic is not valid.
    DataError: the file exists already or cannot be made, or writing failed while recording.
    """
    recorder = Recorder(session, keys, robots, path, topics, on_failure=lambda _: None)
    began = time.monotonic()
    with recorder, ProgressDisplay(console) as status:
        silence_reported = False
        for passed in ticks(stop, _PERIOD, seconds):
            if recorder.failure is not None:
                raise DataError(recorder.failure)
            if not silence_reported and passed >= patience:
                silence_reported = True
                for robot in recorder.silent_robots:
                    status.keep(f"{nothing_received(robot, passed, alive_robots(session))}; recording goes on")
            status(Progress(f"recording {path}", note=_figures(recorder, passed)))
    if recorder.failure is not None:
        raise DataError(recorder.failure)
    seconds_recorded = time.monotonic() - began
    if not silence_reported:
        for robot in recorder.silent_robots:
            status.keep(nothing_received(robot, seconds_recorded, alive_robots(session)))
    status.keep(f"{path}: {_figures(recorder, seconds_recorded)}")
    missed = recorder.missed
    for name in sorted(recorder.counts.keys() | recorder.undecodable.keys() | missed.keys()):
        status.keep(f"  {name}: {recorder.counts[name]:,}{_lacking(recorder.undecodable[name], missed[name])}")
    return recorder


def _figures(recorder: Recorder, seconds: float) -> str:
    """Messages and bytes that were recorded in ``seconds``."""
    lost = f", {recorder.lost:,} lost because the disk was too slow" if recorder.lost else ""
    lacking = _lacking(recorder.undecodable.total(), recorder.missed.total())
    return f"{seconds:.1f} s, {plural(recorder.messages, 'message')}, {recorder.bytes / 1e6:.2f} MB{lacking}{lost}"


def _lacking(undecodable: int, missed: int) -> str:
    left_out = f", {undecodable:,} left out that could not be decoded" if undecodable else ""
    return left_out + (f", {missed:,} missed on the way" if missed else "")


_REFRESH: Final = 0.2  # s between two drawings of the table; chosen
_LINE_PERIOD: Final = 1.0  # s between two lines of a robot
_SILENCE: Final = 1.0  # s without a message from which on the silence is shown
_HEALTH_WIDTH: Final = 48  # columns that the health and wider gaps between the figures need beside the figures
_NO_ROBOT: Final = "no robot seen yet"
_COLUMNS: Final = (
    Column("robot", numeric=False),
    Column("frame", numeric=False),
    Column("x", "m"),
    Column("y", "m"),
    Column("deg"),
    Column("±m", priority=2),
    Column("±deg", priority=2),
    Column("vx", "m/s", priority=1),
    Column("vy", "m/s", priority=1),
    Column("deg/s", priority=1),
    Column("Hz"),
    Column("age", "ms"),
    Column("health", numeric=False),
)


def listen(
    robot: str | None,
    session: zenoh.Session,
    keys: KeySpace,
    console: Console,
    stop: Event,
    seconds: float | None = None,
    as_json: bool = False,
    patience: float = 3.0,
) -> None:
    """Show the state of ``robot`` (None: of all robots) until ``stop`` is set or ``seconds`` have passed.

    A table on a terminal, else a line a second for each robot; with ``as_json`` the line is a JSON document.
    DataError: nothing was received from ``robot`` within ``patience`` s. ConfigError: no robot can have this name.
    """
    draws_table = console.is_terminal and not as_json
    with RobotMonitor(session, keys, robot) as monitor:
        if robot is not None:
            monitor.wait_until_present(stop, patience)
        with Live(console=console, auto_refresh=False) if draws_table else nullcontext() as live:
            for _ in ticks(stop, _REFRESH if live else _LINE_PERIOD, seconds):
                statuses = monitor.statuses()
                if live:
                    live.update(view(statuses, console), refresh=True)
                    continue
                lines = [json.dumps(json_document(status)) if as_json else plain_line(status) for status in statuses]
                for line in lines or ([] if as_json else [_NO_ROBOT]):
                    console.print(Text(line), soft_wrap=True)


def view(statuses: Sequence[RobotStatus], console: Console) -> RenderableType:
    """The robots as a table that fits the console: health beside the figures if there is room, else below them."""
    if not statuses:
        return Text(_NO_ROBOT)
    figures = render_table(_table(statuses, health=False), console.width)
    if console.measure(figures).maximum + _HEALTH_WIDTH <= console.width:
        return render_table(_table(statuses, health=True), console.width)
    lines = [
        Text(f"{status.robot}: {describe(status)}", style="dim" if status.presence == "left" else "")
        for status in statuses
    ]
    return Group(figures, *lines)


def describe(status: RobotStatus) -> str:
    """A robot's presence and health in words."""
    left, streams = status.presence == "left", _streams(status)
    silence = min((stream.age for stream in streams), default=None)
    parts = ["left"] if left else []
    if silence is None:
        parts.append("no odometry yet")
    elif silence >= _SILENCE:
        parts.append(f"no message for {silence:.1f} s")
    elif status.health is None and not left:
        parts.append("health unknown")
    if status.health is not None and not left:
        message = status.health.message
        parts.append(status.health.status + (f": {message}" if message not in ("", status.health.status) else ""))
        parts += [f"{name} {count}" for name, count in status.health.counts.items()]
    if undecodable := sum(stream.undecodable for stream in streams):
        parts.append(f"undecodable odometry {undecodable}")
    if missed := sum(stream.missed for stream in streams):
        parts.append(f"{plural(missed, 'message')} missed on the way")
    return one_line(", ".join(parts))


def plain_line(status: RobotStatus) -> str:
    """A robot's state as one line of text."""
    parts = [f"{status.robot}: {describe(status)}"]
    for stream in _streams(status):
        x, y, heading = stream.message.pose.tolist()
        vx, vy, w = stream.message.twist.tolist()
        position_sigma, heading_sigma = stream.message.position_sigma, math.degrees(stream.message.heading_sigma)
        rate = "" if stream.rate is None else f", {stream.rate:.1f} Hz"
        by_stamp = "" if stream.stamp_age is None else f" ({stream.stamp_age * 1e3:.0f} ms by its stamp)"
        parts.append(
            f"{stream.message.frame} x {x:.3f} m y {y:.3f} m heading {math.degrees(heading):.1f} deg (1 sigma "
            f"{position_sigma:.3f} m {heading_sigma:.2f} deg) vx {vx:.3f} m/s vy {vy:.3f} "
            f"m/s w {math.degrees(w):.1f} deg/s{rate}, age {stream.age * 1e3:.0f} ms{by_stamp}"
        )
    return "; ".join(parts)


def _table(statuses: Sequence[RobotStatus], health: bool) -> Table:
    rows = []
    for status in statuses:
        role: RowRole = "muted" if status.presence == "left" else "plain"
        names, words = [status.robot, ""], [describe(status), ""]  # in the first line of a robot
        for number, stream in enumerate(_streams(status) or (None,)):
            ending = [words[number]] if health else []
            rows.append(Row.of(names[number], *_cells(status.robot, stream, by_stamp=health), *ending, role=role))
    return Table("", _COLUMNS if health else _COLUMNS[:-1], tuple(rows))


def _cells(robot: str, stream: OdometryStatus | None, by_stamp: bool) -> list[str]:
    if stream is None:
        return ["-"] * 11
    x, y, heading = stream.message.pose.tolist()
    vx, vy, w = stream.message.twist.tolist()
    silent = stream.age >= _SILENCE
    # since its stamp, ms, where the clocks agree
    since_stamp = f"/{stream.stamp_age * 1e3:.0f}" if by_stamp and stream.stamp_age is not None else ""
    return [
        stream.message.frame.removeprefix(f"{robot}/"),  # in a node of several robots frames carry the robot's name
        _digits(x, 3),
        _digits(y, 3),
        f"{math.degrees(heading):.1f}",
        _digits(stream.message.position_sigma, 3),
        _digits(math.degrees(stream.message.heading_sigma), 2),
        f"{vx:.2f}",
        f"{vy:.2f}",
        _digits(math.degrees(w), 1),
        "-" if silent or stream.rate is None else f"{stream.rate:.0f}",
        "-" if silent else f"{stream.age * 1e3:.0f}{since_stamp}",
    ]


def _digits(value: float, decimals: int) -> str:
    """A value with fewer decimals the larger it is, so that a column stays narrow."""
    digits = len(f"{abs(value):.0f}")
    return f"{value:.{max(decimals - max(digits - 2, 0), 0)}f}"


def _streams(status: RobotStatus) -> tuple[OdometryStatus, ...]:
    return tuple(stream for stream in (status.odom, status.filtered) if stream is not None)
