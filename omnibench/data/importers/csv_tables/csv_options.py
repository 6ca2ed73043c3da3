"""Options of the importer of CSV tables, and the columns that they name or that are guessed from headings."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from omnibench.config import Positive
from omnibench.data.checks.misreading import as_yaml
from omnibench.data.delimited import DECIMAL_COMMA, CellTable, ColumnError, missing_column
from omnibench.data.importers.recording_options import HeadingUnit, TimeUnit
from omnibench.data.importers.wheel_samples import EncoderOptions, Signs
from omnibench.data.splits import Names
from omnibench.errors import nearest
from omnibench.words import plural

WHEEL_SUFFIXES = ("_wheels.csv", "_wheels.parquet")
REFERENCE_SUFFIXES = ("_references.csv", "_references.parquet")
POSE_SUFFIXES = ("_poses.csv", "_poses.tum", "_poses.parquet")
BLANKS = "blanks"
_SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t"}
TIMES = ("t", "time", "stamp", "timestamp")
HEADINGS = ("theta", "heading", "yaw")
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


def _as_names(value: Any) -> Any:
    return {key: _as_name(name) for key, name in value.items()} if isinstance(value, dict) else value


Column = Annotated[str, BeforeValidator(_as_name)]
"""An option that takes the name of a column, or its number."""


class CsvOptions(EncoderOptions):
    """Names of files and columns, units, and how the text is written."""

    group: ClassVar[str] = "Tables, columns and units"

    name: str = Field("csv", min_length=1, description="name of the data set")
    columns: Annotated[dict[str, Column], BeforeValidator(_as_names)] = Field(
        {}, description="names of columns, as {t: time, omega_left: rpm_l, x: px}; also pose_t, run"
    )
    wheel_columns: Names = Field((), description="in the robot's order; default omega_, phi_ or ticks_ <wheel>")
    wheel_signs: Signs = Field((), description="-1 for wheels that count the other way round, as [-1,1]")
    wheel_time_column: Column | None = Field(None, description=f"default: {', '.join(TIMES)}")
    wheel_time_unit: TimeUnit = Field("s", description="unit of the wheels' times")
    steering_columns: Names = Field((), description="in the order of the wheels that steer; default steer_<wheel>")
    pose_columns: Names = Field((), description="of x, y and heading; default: x, y, and theta, heading or yaw")
    pose_time_column: Column | None = Field(None, description="default: as for wheels")
    pose_time_unit: TimeUnit | None = Field(None, description="default: s, or the wheels' in one table")
    heading_unit: HeadingUnit = Field("rad", description="unit of the headings of CSV poses")
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
    wheel_suffix: str | None = Field(None, min_length=1, description="of the wheels' files; default _wheels.csv")
    pose_suffix: str | None = Field(None, min_length=1, description="of the poses' files; default _poses.csv or .tum")
    window: Positive | None = Field(None, description="s; cuts each recording into runs this long")
    command_pattern: str | None = Field(
        None, description="regular expression: its group 1 in a run's name is the command"
    )

    @model_validator(mode="after")
    def _fits_together(self) -> CsvOptions:
        self.require_one_each("wheel_columns", "wheel_signs", "steering_columns")
        if len(self.pose_columns) not in (0, 3):
            raise ValueError(f"pose_columns has {plural(len(self.pose_columns), 'value')}, expected 3: x, y, heading")
        known = self.column_keys
        otherwise = {f"{prefix}{wheel}" for prefix in PREFIXES for wheel in self.robot.wheel_names}
        for key in self.columns:
            if key not in known and key not in otherwise:
                raise ValueError(f"columns: unknown column {key!r}; {nearest(key, known)}known: {', '.join(known)}")
        if self.command_pattern is not None:
            try:
                groups = re.compile(self.command_pattern).groups
            except re.error as error:
                raise ValueError(f"command_pattern is not a regular expression: {error}") from None
            if groups < 1:
                raise ValueError("command_pattern needs a group in parentheses, for example '^(.*)_rep'")
        return self

    @property
    def signs(self) -> Signs:
        return self.wheel_signs

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
        return ("t", *wheels, *self.robot.wheel_names, *steering, "pose_t", "x", "y", "theta", "run")


_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|°")
TIME_UNITS = {"ms": "ms", "msec": "ms", "millis": "ms", "us": "us", "usec": "us", "micros": "us", "ns": "ns"}
_LENGTHS = {"mm": "mm", "cm": "cm"}
_ANGLES = {"deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg"}
_TICKS = dict.fromkeys(("tick", "ticks", "count", "counts", "pulses", "enc", "encoder"), "ticks")
_WHEELS = {**_ANGLES, **_TICKS, **dict.fromkeys(("rev", "revs", "revolutions"), "rev"), "rpm": "rpm"}
_PER_SECOND = ("s", "sec")  # behind a unit, of rates


def words_of(name: str) -> list[str]:
    """The words of a column's name in lower case: ``rpm``, ``fl`` of ``RPM_FL``."""
    return [word.lower() for word in _WORDS.findall(name)] or [name.lower()]


