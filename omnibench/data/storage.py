"""Data sets on disk, ``omnibench-dataset/1``: a folder with dataset.yaml and Parquet or CSV tables."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import polars as pl

from omnibench.data.dataset import SPLITS, Dataset, Split, Trajectory, make_dataset
from omnibench.data.header import Header, read_header
from omnibench.data.references.reference_table import TABLE, read_references, reference_frame
from omnibench.data.references.run_references import References
from omnibench.data.run_checks import Flaw, pose_times_flaw, stored_pose_times_flaw, wheel_times_flaw
from omnibench.data.scan_files import ScansOnDisk, write_scans
from omnibench.data.scans import Scans
from omnibench.data.table import Table, read_table, table_file
from omnibench.errors import DataError, nearest, require_type
from omnibench.files import FileContent, TableFormat, encode_table, remove, resolved, write_files
from omnibench.robot.kinematics import Array, Robot

_RUN_NUMBERS = ("started_at", "v", "alpha", "omega", "duration", "distance")
_Rows = np.ndarray[Any, np.dtype[np.intp]]  # indices of rows of a table
_COVARIANCE = ("xx", "xy", "xtheta", "yy", "ytheta", "thetatheta")


@dataclass(frozen=True, eq=False)
class RecordedDataset:
    """The content of a data set folder as it was recorded: headings are not unwrapped, and no units are checked."""

    header: Header
    trajectories: list[Trajectory]
    scans: ScansOnDisk | None


def load_dataset(path: Path | str) -> Dataset:
    """Read and check a data set folder.

    DataError names the file, the row (1 is the first after the header) and what is wrong.
    """
    recorded = read_recorded(Path(path))
    header = recorded.header
    dataset = make_dataset(
        header.name,
        header.robot,
        header.sample_period,
        recorded.trajectories,
        description=header.description,
        source=header.source,
        licence=header.licence,
        simulated=header.simulated,
        scans=recorded.scans,
    )
    return replace(dataset, imported=header.imported)


def read_recorded(folder: Path) -> RecordedDataset:
    """Read a data set folder and check its tables. DataError as for ``load_dataset``."""
    header = read_header(folder)
    runs = read_table(folder, "trajectories", ("trajectory", "split"))
    rates = [f"omega_{wheel}" for wheel in header.wheels]
    wheels = read_table(folder, "wheels", ("trajectory", "t", *rates))
    _check_steering(wheels, header.robot)
    poses = _poses(folder)
    _check_runs(runs)
    wheel_rows = _rows_by_trajectory(runs, wheels)
    _check_times(wheels, wheel_rows, wheel_times_flaw)
    samples = _WheelColumns(wheels, header.robot)
    ids = runs.frame["trajectory"].to_list()
    ends = {run: samples.times[rows] for run, rows in zip(ids, wheel_rows, strict=True)}
    started = set() if poses is None else set(poses.frame["trajectory"])
    references = read_references(folder, ends, started, runs.file.name)
    pose_rows = _pose_rows(runs, poses, references)
    reference = None if poses is None else _PoseColumns(poses)
    trajectories = [
        _trajectory(row, samples, wheel_rows[index], reference, pose_rows[index], references.get(row["trajectory"]))
        for index, row in enumerate(runs.frame.iter_rows(named=True))
    ]
    return RecordedDataset(header, trajectories, _scans(folder, header, [trajectory.id for trajectory in trajectories]))


def save_dataset(
    dataset: Dataset, path: Path | str, table_format: TableFormat = "parquet", *, overwrite: bool = False
) -> None:
    """Write a data set folder. One that holds an earlier state of the data set is replaced.

    overwrite: replace any data set. DataError when the poses are placeholders, the folder holds something else or (not
    ``overwrite``) another data set, by its name or by being simulated, or the disk refuses.
    """
    require_type(dataset, Dataset, "load_dataset")
    folder = Path(path)
    if not dataset.referenced:
        raise DataError(
            f"data set {dataset.name}: it has no reference poses; make them from its scans with slam_dataset, as "
            "omnibench.import_dataset does"
        )
    measured = [(run.id, run.references) for run in dataset.trajectories if run.references is not None]
    for trajectory in dataset.trajectories:
        if (
            trajectory.references is None
            and (flaw := stored_pose_times_flaw(trajectory.pose_times, trajectory.id)) is not None
        ):
            raise DataError(f"data set {dataset.name}: {flaw[1]}; leave it out")
    check_dataset_folder(folder)
    if not overwrite:
        _check_origin(folder, dataset)
    tables = {
        "trajectories": pl.DataFrame(
            [_run_row(trajectory) for trajectory in dataset.trajectories], infer_schema_length=None
        ),
        "wheels": pl.concat([_wheel_frame(trajectory, dataset.robot) for trajectory in dataset.trajectories]),
    }
    if placed := [_pose_frame(trajectory) for trajectory in dataset.trajectories if trajectory.start_known]:
        tables["poses"] = pl.concat(placed)
    if measured:
        tables[TABLE] = reference_frame(measured)
    contents: dict[Path, FileContent] = {folder / "dataset.yaml": header_of(dataset).text.encode()}
    for name, frame in tables.items():
        # A column that only some trajectories have is left out of the sample tables, which may have no gaps.
        allowed = len(frame) - 1 if name in ("trajectories", TABLE) else 0
        kept = frame.select(column for column in frame.iter_columns() if column.null_count() <= allowed)
        contents[folder / f"{name}.{table_format}"] = encode_table(kept, table_format)
    scans = _recorded_scans(dataset)
    if scans is not None:
        ids = [trajectory.id for trajectory in dataset.trajectories]
        contents[folder / f"scans.{table_format}"] = partial(write_scans, scans, table_format, ids)
    write_files(contents)
    for name in ("poses", TABLE, "scans"):  # that an earlier data set had
        if folder / f"{name}.{table_format}" not in contents:
            remove(folder / f"{name}.{table_format}")
    for name in ("trajectories", "wheels", "poses", TABLE, "scans"):  # in the other format, of an earlier data set
        remove(folder / f"{name}.{'csv' if table_format == 'parquet' else 'parquet'}")


def check_dataset_folder(folder: Path) -> None:
    """DataError in one line when a data set cannot be written there: something else is there, or nobody may write."""
    resolved(folder)
    if folder.is_file():
        raise DataError(f"{folder}: is a file; name a folder for the data set")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "dataset.yaml").is_file():
        raise DataError(f"{folder}: holds other files; name an empty or new folder for the data set")
    existing = next(each for each in (folder.absolute(), *folder.absolute().parents) if each.exists())
    if not existing.is_dir():
        raise DataError(f"{folder}: cannot be written: {existing} is not a folder; choose another place")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise DataError(f"{folder}: cannot be written: {existing} is read-only; choose another place")


def _check_origin(folder: Path, dataset: Dataset) -> None:
    """DataError: the folder holds another data set."""
    if not (folder / "dataset.yaml").is_file():
        return
    old = read_header(folder)
    if (old.name, old.simulated) != (dataset.name, dataset.simulated):
        kind = "simulated " if old.simulated else ""
        raise DataError(f"{folder}: holds the {kind}data set {old.name!r}; name another folder, or overwrite=True")


def header_of(dataset: Dataset) -> Header:
    """The content of a data set's dataset.yaml."""
    scans = _recorded_scans(dataset)
    return Header(
        name=dataset.name,
        description=dataset.description,
        source=dataset.source,
        licence=dataset.licence,
        simulated=dataset.simulated,
        robot=dataset.robot,
        sample_period=dataset.sample_period,
        wheels=dataset.robot.wheel_names,
        scanner=None if scans is None else scans.scanner,
        imported=dataset.imported,
    )


