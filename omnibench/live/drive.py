"""All runs of a recording concatenated to one drive: each run starts at the pose where the run before ended.

A run goes from its first reference pose to its last; wheel samples after that are left out. Between two runs the robot
stands still. With S_i the start pose of run i in the drive and p(t) its reference, the concatenated pose is

    S_i p(0)^-1 p(t).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any, Literal

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

    def log(self, stamps: Sequence[float] | Array | None = None, session: str | None = None) -> WheelLog:
        """The drive's wheel samples for the batch odometry, with poses at ``stamps`` (s; default: every sample).

        session: name of the session, which starts with the drive.
        """
        wanted = self.wheel_times if stamps is None else np.asarray(stamps, dtype=float)
        steering = None if self.steering is None else self.steering[1:]
        drive = None if steering is None else self.robot.drive
        times, rates, angles, start = self.wheel_times[1:], self.rates[1:], self.angles[1:], self.start_poses[0]
        return WheelLog(times, rates, start, wanted, angles, 0.0, session or "", steering, drive)


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
        starts = np.array(start_poses, dtype=float)
        if starts.shape != moves.shape or not np.isfinite(starts).all():
            shapes = f"have shape {starts.shape}, expected {moves.shape}, finite"
            raise DataError(f"data set {dataset.name}: start poses {shapes}")
        # Multiples of 2 pi are added so that headings are continuous from run to run.
        errors = starts[:, 2] - np.append(0.0, np.cumsum(moves[:-1, 2]))
        starts[:, 2] += np.unwrap(errors) - errors
    # Samples of a standstill do not come oftener than others, whatever the data set's nominal period is.
    periods = np.concatenate([np.diff(run.times, prepend=0.0) for run in runs])
    period = max(dataset.sample_period, 0.5 * float(np.median(periods)))
    # Number of samples at standstill after a run: up to its last reference pose if that is later, and the pause.
    missing = [np.ceil((run.pose_times[-1] - run.times[-1] - _SAME_TIME) / period) for run in runs[:-1]]
    resting = [*(max(0, int(samples)) + round(pause / period) for samples in missing), 0]
    if sum(resting) > _MOST_RESTING:
        standstill = f"with {pause:g} s the robot stands still for {sum(resting)} samples, more than {_MOST_RESTING}"
        raise ConfigError(f"pause: {standstill}; give a shorter one, and check the times of the last poses")
    # Rows of the drive's arrays, run by run; those of the wheels begin with the baseline.
    begins, times, rates = [0.0], [np.zeros(1)], [np.zeros((1, len(dataset.robot.wheel_names)))]
    angles, steering, slam_times, slam_poses, covariances = (list[Array]() for _ in range(5))
    for number, (run, start, rest) in enumerate(zip(runs, starts, resting, strict=True)):
        begin, still, rested = begins[-1], ((0, rest), (0, 0)), number > 0 and resting[number - 1] > 0
        times.append(begin + np.append(run.times, run.times[-1] + period * np.arange(1, rest + 1)))
        begins.append(float(times[-1][-1]))
        rates.append(np.pad(run.rates, still))
        turned = run.angles
        if turned is None:
            turned = np.cumsum(run.rates * np.diff(run.times, prepend=0.0)[:, None], axis=0)
        before = turned[0] - run.rates[0] * run.times[0]
        angles = angles or [before[None]]
        angles.append(np.pad(turned, still, mode="edge") + (angles[-1][-1] - before))
        if run.steering is not None:
            steering = steering or [run.steering[:1]]
            if rested:
                steering[-1][-1] = run.steering[0]
            steering.append(np.pad(run.steering, still, mode="edge"))
        measured = slice(min(number, 1), None)  # the start pose of a later run is set by the drive
        slam_times.append(begin + run.pose_times[measured])
        slam_poses.append(moved_to(start, run.poses)[measured])
        if run.pose_covariances is not None:
            turn = rotation(start[2] - run.start[2])
            covariances.append(turn @ run.pose_covariances[measured] @ turn.T)
    numbers = np.arange(len(runs))
    return ConcatenatedDrive(
        robot=dataset.robot,
        ids=tuple(run.id for run in runs),
        wheel_times=np.concatenate(times),
        angles=np.concatenate(angles),
        rates=np.concatenate(rates),
        run=np.append(0, np.repeat(numbers, [len(part) for part in times[1:]])),
        slam_times=np.concatenate(slam_times),
        slam_poses=np.concatenate(slam_poses),
        slam_covariances=np.concatenate(covariances) if len(covariances) == len(runs) else None,
        slam_run=np.repeat(numbers, [len(part) for part in slam_times]),
        start_poses=starts,
        start_times=np.array(begins[:-1]),
        steering=np.unwrap(np.concatenate(steering), axis=0) if steering else None,
    )


def concatenate_recording(recording: Recording, *, pause: float = 1.0, split: Split | None = None) -> ConcatenatedDrive:
    """The runs of a recording as one drive; where its truth is known, each run starts where the robot truly was."""
    start_poses = None if recording.truth is None else true_start_poses(recording, split)
    return concatenate_runs(recording.dataset, pause=pause, split=split, start_poses=start_poses)


def true_start_poses(recording: Recording, split: Split | None = None) -> Array:
    """Start poses (R, 3) of the runs in one drive: each at the true end of the one before. DataError without a truth.

    With them the errors of a drive's reference poses do not accumulate from run to run.
    """
    runs = _ordered(recording.dataset, split)
    moves = [relative(run.start, _true_poses(recording, run, run.times[-1:])[0]) for run in runs]
    return _composed(runs[0].start, np.array(moves))


def concatenated_truth(drive: ConcatenatedDrive, recording: Recording) -> Array:
    """True poses (n, 3) of a simulated robot at the drive's wheel times, each run from its start pose in the drive.

    Continuous if the drive has true start poses; else it jumps between runs by the error of the reference. DataError
    without a truth.
    """
    poses = []
    for number, name in enumerate(drive.ids):
        stamps = drive.wheel_times[drive.run == number] - drive.start_times[number]
        driven = _true_poses(recording, _trimmed(recording.dataset[name]), np.append(0.0, stamps))
        poses.append(moved_to(drive.start_poses[number], driven)[1:])
    return np.concatenate(poses)


def _ordered(dataset: Dataset, split: Split | None) -> list[Trajectory]:
    """The runs in the order of the drive, each cut at its last reference pose."""
    chosen = dataset.trajectories if split is None else dataset.split(split)
    if not chosen:
        raise DataError(f"data set {dataset.name}: no run in split {split!r}; choose another split, or none")
    for run in chosen:
        if not run.has_poses:
            reason = "a single reference pose; it cannot be concatenated"
            if run.references is not None:
                reason = "no reference poses, but distances, turns and the like; replay runs with poses (--split)"
            raise DataError(f"data set {dataset.name}: run {run.id} has {reason}")
    return list(map(_trimmed, in_order(chosen)))


def in_order(runs: Iterable[Trajectory]) -> list[Trajectory]:
    """Runs session by session, in each by their start where that is known of all."""
    sessions: dict[str | None, list[Trajectory]] = {}
    for run in runs:
        sessions.setdefault(run.session, []).append(run)
    for members in sessions.values():
        if all(run.started_at is not None for run in members):
            members.sort(key=lambda run: run.started_at or 0.0)
    return [run for members in sessions.values() for run in members]


def _trimmed(run: Trajectory) -> Trajectory:
    """A run cut at its last reference pose; the wheel sample that contains the pose's time is shortened."""
    end = run.pose_times[-1]
    if run.times[-1] <= end + _SAME_TIME:
        return run
    last = int(np.searchsorted(run.times, end - _SAME_TIME))  # the sample that reaches the end or passes it
    rows: dict[str, Any] = {}
    for name in ("times", "rates", "angles", "targets", "steering"):
        array = getattr(run, name)
        rows[name] = None if array is None else array[: last + 1].copy()
    excess = max(run.times[last] - end, 0.0)
    rows["times"][last] -= excess
    if rows["angles"] is not None:
        rows["angles"][last] -= run.rates[last] * excess
    return replace(run, **rows, odometry=None)


