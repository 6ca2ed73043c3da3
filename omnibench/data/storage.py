"""Data sets on disk, ``omnibench-dataset/1``: a folder with dataset.yaml, Parquet or CSV tables, and scans."""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray
from polars.io.plugins import register_io_source

from omnibench.data.dataset import Dataset, Header, Trajectory, make_dataset, read_header
from omnibench.data.delimited import missing_column, not_increasing
from omnibench.data.run_checks import stored_pose_times_flaw
from omnibench.data.scans import Ranges, Scanner, Scans, TrajectoryScans
from omnibench.data.splits import SCANS_LEFT_OUT, check_fits, complete, distinct_runs
from omnibench.data.stored_rows import MOST_IN_MEMORY, count_rows, file_state, readable
from omnibench.data.tables import (
    TABLE,
    Table,
    dataset_folders,
    read_trajectories,
    stored_samples,
    table_file,
    tables_of,
)
from omnibench.errors import DataError, nearest, require_type
from omnibench.files import (
    FileContent,
    TableFormat,
    check_file,
    check_place,
    encode_table,
    quoted_formulas,
    remove,
    resolved,
    results_locked,
    unquoted_formulas,
    write_files,
)
from omnibench.progress import expect_reading
from omnibench.robot.kinematics import Array
from omnibench.words import plural, some

_COLUMNS = ("trajectory", "t", "ranges")
_SCHEMA = {"trajectory": pl.String(), "t": pl.Float64(), "ranges": pl.List(pl.Float32)}
_ROW_GROUP = 256  # rows of a Parquet row group; about 1 MB
_MOST_ROWS = 4096  # rows of a Parquet file that are read at a time; about 20 MB
_ROWS_OF_CSV = 65536  # rows of a CSV file read at a time: more, since every reading begins at its first line

Rows = NDArray[np.intp]


