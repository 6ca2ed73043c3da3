"""Words in the names of columns, and the units among these with the options that take them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

from omnibench.data.delimited import ColumnError
from omnibench.data.importers.csv_tables.csv_options import CsvOptions

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
