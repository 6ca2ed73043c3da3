"""Screening: all that could explain what the plain matrix leaves, as whitened columns against its residuals.

Encoder quantisation is what a wheel turns between the last tick and standstill, which is not measured. No effect
explains it, and it may look like one where a controller stops the wheels at the same place each time. A
wheel's true angle is then off the measured one by the same part of a tick in all repetitions of a command, uniform
within half a tick: a quarter in the mean. With q the changes of the poses by such a quarter, of each wheel at its start
and at its rest, whitened, and R the roots of the information of columns X beyond others (R'X'XR = I), columns lower the
chi-square that the changes make by at most

    (sum over commands, wheels, start and rest of |R' X' q|)^2,                                                     (1)

which they reach if all of these happen to push into one direction.

An angle of n ticks is known to n e ticks, e being the relative error of rates as written. Any angle is that near to a
whole number of ticks with a probability of 2 n e, at most 1, so that angles n_i are multiples of a tick by chance with

    P = product of min(1, 2 n_i e).                                                                                 (2)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting import Extended, Fit, paths_of
from omnibench.discover.held_out import folds_of_repetitions, is_confirmed, kinds_of_runs
from omnibench.discover.regressors.significance import ColumnStore, Group, Significance, significance_of
from omnibench.discover.selection.evidence import Groups, make_groups
from omnibench.fit.noise import grouped
from omnibench.fit.trajectory_fit import Given, Whitened, given
from omnibench.robot.kinematics import Array, in_the_middle, rotated

_FEWEST = 50  # samples in which a wheel turns (chosen): with fewer, the smallest gap need not be one tick
_DECADES = 20.0  # -log10 of the chance, Eq. (2), that angles are multiples: no set of recordings has so many (chosen)
_FINEST = 10_000  # ticks in the largest sample: a finer one is 0.01 % of the motion, less than a wheel slips
_MEAN = 0.25  # ticks: mean size of an error that is uniform within half a tick
_WHOLE = 1e-3  # e, share by which angles may differ from whole ticks: rates written with four digits differ by 1e-4


def quantisation_steps(runs: Sequence[Trajectory]) -> Array:
    """The angle (N,) of a tick of each wheel's encoder, rad; 0 where measured angles are no multiples of one."""
    turned = np.concatenate([run.rates * np.diff(run.times, prepend=0.0)[:, None] for run in runs])
    return np.array([_tick(np.abs(of_wheel)) for of_wheel in turned.T])


def _tick(steps: Array) -> float:
    turning = steps[steps > 0]
    if len(turning) < _FEWEST:
        return 0.0
    floor = turning.max() / _FINEST
    ordered = np.sort(np.append(turning, 0.0))
    gaps = np.diff(ordered)
    gaps = gaps[gaps > floor]
    if not len(gaps):
        return 0.0
    tick = float(gaps.min())
    near = np.round(turning / tick)
    if not near.any():
        return 0.0
    tick = float(turning @ near / (near @ near))  # least squares over all samples: more exact than the smallest gap
    near = np.maximum(np.round(turning / tick), 1)
    if -np.log10(np.minimum(2 * _WHOLE * near, 1)).sum() < _DECADES:  # Eq. (2)
        return 0.0
    return tick if (np.abs(turning / tick - near) < _WHOLE * near).all() else 0.0


class EncoderQuantisation:
    """Upper bounds on the chi-square that encoder quantisation lets columns explain, if every command conspired."""

    def __init__(self, fit: Fit, data: Whitened) -> None:
        """data: the columns of every run of the fit."""
        self.steps = quantisation_steps(fit.runs)
        self._data = data
        if not self.steps.any():
            return
        errors = [
            _quarter_ticks(run, run.poses[1:] - residuals, fit.model.matrix, self.steps)
            for run, residuals in zip(fit.runs, fit.residuals, strict=True)
        ]
        of_runs = zip(data.columns, fit.whitened(errors).columns, strict=True)
        products = [columns.T @ of_errors for columns, of_errors in of_runs]
        members = grouped([run.command or run.id for run in fit.runs])
        self._products = np.concatenate([sum(products[run] for run in runs) for runs in members], axis=1)

    def chi_square(self, index: Sequence[int], beyond: Sequence[int]) -> float:
        """The largest chi-square difference (0 without ticks) by the columns ``index`` beyond others."""
        if not self.steps.any():
            return 0.0
        left = given(self._data, beyond)
        taken = given(self._data, []).roots(beyond)
        products = self._products[list(index)]
        products = products - (self._data.information[np.ix_(index, beyond)] @ taken) @ (
            taken.T @ self._products[list(beyond)]
        )
        return float(np.linalg.norm(left.roots(index).T @ products, axis=0).sum() ** 2)  # Eq. (1)


def _quarter_ticks(run: Trajectory, poses: Array, matrix: Array, ticks: Array) -> Array:
    """Changes (K, 3, 2N) of a run's poses (K, 3) by a quarter of a tick of each wheel: at its start, and its rest."""
    turning = run.rates != 0
    columns = np.zeros((len(poses), 3, 2 * len(ticks)))
    stamps, known = run.pose_times[1:], np.vstack([run.start, poses])
    for wheel in np.flatnonzero(turning.any(axis=0) & (ticks > 0)):
        moving = np.flatnonzero(turning[:, wheel])
        first, last = moving[0], moving[-1]
        moments = ((first, run.times[first - 1] if first else 0.0), (last, run.times[last]))
        for column, (sample, moment) in zip((wheel, wheel + len(ticks)), moments, strict=True):
            later = stamps > moment - 1e-9
            x, y, heading = (float(np.interp(moment, run.pose_times, values)) for values in known.T)
            moved = _column(run, matrix, int(wheel), int(sample))
            # Later poses by a radian more of the wheel at the place (x, y, heading).
            turn = moved[2] * np.column_stack([y - poses[later, 1], poses[later, 0] - x])
            changes = np.column_stack([rotated(moved, heading) + turn, np.full(len(turn), moved[2])])
            columns[later, :, column] = _MEAN * ticks[wheel] * changes
    return columns


