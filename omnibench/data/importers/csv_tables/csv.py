"""Importer of general CSV recordings: wheel rates, angles or ticks, and poses as CSV or in TUM format."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from omnibench.data.alignment import align
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.importer import Importer
from omnibench.data.importers.copied_reference import follows_the_wheels
from omnibench.data.importers.csv_tables.csv_options import CsvOptions
from omnibench.data.importers.csv_tables.run_files import find_runs
from omnibench.data.importers.csv_tables.table_streams import read_poses, read_wheels
from omnibench.data.importers.wheel_samples import WheelSamples
from omnibench.data.splits import divided
from omnibench.errors import DataError
from omnibench.registry import importers
from omnibench.words import plural

_SAME_TIME = 1e-6  # s; unix time in a double has steps of 0.2 us


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
            for name, files in find_runs(source, self.options).items()
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
        samples = read_wheels(wheel_file, self.options, warnings)
        pose_times, poses = read_poses(pose_file, wheel_file, self.options, warnings)
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
