"""The error of a table that lacks columns: all of them at once, with the options that name them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

from omnibench.data.checks.option_words import as_yaml
from omnibench.data.delimited import DECIMAL_COMMA, CellTable, ColumnError
from omnibench.data.importers.csv_tables.column_words import TIME_UNITS, typed_units, unit_options, words_of
from omnibench.data.importers.csv_tables.csv_options import CsvOptions
from omnibench.data.importers.csv_tables.wanted_columns import Wanted, pose_columns, wheel_columns

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
    units = typed_units(unit_options(taken, options, shared=True))
    typed = "".join(f" --set {setting}" for setting in [*units, *_decimals(table, taken)])
    shown = ", ".join(f"{wanted.key}: {_typed(taken.get(wanted.key, 'NAME'))}" for wanted in missing)
    if len(taken) < len(missing):
        return f'name {"it" if len(missing) == 1 else "them"}: --set "columns={{{shown}}}"{typed}'
    return f'did you mean --set "columns={{{shown}}}"{typed}?'


def _typed(name: str) -> str:
    """A name as a value in a mapping of YAML that is typed between double quotes."""
    return name if as_yaml(name) == name else "'" + name.replace("'", "''") + "'"


def _decimals(table: CellTable, taken: Mapping[str, str]) -> list[str]:
    """The option of decimal commas, where cells of the columns have them."""
    commas = any(DECIMAL_COMMA.fullmatch(cell) for name in taken.values() for cell in table.texts(name))
    return ["decimal=comma"] if commas else []


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
