"""The robot's own log of one OptiOdom session."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omnibench.data.importers.optiodom.session_files import SessionMetadata
from omnibench.errors import DataError
from omnibench.files import read_text
from omnibench.robot.kinematics import Array


@dataclass(frozen=True, eq=False)
class LogStretch:
    """Rows of a log: times (F,) s; ticks (F, N) and angles (F, N), rad, in the sense of the wheels of omnibench;
    commanded twists (F, 3) m/s, m/s, rad/s, or None."""

    times: Array
    ticks: Array
    angles: Array
    commands: Array | None


@dataclass(frozen=True, eq=False)
class SessionLog:
    """The robot's own log of a session. runs (F,): number of the run of each row. path: its size, in a name's words."""

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
        commands = None if whole.commands is None else whole.commands[rows]
        return LogStretch(whole.times[rows], whole.ticks[rows], whole.angles[rows], commands)


def read_log(session: SessionMetadata) -> SessionLog | None:
    """The session's log, if it is there. DataError names the file and the line that is wrong."""
    file = session.file.with_name(f"{session.name}.csv")
    if not file.is_file():
        return None
    form = session.kind.log
    header: list[list[str]] = []
    run, runs, rows = None, [], []
    for line, text in enumerate(read_text(file).splitlines(), 1):
        fields = text.split(",")
        if fields[0] == "Run:":
            run = _run_of(file, line, fields)
        elif fields[0] in ("RUNFINISHED", "METHODFINISHED") or fields[0].startswith("+++"):
            run = None
        elif run is not None:
            runs.append(run)
            rows.append(_log_row(file, line, fields, form.fields))
        elif not rows:
            header.append(fields)
    if not rows:
        raise DataError(f"{file}: it holds no run")
    table = np.array(rows)
    ticks = table[:, form.ticks] * form.signs
    angles = np.cumsum(ticks, axis=0) * session.angle_per_tick
    stretch = LogStretch(table[:, 0], ticks, angles, _commands(session, table))
    return SessionLog(file, _path(header), np.array(runs), stretch)


def _commands(session: SessionMetadata, table: Array) -> Array | None:
    """Commanded twists (F, 3), m/s, m/s, rad/s; None where the log has none."""
    form = session.kind.log
    if not form.commands:
        return None
    if not form.in_ticks:
        return table[:, form.commands]
    cycle = float(np.median(np.diff(table[:, 0])))
    speed, turn = table[:, form.commands].T
    metres = session.angle_per_tick * float(np.mean(session.geometry.diameters)) / 2
    return np.column_stack([speed * metres, np.zeros(len(table)), turn]) / cycle


def _run_of(file: Path, line: int, fields: list[str]) -> int:
    if len(fields) < 2 or not fields[1].strip().isdigit():
        raise DataError(f"{file}, line {line}: expected the number of a run after 'Run:'")
    return int(fields[1])


def _log_row(file: Path, line: int, fields: list[str], count: int) -> list[float]:
    if len(fields) < count:
        raise DataError(f"{file}, line {line}: it has {len(fields)} fields, expected {count}")
    try:
        numbers = [float(field) for field in fields[:count]]
    except ValueError as error:
        raise DataError(f"{file}, line {line}: {error}") from None
    if not all(map(math.isfinite, numbers)):
        raise DataError(f"{file}, line {line}: a value is not finite; remove or repair the row")
    return numbers


def _path(header: Sequence[Sequence[str]]) -> str:
    """Size of the path as a part of a command's name: radius and shrinkage of circles, or the length of a side.

    A log of the differential drive also says by what geometry the robot drove it.
    """
    said = {key: value for line in header for key, value in zip(line[::2], line[1::2], strict=False)}
    shrinkage = next((value for key, value in said.items() if key.startswith("Rrate(")), "")  # its end is garbled
    length = said.get("L(LmxLm):") or said.get("L(Lm):")
    radius = said.get("R(m):")
    if [len(line) for line in header] == [1, 4, 4]:  # the tricycle's: path; L, D, offset, ticks; N, size, %, turns
        (kind,), _, (_, size, shrinkage, _) = header
        radius, length = (size, None) if kind == "circular" else (None, size)
    try:
        size = f"_r{float(radius):g}x{float(shrinkage) / 100:g}" if radius else f"_l{float(length or ''):g}"
        if "b0(m):" in said:
            size += f"_b{float(said['b0(m):']):g}d{float(said['dL0(m):']):g}"
    except (KeyError, ValueError):
        return ""
    return size
