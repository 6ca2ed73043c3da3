"""Importer of general CSV recordings: wheel rates, angles or ticks, and poses, in one table, two or three.

Columns are named by options, or guessed from headings. A table of runs may give the command, repetition, split and
session of each. Distances, turns, positions and the like stand in a table of their own: a row for each, with its kind,
value and standard deviation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from omnibench.data import delimited
from omnibench.data.dataset import SPLITS, Dataset
from omnibench.data.delimited import ColumnError, Table, missing_column
from omnibench.data.importer import Importer
from omnibench.data.importers.tum import planar_headings, read_tum
from omnibench.data.recording import Notes, PoseReadings, Recording, RunAttributes, WheelReadings
from omnibench.data.recording_options import ReferenceOptions, words_of
from omnibench.data.references import KINDS, NUMBERS, References, reference_flaw, references_of
from omnibench.data.runs import dataset_of
from omnibench.data.scratch import Scratch
from omnibench.data.splits import Names
from omnibench.errors import DataError, nearest
from omnibench.progress import expect_reading, tell_reading
from omnibench.registry import importers
from omnibench.robot.kinematics import Array
from omnibench.words import plural, some

WHEEL_ENDINGS = ("_wheels.csv", "_wheels.parquet")
REFERENCE_ENDINGS = ("_references.csv", "_references.parquet")
POSE_ENDINGS = ("_poses.csv", "_poses.tum", "_poses.parquet")
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
"""Prefixes of the wheels' columns: rates, positions or increments in ticks, and those in other units."""


def _as_separator(value: str) -> str:
    value = _SEPARATORS.get(value, value)
    if value.isspace() and value != "\t":
        return BLANKS
    if len(value) != 1 and value != BLANKS:
        words = [BLANKS, *_SEPARATORS]
        raise ValueError(f"{nearest(value, words)}expected one character, or {', '.join(words)} (given: {value!r})")
    return value


Separator = Annotated[str, AfterValidator(_as_separator)]
Column = Annotated[str, BeforeValidator(lambda value: str(value) if isinstance(value, int) else value)]
"""An option that takes the name of a column, or its number."""


