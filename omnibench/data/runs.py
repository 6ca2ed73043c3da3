"""Runs of recordings: wheels in SI units and the robot's senses, references by the wheels' clock, cut where asked.

Everything is decided for all recordings together: ranges of counters, the clocks' coefficients, commands and splits.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from omnibench.data.aligned import aligned_recordings
from omnibench.data.clock_matching import usual_period
from omnibench.data.cutting import MadeRun, cut_into_runs
from omnibench.data.dataset import SPLITS, Dataset, Trajectory, make_dataset
from omnibench.data.recording import Recording, ReferenceOptions, WheelReadings, scan_difference
from omnibench.data.scans import Scans
from omnibench.data.scratch import Scratch, StoredSequence
from omnibench.data.splits import complete, divided, every_second, remaining
from omnibench.errors import DataError
from omnibench.robot.kinematics import Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.samples import Samples
from omnibench.words import some

_NUMBER = re.compile(
    r"(?:run|trial|exp|experiment|test|take|rep|repetition|drive|log|bag|recording|traj|trajectory)?\d*"
)


def dataset_of(
    recordings: Sequence[Recording], options: ReferenceOptions, notes: list[str], *, simulated: bool = False
) -> Dataset:
    """The data set of the runs of recordings. DataError in one line: no run is left, or a unit cannot be right.

    notes: what was left out, mended or decided is added; the data set's warnings hold it.
    """
    scratch = Scratch() if isinstance(recordings, StoredSequence) else None
    runs, cuts, referenced = list[MadeRun](), list[str](), True
    for aligned in aligned_recordings(recordings, options, notes):
        referenced &= aligned.recording.referenced
        made = cut_into_runs(aligned, options, cuts, alone=len(recordings) == 1)
        runs += made if scratch is None else [_in_file(run, scratch) for run in made]
    notes += cuts
    if not runs:
        raise DataError(f"{notes[-1] if notes else recordings[0].place}; nothing is left")
    trajectories = complete([run.trajectory for run in runs])
    trajectories = divided_runs(with_commands(trajectories, options, notes), runs, options, notes)
    kept = {run.id for run in trajectories}
    scans = _scans_of([run for run in runs if run.trajectory.id in kept])
    period = options.sample_period or usual_period(run.times for run in trajectories)
    dataset = make_dataset(
        options.name, options.robot, period, trajectories,
        description=options.description, source=options.source, licence=options.licence,
        simulated=simulated, scans=scans,
    )  # fmt: skip
    if referenced:
        return replace(dataset, warnings=(*notes, *dataset.warnings))
    # In the place of poses that are yet to be made stands the design's odometry, from (0, 0, 0) on.
    logs = [run.log(run.pose_times) for run in dataset.trajectories]
    poses = OdometryModel.of_design(options.robot, "arc").poses(logs)
    placed = [replace(run, poses=driven) for run, driven in zip(dataset.trajectories, poses, strict=True)]
    return replace(dataset, trajectories=tuple(placed), referenced=False, warnings=tuple(notes))


def _in_file(run: MadeRun, scratch: Scratch) -> MadeRun:
    """The run with its wheel samples in a temporary file, and without the readings that it was made of."""
    held, recording = run.trajectory.samples, run.recording
    arrays = {name: None if array is None else scratch.stored(array) for name, array in held.contents().items()}
    trajectory = replace(run.trajectory, samples=Samples(arrays, (held.count, held.end)))
    none = WheelReadings(np.empty(0), np.empty((0, 0)), recording.wheels.unit)
    return replace(run, trajectory=trajectory, recording=replace(recording, wheels=none, poses=None, measured=None))


def with_commands(runs: Sequence[Trajectory], options: ReferenceOptions, notes: list[str]) -> list[Trajectory]:
    """The runs with the commands that their names say, by ``command_pattern`` or by the words before their numbers."""
    if options.command_pattern:
        matches = [re.search(options.command_pattern, run.id.partition("#")[0]) for run in runs]
        return [replace(run, command=match[1]) if match else run for run, match in zip(runs, matches, strict=True)]
    if any(run.command for run in runs):
        return list(runs)
    if options.cutting == "rests" and any(sent := [_sent_command(run) for run in runs]):
        notes.append(f"commands by the twists that were sent (cmd_vel): {some(sorted(set(filter(None, sent))))}")
        return [replace(run, command=command) for run, command in zip(runs, sent, strict=True)]
    words = [_command_in(run.id.partition("#")[0]) for run in runs]
    counts = Counter(words)
    if "" in counts or len(counts) < 2 or min(counts.values()) < 2:
        return list(runs)
    notes.append(f"commands by the names of the runs: {some(list(counts))} (other: --set command_pattern=PATTERN)")
    return [replace(run, command=word) for run, word in zip(runs, words, strict=True)]


def _sent_command(run: Trajectory) -> str | None:
    """The twist that was sent for most of the time in which any was, as ``v0.3_w0.6``; None without such a one."""
    spans: Counter[str] = Counter()
    for begin, v, alpha, turn, valid in () if run.sent is None else run.sent.tolist():
        x, y, w = (round(value, 2) + 0.0 for value in (v * np.cos(alpha), v * np.sin(alpha), turn))
        if x or y or w:
            command = f"v{x:g}{f'_y{y:g}' if y else ''}_w{w:g}"
            spans[command] += max(min(begin + valid, float(run.times[-1])) - max(begin, 0.0), 0.0)
    command, longest = max(spans.items(), key=lambda pair: pair[1], default=("", 0.0))
    return command if longest > spans.total() / 2 else None


def _command_in(name: str) -> str:
    """The words of a run's name that are no numbers: ``circleL`` of ``run03_circleL``, ``left`` of ``day1/left_2``."""
    parts = [
        [word for word in re.split(r"[-_ .]+", part) if not _NUMBER.fullmatch(word.lower())] for part in name.split("/")
    ]
    return "_".join(next((words for words in reversed(parts) if words), []))


