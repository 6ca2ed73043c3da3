"""Importer of files with the quantities of Table 1 of Palacin et al. 2023: rpm, degrees, m or mm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from omnibench.data.clock_matching import align
from omnibench.data.dataset import SPLITS, Dataset, Split, Trajectory
from omnibench.data.delimited import NumberTable, read_numbers
from omnibench.data.importer import Importer
from omnibench.data.importers.recording_options import RecordingOptions, RobotOption
from omnibench.data.scans import Scanner, ScansInMemory, TrajectoryScans
from omnibench.data.splits import complete
from omnibench.errors import DataError
from omnibench.registry import importers
from omnibench.robot.kinematics import Array, Robot, Wheel
from omnibench.words import plural

RPM = 2 * math.pi / 60  # rad/s
_METRES = {"m": 1.0, "mm": 1e-3}
_COMMAND = ("v", "alpha", "omega", "d")
_POSE = ("t", "x", "y", "theta")
_SENT = ("t", "v", "alpha", "omega", "t_r")
_WAY_OUT = "set scanner={rays: 1080, angle_min: -2.356, ..., mount: {x: 0.1, y: 0, yaw: 0}} (m, rad)"

APR_02 = Robot(
    name="APR-02",
    wheels=tuple(
        Wheel(name=name, radius=0.148, distance=0.195, angle=math.radians(angle), roller_angle=0.0)
        for name, angle in (("a", 60), ("b", 180), ("c", 300))
    ),
)
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


class Table1Options(RecordingOptions):
    """Unit of positions, the robot, and which trajectories train and validate."""

    position_unit: Literal["m", "mm"] = Field("m", description="of x and y; Table 1 has m")
    robot: RobotOption = Field(APR_02, description="mapping as in dataset.yaml, or path of a YAML file; default APR-02")
    scanner: Scanner = Field(UTM_30LX, description="of lidar.csv: mapping as in dataset.yaml; default Hokuyo UTM-30LX")
    name: str = Field("table1", min_length=1, description="name of the data set")


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
        folders = [file.parent for file in sorted(source.rglob("command.csv"))]
        if not folders:
            raise DataError(
                f"{source}: no command.csv below it; Table 1 wants one folder a trajectory with command.csv"
            )
        scans: dict[str, TrajectoryScans] = {}
        runs = [self._trajectory(folder, _name(folder, source), scans) for folder in folders]
        train, validation = self.options.train, self.options.validation
        by_folder = None if train or validation else _splits_by_folder([run.id for run in runs])
        alike = [(run.session, run.command) for run in runs]
        runs = self.options.divided(complete(runs), otherwise=by_folder, alike=alike, kind="trajectory")
        if not scans:
            return self.options.dataset(runs)
        dataset = self.options.dataset(runs, ScansInMemory(self.options.scanner, scans))
        if self.options.scanner != UTM_30LX:
            return dataset
        unknown = (
            f"{source}: lidar.csv does not say where the LIDAR is mounted; the robot's middle is taken; {_WAY_OUT}"
        )
        return replace(dataset, warnings=(*dataset.warnings, unknown))

    def _trajectory(self, folder: Path, name: str, scans: dict[str, TrajectoryScans]) -> Trajectory:
        """The trajectory of a folder; its scans, if it has some, are added to ``scans``."""
        wheels = self.options.robot.wheel_names
        samples = read_numbers(folder / "wheels.csv", ("t", *(f"omega_{wheel}" for wheel in wheels)))
        slam = read_numbers(folder / "slam.csv", _POSE)
        target_names = [f"omega_M{wheel}" for wheel in wheels]
        table = read_numbers(folder / "command.csv", _COMMAND, optional=target_names)
        if len(table.values) != 1:
            raise DataError(
                f"{table.file}: it has {plural(len(table.values), 'row')}, expected one: the command of this trajectory"
            )
        v, degrees, omega, distance = (float(value) for value in table.columns(_COMMAND)[0])
        alpha, has_targets = math.radians(degrees), all(name in table for name in target_names)
        times, pose_times = _times(samples), _times(slam)
        metres = _METRES[self.options.position_unit]
        units = (metres, metres, math.radians(1))
        poses = slam.columns(_POSE[1:]) * units
        aligned = align(0.0, times, pose_times, poses)
        if aligned is None:
            raise DataError(
                f"{slam.file}: no two poses while the wheels were recorded (wheels end at t = {times[-1]:g})"
            )
        if (folder / "lidar.csv").exists():
            scans[name] = _read_scans(folder / "lidar.csv", self.options.scanner, aligned.zero, float(times[-1]))
        odometry = sent = None
        if (file := folder / "odometry.csv").exists():
            computed = read_numbers(file, _POSE)
            if not np.array_equal(computed.column("t"), times):
                raise DataError(f"{file}: its times t are not those of {samples.file.name}; give a row for each")
            odometry = (computed.columns(_POSE[1:]) * units)[aligned.after_start]
        if (file := folder / "commands.csv").exists():
            commands = read_numbers(file, _SENT)
            _times(commands)
            sent = commands.columns(_SENT) * (1, 1, math.radians(1), 1, 1) - (aligned.zero, 0, 0, 0, 0)
        times = times[aligned.after_start] - aligned.zero
        return Trajectory(
            id=name,
            split="train",
            times=times,
            rates=samples.values[aligned.after_start, 1:] * RPM,
            pose_times=aligned.pose_times,
            poses=aligned.poses,
            command=f"v{v:g}_a{math.degrees(alpha):g}_w{omega:g}_d{distance:g}",
            session=name.rsplit("/", 1)[0] if "/" in name else None,
            v=v,
            alpha=alpha,
            omega=omega,
            distance=distance,
            duration=float(times[-1]),
            odometry=odometry,
            sent=sent,
            targets=np.tile(table.columns(target_names)[0] * RPM, (len(times), 1)) if has_targets else None,
        )


def _read_scans(file: Path, scanner: Scanner, zero: float, end: float) -> TrajectoryScans:
    """The scans from ``zero`` to ``end``, s of the file's clock; stamps count from ``zero``, ranges in m."""
    columns = [f"d{ray}" for ray in range(1, scanner.rays + 1)]
    table = read_numbers(file, ("t", *columns), optional=[f"d{scanner.rays + 1}"])
    if len(table.names) > scanner.rays + 1:
        raise DataError(f"{file}: it has more than the {scanner.rays} ranges of the scanner; {_WAY_OUT}")
    times = _times(table)
    ranges = (table.columns(columns) * _METRES["mm"]).astype(np.float32)
    seen = scanner.valid(ranges)
    for row in np.flatnonzero(~seen.any(axis=1))[:1]:
        limits = f"{1e3 * scanner.range_min:g} to {1e3 * scanner.range_max:g} mm"
        raise table.fail(int(row), f"no range is from {limits}; give mm, and remove scans that saw nothing")
    shown = (times >= zero) & (times <= end)
    if not shown.any():
        raise DataError(f"{file}: no scan while poses and wheels were recorded, {zero:g} to {end:g} s")
    return TrajectoryScans(times[shown] - zero, np.where(seen, ranges, np.float32(np.inf))[shown])


def _times(table: NumberTable) -> Array:
    times = table.increasing("t")
    if times[0] < 0:
        raise table.fail(0, f"t is {times[0]:g}; times count from the start of the command and must not be negative")
    return times


def _name(folder: Path, source: Path) -> str:
    name = folder.relative_to(source).as_posix()
    return folder.resolve().name if name == "." else name


def _splits_by_folder(names: Sequence[str]) -> list[Split] | None:
    """The splits by folders called train and validation; None without such folders."""
    found = [next((split for split in SPLITS if split in name.split("/")), None) for name in names]
    splits = [split for split in found if split]
    if splits and len(splits) < len(names):
        stray = names[found.index(None)]
        raise DataError(f"trajectory {stray!r} is in no folder train or validation; move it or give train=PATTERN")
    return splits or None