class CsvOptions(ReferenceOptions):
    """Names of files and columns, and how the text is written."""

    group: ClassVar[str] = "Tables, columns and units"

    name: str = Field("csv", min_length=1, description="name of the data set")
    columns: dict[str, Column] = Field({}, description="as {t: time, omega_left: rpm_l}; x, pose_t, run, z, qx ... qw")
    wheel_columns: Names = Field((), description="in the robot's order; default omega_, phi_ or ticks_ <wheel>")
    wheel_time_column: Column | None = Field(None, description=f"default: {', '.join(TIMES)}")
    steering_columns: Names = Field((), description="in the order of the wheels that steer; default steer_<wheel>")
    pose_columns: Names = Field((), description="x, y, heading; default: x, y, and theta, heading, yaw, or qx..qw")
    pose_time_column: Column | None = Field(None, description="default: as for wheels")
    up: Literal["x", "y", "z"] = Field("z", description="axis of the poses that points up: y of motion capture")
    run_column: Column | None = Field(None, description=f"names the run of a row; default, if any: {', '.join(RUNS)}")
    runs_table: Path | None = Field(None, description="of run, command, repetition, split, session; default: runs.csv")
    separator: Separator | None = Field(None, description="comma, semicolon, tab, blanks or a character; default: auto")
    decimal: Literal["point", "comma"] = Field("point", description="what decimals are written with")
    header_lines: int = Field(1, ge=0, description="above the rows, the last with names; 0: columns by number, from 1")
    pose_header_lines: int | None = Field(None, ge=0, description="of the poses' files, if they are others")
    wheel_suffix: str | None = Field(None, min_length=1, description="of the wheels' files; default _wheels.csv")
    pose_suffix: str | None = Field(None, min_length=1, description="of the poses' files; default _poses.csv or .tum")

    @model_validator(mode="after")
    def _columns_fit_together(self) -> CsvOptions:
        self.require_one_each("wheel_columns", "steering_columns")
        if len(self.pose_columns) not in (0, 3):
            raise ValueError(f"pose_columns has {plural(len(self.pose_columns), 'value')}, expected 3: x, y, heading")
        wheels = self.robot.wheel_names
        known = (*self.wheel_keys, *wheels, "pose_t", "x", "y", "theta", "run", "z", *QUATERNION)
        otherwise = {f"{prefix}{wheel}" for prefix in PREFIXES for wheel in wheels}
        for key in self.columns:
            if key not in known and key not in otherwise:
                raise ValueError(f"columns: unknown column {key!r}; {nearest(key, known)}known: {', '.join(known)}")
        return self

    @property
    def prefix(self) -> str:
        """Prefix of the wheels' columns, by their unit."""
        rates, ticks, angles = PREFIXES
        return rates if self.quantity == "rates" else ticks if "ticks" in self.wheel_unit else angles

    @property
    def wheel_keys(self) -> tuple[str, ...]:
        """The keys of the wheels' columns: of their time, their readings, and their steering angles if they steer."""
        wheels = [f"{self.prefix}{wheel}" for wheel in self.robot.wheel_names]
        return ("t", *wheels, *(f"steer_{wheel}" for wheel in self.robot.drive.steered))

    @property
    def floor(self) -> tuple[str, str]:
        """The axes of the poses along x and y of the floor, seen from above; where y is up, z points to the right."""
        return {"x": ("y", "z"), "y": ("x", "z"), "z": ("x", "y")}[self.up]

    def pose_keys(self, names: Mapping[str, str], *, shared: bool) -> tuple[str, ...]:
        """The keys of the poses' columns: time, x, y and the heading, or a quaternion where a table has one instead.

        names: of the table's columns, by their keys. shared: wheels stand in the same table, whose time is theirs
        unless it is said.
        """
        turned = "theta" not in names and all(key in names for key in QUATERNION)
        turned = turned or not self.columns.keys().isdisjoint(QUATERNION)
        time = "t" if shared and not self.pose_time_column and "pose_t" not in self.columns else "pose_t"
        return (time, *self.floor, *(QUATERNION if turned else ("theta",)))

    @property
    def accepted(self) -> dict[str, tuple[str, ...]]:
        """The names that the column of each key may have, the first first: the one of an option, or usual ones."""
        _, *keys = self.wheel_keys
        wheels = self.robot.wheel_names
        # Columns that are called by another unit are the wheels', too, where a unit is said.
        others = PREFIXES if "wheel_unit" in self.model_fields_set else ()
        names = {key: (key,) for key in (*keys, *"xyz", *QUATERNION)} | {"t": TIMES, "theta": HEADINGS}
        named = dict(zip(keys, self.wheel_columns, strict=False))
        named |= zip(keys[len(wheels) :], self.steering_columns, strict=False)
        named |= zip((*self.floor, "theta"), self.pose_columns, strict=False)
        named |= self.columns
        for key, wheel in zip(keys, wheels, strict=False):
            names[key] = (key, wheel, *(f"{other}{wheel}" for other in others))
            said = [each for each in (key, wheel, *(f"{prefix}{wheel}" for prefix in PREFIXES)) if each in self.columns]
            if said:
                named[key] = self.columns[said[0]]
        times_and_run = {"t": self.wheel_time_column, "pose_t": self.pose_time_column, "run": self.run_column}
        named |= {key: name for key, name in times_and_run.items() if name}
        names |= {key: (name,) for key, name in named.items()}
        names.setdefault("pose_t", tuple(dict.fromkeys((*names["t"], *TIMES))))
        return names | {"run": (*names.get("run", ()), *RUNS)}

    def names_in(self, table: Table) -> dict[str, str]:
        """The names of a table's columns by their keys, in any case of letters."""
        lower = {name.lower(): name for name in reversed(table.names)}
        found = {}
        for key, names in self.accepted.items():
            same = [name for name in names if name in table]
            alike = [lower[name.lower()] for name in names if name.lower() in lower]
            if same or alike:
                found[key] = [*same, *alike][0]
        return found


