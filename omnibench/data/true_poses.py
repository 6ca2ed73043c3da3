"""True poses of simulated runs, in the truth folder; read only to judge reference poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from omnibench.config import read_yaml, validate
from omnibench.data.stored import read_table
from omnibench.errors import DataError
from omnibench.files import write_table
from omnibench.robot.kinematics import Array, Robot, interpolated

TRUTH_FILE = "truth.yaml"
POSES_FILE = "poses.parquet"
_COLUMNS = ("t", "x", "y", "theta")


@dataclass(frozen=True, eq=False)
class TruePath:
    """True poses of a run from its start on. times (M,): s, dense. poses (M, 3): m, m, rad, headings continuous."""

    times: Array
    poses: Array

    def at(self, stamps: Array) -> Array:
        """Poses (..., 3) at stamps (...), s, interpolated by straight lines; before and after the path it rests."""
        return interpolated(stamps, self.times, self.poses)


def write_true_poses(folder: Path, paths: Mapping[str, TruePath]) -> None:
    """Write ``poses.parquet`` into the truth folder. DataError when the disk refuses."""
    frames = []
    for name, path in paths.items():
        columns = dict(zip(_COLUMNS, np.column_stack([path.times, path.poses]).T, strict=True))
        frames.append(pl.DataFrame({"trajectory": [name] * len(path.times)} | columns))
    write_table(folder / POSES_FILE, pl.concat(frames))


def read_true_poses(folder: Path | str) -> dict[str, TruePath]:
    """The true poses of every run of a truth folder. DataError in one line: there are none, or they are broken."""
    folder = Path(folder)
    if not (folder / POSES_FILE).is_file():
        raise DataError(f"{folder}: no {POSES_FILE}; name the truth of a simulated robot with scans")
    table = read_table(folder, "poses", ("trajectory", *_COLUMNS))
    ids, values = list(dict.fromkeys(table.ids)), table.stack(_COLUMNS)
    paths = table.rows_by_run(ids, POSES_FILE)
    return {ids[index]: TruePath(values[rows, 0], values[rows, 1:]) for index, rows in paths}


def robot_of_truth(folder: Path | str) -> Robot | None:
    """The design robot in ``truth.yaml`` of a truth folder; None without that file. ConfigError in one line."""
    file = Path(folder) / TRUTH_FILE
    if not file.is_file():
        return None
    record = read_yaml(file)
    return validate(Robot, record.get("robot") if isinstance(record, dict) else None, f"{file}: robot")
