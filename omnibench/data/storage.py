"""Data sets on disk, ``omnibench-dataset/1``: a folder with dataset.yaml, Parquet or CSV tables, and scans."""

from __future__ import annotations

import glob
import os
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import polars as pl
from pydantic import Field, model_validator

from omnibench.config import Model, Name, Positive, read_yaml, to_yaml, validate
from omnibench.data import stored
from omnibench.data.dataset import RUN_NUMBERS, Dataset, Imported, Trajectory, check_runs, checked, runs_of_tables
from omnibench.data.parquet import parquet_shape, sink_frames
from omnibench.data.references import AT_ONE_TIME, References
from omnibench.data.scans import Scanner, ScansOnDisk, write_scans
from omnibench.data.splits import put_together
from omnibench.data.stored import Table, read_table, table_file
from omnibench.errors import ConfigError, DataError, require_type, shown
from omnibench.files import FileContent, TableFormat, check_place, remove, resolved, results_locked, write_files
from omnibench.progress import expect_reading
from omnibench.robot.kinematics import Robot
from omnibench.words import plural, some

FORMAT: Final = "omnibench-dataset/1"
_ROW_GROUP = 1 << 17  # rows of samples or poses that are written together; chosen
_TABLES = ("trajectories", "wheels", "poses", "references", "commands", "scans")


class Header(Model):
    """The content of dataset.yaml."""

    format: Literal["omnibench-dataset/1"] = FORMAT
    name: Name = Field(min_length=1)
    description: str = ""
    source: str = ""
    licence: str = ""
    simulated: bool = Field(False, description="true for simulated data")
    robot: Robot
    sample_period: Positive = Field(description="s")
    wheels: tuple[str, ...] = Field(description="the wheels with a measured rate; column names: omega_<wheel>")
    scanner: Scanner | None = Field(None, description="the scanner, if there are scans")
    imported: Imported | None = Field(None, description="how it was imported; no part of the hash")

    @model_validator(mode="after")
    def _wheels_are_the_robots(self) -> Header:
        if self.wheels != (names := self.robot.wheel_names):
            measured = f"the robot's wheels with a measured rate are {', '.join(names)}"
            raise ValueError(f"wheels are {', '.join(self.wheels)}, but {measured}; name these, in this order")
        return self


_DESCRIBED = ("name", "robot", "sample_period", "description", "source", "licence", "simulated", "imported")


def read_header(folder: Path) -> Header:
    """The dataset.yaml of a data set's folder. DataError: it is none, or it is wrong."""
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "no such folder"
        raise DataError(f"{folder}: {what}; a data set is a folder with dataset.yaml in it")
    file = folder / "dataset.yaml"
    if not file.exists():
        several = any(folder.glob("*/dataset.yaml"))
        way = f"its folders are some: give '{folder}/*'" if several else "`omnibench import` makes one of a log"
        raise DataError(f"{file}: no such file, and so {folder} is no data set; {way}")
    try:
        content = read_yaml(file)
        given = content.get("format") if isinstance(content, dict) else None
        if given != FORMAT:
            raise DataError(f"{file}: format is {shown(given)}, expected {FORMAT!r}")
        return validate(Header, content, str(file))
    except ConfigError as error:
        raise DataError(str(error)) from None


def read_recorded(folder: Path, *, left_in_files: bool = False) -> Dataset:
    """A data set folder as it was recorded, with checked tables: headings are not unwrapped. DataError in one line.

    left_in_files: the wheel samples of a Parquet file stay there, if its rows allow to read it run by run.
    """
    header, tables = read_header(folder), dict[str, Table]()
    runs = check_runs(read_table(folder, "trajectories"))
    for name in ("references", "poses", "commands"):
        # Without references there must be poses.
        if table_file(folder, name) is not None or (name == "poses" and not tables):
            tables[name] = read_table(folder, name)
    samples = stored.read_samples(folder, runs, header.robot, left_in_files=left_in_files)
    trajectories = runs_of_tables(runs, samples, tables)
    scans = None
    if (file := table_file(folder, "scans")) is not None:
        if header.scanner is None:
            keys = "rays, angle_min, angle_increment, range_max (rad, m)"
            raise DataError(f"{folder / 'dataset.yaml'}: scanner is missing, which {file.name} needs: {keys}")
        scans = ScansOnDisk(file, header.scanner, runs.ids)
    described = {name: getattr(header, name) for name in _DESCRIBED}
    return Dataset(trajectories=tuple(trajectories), scans=scans, **described)


