"""Importer of general CSV recordings: wheel rates, angles or ticks, and poses, in one table, two or three.

A table of runs may give the command, repetition, split and session of each.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from omnibench.data.dataset import SPLITS, Dataset, Split, Trajectory
from omnibench.data.delimited import row_error
from omnibench.data.importer import Importer
from omnibench.data.importers.copied_reference import follows_the_wheels
from omnibench.data.importers.csv_tables.csv_options import CsvOptions, run_column
from omnibench.data.importers.csv_tables.table_recordings import (
    RUN_TABLES,
    file_called,
    find_tables,
    load,
    read_recordings,
)
from omnibench.data.importers.runs.recorded_streams import RecordedStreams, by_one_clock
from omnibench.data.importers.runs.recording_runs import recording_runs
from omnibench.errors import DataError, nearest
from omnibench.registry import importers
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_TEXTS, _NUMBERS = ("command", "split", "session"), ("repetition", "started_at")


@dataclass(frozen=True)
class RunAttributes:
    """What a table of runs says of one; None where it says nothing."""

    command: str | None = None
    repetition: int | None = None
    split: Split | None = None
    session: str | None = None
    started_at: float | None = None


def read_run_attributes(source: Path, options: CsvOptions, warnings: list[str]) -> dict[str, RunAttributes]:
    """The attributes of each run by its name; empty without a table of runs. DataError names the row of a flaw."""
    file = options.runs_table or file_called(
        source if source.is_dir() else source.parent, RUN_TABLES, other_than=source
    )
    if file is None:
        return {}
    table = load(file, options).in_lower_case()
    named = run_column(options, table)
    if named is None:
        raise DataError(f"{file}: column 'run' is missing; found: {', '.join(table.names)}; --set run_column=NAME")
    known = [key for key in (*_TEXTS, *_NUMBERS) if key not in table.names]
    others = [name for name in table.names if name not in (named, *_TEXTS, *_NUMBERS)]
    alike = {name: hint.strip() for name in others if (hint := nearest(name, known))}
    warnings.extend(f"{file}: column {name!r} is not read; {hint}" for name, hint in alike.items())
    texts = {key: table.texts(key) for key in _TEXTS if key in table.names}
    numbers = {key: table.numbers([key])[:, 0] for key in _NUMBERS if key in table.names}
    attributes: dict[str, RunAttributes] = {}
    for row, run in enumerate(table.texts(named)):
        split = texts["split"][row] if "split" in texts else None
        if split is not None and split not in SPLITS:
            what = f"split is {split!r}; {nearest(split, SPLITS)}it must be train or validation"
            raise row_error(file, row, int(table.lines[row]), what)
        if run in attributes:
            raise row_error(file, row, int(table.lines[row]), f"run {run!r} is there twice")
        repetition, started_at = (_number(numbers.get(key), row) for key in _NUMBERS)
        attributes[run] = RunAttributes(
            command=texts["command"][row] or None if "command" in texts else None,
            repetition=None if repetition is None else round(repetition),
            split=split,
            session=texts["session"][row] or None if "session" in texts else None,
            started_at=started_at,
        )
    return attributes


def check_names(attributes: Collection[str], runs: Collection[str], warnings: list[str]) -> None:
    """Check that a table of runs lists the runs that there are. DataError names one that is missing."""
    if not attributes:
        return
    for run in runs:
        if run not in attributes:
            raise DataError(
                f"the table of runs does not list run {run!r}; {nearest(run, attributes)}it has: "
                f"{', '.join(list(attributes)[:12])}"
            )
    extra = [run for run in attributes if run not in runs]
    if extra:
        warnings.append(f"the table of runs lists runs that have no samples: {', '.join(extra[:12])}")


def _number(numbers: np.ndarray | None, row: int) -> float | None:
    return None if numbers is None or np.isnan(numbers[row]) else float(numbers[row])


_NUMBERED = re.compile(r"[_-]?\d+$")
_PATTERN = r"^(.*?)[_-]?\d+$"
_FAR = 100.0  # times; wheels' and poses' times that last so differently are in other units; chosen


@importers.register("csv")
class Csv(Importer):
    """CSV tables of any robot, with wheel rates, angles or ticks, and reference poses.

    The source is a folder, searched with its subfolders, or one file. Its tables are told by their names and headers:

        a pair a run   <run>_wheels.csv and <run>_poses.csv (or _poses.tum); or a folder a run, wheels.csv and poses.csv
        a table a run  any tables whose header holds columns of wheels and of poses
        one table      the same with a column run, which names the run of each row
        three tables   wheels.csv and poses.csv, both with a column run, and runs.csv with run, command, repetition,
                       split, session (each optional; runs.csv may stand beside any other tables, too)
        references     <run>_references.csv, or references.csv with a column run, beside poses or in their place

    ``robot`` (a YAML file or a mapping; robot.yaml in the source is found) is the only option that must be given; with
    ``omnibench import csv --template DIR`` come tables and a robot to fill in. Columns are named in a header, in any
    order and among others, or counted from 1. Defaults: t (s), omega_<wheel> (rad/s), steer_<wheel> (rad), x, y (m),
    theta (rad); ``columns`` takes any other names, ``..._unit`` other units. Commas, semicolons or tabs separate
    them, Parquet files hold the same. Where wheels and poses stand in the same rows, cells without a sample are blank.

    wheels: with rates a row holds the mean rates since the row before (its first one: since a sample period before).
    With positions or increments the first row only gives the start of counting. Counters that begin again are counted
    on where they can be recognised, or ``wraps_at`` gives the value (65536, 2^32, 360 deg). ``gear_ratio`` is for
    encoders at the motor. A run ends where positions begin anew. The sense of a positive rate is in ``omnibench guide
    conventions``; ``wheel_signs: [-1, 1, 1]`` turns a wheel round. Steering angles are those at the rows' times.

    references: what was measured without motion capture, a row each with its kind (distance, turn, displacement,
    position, heading), value or value_x and value_y, sigma (or sigma_x, sigma_y), and t0 and t1, which are empty for
    the whole run (``omnibench guide references``). The options of unit, sign and time of the poses hold for them, too.

    times: in any epoch (unix time, say), wheels and poses by one clock, or ``clocks=match`` finds what is between them.
    t = 0 becomes the first pose, or, where poses begin before the wheels, the begin of the wheels with the pose
    interpolated. Poses after the last wheel sample are left out, and so are rows that repeat a time.

    Splits: ``train`` and ``validation`` are patterns of run names (``day2/*``); with one of them all other runs go to
    the other side, with both the runs in neither are left out, with none the table of runs says it, or every second run
    of a command validates. Runs share a command by the table of runs or by ``command_pattern``; without them nothing is
    known of repetitions. The runs that a recording is cut into are called ``<run>#1``, ``<run>#2`` ...
    """

    Options = CsvOptions
    options: CsvOptions

    def read(self, source: Path) -> Dataset:
        """All runs under ``source``; DataError names the file and the row of what is wrong."""
        options, warnings = self.options, list[str]()
        recordings = read_recordings(find_tables(source, options, warnings), options, warnings)
        attributes = read_run_attributes(source, options, warnings)
        check_names(attributes, [recording.name for recording in recordings], warnings)
        recordings = by_one_clock(recordings, options, warnings)
        runs = [run for recording in recordings for run in self._runs(recording, attributes, warnings)]
        if not runs:
            raise DataError(
                f"{source}: no run stands still before it drives, so that start_at_rest leaves none; leave that option "
                "out, and record from a standstill"
            )
        splits = [run.split for run in runs] if any(each.split for each in attributes.values()) else None
        numbers = {run.id: run.repetition for run in runs if run.repetition is not None}
        divided = [
            replace(run, repetition=numbers.get(run.id, run.repetition))
            for run in options.divided(runs, otherwise=splits)
        ]
        dataset = options.dataset(divided)
        warnings += _unsaid_commands([recording.name for recording in recordings], dataset)
        if (residual := follows_the_wheels(dataset.trajectories)) is not None:
            warnings.append(
                "the reference is the robot's odometry, or simulated without noise: some matrix makes its headings of "
                f"the wheels to {residual:.1g} rad a second; if it is odometry, name the columns of an independent one "
                '(--set "columns={x: NAME, y: NAME, theta: NAME}")'
            )
        return replace(dataset, warnings=(*warnings, *dataset.warnings))

    def _runs(
        self, recording: RecordedStreams, attributes: Mapping[str, RunAttributes], warnings: list[str]
    ) -> list[Trajectory]:
        name, options, samples, reference = recording.name, self.options, recording.samples, recording.reference
        match = re.search(options.command_pattern, name) if options.command_pattern else None
        said = attributes.get(name, RunAttributes())
        whole = Trajectory(
            id=name,
            split=said.split or "train",
            times=samples.ends,
            rates=samples.rates,
            pose_times=reference.times,
            poses=reference.poses,
            command=match.group(1) if match else said.command,
            repetition=said.repetition,
            session=said.session,
            started_at=said.started_at,
        )
        runs = recording_runs(whole, samples, reference, options, warnings, recording.place, options.window)
        if not runs and options.start_at_rest and len(_poses_within(recording)) > 1:
            warnings.append(f"{name}: left out: it never stands still before it drives (start_at_rest)")
        elif not runs:
            raise _apart(recording, options.pose_time_offset)
        return [run.trajectory for run in runs]


def _unsaid_commands(names: Sequence[str], dataset: Dataset) -> list[str]:
    """A word on commands that the names of runs seem to say, where nothing else does: ``left_1``, ``left_2`` ..."""
    stems = Counter(_NUMBERED.sub("", name) for name in names)
    said = any(run.command for run in dataset.trajectories)
    if said or len(stems) < 2 or min(stems.values()) < 2 or "" in stems:
        return []
    return [
        f"names such as {names[0]} look like repetitions of {plural(len(stems), 'command')}; if they are, say --set "
        f"'command_pattern={_PATTERN}', since noise is known from repetitions"
    ]


def _poses_within(recording: RecordedStreams) -> Array:
    """Times of the poses while the wheels were recorded, s."""
    samples, times = recording.samples, recording.reference.times
    return times[(times >= samples.begins[0]) & (times <= samples.ends[-1])]


def _apart(recording: RecordedStreams, offset: float) -> DataError:
    """The error of wheels and poses that share no time. offset: that was added to the poses' times, s."""
    samples, times = recording.samples, recording.reference.times
    if len(times) < 2 and recording.reference.measured is not None:
        return DataError(
            f"{recording.place}: none of its references lies within its wheels' samples, {samples.begins[0]:.10g} to "
            f"{samples.ends[-1]:.10g} s; times count by the wheels' clock (--set pose_time_unit=ms, pose_time_offset=S)"
        )
    for what, count in (("poses", len(times)), ("wheels", len(samples.ends))):
        if count < 2:
            return DataError(f"{recording.place}: {what}: has one row; two are needed, or the run is no run")
    spans = f"poses {times[0]:.10g} to {times[-1]:.10g} s, wheels {samples.begins[0]:.10g} to {samples.ends[-1]:.10g} s"
    share = (times[-1] - times[0]) / (samples.ends[-1] - samples.begins[0])
    shift = offset + samples.begins[0] - times[0]
    way = f"of clocks apart that begin together: --set pose_time_offset={shift:.10g} --set clocks=match"
    if share > _FAR:
        way = "the poses' times look like ms: --set pose_time_unit=ms (or us, ns)"
    elif share < 1 / _FAR:
        way = "the wheels' times look like ms: --set wheel_time_unit=ms (or us, ns)"
    return DataError(f"{recording.place}: no two poses while the wheels were recorded ({spans}); {way}")
