"""The tables of every recording under a source: a pair of files each, or tables that hold wheels and poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from omnibench.data.delimited import AUTO, CellTable, NoRowsError, read_cells
from omnibench.data.importers.csv_tables.csv_options import (
    BLANKS,
    POSE_SUFFIXES,
    REFERENCE_SUFFIXES,
    WHEEL_SUFFIXES,
    CsvOptions,
    Wanted,
    WantedColumns,
    missing_error,
    pose_columns,
    wheel_columns,
)
from omnibench.errors import DataError
from omnibench.words import some

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
    return _as_expected(table, options)


def _as_expected(table: CellTable, options: CsvOptions) -> CellTable:
    """A table without a header that has exactly the columns that are wanted of one of its streams, with their names."""
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
        name, wanted = _stem(file, source), pose_columns(options, shared=True)
        posed = references.of(name) is None or not _all_missing(wanted, table)
        missing = [*wheel_columns(options).missing(table), *(wanted.missing(table) if posed else ())]
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


def _stem(file: Path, source: Path) -> str:
    return file.relative_to(source).with_suffix("").as_posix()
