"""Runs of a data set, read again with other options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.data.importers.runs.recorded_streams import RecordedStreams, ReferenceStream, by_one_clock
from omnibench.data.importers.runs.recording_runs import recording_runs
from omnibench.data.importers.runs.reference_options import ReferenceOptions
from omnibench.data.importers.wheel_samples import EncoderOptions, WheelSamples
from omnibench.data.scans import Scans, ScansInMemory, TrajectoryScans
from omnibench.errors import ConfigError, nearest
from omnibench.robot.kinematics import Robot
from omnibench.words import plural, some


@dataclass(frozen=True)
class Columns:
    """Indices of the columns of the wheels and of the steering angles in the order of the robot that is wanted."""

    wheels: tuple[int, ...]
    steering: tuple[int, ...]

    @classmethod
    def of(cls, recorded: Robot, options: EncoderOptions, wheels: Sequence[str], steering: Sequence[str]) -> Columns:
        """The columns of a recorded robot that are named, or those called like the wheels. ConfigError names others."""
        robot = options.robot
        return cls(
            _indices(wheels or robot.wheel_names, recorded.wheel_names, "omega_", "wheel_columns"),
            _indices(steering or robot.drive.steered, recorded.drive.steered, "steer_", "steering_columns"),
        )

    def read(self, run: Trajectory, options: EncoderOptions) -> Trajectory:
        """A run with wheels in the robot's order and senses, rad/s, and its steering angles, rad."""
        order = list(self.wheels)
        factors, signs = options.wheel_radians, np.array(options.signs or 1)
        steering = None
        if run.steering is not None and self.steering:
            steering = run.steering[:, list(self.steering)]
            if options.steers_otherwise:
                steering = options.steering_angles(steering, f"trajectory {run.id}")
        return replace(
            run,
            rates=run.rates[:, order] * factors,
            angles=None if run.angles is None else run.angles[:, order] * factors,
            targets=None if run.targets is None else run.targets[:, order] * signs,
            steering=steering,
            drive=None,
        )


def in_seconds(run: Trajectory, wheels: float, poses: float) -> Trajectory:
    """A run whose wheels' and whose poses' times were recorded in units of so many seconds."""
    if wheels == poses == 1.0:
        return run
    duration = None if run.duration is None else run.duration * wheels
    times, references = run.times * wheels, run.references
    if references is not None:
        given = references.open_ended(float(run.times[-1]))
        references = replace(given, t0=given.t0 * poses, t1=given.t1 * poses).of_run(0.0, float(times[-1]))
    sent = None if run.sent is None else run.sent * [wheels, 1, 1, 1, wheels]
    recorded = replace(run, times=times, pose_times=run.pose_times * poses, sent=sent)
    return replace(recorded, duration=duration, references=references)


def _indices(names: Sequence[str], known: Sequence[str], prefix: str, option: str) -> tuple[int, ...]:
    bare = [name.removeprefix(prefix) for name in names]
    for name in bare:
        if name not in known:
            shown = ", ".join(known) or "none"
            raise ConfigError(f"the data set has no wheel {name!r}; {nearest(name, known)}found: {shown}; set {option}")
    if len(set(bare)) < len(bare):
        raise ConfigError(f"{option} names one wheel twice: {', '.join(names)}; name each once")
    return tuple(known.index(name) for name in bare)


@dataclass(frozen=True, eq=False)
class Part:
    """A run that was made of the run ``old``, whose time ``zero`` became its t = 0, s. whole: nothing was cut off."""

    run: Trajectory
    old: str
    zero: float
    whole: bool


