"""The files of one OptiOdom session: its metadata and the robot's own log."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omnibench.data.delimited import read_text
from omnibench.errors import DataError, nearest
from omnibench.robot.kinematics import Array

_RUN = re.compile(r"_run-(\d+)\.csv$")
_LOG_FIELDS = 10  # time, three tick increments, x, y, theta, v, vn, omega; more are ignored


@dataclass(frozen=True)
class SessionMetadata:
    """Content of ``<session>_metadata.csv``, and the run files beside it.

    diameters of the wheels and distance to the centre in m; gear and resolution (ticks per turn of the motor);
    starts: when each run's file begins in the session's log, s after the run's begin there.
    """

    file: Path
    group: str
    name: str
    diameters: tuple[float, float, float]
    distance: float
    gear: float
    resolution: float
    starts: tuple[float, ...]
    runs: tuple[Path, ...]

    @property
    def geometry(self) -> tuple[object, ...]:
        """Dimensions of the robot, which must be the same in every session."""
        return self.diameters, self.distance, self.gear, self.resolution

    @property
    def angle_per_tick(self) -> float:
        """Wheel angle of one tick, rad."""
        return 2 * math.pi / (self.gear * self.resolution)


@dataclass(frozen=True, eq=False)
class LogStretch:
    """Rows of a log: times (F,) s; ticks (F, 3); angles (F, 3) rad; commanded twists (F, 3) m/s, m/s, rad/s."""

    times: Array
    ticks: Array
    angles: Array
    commands: Array


@dataclass(frozen=True, eq=False)
class SessionLog:
    """The robot's own log of a session. runs (F,): number of the run of each row. path: radius and shrinkage."""

    file: Path
    path: str
    runs: NDArray[np.intp]
    rows: LogStretch

    @property
    def begin(self) -> float:
        """Time of the first row, s."""
        return float(self.rows.times[0])

    def stretch(self, run: int, first: int, count: int) -> LogStretch | None:
        """``count`` rows of one run from its row ``first`` on; None when the log does not hold them."""
        rows = np.flatnonzero(self.runs == run)[first : first + count]
        if len(rows) < count:
            return None
        whole = self.rows
        return LogStretch(whole.times[rows], whole.ticks[rows], whole.angles[rows], whole.commands[rows])


def run_number(file: Path) -> int:
    """The number in the name of a run's file."""
    match = _RUN.search(file.name)
    assert match is not None  # only such files are collected
    return int(match.group(1))


def read_metadata(file: Path) -> SessionMetadata:
    """Read a session's metadata and find its runs. DataError names the file and the key that is wrong."""
    values = {fields[0].strip(): fields[1:] for fields in csv.reader(read_text(file).splitlines()) if fields}
    kind = "".join(values.get("type", [])[:1]).strip()
    if kind != "omni3":
        raise DataError(
            f"{file}: type is {kind!r}, only omni3 robots can be imported; name a folder such as data/omni3"
        )
    diameters = _numbers(file, values, "Di", 3)
    (distance,) = _numbers(file, values, "Li", 1)
    (gear,) = _numbers(file, values, "ngear", 1)
    (resolution,) = _numbers(file, values, "encRes", 1)
    for key, number in (("Di", min(diameters)), ("Li", distance), ("ngear", gear), ("encRes", resolution)):
        if number <= 0:
            raise DataError(f"{file}: {key} is {number:g}, it must be above 0")
    name = file.name.removesuffix("_metadata.csv")
    runs = sorted(path for path in file.parent.glob(f"{name}_run-*.csv") if _RUN.search(path.name))
    if not runs:
        raise DataError(f"{file.parent}: no {name}_run-NN.csv beside {file.name}")
    starts = _numbers(file, values, "odo_ti", None) if "odo_ti" in values else ()
    return SessionMetadata(
        file, file.parent.parent.name, name, (diameters[0], diameters[1], diameters[2]), distance, gear, resolution,
        starts, tuple(runs),
    )  # fmt: skip


def read_log(session: SessionMetadata) -> SessionLog | None:
    """The session's log, if it is there. DataError names the file and the line that is wrong."""
    file = session.file.with_name(f"{session.name}.csv")
    if not file.is_file():
        return None
    path, run, runs, rows = "", None, [], []
    for line, text in enumerate(read_text(file).splitlines(), 1):
        fields = text.split(",")
        if fields[0] == "Run:":
            run = _run_of(file, line, fields)
        elif fields[0] in ("RUNFINISHED", "METHODFINISHED"):
            run = None
        elif run is not None:
            runs.append(run)
            rows.append(_log_row(file, line, fields))
        elif "R(m):" in fields:
            path = _path(fields)
    if not rows:
        raise DataError(f"{file}: it holds no run")
    table = np.array(rows)
    angles = np.cumsum(table[:, 1:4], axis=0) * session.angle_per_tick
    return SessionLog(file, path, np.array(runs), LogStretch(table[:, 0], table[:, 1:4], angles, table[:, 7:10]))


def _numbers(file: Path, values: dict[str, list[str]], key: str, count: int | None) -> tuple[float, ...]:
    if key not in values:
        raise DataError(f"{file}: key {key!r} is missing; {nearest(key, values)}found: {', '.join(values)}")
    texts = [text.strip() for text in values[key] if text.strip()]
    try:
        numbers = tuple(float(text) for text in texts)
    except ValueError:
        raise DataError(f"{file}: {key} is {', '.join(texts)!r}, expected numbers") from None
    if (count is not None and len(numbers) != count) or not all(map(math.isfinite, numbers)):
        raise DataError(f"{file}: {key} is {', '.join(texts)!r}, expected {count or 'finite'} numbers")
    return numbers


def _run_of(file: Path, line: int, fields: list[str]) -> int:
    if len(fields) < 2 or not fields[1].strip().isdigit():
        raise DataError(f"{file}, line {line}: expected the number of a run after 'Run:'")
    return int(fields[1])


def _log_row(file: Path, line: int, fields: list[str]) -> list[float]:
    if len(fields) < _LOG_FIELDS:
        raise DataError(f"{file}, line {line}: it has {len(fields)} fields, expected {_LOG_FIELDS}")
    try:
        numbers = [float(field) for field in fields[:_LOG_FIELDS]]
    except ValueError as error:
        raise DataError(f"{file}, line {line}: {error}") from None
    if not all(map(math.isfinite, numbers)):
        raise DataError(f"{file}, line {line}: a value is not finite; remove or repair the row")
    return numbers


def _path(fields: list[str]) -> str:
    """Radius and shrinkage of the path, as a part of a command's name."""
    values = dict(zip(fields[::2], fields[1::2], strict=False))
    try:
        return f"_r{float(values['R(m):']):g}x{float(values['Rrate(%):']) / 100:g}"
    except (KeyError, ValueError):
        return ""
