"""Recordings in tables: wheels and poses of every run, found, split by run and read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from omnibench.data.delimited import CellTable, ColumnError
from omnibench.data.importers.csv_tables.column_words import check_units
from omnibench.data.importers.csv_tables.csv_options import CsvOptions
from omnibench.data.importers.csv_tables.missing_columns import missing_error
from omnibench.data.importers.csv_tables.table_files import TablePair, load
from omnibench.data.importers.csv_tables.table_references import ReferenceRows, reference_rows
from omnibench.data.importers.csv_tables.table_rows import Rows, rows_by_run
from omnibench.data.importers.csv_tables.table_streams import read_poses, read_wheels
from omnibench.data.importers.csv_tables.wanted_columns import WantedColumns, pose_columns, wheel_columns
from omnibench.data.importers.runs.recorded_streams import RecordedStreams
from omnibench.data.importers.runs.reference_options import RADIANS
from omnibench.data.importers.runs.reference_stream import ReferenceStream
from omnibench.data.importers.tum import read_tum
from omnibench.data.references.run_references import References
from omnibench.errors import DataError

_NO_ROWS: Rows = np.empty(0, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class _Loaded:
    """The tables of a recording; poses are None where a TUM file holds them, or where there are none."""

    pair: TablePair
    wheels: CellTable
    poses: CellTable | None
    references: ReferenceRows | None

    @property
    def shared(self) -> bool:
        """True where wheels and poses stand in the same rows."""
        return self.pair.wheels == self.pair.poses


def read_recordings(pairs: Sequence[TablePair], options: CsvOptions, warnings: list[str]) -> list[RecordedStreams]:
    """The recordings of all tables, of each run by itself. DataError names the file and the row of what is wrong."""
    measured = reference_rows([pair.references for pair in pairs], options)
    loaded = [_load(pair, measured, options) for pair in pairs]
    _check_columns(loaded[0], options)
    several = len(loaded) > 1
    recordings = [recording for each in loaded for recording in _recordings(each, options, warnings, several=several)]
    for rows in measured.values():
        rows.check_names([recording.name for recording in recordings])
    return recordings


def _load(pair: TablePair, measured: Mapping[Path, ReferenceRows], options: CsvOptions) -> _Loaded:
    wheels, references = load(pair.wheels, options), None if pair.references is None else measured[pair.references]
    if pair.poses is None or pair.poses.suffix == ".tum":
        return _Loaded(pair, wheels, None, references)
    poses = wheels if pair.poses == pair.wheels else load(pair.poses, options)
    return _Loaded(pair, wheels, poses, references)


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
    names = {each.key: found for table, wanted in lacking for each in wanted.all if (found := each.found(table))}
    check_units(loaded.wheels.file, names, options, shared=loaded.shared)


def _recordings(loaded: _Loaded, options: CsvOptions, warnings: list[str], *, several: bool) -> list[RecordedStreams]:
    _check_columns(loaded, options)
    wheels, poses = rows_by_run(loaded.wheels, options), rows_by_run(loaded.poses, options)
    names = list(dict.fromkeys([*wheels, *poses]))
    if names == [None]:
        return [_recording(loaded, loaded.pair.name, (None, None), options, warnings)]
    if loaded.references is not None and len(names) > 1:
        loaded.references.check_of_several()
    recordings = []
    for name in filter(None, names):
        if name not in wheels and None not in wheels:
            raise DataError(_lacking(loaded.pair.wheels, name, "wheels"))
        run = name if not several else loaded.pair.name if len(names) == 1 else f"{loaded.pair.name}/{name}"
        if name not in poses and None not in poses and _measured(loaded, run, options) is None:
            raise DataError(_lacking(loaded.pair.place, name, "poses"))
        seen = poses.get(name, _NO_ROWS if None not in poses else None)
        recordings.append(_recording(loaded, run, (wheels.get(name), seen), options, warnings))
    return recordings


def _lacking(file: Path, run: str, what: str) -> str:
    return f"{file}: run {run!r} has no {what}; add them, or take it out of the other table"


def _recording(
    loaded: _Loaded, name: str, rows: tuple[Rows | None, Rows | None], options: CsvOptions, warnings: list[str]
) -> RecordedStreams:
    """The recording of some rows of wheels and of poses."""
    wheels = _some(loaded.wheels, rows[0])
    samples = read_wheels(wheels, wheel_columns(options), options, warnings, shared=loaded.shared)
    measured = _measured(loaded, name, options)
    place = str(loaded.pair.place) if rows[0] is None else f"{loaded.pair.place}, run {name}"
    reference = _poses(loaded, rows[1], options, warnings)
    if reference is None:
        if measured is None:
            raise DataError(
                f"{loaded.pair.references}: run {name!r} is not in its column run, and has no poses; add what was "
                "measured of it, or take its wheels out"
            )
        reference = ReferenceStream.without_poses()
    if measured is not None:
        reference = replace(reference, measured=replace(measured, start_known=len(reference.times) > 0))
    radian = RADIANS[options.heading_unit]
    tum = loaded.poses is None and len(reference.times) > 0  # always in rad
    return RecordedStreams(name, place, samples, reference.read_as(options, 1.0 if tum else radian, radian))


def _measured(loaded: _Loaded, run: str, options: CsvOptions) -> References | None:
    return None if loaded.references is None else loaded.references.of(run, options, shared=loaded.shared)


def _poses(loaded: _Loaded, rows: Rows | None, options: CsvOptions, warnings: list[str]) -> ReferenceStream | None:
    """The poses of some rows as they were recorded; None where there are none."""
    if loaded.pair.poses is None or (rows is not None and not len(rows)):
        return None
    if loaded.poses is None:
        track = read_tum(loaded.pair.poses)
        return ReferenceStream(track.times, track.poses)
    wanted: WantedColumns = pose_columns(options, shared=loaded.shared)
    return read_poses(_some(loaded.poses, rows), wanted, options, warnings, shared=loaded.shared)


def _some(table: CellTable, rows: Rows | None) -> CellTable:
    return table if rows is None else table.only(rows)