def _recorded_scans(dataset: Dataset) -> Scans | None:
    """The scans, if any trajectory has some; the data set may be a part of the one that was recorded."""
    if dataset.scans is None:
        return None
    recorded = set(dataset.scans.trajectories)
    return dataset.scans if any(trajectory.id in recorded for trajectory in dataset.trajectories) else None


class _WheelColumns:
    def __init__(self, table: Table, robot: Robot) -> None:
        wheels, steered = robot.wheel_names, robot.drive.steered
        self.times = table.numbers("t")
        rates = table.stack([f"omega_{wheel}" for wheel in wheels])
        assert rates is not None  # their presence was checked on reading
        self.rates = rates
        self.steering = table.stack([f"steer_{wheel}" for wheel in steered]) if steered else None
        self.angles = table.stack([f"phi_{wheel}" for wheel in wheels])
        self.targets = table.stack([f"target_{wheel}" for wheel in wheels])


class _PoseColumns:
    def __init__(self, table: Table) -> None:
        self.times = table.numbers("t")
        self.poses = np.column_stack([table.numbers(column) for column in ("x", "y", "theta")])
        upper = table.stack([f"cov_{name}" for name in _COVARIANCE])
        self.covariances = None if upper is None else upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def _scans(folder: Path, header: Header, trajectories: Sequence[str]) -> ScansOnDisk | None:
    file = table_file(folder, "scans")
    if file is None:
        return None
    if header.scanner is None:
        raise DataError(
            f"{folder / 'dataset.yaml'}: scanner is missing, which {file.name} needs: rays, angle_min, "
            "angle_increment, range_max (rad, m)"
        )
    return ScansOnDisk(file, header.scanner, trajectories)


