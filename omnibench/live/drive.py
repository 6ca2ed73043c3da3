"""All runs of a recording concatenated to one drive: each run starts at the pose where the run before ended.

A run goes from its first reference pose to its last; wheel samples after that are left out. Between two runs the robot
stands still. With S_i the start pose of run i in the drive and p(t) its reference, the concatenated pose is

    S_i p(0)^-1 p(t).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from omnibench.config import Model, NonNegative, Positive
from omnibench.data.dataset import Dataset, Split, Trajectory
from omnibench.data.storage import load_dataset
from omnibench.data.true_poses import TruePath
from omnibench.errors import ConfigError, DataError
from omnibench.progress import Reporter, no_progress
from omnibench.registry import load_plugins
from omnibench.robot.kinematics import Array, Robot, compose, moved_to, relative, rotation
from omnibench.robot.odometry import WheelLog
from omnibench.simulate.robot_simulator import true_steering
from omnibench.simulate.source import read_simulation
from omnibench.simulate.truth import TruthRecord


@dataclass(frozen=True, eq=False)
class Recording:
    """A data set and, if it was simulated when loaded, its truth.

    paths: run -> true poses, for robots whose true motion does not follow from the wheels' set points alone.
    """

    dataset: Dataset
    truth: TruthRecord | None = None
    paths: Mapping[str, TruePath] = field(default_factory=dict)


def load_recording(path: Path, dataset: str | None = None, watch: Reporter = no_progress) -> Recording:
    """The data set in a folder, or the simulated one of a comparison's config, with its truth.

    dataset: name of the data set if the config has several. ConfigError or DataError in one line: it does not exist.
    """
    path = Path(path)
    if not path.exists():
        raise ConfigError(f"{path}: no such file or folder; name a data set folder or a comparison's config")
    if not path.is_dir():
        source = read_simulation(path, dataset)
        load_plugins(source.effect_plugins, installed=False)
        simulation = source.simulate(watch)
        return Recording(simulation.dataset, simulation.truth, simulation.paths)
    if dataset is not None:
        raise ConfigError(f"--dataset {dataset}: {path} is a folder with one data set; leave --dataset out")
    return Recording(load_dataset(path))


FULL_TURN = 2 * np.pi
LONGEST_PAUSE = 3600.0  # s between two runs; chosen
_MOST_RESTING = 10_000_000  # wheel samples of all pauses together: a day at 100 Hz; chosen
_SAME_TIME = 1e-9  # s, the resolution of stamps: times that differ by less are equal


@dataclass(frozen=True, eq=False)
class ConcatenatedDrive:
    """R runs with n wheel samples of N wheels and m reference poses on one time axis, s, which begins at 0.

    wheel_times (n,): ends of the samples; the first, 0, is the baseline. angles (n, N): wheel angles, rad, continuous.
    rates (n, N): mean rates over the samples, rad/s; 0 at the baseline and at standstill. run (n,): index of each
    sample's run; a standstill belongs to the run before it.

    slam_times (m,), slam_poses (m, 3) in m, m, rad with continuous headings, slam_covariances (m, 3, 3) if the data set
    has them, slam_run (m,). Runs after the first have no pose at their start: the drive sets it, nobody measured it.

    start_poses (R, 3) and start_times (R,), s: of the runs in the drive. steering (n, S): at the samples' ends, rad;
    None of a robot that does not steer. Where it stands before a run, it steers to where that one begins.
    """

    robot: Robot
    ids: tuple[str, ...]
    wheel_times: Array
    angles: Array
    rates: Array
    run: NDArray[np.intp]
    slam_times: Array
    slam_poses: Array
    slam_covariances: Array | None
    slam_run: NDArray[np.intp]
    start_poses: Array
    start_times: Array
    steering: Array | None = None

    @property
    def duration(self) -> float:
        """Time from the first sample to the last, s."""
        return float(max(self.wheel_times[-1], self.slam_times[-1]))

    def log(self, stamps: Sequence[float] | Array | None = None, session: str | None = None) -> WheelLog:
        """The drive's wheel samples for the batch odometry, with poses at ``stamps`` (s; default: every sample).

        session: name of the session, which starts with the drive.
        """
        wanted = self.wheel_times if stamps is None else np.asarray(stamps, dtype=float)
        return WheelLog(
            self.wheel_times[1:],
            self.rates[1:],
            self.start_poses[0],
            wanted,
            self.angles[1:],
            0.0,
            session or "",
            None if self.steering is None else self.steering[1:],
            None if self.steering is None else self.robot.drive,
        )


def concatenate_runs(
    dataset: Dataset, *, pause: float = 1.0, split: Split | None = None, start_poses: Array | None = None
) -> ConcatenatedDrive:
    """The runs of a data set (or of one split) as one drive with ``pause`` s of standstill between them.

    Runs go session by session, in the order of ``started_at`` where it is known, else of the data set.
    start_poses (R, 3): where the runs start, in place of what follows from the reference.

    ConfigError: a pause out of range. DataError: no run, a run with a single pose, or start_poses of another shape or
    not finite.
    """
    if not 0 <= pause <= LONGEST_PAUSE:
        raise ConfigError(f"pause: {pause:g} s between runs; expected 0 to {LONGEST_PAUSE:g} s")
    runs = _ordered(dataset, split)
    moves = np.array([relative(run.start, run.final_pose) for run in runs])
    starts = _composed(runs[0].start, moves)
    if start_poses is not None:
        # Multiples of 2 pi are added so that headings are continuous from run to run.
        poses = np.asarray(start_poses, dtype=float)
        if poses.shape != moves.shape or not np.isfinite(poses).all():
            raise DataError(
                f"data set {dataset.name}: start poses have shape {poses.shape}, expected {moves.shape}, finite"
            )
        leaps = np.diff(poses[:, 2]) - moves[:-1, 2]
        turns = np.concatenate([[0.0], np.cumsum(np.round(leaps / FULL_TURN))])
        starts = np.column_stack([poses[:, :2], poses[:, 2] - FULL_TURN * turns])
    # Samples of a standstill do not come oftener than others, whatever the data set's nominal period is.
    periods = np.concatenate([np.diff(run.times, prepend=0.0) for run in runs])
    period = max(dataset.sample_period, 0.5 * float(np.median(periods)))
    resting = [*(_rest_samples(run, pause, period) for run in runs[:-1]), 0]
    if sum(resting) > _MOST_RESTING:
        raise ConfigError(
            f"pause: with {pause:g} s the robot stands still for {sum(resting)} samples, more than {_MOST_RESTING}; "
            "give a shorter one, and check the times of the last poses"
        )
    legs = [_with_rest(run, rest, period) for run, rest in zip(runs, resting, strict=True)]
    begins = np.concatenate([[0.0], np.cumsum([leg.times[-1] for leg in legs[:-1]])])
    measured = [run.pose_times > 0 for run in runs]
    measured[0] = np.ones(len(runs[0].pose_times), dtype=bool)
    return ConcatenatedDrive(
        robot=dataset.robot,
        ids=tuple(run.id for run in runs),
        wheel_times=np.concatenate([[0.0], *(begin + leg.times for begin, leg in zip(begins, legs, strict=True))]),
        angles=_continuous_angles(legs),
        rates=np.concatenate([np.zeros((1, len(dataset.robot.wheel_names))), *(leg.rates for leg in legs)]),
        run=np.repeat(np.arange(len(legs)), [1 + len(legs[0].times), *(len(leg.times) for leg in legs[1:])]),
        slam_times=np.concatenate([b + run.pose_times[m] for b, run, m in zip(begins, runs, measured, strict=True)]),
        slam_poses=np.concatenate(
            [moved_to(start, run.poses)[m] for start, run, m in zip(starts, runs, measured, strict=True)]
        ),
        slam_covariances=_covariances(runs, starts, measured),
        slam_run=np.repeat(np.arange(len(runs)), [np.count_nonzero(m) for m in measured]),
        start_poses=starts,
        start_times=begins,
        steering=_steering(legs, resting),
    )


def concatenate_recording(recording: Recording, *, pause: float = 1.0, split: Split | None = None) -> ConcatenatedDrive:
    """The runs of a recording as one drive; where its truth is known, each run starts where the robot truly was."""
    start_poses = None if recording.truth is None else true_start_poses(recording, split)
    return concatenate_runs(recording.dataset, pause=pause, split=split, start_poses=start_poses)


def true_start_poses(recording: Recording, split: Split | None = None) -> Array:
    """Start poses (R, 3) of the runs in one drive: each at the true end of the one before. DataError without a truth.

    With them the errors of a drive's reference poses do not accumulate from run to run.
    """
    truth, runs = _TruthOfRuns(recording), _ordered(recording.dataset, split)
    moves = [relative(run.start, truth.poses(run, run.times[-1:])[0]) for run in runs]
    return _composed(runs[0].start, np.array(moves))


def concatenated_truth(drive: ConcatenatedDrive, recording: Recording) -> Array:
    """True poses (n, 3) of a simulated robot at the drive's wheel times, each run from its start pose in the drive.

    Continuous if the drive has true start poses; else it jumps between runs by the error of the reference. DataError
    without a truth.
    """
    truth = _TruthOfRuns(recording)
    known = {run.id: run for run in recording.dataset.trajectories}
    bounds = np.searchsorted(drive.run, np.arange(1, len(drive.ids)))
    poses = []
    for index, times in enumerate(np.split(drive.wheel_times, bounds)):
        if drive.ids[index] not in known:
            raise DataError(
                f"run {drive.ids[index]} is not in data set {recording.dataset.name}; take the drive's own recording"
            )
        run = _trimmed(known[drive.ids[index]])
        driven = truth.poses(run, np.append(0.0, times - drive.start_times[index]))
        poses.append(moved_to(drive.start_poses[index], driven)[1:])
    return np.concatenate(poses)


def _ordered(dataset: Dataset, split: Split | None) -> list[Trajectory]:
    """The runs in the order of the drive, each cut at its last reference pose."""
    chosen = dataset.trajectories if split is None else dataset.split(split)
    if not chosen:
        raise DataError(f"data set {dataset.name}: no run in split {split!r}; choose another split, or none")
    sessions: dict[str | None, list[Trajectory]] = {}
    for run in chosen:
        sessions.setdefault(run.session, []).append(run)
    for runs in sessions.values():
        if all(run.started_at is not None for run in runs):
            runs.sort(key=lambda run: run.started_at or 0.0)
    ordered = [run for runs in sessions.values() for run in runs]
    for run in ordered:
        if not run.has_poses and run.references is not None:
            raise DataError(
                f"data set {dataset.name}: run {run.id} has distances, turns and the like and no reference poses, so "
                "that nothing says where the next run begins; replay runs with poses, or others of --split"
            )
        if len(run.pose_times) < 2:
            raise DataError(
                f"data set {dataset.name}: run {run.id} has a single reference pose; it cannot be concatenated"
            )
    return [_trimmed(run) for run in ordered]


def _trimmed(run: Trajectory) -> Trajectory:
    """A run cut at its last reference pose; the wheel sample that contains the pose's time is shortened."""
    end = run.pose_times[-1]
    if run.times[-1] <= end + _SAME_TIME:
        return run
    last = int(np.searchsorted(run.times, end - _SAME_TIME))  # the sample that reaches the end or passes it
    times = np.append(run.times[:last], min(run.times[last], end))
    kept = slice(0, last + 1)
    angles = None
    if run.angles is not None:
        angles = run.angles[kept].copy()
        angles[last] -= run.rates[last] * (run.times[last] - times[last])
    targets, steering = (None if array is None else array[kept] for array in (run.targets, run.steering))
    cut = replace(run, times=times, rates=run.rates[kept], angles=angles, targets=targets, steering=steering)
    return replace(cut, odometry=None)


