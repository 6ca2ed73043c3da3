"""``omnibench listen``: robots' odometry as a table that refreshes itself, as plain lines, or as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from contextlib import nullcontext
from threading import Event
from typing import Final

import zenoh
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from omnibench.cli.terminal.tables import render_table
from omnibench.errors import one_line
from omnibench.live.robot_monitor import OdometryStatus, RobotMonitor, RobotStatus, json_document
from omnibench.live.stopping import ticks
from omnibench.live.wire.topics import KeySpace
from omnibench.report.blocks import Column, Row, RowRole, Table
from omnibench.words import plural

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
                for line in _json_lines(statuses) if as_json else _plain_lines(statuses):
                    console.print(Text(line), soft_wrap=True)


def view(statuses: Sequence[RobotStatus], console: Console) -> RenderableType:
    """The robots as a table that fits the console: health beside the figures if there is room, else below them."""
    if not statuses:
        return Text(_NO_ROBOT)
    figures = render_table(_table(statuses, health=False), console.width)
    if console.measure(figures).maximum + _HEALTH_WIDTH <= console.width:
        return render_table(_table(statuses, health=True), console.width)
    return Group(figures, *(Text(f"{status.robot}: {describe(status)}", style=_style(status)) for status in statuses))


def describe(status: RobotStatus) -> str:
    """A robot's presence and health in words."""
    parts = []
    if status.presence == "left":
        parts.append("left")
    streams = _streams(status)
    silence = min((stream.age for stream in streams), default=None)
    if silence is None:
        parts.append("no odometry yet")
    elif silence >= _SILENCE:
        parts.append(f"no message for {silence:.1f} s")
    elif status.health is None and status.presence != "left":
        parts.append("health unknown")
    if status.health is not None and status.presence != "left":
        message = status.health.message
        parts.append(status.health.status + (f": {message}" if message not in ("", status.health.status) else ""))
        parts.extend(f"{name} {count}" for name, count in status.health.counts.items())
    undecodable = sum(stream.undecodable for stream in streams)
    if undecodable:
        parts.append(f"undecodable odometry {undecodable}")
    missed = sum(stream.missed for stream in streams)
    if missed:
        parts.append(f"{plural(missed, 'message')} missed on the way")
    return one_line(", ".join(parts))


def plain_line(status: RobotStatus) -> str:
    """A robot's state as one line of text."""
    return "; ".join([f"{status.robot}: {describe(status)}", *map(_plain_odometry, _streams(status))])


def _plain_lines(statuses: Sequence[RobotStatus]) -> list[str]:
    return [plain_line(status) for status in statuses] or [_NO_ROBOT]


def _json_lines(statuses: Sequence[RobotStatus]) -> list[str]:
    return [json.dumps(json_document(status)) for status in statuses]


def _table(statuses: Sequence[RobotStatus], health: bool) -> Table:
    rows = []
    for status in statuses:
        for number, stream in enumerate(_streams(status) or (None,)):
            words = [describe(status) if number == 0 else ""] if health else []
            name = status.robot if number == 0 else ""
            role: RowRole = "muted" if status.presence == "left" else "plain"
            rows.append(Row.of(name, *_cells(status.robot, stream, by_stamp=health), *words, role=role))
    return Table("", _COLUMNS if health else _COLUMNS[:-1], tuple(rows))


def _style(status: RobotStatus) -> str:
    return "dim" if status.presence == "left" else ""


def _cells(robot: str, stream: OdometryStatus | None, by_stamp: bool) -> list[str]:
    if stream is None:
        return ["-"] * 11
    x, y, heading = stream.message.pose.tolist()
    vx, vy, w = stream.message.twist.tolist()
    silent = stream.age >= _SILENCE
    return [
        stream.message.frame.removeprefix(f"{robot}/"),  # in a node of several robots frames carry the robot's name
        _digits(x, 3),
        _digits(y, 3),
        f"{math.degrees(heading):.1f}",
        _digits(stream.position_sigma, 3),
        _digits(math.degrees(stream.heading_sigma), 2),
        f"{vx:.2f}",
        f"{vy:.2f}",
        _digits(math.degrees(w), 1),
        "-" if silent or stream.rate is None else f"{stream.rate:.0f}",
        "-" if silent else _age(stream, by_stamp),
    ]


def _digits(value: float, decimals: int) -> str:
    """A value with fewer decimals the larger it is, so that a column stays narrow."""
    digits = len(f"{abs(value):.0f}")
    return f"{value:.{max(decimals - max(digits - 2, 0), 0)}f}"


def _age(stream: OdometryStatus, by_stamp: bool) -> str:
    """Time since the message arrived and, where the clocks agree, since its stamp; ms."""
    since_stamp = f"/{stream.stamp_age * 1e3:.0f}" if by_stamp and stream.stamp_age is not None else ""
    return f"{stream.age * 1e3:.0f}{since_stamp}"


def _streams(status: RobotStatus) -> tuple[OdometryStatus, ...]:
    return tuple(stream for stream in (status.odom, status.filtered) if stream is not None)


def _plain_odometry(stream: OdometryStatus) -> str:
    x, y, heading = stream.message.pose.tolist()
    vx, vy, w = stream.message.twist.tolist()
    rate = "" if stream.rate is None else f", {stream.rate:.1f} Hz"
    by_stamp = "" if stream.stamp_age is None else f" ({stream.stamp_age * 1e3:.0f} ms by its stamp)"
    return (
        f"{stream.message.frame} x {x:.3f} m y {y:.3f} m heading {math.degrees(heading):.1f} deg"
        f" (1 sigma {stream.position_sigma:.3f} m {math.degrees(stream.heading_sigma):.2f} deg)"
        f" vx {vx:.3f} m/s vy {vy:.3f} m/s w {math.degrees(w):.1f} deg/s{rate}, age {stream.age * 1e3:.0f} ms{by_stamp}"
    )
