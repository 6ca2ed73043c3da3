"""Outliers: reference poses that contradict the other poses of their run, where nothing like it recurs.

Let r be the residuals of a run along one axis, normal with the inverse covariance P. Given all others, residual i is
normal with the mean r_i - (P r)_i / P_ii and the variance 1 / P_ii (Rasmussen and Williams, Gaussian processes for
machine learning, 2006, Eq. 5.12), so that it lies so many standard deviations from what the others predict:

    |(P r)_i| / sqrt(P_ii).                                                                                         (1)

The score of a pose is the largest of those in x, y and heading. What a model lacks raises scores, too, but wherever the
robot does the same again: at one stamp of a command's repetitions, or of most runs. An outlier stands out of these.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.fit.noise import Whitener, whiteners
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

# tests/studies/constants.py varies each number by 0.5 and 2: on a small set with heading drift no verdict and no
# name changes.
_JUMP = 4.5  # score, Eq. (1), from which on a pose is an outlier: noise alone makes it of one normal pose in 49,000
_MOST_JUMPS = 0.1  # share of a run's poses that may be outliers
_RARE = 0.08  # share of all poses: where more seem to be outliers, the model is wrong in a way that varies fast
_MANY, _MANY_BY_CHANCE = 0.95, 2.39  # a quantile of all scores, and its value for the largest of three normal ones
_OFTEN, _OFTEN_BY_CHANCE = 0.8, 1.80  # likewise, of the scores at one stamp in other runs


def inliers_of(runs: Sequence[Trajectory], residuals: Sequence[Array], noise: Noise) -> tuple[NDArray[np.bool_], ...]:
    """True (K,) for the poses of each run that are no outliers. residuals (K, 3): in the frame of the run's start.

    A score of 4.5 makes an outlier, or 4.5 times what is usual for the scores at its stamp in other runs. Where more
    than 8 % of the poses seem to be outliers they are not, and the limit rises in proportion to the usual score.
    """
    whitening = whiteners(noise, [run.pose_times[1:] for run in runs])
    scores = [_scores(*each) for each in zip(whitening, residuals, strict=True)]
    every = np.concatenate(scores)
    if every.max() < _JUMP:
        return tuple(np.ones(len(of_run), dtype=bool) for of_run in scores)
    limits = _JUMP * np.maximum(_usual_at_stamps(runs, scores), 1.0)

    def below(limits: Array) -> tuple[NDArray[np.bool_], ...]:
        of_runs = np.split(limits, np.cumsum([len(of_run) for of_run in scores])[:-1])
        return tuple(_below(noise, *each) for each in zip(runs, residuals, scores, of_runs, strict=True))

    inliers = below(limits)
    if sum(int((~of_run).sum()) for of_run in inliers) <= _RARE * len(every):
        return inliers
    return below(np.maximum(limits, _JUMP * float(np.quantile(every, _MANY)) / _MANY_BY_CHANCE))


def _below(noise: Noise, run: Trajectory, residuals: Array, scores: Array, limits: Array) -> NDArray[np.bool_]:
    """True (K,) for the poses of a run whose scores are below their limits; the worst goes first."""
    inliers, stamps = np.ones(len(limits), dtype=bool), run.pose_times[1:]
    for _ in range(int(np.ceil(_MOST_JUMPS * len(limits)))):
        excess = scores / limits[inliers]
        if len(excess) < 3 or excess.max() < 1:
            break
        inliers[np.flatnonzero(inliers)[excess.argmax()]] = False
        scores = _scores(Whitener(noise, stamps[inliers]), residuals[inliers])
    return inliers


def _scores(whitener: Whitener, residuals: Array) -> Array:
    """Distances (K,) of poses from what the others of their run predict, in standard deviations, Eq. (1)."""
    errors, variances = whitener.left_out(residuals)
    scores: Array = np.abs(errors / np.sqrt(variances)).max(axis=1)
    return scores


def _usual_at_stamps(runs: Sequence[Trajectory], scores: Sequence[Array]) -> Array:
    """The usual score of other runs at each pose's stamp, as a share of that by chance; 0 where there are none.

    Of repetitions of a command and of all runs, at the time from the start and from the end: the largest.
    """
    interval = float(np.median(np.concatenate([np.diff(run.pose_times) for run in runs])))
    owner = np.repeat(np.arange(len(runs)), [len(of_run) for of_run in scores])
    every, usual = np.concatenate(scores), np.zeros(len(owner))
    names: dict[Hashable, int] = {}
    commands = np.array([names.setdefault((run.session, run.command or run.id), len(names)) for run in runs])
    for origin in (0, -1):
        moments = np.concatenate([(run.pose_times[1:] - run.pose_times[origin]) / interval for run in runs])
        stamps = np.round(moments).astype(int)
        for driven in (commands[owner], np.zeros(len(owner), dtype=int)):
            groups = np.unique(np.column_stack([driven, stamps]), axis=0, return_inverse=True)[1].ravel()
            np.maximum(usual, _quantile_of_others(groups, owner, every), out=usual)
    return usual / _OFTEN_BY_CHANCE


def _quantile_of_others(groups: NDArray[np.intp], owner: NDArray[np.intp], scores: Array) -> Array:
    """The quantile (S,) of the scores (S,) that the other runs of each one's group have, 0 where it has no other run.

    A run counts once in a group, by its largest score there.
    """
    members, member = np.unique(np.column_stack([groups, owner]), axis=0, return_inverse=True)
    largest = np.zeros(len(members))
    np.maximum.at(largest, member.ravel(), scores)
    order = np.lexsort([largest, members[:, 0]])
    _, firsts, counts = np.unique(members[order, 0], return_index=True, return_counts=True)
    first, count = np.repeat(firsts, counts), np.repeat(counts, counts)
    place = np.floor(_OFTEN * np.maximum(count - 2, 0)).astype(int)  # of the quantile among the others
    place += np.arange(len(order)) - first <= place  # among all, where the run itself stands before it
    place = np.minimum(place, count - 1)
    of_others = np.empty(len(members))
    of_others[order] = np.where(count > 1, largest[order][first + place], 0.0)
    quantiles: Array = of_others[member.ravel()]
    return quantiles


class InlierWhitener:
    """The whitening of a run's inliers: residuals (K, 3) or (K, 3, n) of all poses to (k, 3) or (k, 3, n)."""

    def __init__(self, noise: Noise, stamps: Array, inliers: NDArray[np.bool_]) -> None:
        self._whitener, self._inliers = Whitener(noise, stamps[inliers]), inliers
        self._whole = bool(inliers.all())

    def __call__(self, residuals: Array) -> Array:
        """Whitened residuals, or derivatives of residuals, of the inliers."""
        return self._whitener(residuals if self._whole else residuals[self._inliers])

    def of_differences(self, differences: Array) -> Array:
        """Whitened residuals of the inliers by the differences (K, 3, n) from one pose to the next, the first from 0.

        These may be overwritten.
        """
        if not self._whole:
            rows = np.flatnonzero(self._inliers)
            differences = np.add.reduceat(differences[: rows[-1] + 1], np.append(0, rows[:-1] + 1), axis=0)
        return self._whitener.of_differences(differences)

    def weighted(self, white: Array) -> Array:
        """Inverse covariance times the residuals (K, 3) that were whitened to (k, 3); 0 for outliers."""
        values = np.zeros((len(self._inliers), 3))
        values[self._inliers] = -np.diff(self._whitener.transposed(white), axis=0, append=0.0)
        return values
