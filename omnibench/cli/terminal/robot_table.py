"""``omnibench listen``: robots' odometry as a live table, as plain lines, or as JSON."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from contextlib import nullcontext
from threading import Event
from typing import Any, Final

import zenoh
from pydantic_core import to_jsonable_python
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from omnibench.errors import DataError
from omnibench.live.network.presence import checked_robot, nothing_received
from omnibench.live.robot_monitor import OdometryStatus, RobotMonitor, RobotStatus
from omnibench.live.stopping import ticks
from omnibench.live.wire.topics import KeySpace

_REFRESH: Final = 0.2  # s, of the table
_LINE_PERIOD: Final = 1.0  # s, of lines
_SILENCE: Final = 1.0  # s without a message, then it is said
_HEALTH_WIDTH: Final = 48  # columns that health, and more room between the figures, need beside these
_NAME_WIDTH: Final = 10
_NOBODY: Final = "no robot is heard yet"


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
    """Show what is heard of ``robot`` (None: of all) until ``stop`` is set or ``seconds`` have passed.

    A table on a terminal, else a line a second for each robot; ``as_json``: that line is a JSON document.
    DataError: nothing is heard of ``robot`` within ``patience`` s. ConfigError: no robot can have this name.
    """
    if robot is not None:
        checked_robot(robot)
    table = console.is_terminal and not as_json
    with RobotMonitor(session, keys, robot) as monitor:
        if robot is not None:
            _wait_for(robot, monitor, stop, patience)
        with Live(console=console, auto_refresh=False) if table else nullcontext() as live:
            for _ in ticks(stop, _REFRESH if live else _LINE_PERIOD, seconds):
                news = monitor.status()
                if live:
                    live.update(view(news, console), refresh=True)
                    continue
                for line in [json.dumps(document(each)) for each in news] if as_json else _plain_lines(news):
                    console.print(Text(line), soft_wrap=True)


def _wait_for(robot: str, monitor: RobotMonitor, stop: Event, patience: float) -> None:
    deadline = time.monotonic() + patience
    while not any(each.presence == "alive" or each.odom or each.filtered for each in monitor.status()):
        if time.monotonic() > deadline:
            raise DataError(nothing_received(robot, patience, monitor.alive))
        if stop.wait(0.02):
            return


def view(news: Sequence[RobotStatus], console: Console) -> RenderableType:
    """The robots as a table that fits the console: health beside the figures if there is room, else below them."""
    if not news:
        return Text(_NOBODY)
    figures = _table(news, health=False)
    if console.measure(figures).maximum + _HEALTH_WIDTH <= console.width:
        return _table(news, health=True)
    return Group(figures, *(Text(f"{each.robot}: {state(each)}", style=_style(each)) for each in news))


def _table(news: Sequence[RobotStatus], health: bool) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, int(health), 0, 0), pad_edge=False)
    table.add_column("robot", no_wrap=True, overflow="ellipsis", max_width=None if health else _NAME_WIDTH)
    table.add_column("frame")
    for heading in ("x\nm", "y\nm", "deg", "±m", "±deg", "vx\nm/s", "vy\nm/s", "deg/s", "Hz", "age\nms"):
        table.add_column(heading, justify="right", no_wrap=True)
    if health:
        table.add_column("health")
    for each in news:
        for row, stream in enumerate(_streams(each) or (None,)):
            words = [state(each) if row == 0 else ""] if health else []
            name = each.robot if row == 0 else ""
            table.add_row(name, *_cells(each.robot, stream, by_stamp=health), *words, style=_style(each))
    return table


def _style(news: RobotStatus) -> str:
    return "dim" if news.presence == "left" else ""


def _cells(robot: str, news: OdometryStatus | None, by_stamp: bool) -> list[str]:
    if news is None:
        return ["-"] * 11
    x, y, heading = news.message.pose.tolist()
    vx, vy, w = news.message.twist.tolist()
    silent = news.age >= _SILENCE
    return [
        news.message.frame.removeprefix(f"{robot}/"),  # frames of one robot among several carry its name
        _digits(x, 3),
        _digits(y, 3),
        f"{math.degrees(heading):.1f}",
        _digits(news.position_sigma, 3),
        _digits(math.degrees(news.heading_sigma), 2),
        f"{vx:.2f}",
        f"{vy:.2f}",
        _digits(math.degrees(w), 1),
        "-" if silent or news.rate is None else f"{news.rate:.0f}",
        "-" if silent else _age(news, by_stamp),
    ]


def _digits(value: float, decimals: int) -> str:
    """A value with fewer decimals the larger it is, so that a column stays narrow."""
    digits = len(f"{abs(value):.0f}")
    return f"{value:.{max(decimals - max(digits - 2, 0), 0)}f}"


def _age(news: OdometryStatus, by_stamp: bool) -> str:
    """Since it came and, where the clocks agree, since its stamp; ms."""
    since_stamp = f"/{news.stamp_age * 1e3:.0f}" if by_stamp and news.stamp_age is not None else ""
    return f"{news.age * 1e3:.0f}{since_stamp}"


def state(news: RobotStatus) -> str:
    """How a robot is, in words."""
    parts = []
    if news.presence == "left":
        parts.append("left")
    streams = _streams(news)
    silence = min((stream.age for stream in streams), default=None)
    if silence is None:
        parts.append("no odometry yet")
    elif silence >= _SILENCE:
        parts.append(f"no news for {silence:.1f} s")
    elif news.health is None and news.presence != "left":
        parts.append("it does not tell its health")
    if news.health is not None and news.presence != "left":
        message = news.health.message
        parts.append(news.health.status + (f": {message}" if message not in ("", news.health.status) else ""))
        parts.extend(f"{name} {count}" for name, count in news.health.counts.items())
    undecodable = sum(stream.undecodable for stream in streams)
    if undecodable:
        parts.append(f"undecodable odometry {undecodable}")
    return ", ".join(parts)


def _plain_lines(news: Sequence[RobotStatus]) -> list[str]:
    return [plain(each) for each in news] or [_NOBODY]


def plain(news: RobotStatus) -> str:
    """A robot as one line."""
    return "; ".join([f"{news.robot}: {state(news)}", *map(_plain_odometry, _streams(news))])


def _streams(news: RobotStatus) -> tuple[OdometryStatus, ...]:
    return tuple(stream for stream in (news.odom, news.filtered) if stream is not None)


def _plain_odometry(news: OdometryStatus) -> str:
    x, y, heading = news.message.pose.tolist()
    vx, vy, w = news.message.twist.tolist()
    rate = "" if news.rate is None else f", {news.rate:.1f} Hz"
    by_stamp = "" if news.stamp_age is None else f" ({news.stamp_age * 1e3:.0f} ms by its stamp)"
    return (
        f"{news.message.frame} x {x:.3f} m y {y:.3f} m heading {math.degrees(heading):.1f} deg"
        f" (1 sigma {news.position_sigma:.3f} m {math.degrees(news.heading_sigma):.2f} deg)"
        f" vx {vx:.3f} m/s vy {vy:.3f} m/s w {math.degrees(w):.1f} deg/s{rate}, age {news.age * 1e3:.0f} ms{by_stamp}"
    )


def document(news: RobotStatus) -> Any:
    """A robot as a JSON document: SI units, infinity and NaN as null."""
    content = {
        "robot": news.robot,
        "presence": news.presence,
        "odom": _odometry_record(news.odom),
        "filtered": _odometry_record(news.filtered),
        "health": news.health,
    }
    return to_jsonable_python(content, inf_nan_mode="null")


def _odometry_record(news: OdometryStatus | None) -> dict[str, Any] | None:
    if news is None:
        return None
    message = news.message
    return {
        "stamp": message.seconds,
        "frame": message.frame,
        "pose": message.pose.tolist(),
        "pose_covariance": message.pose_covariance.tolist(),
        "position_sigma_m": news.position_sigma,
        "heading_sigma_rad": news.heading_sigma,
        "twist": message.twist.tolist(),
        "rate_hz": news.rate,
        "age_s": news.age,
        "stamp_age_s": news.stamp_age,
        "undecodable": news.undecodable,
    }