@dataclass(frozen=True)
class Stream:
    """The columns of wheels or of poses in a table.

    what: wheels or poses. keys: of its columns, as in the option ``columns``: that of the time first. names: of all the
    table's columns by their keys. shared: wheels and poses stand in the same rows.
    """

    what: Literal["wheels", "poses"]
    table: Table
    keys: tuple[str, ...]
    names: Mapping[str, str]
    shared: bool

    @property
    def missing(self) -> list[str]:
        """The keys of the columns that the table does not have."""
        return [key for key in self.keys if key not in self.names]


def streams_in(table: Table, options: CsvOptions, *, shared: bool) -> tuple[Stream, Stream]:
    """The columns of the wheels and of the poses in a table. shared: both stand in the same rows."""
    names = options.names_in(table)
    poses = Stream("poses", table, options.pose_keys(names, shared=shared), names, shared)
    return Stream("wheels", table, options.wheel_keys, names, shared), poses


def run_column(options: CsvOptions, table: Table) -> str | None:
    """The column that names the run of a row; None without one. DataError: it has not the one that the options name."""
    given, column = options.run_column or options.columns.get("run"), options.names_in(table).get("run")
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


def units_in(columns: Mapping[str, str], table: Table, options: CsvOptions, *, shared: bool) -> dict[str, list[str]]:
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
        word, after = next((pair for pair in pairwise([*words, ""]) if pair[0] in units), ("", ""))
        rate = option == "wheel_unit" and word != "rpm" and after in _PER_SECOND
        unit = units.get(word, "") + ("/s" if rate else "")
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


def missing_error(table: Table, missing: Sequence[str], options: CsvOptions) -> ColumnError:
    """The error that names what is missing, by its keys, what was found, and what to type if that is meant."""
    if not table.headed:
        typed = f'--set "columns={{{missing[0]}: 1, ...}}"'
        way = f"say by numbers, from 1, which of them are {', '.join(missing)}: {typed}"
        return ColumnError(f"{table.file}: it has no header and {len(table.names)} columns; {way}")
    names = [f"'{options.accepted[key][0]}'" for key in missing]
    what = f"column {names[0]} is" if len(names) == 1 else f"columns {', '.join(names[:-1])} and {names[-1]} are"
    if above := table.lines_above:
        poses = {"x", "y", "theta"} & set(missing) and set(missing).isdisjoint(options.wheel_keys[1:])
        way = f"are there {above} lines above the rows? --set {'pose_' if poses else ''}header_lines={above}"
    elif len(table.names) == 1:
        way = "name what separates the fields: --set separator=blanks (or another character)"
    else:
        way = _way_out(table, missing, options)
    return ColumnError(f"{table.file}: {what} missing; found: {', '.join(filter(None, table.names))}; {way}")


