"""Data sets on disk, ``omnibench-dataset/1``: a folder with dataset.yaml and Parquet or CSV tables."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.header import Header, read_header
from omnibench.data.reference_table import REFERENCE_COLUMNS, TABLE
from omnibench.data.run_checks import stored_pose_times_flaw
from omnibench.data.scan_files import ScansOnDisk, write_scans
from omnibench.data.scans import Scans
from omnibench.data.splits import SCANS_LEFT_OUT, check_fits, complete, distinct_runs
from omnibench.data.stored_rows import MOST_IN_MEMORY, count_rows
from omnibench.data.stored_wheels import StoredWheels, WholeTableError
from omnibench.data.tables.dataset_tables import COMMAND_COLUMNS, POSE_COLUMNS, DatasetTables, tables_of
from omnibench.data.tables.table import Table, WheelTable, dataset_folders, read_table, table_file
from omnibench.errors import DataError, require_type
from omnibench.files import (
    FileContent,
    TableFormat,
    check_place,
    encode_table,
    remove,
    resolved,
    results_locked,
    write_files,
)
from omnibench.progress import expect_reading
from omnibench.words import plural, some


@dataclass(frozen=True, eq=False)
class RecordedDataset:
    """The content of a data set folder as it was recorded: headings are not unwrapped, and no units are checked."""

    header: Header
    trajectories: list[Trajectory]
    scans: ScansOnDisk | None


def load_dataset(path: Path | str | Sequence[Path | str], *, most_in_memory: int = MOST_IN_MEMORY) -> Dataset:
    """Read and check a data set: a folder, or several of one robot, named one by one or by a glob.

    most_in_memory: wheel samples up to which they are kept; those of Parquet files with more stay there, and are read
    run by run where they are used. Of several folders ids and sessions that two share get the name of their folder's
    data set before them.
    DataError names the file, the row (1 is the first after the header) and what is wrong.
    """
    folders = dataset_folders(path)
    samples = sum(_stored_samples(folder) for folder in folders)
    left = samples > most_in_memory
    if left:
        expect_reading(samples, "sample")
    recorded = [read_recorded(folder, left_in_files=left) for folder in folders]
    headers = [each.header for each in recorded]
    first, last = headers[0], headers[-1]
    for folder, other in zip(folders[1:], headers[1:], strict=True):
        check_fits(first, other, (str(folders[0]), str(folder)))
    runs = recorded[0].trajectories
    if len(recorded) > 1:
        runs = complete(distinct_runs([(each.header.name, each.trajectories) for each in recorded]))
    dataset = make_dataset(
        first.name if all(header.name == first.name for header in headers) else f"{first.name} to {last.name}",
        first.robot,
        first.sample_period,
        runs,
        description=_all_of([header.description for header in headers]),
        source=_all_of([header.source for header in headers]),
        licence=_all_of([header.licence for header in headers]),
        simulated=any(header.simulated for header in headers),
        scans=recorded[0].scans if len(recorded) == 1 else None,
    )
    if len(recorded) > 1:
        left_out = [SCANS_LEFT_OUT] if any(each.scans is not None for each in recorded) else []
        dataset = replace(dataset, warnings=(*dataset.warnings, *left_out, *_there_twice(dataset.trajectories)))
    return replace(dataset, imported=first.imported if len(recorded) == 1 else None)


def load_whole(path: Path | str) -> Dataset:
    """Read a data set as load_dataset does, into memory whatever its size: for work that needs all samples at once."""
    return load_dataset(path, most_in_memory=sys.maxsize)


def _there_twice(runs: Sequence[Trajectory]) -> list[str]:
    """Warning of runs of several folders that hold the same recording."""
    first: dict[str, str] = {}
    copies = [run.id for run in runs if first.setdefault(run.fingerprint, run.id) != run.id]
    if not copies:
        return []
    return [f"{plural(len(copies), 'run')} of another folder there twice, counted as repetitions: {some(copies, 5)}"]


def _all_of(texts: Sequence[str]) -> str:
    """The texts that differ, one after another."""
    return "; ".join(dict.fromkeys(filter(None, texts)))


def read_recorded(folder: Path, *, left_in_files: bool = False) -> RecordedDataset:
    """Read a data set folder and check its tables. DataError as for ``load_dataset``.

    left_in_files: the wheel samples of a Parquet file stay there, if its rows allow to read it run by run.
    """
    header = read_header(folder)
    runs = read_table(folder, "trajectories", ("trajectory", "split"))
    poses = _poses(folder)
    references = None if table_file(folder, TABLE) is None else read_table(folder, TABLE, REFERENCE_COLUMNS)
    commands = None if table_file(folder, "commands") is None else read_table(folder, "commands", COMMAND_COLUMNS)
    whole = partial(read_table, folder, "wheels", ("trajectory", "t", *(f"omega_{wheel}" for wheel in header.wheels)))
    trajectories = None
    if left_in_files and (file := _parquet_of_wheels(folder)) is not None:
        with suppress(WholeTableError):
            tables = DatasetTables(runs, StoredWheels(file), poses, references, commands)
            trajectories = tables.trajectories(header.robot)
    if trajectories is None:
        tables = DatasetTables(runs, WheelTable(whole()), poses, references, commands)
        trajectories = tables.trajectories(header.robot)
    return RecordedDataset(header, trajectories, _scans(folder, header, [trajectory.id for trajectory in trajectories]))


def _stored_samples(folder: Path) -> int:
    """The number of wheel samples that a folder has in a Parquet file."""
    file = _parquet_of_wheels(folder)
    return 0 if file is None else count_rows(file)


def _parquet_of_wheels(folder: Path) -> Path | None:
    file = table_file(folder, "wheels")
    return file if file is not None and file.suffix == ".parquet" else None


def save_dataset(
    dataset: Dataset, path: Path | str, table_format: TableFormat = "parquet", *, overwrite: bool = False
) -> None:
    """Write a data set folder. One that holds an earlier state of the data set is replaced.

    overwrite: replace any data set. DataError when the poses are placeholders, the folder holds something else or (not
    ``overwrite``) another data set, by its name or by being simulated, or the disk refuses.

    >>> save_dataset(dataset, "data/mine")
    >>> load_dataset("data/mine").hash == dataset.hash
    True
    """
    require_type(dataset, Dataset, "load_dataset")
    folder = Path(path)
    if not dataset.referenced:
        raise DataError(
            f"data set {dataset.name}: it has no reference poses; make them from its scans with slam_dataset, as "
            "omnibench.import_dataset does"
        )
    for trajectory in dataset.trajectories:
        if (
            trajectory.references is None
            and (flaw := stored_pose_times_flaw(trajectory.pose_times, trajectory.id)) is not None
        ):
            raise DataError(f"data set {dataset.name}: {flaw[1]}; leave it out")
    check_dataset_folder(folder)
    if not overwrite:
        _check_origin(folder, dataset)
    tables = tables_of(dataset)
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
    with results_locked(folder):
        write_files(contents)
        for name in ("poses", TABLE, "commands", "scans"):  # that an earlier data set had
            if folder / f"{name}.{table_format}" not in contents:
                remove(folder / f"{name}.{table_format}")
        # In the other format, of an earlier data set.
        for name in ("trajectories", "wheels", "poses", TABLE, "commands", "scans"):
            remove(folder / f"{name}.{'csv' if table_format == 'parquet' else 'parquet'}")


def check_dataset_folder(folder: Path) -> None:
    """DataError in one line when a data set cannot be written there: something else is there, or nobody may write."""
    resolved(folder)
    if folder.is_file():
        raise DataError(f"{folder}: is a file; name a folder for the data set")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "dataset.yaml").is_file():
        raise DataError(f"{folder}: holds other files; name an empty or new folder for the data set")
    check_place(folder)


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


def _poses(folder: Path) -> Table | None:
    """The table of poses; None where there is none, and references in its place."""
    if table_file(folder, "poses") is None and table_file(folder, TABLE) is not None:
        return None
    return read_table(folder, "poses", POSE_COLUMNS)
