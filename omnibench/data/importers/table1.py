"""Importer of files with the quantities of Table 1 of Palacin et al. 2023: rpm, degrees, m or mm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field

from omnibench.data.dataset import SPLITS, Dataset, Split, every_second, repetitions
from omnibench.data.delimited import read_numbers
from omnibench.data.importer import Importer
from omnibench.data.recording import Notes, PoseReadings, Recording, RunAttributes, ScanReadings, WheelReadings
from omnibench.data.recording_options import METRES, RADIANS, HeadingUnit, ReferenceOptions, RobotOption, WheelUnit
from omnibench.data.runs import dataset_of
from omnibench.data.scans import Scanner
from omnibench.errors import DataError
from omnibench.registry import importers
from omnibench.robot.kinematics import Array, Robot
from omnibench.words import plural

_COMMAND = ("v", "alpha", "omega", "d")
_POSE = ("x", "y", "theta")
_SENT = ("v", "alpha", "omega", "t_r")
_WAY_OUT = "set scanner={rays: 1080, angle_min: -2.356, ..., mount: {x: 0.1, y: 0, yaw: 0}} (m, rad)"

_WHEELS = [
    {"name": name, "radius": 0.148, "distance": 0.195, "angle_deg": angle}
    for name, angle in (("a", 60), ("b", 180), ("c", 300))
]
APR_02 = Robot.model_validate({"name": "APR-02", "wheels": _WHEELS})
"""The design values behind Eq. (7)."""

UTM_30LX = Scanner(
    name="Hokuyo UTM-30LX",
    rays=1080,
    angle_min=math.radians(-135),
    angle_increment=math.radians(0.25),
    time_increment=0.025 / 1440,
    range_min=0.1,
    range_max=30.0,
)
"""The paper's LIDAR by its data sheet (270 degrees, 25 ms a turn), with 1080 of its 1081 ranges, as in Table 1."""


class Table1Options(ReferenceOptions):
    """The robot, the scanner, and the units of Table 1."""

    group: ClassVar[str] = "Table 1"

    robot: RobotOption = Field(APR_02, description="mapping as in dataset.yaml, or path of a YAML file; default APR-02")
    scanner: Scanner = Field(UTM_30LX, description="of lidar.csv: mapping as in dataset.yaml; default Hokuyo UTM-30LX")
    name: str = Field("table1", min_length=1, description="name of the data set")
    wheel_unit: WheelUnit = Field("rpm", description="of wheels.csv and of omega_Ma, ...; Table 1 has rpm")
    heading_unit: HeadingUnit = Field("deg", description="of theta; Table 1 has deg")


@importers.register("table1")
class Table1(Importer):
    """Quantities of Table 1 of Palacin et al. 2023, one folder a trajectory: rpm, degrees, m or mm.

    The source is any folder above trajectory folders, or one of them; each is found by its ``command.csv``:

        command.csv  one row: v (m/s), alpha (deg), omega (rad/s), d (m)[, omega_Ma, omega_Mb, omega_Mc (rpm)]
        wheels.csv   t (s), omega_a, omega_b, omega_c (rpm): a row holds the rates up to its t; rows start after 0
        slam.csv     t (s), x, y (m; ``position_unit: mm`` for mm), theta (deg): the ground truth, one row a scan
        odometry.csv t, x, y, theta as in slam.csv: what the robot computed, a row for each of wheels.csv. Optional.
        commands.csv t (s), v (m/s), alpha (deg), omega (rad/s), t_r (s): the commands that were sent. Optional.
        lidar.csv    t (s), d1, d2, ... d1080 (mm), counter-clockwise; 0: nothing was seen. It may be missing.

    Columns are separated by commas and named in a header; more columns do no harm. For another ``robot`` than the
    APR-02 the columns are omega_<wheel> and omega_M<wheel>; ``scanner`` describes another LIDAR, and where it is
    mounted. Odometry and sent commands are kept with the run, and no fit uses them. A first pose later than the
    first wheel sample becomes t = 0.

    A trajectory is called by its folder, seen from the source; its session is the folder above. Repetitions share
    session and (v, alpha, omega, d). Splits: by ``train`` and ``validation`` (patterns such as ``training/*``); without
    them by folders called train and validation, and without these every second repetition validates.
    """

    Options = Table1Options
    options: Table1Options

    def read(self, source: Path) -> Dataset:
        """All trajectories under ``source``; DataError names the file and the row of what is wrong."""
        notes = list[str]()
        return dataset_of(self.recordings(source, notes), self.options, notes)

    def recordings(self, source: Path, notes: Notes) -> list[Recording]:
        """The trajectories under ``source`` as they stand in their tables."""
        options = self.options
        folders = [file.parent for file in sorted(source.rglob("command.csv"))]
        if not folders:
            raise DataError(f"{source}: no command.csv below it; each trajectory is a folder with one")
        recordings = [_recording(folder, source, options) for folder in folders]
        if options.scanner == UTM_30LX and any(recording.scans for recording in recordings):
            unknown = "lidar.csv does not say where the LIDAR is mounted; the robot's middle is taken"
            notes.append(f"{source}: {unknown}; {_WAY_OUT}")
        # Splits by folders called train and validation, else every second repetition validates.
        attributes = [recording.attributes for recording in recordings]
        alike = [(said.session, said.command) for said in attributes]
        splits: list[Split | None] = [said.split for said in attributes]
        if not any(splits) or options.train or options.validation:
            splits = list(every_second(alike))
        if None in splits:
            stray = recordings[splits.index(None)].name
            raise DataError(f"trajectory {stray!r} is in no folder train or validation; move it or give train=PATTERN")
        rows = zip(recordings, attributes, splits, repetitions(alike), strict=True)
        return [replace(each, attributes=replace(said, split=side, repetition=at)) for each, said, side, at in rows]


