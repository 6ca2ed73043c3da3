"""Poses in TUM format, read and written: ``timestamp tx ty tz qx qy qz qw`` by spaces, ``#`` begins a comment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omnibench.data.delimited import read_numbers
from omnibench.data.recording import PoseReadings
from omnibench.errors import DataError
from omnibench.files import write_text
from omnibench.robot.kinematics import Array
from omnibench.robot.wheel_logs import finite_array

FIELDS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


_LARGEST_TILT = np.radians(20)  # rad; a larger tilt is that of another frame than the robot's body (chosen)
_LENGTH_TOLERANCE = 0.01  # largest deviation of a quaternion's length from 1 (chosen)


@dataclass(frozen=True, eq=False)
class PlanarHeadings:
    """Yaw of K orientations, and whether they are those of a robot on the floor.

    headings (K,): rad, within a turn. lengths (K,): the quaternions' lengths, 1 for a rotation. tilts (K,): rad,
    between the z axes of body and world. flawed (K,): the length is not 1 (to 1 %), or the tilt above 20 degrees: then
    it is another frame than the robot's body (z up), for example a camera's.
    """

    headings: Array
    lengths: Array
    tilts: Array
    flawed: NDArray[np.bool_]

    def flaw(self, index: int) -> str:
        """The flaw of an orientation in words."""
        if not abs(self.lengths[index] - 1) <= _LENGTH_TOLERANCE:
            return f"quaternion has length {self.lengths[index]:.3g}, expected 1"
        return f"pose is tilted by {np.degrees(self.tilts[index]):.0f} degrees; give poses of the robot's body (z up)"


def planar_headings(quaternions: Array) -> PlanarHeadings:
    """The yaw of quaternions (K, 4) in the order x, y, z, w; roll and pitch are left out."""
    with np.errstate(over="ignore", invalid="ignore"):  # recorded rubbish
        lengths = np.linalg.norm(quaternions, axis=1)
    rotation = np.abs(lengths - 1) <= _LENGTH_TOLERANCE  # False for NaN, too
    x, y, z, w = np.where(rotation, quaternions.T, [[0.0], [0.0], [0.0], [1.0]]) / np.where(rotation, lengths, 1.0)
    headings = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    tilts = np.arccos(np.clip(1 - 2 * (x**2 + y**2), -1, 1))
    return PlanarHeadings(headings, lengths, tilts, ~(rotation & (tilts <= _LARGEST_TILT)))


def read_tum(file: Path | str) -> PoseReadings:
    """The planar poses of a TUM file: times (K,) in s, poses (K, 3) as x, y (m) and the yaw (rad) of the quaternion.

    z, roll and pitch are left out. DataError names file and row when a row is malformed, the time does not increase, a
    quaternion has no length 1 (to 1 %), or the pose is tilted by more than 20 degrees: then it is another frame than
    the robot's body (z up), for example a camera's. Source: the file format of the TUM RGB-D benchmark, as evo and
    others write it.
    """
    table = read_numbers(Path(file), FIELDS, separator=None, header_lines=0)
    times = table.increasing("timestamp")
    orientations = planar_headings(table.columns(FIELDS[4:]))
    for row in np.flatnonzero(orientations.flawed)[:1]:
        raise table.fail(int(row), orientations.flaw(int(row)))
    return PoseReadings(times, np.column_stack([table.columns(("tx", "ty")), orientations.headings]), radians=True)


def write_tum(file: Path | str, times: ArrayLike, poses: ArrayLike) -> None:
    """Write planar poses as a TUM file, which evo reads (``evo_ape tum REFERENCE ODOMETRY``).

    times (K,): s. poses (K, 3): x, y (m) and heading (rad); z is 0. DataError: shapes do not agree, a value is not
    finite, times do not increase, or the disk refuses.

    >>> write_tum("reference.tum", [0.0, 0.1], [[0, 0, 0], [0.02, 0, 0.5]])
    >>> read_tum("reference.tum").poses.round(6).tolist()
    [[0.0, 0.0, 0.0], [0.02, 0.0, 0.5]]
    """
    stamps, planar = finite_array("times", times, 1), finite_array("poses", poses, 2)
    if planar.shape != (*stamps.shape, 3):
        raise DataError(f"{file}: times have shape {stamps.shape}, poses {planar.shape}; expected (K,) and (K, 3)")
    for row in np.flatnonzero(np.diff(stamps, prepend=-np.inf) <= 0)[:1]:
        raise DataError(f"times, row {row + 1}: it is {stamps[row]:g}; times increase")
    half = planar[:, 2] / 2
    zero = np.zeros_like(half)
    columns = (stamps, planar[:, 0], planar[:, 1], zero, zero, zero, np.sin(half), np.cos(half))
    lines = (" ".join(f"{value:.9f}" for value in row) for row in zip(*columns, strict=True))
    write_text(Path(file), "\n".join([f"# {' '.join(FIELDS)}", *lines]) + "\n")