def _way_out(table: Table, missing: Sequence[str], options: CsvOptions) -> str:
    """Options to type for the columns that are missing: columns that look like them, or an example."""
    for first in range(len(table.names)):
        if table.names[first : first + len(_MOTIVE)] == _MOTIVE and "theta" in missing:
            numbers = enumerate(("pose_t", *QUATERNION, "x", "y", "z"), first)
            shown = ", ".join(f"{key}: {number}" for number, key in numbers if key != "y")
            return f'a rigid body of OptiTrack Motive? --set "columns={{{shown}}}" --set up=y'
    words = {name: words_of(name) for name in table.names if name}
    joints = set[str]()  # positions of joints that columns name in every row, as ``rostopic echo -p`` prints them
    for name in table.names:
        base, _, number = name.partition(".name")
        position = f"{base}.position{number}"
        if number.isdecimal() and position in words and len(texts := {*table.texts(name)}) == 1:
            words[position] = words_of(*texts)
            joints.add(position)
    found = options.names_in(table)
    wheels, poses = options.wheel_keys, options.pose_keys(found, shared=False)
    turns = [name for name, said in words.items() if not _TURNS.isdisjoint(said) and said[-1] in "xyzw"]
    turns.sort(key=lambda name: "xyzw".index(words[name][-1]))
    used = {*turns, *(found[key] for key in (*wheels, *poses) if key in found)}
    likely: dict[str, str] = {}
    for key in sorted(missing, key=lambda key: key != "theta"):  # it is told by its name alone
        free = {name: said for name, said in words.items() if name not in {*used, *likely.values()}}
        beside = {word for name in (*likely.values(), *options.columns.values()) for word in words_of(name)[:-1]}
        if key == "theta" and len(turns) == len(QUATERNION):
            likely |= zip(QUATERNION, turns, strict=True)
        elif (column := _likely(key, free, options, beside)) is not None:
            likely[key] = column
    shared = any(key in missing or key in found for key in wheels[1:])
    time = wheels[0] if shared else poses[0]
    named = likely | {key: found[key] for key in (time,) if key in found}
    settings = list(units_in(named, table, options, shared=shared))
    if any(delimited.DECIMAL_COMMA.fullmatch(cell) for name in likely.values() for cell in table.texts(name)[:100]):
        settings.append("decimal=comma")
    if not joints.isdisjoint(likely.values()):
        settings = list(dict.fromkeys([*settings, "wheel_unit=rad", "wheel_time_unit=ns"]))
    typed = "".join(f" --set {setting}" for setting in settings)
    keys = [each for key in missing for each in (QUATERNION if key == "theta" and "qw" in likely else (key,))]
    quoted = {name: name if as_yaml(name) == name else "'" + name.replace("'", "''") + "'" for name in likely.values()}
    shown = ", ".join(f"{key}: {quoted[likely[key]] if key in likely else 'NAME'}" for key in keys)
    if likely.keys() >= {*keys}:
        return f'did you mean --set "columns={{{shown}}}"{typed}?'
    way = f'name {"it" if len(keys) == 1 else "them"}: --set "columns={{{shown}}}"{typed}'
    without = ", or put positions without headings into a table RUN_references.csv (omnibench guide references)"
    return way + (without if keys == ["theta"] else "")


def _likely(key: str, free: Mapping[str, Sequence[str]], options: CsvOptions, beside: set[str]) -> str | None:
    """The one of the columns whose name holds a word that says a key; None if there is none, or several.

    free: names of columns, and the words that they say. beside: words of columns that are known, of which one with such
    a word is likelier.
    """
    steers, wheel = key.startswith("steer_"), key.split("_", 1)[-1]
    words = _KINDS.get("t" if key == "pose_t" else key) or _SIDES.get(wheel.lower())
    steering = [name for name, said in free.items() if not _STEERING.isdisjoint(said)]
    kind = [name for name in free if steers == (name in steering)]
    alike = [name for name in kind if not set(words or ()).isdisjoint(free[name])]
    if not words:
        alike = [name for name in kind if set(words_of(wheel)) <= set(free[name])]
    if steers and not alike and len(options.robot.drive.steered) == 1:
        alike = steering
    alike = [name for name in alike if not beside.isdisjoint(words_of(name))] or alike
    exact = [name for name in alike if len(alike) == 1 or (words and free[name][0] in words)]
    if len(exact) == 1:
        return exact[0]
    close = get_close_matches(options.accepted[key][0], free, n=1, cutoff=_CLOSE)
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