def unit_options(columns: Mapping[str, str], options: CsvOptions, *, shared: bool) -> dict[str, list[str]]:
    """Units in the names of columns that differ from those read: what to set (``position_unit=mm``), and the columns.

    columns: their names by the keys of the option ``columns``. shared: wheels and poses stand in the same rows. A unit
    that the options say is never contradicted.
    """
    said: dict[str, list[str]] = {}
    for key, name in columns.items():
        for option, unit in _said(key, words_of(name)):
            read = getattr(options, option) or (options.wheel_time_unit if shared else "s")
            default = key.lower().endswith(name.lower())  # omega_left, or left: a wheel may be called as a unit
            if option not in options.model_fields_set and unit != read and not default:
                said.setdefault(f"{option}={unit}", []).append(name)
    return said


def typed_units(said: Mapping[str, list[str]]) -> list[str]:
    """The settings of units, with what else ticks need."""
    needs = {"wheel_unit=ticks": "ticks_per_turn=N", "steering_unit=ticks": "steering_ticks_per_turn=N"}
    return [setting for unit in said for setting in filter(None, (unit, needs.get(unit)))]


def check_units(file: object, columns: Mapping[str, str], options: CsvOptions, *, shared: bool) -> None:
    """ColumnError: names of columns say other units than they are read in."""
    said = unit_options(columns, options, shared=shared)
    if not said:
        return
    names = list(dict.fromkeys(name for each in said.values() for name in each))
    typed = " ".join(f"--set {setting}" for setting in typed_units(said))
    option = next(iter(said)).partition("=")[0]
    read = getattr(options, option) or "s"
    raise ColumnError(
        f"{file}: columns say another unit by their names than they are read in ({', '.join(names)}): {typed}; or say "
        f"the unit that holds, as --set {option}={read}"
    )


def _said(key: str, words: list[str]) -> Iterator[tuple[str, str]]:
    """The options and values that the words of a column's name say."""
    if key in ("t", "pose_t"):
        yield from _first("wheel_time_unit" if key == "t" else "pose_time_unit", words, TIME_UNITS)
    elif key in ("x", "y"):
        yield from _first("position_unit", words, _LENGTHS)
    elif key == "theta":
        yield from _first("heading_unit", words, _ANGLES)
    elif key.startswith("steer_"):
        yield from _first("steering_unit", words, {**_ANGLES, **_TICKS})
    else:
        yield from _first("wheel_unit", words, _WHEELS)