def _rest_samples(run: Trajectory, pause: float, period: float) -> int:
    """Number of samples at standstill after a run: up to its last reference pose if that is later, and the pause."""
    missing = (run.pose_times[-1] - run.times[-1] - _SAME_TIME) / period
    return max(0, int(np.ceil(missing))) + round(pause / period)


def _with_rest(run: Trajectory, rest: int, period: float) -> Trajectory:
    """A run with samples of standstill after it, and with its rates integrated where no angles were recorded."""
    still, angles = np.zeros((rest, run.rates.shape[1])), run.angles
    if angles is None:
        angles = np.cumsum(run.rates * np.diff(run.times, prepend=0.0)[:, None], axis=0)
    return replace(
        run,
        times=np.append(run.times, run.times[-1] + period * np.arange(1, rest + 1)),
        rates=np.vstack([run.rates, still]),
        angles=np.vstack([angles, angles[-1] + still]),
        targets=None,
        steering=None if run.steering is None else np.vstack([run.steering, *[run.steering[-1:]] * rest]),
    )


def _steering(legs: Sequence[Trajectory], resting: Sequence[int]) -> Array | None:
    """Steering angles (n, S) at the baseline and at all samples, made continuous over whole turns."""
    parts: list[Array] = []
    for leg, rest in zip(legs, (0, *resting), strict=False):
        if leg.steering is None:
            return None
        if rest:
            parts[-1][-1] = leg.steering[0]
        parts += [leg.steering.copy()] if parts else [leg.steering[:1], leg.steering.copy()]
    angles: Array = np.unwrap(np.concatenate(parts), axis=0)
    return angles