def find_tables(source: Path, options: CsvOptions, notes: Notes) -> list[TableFiles]:
    """The tables under a folder, or those of a file, by the names of files, else by what their headers hold."""
    alone = source.is_file()
    folder = source.parent if alone else source
    files = sorted(file for file in (folder.iterdir() if alone else folder.rglob("*")) if not file.is_dir())
    wheel_endings = (options.wheel_suffix,) if options.wheel_suffix else WHEEL_ENDINGS
    pose_endings = (options.pose_suffix,) if options.pose_suffix else POSE_ENDINGS
    wheels = _by_ending(folder, [source] if alone else files, wheel_endings)
    poses, measured = (_by_ending(folder, files, endings) for endings in (pose_endings, REFERENCE_ENDINGS))
    common = file_called(folder, [ending.lstrip("_") for ending in REFERENCE_ENDINGS])  # one table for all runs
    pairs = [
        TableFiles(name, wheels[name], poses.get(name), measured.get(name, common))
        for name in sorted(wheels)
        if name in poses or name in measured or common
    ]
    if not alone and (wheels or (poses and options.wheel_suffix)):
        of_one = {run: file for run, file in measured.items() if file != common}
        for name in sorted({*wheels, *poses, *of_one} - {pair.name for pair in pairs}):
            file = wheels.get(name) or poses.get(name) or of_one[name]
            endings, option = (pose_endings, "pose_suffix") if name in wheels else (wheel_endings, "wheel_suffix")
            way = f"--set {option}=ENDING for other names, or name a file of wheels and poses as the source"
            if name in wheels:
                way += f"; distances and turns go into {name}{REFERENCE_ENDINGS[0]} (omnibench guide references)"
            raise DataError(f"{file}: run {name!r} has no {' or '.join(name + end for end in endings)}; {way}")
    if pairs:
        return pairs
    if options.wheel_suffix and not alone:
        raise DataError(f"{source}: no *{options.wheel_suffix} below it; --set wheel_suffix=ENDING for other names")
    tables = [file for file in files if file.suffix.lower() in _TABLES and file.name.lower() not in RUN_TABLES]
    tables = [source] if alone else [file for file in tables if file not in {*measured.values(), common}]
    return _by_headers(folder, tables, lambda name: measured.get(name, common), options, notes)


def file_called(folder: Path, names: Sequence[str], *, other_than: Path | None = None) -> Path | None:
    """The file of a folder that has one of the names, the first first, in any case of letters."""
    files = {file.name.lower(): file for file in sorted(folder.iterdir()) if not file.is_dir() and file != other_than}
    return next((files[name] for name in names if name in files), None)


def load(file: Path, options: CsvOptions, *, poses: bool = False) -> Table:
    """The table of a file as the options say it is written. poses: it holds the poses alone."""
    other, commas = options.pose_header_lines if poses else None, options.decimal == "comma"
    lines = options.header_lines if other is None else other
    separator = None if options.separator == BLANKS else options.separator or delimited.AUTO
    try:
        table = delimited.read_cells(file, separator=separator, header_lines=lines, decimal_comma=commas)
    except DataError as error:
        key = "pose_header_lines" if poses else "header_lines"
        raise type(error)(str(error).replace("--set header_lines", f"--set {key}")) from None
    # A table without a header that has exactly the columns that are wanted of one of its streams gets their names.
    for keys in () if table.headed else (options.wheel_keys, options.pose_keys({}, shared=False)):
        names = [options.accepted[key][0] for key in keys]
        if len(names) == len(table.names) and not any(name.isdecimal() for name in names):
            return replace(table, names=tuple(names))
    return table


def _by_ending(source: Path, files: Sequence[Path], endings: Sequence[str]) -> dict[str, Path]:
    """The files with one of the endings, or that are called like one, in any case, by the names of their runs."""
    by_run = {}
    for ending in endings:
        for file in files:
            place, name = file.relative_to(source), file.name.lower()
            if name == ending.lstrip("_-.").lower():
                by_run[place.parent.as_posix() if place.parent.name else source.resolve().name] = file
            elif name.endswith(ending.lower()):
                by_run[place.as_posix()[: -len(ending)]] = file
    return by_run