def dataset_folders(places: Path | str | Sequence[Path | str]) -> list[Path]:
    """The folders that places name: each a data set folder or a glob, whose folders come in the order of their names.

    A folder that is named twice counts once. DataError: a glob matches no data set folder, or one without dataset.yaml
    that has wheel samples; or nothing is named.
    """
    folders: dict[Path, Path] = {}
    for place in map(Path, [places] if isinstance(places, Path | str) else places):
        matching = _matching(str(place)) if is_glob(place) else [place]
        if not matching:
            others = sorted(glob.glob(str(place), recursive=True))
            seen = f"; {others[0]} has no dataset.yaml" if others else ""
            raise DataError(f"{place}: no data set folder matches{seen}")
        folders |= {folder.resolve(): folder for folder in matching}
    if not folders:
        raise DataError("no data set folder is named")
    return list(folders.values())


def is_glob(place: Path) -> bool:
    """True for a pattern, which no file or folder has as its name."""
    return glob.has_magic(str(place)) and not place.exists()


def in_few_words(folders: Sequence[Path]) -> str:
    """The folders as words of a shell: a glob that names just these, where there is one, else one by one."""
    begin = os.path.commonprefix([str(folder) for folder in folders])  # noqa: RUF071 (a glob's begin is no path)
    in_one_folder = len(folders) > 2 and begin.startswith(f"{folders[0].parent}/")
    if in_one_folder and _matching(f"{glob.escape(begin)}*") == list(folders):
        return f"{shlex.quote(begin)}*"
    return shlex.join(map(str, folders))


def _matching(pattern: str) -> list[Path]:
    folders = [Path(match) for match in sorted(glob.glob(pattern, recursive=True))]
    for folder in folders:
        if table_file(folder, "wheels") is not None and not (folder / "dataset.yaml").is_file():
            raise DataError(f"{folder}: it has wheel samples, but no dataset.yaml; write one there, or name the others")
    return [folder for folder in folders if (folder / "dataset.yaml").is_file()]


def load_dataset(path: Path | str | Sequence[Path | str], *, most_in_memory: int = stored.MOST_IN_MEMORY) -> Dataset:
    """Read and check a data set: a folder, or several of one robot, named one by one or by a glob.

    most_in_memory: wheel samples up to which they are held; those of Parquet files with more stay there, and are read
    run by run where they are used. Of several folders ids and sessions that two share get the name of their folder's
    data set before them.
    DataError names the file, the row (1 is the first after the header) and what is wrong.
    """
    folders = dataset_folders(path)
    files = [file for folder in folders if (file := table_file(folder, "wheels")) and file.suffix == ".parquet"]
    left_in_files = (samples := sum(parquet_shape(file)[0] for file in files)) > most_in_memory
    if left_in_files:
        expect_reading(samples, "sample")
    recorded = [read_recorded(folder, left_in_files=left_in_files) for folder in folders]
    if len(recorded) == 1:
        return checked(recorded[0])
    names = [part.name for part in recorded]
    dataset = put_together(recorded, list(map(str, folders)))
    if len({*names}) > 1:
        dataset = replace(dataset, name=f"{names[0]} to {names[-1]}")
    dataset = checked(dataset)
    originals = {run.fingerprint: run.id for run in reversed(dataset.trajectories)}
    copies = [run.id for run in dataset.trajectories if originals[run.fingerprint] != run.id]
    if not copies:
        return dataset
    twice = f"{plural(len(copies), 'run')} of another folder there twice, counted as repetitions: {some(copies, 5)}"
    return replace(dataset, warnings=(*dataset.warnings, twice))


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
    folder, runs = Path(path), dataset.trajectories
    if not dataset.referenced:
        raise DataError(f"data set {dataset.name}: it has no reference poses; omnibench.import_dataset makes some")
    for run in runs:
        if run.references is None and (flaw := stored.pose_times_flaw(run.pose_times, run.id, fewest=2)) is not None:
            raise DataError(f"data set {dataset.name}: {flaw[1]}; leave it out")
    check_dataset_folder(folder)
    if not overwrite and (folder / "dataset.yaml").is_file():
        old = read_header(folder)
        if (old.name, old.simulated) != (dataset.name, dataset.simulated):
            kind = "simulated " if old.simulated else ""
            raise DataError(f"{folder}: holds the {kind}data set {old.name!r}; name another folder, or overwrite=True")
    ids = [run.id for run in runs]
    # The data set may be a part of the one that was recorded.
    scans = dataset.scans if dataset.scans is not None and {*ids} & {*dataset.scans.trajectories} else None
    described: dict[str, Any] = {name: getattr(dataset, name) for name in _DESCRIBED}
    header = Header(wheels=dataset.robot.wheel_names, scanner=None if scans is None else scans.scanner, **described)
    text = to_yaml(header.model_dump(mode="json", by_alias=True, exclude=None if header.imported else {"imported"}))
    contents: dict[Path, FileContent] = {folder / "dataset.yaml": text.encode()}
    for name, (types, parts) in _tables(dataset, whole=True).items():
        contents[folder / f"{name}.{table_format}"] = partial(sink_frames, parts, types, table_format, _ROW_GROUP)
    if scans is not None:
        contents[folder / f"scans.{table_format}"] = partial(write_scans, scans, table_format, ids)
    with results_locked(folder):
        write_files(contents)
        for file in (folder / f"{name}.{suffix}" for name in _TABLES for suffix in ("parquet", "csv")):
            if file not in contents:  # of an earlier data set
                remove(file)


