"""The wheel samples of a data set's runs, from a table in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from omnibench.data.run_checks import wheel_times_flaw
from omnibench.data.tables.rows_of_runs import check_times, rows_by_trajectory
from omnibench.data.tables.table import Table
from omnibench.errors import DataError, nearest
from omnibench.robot.kinematics import Array, Robot


class WheelArrays(NamedTuple):
    """A run's wheel samples, as in Trajectory."""

    times: Array
    rates: Array
    steering: Array | None = None
    angles: Array | None = None
    targets: Array | None = None
    odometry: Array | None = None


class WheelSource(Protocol):
    """A table of wheel samples, in memory or in its file."""

    def of_runs(self, runs: Table, robot: Robot) -> list[WheelArrays]:
        """The samples of each of the runs. DataError names the table, the row and what is wrong."""


def wheel_columns(robot: Robot) -> dict[str, list[str]]:
    """The columns of each of the arrays of WheelArrays; those of no length are not there."""
    wheels, steered = robot.wheel_names, robot.drive.steered
    columns = {
        "times": ["t"],
        "rates": [f"omega_{wheel}" for wheel in wheels],
        "steering": [f"steer_{wheel}" for wheel in steered],
        "angles": [f"phi_{wheel}" for wheel in wheels],
        "targets": [f"target_{wheel}" for wheel in wheels],
        "odometry": ["odom_x", "odom_y", "odom_theta"],
    }
    return {name: names for name, names in columns.items() if names}


def check_steering(file: Path, columns: Sequence[str], robot: Robot) -> None:
    """DataError: there is no column with the steering angles of a wheel."""
    for wheel in robot.drive.steered:
        if (column := f"steer_{wheel}") not in columns:
            hint = nearest(column, [name for name in columns if not name.startswith("omega_")])
            raise DataError(
                f"{file}: column {column!r}, the steering angle of wheel {wheel} (rad, counter-clockwise, at "
                f"the sample's end), is missing; {hint}found: {', '.join(columns)}"
            )


@dataclass(frozen=True, eq=False)
class WheelTable:
    """A table of wheel samples in memory."""

    table: Table

    def of_runs(self, runs: Table, robot: Robot) -> list[WheelArrays]:
        """The samples of each of the runs, see WheelSource."""
        table = self.table
        check_steering(table.file, table.frame.columns, robot)
        rows_of_runs = rows_by_trajectory(runs, table)
        check_times(table, rows_of_runs, wheel_times_flaw)
        times = table.numbers("t")
        stacked = {
            name: values
            for name, columns in wheel_columns(robot).items()
            if name != "times" and (values := table.stack(columns)) is not None
        }
        return [
            WheelArrays(times[rows], **{name: values[rows] for name, values in stacked.items()})
            for rows in rows_of_runs
        ]
