"""A data set as tables: made from data frames, from dicts of arrays or from what was read, and written as such."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any, cast

import numpy as np
import polars as pl

from omnibench.data.dataset import SPLITS, Dataset, Split, Trajectory
from omnibench.data.dataset import make_dataset as of_trajectories
from omnibench.data.delimited import not_increasing
from omnibench.data.reference_table import REFERENCE_COLUMNS, TABLE, read_references, reference_frame
from omnibench.data.references import References
from omnibench.data.run_checks import pose_times_flaw, stored_pose_times_flaw
from omnibench.data.scans import Scans
from omnibench.data.splits import every_second
from omnibench.data.stored_rows import median_period
from omnibench.data.tables.table import (
    Rows,
    Table,
    WheelArrays,
    WheelSource,
    WheelTable,
    check_times,
    checked_table,
    rows_by_trajectory,
)
from omnibench.errors import DataError, nearest, require_type
from omnibench.robot.kinematics import Array, Robot

POSE_COLUMNS = ("trajectory", "t", "x", "y", "theta")
COMMAND_COLUMNS = ("trajectory", "t", "v", "alpha", "omega", "t_r")
_RUN_NUMBERS = ("started_at", "v", "alpha", "omega", "duration", "distance")
_COVARIANCE = ("xx", "xy", "xtheta", "yy", "ytheta", "thetatheta")
_ONLY_RUN = "run"  # id of the run of tables without a column "trajectory"
_PERIOD_DECIMALS = 9  # of a sample period in s that is taken from stamps: ns


def make_dataset(
    name: str,
    robot: Robot,
    sample_period: float | None = None,
    trajectories: Iterable[Trajectory] | Any = None,
    *,
    wheels: Any = None,
    poses: Any = None,
    references: Any = None,
    description: str = "",
    source: str = "",
    licence: str = "",
    simulated: bool = False,
    scans: Scans | None = None,
) -> Dataset:
    """A data set from arrays or data frames, checked as files are checked.

    sample_period: s, that of the wheel samples; default: the median of their stamps. Either

    - ``trajectories``: :class:`Trajectory` objects, one a run, with arrays; or
    - tables: Polars or pandas data frames, or dicts of columns, with the columns of a data set's files.
      wheels: trajectory, t (s), omega_<wheel> (rad/s) of every wheel, steer_<wheel> (rad) of steered ones; poses:
      trajectory, t, x, y (m), theta (rad), the first of a run at t = 0; references: in their place or beside them.
      trajectories: trajectory, split (train or validation), command ...; default: every run of ``wheels``. Without
      ``split`` every second run of a command validates. Tables of one run need no column ``trajectory``.

    DataError names the table, its row (1 is the first) and column, and what is wrong: a missing column or value, times
    that do not increase, a run without a pose at t = 0, two runs of the same name, values that no robot reaches. Units
    and signs that look wrong are the data set's ``warnings``.

    >>> import numpy as np
    >>> robot = Robot(name="cart", wheels=[
    ...     Wheel(name="left", type="fixed", radius=0.05, x=0, y=0.15),
    ...     Wheel(name="right", type="fixed", radius=0.05, x=0, y=-0.15)])
    >>> t = np.arange(1, 51) * 0.02
    >>> wheels = {"t": t, "omega_left": np.full(50, 4.0), "omega_right": np.full(50, 4.0)}
    >>> poses = {"t": [0.0, 1.0], "x": [0.0, 0.2], "y": [0.0, 0.0], "theta": [0.0, 0.0]}
    >>> make_dataset("day1", robot, wheels=wheels, poses=poses)
    Dataset 'day1': 1 run (1 train, 0 validation) of robot cart (wheels left, right)
      recorded, 50 wheel samples every 20 ms, 2 reference poses
    """
    require_type(robot, Robot, "Robot(name=..., wheels=[...])")
    texts: dict[str, Any] = {"description": description, "source": source, "licence": licence, "simulated": simulated}
    if wheels is None:
        runs = _runs(name, trajectories, poses is not None or references is not None)
    elif poses is None and references is None:
        raise DataError(
            f"data set {name}: poses is missing: a table with the columns t, x, y and theta; or references, with "
            "distances, turns and the like"
        )
    else:
        runs = _tables(robot, trajectories, wheels, poses, references).trajectories(robot)
    if not isinstance(sample_period, Real | None):
        raise DataError(f"data set {name}: sample_period is {sample_period!r}, expected a number of seconds")
    period = _sample_period(runs) if sample_period is None else sample_period
    return of_trajectories(name, robot, period, runs, scans=scans, **texts)


def _runs(name: str, trajectories: Any, others: bool) -> list[Trajectory]:
    """Trajectory objects whose fields may be lists. DataError: there are none, or tables without that of the wheels."""
    if others or trajectories is None:
        raise DataError(f"data set {name}: wheels is missing: a table with the columns t and omega_<wheel>")
    runs = list(trajectories)
    for run in runs:
        if not isinstance(run, Trajectory):
            given = type(run).__name__
            raise DataError(f"data set {name}: a trajectory is of type {given}; of tables give wheels= and poses=, too")
    return [run.with_arrays() for run in runs]


def _sample_period(runs: Sequence[Trajectory]) -> float:
    """The median time between wheel samples, s."""
    if not runs:
        return 1.0  # that there is no run is said next
    return round(median_period(runs), _PERIOD_DECIMALS)


def _tables(robot: Robot, trajectories: Any, wheels: Any, poses: Any, references: Any) -> DatasetTables:
    """The tables that a user gave, with a table of runs."""
    frames = {"wheels": _frame("wheels", wheels)}
    if poses is not None:
        frames["poses"] = _frame("poses", poses)
    if references is not None:
        frames[TABLE] = _frame(TABLE, references)
    if all("trajectory" not in frame.columns for frame in frames.values()):
        frames = {name: frame.with_columns(pl.lit(_ONLY_RUN).alias("trajectory")) for name, frame in frames.items()}
    rates = [f"omega_{wheel}" for wheel in robot.wheel_names]
    required = {"wheels": ("trajectory", "t", *rates), "poses": POSE_COLUMNS, TABLE: REFERENCE_COLUMNS}
    checked = {name: checked_table(Path(name), frame, required[name]) for name, frame in frames.items()}
    named = checked["wheels"].frame["trajectory"].unique(maintain_order=True)
    runs = pl.DataFrame({"trajectory": named}) if trajectories is None else _frame("trajectories", trajectories)
    if "split" not in runs.columns:
        commands = runs["command"].to_list() if "command" in runs.columns else [None] * len(runs)
        runs = runs.with_columns(pl.Series("split", every_second(commands), dtype=pl.String))
    of_runs = checked_table(Path("trajectories"), runs, ("trajectory", "split"))
    return DatasetTables(of_runs, WheelTable(checked["wheels"]), checked.get("poses"), checked.get(TABLE))


def _frame(name: str, content: Any) -> pl.DataFrame:
    """A data frame or a dict of columns as a Polars frame. DataError names the table and the column that is unfit."""
    if isinstance(content, pl.DataFrame):
        return content
    if isinstance(content, Mapping):
        columns = {str(column): content[column] for column in content}
    elif hasattr(content, "columns") and hasattr(content, "__getitem__"):  # pandas, and others like it
        columns = {str(column): content[column] for column in content.columns}
    else:
        raise DataError(f"{name}: expected a data frame or a dict of arrays, found {type(content).__name__}")
    arrays = {column: np.atleast_1d(np.asarray(values)) for column, values in columns.items()}
    if not arrays:
        raise DataError(f"{name}: it has no columns")
    first, rows = next((column, len(array)) for column, array in arrays.items())
    for column, array in arrays.items():
        if array.ndim != 1:
            raise DataError(f"{name}: column {column!r} has shape {array.shape}; give a column for each wheel or axis")
        if len(array) != rows:
            raise DataError(f"{name}: column {column!r} has {len(array)} rows, {first!r} has {rows}")
    return pl.DataFrame(
        {column: array.tolist() if array.dtype == object else array for column, array in arrays.items()}, strict=False
    )


@dataclass(frozen=True, eq=False)
class DatasetTables:
    """The tables of a data set, whose required columns are there. poses: None where all runs have references.

    commands: the motion commands that were sent in runs, if they were recorded.
    """

    runs: Table
    wheels: WheelSource
    poses: Table | None
    references: Table | None
    commands: Table | None = None

    def trajectories(self, robot: Robot) -> list[Trajectory]:
        """The runs of the tables. DataError names the table, the row and what is wrong."""
        runs, poses = self.runs, self.poses
        _check_runs(runs)
        samples = self.wheels.of_runs(runs, robot)
        ids = runs.frame["trajectory"].to_list()
        ends = {run: arrays.times for run, arrays in zip(ids, samples, strict=True)}
        started = set() if poses is None else set(poses.frame["trajectory"])
        references = read_references(self.references, ends, started, runs.file.name)
        pose_rows = _pose_rows(runs, poses, references)
        reference = None if poses is None else _PoseColumns(poses)
        sent = [None] * len(ids) if self.commands is None else _sent(runs, self.commands)
        return [
            _trajectory(row, samples[index], reference, pose_rows[index], references.get(row["trajectory"]), commands)
            for index, (row, commands) in enumerate(zip(runs.frame.iter_rows(named=True), sent, strict=True))
        ]


def tables_of(dataset: Dataset) -> dict[str, pl.DataFrame]:
    """The tables of a data set by name: trajectories, wheels, and poses and references where there are some."""
    tables = {
        "trajectories": pl.DataFrame([_run_row(run) for run in dataset.trajectories], infer_schema_length=None),
        "wheels": pl.concat([_wheel_frame(run, dataset.robot) for run in dataset.trajectories]),
    }
    if placed := [_pose_frame(run) for run in dataset.trajectories if run.start_known]:
        tables["poses"] = pl.concat(placed)
    if measured := [(run.id, run.references) for run in dataset.trajectories if run.references is not None]:
        tables[TABLE] = reference_frame(measured)
    if rows := [(run.id, *row) for run in dataset.trajectories if run.sent is not None for row in run.sent.tolist()]:
        tables["commands"] = pl.DataFrame(rows, schema=list(COMMAND_COLUMNS), orient="row")
    return tables


def _sent(runs: Table, commands: Table) -> list[Array | None]:
    """The motion commands (C, 5) of each run; None for one without any."""
    rows = rows_by_trajectory(runs, commands, runs.frame["trajectory"].to_list())
    check_times(commands, [of_run for of_run in rows if len(of_run)], lambda times, _: not_increasing(times))
    values = np.column_stack([commands.numbers(column) for column in COMMAND_COLUMNS[1:]])
    return [values[of_run] if len(of_run) else None for of_run in rows]


class _PoseColumns:
    def __init__(self, table: Table) -> None:
        self.times = table.numbers("t")
        self.poses = np.column_stack([table.numbers(column) for column in ("x", "y", "theta")])
        upper = table.stack([f"cov_{name}" for name in _COVARIANCE])
        self.covariances = None if upper is None else upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def _check_runs(runs: Table) -> None:
    for column in (*_RUN_NUMBERS, "repetition"):
        if column in runs.frame.columns:
            series = runs.floats(column)
            _refuse_infinite(runs, series)
            runs.frame = runs.frame.with_columns(series.alias(column))
    if "repetition" in runs.frame.columns:
        numbers = runs.frame["repetition"]
        runs.refuse(numbers % 1 != 0, lambda row: f"repetition is {numbers[row]}, not a whole number")
    ids = runs.frame["trajectory"]
    runs.refuse(~ids.is_first_distinct(), lambda row: f"trajectory {ids[row]} is there twice; give each its own id")
    for row, split in enumerate(runs.frame["split"]):
        if split not in SPLITS:
            raise runs.fail(row, f"split is {split!r}; {nearest(str(split), SPLITS)}it must be train or validation")


def _refuse_infinite(runs: Table, values: pl.Series) -> None:
    infinite = ~values.is_finite() & values.is_not_null()
    runs.refuse(infinite, lambda row: f"{values.name} is {values[row]}; leave it empty if it is not known")


def _pose_rows(runs: Table, poses: Table | None, referenced: Collection[str]) -> list[Rows]:
    """The rows of poses of each run; runs that have references may have none, or the start alone."""
    ids = runs.frame["trajectory"].to_list()
    if poses is None:
        for index, run in enumerate(ids):
            if run not in referenced:
                raise runs.fail(index, f"trajectory {run} has neither references nor, without poses.parquet, poses")
        return [np.zeros(0, dtype=np.intp) for _ in ids]
    rows = rows_by_trajectory(runs, poses, referenced)
    given = [(run in referenced, of_run) for run, of_run in zip(ids, rows, strict=True) if len(of_run)]
    check_times(poses, [of_run for has_references, of_run in given if not has_references], stored_pose_times_flaw)
    check_times(poses, [of_run for has_references, of_run in given if has_references], pose_times_flaw)
    return rows


def _trajectory(
    run: dict[str, Any],
    wheels: WheelArrays,
    reference: _PoseColumns | None,
    pose_rows: Rows,
    references: References | None,
    sent: Array | None,
) -> Trajectory:
    pose_times: Array = np.zeros(1)
    poses: Array = np.zeros((1, 3))
    covariances: Array | None = None
    if reference is not None and len(pose_rows):
        pose_times, poses = reference.times[pose_rows], reference.poses[pose_rows]
        covariances = None if reference.covariances is None else reference.covariances[pose_rows]
    return Trajectory(
        id=run["trajectory"],
        split=cast(Split, run["split"]),
        times=wheels.times,
        rates=wheels.rates,
        pose_times=pose_times,
        poses=poses,
        command=None if run.get("command") is None else str(run["command"]),
        repetition=None if run.get("repetition") is None else round(run["repetition"]),
        session=None if run.get("session") is None else str(run["session"]),
        angles=wheels.angles,
        targets=wheels.targets,
        steering=wheels.steering,
        odometry=wheels.odometry,
        sent=sent,
        pose_covariances=covariances,
        references=references,
        **_run_numbers(run),
    )


def _run_numbers(run: dict[str, Any]) -> dict[str, Any]:
    return {name: float(run[name]) for name in _RUN_NUMBERS if run.get(name) is not None}


def _run_row(trajectory: Trajectory) -> dict[str, Any]:
    names = ("command", "repetition", "split", "session", *_RUN_NUMBERS)
    return {"trajectory": trajectory.id} | {name: getattr(trajectory, name) for name in names}


def _wheel_frame(trajectory: Trajectory, robot: Robot) -> pl.DataFrame:
    columns: dict[str, Any] = {"trajectory": [trajectory.id] * len(trajectory.times), "t": np.asarray(trajectory.times)}
    for prefix, wheels, values in (
        ("omega", robot.wheel_names, trajectory.rates),
        ("steer", robot.drive.steered, trajectory.steering),
        ("phi", robot.wheel_names, trajectory.angles),
        ("target", robot.wheel_names, trajectory.targets),
        ("odom", ("x", "y", "theta"), trajectory.odometry),
    ):
        for index, wheel in enumerate(wheels):
            columns[f"{prefix}_{wheel}"] = [None] * len(trajectory.times) if values is None else values[:, index]
    return pl.DataFrame(columns, schema_overrides={name: pl.Float64 for name in columns if name != "trajectory"})


def _pose_frame(trajectory: Trajectory) -> pl.DataFrame:
    count = len(trajectory.pose_times)
    columns: dict[str, Any] = {"trajectory": [trajectory.id] * count, "t": trajectory.pose_times}
    columns |= {name: trajectory.poses[:, index] for index, name in enumerate(("x", "y", "theta"))}
    covariances = trajectory.pose_covariances
    for index, name in enumerate(_COVARIANCE):
        row, column = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))[index]
        columns[f"cov_{name}"] = [None] * count if covariances is None else covariances[:, row, column]
    return pl.DataFrame(columns, schema_overrides={name: pl.Float64 for name in columns if name != "trajectory"})