def _by_headers(
    source: Path, tables: Sequence[Path], references: Callable[[str], Path | None], options: CsvOptions, notes: Notes
) -> list[TableFiles]:
    """The tables under a folder whose headers hold columns of wheels and of poses, or of wheels with references.

    references: gives the file of a recording's references, if there is one.
    """
    if not tables:
        pair = "a recording is a pair <run>_wheels.csv and <run>_poses.csv, or one table of both"
        raise DataError(f"{source}: no tables below it; {pair} ({_TEMPLATE})")
    fitting, lacking = list[TableFiles](), list[tuple[Table, list[str]]]()
    for file in tables:
        try:
            table = load(file, options)
        except delimited.NoRowsError:
            notes.append(f"{file}: left out, as it has no rows")
            continue
        name = file.relative_to(source).with_suffix("").as_posix()
        beside, (wheels, poses) = references(name), streams_in(table, options, shared=True)
        posed = beside is None or any(key in poses.names for key in poses.keys[1:])
        missing = [*wheels.missing, *(poses.missing if posed else ())]
        if missing:
            lacking.append((table, list(dict.fromkeys(missing))))
        else:
            fitting.append(TableFiles(name, file, file if posed else None, beside))
    if not fitting and not lacking:
        raise DataError(f"{source}: none of its tables has rows ({_TEMPLATE})")
    if not fitting:
        # Some tables hold the wheels and others the poses, by names that do not say so.
        apart = [streams_in(table, options, shared=False) for table, _ in lacking]
        of_wheels, of_poses = ([each.table.file for each in of if not each.missing] for of in zip(*apart, strict=True))
        if of_wheels and of_poses:
            endings = "--set wheel_suffix=ENDING --set pose_suffix=ENDING"
            way = f"call them <run>_wheels.csv and <run>_poses.csv, or {endings}"
            raise DataError(f"{of_wheels[0]} holds wheels and {of_poses[0].name} poses; {way}")
        raise missing_error(*min(lacking, key=lambda pair: len(pair[1])), options)
    if lacking:
        others = some([table.file.relative_to(source).as_posix() for table, _ in lacking])
        notes.append(f"tables without columns of wheels and poses were left out: {others}")
    return fitting


Tables = dict[str | None, Table]
Attributes = dict[str, RunAttributes]


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
        way = f"a row needs its kind ({', '.join(KINDS)}), value and sigma (omnibench guide references)"
        raise DataError(f"{missing_column(table.file, 'kind', table.names)}; {way}")
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


def _values(stream: Stream, table: Table, notes: Notes) -> tuple[Array, Array, tuple[str, ...], NDArray[np.intp]]:
    """Times (F,) and values (F, n) of a stream in the table of a run, their names, and the rows (F,) that hold them.

    Rows without any value of the stream are left out, and so are rows that repeat a time. DataError names the row of
    what is wrong.
    """
    time, *names = [stream.names[key] for key in stream.keys]
    numbers = table.numbers([time, *names])
    filled = ~np.isnan(numbers[:, 1:]).all(axis=1)
    rows, blank = np.flatnonzero(filled), len(numbers) - int(np.sum(filled))
    beside = stream.shared and stream.what == "poses"  # poses in the rows of the wheels
    if blank == len(numbers):
        raise DataError(f"{table.file}: no row has values of the {stream.what} ({', '.join(names)})")
    if blank:
        numbers = numbers[rows]
        if not stream.shared:
            notes.append(f"{table.file}: {plural(blank, 'row')} without values of the {stream.what} left out")
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
    if (flaw := delimited.not_increasing(times)) is not None:
        raise DataError(f"{table.fail(int(rows[flaw[0]]), f'{time} {flaw[1]}')}{_of_runs(table.only(rows), time)}")
    return times, numbers[:, 1:].copy(), tuple(names), rows


def _of_runs(table: Table, time: str) -> str:
    """Hint at run_column where times begin anew, as in a table of several runs; empty where they do not."""
    anew = (np.flatnonzero(np.diff(table.numbers([time])[:, 0]) < 0) + 1).tolist()
    for name in filter(None, table.names if anew else ()):
        cells = table.texts(name)
        if [row for row in range(1, len(cells)) if cells[row] != cells[row - 1]] == anew:
            return f"; does {name} name the run of each row? --set {quote(f'run_column={as_yaml(name)}')}"
    several = "; repair the row, or, in a table of several runs, name the column of runs: --set run_column=NAME"
    return several if anew else ""