def _check_steering(wheels: Table, robot: Robot) -> None:
    """DataError: there is no column with the steering angles of a wheel."""
    columns = wheels.frame.columns
    for wheel in robot.drive.steered:
        if (column := f"steer_{wheel}") not in columns:
            hint = nearest(column, [name for name in columns if not name.startswith("omega_")])
            raise DataError(
                f"{wheels.file}: column {column!r}, the steering angle of wheel {wheel} (rad, counter-clockwise, at "
                f"the sample's end), is missing; {hint}found: {', '.join(columns)}"
            )


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


def _poses(folder: Path) -> Table | None:
    """The table of poses; None where there is none, and references in its place."""
    if table_file(folder, "poses") is None and table_file(folder, TABLE) is not None:
        return None
    return read_table(folder, "poses", ("trajectory", "t", "x", "y", "theta"))


def _pose_rows(runs: Table, poses: Table | None, referenced: Collection[str]) -> list[_Rows]:
    """The rows of poses of each run; runs that have references may have none, or the start alone."""
    ids = runs.frame["trajectory"].to_list()
    if poses is None:
        for index, run in enumerate(ids):
            if run not in referenced:
                raise runs.fail(index, f"trajectory {run} has neither references nor, without poses.parquet, poses")
        return [np.zeros(0, dtype=np.intp) for _ in ids]
    rows = _rows_by_trajectory(runs, poses, referenced)
    given = [(run in referenced, of_run) for run, of_run in zip(ids, rows, strict=True) if len(of_run)]
    _check_times(poses, [of_run for has_references, of_run in given if not has_references], stored_pose_times_flaw)
    _check_times(poses, [of_run for has_references, of_run in given if has_references], pose_times_flaw)
    return rows


def _rows_by_trajectory(runs: Table, table: Table, others: Collection[str] = ()) -> list[_Rows]:
    """The rows of ``table`` that belong to each run, in the file's order; a run among the others may have none."""
    ids = runs.frame["trajectory"].to_list()
    number = {identity: index for index, identity in enumerate(ids)}
    named = table.frame["trajectory"]
    codes = np.array([number.get(identity, -1) for identity in named])
    table.refuse(codes < 0, lambda row: f"trajectory {named[row]} is not in {runs.file.name}")
    order = np.argsort(codes, kind="stable")
    counts = np.bincount(codes, minlength=len(ids))
    for index, count in enumerate(counts):
        if count == 0 and ids[index] not in others:
            what = "wheel samples" if table.file.stem == "wheels" else "reference poses"
            raise DataError(f"{table.file}: trajectory {ids[index]} ({runs.file.name}, row {index + 1}) has no {what}")
    return np.split(order, np.cumsum(counts)[:-1])


def _check_times(table: Table, groups: Sequence[_Rows], find_flaw: Callable[[Array, str], Flaw | None]) -> None:
    """DataError for the first run whose times in ``table`` have a flaw. groups: the rows of each run."""
    times = table.numbers("t")
    for rows in groups:
        if (flaw := find_flaw(times[rows], table.frame["trajectory"][int(rows[0])])) is not None:
            raise table.fail(int(rows[flaw[0]]), flaw[1])


def _trajectory(
    run: dict[str, Any],
    wheels: _WheelColumns,
    wheel_rows: _Rows,
    reference: _PoseColumns | None,
    pose_rows: _Rows,
    references: References | None,
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
        times=wheels.times[wheel_rows],
        rates=wheels.rates[wheel_rows],
        pose_times=pose_times,
        poses=poses,
        command=None if run.get("command") is None else str(run["command"]),
        repetition=None if run.get("repetition") is None else round(run["repetition"]),
        session=None if run.get("session") is None else str(run["session"]),
        angles=None if wheels.angles is None else wheels.angles[wheel_rows],
        targets=None if wheels.targets is None else wheels.targets[wheel_rows],
        steering=None if wheels.steering is None else wheels.steering[wheel_rows],
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
    columns: dict[str, Any] = {"trajectory": [trajectory.id] * len(trajectory.times), "t": trajectory.times}
    for prefix, wheels, values in (
        ("omega", robot.wheel_names, trajectory.rates),
        ("steer", robot.drive.steered, trajectory.steering),
        ("phi", robot.wheel_names, trajectory.angles),
        ("target", robot.wheel_names, trajectory.targets),
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