def reread_runs(
    runs: Sequence[Trajectory], options: ReferenceOptions, columns: Sequence[int], radian: float, notes: list[str]
) -> list[Part]:
    """The runs with references, clocks and cuts as the options say.

    columns: of x, y and heading. radian: unit of the headings. Distances, turns and the like are read alike; a run that
    is cut keeps those that lie within one of its parts.
    """
    streams = by_one_clock([_streams(run, options, columns, radian) for run in runs], options, notes)
    parts, bare = [], []
    for run, stream in zip(runs, streams, strict=True):
        made = _parts(run, stream, options, notes)
        parts += made
        bare += [] if made else [run.id]
    if bare:
        rest = " or never stand still before they drive (start_at_rest)" if options.start_at_rest else ""
        notes.append(f"{plural(len(bare), 'run')} left out that have too few poses{rest}: {some(bare)}")
    return parts


def _streams(run: Trajectory, options: ReferenceOptions, columns: Sequence[int], radian: float) -> RecordedStreams:
    begins = np.append(0.0, run.times[:-1])
    lost = np.zeros(len(begins), dtype=bool)
    if options.longest_gap is not None:
        lost = run.times - begins > options.longest_gap
    kept = ~lost
    angles, steering = (None if each is None else each[kept] for each in (run.angles, run.steering))
    stretch = np.cumsum(lost, dtype=np.intp)[kept]
    samples = WheelSamples(begins[kept], run.times[kept], run.rates[kept], angles, steering, stretch)
    covariances = run.pose_covariances
    if list(columns) != [0, 1, 2]:
        covariances = None if covariances is None else covariances[:, columns][:, :, columns]
        reference = ReferenceStream(run.pose_times, run.poses[:, columns], covariances)
    else:
        reference = ReferenceStream(run.pose_times, run.poses, covariances)
    if run.references is not None:
        reference = replace(reference, measured=run.references.open_ended(float(run.times[-1])))
    return RecordedStreams(run.id, f"trajectory {run.id}", samples, reference.read_as(options, radian))


def _parts(run: Trajectory, streams: RecordedStreams, options: ReferenceOptions, notes: list[str]) -> list[Part]:
    reference = streams.reference
    if not options.cuts and reference.times is run.pose_times:
        poses = reference.poses if run.start_known else run.poses
        measured = None if reference.measured is None else reference.measured.of_run(0.0, float(run.times[-1]))
        read = replace(run, poses=poses, pose_covariances=reference.covariances, references=measured)
        return [Part(read, run.id, 0.0, whole=True)]
    parts = []
    recorded = _recorded(run, streams.samples)
    for cut in recording_runs(run, streams.samples, reference, options, notes, streams.place):
        rows = recorded[cut.kept]
        targets, odometry = (None if array is None else array[rows] for array in (run.targets, run.odometry))
        sent = None if run.sent is None else run.sent - np.array([cut.zero, 0, 0, 0, 0])
        if sent is not None:  # those that hold at some time of the part
            sent = sent[(sent[:, 0] > -sent[:, 4]) & (sent[:, 0] < cut.trajectory.times[-1])]
        whole = cut.zero == 0 and len(cut.kept) == len(run.times)
        distance = run.distance if whole else None
        made = replace(cut.trajectory, targets=targets, odometry=odometry, sent=sent, distance=distance)
        parts.append(Part(replace(made, duration=run.duration) if whole else made, run.id, cut.zero, whole))
    return parts


def _recorded(run: Trajectory, samples: WheelSamples) -> NDArray[np.intp]:
    """Indices of the run's samples that are left."""
    return np.searchsorted(run.times, samples.ends)


def scans_of(scans: Scans, parts: Sequence[Part]) -> Scans:
    """The scans of the parts of runs, by their times."""
    if all(part.whole for part in parts):
        return scans
    recorded = set(scans.trajectories)
    cut = {}
    for part in parts:
        if part.old not in recorded:
            continue
        of_run = scans.of(part.old)
        times = of_run.times - part.zero
        seen = (times >= 0) & (times <= part.run.times[-1])
        if seen.any():
            cut[part.run.id] = TrajectoryScans(times[seen], of_run.ranges[seen])
    return ScansInMemory(scans.scanner, cut)
