"""Importer of general CSV recordings: wheel rates, angles or ticks, and poses as CSV or in TUM format."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.importer import Importer
from omnibench.data.importers.copied_reference import follows_the_wheels
from omnibench.data.importers.csv_tables.csv_options import CsvOptions
from omnibench.data.importers.csv_tables.run_files import find_runs
from omnibench.data.importers.csv_tables.table_streams import read_poses, read_wheels
from omnibench.data.importers.runs.recorded_streams import RecordedStreams, by_one_clock
from omnibench.data.importers.runs.recording_runs import recording_runs
from omnibench.errors import DataError
from omnibench.registry import importers


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
        files = find_runs(source, self.options)
        recordings = [self._read(name, *tables, warnings) for name, tables in files.items()]
        recordings = by_one_clock(recordings, self.options, warnings)
        runs = [run for recording in recordings for run in self._runs(recording, warnings)]
        dataset = self.options.dataset(self.options.divided(runs))
        if (residual := follows_the_wheels(dataset.trajectories)) is not None:
            warnings.append(
                "the reference is the robot's odometry, or simulated without noise: some matrix makes its headings of "
                f"the wheels to {residual:.1g} rad a second; if it is odometry, name the columns of an independent one"
            )
        return replace(dataset, warnings=(*warnings, *dataset.warnings))

    def _read(self, name: str, wheel_file: Path, pose_file: Path, warnings: list[str]) -> RecordedStreams:
        samples = read_wheels(wheel_file, self.options, warnings)
        return RecordedStreams(name, str(pose_file), samples, read_poses(pose_file, wheel_file, self.options, warnings))

    def _runs(self, recording: RecordedStreams, warnings: list[str]) -> list[Trajectory]:
        name, options, samples, reference = recording.name, self.options, recording.samples, recording.reference
        match = re.search(options.command_pattern, name) if options.command_pattern else None
        command = match and match.group(1)
        whole = Trajectory(name, "train", samples.ends, samples.rates, reference.times, reference.poses, command)
        runs = recording_runs(whole, samples, reference, options, warnings, recording.place, options.window)
        if not runs:
            raise DataError(
                f"{recording.place}: no two poses while the wheels were recorded (poses {reference.times[0]:.10g} to "
                f"{reference.times[-1]:.10g} s, wheels {samples.begins[0]:.10g} to {samples.ends[-1]:.10g} s); check "
                "time units"
            )
        return [run.trajectory for run in runs]
