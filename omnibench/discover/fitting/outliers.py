"""Reference poses that jump: they contradict the other poses of their run.

Let r be the residuals of a run along one axis, normal with the inverse covariance P. Given all others, residual i is
normal with the mean r_i - (P r)_i / P_ii and the variance 1 / P_ii (Rasmussen and Williams, Gaussian processes for
machine learning, 2006, Eq. 5.12), so that it lies so many standard deviations from what the others predict:

    |(P r)_i| / sqrt(P_ii).                                                                                         (1)

The score of a pose is the largest of those in x, y and heading.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.least_squares.noise import Whitener
from omnibench.fit.least_squares.usable_runs import with_poses
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

# tests/benchmarks/constants.py varies each number by 0.5 and 2: on a small set with heading drift no verdict and no
# name changes.
_JUMP = 4.5  # score, Eq. (1), from which on a pose jumps: noise alone makes it of one normal pose in 49,000
_MOST_JUMPS = 0.1  # share of a run's poses that may be left out
_RARE = 0.08  # share of all poses: where more seem to jump, the model is wrong in a way that varies fast
_MANY, _MANY_BY_CHANCE = 0.95, 2.39  # a quantile of all scores, and its value for the largest of three normal ones


def without_jumps(
    runs: Sequence[Trajectory], residuals: Sequence[Array], noise: Noise
) -> tuple[tuple[Trajectory, ...], int]:
    """The runs without the poses that jump, and how many these are.

    A pose jumps where its residual lies 4.5 standard deviations from what the run's other residuals predict. Errors of
    a model seldom vary as fast as that. Where more than 8 % of the poses seem to jump they do, and the limit is raised
    in proportion to the usual score.
    """
    kept, count = _below(runs, residuals, noise, _JUMP)
    poses = sum(len(values) for values in residuals)
    if count <= _RARE * poses:
        return kept, count
    scores = [
        _scores(values, *_precisions(noise, run.pose_times[1:])) for run, values in zip(runs, residuals, strict=True)
    ]
    usual = float(np.quantile(np.concatenate(scores), _MANY)) / _MANY_BY_CHANCE
    return _below(runs, residuals, noise, _JUMP * max(1.0, usual))


def _below(
    runs: Sequence[Trajectory], residuals: Sequence[Array], noise: Noise, limit: float
) -> tuple[tuple[Trajectory, ...], int]:
    """The runs without poses whose scores exceed a limit, and how many these are; the worst goes first."""
    precisions: dict[bytes, tuple[Array, Array]] = {}
    kept, count = [], 0
    for run, values in zip(runs, residuals, strict=True):
        stamps = run.pose_times[1:]
        keep = np.ones(len(stamps), dtype=bool)
        for _ in range(int(np.ceil(_MOST_JUMPS * len(stamps)))):
            key = stamps[keep].tobytes()
            if key not in precisions:
                precisions[key] = _precisions(noise, stamps[keep])
            score = _scores(values[keep], *precisions[key])
            if keep.sum() < 3 or score.max() < limit:
                break
            keep[np.flatnonzero(keep)[score.argmax()]] = False
        count += int((~keep).sum())
        whole = bool(keep.all())
        kept.append(run if whole else with_poses(run, np.concatenate([[True], keep])))
    return tuple(kept), count


def _precisions(noise: Noise, stamps: Array) -> tuple[Array, Array]:
    """Inverse covariances (K, K) of the positions and of the headings."""
    identity = np.repeat(np.eye(len(stamps))[:, None, :], 3, axis=1)
    white = Whitener(noise, stamps)(identity)
    return white[:, 0].T @ white[:, 0], white[:, 2].T @ white[:, 2]


def _scores(residuals: Array, position: Array, heading: Array) -> Array:
    """Distance (K,) of each pose from what the other poses predict, in standard deviations.

    The largest of those in x, y and heading. residuals (K, 3); position, heading (K, K): inverse covariances.
    """
    of_position = (position @ residuals[:, :2]) / np.sqrt(np.diag(position))[:, None]
    of_heading = (heading @ residuals[:, 2:]) / np.sqrt(np.diag(heading))[:, None]
    scores: Array = np.abs(np.concatenate([of_position, of_heading], axis=1)).max(axis=1)  # Eq. (1)
    return scores
