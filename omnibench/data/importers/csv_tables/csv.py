"""Importer of general CSV recordings: wheel rates, angles or ticks, and poses, in one table, two or three.

A table of runs may give the command, repetition, split and session of each. Distances, turns, positions and the like
stand in a table of their own: a row for each, with its kind, value and standard deviation.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote

import numpy as np
from numpy.typing import NDArray

from omnibench.data.checks.misreading import as_yaml
from omnibench.data.clock_matching import median_period
from omnibench.data.dataset import SPLITS, Dataset, Split, Trajectory
from omnibench.data.delimited import AUTO, CellTable, ColumnError, NoRowsError, NumberTable, read_cells, row_error
from omnibench.data.importer import Importer
from omnibench.data.importers.copied_reference import follows_the_wheels
from omnibench.data.importers.csv_tables.csv_options import (
    BLANKS,
    POSE_SUFFIXES,
    REFERENCE_SUFFIXES,
    WHEEL_SUFFIXES,
    CsvOptions,
    Wanted,
    WantedColumns,
    check_units,
    missing_error,
    pose_columns,
    run_column,
    wheel_columns,
)
from omnibench.data.importers.recording_options import RADIANS, SECONDS
from omnibench.data.importers.runs.recording_runs import RecordedStreams, ReferenceStream, by_one_clock, recording_runs
from omnibench.data.importers.tum import read_tum
from omnibench.data.importers.wheel_samples import WheelReadings, WheelSamples, wheel_samples
from omnibench.data.references import KINDS, NUMBERS, References, reference_flaw, references_of
from omnibench.errors import DataError, nearest
from omnibench.registry import importers
from omnibench.robot.kinematics import Array
from omnibench.words import plural, some

RUN_TABLES = ("runs.csv", "runs.parquet", "trajectories.csv", "trajectories.parquet")
_TABLES = (".csv", ".tsv", ".txt", ".log", ".dat", ".parquet")
_TEMPLATE = "omnibench import csv --template DIR writes tables to fill in"


@dataclass(frozen=True)
class TablePair:
    """The files of wheels and of poses of a recording; one file where they stand in the same rows.

    references: that of distances, turns and the like, of this recording or of all; without poses there is one.
    """

    name: str
    wheels: Path
    poses: Path | None
    references: Path | None = None

    @property
    def place(self) -> Path:
        """The file of the reference, for messages."""
        return self.poses or self.references or self.wheels


def find_tables(source: Path, options: CsvOptions, warnings: list[str]) -> list[TablePair]:
    """The tables under a folder, or those of a file, by the names of files, else by what their headers hold."""
    if source.is_file():
        return [_of_file(source, options)]
    files = sorted(file for file in source.rglob("*") if not file.is_dir())
    wheels, poses, measured = (
        _by_suffix(source, files, suffixes)
        for suffixes in (_wheel_suffixes(options), _pose_suffixes(options), REFERENCE_SUFFIXES)
    )
    references = _References(measured, _common(source))
    if wheels or (poses and options.wheel_suffix):
        return _pairs(wheels, poses, references, options)
    if options.wheel_suffix:
        raise DataError(f"{source}: no *{options.wheel_suffix} below it; --set wheel_suffix=ENDING for other names")
    tables = [file for file in files if file.suffix.lower() in _TABLES and file.name.lower() not in RUN_TABLES]
    return _by_headers(source, tables, references, options, warnings)


@dataclass(frozen=True)
class _References:
    """The tables of references: of recordings by their names, and one beside all of them."""

    own: Mapping[str, Path]
    common: Path | None

    def of(self, name: str) -> Path | None:
        """The table that may hold references of a recording."""
        return self.own.get(name, self.common)


def _common(folder: Path) -> Path | None:
    """The table of references of all runs in a folder."""
    return file_called(folder, [suffix.lstrip("_") for suffix in REFERENCE_SUFFIXES])


def file_called(folder: Path, names: Sequence[str], *, other_than: Path | None = None) -> Path | None:
    """The file of a folder that has one of the names, the first first, in any case of letters."""
    files = {file.name.lower(): file for file in sorted(folder.iterdir()) if not file.is_dir() and file != other_than}
    return next((files[name.lower()] for name in names if name.lower() in files), None)


def load(file: Path, options: CsvOptions) -> CellTable:
    """The cells of a file as the options say they are written."""
    separator = None if options.separator == BLANKS else options.separator or AUTO
    comma = options.decimal == "comma"
    table = read_cells(file, separator=separator, header_lines=options.header_lines, decimal_comma=comma)
    if options.header_lines or file.suffix == ".parquet":
        return table
    # A table without a header that has exactly the columns that are wanted of one of its streams gets their names.
    for wanted in (wheel_columns(options), pose_columns(options, shared=False)):
        names = [each.names[0] for each in wanted.all]
        if len(names) == len(table.names) and not any(name.isdecimal() for name in names):
            return table.named(names)
    return table


def _wheel_suffixes(options: CsvOptions) -> tuple[str, ...]:
    return (options.wheel_suffix,) if options.wheel_suffix else WHEEL_SUFFIXES


def _pose_suffixes(options: CsvOptions) -> tuple[str, ...]:
    return (options.pose_suffix,) if options.pose_suffix else POSE_SUFFIXES


def _of_file(source: Path, options: CsvOptions) -> TablePair:
    for ending in _wheel_suffixes(options):
        bare = source.name.lower() == ending.lstrip("_-.").lower()
        if not bare and not source.name.lower().endswith(ending.lower()):
            continue
        name = source.name[: -len(ending)]
        recording = source.resolve().parent.name if bare else name
        poses, references = (
            file_called(
                source.parent,
                [suffix.lstrip("_-.") if bare else name + suffix for suffix in suffixes],
                other_than=source,
            )
            for suffixes in (_pose_suffixes(options), REFERENCE_SUFFIXES)
        )
        references = references or _common(source.parent)
        if poses or references:
            return TablePair(recording, source, poses, references)
    table, references = load(source, options), _common(source.parent)
    posed = references is None or not _all_missing(pose_columns(options, shared=True), table)
    return TablePair(source.stem, source, source if posed else None, references)


def _all_missing(wanted: WantedColumns, table: CellTable) -> bool:
    """True if a table has none of the values of a stream."""
    return all(value.found(table) is None for value in wanted.values)


def _by_suffix(source: Path, files: Sequence[Path], suffixes: Sequence[str]) -> dict[str, Path]:
    """The files that end in one of the suffixes, or are called like one, in any case, by the names of their runs."""
    found = {}
    for suffix in suffixes:
        for file in files:
            place, name = file.relative_to(source), file.name.lower()
            if name == suffix.lstrip("_-.").lower():
                found[place.parent.as_posix() if place.parent.name else source.resolve().name] = file
            elif name.endswith(suffix.lower()):
                found[place.as_posix()[: -len(suffix)]] = file
    return found


def _pairs(
    wheels: dict[str, Path], poses: dict[str, Path], references: _References, options: CsvOptions
) -> list[TablePair]:
    for name in sorted(wheels):
        if name not in poses and references.of(name) is None:
            missing = " or ".join(name + suffix for suffix in _pose_suffixes(options))
            raise DataError(
                f"{wheels[name]}: run {name!r} has no {missing}; --set pose_suffix=ENDING for other names, or name "
                "this file as the source if it holds the poses, too; distances, turns and the like go into "
                f"{name}{REFERENCE_SUFFIXES[0]} (omnibench guide references)"
            )
    own = {name: file for name, file in references.own.items() if file != references.common}
    for name, file in sorted({**own, **poses}.items()):
        if name not in wheels:
            missing = name + _wheel_suffixes(options)[0]
            raise DataError(f"{file}: run {name!r} has no {missing}; --set wheel_suffix=ENDING for other names")
    return [TablePair(name, wheels[name], poses.get(name), references.of(name)) for name in sorted(wheels)]


def _by_headers(
    source: Path, tables: Sequence[Path], references: _References, options: CsvOptions, warnings: list[str]
) -> list[TablePair]:
    """The tables under a folder whose headers hold columns of wheels and of poses, or of wheels with references."""
    measured = {*references.own.values(), references.common}
    files = [file for file in tables if file not in measured]
    if not files:
        raise DataError(
            f"{source}: no tables below it; a recording is a pair <run>_wheels.csv and <run>_poses.csv, or one table "
            f"of both ({_TEMPLATE})"
        )
    lacking: dict[Path, tuple[CellTable, list[Wanted]]] = {}
    fitting: list[TablePair] = []
    for file in files:
        try:
            table = load(file, options)
        except NoRowsError:
            warnings.append(f"{file}: left out, as it has no rows")
            continue
        name, poses = file.relative_to(source).with_suffix("").as_posix(), pose_columns(options, shared=True)
        posed = references.of(name) is None or not _all_missing(poses, table)
        missing = [*wheel_columns(options).missing(table), *(poses.missing(table) if posed else ())]
        if missing:
            lacking[file] = table, list(dict.fromkeys(missing))
        else:
            fitting.append(TablePair(name, file, file if posed else None, references.of(name)))
    if not fitting:
        if not lacking:
            raise DataError(f"{source}: none of its tables has rows ({_TEMPLATE})")
        _check_apart([table for table, _ in lacking.values()], options)
        table, missing = min(lacking.values(), key=lambda pair: len(pair[1]))
        raise missing_error(table, missing, options)
    if lacking:
        others = some([file.relative_to(source).as_posix() for file in lacking])
        warnings.append(f"tables without columns of wheels and poses were left out: {others}")
    return fitting


def _check_apart(tables: Sequence[CellTable], options: CsvOptions) -> None:
    """DataError: some tables hold the wheels and others the poses, by names that do not say so."""
    streams = (wheel_columns(options), pose_columns(options, shared=False))
    wheels, poses = ([table.file for table in tables if not wanted.missing(table)] for wanted in streams)
    if wheels and poses:
        raise DataError(
            f"{wheels[0]} holds wheels and {poses[0].name} poses; call them <run>_wheels.csv and <run>_poses.csv, or "
            "say what their names end in: --set wheel_suffix=ENDING --set pose_suffix=ENDING"
        )


Rows = NDArray[np.intp]


def rows_by_run(table: CellTable | None, options: CsvOptions) -> dict[str | None, Rows | None]:
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


_KIND = "kind"


@dataclass(frozen=True, eq=False)
class ReferenceRows:
    """A table of references and its rows of each run; {None: None} where it is of one run."""

    table: CellTable
    rows: Mapping[str | None, Rows | None]

    def of(self, run: str, options: CsvOptions, *, shared: bool) -> References | None:
        """The references of a run; None if it has none. shared: as for ``read_measured``."""
        if None in self.rows:
            return read_measured(self.table, options, shared=shared)
        rows = self.rows.get(run)
        return None if rows is None else read_measured(self.table.only(rows), options, shared=shared)

    def check_of_several(self) -> None:
        """DataError: the table does not say of which of several runs a row is."""
        if None in self.rows:
            found = ", ".join(self.table.names)
            raise DataError(
                f"{self.table.file}: column 'run' is missing, which says of which run a row is; found: {found}; --set "
                "run_column=NAME"
            )

    def check_names(self, runs: Sequence[str]) -> None:
        """DataError: the table has references of a run that there is not."""
        for name in self.rows:
            if name is not None and name not in runs:
                hint = nearest(name, runs)
                raise DataError(f"{self.table.file}: run {name!r} has no wheels; {hint}runs: {some(runs)}")


def reference_rows(files: Sequence[Path | None], options: CsvOptions) -> dict[Path, ReferenceRows]:
    """The tables of references of some recordings, each read once. DataError: one of several does not name the run."""
    measured = {}
    as_tables = options.model_copy(update={"header_lines": 1, "separator": None})
    for file in dict.fromkeys(filter(None, files)):
        table = load(file, as_tables).in_lower_case()
        measured[file] = ReferenceRows(table, rows_by_run(table, options))
        if files.count(file) > 1:
            measured[file].check_of_several()
    return measured


def read_measured(table: CellTable, options: CsvOptions, *, shared: bool) -> References:
    """The references in the rows of a run, in the units of the table, by the clock of its poses.

    shared: that clock is the wheels' unless it is said. A heading with t0 = 0 counts from the run's start. DataError
    names the row of what is wrong.
    """
    if table.missing([_KIND]):
        found = ", ".join(filter(None, table.names))
        raise DataError(
            f"{table.file}: column 'kind' is missing; found: {found}; each row needs its kind ({', '.join(KINDS)}), "
            "value and sigma (omnibench guide references)"
        )
    kinds = np.array([kind.lower() for kind in table.texts(_KIND)], dtype=str)
    there = {name for name in NUMBERS if not table.missing([name])}
    numbers = {name: table.numbers([name])[:, 0] if name in there else np.full(len(table), np.nan) for name in NUMBERS}
    for name in ("t0", "t1"):
        for row in np.flatnonzero(np.isinf(numbers[name]))[:1].tolist():
            raise table.fail(row, f"{name} is {numbers[name][row]}; remove or repair the row")
    from_start = (kinds == "heading") & (numbers["t0"] == 0)
    unit = options.pose_time_unit or (options.wheel_time_unit if shared else "s")
    numbers |= {name: numbers[name] * SECONDS[unit] for name in ("t0", "t1")}
    numbers["t0"][from_start] = -np.inf
    references = references_of(kinds, numbers)
    if (flaw := reference_flaw(references, None)) is not None:
        raise table.fail(flaw[0], flaw[1])
    return references


# Share of a table's rows that may have the time of the row before; with more its times are too coarse.
_MOST_REPEATED = 0.5


def read_wheels(
    table: CellTable, wanted: WantedColumns, options: CsvOptions, warnings: list[str], *, shared: bool
) -> WheelSamples:
    """The wheel samples of the rows of a run. shared: poses stand in the same rows.

    DataError names the row of what is wrong.
    """
    file, count = table.file, len(options.robot.wheel_names)
    numbers, times, names = _stream(table, wanted, options.wheel_time_unit, warnings, shared)
    shown, counted = numbers.columns(names[:count]), options.quantity != "rates"
    if counted and len(times) < 2:
        raise DataError(f"{file}: positions and increments need two rows or more")
    values = options.wheel_angles(shown, times, str(file), warnings) if counted else shown * options.wheel_radians
    angles = options.steering_angles(numbers.columns(names[count:]), str(file)) if len(names) > count else None
    readings = WheelReadings(times, values, counted, options.quantity == "positions", angles)
    if len(times) < 2 and not options.sample_period:
        raise DataError(f"{file}: wheels: has one row; two are needed, or --set sample_period=S")
    period = options.sample_period or median_period([times])
    samples, losses = wheel_samples(readings, options, str(file), period, longest_gap=options.longest_gap or np.inf)
    warnings.extend(losses.in_words(str(file), "row"))
    return samples


def read_poses(
    table: CellTable, wanted: WantedColumns, options: CsvOptions, warnings: list[str], *, shared: bool
) -> ReferenceStream:
    """The reference poses of the rows of a run as they were recorded. shared: wheels stand in the same rows."""
    unit = options.pose_time_unit or (options.wheel_time_unit if shared else "s")
    said: list[str] = []
    numbers, times, names = _stream(table, wanted, unit, said, shared)
    warnings.extend(() if shared else said)  # of the same rows it was said
    return ReferenceStream(times, numbers.columns(names))


def _stream(
    table: CellTable, wanted: WantedColumns, unit: str, warnings: list[str], shared: bool
) -> tuple[NumberTable, Array, list[str]]:
    """The rows of a table that hold a stream, their times (rows,), s, and the names of its values.

    Rows without any value of the stream are left out, and so are rows that repeat a time.
    """
    time, names = wanted.names(table)
    filled = np.flatnonzero(~np.isnan(table.numbers(names)).all(axis=1))
    if not len(filled):
        raise DataError(f"{table.file}: no row has values of the {wanted.what} ({', '.join(names)})")
    rows = table if len(filled) == len(table) else table.only(filled)
    if shared and wanted.what == "poses":
        # Poses in the rows of the wheels are without a time where they have a clock of their own.
        for row in np.flatnonzero(np.isnan(rows.numbers([time])[:, 0]))[:1].tolist():
            way = 'where poses have a column of times of their own, --set "columns={pose_t: NAME}"'
            raise rows.fail(row, f"{time} is missing; {way}")
    numbers = rows.finite([time, *names])
    blank = len(table) - len(filled)
    if blank and not shared:
        warnings.append(f"{table.file}: {plural(blank, 'row')} without values of the {wanted.what} left out")
    fresh = np.diff(numbers.column(time), prepend=-math.inf) != 0
    repeated = int((~fresh).sum())
    if 0 < repeated < _MOST_REPEATED * len(fresh):
        numbers = numbers.only(fresh)
        warnings.append(f"{table.file}: {plural(repeated, 'row')} that repeat the {time} of the one before left out")
    try:
        return numbers, numbers.increasing(time) * SECONDS[unit], names
    except DataError as error:
        raise DataError(f"{error}{_of_runs(rows, time)}") from None


def _of_runs(table: CellTable, time: str) -> str:
    """Hint at run_column where times begin anew, as in a table of several runs; empty where they do not."""
    anew = (np.flatnonzero(np.diff(table.numbers([time])[:, 0]) < 0) + 1).tolist()
    if not anew:
        return ""
    for name in filter(None, table.names):
        cells = table.texts(name)
        if [row for row in range(1, len(cells)) if cells[row] != cells[row - 1]] == anew:
            return f"; does {name} name the run of each row? --set {quote(f'run_column={as_yaml(name)}')}"
    return "; repair the row, or, in a table of several runs, name the column of runs: --set run_column=NAME"


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


_TEXTS, _NUMBERS = ("command", "split", "session"), ("repetition", "started_at")


@dataclass(frozen=True)
class RunAttributes:
    """What a table of runs says of one; None where it says nothing."""

    command: str | None = None
    repetition: int | None = None
    split: Split | None = None
    session: str | None = None
    started_at: float | None = None


def read_run_attributes(source: Path, options: CsvOptions, warnings: list[str]) -> dict[str, RunAttributes]:
    """The attributes of each run by its name; empty without a table of runs. DataError names the row of a flaw."""
    file = options.runs_table or file_called(
        source if source.is_dir() else source.parent, RUN_TABLES, other_than=source
    )
    if file is None:
        return {}
    table = load(file, options).in_lower_case()
    named = run_column(options, table)
    if named is None:
        raise DataError(f"{file}: column 'run' is missing; found: {', '.join(table.names)}; --set run_column=NAME")
    known = [key for key in (*_TEXTS, *_NUMBERS) if key not in table.names]
    others = [name for name in table.names if name not in (named, *_TEXTS, *_NUMBERS)]
    alike = {name: hint.strip() for name in others if (hint := nearest(name, known))}
    warnings.extend(f"{file}: column {name!r} is not read; {hint}" for name, hint in alike.items())
    texts = {key: table.texts(key) for key in _TEXTS if key in table.names}
    numbers = {key: table.numbers([key])[:, 0] for key in _NUMBERS if key in table.names}
    attributes: dict[str, RunAttributes] = {}
    for row, run in enumerate(table.texts(named)):
        split = texts["split"][row] if "split" in texts else None
        if split is not None and split not in SPLITS:
            what = f"split is {split!r}; {nearest(split, SPLITS)}it must be train or validation"
            raise row_error(file, row, int(table.lines[row]), what)
        if run in attributes:
            raise row_error(file, row, int(table.lines[row]), f"run {run!r} is there twice")
        repetition, started_at = (_number(numbers.get(key), row) for key in _NUMBERS)
        attributes[run] = RunAttributes(
            command=texts["command"][row] or None if "command" in texts else None,
            repetition=None if repetition is None else round(repetition),
            split=split,
            session=texts["session"][row] or None if "session" in texts else None,
            started_at=started_at,
        )
    return attributes


def check_names(attributes: Collection[str], runs: Collection[str], warnings: list[str]) -> None:
    """Check that a table of runs lists the runs that there are. DataError names one that is missing."""
    if not attributes:
        return
    for run in runs:
        if run not in attributes:
            raise DataError(
                f"the table of runs does not list run {run!r}; {nearest(run, attributes)}it has: "
                f"{', '.join(list(attributes)[:12])}"
            )
    extra = [run for run in attributes if run not in runs]
    if extra:
        warnings.append(f"the table of runs lists runs that have no samples: {', '.join(extra[:12])}")


def _number(numbers: np.ndarray | None, row: int) -> float | None:
    return None if numbers is None or np.isnan(numbers[row]) else float(numbers[row])


_NUMBERED = re.compile(r"[_-]?\d+$")
_PATTERN = r"^(.*?)[_-]?\d+$"
_FAR = 100.0  # times; wheels' and poses' times that last so differently are in other units; chosen


@importers.register("csv")
class Csv(Importer):
    """CSV tables of any robot, with wheel rates, angles or ticks, and reference poses.

    The source is a folder, searched with its subfolders, or one file. Its tables are told by their names and headers:

        a pair a run   <run>_wheels.csv and <run>_poses.csv (or _poses.tum); or a folder a run, wheels.csv and poses.csv
        a table a run  any tables whose header holds columns of wheels and of poses
        one table      the same with a column run, which names the run of each row
        three tables   wheels.csv and poses.csv, both with a column run, and runs.csv with run, command, repetition,
                       split, session (each optional; runs.csv may stand beside any other tables, too)
        references     <run>_references.csv, or references.csv with a column run, beside poses or in their place

    ``robot`` (a YAML file or a mapping; robot.yaml in the source is found) is the only option that must be given; with
    ``omnibench import csv --template DIR`` come tables and a robot to fill in. Columns are named in a header, in any
    order and among others, or counted from 1. Defaults: t (s), omega_<wheel> (rad/s), steer_<wheel> (rad), x, y (m),
    theta (rad); ``columns`` takes any other names, ``..._unit`` other units. Commas, semicolons or tabs separate
    them, Parquet files hold the same. Where wheels and poses stand in the same rows, cells without a sample are blank.

    wheels: with rates a row holds the mean rates since the row before (its first one: since a sample period before).
    With positions or increments the first row only gives the start of counting. Counters that begin again are counted
    on where they can be recognised, or ``wraps_at`` gives the value (65536, 2^32, 360 deg). ``gear_ratio`` is for
    encoders at the motor. A run ends where positions begin anew. The sense of a positive rate is in ``omnibench guide
    conventions``; ``wheel_signs: [-1, 1, 1]`` turns a wheel round. Steering angles are those at the rows' times.

    references: what was measured without motion capture, a row each with its kind (distance, turn, displacement,
    position, heading), value or value_x and value_y, sigma (or sigma_x, sigma_y), and t0 and t1, which are empty for
    the whole run (``omnibench guide references``). The options of unit, sign and time of the poses hold for them, too.

    times: in any epoch (unix time, say), wheels and poses by one clock, or ``clocks=match`` finds what is between them.
    t = 0 becomes the first pose, or, where poses begin before the wheels, the begin of the wheels with the pose
    interpolated. Poses after the last wheel sample are left out, and so are rows that repeat a time.

    Splits: ``train`` and ``validation`` are patterns of run names (``day2/*``); with one of them all other runs go to
    the other side, with both the runs in neither are left out, with none the table of runs says it, or every second run
    of a command validates. Runs share a command by the table of runs or by ``command_pattern``; without them nothing is
    known of repetitions. The runs that a recording is cut into are called ``<run>#1``, ``<run>#2`` ...
    """

    Options = CsvOptions
    options: CsvOptions

    def read(self, source: Path) -> Dataset:
        """All runs under ``source``; DataError names the file and the row of what is wrong."""
        options, warnings = self.options, list[str]()
        recordings = read_recordings(find_tables(source, options, warnings), options, warnings)
        attributes = read_run_attributes(source, options, warnings)
        check_names(attributes, [recording.name for recording in recordings], warnings)
        recordings = by_one_clock(recordings, options, warnings)
        runs = [run for recording in recordings for run in self._runs(recording, attributes, warnings)]
        if not runs:
            raise DataError(
                f"{source}: no run stands still before it drives, so that start_at_rest leaves none; leave that option "
                "out, and record from a standstill"
            )
        splits = [run.split for run in runs] if any(each.split for each in attributes.values()) else None
        numbers = {run.id: run.repetition for run in runs if run.repetition is not None}
        divided = [
            replace(run, repetition=numbers.get(run.id, run.repetition))
            for run in options.divided(runs, otherwise=splits)
        ]
        dataset = options.dataset(divided)
        warnings += _unsaid_commands([recording.name for recording in recordings], dataset)
        if (residual := follows_the_wheels(dataset.trajectories)) is not None:
            warnings.append(
                "the reference is the robot's odometry, or simulated without noise: some matrix makes its headings of "
                f"the wheels to {residual:.1g} rad a second; if it is odometry, name the columns of an independent one "
                '(--set "columns={x: NAME, y: NAME, theta: NAME}")'
            )
        return replace(dataset, warnings=(*warnings, *dataset.warnings))

    def _runs(
        self, recording: RecordedStreams, attributes: Mapping[str, RunAttributes], warnings: list[str]
    ) -> list[Trajectory]:
        name, options, samples, reference = recording.name, self.options, recording.samples, recording.reference
        match = re.search(options.command_pattern, name) if options.command_pattern else None
        said = attributes.get(name, RunAttributes())
        whole = Trajectory(
            id=name,
            split=said.split or "train",
            times=samples.ends,
            rates=samples.rates,
            pose_times=reference.times,
            poses=reference.poses,
            command=match.group(1) if match else said.command,
            repetition=said.repetition,
            session=said.session,
            started_at=said.started_at,
        )
        runs = recording_runs(whole, samples, reference, options, warnings, recording.place, options.window)
        if not runs and options.start_at_rest and len(_poses_within(recording)) > 1:
            warnings.append(f"{name}: left out: it never stands still before it drives (start_at_rest)")
        elif not runs:
            raise _apart(recording, options.pose_time_offset)
        return [run.trajectory for run in runs]


def _unsaid_commands(names: Sequence[str], dataset: Dataset) -> list[str]:
    """A word on commands that the names of runs seem to say, where nothing else does: ``left_1``, ``left_2`` ..."""
    stems = Counter(_NUMBERED.sub("", name) for name in names)
    said = any(run.command for run in dataset.trajectories)
    if said or len(stems) < 2 or min(stems.values()) < 2 or "" in stems:
        return []
    return [
        f"names such as {names[0]} look like repetitions of {plural(len(stems), 'command')}; if they are, say --set "
        f"'command_pattern={_PATTERN}', since noise is known from repetitions"
    ]


def _poses_within(recording: RecordedStreams) -> Array:
    """Times of the poses while the wheels were recorded, s."""
    samples, times = recording.samples, recording.reference.times
    return times[(times >= samples.begins[0]) & (times <= samples.ends[-1])]


def _apart(recording: RecordedStreams, offset: float) -> DataError:
    """The error of wheels and poses that share no time. offset: that was added to the poses' times, s."""
    samples, times = recording.samples, recording.reference.times
    if len(times) < 2 and recording.reference.measured is not None:
        return DataError(
            f"{recording.place}: none of its references lies within its wheels' samples, {samples.begins[0]:.10g} to "
            f"{samples.ends[-1]:.10g} s; times count by the wheels' clock (--set pose_time_unit=ms, pose_time_offset=S)"
        )
    for what, count in (("poses", len(times)), ("wheels", len(samples.ends))):
        if count < 2:
            return DataError(f"{recording.place}: {what}: has one row; two are needed, or the run is no run")
    spans = f"poses {times[0]:.10g} to {times[-1]:.10g} s, wheels {samples.begins[0]:.10g} to {samples.ends[-1]:.10g} s"
    share = (times[-1] - times[0]) / (samples.ends[-1] - samples.begins[0])
    shift = offset + samples.begins[0] - times[0]
    way = f"of clocks apart that begin together: --set pose_time_offset={shift:.10g} --set clocks=match"
    if share > _FAR:
        way = "the poses' times look like ms: --set pose_time_unit=ms (or us, ns)"
    elif share < 1 / _FAR:
        way = "the wheels' times look like ms: --set wheel_time_unit=ms (or us, ns)"
    return DataError(f"{recording.place}: no two poses while the wheels were recorded ({spans}); {way}")
