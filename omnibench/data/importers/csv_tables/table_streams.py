"""Wheel samples and reference poses of tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from omnibench.data.alignment import median_period
from omnibench.data.delimited import ColumnError, NumberTable, read_numbers
from omnibench.data.importers.csv_tables.csv_options import BLANKS, CsvOptions
from omnibench.data.importers.runs.reference_options import RADIANS
from omnibench.data.importers.runs.reference_stream import ReferenceStream
from omnibench.data.importers.tum import read_tum
from omnibench.data.importers.wheel_samples import WheelReadings, WheelSamples, wheel_samples
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_MOST_REPEATED = 0.5  # of a table's rows; more mean that its times are too coarse


def read_wheels(file: Path, options: CsvOptions, warnings: list[str]) -> WheelSamples:
    columns = (*options.columns, *options.angle_columns)
    keys = ("wheel_time_column", "wheel_columns", *(["steering_columns"] if options.angle_columns else []))
    table, times = _read(file, options, options.wheel_time_column, options.wheel_time_unit, columns, keys, warnings)
    shown, counted = table.columns(options.columns), options.quantity != "rates"
    if counted and len(times) < 2:
        raise DataError(f"{file}: positions and increments need two rows or more")
    values = options.wheel_angles(shown, times, str(file), warnings) if counted else shown * options.wheel_radians
    angles = options.steering_angles(table.columns(options.angle_columns), str(file)) if options.angle_columns else None
    readings = WheelReadings(times, values, counted, options.quantity == "positions", angles)
    period = options.sample_period or (median_period([times]) if len(times) > 1 else float(times[0]))
    samples, losses = wheel_samples(readings, options, str(file), period)
    warnings.extend(f"{file}: {loss}" for loss in losses.in_words("row"))
    return samples


def read_poses(file: Path, wheel_file: Path, options: CsvOptions, warnings: list[str]) -> ReferenceStream:
    """The reference poses of a run as the options say."""
    if file.suffix == ".tum":
        track = read_tum(file)
        return ReferenceStream(track.times, track.poses).read_as(options)
    column, unit = (options.wheel_time_column, options.wheel_time_unit) if file == wheel_file else ("t", "s")
    column, unit = options.pose_time_column or column, options.pose_time_unit or unit
    keys = ("pose_time_column", "pose_columns")
    said = warnings if file != wheel_file else []  # of the same rows it was said
    table, times = _read(file, options, column, unit, options.pose_columns, keys, said)
    return ReferenceStream(times, table.columns(options.pose_columns)).read_as(options, RADIANS[options.heading_unit])


def _read(
    file: Path,
    options: CsvOptions,
    time_column: str,
    unit: str,
    columns: Sequence[str],
    keys: Sequence[str],
    warnings: list[str],
) -> tuple[NumberTable, Array]:
    """The columns of a file and its times (rows,), s, without rows that repeat a time."""
    separator = None if options.separator == BLANKS else options.separator
    try:
        table = read_numbers(file, (time_column, *columns), separator=separator, header_lines=options.header_lines)
    except ColumnError as error:
        ways = ", ".join([*keys, "separator (blanks, ;)", "header_lines (0: columns by number, from 1)"])
        raise DataError(f"{error}; set {ways}") from None
    fresh = np.diff(table.column(time_column), prepend=-math.inf) != 0
    repeated = int((~fresh).sum())
    if 0 < repeated < _MOST_REPEATED * len(fresh):
        table = table.only(fresh)
        warnings.append(f"{file}: {plural(repeated, 'row')} that repeat the {time_column} of the one before left out")
    return table, table.increasing(time_column) * _SECONDS[unit]
