"""Importer of general CSV recordings: wheel rates, angles or ticks, and poses as CSV or in TUM format."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from omnibench.config import Positive
from omnibench.data.alignment import align, median_period
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.delimited import ColumnError, NumberTable, read_numbers
from omnibench.data.importer import Importer
from omnibench.data.importers.copied_reference import follows_the_wheels
from omnibench.data.importers.encoder_options import EncoderOptions, Signs
from omnibench.data.importers.tum import read_tum
from omnibench.data.importers.wheel_samples import WheelReadings, WheelSamples, wheel_samples
from omnibench.data.splits import Names, divided
from omnibench.errors import DataError, nearest
from omnibench.registry import importers
from omnibench.robot.kinematics import Array
from omnibench.words import plural

TimeUnit = Literal["s", "ms", "us", "ns"]
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_POSE_SUFFIXES = ("_poses.csv", "_poses.tum")
_BLANKS = "blanks"
_SAME_TIME = 1e-6  # s; unix time in a double has steps of 0.2 us
_MOST_REPEATED = 0.5  # of a table's rows; more mean that its times are too coarse


def _as_separator(value: str) -> str:
    if value.isspace():
        return _BLANKS
    if len(value) != 1 and value != _BLANKS:
        raise ValueError(f"{nearest(value, [_BLANKS])}expected one character, or blanks (given: {value!r})")
    return value


def _as_name(value: object) -> object:
    return str(value) if isinstance(value, int) else value


Column = Annotated[str, BeforeValidator(_as_name)]
"""An option that takes the name of a column, or its number."""


class CsvOptions(EncoderOptions):
    """Names of files and columns, units, the robot, and which runs train and validate."""

    name: str = Field("csv", min_length=1, description="name of the data set")
    wheel_columns: Names = Field((), description="in the robot's order; default omega_, phi_ or ticks_ <wheel>")
    wheel_signs: Signs = Field((), description="-1 for wheels that count the other way round")
    wheel_time_column: Column = "t"
    wheel_time_unit: TimeUnit = "s"
    steering_columns: Names = Field((), description="in the order of the wheels that steer; default steer_<wheel>")
    pose_columns: Names = Field(("x", "y", "theta"), description="of CSV poses")
    pose_time_column: Column | None = Field(None, description="of CSV poses; default t, or the wheels' in one file")
    pose_time_unit: TimeUnit | None = Field(None, description="of CSV poses; default s, or the wheels' in one file")
    position_unit: Literal["m", "cm", "mm"] = Field("m", description="of CSV poses; TUM has m")
    heading_unit: Literal["rad", "deg"] = Field("rad", description="of CSV poses")
    separator: Annotated[str, AfterValidator(_as_separator)] = Field(
        ",", min_length=1, description="a character, or blanks: white space between fields, comments from # on"
    )
    header_lines: int = Field(
        1, ge=0, description="lines above the rows, the last with the columns' names; 0: columns by number, from 1"
    )
    wheel_suffix: str = Field("_wheels.csv", min_length=1, description="what follows a run's name")
    pose_suffix: str | None = Field(None, min_length=1, description=f"default: {' or '.join(_POSE_SUFFIXES)}")
    window: Positive | None = Field(None, description="s; cuts each recording into runs this long")
    command_pattern: str | None = Field(
        None, description="regular expression: its group 1 in a run's name is the command"
    )

    @model_validator(mode="after")
    def _fits_together(self) -> CsvOptions:
        self.require_one_each("wheel_columns", "wheel_signs", "steering_columns")
        if len(self.pose_columns) != 3:
            raise ValueError(f"pose_columns has {plural(len(self.pose_columns), 'value')}, expected 3")
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
    def columns(self) -> tuple[str, ...]:
        """The columns of the wheels."""
        prefix = "omega_" if self.quantity == "rates" else "ticks_" if "ticks" in self.wheel_unit else "phi_"
        return self.wheel_columns or tuple(prefix + wheel for wheel in self.robot.wheel_names)

    @property
    def angle_columns(self) -> tuple[str, ...]:
        """The columns of the steering angles."""
        return self.steering_columns or tuple(f"steer_{wheel}" for wheel in self.robot.drive.steered)


@importers.register("csv")
class Csv(Importer):
    """CSV files of any robot: for each run ``<run>_wheels.csv`` and ``<run>_poses.csv`` or ``<run>_poses.tum``.

    The source is a folder, searched with its subfolders, or one file; ``robot`` (a YAML file or a mapping) is the only
    option that must be given. Defaults: columns t (s), omega_<wheel> (rad/s), steer_<wheel> (rad) in wheels, t (s),
    x, y (m), theta (rad) in poses; TUM files have ``timestamp tx ty tz qx qy qz qw``. CSV columns are named in a
    header, in any order and among others, or counted from 1. A source that is one file, or files of equal
    ``wheel_suffix`` and ``pose_suffix``, hold wheels and poses in the same rows.

    wheels: with rates a row holds the mean rates since the row before (its first one: since a sample period before).
    With positions or increments the first row only gives the start of counting. Counters that begin again are counted
    on where they can be recognised, or ``wraps_at`` gives the value (65536, 2^32, 360 deg). ``gear_ratio`` is for
    encoders at the motor. A run ends where positions begin anew. The sense of a positive rate is in ``omnibench guide
    conventions``; ``wheel_signs: [-1, 1, 1]`` turns a wheel round. Steering angles are those at the rows' times.

    times: both files of a run by one clock, in any epoch (unix time, say). t = 0 becomes the first pose, or, where
    poses begin before the wheels, the begin of the wheels with the pose interpolated. Poses after the last wheel sample
    are left out, and so are rows that repeat a time.

    Splits: ``train`` and ``validation`` are patterns of run names (``day2/*``); with one of them all other runs go to
    the other side, with both the runs in neither are left out, with none every second run of a command validates. Runs
    share a command by ``command_pattern``; without it nothing is known of repetitions. The runs that ``window`` cuts a
    recording into are called ``<run>#1``, ``<run>#2`` ...
    """

    Options = CsvOptions
    options: CsvOptions

    def read(self, source: Path) -> Dataset:
        """All runs under ``source``; DataError names the file and the row of what is wrong."""
        warnings: list[str] = []
        runs = [
            run
            for name, files in _find_runs(source, self.options).items()
            for run in self._read_runs(name, *files, warnings)
        ]
        dataset = self.options.dataset(divided(runs, self.options.train, self.options.validation))
        if (residual := follows_the_wheels(dataset.trajectories)) is not None:
            warnings.append(
                "the reference is the robot's odometry, or simulated without noise: some matrix makes its headings of "
                f"the wheels to {residual:.1g} rad a second; if it is odometry, name the columns of an independent one"
            )
        return replace(dataset, warnings=(*warnings, *dataset.warnings))

    def _read_runs(self, name: str, wheel_file: Path, pose_file: Path, warnings: list[str]) -> list[Trajectory]:
        samples = _read_wheels(wheel_file, self.options, warnings)
        pose_times, poses = _read_poses(pose_file, wheel_file, self.options, warnings)
        pattern = self.options.command_pattern
        match = re.search(pattern, name) if pattern else None
        pieces = list(_pieces(samples, self.options.window))
        whole = Trajectory(name, "train", samples.ends, samples.rates, pose_times, poses, match and match.group(1))
        whole = replace(whole, session=name) if len(pieces) > 1 else whole
        runs = []
        for number, (chosen, begin, end) in enumerate(pieces, 1):
            seen = slice(None)
            if len(pieces) > 1:  # from pose to pose: one interpolated within a drive would be wrong by the path's bend
                seen = slice(*np.searchsorted(pose_times, (begin - _SAME_TIME, end + _SAME_TIME)))
            run = _run(whole, samples, chosen, seen)
            if run is not None:
                runs.append(run if whole.session is None else replace(run, id=f"{name}#{number}"))
        if not runs:
            raise DataError(
                f"{pose_file}: no two poses while the wheels were recorded (poses {pose_times[0]:.10g} to "
                f"{pose_times[-1]:.10g} s, wheels {samples.begins[0]:.10g} to {samples.ends[-1]:.10g} s); check time "
                "units"
            )
        if len(runs) < len(pieces):
            warnings.append(
                f"{pose_file}: {len(pieces) - len(runs)} of {plural(len(pieces), 'run')} left out: too few poses"
            )
        return runs


def _find_runs(source: Path, options: CsvOptions) -> dict[str, tuple[Path, Path]]:
    """The files of wheels and of poses of every run by its name."""
    suffixes = (options.pose_suffix,) if options.pose_suffix else _POSE_SUFFIXES
    if source.is_file():
        run = source.name.removesuffix(options.wheel_suffix)
        beside = [file for suffix in suffixes if (file := source.with_name(run + suffix)).is_file()]
        return {run if beside else source.stem: (source, beside[0] if beside else source)}
    wheels = {_run_name(file, source, options.wheel_suffix): file for file in source.rglob(f"*{options.wheel_suffix}")}
    poses = {
        _run_name(file, source, suffix): file for suffix in suffixes for file in sorted(source.rglob(f"*{suffix}"))
    }
    if not wheels:
        raise DataError(
            f"{source}: no *{options.wheel_suffix} below it; name the folder of the runs, or set wheel_suffix (and "
            "pose_suffix to the same where a file holds wheels and poses)"
        )
    for name in sorted(wheels):
        if name not in poses:
            missing = " or ".join(name + suffix for suffix in suffixes)
            raise DataError(f"{wheels[name]}: run {name!r} has no {missing}; set pose_suffix")
    for name in sorted(poses):
        if name not in wheels:
            raise DataError(f"{poses[name]}: run {name!r} has no {name}{options.wheel_suffix}; set wheel_suffix")
    return {name: (wheels[name], poses[name]) for name in sorted(wheels)}


def _run_name(file: Path, source: Path, suffix: str) -> str:
    return file.relative_to(source).as_posix().removesuffix(suffix)


def _pieces(samples: WheelSamples, window: float | None) -> Iterator[tuple[slice, float, float]]:
    """The samples of each piece, and its begin and end, s."""
    for part in samples.stretches():
        begin, end = float(samples.begins[part][0]), float(samples.ends[part][-1])
        count = max(1, round((end - begin) / window)) if window else 1
        for first, last in pairwise(np.linspace(begin, end, count + 1).tolist()):
            within = (samples.begins[part] < last - _SAME_TIME) & (samples.ends[part] > first + _SAME_TIME)
            chosen = np.flatnonzero(within) + part.start
            yield slice(chosen[0], chosen[-1] + 1), first, last


def _run(whole: Trajectory, samples: WheelSamples, chosen: slice, seen: slice) -> Trajectory | None:
    """A part of a recording as a run from t = 0 on; None if it has not two poses."""
    if len(whole.pose_times[seen]) < 2:
        return None
    aligned = align(float(samples.begins[chosen][0]), samples.ends[chosen], whole.pose_times[seen], whole.poses[seen])
    if aligned is None:
        return None
    times = samples.ends[chosen][aligned.kept] - aligned.zero
    angles, steering = (
        None if each is None else each[chosen][aligned.kept] for each in (samples.angles, samples.steering)
    )
    return replace(
        whole,
        times=times,
        rates=samples.rates[chosen][aligned.kept],
        pose_times=aligned.pose_times,
        poses=aligned.poses,
        started_at=None if whole.session is None else aligned.zero - float(samples.begins[0]),
        duration=float(times[-1]),
        angles=angles,
        steering=steering,
    )


def _read_wheels(file: Path, options: CsvOptions, warnings: list[str]) -> WheelSamples:
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


def _read_poses(file: Path, wheel_file: Path, options: CsvOptions, warnings: list[str]) -> tuple[Array, Array]:
    if file.suffix == ".tum":
        track = read_tum(file)
        return track.times, track.poses
    column, unit = (options.wheel_time_column, options.wheel_time_unit) if file == wheel_file else ("t", "s")
    column, unit = options.pose_time_column or column, options.pose_time_unit or unit
    keys = ("pose_time_column", "pose_columns")
    said = warnings if file != wheel_file else []  # of the same rows it was said
    table, times = _read(file, options, column, unit, options.pose_columns, keys, said)
    metres = _METRES[options.position_unit]
    heading = math.pi / 180 if options.heading_unit == "deg" else 1.0
    return times, table.columns(options.pose_columns) * (metres, metres, heading)


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
    separator = None if options.separator == _BLANKS else options.separator
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
