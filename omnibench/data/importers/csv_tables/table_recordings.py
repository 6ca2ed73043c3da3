"""Recordings in tables: wheels and poses of every run, found, split by run and read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omnibench.data.delimited import CellTable, ColumnError
from omnibench.data.importers.csv_tables.csv_options import CsvOptions
from omnibench.data.importers.csv_tables.missing_columns import missing_error
from omnibench.data.importers.csv_tables.table_files import TablePair, load
from omnibench.data.importers.csv_tables.table_streams import read_poses, read_wheels
from omnibench.data.importers.csv_tables.wanted_columns import WantedColumns, pose_columns, run_column, wheel_columns
from omnibench.data.importers.runs.recorded_streams import RecordedStreams
from omnibench.data.importers.runs.reference_stream import ReferenceStream
from omnibench.data.importers.tum import read_tum
from omnibench.errors import DataError

Rows = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _Loaded:
    """The tables of a recording; poses are None where a TUM file holds them."""

    pair: TablePair
    wheels: CellTable
    poses: CellTable | None

    @property
    def shared(self) -> bool:
        """True where wheels and poses stand in the same rows."""
        return self.pair.wheels == self.pair.poses


def read_recordings(pairs: Sequence[TablePair], options: CsvOptions, warnings: list[str]) -> list[RecordedStreams]:
    """The recordings of all tables, of each run by itself. DataError names the file and the row of what is wrong."""
    loaded = [_load(pair, options) for pair in pairs]
    _check_columns(loaded[0], options)
    return [recording for each in loaded for recording in _recordings(each, options, warnings, several=len(loaded) > 1)]


def _load(pair: TablePair, options: CsvOptions) -> _Loaded:
    wheels = load(pair.wheels, options)
    if pair.poses.suffix == ".tum":
        return _Loaded(pair, wheels, None)
    return _Loaded(pair, wheels, wheels if pair.poses == pair.wheels else load(pair.poses, options))


def _check_columns(loaded: _Loaded, options: CsvOptions) -> None:
    """ColumnError: columns of wheels or of poses are missing, all of which it names."""
    lacking = [(loaded.wheels, wheel_columns(options))]
    if loaded.poses is not None:
        lacking.append((loaded.poses, pose_columns(options, shared=loaded.shared)))
    missing = [(table, wanted.missing(table)) for table, wanted in lacking]
    if loaded.shared:
        missing = [(loaded.wheels, list(dict.fromkeys([each for _, columns in missing for each in columns])))]
    errors = [str(missing_error(table, columns, options)) for table, columns in missing if columns]
    if errors:
        raise ColumnError("; and ".join(errors))


def _recordings(loaded: _Loaded, options: CsvOptions, warnings: list[str], *, several: bool) -> list[RecordedStreams]:
    _check_columns(loaded, options)
    wheels, poses = _by_run(loaded.wheels, options), _by_run(loaded.poses, options)
    names = list(dict.fromkeys([*wheels, *poses]))
    if names == [None]:
        return [_recording(loaded, loaded.pair.name, None, None, options, warnings)]
    recordings = []
    for name in filter(None, names):
        for what, rows, file in (("wheels", wheels, loaded.pair.wheels), ("poses", poses, loaded.pair.poses)):
            if name not in rows and None not in rows:
                raise DataError(f"{file}: run {name!r} has no {what}; add them, or take it out of the other table")
        run = name if not several else loaded.pair.name if len(names) == 1 else f"{loaded.pair.name}/{name}"
        recordings.append(_recording(loaded, run, wheels.get(name), poses.get(name), options, warnings))
    return recordings


def _by_run(table: CellTable | None, options: CsvOptions) -> dict[str | None, Rows | None]:
    """The rows of each run that a column names; {None: None} for a table of one run."""
    column = None if table is None else run_column(options, table)
    if table is None or column is None:
        return {None: None}
    rows: dict[str | None, list[int]] = {}
    for row, run in enumerate(table.texts(column)):
        rows.setdefault(run, []).append(row)
    if "" in rows:
        raise table.fail(rows[""][0], f"{column} is missing; name the run of every row")
    return {run: np.array(of_run) for run, of_run in rows.items()}


def _recording(
    loaded: _Loaded,
    name: str,
    wheel_rows: Rows | None,
    pose_rows: Rows | None,
    options: CsvOptions,
    warnings: list[str],
) -> RecordedStreams:
    wheels = _some(loaded.wheels, wheel_rows)
    samples = read_wheels(wheels, wheel_columns(options), options, warnings, shared=loaded.shared)
    if loaded.poses is None:
        track = read_tum(loaded.pair.poses)
        reference = ReferenceStream(track.times, track.poses).read_as(options)
    else:
        wanted: WantedColumns = pose_columns(options, shared=loaded.shared)
        reference = read_poses(_some(loaded.poses, pose_rows), wanted, options, warnings, shared=loaded.shared)
    return RecordedStreams(name, _place(loaded.pair.poses, name, wheel_rows), samples, reference)


def _some(table: CellTable, rows: Rows | None) -> CellTable:
    return table if rows is None else table.only(rows)


def _place(file: Path, name: str, rows: Rows | None) -> str:
    return str(file) if rows is None else f"{file}, run {name}"