def _recordings(
    files: TableFiles, measured: Tables, attributes: Attributes, options: CsvOptions, notes: Notes, *, several: bool
) -> Iterator[Recording]:
    """The recording of every run that a column of the tables names, or of all of their rows.

    measured: the references by their runs. ColumnError: columns of wheels or of poses are missing, all of which it
    names, or say another unit.
    """
    shared, table = files.wheels == files.poses, load(files.wheels, options)
    streams = list(streams_in(table, options, shared=shared))
    if not shared:
        apart = None if files.poses is None or files.poses.suffix == ".tum" else load(files.poses, options, poses=True)
        streams[1:] = [] if apart is None else streams_in(apart, options, shared=False)[1:]
    missing = [(stream.table, stream.missing) for stream in streams]
    if shared:
        missing = [(table, list(dict.fromkeys(key for stream in streams for key in stream.missing)))]
    if errors := [str(missing_error(*lacking, options)) for lacking in missing if lacking[1]]:
        raise ColumnError("; and ".join(errors))
    for stream in streams:
        names = {key: stream.names[key] for key in stream.keys}
        if said := units_in(names, stream.table, options, shared=shared):
            columns = ", ".join(dict.fromkeys(name for columns in said.values() for name in columns))
            typed = " ".join(f"--set {setting}" for setting in said)
            option = next(iter(said)).partition("=")[0]
            way = f"{typed}; or say the unit that holds, as --set {option}={getattr(options, option) or 's'}"
            raise ColumnError(f"{stream.table.file}: columns say another unit than they are read in ({columns}): {way}")
    wheels = by_run(table, options)
    poses = {} if len(streams) == 1 else wheels if shared else by_run(streams[1].table, options)
    runs = list(dict.fromkeys([*wheels, *poses]))
    if len(runs) > 1:
        runs = [run for run in runs if run is not None]
        if files.wheels.stat().st_size > delimited.LARGE:
            expect_reading(len(runs), "run")
    reference = files.poses or files.references or files.wheels
    for run in runs:
        name = files.name if run is None or (several and len(runs) == 1) else f"{files.name}/{run}" if several else run
        if run not in wheels and None not in wheels:
            raise DataError(f"{files.wheels}: run {run!r} has no wheels; add them, or take it out of the other table")
        rows, placed = measured.get(None, measured.get(name)), poses.get(run, poses.get(None))
        references, seen = None if rows is None else read_measured(rows), None
        readings = _wheels(streams[0], wheels.get(run) or wheels[None], options, notes)
        if files.poses is not None and files.poses.suffix == ".tum":
            seen = read_tum(files.poses)
        elif placed is not None:
            seen = _poses(streams[1], placed, options, notes)
        elif references is None:
            what = "has no poses" if files.poses else "is not in its column run, and has no poses"
            raise DataError(f"{reference}: run {name!r} {what}; add what was measured of it, or take its wheels out")
        if references is not None:
            references = replace(references, start_known=seen is not None and len(seen.times) > 0)
        place = str(reference) if None in wheels else f"{reference}, run {run}"
        said_of_run = attributes.get(name, RunAttributes())
        yield Recording(name, place, readings, seen, references, attributes=said_of_run, one_table=shared)


def _wheels(stream: Stream, table: Table, options: CsvOptions, notes: Notes) -> WheelReadings:
    """The wheels in the rows of a run."""
    count = len(options.robot.wheel_names)
    times, values, names, _ = _values(stream, table, notes)
    steering = values[:, count:] if len(names) > count else None
    place, columns = "" if stream.shared else str(table.file), (names[:count], names[count:])
    return WheelReadings(times, values[:, :count], options.wheel_unit, steering, *columns, place=place)


def _poses(stream: Stream, table: Table, options: CsvOptions, notes: Notes) -> PoseReadings:
    """The poses in the rows of a run as they were recorded; those of a quaternion have headings in rad."""
    times, values, _, rows = _values(stream, table, notes)
    side = np.array([1.0, -1.0 if options.up == "y" else 1.0])
    places, turns = values[:, :2] * side, values[:, 2:]
    if turns.shape[1] == 1:
        return PoseReadings(times, np.hstack([places, turns]))
    axes = ["xyz".index(axis) for axis in (*options.floor, options.up)]
    orientations = planar_headings(turns[:, [*axes, 3]] * [*side, 1.0, 1.0])
    for row in np.flatnonzero(orientations.flawed)[:1].tolist():
        raise table.fail(int(rows[row]), orientations.flaw(row))
    return PoseReadings(times, np.column_stack([places, orientations.headings]), radians=True)