def _first(option: str, words: list[str], units: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    for word, after in zip(words, [*words[1:], ""], strict=True):
        if word in units:
            rate = option == "wheel_unit" and units[word] != "rpm" and after in _PER_SECOND
            yield option, units[word] + ("/s" if rate else "")
            return


@dataclass(frozen=True)
class Wanted:
    """A column that is wanted: its key in the option ``columns``, and the names that it may have, the first first."""

    key: str
    names: tuple[str, ...]

    def found(self, table: CellTable) -> str | None:
        """The name that it has in a table, in any case of letters; None if it is not there."""
        for name in self.names:
            if not table.missing([name]):
                return name
        lower = {name.lower(): name for name in reversed(table.names)}
        return next((lower[name.lower()] for name in self.names if name.lower() in lower), None)


@dataclass(frozen=True)
class WantedColumns:
    """The columns that a stream needs: its time, then its values. what: wheels or poses."""

    what: str
    time: Wanted
    values: tuple[Wanted, ...]

    @property
    def all(self) -> tuple[Wanted, ...]:
        """Time and values."""
        return (self.time, *self.values)

    def missing(self, table: CellTable) -> list[Wanted]:
        """The columns that a table does not have."""
        return [wanted for wanted in self.all if wanted.found(table) is None]

    def names(self, table: CellTable) -> tuple[str, list[str]]:
        """The names of time and values in a table that has them all."""
        found = [wanted.found(table) or wanted.names[0] for wanted in self.all]
        return found[0], found[1:]


def wheel_columns(options: CsvOptions) -> WantedColumns:
    """The columns of the wheels, and of the steering angles where the robot steers."""
    wheels = _each(options, options.prefix, options.robot.wheel_names, options.wheel_columns, bare=True)
    steering = _each(options, "steer_", options.robot.drive.steered, options.steering_columns, bare=False)
    return WantedColumns("wheels", _time(options), (*wheels, *steering))


def pose_columns(options: CsvOptions, *, shared: bool) -> WantedColumns:
    """The columns of the poses. shared: wheels stand in the same table, whose time is theirs unless it is said."""
    given = options.pose_time_column or options.columns.get("pose_t")
    wheels = _time(options)
    alike = tuple(dict.fromkeys((*wheels.names, *TIMES)))
    time = Wanted("pose_t", (given,)) if given else wheels if shared else Wanted("pose_t", alike)
    keys = ("x", "y", "theta")
    values = []
    for index, (key, names) in enumerate(zip(keys, (("x",), ("y",), HEADINGS), strict=True)):
        said = options.columns.get(key) or (options.pose_columns[index] if options.pose_columns else None)
        values.append(Wanted(key, (said,) if said else names))
    return WantedColumns("poses", time, tuple(values))


def run_column(options: CsvOptions, table: CellTable) -> str | None:
    """The column that names the run of a row; None without one. DataError: it has not the one that the options name."""
    given = options.run_column or options.columns.get("run")
    found = Wanted("run", (given, *RUNS) if given else RUNS).found(table)
    if given and found is None:
        raise ColumnError(f"{missing_column(table.file, given, table.names)}; --set run_column=NAME")
    return found


def _time(options: CsvOptions) -> Wanted:
    given = options.wheel_time_column or options.columns.get("t")
    return Wanted("t", (given,) if given else TIMES)


def _each(options: CsvOptions, prefix: str, wheels: Sequence[str], given: Sequence[str], *, bare: bool) -> list[Wanted]:
    """The columns of some wheels. bare: wheels' names are some, too, and those of other units where one is said."""
    others = tuple(other for other in PREFIXES if other != prefix) if bare else ()
    wanted = []
    for index, wheel in enumerate(wheels):
        key = f"{prefix}{wheel}"
        keys = (key, wheel, *(f"{other}{wheel}" for other in others)) if bare else (key,)
        said = next((options.columns[each] for each in keys if each in options.columns), None)
        said = said or (given[index] if given else None)
        found = keys if "wheel_unit" in options.model_fields_set else keys[:2]
        wanted.append(Wanted(key, (said,) if said else found))
    return wanted


_CLOSE = 0.75  # of difflib's ratio, from which on a name is taken for a misspelt one; chosen
_KINDS = {
    "t": ("t", "time", "stamp", "timestamp", "clock", "sec", "secs", "seconds", *TIME_UNITS),
    "x": ("x", "px", "posx"),
    "y": ("y", "py", "posy"),
    "theta": ("theta", "heading", "yaw", "angle", "rotation", "orientation", "phi", "th"),
}
_STEERING = frozenset(("steer", "steering"))
_SIDES = {"left": ("left", "l"), "right": ("right", "r"), "front": ("front", "f"), "rear": ("rear", "back", "b")}


def missing_error(table: CellTable, missing: Sequence[Wanted], options: CsvOptions) -> ColumnError:
    """The error that names what is missing, what was found, and what to type if that is meant."""
    if not table.headed:
        shown = ", ".join(f"{wanted.key}: 1" for wanted in missing[:1]) or "t: 1"
        keys = ", ".join(wanted.key for wanted in missing)
        return ColumnError(
            f"{table.file}: it has no header and {len(table.names)} columns; say by numbers, from 1, which of them are "
            f'{keys}: --set "columns={{{shown}, ...}}"'
        )
    names = [f"'{wanted.names[0]}'" for wanted in missing]
    what = f"column {names[0]} is" if len(names) == 1 else f"columns {', '.join(names[:-1])} and {names[-1]} are"
    found = ", ".join(filter(None, table.names))
    if len(table.names) == 1:
        way = "name what separates the fields: --set separator=blanks (or another character)"
    else:
        way = _way_out(table, missing, options)
    return ColumnError(f"{table.file}: {what} missing; found: {found}; {way}")


def _way_out(table: CellTable, missing: Sequence[Wanted], options: CsvOptions) -> str:
    """What to type to name the columns that are missing: by what looks like them, or by an example."""
    streams = (wheel_columns(options), pose_columns(options, shared=False))
    used = {wanted.found(table) for stream in streams for wanted in stream.all}
    taken: dict[str, str] = {}
    for wanted in missing:
        free = [name for name in table.names if name and name not in taken.values() and name not in used]
        if (likely := _likely(wanted, free, options)) is not None:
            taken[wanted.key] = likely
    units = typed_units(unit_options(taken, options, shared=True))
    commas = any(DECIMAL_COMMA.fullmatch(cell) for name in taken.values() for cell in table.texts(name))
    typed = "".join(f" --set {setting}" for setting in [*units, *(["decimal=comma"] if commas else [])])
    shown = ", ".join(f"{wanted.key}: {_typed(taken.get(wanted.key, 'NAME'))}" for wanted in missing)
    if len(taken) < len(missing):
        return f'name {"it" if len(missing) == 1 else "them"}: --set "columns={{{shown}}}"{typed}'
    return f'did you mean --set "columns={{{shown}}}"{typed}?'


def _typed(name: str) -> str:
    """A name as a value in a mapping of YAML that is typed between double quotes."""
    return name if as_yaml(name) == name else "'" + name.replace("'", "''") + "'"


def _likely(wanted: Wanted, names: Sequence[str], options: CsvOptions) -> str | None:
    """The one of the columns whose name holds a word that says it; None if there is none, or several."""
    kind = "t" if wanted.key == "pose_t" else wanted.key
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
    exact = [name for name in alike if len(alike) == 1 or (words and words_of(name)[0] in words)]
    if len(exact) == 1:
        return exact[0]
    close = get_close_matches(wanted.names[0], names, n=1, cutoff=_CLOSE)
    return close[0] if close and not alike else None
