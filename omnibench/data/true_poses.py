"""True poses of simulated runs, in the truth folder; read only to judge reference poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from omnibench.config import read_yaml, validate
from omnibench.data.tables import read_table
from omnibench.errors import DataError
from omnibench.files import write_table
from omnibench.robot.kinematics import Array, Robot, interpolated

TRUTH_FILE = "truth.yaml"
POSES_FILE = "poses.parquet"


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
    frames = [
        pl.DataFrame(
            {"trajectory": [name] * len(path.times), "t": path.times}
            | {column: path.poses[:, index] for index, column in enumerate(("x", "y", "theta"))}
        )
        for name, path in paths.items()
    ]
    write_table(folder / POSES_FILE, pl.concat(frames))


def read_true_poses(folder: Path | str) -> dict[str, TruePath]:
    """The true poses of every run of a truth folder. DataError in one line: there are none, or they are broken."""
    folder = Path(folder)
    if not (folder / POSES_FILE).is_file():
        raise DataError(f"{folder}: no {POSES_FILE}; name the truth of a simulated robot with scans")
    table = read_table(folder, Path(POSES_FILE).stem, ("trajectory", "t", "x", "y", "theta"))
    columns = np.column_stack([table.numbers(name) for name in ("t", "x", "y", "theta")])
    names = table.frame["trajectory"].to_numpy()
    return {
        str(name): TruePath(columns[rows, 0], columns[rows, 1:])
        for name in table.frame["trajectory"].unique(maintain_order=True)
        for rows in [np.flatnonzero(names == name)]
    }


def robot_of_truth(folder: Path | str) -> Robot | None:
    """The design robot in ``truth.yaml`` of a truth folder; None without that file. ConfigError in one line."""
    file = Path(folder) / TRUTH_FILE
    if not file.is_file():
        return None
    record = read_yaml(file)
    return validate(Robot, record.get("robot") if isinstance(record, dict) else None, f"{file}: robot")
