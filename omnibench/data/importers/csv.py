"""Importer of general CSV recordings: wheel rates, angles or ticks, and poses as CSV or in TUM format."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from omnibench.config import Positive
from omnibench.data.alignment import align, median_period
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.delimited import read_numbers
from omnibench.data.importer import Importer
from omnibench.data.importers.recording_options import RecordingOptions
from omnibench.data.importers.tum import read_tum
from omnibench.data.splits import Names, divided
from omnibench.errors import DataError
from omnibench.registry import importers
from omnibench.robot.kinematics import Array
from omnibench.words import plural

TimeUnit = Literal["s", "ms", "us", "ns"]
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_RADIANS = {
    "rad/s": 1.0,
    "deg/s": math.pi / 180,
    "rpm": 2 * math.pi / 60,
    "rad": 1.0,
    "deg": math.pi / 180,
    "ticks": 2 * math.pi,
    "ticks/sample": 2 * math.pi,
}
_PREFIX = {"rad": "phi_", "deg": "phi_", "ticks": "ticks_", "ticks/sample": "ticks_"}
_POSE_SUFFIXES = ("_poses.csv", "_poses.tum")


class CsvOptions(RecordingOptions):
    """Names of files and columns, units, the robot, and which runs train and validate."""

    name: str = Field("csv", min_length=1, description="name of the data set")
    wheel_unit: Literal["rad/s", "deg/s", "rpm", "rad", "deg", "ticks", "ticks/sample"] = Field(
        "rad/s", description="rates (.../s, rpm), absolute angles (rad, deg, ticks) or increments (ticks/sample)"
    )
    ticks_per_turn: Positive | None = Field(None, description="of the wheel, gear included")
    wheel_wrap: Positive | None = Field(None, description="absolute angles start again after this many wheel_unit")
    wheel_columns: Names = Field((), description="in the robot's order; default omega_, phi_ or ticks_ <wheel>")
    wheel_signs: tuple[Literal[1, -1], ...] = Field((), description="-1 for wheels that count the other way round")
    wheel_time_column: str = "t"
    wheel_time_unit: TimeUnit = "s"
    pose_columns: Names = Field(("x", "y", "theta"), description="of CSV poses")
    pose_time_column: str = Field("t", description="of CSV poses")
    pose_time_unit: TimeUnit = Field("s", description="of CSV poses; TUM has s")
    position_unit: Literal["m", "cm", "mm"] = Field("m", description="of CSV poses; TUM has m")
    heading_unit: Literal["rad", "deg"] = Field("rad", description="of CSV poses")
    separator: str = Field(",", min_length=1, max_length=1)
    wheel_suffix: str = Field("_wheels.csv", min_length=1, description="what follows a run's name")
    pose_suffix: str | None = Field(None, min_length=1, description=f"default: {' or '.join(_POSE_SUFFIXES)}")
    command_pattern: str | None = Field(
        None, description="regular expression: its group 1 in a run's name is the command"
    )

    @model_validator(mode="after")
    def _fits_together(self) -> CsvOptions:
        wheels = len(self.robot.wheels)
        if self.wheel_unit.startswith("ticks") and self.ticks_per_turn is None:
            raise ValueError(f"wheel_unit {self.wheel_unit} needs ticks_per_turn (of the wheel, gear included)")
        if self.ticks_per_turn is not None and not self.wheel_unit.startswith("ticks"):
            raise ValueError(f"ticks_per_turn is for wheel_unit ticks or ticks/sample, not for {self.wheel_unit}")
        if self.wheel_wrap is not None and self.wheel_unit not in ("rad", "deg", "ticks"):
            raise ValueError(f"wheel_wrap is for absolute angles (rad, deg, ticks), not for {self.wheel_unit}")
        for key, allowed in (("wheel_columns", (0, wheels)), ("wheel_signs", (0, wheels)), ("pose_columns", (3,))):
            given = len(getattr(self, key))
            if given not in allowed:
                raise ValueError(f"{key} has {plural(given, 'value')}, expected {allowed[-1]}")
        if self.command_pattern is not None:
            try:
                groups = re.compile(self.command_pattern).groups
            except re.error as error:
                raise ValueError(f"command_pattern is not a regular expression: {error}") from None
            if groups < 1:
                raise ValueError("command_pattern needs a group in parentheses, for example '^(.*)_rep'")
        return self

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the wheels."""
        prefix = _PREFIX.get(self.wheel_unit, "omega_")
        return self.wheel_columns or tuple(prefix + wheel for wheel in self.robot.wheel_names)

    @property
    def radians(self) -> float:
        """Factor from the wheels' unit to rad or rad/s."""
        return _RADIANS[self.wheel_unit] / (self.ticks_per_turn or 1.0)


