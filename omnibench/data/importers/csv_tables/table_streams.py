"""Wheel samples and reference poses of tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from shlex import quote

import numpy as np
from numpy.typing import NDArray

from omnibench.data.alignment import median_period
from omnibench.data.checks.option_words import as_yaml
from omnibench.data.delimited import CellTable, NumberTable
from omnibench.data.importers.csv_tables.csv_options import CsvOptions
from omnibench.data.importers.csv_tables.wanted_columns import WantedColumns
from omnibench.data.importers.runs.reference_options import SECONDS
from omnibench.data.importers.runs.reference_stream import ReferenceStream
from omnibench.data.importers.wheel_samples import WheelReadings, WheelSamples, wheel_samples
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_MOST_REPEATED = 0.5  # of a table's rows; more mean that its times are too coarse


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
    filled = _filled(table, names)
    if not len(filled):
        raise DataError(f"{table.file}: no row has values of the {wanted.what} ({', '.join(names)})")
    rows = table if len(filled) == len(table) else table.only(filled)
    if shared and wanted.what == "poses":
        _check_clock(rows, time)
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


def _check_clock(table: CellTable, time: str) -> None:
    """DataError: poses in the rows of the wheels are without a time, as where they have a clock of their own."""
    for row in np.flatnonzero(np.isnan(table.numbers([time])[:, 0]))[:1].tolist():
        way = 'where poses have a column of times of their own, --set "columns={pose_t: NAME}"'
        raise table.fail(row, f"{time} is missing; {way}")


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


def _filled(table: CellTable, names: Sequence[str]) -> NDArray[np.intp]:
    """The rows that hold any of the values."""
    return np.flatnonzero(~np.isnan(table.numbers(names)).all(axis=1))