def _continuous_angles(legs: Sequence[Trajectory]) -> Array:
    """Wheel angles (n, N) at the baseline and at all samples, made continuous from run to run."""
    parts: list[Array] = []
    for leg in legs:
        assert leg.angles is not None  # recorded or integrated
        before = leg.angles[0] - leg.rates[0] * leg.times[0]
        if not parts:
            parts.append(before[None])
        parts.append(leg.angles + (parts[-1][-1] - before))
    return np.concatenate(parts)


def _covariances(runs: Sequence[Trajectory], starts: Array, measured: Sequence[NDArray[np.bool_]]) -> Array | None:
    """Covariances of the reference, rotated with their runs; None unless all runs have them."""
    parts = []
    for run, start, chosen in zip(runs, starts, measured, strict=True):
        if run.pose_covariances is None:
            return None
        turn = rotation(start[2] - run.start[2])
        parts.append(turn @ run.pose_covariances[chosen] @ turn.T)
    return np.concatenate(parts)


def _composed(first: Array, moves: Array) -> Array:
    """Start poses (R, 3) of consecutive relative motions ``moves`` (R, 3), the first of which starts at ``first``."""
    return np.array(list(accumulate(moves[:-1], compose, initial=first)))


class _TruthOfRuns:
    """The true motion of a simulated robot. DataError: the recording has no truth."""

    def __init__(self, recording: Recording) -> None:
        if recording.truth is None:
            raise DataError(
                f"data set {recording.dataset.name}: it has no truth; name a comparison's config, which simulates it"
            )
        self._paths = recording.paths
        self._robot = recording.truth.true_robot()
        self._variation = recording.truth.variation

    def poses(self, run: Trajectory, stamps: Array) -> Array:
        """True poses (K, 3) at stamps (K,), s since the run's start."""
        if run.id in self._paths:
            return moved_to(run.start, self._paths[run.id].at(np.append(0.0, stamps)))[1:]
        if run.targets is None or run.angles is None:
            raise DataError(f"run {run.id}: its set points are not recorded, so its truth is not known")
        rates = self._robot.driven(run.times, run.targets)
        angles = run.angles[0] - run.rates[0] * run.times[0]  # before its first sample
        steering = true_steering(self._robot.model.robot, run, self._variation)
        log = self._robot.log(run.times, rates, run.start, stamps, angles, run.started_at, run.session, steering)
        return self._robot.poses(log)


