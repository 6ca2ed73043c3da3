"""The error of a table that lacks columns: all of them at once, with the options that name them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

from omnibench.data.delimited import DECIMAL_COMMA, CellTable, ColumnError
from omnibench.data.importers.csv_tables.csv_options import CsvOptions
from omnibench.data.importers.csv_tables.wanted_columns import Wanted, pose_columns, wheel_columns

_CLOSE = 0.75  # of difflib's ratio, from which on a name is taken for a misspelt one; chosen
_WORDS = re.compile(r"[a-zA-Z][a-z]*|\d+")
# Words of a column's name that say its unit, and the option of each kind of column that takes it.
_TIME_UNITS = {"ms": "ms", "msec": "ms", "millis": "ms", "us": "us", "usec": "us", "micros": "us", "ns": "ns"}
_LENGTHS = {"mm": "mm", "cm": "cm"}
_ANGLES = {"deg": "deg", "degrees": "deg"}
_RATES = {"rpm": "rpm", "deg": "deg/s", "ticks": "ticks", "tick": "ticks", "counts": "ticks", "count": "ticks"} | {
    "enc": "ticks",
    "encoder": "ticks",
}
_KINDS = {
    "t": ("t", "time", "stamp", "timestamp", "clock", "sec", "secs", "seconds", *_TIME_UNITS),
    "x": ("x", "px", "posx"),
    "y": ("y", "py", "posy"),
    "theta": ("theta", "heading", "yaw", "angle", "rotation", "orientation", "phi", "th"),
}
_SIDES = {"left": ("left", "l"), "right": ("right", "r"), "front": ("front", "f"), "rear": ("rear", "back", "b")}


def missing_error(table: CellTable, missing: Sequence[Wanted], options: CsvOptions) -> ColumnError:
    """The error that names what is missing, what was found, and what to type if that is meant."""
    if not table.headed:
        return _unnamed(table.file, missing, len(table.names))
    names = [f"'{wanted.names[0]}'" for wanted in missing]
    what = f"column {names[0]} is" if len(names) == 1 else f"columns {', '.join(names[:-1])} and {names[-1]} are"
    found = ", ".join(filter(None, table.names))
    if len(table.names) == 1:
        way = "name what separates the fields: --set separator=blanks (or another character)"
    else:
        way = _way_out(table, missing, options)
    return ColumnError(f"{table.file}: {what} missing; found: {found}; {way}")


def _unnamed(file: Path, missing: Sequence[Wanted], count: int) -> ColumnError:
    shown = ", ".join(f"{wanted.key}: 1" for wanted in missing[:1]) or "t: 1"
    keys = ", ".join(wanted.key for wanted in missing)
    return ColumnError(
        f"{file}: it has no header and {count} columns; say by numbers, from 1, which of them are {keys}: "
        f'--set "columns={{{shown}, ...}}"'
    )


def _way_out(table: CellTable, missing: Sequence[Wanted], options: CsvOptions) -> str:
    """What to type to name the columns that are missing: by what looks like them, or by an example."""
    streams = (wheel_columns(options), pose_columns(options, shared=False))
    used = {wanted.found(table) for stream in streams for wanted in stream.all}
    taken: dict[str, str] = {}
    for wanted in missing:
        free = [name for name in table.names if name and name not in taken.values() and name not in used]
        if (likely := _likely(wanted, free, options)) is not None:
            taken[wanted.key] = likely
    units = "".join(f" --set {unit}" for unit in dict.fromkeys([*_units(taken, options), *_decimals(table, taken)]))
    if len(taken) < len(missing):
        shown = ", ".join(f"{wanted.key}: {taken.get(wanted.key, 'NAME')}" for wanted in missing)
        return f'name {"it" if len(missing) == 1 else "them"}: --set "columns={{{shown}}}"{units}'
    mapping = ", ".join(f"{key}: {name}" for key, name in taken.items())
    return f'did you mean --set "columns={{{mapping}}}"{units}?'


def _decimals(table: CellTable, taken: Mapping[str, str]) -> list[str]:
    """The option of decimal commas, where cells of the columns have them."""
    commas = any(DECIMAL_COMMA.fullmatch(cell) for name in taken.values() for cell in table.texts(name))
    return ["decimal=comma"] if commas else []


def _likely(wanted: Wanted, names: Sequence[str], options: CsvOptions) -> str | None:
    """The one of the columns whose name holds a word that says it; None if there is none, or several."""
    kind = "t" if wanted.key == "pose_t" else wanted.key
    words = _KINDS.get(kind)
    if words is None:
        wheel = kind.split("_", 1)[-1] if kind not in options.robot.wheel_names else kind
        words = _SIDES.get(wheel, (wheel,))
    alike = [name for name in names if not {word.lower() for word in _words(name)}.isdisjoint(words)]
    exact = [name for name in alike if _words(name)[0].lower() in words or len(alike) == 1]
    if len(exact) == 1:
        return exact[0]
    close = get_close_matches(wanted.names[0], names, n=1, cutoff=_CLOSE)
    return close[0] if close and not alike else None


def _words(name: str) -> list[str]:
    return _WORDS.findall(name) or [name]


def _units(taken: dict[str, str], options: CsvOptions) -> list[str]:
    """The options of the units that the names of columns say."""
    said = []
    for key, name in taken.items():
        words = [word.lower() for word in _words(name)]
        if key in ("t", "pose_t"):
            option = "wheel_time_unit" if key == "t" else "pose_time_unit"
            said += [f"{option}={_TIME_UNITS[word]}" for word in words if word in _TIME_UNITS]
        elif key in ("x", "y"):
            said += [f"position_unit={_LENGTHS[word]}" for word in words if word in _LENGTHS]
        elif key == "theta":
            said += [f"heading_unit={_ANGLES[word]}" for word in words if word in _ANGLES]
        elif key.startswith("steer_"):
            said += [f"steering_unit={_ANGLES[word]}" for word in words if word in _ANGLES]
        elif "wheel_unit" not in options.model_fields_set:
            for word in words:
                if word in _RATES:
                    ticks = " --set ticks_per_turn=N" if _RATES[word] == "ticks" else ""
                    said.append(f"wheel_unit={_RATES[word]}{ticks}")
    return said