class ScansOnDisk(Scans):
    """A table of scans. Stamps and names are checked at once, ranges when a trajectory's scans are read.

    DataError in one line names the file, the row (1 is the first) and what is wrong.
    """

    def __init__(self, file: Path, scanner: Scanner, trajectories: Iterable[str]) -> None:
        self.file, self.scanner = file, scanner
        self._state = file_state(self.file)
        self._index = self._read_index(set(trajectories))

    @property
    def trajectories(self) -> tuple[str, ...]:
        return tuple(self._index)

    def times(self, trajectory: str) -> Array:
        return self._indexed(trajectory)[1]

    def of(self, trajectory: str) -> TrajectoryScans:
        rows, times = self._indexed(trajectory)
        if file_state(self.file) != self._state:
            raise DataError(
                f"{self.file}: the file has changed since it was opened; load it, or run the command, again"
            )
        ranges = np.empty((len(rows), self.scanner.rays), np.float32)
        for part in _parts(rows, _MOST_ROWS if self.file.suffix == ".parquet" else _ROWS_OF_CSV):
            ranges[part] = self._read(rows[part], f"trajectory {trajectory}", times[part])
        return TrajectoryScans(times, ranges)

    def _indexed(self, trajectory: str) -> tuple[Rows, Array]:
        if trajectory not in self._index:
            raise DataError(f"{self.file}: trajectory {trajectory} has no scans")
        return self._index[trajectory]

    def _collect(self, table: pl.LazyFrame) -> pl.DataFrame:
        with readable(self.file):
            return table.collect()

    def _lazy(self) -> pl.LazyFrame:
        if self.file.suffix == ".parquet":
            return pl.scan_parquet(self.file, glob=False)
        # Cells are read as text, so that one that is no number is reported with its row.
        return pl.scan_csv(self.file, infer_schema=False, glob=False)

    def _read(self, rows: Rows, whose: str, times: Array) -> Ranges:
        """The checked ranges (n, R) of some rows."""
        first, last = int(rows[0]), int(rows[-1])
        column = self._collect(self._lazy().select("ranges").slice(first, last - first + 1))["ranges"]
        column = self._numbers(column[rows - first] if len(rows) < len(column) else column, rows)
        lengths = column.list.len().fill_null(0).to_numpy()
        for index in np.flatnonzero(lengths != self.scanner.rays)[:1]:
            problem = f"the scan has {lengths[index]} ranges, but scanner.rays is {self.scanner.rays}"
            raise self._fail(int(rows[index]), problem)
        ranges = column.explode().cast(pl.Float32).fill_null(np.nan).to_numpy().reshape(len(rows), -1)
        for index in np.flatnonzero(np.isnan(ranges).any(axis=1))[:1]:
            raise self._fail(int(rows[index]), "a range is missing or NaN; write inf where nothing was seen")
        for index in np.flatnonzero(~self.scanner.valid(ranges).any(axis=1))[:1]:
            seen = ranges[index][np.isfinite(ranges[index])]
            in_millimetres = len(seen) > 0 and self.scanner.valid(seen / 1000).mean() > 0.5
            raise self._fail(
                int(rows[index]),
                f"the scan of {whose} at {times[index]:g} s is empty: no range from "
                f"{self.scanner.range_min:g} to {self.scanner.range_max:g} m; "
                + ("they look like mm, give m" if in_millimetres else "remove the row"),
            )
        return ranges

    def _numbers(self, column: pl.Series, rows: Rows) -> pl.Series:
        """The column of ranges as lists of numbers; in CSV a cell is text with blanks between the numbers."""
        if isinstance(column.dtype, pl.Array):
            column = column.arr.to_list()
        if column.dtype == pl.String:
            texts = column.str.strip_chars().str.split(" ")
            values = texts.list.eval(pl.element().cast(pl.Float32, strict=False))
            broken = texts.list.len() != values.list.drop_nulls().list.len()
            for index in broken.arg_true()[:1]:
                raise self._fail(int(rows[index]), "ranges must be numbers, in CSV with a blank between them")
            return values
        if not isinstance(column.dtype, pl.List) or not column.dtype.inner.is_numeric():
            raise DataError(f"{self.file}: column 'ranges' holds {column.dtype}, expected lists of numbers")
        return column

    def _read_index(self, known: set[str]) -> dict[str, tuple[Rows, Array]]:
        """Rows and stamps of every trajectory, in its order."""
        if self.file.suffix == ".parquet":
            count_rows(self.file)
        else:
            check_file(self.file, text=True)
        with readable(self.file):
            schema = self._lazy().collect_schema()
        for column in _COLUMNS:
            if column not in schema:
                raise missing_column(self.file, column, schema)
        frame = self._collect(self._lazy().select("trajectory", "t"))
        if frame.is_empty():
            raise DataError(f"{self.file}: it has no rows; remove it, or record scans")
        table = Table(self.file, frame if self.file.suffix == ".parquet" else unquoted_formulas(frame))
        table.name_trajectories()
        times = table.numbers("t")
        table.refuse(times < 0, lambda row: f"t is {times[row]:g}; it must not be negative")
        index = {}
        grouped = table.frame.with_row_index("row").group_by("trajectory", maintain_order=True).agg(pl.col("row"))
        for trajectory, rows in zip(grouped["trajectory"], grouped["row"], strict=True):
            run_rows: Rows = rows.to_numpy().astype(np.intp)
            if trajectory not in known:
                problem = f"trajectory {trajectory} is not in the table of trajectories; {nearest(trajectory, known)}"
                raise table.fail(int(run_rows[0]), problem.rstrip("; "))
            stamps = times[run_rows]
            flaw = not_increasing(stamps)
            if flaw is not None:
                raise table.fail(int(run_rows[flaw[0]]), f"t {flaw[1]}")
            index[str(trajectory)] = run_rows, stamps
        return index

    def _fail(self, row: int, what: str) -> DataError:
        return DataError(f"{self.file}, row {row + 1}: {what}")