@importers.register("csv")
class Csv(Importer):
    """CSV files of any robot: for each run ``<run>_wheels.csv`` and ``<run>_poses.csv`` or ``<run>_poses.tum``.

    The source is a folder, searched with its subfolders; ``robot`` (a YAML file or a mapping) is the only option that
    must be given. Defaults: columns t (s), omega_<wheel> (rad/s) in wheels, t (s), x, y (m), theta (rad) in poses; TUM
    files have ``timestamp tx ty tz qx qy qz qw``. CSV columns are named in a header, in any order and among others.

    wheels: with rates a row holds the mean rates since the row before (its first one: since a sample period before).
    With angles or ticks the first row only gives the start of counting. They must count on, or ``wheel_wrap`` gives the
    value after which they start again (65536 ticks, 360 deg). A positive rate drives the robot counter-clockwise;
    ``wheel_signs: [-1, 1, 1]`` turns a wheel round.

    times: both files of a run by one clock, in any epoch (unix time, say). t = 0 becomes the first pose, or, where
    poses begin before the wheels, the begin of the wheels with the pose interpolated. Poses after the last wheel sample
    are left out.

    Splits: ``train`` and ``validation`` are patterns of run names (``day2/*``); with one of them all other runs go to
    the other side, with both the runs in neither are left out, with none every second run of a command validates. Runs
    share a command by ``command_pattern``; without it nothing is known of repetitions.
    """

    Options = CsvOptions
    options: CsvOptions

    def read(self, source: Path) -> Dataset:
        """All runs under ``source``; DataError names the file and the row of what is wrong."""
        files = _find_runs(source, self.options)
        runs = [self._read_run(name, *pair) for name, pair in files.items()]
        return self.options.dataset(divided(runs, self.options.train, self.options.validation))

    def _read_run(self, name: str, wheel_file: Path, pose_file: Path) -> Trajectory:
        wheels = _read_wheels(wheel_file, self.options)
        pose_times, poses = _read_poses(pose_file, self.options)
        aligned = align(wheels.begin, wheels.times, pose_times, poses)
        if aligned is None:
            raise DataError(
                f"{pose_file}: no two poses while the wheels were recorded (poses {pose_times[0]:.10g} to "
                f"{pose_times[-1]:.10g} s, wheels {wheels.begin:.10g} to {wheels.times[-1]:.10g} s); check time units"
            )
        times = wheels.times[aligned.kept] - aligned.zero
        pattern = self.options.command_pattern
        match = re.search(pattern, name) if pattern else None
        return Trajectory(
            id=name,
            split="train",
            times=times,
            rates=wheels.rates[aligned.kept],
            pose_times=aligned.pose_times,
            poses=aligned.poses,
            command=match.group(1) if match else None,
            duration=float(times[-1]),
            angles=None if wheels.angles is None else wheels.angles[aligned.kept],
        )


@dataclass(frozen=True, eq=False)
class _Wheels:
    """Wheel samples. begin: of the first sample, s. times (F,): ends, s. rates (F, N): rad/s. angles (F, N): rad."""

    begin: float
    times: Array
    rates: Array
    angles: Array | None


def _find_runs(source: Path, options: CsvOptions) -> dict[str, tuple[Path, Path]]:
    suffixes = (options.pose_suffix,) if options.pose_suffix else _POSE_SUFFIXES
    wheels = {_run_name(file, source, options.wheel_suffix): file for file in source.rglob(f"*{options.wheel_suffix}")}
    poses = {
        _run_name(file, source, suffix): file for suffix in suffixes for file in sorted(source.rglob(f"*{suffix}"))
    }
    if not wheels:
        raise DataError(
            f"{source}: no *{options.wheel_suffix} below it; name the folder of the runs, or set wheel_suffix"
        )
    for name in sorted(wheels):
        if name not in poses:
            raise DataError(f"{wheels[name]}: run {name!r} has no {' or '.join(name + suffix for suffix in suffixes)}")
    for name in sorted(poses):
        if name not in wheels:
            raise DataError(f"{poses[name]}: run {name!r} has no {name}{options.wheel_suffix}")
    return {name: (wheels[name], poses[name]) for name in sorted(wheels)}


def _run_name(file: Path, source: Path, suffix: str) -> str:
    return file.relative_to(source).as_posix().removesuffix(suffix)


def _read_wheels(file: Path, options: CsvOptions) -> _Wheels:
    table = read_numbers(file, (options.wheel_time_column, *options.columns), separator=options.separator)
    times = table.increasing(options.wheel_time_column) * _SECONDS[options.wheel_time_unit]
    values = table.columns(options.columns) * (options.wheel_signs or 1) * options.radians
    if options.wheel_unit in ("rad/s", "deg/s", "rpm"):
        period = options.sample_period or (median_period([times]) if len(times) > 1 else float(times[0]))
        return _Wheels(float(times[0]) - period, times, values, None)
    if len(times) < 2:
        raise DataError(f"{file}: angles and ticks need two rows or more")
    driven = values[1:]
    if options.wheel_unit != "ticks/sample":
        driven = np.diff(values, axis=0)
        if options.wheel_wrap is not None:
            turn = options.wheel_wrap * options.radians
            driven = driven - turn * np.round(driven / turn)
    angles = None if options.wheel_unit == "ticks/sample" else values[0] + np.cumsum(driven, axis=0)
    return _Wheels(float(times[0]), times[1:], driven / np.diff(times)[:, None], angles)


def _read_poses(file: Path, options: CsvOptions) -> tuple[Array, Array]:
    if file.suffix == ".tum":
        track = read_tum(file)
        return track.times, track.poses
    table = read_numbers(file, (options.pose_time_column, *options.pose_columns), separator=options.separator)
    metres = _METRES[options.position_unit]
    heading = math.pi / 180 if options.heading_unit == "deg" else 1.0
    times = table.increasing(options.pose_time_column) * _SECONDS[options.pose_time_unit]
    return times, table.columns(options.pose_columns) * (metres, metres, heading)
