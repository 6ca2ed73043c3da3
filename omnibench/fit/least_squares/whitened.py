"""Columns and residuals of many runs, whitened under the noise, with the nuisances of each run eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from omnibench.fit.least_squares.nuisances import Weighting, weighed_together
from omnibench.robot.kinematics import Array

# Share of a direction's information that must be left beyond other columns for it to count: a thousandth of its length,
# far above rounding. Half of it and twice change no calibration (tests/studies/constants_fit.py) and no discovery
# (tests/studies/constants.py).
_DETERMINED = 1e-6
_NOTHING = 1e-22  # share of the largest information: with _DETERMINED, columns of 1e-14 of its size are rounding
_KEPT = 4  # Schur complements that are kept: beyond the matrix and beyond all effects, with forms or without (chosen)


@dataclass(frozen=True, eq=False)
class Whitened:
    """Residuals and columns of Z runs, independent and of unit variance under the noise.

    residuals: (k,) for each run. columns: (k, p) for each run. information (p, p): products of the columns, summed over
    all runs. scores (Z, p): columns times residuals of each run.
    """

    residuals: Sequence[Array]
    columns: Sequence[Array]
    information: Array
    scores: Array
    _complements: dict[tuple[int, ...], Given] = field(init=False, default_factory=dict)

    @property
    def information_of_runs(self) -> Array:
        """Products (Z, p, p) of the columns of each run."""
        return np.array([columns.T @ columns for columns in self.columns])

    def only(self, index: Sequence[int]) -> Whitened:
        """Some of the columns, in this order."""
        rows = list(index)
        columns = [np.asarray(of_run[:, rows], dtype=float) for of_run in self.columns]
        return Whitened(self.residuals, columns, self.information[np.ix_(rows, rows)], self.scores[:, rows])

    def less(self, index: Sequence[int], values: Array) -> Whitened:
        """The columns with the residuals less some of the columns times values (n,)."""
        rows, left, scores = list(index), list[Array](), np.empty_like(self.scores)
        for run, (residuals, columns) in enumerate(zip(self.residuals, self.columns, strict=True)):
            left.append(residuals - columns[:, rows] @ values)
            scores[run] = left[-1] @ columns
        return replace(self, residuals=left, scores=scores)

    def given(self, index: Sequence[int]) -> Given:
        """Schur complement of all columns once the columns ``index`` are fitted; the last few are kept."""
        key = tuple(index)
        if key not in self._complements:
            if len(self._complements) >= _KEPT:
                self._complements.pop(next(iter(self._complements)))
            self._complements[key] = _beyond(self.information, self.scores, np.diag(self.information).copy(), key)
        return self._complements[key]


def whitened(
    residuals: Sequence[Array],
    columns: Sequence[Array],
    weightings: Sequence[Weighting],
    slopes: Sequence[Array],
    deviations: Array,
    of_columns: Sequence[Weighting] | None = None,
) -> Whitened:
    """Whiten residuals (K, 3) and columns (K, 3, p) of every run.

    slopes (K, 3, m): derivatives of each run's poses by its nuisances. deviations (m,): their standard deviations, > 0;
    they count as noise that all poses of a run share. of_columns: weightings of the columns, if these are given in
    another way than the residuals.
    """
    count, width = len(residuals), columns[0].shape[2]
    beside = [np.concatenate([each[..., None], extra], axis=2) for each, extra in zip(residuals, slopes, strict=True)]
    free_residuals, free_columns = [np.empty(0)] * count, [np.empty((0, width))] * count
    information, scores = np.zeros((width, width)), np.empty((count, width))
    weighed = weighed_together(weightings, beside), weighed_together(of_columns or weightings, columns)
    for (members, white), (_, fitted) in zip(*weighed, strict=True):
        left = white[..., :1]
        if len(deviations):
            nuisances = white[..., 1:] * deviations
            left, fitted = without(left, nuisances), without(fitted, nuisances)
        flat = fitted.reshape(fitted.shape[0] * fitted.shape[1], width)
        information += flat.T @ flat
        scores[list(members)] = (left.swapaxes(1, 2) @ fitted)[:, 0]
        for index, of_residuals, of_run in zip(members, left, fitted, strict=True):
            free_residuals[index], free_columns[index] = of_residuals[:, 0], of_run
    return Whitened(tuple(free_residuals), tuple(free_columns), information, scores)


def without(values: Array, nuisances: Array) -> Array:
    """Values (..., k, n) less what nuisances (..., k, m) of unit variance explain: (1 + N N')^(-1/2) values."""
    basis, sizes, _ = np.linalg.svd(nuisances, full_matrices=False)
    shrink = 1 - 1 / np.sqrt(1 + sizes**2)
    left: Array = values - basis @ (shrink[..., None] * (basis.swapaxes(-1, -2) @ values))
    return left


@dataclass(frozen=True, eq=False)
class Given:
    """Schur complement of the information matrix: what columns add once others are fitted.

    information (p, p), scores (Z, p): computed from the columns' parts beyond the others. total (p,): diagonal of the
    information before, against which a direction counts as determined.
    """

    information: Array
    scores: Array
    total: Array
    _roots: dict[tuple[int, ...], Array] = field(init=False, default_factory=dict)

    def chi_square(self, index: Sequence[int]) -> float:
        """Chi-square difference: by how much fitting some columns lowers it."""
        roots = self.roots(index)
        return float(np.square(roots.T @ self.scores[:, list(index)].sum(axis=0)).sum())

    def rank(self, index: Sequence[int]) -> int:
        """Degrees of freedom: independent directions that some columns have left."""
        return self.roots(index).shape[1]

    def roots(self, index: Sequence[int]) -> Array:
        """Matrix (n, d) that turns the scores of n columns into d independent ones of unit variance."""
        key = tuple(index)
        if key not in self._roots:
            self._roots[key] = self._roots_of(list(key))
        return self._roots[key]

    def _roots_of(self, index: list[int]) -> Array:
        scale = self.scale(index)
        inner = self.information[np.ix_(index, index)] * np.outer(scale, scale)
        values, vectors = np.linalg.eigh(inner)
        known = values > _DETERMINED
        roots: Array = scale[:, None] * vectors[:, known] / np.sqrt(values[known])
        return roots

    def scale(self, index: Sequence[int]) -> Array:
        """Units (n,) in which columns have length one; of signals that no motion drives they are not their own."""
        least = max(_NOTHING * float(self.total.max(initial=0.0)), 1e-300)
        scale: Array = 1 / np.sqrt(np.maximum(self.total[list(index)], least))
        return scale

    def share_left(self, index: Sequence[int]) -> float:
        """The largest share of itself that any direction of some columns keeps beyond those that are fitted, 0 to 1."""
        index, scale = list(index), self.scale(index)
        return float(np.linalg.eigvalsh(self.information[np.ix_(index, index)] * np.outer(scale, scale))[-1])

    def estimate(self, index: Sequence[int]) -> tuple[Array, Array]:
        """Least-squares values (n,) of some columns, and their covariance (n, n) by the noise model."""
        roots = self.roots(index)
        covariance = roots @ roots.T
        values: Array = covariance @ self.scores[:, list(index)].sum(axis=0)
        return values, covariance

    def only(self, index: Sequence[int]) -> Given:
        """Some of the columns, in this order."""
        rows = list(index)
        return Given(self.information[np.ix_(rows, rows)], self.scores[:, rows], self.total[rows])

    def given(self, index: Sequence[int]) -> Given:
        """The Schur complement beyond further columns."""
        return _beyond(self.information, self.scores, self.total, index)


def given(data: Whitened, index: Sequence[int]) -> Given:
    """Schur complement of all columns once the columns ``index`` are fitted."""
    return data.given(index)


def _beyond(information: Array, scores: Array, total: Array, index: Sequence[int]) -> Given:
    index = list(index)
    if not index:
        return Given(information, scores, total)
    roots = Given(information, scores, total).roots(index)
    taken = information[:, index] @ roots
    return Given(information - taken @ taken.T, scores - (scores[:, index] @ roots) @ taken.T, total)