def _composed(first: Array, moves: Array) -> Array:
    """Start poses (R, 3) of consecutive relative motions ``moves`` (R, 3), the first of which starts at ``first``."""
    return np.array(list(accumulate(moves[:-1], compose, initial=first)))


def _true_poses(recording: Recording, run: Trajectory, stamps: Array) -> Array:
    """True poses (K, 3) of a simulated robot at stamps (K,), s since a run's start. DataError without a truth."""
    if recording.truth is None:
        name = recording.dataset.name
        raise DataError(f"data set {name}: it has no truth; name a comparison's config, which simulates it")
    if run.id in recording.paths:
        return moved_to(run.start, recording.paths[run.id].at(np.append(0.0, stamps)))[1:]
    if run.targets is None or run.angles is None:
        raise DataError(f"run {run.id}: its set points are not recorded, so its truth is not known")
    robot = recording.truth.true_robot()
    angles = run.angles[0] - run.rates[0] * run.times[0]  # before its first sample
    steering = true_steering(robot.model.robot, run, recording.truth.variation)
    rates = robot.driven(run.times, run.targets)
    return robot.poses(robot.log(run.times, rates, run.start, stamps, angles, run.started_at, run.session, steering))


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
        None, gt=0, le=_LATEST_ORIGIN, description="stamp of the recording's start, ns; default: the replay's start"
    )
    wait: NonNegative = Field(10.0, description="longest wait for a subscriber of the wheel samples, s; 0: do not wait")
