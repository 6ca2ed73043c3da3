"""The runs that are looked at, made ready: few enough stamps, without poses that jump, with their nuisances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.noise import Whitener
from omnibench.fit.repetitions import differences_between_repetitions
from omnibench.fit.start_noise import by_stamps, surprise
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import WheelLog

_MOST_STAMPS = 150  # of a run; neighbours in denser references share their errors
_JUMP = 4.5  # standard deviations from what a pose's neighbours say
_MOST_JUMPS = 0.1  # of a run's poses
_LAST = 5  # samples whose mean rate tells how the robot goes on after the last
_GAIN = 6.6  # twice the gain in log-likelihood that a variance of zero exceeds by chance once in 200 times

NUISANCES = ("start heading", "clock offset", "clock slope")
_LARGEST = np.array([0.3, 0.5, 0.02])  # rad, s, s/s


def usable_runs(trajectories: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
    """Runs with a reference pose after their start, by session and time, at most 150 stamps each. DataError: none."""
    runs = [run for run in trajectories if len(run.pose_times) > 1]
    if not runs:
        raise DataError("no trajectory of the split train has a reference pose after its start; nothing can be found")
    runs.sort(key=lambda run: (str(run.session), run.started_at or 0.0))
    return tuple(_thinned(run) for run in runs)


def _thinned(run: Trajectory) -> Trajectory:
    count = len(run.pose_times) - 1
    if count <= _MOST_STAMPS:
        return run
    chosen = np.unique(np.round(np.linspace(count, 0, _MOST_STAMPS + 1)).astype(int))
    return _with_poses(run, chosen)


def _with_poses(run: Trajectory, chosen: Array) -> Trajectory:
    covariances = None if run.pose_covariances is None else run.pose_covariances[chosen]
    return replace(run, pose_times=run.pose_times[chosen], poses=run.poses[chosen], pose_covariances=covariances)


def without_jumps(
    runs: Sequence[Trajectory], residuals: Sequence[Array], noise: Noise
) -> tuple[tuple[Trajectory, ...], int]:
    """Runs less the poses that contradict their neighbours, and how many these are.

    A pose jumps when its residual lies 4.5 standard deviations from what the run's other residuals make of it; what a
    model gets wrong varies too slowly for that.
    """
    precisions: dict[bytes, tuple[Array, Array]] = {}
    kept, count = [], 0
    for run, own in zip(runs, residuals, strict=True):
        stamps = run.pose_times[1:]
        keep = np.ones(len(stamps), dtype=bool)
        for _ in range(int(np.ceil(_MOST_JUMPS * len(stamps)))):
            key = stamps[keep].tobytes()
            if key not in precisions:
                precisions[key] = _precisions(noise, stamps[keep])
            score = _surprises(own[keep], *precisions[key])
            if keep.sum() < 3 or score.max() < _JUMP:
                break
            keep[np.flatnonzero(keep)[score.argmax()]] = False
        count += int((~keep).sum())
        whole = bool(keep.all())
        kept.append(run if whole else _with_poses(run, np.concatenate([[True], keep])))
    return tuple(kept), count


def _precisions(noise: Noise, stamps: Array) -> tuple[Array, Array]:
    """Inverse covariances (K, K) of the positions and of the headings."""
    identity = np.repeat(np.eye(len(stamps))[:, None, :], 3, axis=1)
    white = Whitener(noise, stamps)(identity)
    return white[:, 0].T @ white[:, 0], white[:, 2].T @ white[:, 2]


def _surprises(residuals: Array, position: Array, heading: Array) -> Array:
    """How many standard deviations (K,) each pose lies from what the others say, the worst of x, y and heading."""
    of_position = (position @ residuals[:, :2]) / np.sqrt(np.diag(position))[:, None]
    of_heading = (heading @ residuals[:, 2:]) / np.sqrt(np.diag(heading))[:, None]
    scores: Array = np.abs(np.concatenate([of_position, of_heading], axis=1)).max(axis=1)
    return scores


def log_of(run: Trajectory, nuisances: Array) -> WheelLog:
    """A run's log at the times when its poses were taken, its start turned: nuisances (3,) rad, s, s per s.

    After the last sample the robot goes on as in the last ones, so that the path has no kink there.
    """
    turn, offset, slope = nuisances
    log = run.log(run.pose_times[1:] * (1 - slope) - offset)
    start = log.start + np.array([0.0, 0.0, turn])
    if log.stamps[-1] <= log.times[-1]:
        return replace(log, start=start)
    rate = log.rates[-_LAST:].mean(axis=0)
    end = log.stamps[-1]
    angles = log.wheel_angles
    if angles is not None:
        angles = np.vstack([angles, angles[-1] + rate * (end - log.times[-1])])
    return replace(
        log, start=start, times=np.append(log.times, end), rates=np.vstack([log.rates, rate]), wheel_angles=angles
    )


@dataclass(frozen=True, eq=False)
class Nuisances:
    """What is each run's own: values (Z, 3), rad, s, s per s, and the sizes (3,) that are expected, 0 for none."""

    values: Array
    deviations: Array


def deviation_of(runs: Sequence[Trajectory], residuals: Sequence[Array], columns: Sequence[Array], noise: Noise,
                 kind: int) -> float:  # fmt: skip
    """Standard deviation of one kind of nuisance between repetitions of a command; 0 where none shows.

    columns (K, 3): derivatives of each run's poses by it.
    """
    differences = differences_between_repetitions(runs, residuals, columns)
    groups = by_stamps(differences.each)
    size = float(np.median([np.sqrt(np.square(each).sum(axis=1)).max() for each in columns]))
    if size == 0:
        return 0.0
    before = surprise(groups, noise, 0.0)
    found = minimize_scalar(
        lambda deviation: surprise(groups, noise, deviation),
        bounds=(0.0, float(_LARGEST[kind])),
        method="bounded",
        options={"xatol": 1e-5 * float(_LARGEST[kind])},
    )
    return float(found.x) if before - float(found.fun) > _GAIN else 0.0