def divided_runs(
    runs: Sequence[Trajectory], made: Sequence[MadeRun], options: ReferenceOptions, notes: list[str]
) -> list[Trajectory]:
    """The runs with their splits and the numbers of their repetitions, without those that are left out.

    Without patterns and without splits in the source every second run of a command validates, and of runs without a
    command every second one that moves alike: to the same side, ahead or back.
    """
    source = {run.trajectory.id: run for run in made}
    if options.leave_out:
        names = remaining([run.id for run in runs], options.leave_out, "run")
        runs = [run for run in runs if run.id in names]
    motions = {run.id: motion_of(options.robot, run) for run in runs}
    splits = [run.split for run in runs]
    if not any(source[run.id].recording.attributes.split for run in runs):
        # Commands by sent twists or names that were driven once leave no repetition to validate on.
        counts = Counter(run.command for run in runs)
        stated = {run.id for run in runs if source[run.id].trajectory.command}
        alike = [run.command and (counts[run.command] > 1 or run.id in stated) for run in runs]
        splits = every_second([run.command if by else motions[run.id] for run, by in zip(runs, alike, strict=True)])
    parted = divided(runs, options.train, options.validation, otherwise=splits)
    train, validation = ({motions[run.id] for run in parted if run.split == side} for side in SPLITS)
    if train and (missing := sorted(validation - train)):
        notes.append(
            f"validation holds runs that go {' and '.join(missing)}, as no training run does; divide them anew"
        )
    for index, run in enumerate(parted):
        recording = source[run.id].recording
        if recording.a_run or recording.attributes.repetition is not None:
            parted[index] = replace(run, repetition=recording.attributes.repetition)
    return parted


def motion_of(robot: Robot, run: Trajectory) -> str:
    """The motion of a run by its wheels and the design, in words: ``ahead, turning left``."""
    run = run if robot.drive.direct else replace(run, drive=robot.drive)
    twists = (run.signals @ robot.inverse_kinematic_matrix.T) * np.diff(run.times, prepend=0.0)[:, None]
    x, y, turn = twists.sum(axis=0)
    way, turned = np.abs(twists[:, :2]).sum(), np.abs(twists[:, 2]).sum() * robot.reach
    words = []
    if way > 0.2 * turned:
        ahead = "ahead" if x > 0 else "back"
        words.append(ahead if abs(x) >= abs(y) else "left" if y > 0 else "right")
    if abs(turn) * robot.reach > 0.1 * way and abs(turn) > 0.2:
        words.append(f"turning {'left' if turn > 0 else 'right'}")
    return ", ".join(words) or "nowhere"


def _scans_of(runs: Sequence[MadeRun]) -> Scans | None:
    """The scans of runs, still in their recordings; None without any. DataError: they are of different scanners."""
    scans, read = [], {}
    for run in runs:
        if (recorded := run.recording.scans) is not None and len(run.scans):
            scans.append(recorded)
            times = np.maximum(recorded.times[run.scans] - run.zero, 0.0)
            read[run.trajectory.id] = times, partial(recorded.read, run.scans)
    for other in scans[1:]:
        if difference := scan_difference(scans[0].scanner, other.scanner):
            raise DataError(f"{other.place}: {difference} as in {scans[0].place}; import them apart, or without scans")
    return Scans(scans[0].scanner, read) if scans else None