def write_scans(scans: Scans, table_format: TableFormat, trajectories: Iterable[str], file: Path) -> None:
    """Write the scans of ``trajectories``, of those that have some; one trajectory's are in memory at a time.

    Ranges are written in single precision. DataError: scans cannot be read. OSError: the disk refuses.
    """
    recorded = set(scans.trajectories)
    chosen = [trajectory for trajectory in trajectories if trajectory in recorded]
    as_text = table_format == "csv"

    def frames(*_: Any) -> Iterator[pl.DataFrame]:
        for trajectory in chosen:
            yield from _frames(trajectory, scans.of(trajectory), as_text)

    table = register_io_source(frames, schema=_SCHEMA | ({"ranges": pl.String()} if as_text else {}))
    try:
        with file.open("wb") as opened:  # polars would open it at any time, even after a break has removed it
            if as_text:
                table.sink_csv(opened, maintain_order=True)
            else:
                table.sink_parquet(opened, row_group_size=_ROW_GROUP, maintain_order=True)
    except pl.exceptions.PolarsError as error:
        raise OSError(errno.EIO, str(error)) from None


def _frames(trajectory: str, scans: TrajectoryScans, as_text: bool) -> Iterator[pl.DataFrame]:
    rays = scans.ranges.shape[1]
    for first in range(0, len(scans.times), _ROW_GROUP):
        part = slice(first, first + _ROW_GROUP)
        times, ranges = scans.times[part], np.asarray(scans.ranges[part], dtype=np.float32)
        frame = pl.DataFrame(
            {"trajectory": [trajectory] * len(times), "t": times, "ranges": ranges},
            schema={"trajectory": pl.String, "t": pl.Float64, "ranges": pl.Array(pl.Float32, rays)},
        ).with_columns(pl.col("ranges").arr.to_list())
        if as_text:
            joined = pl.col("ranges").cast(pl.List(pl.String)).list.join(" ")
            frame = quoted_formulas(frame.with_columns(joined))
        yield frame


def _parts(rows: Rows, most: int) -> Iterator[slice]:
    """Slices of increasing row numbers, each of which spans at most ``most`` rows of the file."""
    begin = 0
    while begin < len(rows):
        end = int(np.searchsorted(rows, rows[begin] + most))
        yield slice(begin, end)
        begin = end


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
    samples = sum(stored_samples(folder) for folder in folders)
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
        warnings = [*dataset.warnings]
        if any(each.scans is not None for each in recorded):
            warnings.append(SCANS_LEFT_OUT)
        # Runs of several folders that hold the same recording.
        originals: dict[str, str] = {}
        copies = [run.id for run in dataset.trajectories if originals.setdefault(run.fingerprint, run.id) != run.id]
        if copies:
            shown = some(copies, 5)
            warnings.append(
                f"{plural(len(copies), 'run')} of another folder there twice, counted as repetitions: {shown}"
            )
        dataset = replace(dataset, warnings=tuple(warnings))
    return replace(dataset, imported=first.imported if len(recorded) == 1 else None)


def load_whole(path: Path | str) -> Dataset:
    """Read a data set as load_dataset does, into memory whatever its size: for work that needs all samples at once."""
    return load_dataset(path, most_in_memory=sys.maxsize)


def _all_of(texts: Sequence[str]) -> str:
    """The texts that differ, one after another."""
    return "; ".join(dict.fromkeys(filter(None, texts)))


def read_recorded(folder: Path, *, left_in_files: bool = False) -> RecordedDataset:
    """Read a data set folder and check its tables. DataError as for ``load_dataset``.

    left_in_files: the wheel samples of a Parquet file stay there, if its rows allow to read it run by run.
    """
    header = read_header(folder)
    trajectories = read_trajectories(folder, header, left_in_files=left_in_files)
    scans = None
    if (file := table_file(folder, "scans")) is not None:
        if header.scanner is None:
            raise DataError(
                f"{folder / 'dataset.yaml'}: scanner is missing, which {file.name} needs: rays, angle_min, "
                "angle_increment, range_max (rad, m)"
            )
        scans = ScansOnDisk(file, header.scanner, [trajectory.id for trajectory in trajectories])
    return RecordedDataset(header, trajectories, scans)


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
    if not overwrite and (folder / "dataset.yaml").is_file():
        old = read_header(folder)
        if (old.name, old.simulated) != (dataset.name, dataset.simulated):
            kind = "simulated " if old.simulated else ""
            raise DataError(f"{folder}: holds the {kind}data set {old.name!r}; name another folder, or overwrite=True")
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
