"""The runs of a split that can be used: with a reference pose after the start, at most 80 stamps each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array
from omnibench.robot.planar import rotation


def in_start_frames(runs: Sequence[Trajectory], values: Sequence[Array]) -> list[Array]:
    """Residuals (K, 3), or derivatives of poses (K, 3, m), turned into the frame of each run's start.

    Repetitions of a command that start in different headings can be compared only so.
    """
    turned = []
    for run, of_run in zip(runs, values, strict=True):
        turned.append(np.einsum("ij,kj...->ki...", rotation(-run.start[2]), of_run))
    return turned


# tests/studies/constants.py varies each number by 0.5 and 2: on a small set with heading drift no verdict and no
# name changes.
_MOST_STAMPS = 80  # reference poses used of a run: neighbours in denser references share their errors
_STANDING = 1e-3  # rad/s: slower wheels count as standing; one of 0.1 m moves 0.1 mm in a second
_OVERHANG = 0.5  # s after the last wheel sample in which reference poses are still used, see ``log_of``


def usable_runs(trajectories: Sequence[Trajectory], split: str = "train") -> tuple[Trajectory, ...]:
    """Runs of a split with a reference pose after their start, by session and time, at most 80 stamps each.

    Raises DataError where there are none, or where the wheels stand in all of them.
    """
    runs = [run for run in trajectories if _covered_poses(run) > 1]
    if not runs and any(run.references is not None for run in trajectories):
        raise DataError(
            f"no trajectory of the split {split} has reference poses along its path, without which what a "
            "matrix lacks is not found; distances, turns and other references serve calibrate, evaluate and compare"
        )
    if not runs:
        raise DataError(
            f"no trajectory of the split {split} has a reference pose between its start and its last wheel sample"
        )
    if max(float(np.abs(run.rates).max()) for run in runs) < _STANDING:
        raise DataError(f"the wheels stand in all runs of the split {split}; drive some, or check the columns omega_*")
    runs.sort(key=lambda run: (str(run.session), run.started_at or 0.0))
    return tuple(_thinned(run) for run in runs)


def with_poses(run: Trajectory, index: Array) -> Trajectory:
    """The run with those of its reference poses that ``index`` chooses."""
    covariances = None if run.pose_covariances is None else run.pose_covariances[index]
    return replace(run, pose_times=run.pose_times[index], poses=run.poses[index], pose_covariances=covariances)


def _covered_poses(run: Trajectory) -> int:
    """The number of poses, the start among them, up to the end of the wheel samples and the overhang."""
    return int((run.pose_times <= run.times[-1] + _OVERHANG).sum())


def _thinned(run: Trajectory) -> Trajectory:
    last = _covered_poses(run) - 1
    if last == len(run.pose_times) - 1 <= _MOST_STAMPS:
        return run
    return with_poses(run, np.unique(np.round(np.linspace(last, 0, min(last, _MOST_STAMPS) + 1)).astype(int)))
