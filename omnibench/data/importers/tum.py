"""Reference poses in TUM format: ``timestamp tx ty tz qx qy qz qw``, separated by spaces, ``#`` begins a comment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omnibench.data.delimited import read_numbers
from omnibench.data.importers.orientation import planar_headings
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
    table = read_numbers(file, FIELDS, separator=None, header_lines=0)
    times = table.increasing("timestamp")
    orientations = planar_headings(table.columns(FIELDS[4:]))
    for row in np.flatnonzero(orientations.flawed)[:1]:
        raise table.fail(int(row), orientations.flaw(int(row)))
    return PoseTrack(times, np.column_stack([table.columns(("tx", "ty")), orientations.headings]))
