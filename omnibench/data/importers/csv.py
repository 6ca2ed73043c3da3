"""Importer of general CSV recordings: wheel rates, angles or ticks, and poses, in one table, two or three.

Columns are named by options, or guessed from headings. A table of runs may give the command, repetition, split and
session of each. Distances, turns, positions and the like stand in a table of their own: a row for each, with its kind,
value and standard deviation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from shlex import quote
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from omnibench.config import as_yaml
from omnibench.data.dataset import SPLITS, Dataset
from omnibench.data.delimited import (
    AUTO,
    DECIMAL_COMMA,
    LARGE,
    ColumnError,
    NoRowsError,
    Table,
    missing_column,
    not_increasing,
    read_cells,
)
from omnibench.data.importer import Importer
from omnibench.data.importers.tum import planar_headings, read_tum
from omnibench.data.recording import PoseReadings, Recording, ReferenceOptions, RunAttributes, WheelReadings, words_of
from omnibench.data.references import KINDS, NUMBERS, References, reference_flaw, references_of
from omnibench.data.runs import dataset_of
from omnibench.data.scratch import Scratch
from omnibench.data.splits import Names
from omnibench.errors import DataError, nearest
from omnibench.progress import expect_reading, tell_reading
from omnibench.registry import importers
from omnibench.robot.kinematics import Array
from omnibench.words import plural, some

WHEEL_SUFFIXES = ("_wheels.csv", "_wheels.parquet")
REFERENCE_SUFFIXES = ("_references.csv", "_references.parquet")
POSE_SUFFIXES = ("_poses.csv", "_poses.tum", "_poses.parquet")
RUN_TABLES = ("runs.csv", "runs.parquet", "trajectories.csv", "trajectories.parquet")
_TABLES = (".csv", ".tsv", ".txt", ".log", ".dat", ".parquet")
_TEMPLATE = "omnibench import csv --template DIR writes tables to fill in"
_TEXTS, _NUMBERS = ("command", "split", "session"), ("repetition", "started_at")
_MOST_REPEATED = 0.5  # share of rows that may have the time of the row before; with more the times are too coarse
BLANKS = "blanks"
_SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t"}
TIMES = ("t", "time", "stamp", "timestamp")
HEADINGS = ("theta", "heading", "yaw")
QUATERNION = ("qx", "qy", "qz", "qw")
RUNS = ("run", "trajectory", "trial", "experiment")
PREFIXES = ("omega_", "ticks_", "phi_")
"""Of the columns of wheels: rates, positions or increments in ticks, and those in other units."""


def _as_separator(value: str) -> str:
    value = _SEPARATORS.get(value, value)
    if value.isspace() and value != "\t":
        return BLANKS
    if len(value) != 1 and value != BLANKS:
        words = [BLANKS, *_SEPARATORS]
        raise ValueError(f"{nearest(value, words)}expected one character, or {', '.join(words)} (given: {value!r})")
    return value


def _as_name(value: object) -> object:
    return str(value) if isinstance(value, int) else value


Column = Annotated[str, BeforeValidator(_as_name)]
"""An option that takes the name of a column, or its number."""


class CsvOptions(ReferenceOptions):
    """Names of files and columns, and how the text is written."""

    group: ClassVar[str] = "Tables, columns and units"

    name: str = Field("csv", min_length=1, description="name of the data set")
    columns: dict[str, Column] = Field(
        {}, description="names of columns, as {t: time, omega_left: rpm_l, x: px}; also pose_t, run, z, qx, qy, qz, qw"
    )
    wheel_columns: Names = Field((), description="in the robot's order; default omega_, phi_ or ticks_ <wheel>")
    wheel_time_column: Column | None = Field(None, description=f"default: {', '.join(TIMES)}")
    steering_columns: Names = Field((), description="in the order of the wheels that steer; default steer_<wheel>")
    pose_columns: Names = Field(
        (), description="of x, y and heading; default: x, y, and theta, heading, yaw, or qx..qw"
    )
    pose_time_column: Column | None = Field(None, description="default: as for wheels")
    up: Literal["x", "y", "z"] = Field("z", description="axis of the poses that points up: y of motion capture")
    run_column: Column | None = Field(
        None, description=f"it names the run of a row; default, if any: {', '.join(RUNS)}"
    )
    runs_table: Path | None = Field(
        None, description="table of run, command, repetition, split, session; default: runs.csv, if any"
    )
    separator: Annotated[str, AfterValidator(_as_separator)] | None = Field(
        None, min_length=1, description="comma, semicolon, tab, blanks or a character; default: recognised"
    )
    decimal: Literal["point", "comma"] = Field("point", description="what decimals are written with")
    header_lines: int = Field(
        1, ge=0, description="lines above the rows, the last with the names; 0: columns by number, from 1"
    )
    pose_header_lines: int | None = Field(None, ge=0, description="of the poses' files, if they are others")
    wheel_suffix: str | None = Field(None, min_length=1, description="of the wheels' files; default _wheels.csv")
    pose_suffix: str | None = Field(None, min_length=1, description="of the poses' files; default _poses.csv or .tum")

    @model_validator(mode="after")
    def _columns_fit_together(self) -> CsvOptions:
        self.require_one_each("wheel_columns", "steering_columns")
        if len(self.pose_columns) not in (0, 3):
            raise ValueError(f"pose_columns has {plural(len(self.pose_columns), 'value')}, expected 3: x, y, heading")
        known = self.column_keys
        otherwise = {f"{prefix}{wheel}" for prefix in PREFIXES for wheel in self.robot.wheel_names}
        for key in self.columns:
            if key not in known and key not in otherwise:
                raise ValueError(f"columns: unknown column {key!r}; {nearest(key, known)}known: {', '.join(known)}")
        return self

    @property
    def prefix(self) -> str:
        """What the columns of the wheels begin with, by their unit."""
        rates, ticks, angles = PREFIXES
        return rates if self.quantity == "rates" else ticks if "ticks" in self.wheel_unit else angles

    @property
    def column_keys(self) -> tuple[str, ...]:
        """The keys of ``columns``."""
        wheels = [f"{self.prefix}{wheel}" for wheel in self.robot.wheel_names]
        steering = [f"steer_{wheel}" for wheel in self.robot.drive.steered]
        return ("t", *wheels, *self.robot.wheel_names, *steering, "pose_t", "x", "y", "theta", "run", "z", *QUATERNION)

    @property
    def floor(self) -> tuple[str, str]:
        """The axes of the poses along x and y of the floor, seen from above; where y is up, z points to the right."""
        return {"x": ("y", "z"), "y": ("x", "z"), "z": ("x", "y")}[self.up]

    @property
    def named(self) -> dict[str, str]:
        """The names of columns by their keys, whichever option gives them."""
        wheels, steered = self.robot.wheel_names, self.robot.drive.steered
        named = dict(zip([f"{self.prefix}{wheel}" for wheel in wheels], self.wheel_columns, strict=False))
        named |= zip([f"steer_{wheel}" for wheel in steered], self.steering_columns, strict=False)
        named |= zip((*self.floor, "theta"), self.pose_columns, strict=False)
        named |= self.columns
        for prefix in (*reversed(PREFIXES), "", self.prefix):  # of the keys of a wheel's column the usual one counts
            keys = {f"{self.prefix}{wheel}": f"{prefix}{wheel}" for wheel in wheels}
            named |= {key: self.columns[said] for key, said in keys.items() if said in self.columns}
        times_and_run = {"t": self.wheel_time_column, "pose_t": self.pose_time_column, "run": self.run_column}
        return named | {key: name for key, name in times_and_run.items() if name}

    def column(self, key: str, *names: str) -> StreamColumn:
        """The column with a key: by the name that an option gives, else by one of ``names``."""
        return StreamColumn(key, (self.named[key],) if key in self.named else names)


@dataclass(frozen=True)
class StreamColumn:
    """A column of a stream: its key in the option ``columns``, and the names that it may have, the first first."""

    key: str
    names: tuple[str, ...]

    def place(self, table: Table) -> str | None:
        """The name that it has in a table, in any case of letters; None if it is not there."""
        for name in self.names:
            if name in table:
                return name
        lower = {name.lower(): name for name in reversed(table.names)}
        return next((lower[name.lower()] for name in self.names if name.lower() in lower), None)


def lacking(columns: Sequence[StreamColumn], table: Table) -> list[StreamColumn]:
    """The columns that a table does not have."""
    return [column for column in columns if column.place(table) is None]


def wheel_columns(options: CsvOptions) -> list[StreamColumn]:
    """The columns of the wheels: their time, their readings, and the steering angles where the robot steers."""
    # Columns that are called by another unit are the wheels', too, where a unit is said.
    others = PREFIXES if "wheel_unit" in options.model_fields_set else ()
    columns = [options.column("t", *TIMES)]
    for wheel in options.robot.wheel_names:
        key = f"{options.prefix}{wheel}"
        columns.append(options.column(key, key, wheel, *(f"{other}{wheel}" for other in others)))
    return columns + [options.column(f"steer_{wheel}", f"steer_{wheel}") for wheel in options.robot.drive.steered]


def pose_columns(options: CsvOptions, table: Table | None, *, shared: bool) -> list[StreamColumn]:
    """The columns of the poses: time, x, y and the heading, or the quaternion where a table has one in its place.

    shared: wheels stand in the same table, whose time is theirs unless it is said.
    """
    time = options.column("t", *TIMES)
    if "pose_t" in options.named or not shared:
        time = options.column("pose_t", *dict.fromkeys((*time.names, *TIMES)))
    heading, quaternion = options.column("theta", *HEADINGS), [options.column(key, key) for key in QUATERNION]
    turned = table is not None and heading.place(table) is None and not lacking(quaternion, table)
    turned = turned or not options.columns.keys().isdisjoint(QUATERNION)
    return [time, *(options.column(key, key) for key in options.floor), *(quaternion if turned else [heading])]


def run_column(options: CsvOptions, table: Table) -> str | None:
    """The column that names the run of a row; None without one. DataError: it has not the one that the options name."""
    given = options.named.get("run")
    column = StreamColumn("run", (given, *RUNS) if given else RUNS).place(table)
    if given and column is None:
        raise ColumnError(f"{missing_column(table.file, given, table.names)}; --set run_column=NAME")
    return column


_TIME_UNITS = {"ms": "ms", "msec": "ms", "millis": "ms", "us": "us", "usec": "us", "micros": "us", "ns": "ns"}
_LENGTHS = {"mm": "mm", "cm": "cm", "inch": "inch", "inches": "inch"}
_ANGLES = {"deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg"}
_TICKS = dict.fromkeys(("tick", "ticks", "count", "counts", "pulses", "enc", "encoder"), "ticks")
_WHEELS = {**_ANGLES, **_TICKS, **dict.fromkeys(("rev", "revs", "revolutions"), "rev"), "rpm": "rpm", **_LENGTHS}
_PER_SECOND = ("s", "sec")  # behind a unit, of rates
_UNITS: dict[str, tuple[str, dict[str, str]]] = {
    "t": ("wheel_time_unit", _TIME_UNITS),
    "pose_t": ("pose_time_unit", _TIME_UNITS),
    "theta": ("heading_unit", _ANGLES),
    "steer": ("steering_unit", {**_ANGLES, **_TICKS}),
    **dict.fromkeys("xyz", ("position_unit", _LENGTHS)),
    **dict.fromkeys(QUATERNION, ("wheel_unit", dict[str, str]())),
}
"""Options of the units of columns by their keys, and the words that say these units; others are wheels."""
_NEEDS = {"wheel_unit=ticks": "ticks_per_turn=N", "steering_unit=ticks": "steering_ticks_per_turn=N"}
_FIRST_ROWS = 1000  # by whose times it is told whether they count from 1970
_EPOCHS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))  # of unix time, which is 1.8e9 s


def unit_options(
    columns: Mapping[str, str], table: Table, options: CsvOptions, *, shared: bool
) -> dict[str, list[str]]:
    """Units that columns say and that differ from those read: what to set (``position_unit=mm``), and the columns.

    columns: their names by the keys of the option ``columns``. They say a unit in their names, in the row below, or as
    times since 1970 by their size. shared: wheels and poses stand in the same rows. A unit that the options say is
    never contradicted.
    """
    said: dict[str, list[str]] = {}
    for key, name in columns.items():
        default = key.lower().endswith(name.lower())  # omega_left, or left: a wheel may be called as a unit
        words = words_of(table.unit_of(name)) if table.units else [] if default else words_of(name)
        option, units = _UNITS.get("steer" if key.startswith("steer_") else key, ("wheel_unit", _WHEELS))
        unit = ""
        for word, after in reversed(list(pairwise([*words, ""]))):  # the first one counts
            if word in units:
                rate = option == "wheel_unit" and word != "rpm" and after in _PER_SECOND
                unit = units[word] + ("/s" if rate else "")
        if "time" in option and not unit:
            numbers = table.only(np.arange(min(len(table), _FIRST_ROWS))).numbers([name])
            numbers = numbers if np.isfinite(numbers).any() else table.numbers([name])
            largest = float(np.abs(numbers[np.isfinite(numbers)]).max(initial=0.0))
            unit = next((word for least, word in _EPOCHS if largest > least), "")
        read = getattr(options, option) or (options.wheel_time_unit if shared else "s")
        if unit and option not in options.model_fields_set and unit != read:
            setting = f"{option}={unit}"
            said.setdefault(" --set ".join(filter(None, (setting, _NEEDS.get(setting)))), []).append(name)
    return said


def check_units(table: Table, columns: Mapping[str, str], options: CsvOptions, *, shared: bool) -> None:
    """ColumnError: columns say other units than they are read in."""
    if said := unit_options(columns, table, options, shared=shared):
        names = ", ".join(dict.fromkeys(name for columns in said.values() for name in columns))
        typed = " ".join(f"--set {setting}" for setting in said)
        option = next(iter(said)).partition("=")[0]
        raise ColumnError(
            f"{table.file}: columns say another unit than they are read in ({names}): {typed}; or say "
            f"the unit that holds, as --set {option}={getattr(options, option) or 's'}"
        )


_CLOSE = 0.75  # of difflib's ratio, from which on a name is taken for a misspelt one; chosen
_KINDS = {
    "t": ("t", "time", "stamp", "timestamp", "clock", "sec", "secs", "seconds", *_TIME_UNITS),
    "x": ("x", "px", "posx"),
    "y": ("y", "py", "posy"),
    "theta": ("theta", "heading", "yaw", "angle", "rotation", "phi", "th"),
}
_STEERING = frozenset(("steer", "steering"))
_SIDES = {"left": ("left", "l"), "right": ("right", "r"), "front": ("front", "f"), "rear": ("rear", "back", "b")}
_MOTIVE = ("X", "Y", "Z", "W", "X", "Y", "Z")  # a rotation and a position, after the time
_TURNS = frozenset(("orientation", "rotation", "quaternion", "quat", "q", "rot"))


def missing_error(table: Table, missing: Sequence[StreamColumn], options: CsvOptions) -> ColumnError:
    """The error that names what is missing, what was found, and what to type if that is meant."""
    keys = [column.key for column in missing]
    if not table.headed:
        return ColumnError(
            f"{table.file}: it has no header and {len(table.names)} columns; say by numbers, from 1, which of them are "
            f'{", ".join(keys)}: --set "columns={{{keys[0]}: 1, ...}}"'
        )
    names = [f"'{column.names[0]}'" for column in missing]
    what = f"column {names[0]} is" if len(names) == 1 else f"columns {', '.join(names[:-1])} and {names[-1]} are"
    if (above := table.lines_above()) > 0:
        poses = {"x", "y", "theta"} & set(keys) and not any(column in missing for column in wheel_columns(options)[1:])
        way = f"are there {above} lines above the rows? --set {'pose_' if poses else ''}header_lines={above}"
    elif len(table.names) == 1:
        way = "name what separates the fields: --set separator=blanks (or another character)"
    else:
        way = _way_out(table, missing, options)
    return ColumnError(f"{table.file}: {what} missing; found: {', '.join(filter(None, table.names))}; {way}")


def _way_out(table: Table, missing: Sequence[StreamColumn], options: CsvOptions) -> str:
    """What to type to name the columns that are missing: by what looks like them, or by an example."""
    wheels, poses = wheel_columns(options), pose_columns(options, table, shared=False)
    if joints := _joints_in(table, [column for column in wheels if column in missing]):
        return joints
    for first in range(len(table.names)):
        if table.names[first : first + len(_MOTIVE)] == _MOTIVE and any(column.key == "theta" for column in missing):
            numbers = dict(zip((*QUATERNION, "x", "y", "z"), range(first + 1, first + 1 + len(_MOTIVE)), strict=True))
            shown = ", ".join(f"{key}: {number}" for key, number in ({"pose_t": first} | numbers).items() if key != "y")
            return f'a rigid body of OptiTrack Motive? --set "columns={{{shown}}}" --set up=y'
    used = {column.place(table) for column in (*wheels, *poses)}
    turns = [name for name in table.names if not _TURNS.isdisjoint(words_of(name)) and words_of(name)[-1] in "xyzw"]
    turns.sort(key=lambda name: "xyzw".index(words_of(name)[-1]))
    taken: dict[str, str] = {}
    for column in sorted(missing, key=lambda column: column.key != "theta"):  # it is told by its name alone
        if column.key == "theta" and len(turns) == len(QUATERNION):
            taken |= zip(QUATERNION, turns, strict=True)
            continue
        free = [name for name in table.names if name and name not in {*taken.values(), *used, *turns}]
        beside = {word for name in (*taken.values(), *options.columns.values()) for word in words_of(name)[:-1]}
        if (likely := _likely(column, free, options, beside)) is not None:
            taken[column.key] = likely
    holds_wheels = any(column in missing or column.place(table) for column in wheels[1:])
    time = wheels[0] if holds_wheels else poses[0]
    named = taken | ({} if time in missing else {time.key: time.place(table) or ""})
    units = unit_options(named, table, options, shared=holds_wheels)
    commas = any(DECIMAL_COMMA.fullmatch(cell) for name in taken.values() for cell in table.texts(name)[:100])
    typed = "".join(f" --set {setting}" for setting in [*units, *(["decimal=comma"] if commas else [])])
    keys = [
        key for column in missing for key in (QUATERNION if column.key == "theta" and "qw" in taken else (column.key,))
    ]
    shown = ", ".join(f"{key}: {_typed(taken.get(key, 'NAME'))}" for key in keys)
    if any(key not in taken for key in keys):
        way = f'name {"it" if len(keys) == 1 else "them"}: --set "columns={{{shown}}}"{typed}'
        without = ", or put positions without headings into a table RUN_references.csv (omnibench guide references)"
        return way + (without if keys == ["theta"] else "")
    return f'did you mean --set "columns={{{shown}}}"{typed}?'


def _joints_in(table: Table, missing: Sequence[StreamColumn]) -> str:
    """What to type for joints that columns name in every row, as ``rostopic echo -p`` prints a JointState."""
    named = {f"name{n}": {*table.texts(name)} for name in table.names if (n := name.partition(".name")[2]).isdecimal()}
    taken: dict[str, str] = {}
    for column in missing:
        wheel = set(words_of(column.key.split("_", 1)[-1]))
        held = [name for name, texts in named.items() if len(texts) == 1 and wheel <= set(words_of(*texts))]
        places = [name for name in table.names if held and name.endswith(f".position{held[0].removeprefix('name')}")]
        if len(held) == 1 and places:
            taken[column.key] = places[0]
    if "%time" in table.names and any(column.key == "t" for column in missing):
        taken["t"] = "%time"
    if not taken or len(taken) < len(missing):
        return ""
    shown = ", ".join(f"{key}: {_typed(name)}" for key, name in taken.items())
    return f'did you mean --set "columns={{{shown}}}" --set wheel_unit=rad --set wheel_time_unit=ns?'


def _typed(name: str) -> str:
    """A name as a value in a mapping of YAML that is typed between double quotes."""
    return name if as_yaml(name) == name else "'" + name.replace("'", "''") + "'"


def _likely(column: StreamColumn, names: Sequence[str], options: CsvOptions, beside: set[str]) -> str | None:
    """The one of the columns whose name holds a word that says it; None if there is none, or several.

    beside: words of columns that are known, of which one with such a word is likelier.
    """
    kind = "t" if column.key == "pose_t" else column.key
    steers = kind.startswith("steer_")
    wheel = kind if kind in options.robot.wheel_names else kind.split("_", 1)[-1]
    words = _KINDS.get(kind) or _SIDES.get(wheel.lower())
    alike = [
        name
        for name in names
        if steers == (not _STEERING.isdisjoint(said := words_of(name)))
        and (not set(words).isdisjoint(said) if words else set(words_of(wheel)) <= set(said))
    ]
    if steers and not alike and len(options.robot.drive.steered) == 1:
        alike = [name for name in names if not _STEERING.isdisjoint(words_of(name))]
    alike = [name for name in alike if not beside.isdisjoint(words_of(name))] or alike
    exact = [name for name in alike if len(alike) == 1 or (words and words_of(name)[0] in words)]
    if len(exact) == 1:
        return exact[0]
    close = get_close_matches(column.names[0], names, n=1, cutoff=_CLOSE)
    return close[0] if close and not alike else None


@dataclass(frozen=True)
class TableFiles:
    """The files of wheels and of poses of a recording; one file where they stand in the same rows.

    references: that of distances, turns and the like, of this recording or of all; without poses there is one.
    """

    name: str
    wheels: Path
    poses: Path | None
    references: Path | None = None


def find_tables(source: Path, options: CsvOptions, notes: list[str]) -> list[TableFiles]:
    """The tables under a folder, or those of a file, by the names of files, else by what their headers hold."""
    alone = source.is_file()
    folder = source.parent if alone else source
    files = sorted(file for file in (folder.iterdir() if alone else folder.rglob("*")) if not file.is_dir())
    wheel_suffixes = (options.wheel_suffix,) if options.wheel_suffix else WHEEL_SUFFIXES
    pose_suffixes = (options.pose_suffix,) if options.pose_suffix else POSE_SUFFIXES
    wheels = _by_suffix(folder, [source] if alone else files, wheel_suffixes)
    poses, measured = (_by_suffix(folder, files, suffixes) for suffixes in (pose_suffixes, REFERENCE_SUFFIXES))
    common = file_called(folder, [suffix.lstrip("_") for suffix in REFERENCE_SUFFIXES])  # of all runs
    pairs = [
        TableFiles(name, wheels[name], poses.get(name), measured.get(name, common))
        for name in sorted(wheels)
        if name in poses or name in measured or common
    ]
    if alone:
        return pairs or _by_headers(folder, [source], measured, common, options, notes)
    if wheels or (poses and options.wheel_suffix):
        paired = {pair.name for pair in pairs}
        for name in sorted({**wheels, **poses, **{run: file for run, file in measured.items() if file != common}}):
            if name in paired:
                continue
            have = wheels if name in wheels else poses if name in poses else measured
            suffixes, option = (pose_suffixes, "pose_suffix") if have is wheels else (wheel_suffixes, "wheel_suffix")
            missing = " or ".join(name + suffix for suffix in suffixes)
            others = ", or name this file as the source if it holds the poses, too; distances, turns and the like go "
            others += f"into {name}{REFERENCE_SUFFIXES[0]} (omnibench guide references)"
            raise DataError(
                f"{have[name]}: run {name!r} has no {missing}; --set {option}=ENDING for other names"
                + (others if have is wheels else "")
            )
        return pairs
    if options.wheel_suffix:
        raise DataError(f"{source}: no *{options.wheel_suffix} below it; --set wheel_suffix=ENDING for other names")
    tables = [
        file
        for file in files
        if file.suffix.lower() in _TABLES
        and file.name.lower() not in RUN_TABLES
        and file not in {*measured.values(), common}
    ]
    return _by_headers(source, tables, measured, common, options, notes)


def file_called(folder: Path, names: Sequence[str], *, other_than: Path | None = None) -> Path | None:
    """The file of a folder that has one of the names, the first first, in any case of letters."""
    files = {file.name.lower(): file for file in sorted(folder.iterdir()) if not file.is_dir() and file != other_than}
    return next((files[name] for name in names if name in files), None)


def load(file: Path, options: CsvOptions, *, poses: bool = False) -> Table:
    """The table of a file as the options say it is written. poses: it holds the poses alone."""
    other = options.pose_header_lines if poses else None
    lines = options.header_lines if other is None else other
    separator = None if options.separator == BLANKS else options.separator or AUTO
    try:
        table = read_cells(file, separator=separator, header_lines=lines, decimal_comma=options.decimal == "comma")
    except DataError as error:
        if not poses or "--set header_lines" not in str(error):
            raise
        raise DataError(str(error).replace("--set header_lines", "--set pose_header_lines")) from None
    if lines or file.suffix == ".parquet":
        return table
    # A table without a header that has exactly the columns that are wanted of one of its streams gets their names.
    for columns in (wheel_columns(options), pose_columns(options, None, shared=False)):
        names = [column.names[0] for column in columns]
        if len(names) == len(table.names) and not any(name.isdecimal() for name in names):
            return replace(table, names=tuple(names))
    return table


def _by_suffix(source: Path, files: Sequence[Path], suffixes: Sequence[str]) -> dict[str, Path]:
    """The files that end in one of the suffixes, or are called like one, in any case, by the names of their runs."""
    by_run = {}
    for suffix in suffixes:
        for file in files:
            place, name = file.relative_to(source), file.name.lower()
            if name == suffix.lstrip("_-.").lower():
                by_run[place.parent.as_posix() if place.parent.name else source.resolve().name] = file
            elif name.endswith(suffix.lower()):
                by_run[place.as_posix()[: -len(suffix)]] = file
    return by_run


def _by_headers(
    source: Path,
    tables: Sequence[Path],
    measured: Mapping[str, Path],
    common: Path | None,
    options: CsvOptions,
    notes: list[str],
) -> list[TableFiles]:
    """The tables under a folder whose headers hold columns of wheels and of poses, or of wheels with references."""
    if not tables:
        raise DataError(
            f"{source}: no tables below it; a recording is a pair <run>_wheels.csv and <run>_poses.csv, or one table "
            f"of both ({_TEMPLATE})"
        )
    without: dict[Path, tuple[Table, list[StreamColumn]]] = {}
    fitting: list[TableFiles] = []
    for file in tables:
        try:
            table = load(file, options)
        except NoRowsError:
            notes.append(f"{file}: left out, as it has no rows")
            continue
        name = file.relative_to(source).with_suffix("").as_posix()
        references, poses = measured.get(name, common), pose_columns(options, table, shared=True)
        posed = references is None or any(value.place(table) for value in poses[1:])
        missing = [*lacking(wheel_columns(options), table), *(lacking(poses, table) if posed else ())]
        if missing:
            without[file] = table, list(dict.fromkeys(missing))
        else:
            fitting.append(TableFiles(name, file, file if posed else None, references))
    if not fitting and not without:
        raise DataError(f"{source}: none of its tables has rows ({_TEMPLATE})")
    if not fitting:
        # Some tables hold the wheels and others the poses, by names that do not say so.
        loaded = [table for table, _ in without.values()]
        wheels = [table.file for table in loaded if not lacking(wheel_columns(options), table)]
        poses_of = [table.file for table in loaded if not lacking(pose_columns(options, table, shared=False), table)]
        if wheels and poses_of:
            raise DataError(
                f"{wheels[0]} holds wheels and {poses_of[0].name} poses; call them <run>_wheels.csv and "
                "<run>_poses.csv, or say what their names end in: --set wheel_suffix=ENDING --set pose_suffix=ENDING"
            )
        table, missing = min(without.values(), key=lambda pair: len(pair[1]))
        raise missing_error(table, missing, options)
    if without:
        others = some([file.relative_to(source).as_posix() for file in without])
        notes.append(f"tables without columns of wheels and poses were left out: {others}")
    return fitting


Tables = dict[str | None, Table]


def by_run(table: Table, options: CsvOptions) -> Tables:
    """The rows of each run that a column names, in their order; by None those of a table of one run."""
    column = run_column(options, table)
    if column is None:
        return {None: table}
    of_runs: Tables = dict(table.by_text(column).items())
    if "" in of_runs:
        raise of_runs[""].fail(0, f"{column} is missing; name the run of every row")
    return of_runs


def read_measured(table: Table) -> References:
    """The references in the rows of a run as recorded, by the clock of its poses.

    A heading with t0 = 0 counts from the run's start. DataError names the row of what is wrong.
    """
    if "kind" not in table:
        raise DataError(
            f"{table.file}: column 'kind' is missing; found: {', '.join(filter(None, table.names))}; each row needs "
            f"its kind ({', '.join(KINDS)}), value and sigma (omnibench guide references)"
        )
    kinds = np.array([kind.lower() for kind in table.texts("kind")], dtype=str)
    numbers = {name: np.full(len(table), np.nan) for name in NUMBERS}
    numbers |= {name: table.numbers([name])[:, 0] for name in NUMBERS if name in table}
    for name in ("t0", "t1"):
        for row in np.flatnonzero(np.isinf(numbers[name]))[:1].tolist():
            raise table.fail(row, f"{name} is {numbers[name][row]}; remove or repair the row")
    numbers["t0"][(kinds == "heading") & (numbers["t0"] == 0)] = -np.inf
    references = references_of(kinds, numbers)
    if (flaw := reference_flaw(references, None)) is not None:
        raise table.fail(flaw[0], flaw[1])
    return references


def _stream(
    table: Table, columns: Sequence[StreamColumn], what: str, notes: list[str], *, shared: bool
) -> tuple[Array, Array, list[str], NDArray[np.intp]]:
    """Times (F,) and values (F, n) of a stream, the names of its values, and the rows (F,) of the table that hold it.

    what: wheels or poses. Rows without any value of the stream are left out, and so are rows that repeat a time.
    DataError names the row of what is wrong.
    """
    time, *names = [column.place(table) or column.names[0] for column in columns]
    numbers = table.numbers([time, *names])
    filled = ~np.isnan(numbers[:, 1:]).all(axis=1)
    rows, blank = np.flatnonzero(filled), len(numbers) - int(np.sum(filled))
    beside = shared and what == "poses"  # poses in the rows of the wheels
    if blank == len(numbers):
        raise DataError(f"{table.file}: no row has values of the {what} ({', '.join(names)})")
    if blank:
        numbers = numbers[rows]
        if not shared:
            notes.append(f"{table.file}: {plural(blank, 'row')} without values of the {what} left out")
    for row in np.flatnonzero(np.isnan(numbers[:, 0]))[:1].tolist() if beside else ():
        way = 'where poses have a column of times of their own, --set "columns={pose_t: NAME}"'
        raise table.fail(int(rows[row]), f"{time} is missing; {way}")
    table.check_finite(numbers, [time, *names], rows)
    again = np.diff(numbers[:, 0], prepend=np.nan) == 0
    # Of a sensor that is slower than the rows all values are held.
    held = np.append(False, (np.diff(numbers[:, 1:], axis=0) == 0).all(axis=1))
    if again.any() and (np.mean(again) < _MOST_REPEATED or held[again].all()):
        numbers, rows = numbers[~again], rows[~again]
        if not beside:  # of the same rows it was said
            repeated = plural(int(again.sum()), "row")
            notes.append(f"{table.file}: {repeated} that repeat the {time} of the one before left out")
    times = numbers[:, 0].copy()
    if (flaw := not_increasing(times)) is not None:
        row, why = flaw
        raise DataError(f"{table.fail(int(rows[row]), f'{time} {why}')}{_of_runs(table.only(rows), time)}")
    return times, numbers[:, 1:].copy(), names, rows


def _of_runs(table: Table, time: str) -> str:
    """Hint at run_column where times begin anew, as in a table of several runs; empty where they do not."""
    anew = (np.flatnonzero(np.diff(table.numbers([time])[:, 0]) < 0) + 1).tolist()
    if not anew:
        return ""
    for name in filter(None, table.names):
        cells = table.texts(name)
        if [row for row in range(1, len(cells)) if cells[row] != cells[row - 1]] == anew:
            return f"; does {name} name the run of each row? --set {quote(f'run_column={as_yaml(name)}')}"
    return "; repair the row, or, in a table of several runs, name the column of runs: --set run_column=NAME"


def read_recordings(source: Path, options: CsvOptions, notes: list[str]) -> Sequence[Recording]:
    """The recordings of all tables, of each run by itself; of large tables in a temporary file, whence one is read.

    DataError names the file and the row of what is wrong.
    """
    files = find_tables(source, options, notes)
    as_tables = options.model_copy(update={"header_lines": 1, "separator": None})
    measured = {
        file: by_run(load(file, as_tables).in_lower_case(), options)
        for file in dict.fromkeys(each.references for each in files)
        if file
    }
    attributes = read_run_attributes(source, options, notes)
    names = list[str]()

    def read() -> Iterator[Recording]:
        if size > LARGE:
            expect_reading(len(files), "run")
        for each in files:
            of_runs = measured[each.references] if each.references else {}
            for recording in _recordings(each, of_runs, attributes, options, notes, several=len(files) > 1):
                tell_reading(1, "run")
                names.append(recording.name)
                yield recording

    size = sum(file.stat().st_size for file in {file for each in files for file in (each.wheels, each.poses) if file})
    recordings = Scratch().sequence(read()) if size > LARGE else list(read())
    for file, of_runs in measured.items():
        if len(names) > 1 and None in of_runs and sum(each.references == file for each in files) != 1:
            raise _unnamed(of_runs[None])
        for name in of_runs:
            if name is not None and name not in names:
                raise DataError(f"{file}: run {name!r} has no wheels; {nearest(name, names)}runs: {some(names)}")
    if attributes:
        for run in names:
            if run not in attributes:
                shown = ", ".join(list(attributes)[:12])
                raise DataError(
                    f"the table of runs does not list run {run!r}; {nearest(run, attributes)}it has: {shown}"
                )
        if extra := [run for run in attributes if run not in names]:
            notes.append(f"the table of runs lists runs that have no samples: {', '.join(extra[:12])}")
    return recordings


def _unnamed(table: Table) -> DataError:
    """The error of references that do not say of which of several runs they are."""
    return DataError(
        f"{table.file}: column 'run' is missing, which says of which run a row is; found: {', '.join(table.names)}; "
        "--set run_column=NAME"
    )


def _recordings(
    files: TableFiles,
    measured: Tables,
    attributes: Mapping[str, RunAttributes],
    options: CsvOptions,
    notes: list[str],
    *,
    several: bool,
) -> Iterator[Recording]:
    """The recording of every run that a column of the tables names, or of all of their rows.

    measured: the references by their runs. ColumnError: columns of wheels or of poses are missing, all of which it
    names, or say another unit.
    """
    shared, table = files.wheels == files.poses, load(files.wheels, options)
    reference = files.poses or files.references or files.wheels
    tables = [(table, wheel_columns(options))]
    if files.poses is not None and files.poses.suffix != ".tum":
        posed = table if shared else load(files.poses, options, poses=True)
        tables.append((posed, pose_columns(options, posed, shared=shared)))
    missing = [(table, lacking(columns, table)) for table, columns in tables]
    if shared:
        missing = [(table, list(dict.fromkeys(column for _, columns in missing for column in columns)))]
    if errors := [str(missing_error(table, columns, options)) for table, columns in missing if columns]:
        raise ColumnError("; and ".join(errors))
    for table, columns in tables:
        names = {column.key: place for column in columns if (place := column.place(table))}
        check_units(table, names, options, shared=shared)
    wheels = by_run(tables[0][0], options)
    poses = {} if len(tables) == 1 else wheels if shared else by_run(tables[1][0], options)
    runs = list(dict.fromkeys([*wheels, *poses]))
    if len(runs) > 1:
        runs = [run for run in runs if run is not None]
        if files.wheels.stat().st_size > LARGE:
            expect_reading(len(runs), "run")
    for run in runs:
        name = files.name if run is None or (several and len(runs) == 1) else f"{files.name}/{run}" if several else run
        if run not in wheels and None not in wheels:
            raise DataError(f"{files.wheels}: run {run!r} has no wheels; add them, or take it out of the other table")
        if None in measured and len(runs) > 1:
            raise _unnamed(measured[None])
        told, placed = measured.get(None, measured.get(name)), poses.get(run, poses.get(None))
        references, seen = None if told is None else read_measured(told), None
        readings = _wheels(wheels.get(run) or wheels[None], options, notes, shared=shared)
        if files.poses is not None and files.poses.suffix == ".tum":
            track = read_tum(files.poses)
            seen = PoseReadings(track.times, track.poses, radians=True)
        elif placed is not None:
            seen = _poses(placed, options, notes, shared=shared)
        elif files.poses is None and references is None:
            raise DataError(
                f"{files.references}: run {name!r} is not in its column run, and has no poses; add what was measured "
                "of it, or take its wheels out"
            )
        elif references is None:
            raise DataError(f"{reference}: run {run!r} has no poses; add them, or take it out of the other table")
        if references is not None:
            references = replace(references, start_known=seen is not None and len(seen.times) > 0)
        place = str(reference) if None in wheels else f"{reference}, run {run}"
        said = attributes.get(name, RunAttributes())
        yield Recording(name, place, readings, seen, references, attributes=said, one_table=shared)


def _wheels(table: Table, options: CsvOptions, notes: list[str], *, shared: bool) -> WheelReadings:
    """The wheels in the rows of a run. shared: poses stand in the same rows."""
    count = len(options.robot.wheel_names)
    times, values, names, _ = _stream(table, wheel_columns(options), "wheels", notes, shared=shared)
    steering = values[:, count:] if len(names) > count else None
    unit, columns, axles = options.wheel_unit, tuple(names[:count]), tuple(names[count:])
    place = "" if shared else str(table.file)
    return WheelReadings(times, values[:, :count], unit, steering, columns, axles, place=place)


def _poses(table: Table, options: CsvOptions, notes: list[str], *, shared: bool) -> PoseReadings:
    """The poses in the rows of a run as they were recorded; those of a quaternion have headings in rad."""
    columns = pose_columns(options, table, shared=shared)
    times, values, _, rows = _stream(table, columns, "poses", notes, shared=shared)
    side = np.array([1.0, -1.0 if options.up == "y" else 1.0])
    places, turns = values[:, :2] * side, values[:, 2:]
    if turns.shape[1] == 1:
        return PoseReadings(times, np.hstack([places, turns]))
    axes = ["xyz".index(axis) for axis in (*options.floor, options.up)]
    orientations = planar_headings(turns[:, [*axes, 3]] * [*side, 1.0, 1.0])
    for row in np.flatnonzero(orientations.flawed)[:1].tolist():
        raise table.fail(int(rows[row]), orientations.flaw(row))
    return PoseReadings(times, np.column_stack([places, orientations.headings]), radians=True)


def read_run_attributes(source: Path, options: CsvOptions, notes: list[str]) -> dict[str, RunAttributes]:
    """What a table of runs says of each run, by its name; empty without one. DataError names the row of a flaw."""
    folder = source if source.is_dir() else source.parent
    file = options.runs_table or file_called(folder, RUN_TABLES, other_than=source)
    if file is None:
        return {}
    table = load(file, options).in_lower_case()
    named = run_column(options, table)
    if named is None:
        raise DataError(f"{file}: column 'run' is missing; found: {', '.join(table.names)}; --set run_column=NAME")
    unused = [key for key in (*_TEXTS, *_NUMBERS) if key not in table.names]
    others = [name for name in table.names if name not in (named, *_TEXTS, *_NUMBERS)]
    hints = {name: hint.strip() for name in others if (hint := nearest(name, unused))}
    notes += [f"{file}: column {name!r} is not read; {hint}" for name, hint in hints.items()]
    columns: dict[str, list[Any]] = {key: table.texts(key) for key in _TEXTS if key in table.names}
    columns |= {key: table.numbers([key])[:, 0].tolist() for key in _NUMBERS if key in table.names}
    attributes: dict[str, RunAttributes] = {}
    for row, run in enumerate(table.texts(named)):
        said = {key: column[row] for key, column in columns.items()}
        if (split := said.get("split", SPLITS[0])) not in SPLITS:
            raise table.fail(row, f"split is {split!r}; {nearest(split, SPLITS)}it must be train or validation")
        if run in attributes:
            raise table.fail(row, f"run {run!r} is there twice")
        said = {key: value for key, value in said.items() if value not in ("", None) and value == value}  # nan: blank
        if "repetition" in said:
            said["repetition"] = round(said["repetition"])
        attributes[run] = RunAttributes(**said)
    return attributes


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
    theta (rad) or a quaternion qx, qy, qz, qw; ``columns`` takes any other names, ``..._unit`` other units, and a row
    of units may stand below the header. Commas, semicolons or tabs separate them, Parquet files hold the same. Times
    may be dates (ISO 8601). Where wheels and poses stand in the same rows, cells without a sample are blank.

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
    of a command validates. Runs share a command by the table of runs, by ``command_pattern`` or by the words of their
    names (``left_1``, ``left_2``); of runs without one every second that moves alike validates. The runs that a
    recording is cut into are called ``<run>#1``, ``<run>#2`` ...
    """

    Options = CsvOptions
    options: CsvOptions

    def read(self, source: Path) -> Dataset:
        """All runs under ``source``; DataError names the file and the row of what is wrong."""
        notes: list[str] = []
        return dataset_of(self.recordings(source, notes), self.options, notes)

    def recordings(self, source: Path, notes: list[str]) -> Sequence[Recording]:
        """The recordings under ``source`` as they stand in their tables."""
        return read_recordings(source, self.options, notes)