def read_run_attributes(source: Path, options: CsvOptions, notes: Notes) -> Attributes:
    """Attributes of each run in a table of runs, by its name; empty without one. DataError names the row of a flaw."""
    folder = source if source.is_dir() else source.parent
    file = options.runs_table or file_called(folder, RUN_TABLES, other_than=source)
    if file is None:
        return {}
    table = load(file, options).in_lower_case()
    named = run_column(options, table)
    if named is None:
        raise DataError(f"{missing_column(file, 'run', table.names)}; --set run_column=NAME")
    known = [key for key in (*_TEXTS, *_NUMBERS) if key in table.names]
    unused = [key for key in (*_TEXTS, *_NUMBERS) if key not in known]
    hints = {name: nearest(name, unused).strip() for name in table.names if name not in (named, *known)}
    notes += [f"{file}: column {name!r} is not read; {hint}" for name, hint in hints.items() if hint]
    columns: dict[str, list[Any]] = {key: table.texts(key) for key in known if key in _TEXTS}
    columns |= {key: table.numbers([key])[:, 0].tolist() for key in known if key in _NUMBERS}
    attributes: Attributes = {}
    for row, run in enumerate(table.texts(named)):
        said = {key: column[row] for key, column in columns.items()}
        if (split := said.get("split", SPLITS[0])) not in SPLITS:
            raise table.fail(row, f"split is {split!r}; {nearest(split, SPLITS)}it must be train or validation")
        if run in attributes:
            raise table.fail(row, f"run {run!r} is there twice")
        said = {key: value for key, value in said.items() if value != "" and value == value}  # nan: blank
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
        notes = list[str]()
        return dataset_of(self.recordings(source, notes), self.options, notes)

    def recordings(self, source: Path, notes: Notes) -> Sequence[Recording]:
        """The recordings of all tables, of each run by itself; of large tables in a temporary file, whence one is read.

        DataError names the file and the row of what is wrong.
        """
        options = self.options
        files = find_tables(source, options, notes)
        as_tables = options.model_copy(update={"header_lines": 1, "separator": None})
        of_references = filter(None, dict.fromkeys(each.references for each in files))
        measured = {file: by_run(load(file, as_tables).in_lower_case(), options) for file in of_references}
        attributes = read_run_attributes(source, options, notes)
        names = list[str]()
        users = Counter[Path | None]()  # number of recordings by their table of references

        def read() -> Iterator[Recording]:
            if size > delimited.LARGE:
                expect_reading(len(files), "run")
            for each in files:
                of_runs = measured[each.references] if each.references else {}
                for recording in _recordings(each, of_runs, attributes, options, notes, several=len(files) > 1):
                    tell_reading(1, "run")
                    names.append(recording.name)
                    users[each.references] += 1
                    yield recording

        tables = {file for each in files for file in (each.wheels, each.poses) if file}
        size = sum(file.stat().st_size for file in tables)
        recordings = Scratch().sequence(read()) if size > delimited.LARGE else list(read())
        for file, of_runs in measured.items():
            if None in of_runs and users[file] > 1:
                found = ", ".join(of_runs[None].names)
                way = f"which says of which run a row is; found: {found}; --set run_column=NAME"
                raise DataError(f"{file}: column 'run' is missing, {way}")
            for name in of_runs:
                if name is not None and name not in names:
                    raise DataError(f"{file}: run {name!r} has no wheels; {nearest(name, names)}runs: {some(names)}")
        for run in names if attributes else ():
            if run not in attributes:
                known = f"{nearest(run, attributes)}it has: {some(list(attributes))}"
                raise DataError(f"the table of runs does not list run {run!r}; {known}")
        if extra := [run for run in attributes if run not in names]:
            notes.append(f"the table of runs lists runs that have no samples: {some(extra)}")
        return recordings