def _recording(folder: Path, source: Path, options: Table1Options) -> Recording:
    """The trajectory of a folder, which is called by it as seen from the source."""
    name = folder.relative_to(source).as_posix()
    name = folder.resolve().name if name == "." else name
    wheels, targets = ([f"omega_{prefix}{wheel}" for wheel in options.robot.wheel_names] for prefix in ("", "M"))
    table = read_numbers(folder / "command.csv", _COMMAND)
    if len(table) != 1:
        raise DataError(f"{table.file}: it has {plural(len(table), 'row')}, expected one: the trajectory's command")
    v, alpha, omega, distance = table.columns(_COMMAND)[0].tolist()
    times, rates = _timed(folder / "wheels.csv", wheels)
    pose_times, poses = _timed(folder / "slam.csv", _POSE)
    others: dict[str, Array] = {}
    if all(target in table for target in targets):
        factors = options.wheel_factors(options.wheel_unit)
        others["targets"] = np.tile(table.columns(targets)[0] * factors, (len(times), 1))
    if (file := folder / "odometry.csv").exists():
        stamps, odometry = _timed(file, _POSE)
        if not np.array_equal(stamps, times):
            raise DataError(f"{file}: its times t are not those of wheels.csv; give a row for each")
        metre = METRES[options.position_unit]
        others["odometry"] = odometry * (metre, metre, RADIANS[options.heading_unit])
    sent = scans = None
    if (file := folder / "commands.csv").exists():
        sent = np.column_stack(_timed(file, _SENT)) * (1, 1, RADIANS["deg"], 1, 1)
    if (file := folder / "lidar.csv").exists():
        scans = _scans(file, options.scanner, float(pose_times[0]), float(times[-1]))
    command, session = f"v{v:g}_a{alpha:g}_w{omega:g}_d{distance:g}", name.rpartition("/")[0] or None
    split = next((split for split in SPLITS if split in name.split("/")), None)
    numbers = {"v": v, "alpha": math.radians(alpha), "omega": omega, "distance": distance}
    attributes = RunAttributes(command, split=split, session=session, numbers=numbers, sent=sent)
    readings = WheelReadings(times, rates, options.wheel_unit, begin=0.0, others=others)
    place = str(folder / "slam.csv")
    return Recording(name, place, readings, PoseReadings(pose_times, poses), attributes=attributes, scans=scans)


def _timed(file: Path, columns: Sequence[str]) -> tuple[Array, Array]:
    """Times (F,), s, and columns (F, n) of a file."""
    table = read_numbers(file, ("t", *columns))
    times = table.increasing("t")
    if times[0] < 0:
        raise table.fail(0, f"t is {times[0]:g}; times count from the start of the command and must not be negative")
    return times, table.columns(columns)


def _scans(file: Path, scanner: Scanner, begin: float, end: float) -> ScanReadings:
    """The scans of a file. DataError: it does not fit the scanner, or none is from ``begin`` to ``end``, s."""
    columns = [f"d{ray}" for ray in range(1, scanner.rays + 1)]
    table = read_numbers(file, ("t", *columns))
    if f"d{scanner.rays + 1}" in table:
        raise DataError(f"{file}: it has more than the {scanner.rays} ranges of the scanner; {_WAY_OUT}")
    times = table.increasing("t")
    ranges = (table.columns(columns) * METRES["mm"]).astype(np.float32)
    seen = scanner.valid(ranges)
    for row in np.flatnonzero(~seen.any(axis=1))[:1]:
        limits = f"{1e3 * scanner.range_min:g} to {1e3 * scanner.range_max:g} mm"
        raise table.fail(int(row), f"no range is from {limits}; give mm, and remove scans that saw nothing")
    if not ((times >= begin) & (times <= end)).any():
        raise DataError(f"{file}: no scan while poses and wheels were recorded, {begin:g} to {end:g} s")
    ranges = np.where(seen, ranges, np.float32(np.inf))
    return ScanReadings(scanner, str(file), times, lambda rows: ranges[rows])
