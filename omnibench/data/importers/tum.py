"""Reference poses in TUM format: ``timestamp tx ty tz qx qy qz qw``, separated by spaces, ``#`` begins a comment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omnibench.data.delimited import read_text, row_error
from omnibench.data.importers.orientation import planar_headings
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

FIELDS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Planar poses: times (K,) in s as recorded, poses (K, 3) as x, y (m) and heading (rad, within a turn)."""

    times: Array
    poses: Array


def read_tum(file: Path) -> PoseTrack:
    """The planar poses of a TUM file: x, y and the yaw of the quaternion; z, roll and pitch are left out.

    DataError names file and row when a row is malformed, the time does not increase, a quaternion has no length 1
    (to 1 %), or the pose is tilted by more than 20 degrees: then it is another frame than the robot's body (z up), for
    example a camera's. Source: the file format of the TUM RGB-D benchmark, as evo and others write it.
    """
    rows: list[list[float]] = []
    lines: list[int] = []
    for line, text in enumerate(read_text(file).splitlines(), 1):
        fields = text.split("#", 1)[0].split()
        if not fields:
            continue
        rows.append(_numbers(file, len(rows), line, fields))
        lines.append(line)
    if not rows:
        raise DataError(f"{file}: it has no poses; a row is {' '.join(FIELDS)}")
    table = np.array(rows)
    _check_times(file, table[:, 0], lines)
    orientations = planar_headings(table[:, 4:])
    bad = np.flatnonzero(orientations.flawed)
    if len(bad):
        row = int(bad[0])
        raise row_error(file, row, lines[row], orientations.flaw(row))
    return PoseTrack(table[:, 0], np.column_stack([table[:, 1], table[:, 2], orientations.headings]))


def _numbers(file: Path, row: int, line: int, fields: list[str]) -> list[float]:
    if len(fields) != len(FIELDS):
        raise row_error(file, row, line, f"it has {len(fields)} fields, expected {len(FIELDS)}: {' '.join(FIELDS)}")
    numbers = []
    for name, field in zip(FIELDS, fields, strict=True):
        try:
            number = float(field)
        except ValueError:
            raise row_error(file, row, line, f"{name} is {field!r}, expected a number") from None
        if not np.isfinite(number):
            raise row_error(file, row, line, f"{name} is {field}; remove or repair the row")
        numbers.append(number)
    return numbers


def _check_times(file: Path, times: Array, lines: list[int]) -> None:
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        row = int(back[0]) + 1
        what = "is repeated" if times[row] == times[row - 1] else "goes backwards"
        raise row_error(file, row, lines[row], f"timestamp {what}: {times[row]:.10g} after {times[row - 1]:.10g}")