WHEELS, SLAM = 0, 1  # indices in TOPICS_PLAYED
TOPICS_PLAYED: Final = ("joint_states", "slam_pose")

_SAME_ARRIVAL = 1e-6  # s; times that differ by less are equal
_LATEST_ORIGIN = (2**31 - 10**8) * 10**9  # ns; ROS 2's stamps end at 2^31 s

Share = Annotated[float, Field(ge=0, le=1)]
Delay = Annotated[float, Field(ge=0, le=3600)]  # s; an hour is longer than any network's; chosen


class Channel(Model):
    """The network from sensor to node: delays and losses of messages, in s of the recording at any speed."""

    delay: Delay = Field(0.0, description="of each message, s")
    jitter: Delay = Field(0.0, description="additional delay of each message, half-normal: |N(0, jitter)|, s")
    drop: Share = Field(0.0, description="share of the messages that never arrive")
    duplicate: Share = Field(0.0, description="share of the messages that arrive twice, each time with its own jitter")


class WheelChannel(Channel):
    """The network that wheel samples take."""

    use: Literal["positions", "velocities", "both"] = Field("both", description="content of the messages")


class PoseDeviation(Model):
    """Standard deviations of a pose."""

    position: Positive = Field(0.02, description="standard deviation of x and of y, m")
    heading: Positive = Field(0.02, description="standard deviation, rad")