def _column(run: Trajectory, matrix: Array, wheel: int, sample: int) -> Array:
    """The motion (3,) in the robot's frame by a radian more of a wheel in a sample, m, m, rad."""
    column: Array
    if run.drive is None:
        column = matrix[:, wheel]
    else:
        assert run.steering is not None  # the drive steers
        part = slice(sample, sample + 1)
        by_rate, _ = run.drive.slopes(run.rates[part], in_the_middle(run.steering)[part])
        column = matrix @ by_rate[0, :, wheel]
    return column


# s: shorter wheel samples are merged up to this duration, as covariates vary more slowly. tests/studies/constants.py
# varies it by 0.5 and 2: on a small set with heading drift no verdict and no name changes.
_COARSE = 0.03


@dataclass(frozen=True, eq=False)
class Screening:
    """Columns of all candidates against the residuals of the plain matrix.

    folds (Z,): by which runs are held out. quantisation: the encoders', None where it does not matter. kinds: number of
    kinds of motion that the runs drive, None where these do not matter.
    """

    groups: Groups
    data: Whitened
    folds: NDArray[np.intp]
    quantisation: EncoderQuantisation | None = None
    kinds: int | None = None

    def beyond_matrix(self) -> Given:
        """Schur complement of all columns once the matrix is fitted."""
        return given(self.data, self.groups.matrix.index)

    def index_with(self, chosen: Sequence[Group]) -> list[int]:
        """The column numbers of the matrix, then those of the chosen groups."""
        return [*self.groups.matrix.index, *(index for group in chosen for index in group.index)]

    def confirms(self, others: Sequence[Group], group: Group) -> bool:
        """True if held-out runs gain significantly by a group beyond the matrix and others."""
        return is_confirmed(self.data, self.index_with(others), group.index, self.folds)

    def quantisation_chi_square(self, group: Group, beyond: Sequence[Group] = ()) -> float:
        """The chi-square difference that encoder quantisation could make for a group, beyond the matrix and others."""
        if self.quantisation is None:
            return 0.0
        return self.quantisation.chi_square(group.index, self.index_with(beyond))


def screen_plain(plain: Fit, without: Sequence[str]) -> Screening:
    """Screen the residuals of the plain matrix. without: names of effects that are not to be tried."""
    return _screened(plain, plain.nuisance_free_residuals, _groups_at(plain, without))


def screen_extended(extended: Extended, without: Sequence[str]) -> Screening:
    """Screen with the noise, nuisances and poses of an extended model, its effects put back into the residuals."""
    return _screened(extended.fit, extended.residuals_without_effects, _groups_at(extended.fit, without))


def screen_again(extended: Extended, earlier: Screening) -> Screening:
    """Screen as ``screen_extended``, with the columns of an earlier screening."""
    return _screened(extended.fit, extended.residuals_without_effects, earlier.groups)


def significance_left(extended: Extended, screening: Screening, rng: np.random.Generator) -> Significance:
    """Significance of the generic bases beyond all that an extended model holds, smooth terms among it."""
    fit, groups = extended.fit, screening.groups
    data = _whitened(fit, groups, fit.nuisance_free_residuals, extended.columns)
    width = extended.columns[0].shape[2]
    first = groups.bases[0].index[0] if groups.bases else 0
    bases = [replace(group, index=tuple(width + column - first for column in group.index)) for group in groups.bases]
    found = significance_of(data, range(width), bases, rng)
    return replace(found, groups=groups.bases)


def _groups_at(fit: Fit, without: Sequence[str]) -> Groups:
    return make_groups(paths_of(fit, _COARSE), fit.runs, without)


def _screened(fit: Fit, residuals: Sequence[Array], groups: Groups) -> Screening:
    data = _whitened(fit, groups, residuals)
    kinds = len(set(kinds_of_runs(fit).tolist()))
    return Screening(groups, data, folds_of_repetitions(fit.runs), EncoderQuantisation(fit, data), kinds)


def _whitened(fit: Fit, groups: Groups, residuals: Sequence[Array], fitted: Sequence[Array] | None = None) -> Whitened:
    """The groups' columns and residuals (K, 3), whitened, some runs at a time.

    fitted (K, 3, n): of a model; then its columns and those of the generic bases alone.
    """
    left, columns, scores, information = list[Array](), ColumnStore(), list[Array](), np.zeros(())
    first = groups.bases[0].index[0] if groups.bases else None
    for runs, steps in groups.columns.blocks():
        if fitted is not None:
            of_model = [np.diff(of_run, axis=0, prepend=0.0) for of_run in fitted[runs]]
            of_bases = [of_run[..., first:] for of_run in steps]
            steps = [np.concatenate(both, axis=2) for both in zip(of_model, of_bases, strict=True)]
        white = fit.whitened_steps(steps, residuals, runs)
        left += white.residuals
        scores.append(white.scores)
        information = information + white.information
        columns.append(np.concatenate(white.columns), [len(of_run) for of_run in white.columns])
    return Whitened(left, columns, information, np.concatenate(scores))