def check_dataset_folder(folder: Path) -> None:
    """DataError in one line when a data set cannot be written there: something else is there, or nobody may write."""
    resolved(folder)
    if folder.is_file():
        raise DataError(f"{folder}: is a file; name a folder for the data set")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "dataset.yaml").is_file():
        raise DataError(f"{folder}: holds other files; name an empty or new folder for the data set")
    check_place(folder)


_Frames = tuple[Mapping[str, Any], Iterable[pl.DataFrame]]
"""Types of a table's columns by name, and the table in parts."""


def _rows_of_runs(runs: Sequence[Trajectory], times: str, groups: Mapping[str, list[str]]) -> _Frames:
    """A table with rows of every run; null where it does not have an array.

    times, groups: the array of the times, and the columns of the others, by their names in Trajectory.
    """
    types = {"trajectory": pl.String()} | dict.fromkeys(["t", *chain(*groups.values())], pl.Float64())

    def parts() -> Iterator[pl.DataFrame]:
        for run in runs:
            stamps = getattr(run, times)
            columns: dict[str, Any] = {"trajectory": pl.repeat(run.id, len(stamps), eager=True), "t": stamps}
            for name, group in groups.items():
                values = getattr(run, name)
                if name == "pose_covariances" and values is not None:
                    values = values[:, *np.triu_indices(3)]
                columns |= {column: None if values is None else values[:, i] for i, column in enumerate(group)}
            yield pl.DataFrame(columns, schema=types)

    return types, parts()


def _tables(dataset: Dataset, *, whole: bool) -> dict[str, _Frames]:
    """The tables of a data set by name: trajectories, wheels, and poses, references and commands, if there are some.

    whole: without the columns of samples and poses that only some runs have, as files have no gaps.
    """
    runs, names = dataset.trajectories, ("command", "repetition", "split", "session", *RUN_NUMBERS)
    rows = [{"trajectory": run.id} | {name: getattr(run, name) for name in names} for run in runs]
    frames = {"trajectories": _without_empty(pl.DataFrame(rows, infer_schema_length=None))}
    if measured := [(run.id, run.references) for run in runs if run.references is not None]:
        frames["references"] = reference_frame(measured)
    if sent := [(run.id, *row) for run in runs if run.sent is not None for row in run.sent.tolist()]:
        frames["commands"] = pl.DataFrame(sent, schema=["trajectory", *stored.SENT["sent"]], orient="row")
    present = all if whole else any
    groups = {
        name: columns
        for name, columns in stored.wheel_columns(dataset.robot).items()
        if present(run.samples.has(name) for run in runs)
    }
    tables = {"wheels": _rows_of_runs(runs, "times", groups)}
    if placed := [run for run in runs if run.start_known]:
        covered = present(run.pose_covariances is not None for run in placed)
        tables["poses"] = _rows_of_runs(placed, "pose_times", stored.POSES | (stored.COVARIANCES if covered else {}))
    return {name: (frame.schema, [frame]) for name, frame in frames.items()} | tables


def tables_of(dataset: Dataset) -> dict[str, pl.DataFrame]:
    """The tables of a data set by name: trajectories, wheels, and poses, references and commands, if there are some."""
    return {name: pl.concat(parts) for name, (_, parts) in _tables(dataset, whole=False).items()}


def _without_empty(frame: pl.DataFrame) -> pl.DataFrame:
    """The columns of a table that have a value."""
    return frame.select(column for column in frame.iter_columns() if column.null_count() < len(frame))


def reference_frame(references: Sequence[tuple[str, References]]) -> pl.DataFrame:
    """The table of the references of some runs, given with their ids."""
    frames = []
    for run, of_run in references:
        instant = np.isin(of_run.kinds, list(AT_ONE_TIME)) & (of_run.t0 == of_run.t1)
        columns: dict[str, Any] = {"t0": np.where(instant, np.nan, of_run.t0), "t1": of_run.t1, "kind": of_run.kinds}
        for name, numbers in (("value", of_run.values), ("sigma", of_run.sigmas)):
            columns[name] = np.where(of_run.planar, np.nan, numbers[:, 0])
            columns[f"{name}_x"] = np.where(of_run.planar, numbers[:, 0], np.nan)
            columns[f"{name}_y"] = numbers[:, 1]
        columns["sigma_rate"] = np.where(of_run.gyro & (of_run.rate_sigma > 0), of_run.rate_sigma, np.nan)
        frames.append(pl.DataFrame({"trajectory": [run] * len(of_run)} | columns).fill_nan(None))
    return _without_empty(pl.concat(frames))