class SlamChannel(Channel):
    """The network that SLAM poses take."""

    delay: Delay = Field(0.2, description="of each message, s")
    jitter: Delay = Field(0.02, description="additional delay of each message, half-normal: |N(0, jitter)|, s")
    period: Delay = Field(0.25, description="least time between two poses, s")
    covariance: PoseDeviation | None = Field(
        None, description="for poses without covariance in the data set; default: the noise model's, else 0.02 m, rad"
    )


_Speed = BeforeValidator(
    lambda value: math.inf if value == "max" else value, json_schema_input_type=float | Literal["max"]
)


class ReplayConfig(Model):
    """Settings of a replay of a recording."""

    speed: Annotated[float, _Speed] = Field(
        1.0,
        ge=1e-3,
        description="1: real time; 10: ten times as fast; max: as fast as possible without losing messages",
    )
    pause: float = Field(1.0, ge=0, le=LONGEST_PAUSE, description="standstill between two runs, s")
    split: Split | None = Field(None, description="replay only the runs of this split")
    seed: int = Field(0, ge=0, description="random seed of jitter, drops and duplicates")
    wheels: WheelChannel = WheelChannel()
    slam: SlamChannel = SlamChannel()
    stamp_origin: int | None = Field(
        None,
        gt=0,
        le=_LATEST_ORIGIN,
        description="stamp of the recording's start, ns; default: the replay's start",
    )
    wait: NonNegative = Field(10.0, description="longest wait for a subscriber of the wheel samples, s; 0: do not wait")


@dataclass(frozen=True, eq=False)
class Schedule:
    """All messages by time of arrival: arrivals (E,) s; topics (E,) in TOPICS_PLAYED; rows (E,) in the drive."""

    arrivals: Array
    topics: NDArray[np.int8]
    rows: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.arrivals)


def make_schedule(drive: ConcatenatedDrive, config: ReplayConfig) -> Schedule:
    """The arrivals of a drive's messages. They depend on the seed only; each topic has its own random numbers."""
    wheel_seed, slam_seed = np.random.SeedSequence(config.seed).spawn(2)
    samples, sampled = _arrivals(drive.wheel_times, config.wheels, np.random.default_rng(wheel_seed))
    # Poses that are at least a period apart, beginning with the first.
    chosen, index = [], 0
    while index < len(drive.slam_times):
        chosen.append(index)
        index = max(
            index + 1,
            int(np.searchsorted(drive.slam_times, drive.slam_times[index] + config.slam.period - _SAME_ARRIVAL)),
        )
    kept = np.array(chosen, dtype=np.intp)
    poses, posed = _arrivals(drive.slam_times[kept], config.slam, np.random.default_rng(slam_seed))
    arrivals = np.concatenate([sampled, posed])
    topics = np.repeat(np.array([WHEELS, SLAM], dtype=np.int8), [len(samples), len(poses)])
    rows = np.concatenate([samples, kept[poses]])
    order = np.argsort(arrivals, kind="stable")
    return Schedule(arrivals[order], topics[order], rows[order])


def _arrivals(times: Array, channel: Channel, rng: np.random.Generator) -> tuple[NDArray[np.intp], Array]:
    """Indices (E,) of the messages that arrive, some of them twice, and their times of arrival (E,)."""
    chance, jitter = rng.random((2, len(times))), np.abs(rng.standard_normal((2, len(times))))
    arrives = chance[0] >= channel.drop
    twice = arrives & (chance[1] < channel.duplicate)
    late = times + channel.delay + channel.jitter * jitter
    indices = np.concatenate([np.flatnonzero(arrives), np.flatnonzero(twice)])
    when = np.concatenate([late[0][arrives], late[1][twice]])
    order = np.lexsort((indices, when))
    return indices[order], when[order]
