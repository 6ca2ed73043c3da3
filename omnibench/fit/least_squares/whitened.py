"""Columns and residuals of many runs, whitened under the noise, with the nuisances of each run eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.fit.least_squares.nuisances import Weighting
from omnibench.robot.kinematics import Array

# Share of a direction's information that must be left beyond other columns for it to count: a thousandth of its length,
# far above rounding. Half of it and twice change no calibration (tests/benchmarks/constants_fit.py) and no discovery
# (tests/benchmarks/constants.py).
_DETERMINED = 1e-6


@dataclass(frozen=True, eq=False)
class Whitened:
    """Residuals and columns of Z runs, independent and of unit variance under the noise.

    residuals: (k,) for each run. columns: (k, p) for each run. information (p, p): products of the columns, summed over
    all runs. scores (Z, p): columns times residuals of each run.
    """

    residuals: tuple[Array, ...]
    columns: tuple[Array, ...]
    information: Array
    scores: Array

    @property
    def information_of_runs(self) -> Array:
        """Products (Z, p, p) of the columns of each run."""
        return np.array([columns.T @ columns for columns in self.columns])

    def with_residuals(self, residuals: Sequence[Array]) -> Whitened:
        """These columns with other whitened residuals."""
        return Whitened(tuple(residuals), self.columns, self.information, _scores(self.columns, residuals))


def whitened(
    residuals: Sequence[Array],
    columns: Sequence[Array],
    weightings: Sequence[Weighting],
    slopes: Sequence[Array],
    deviations: Array,
) -> Whitened:
    """Whiten residuals (K, 3) and columns (K, 3, p) of every run.

    slopes (K, 3, m): derivatives of each run's poses by its nuisances. deviations (m,): their standard deviations, > 0;
    they count as noise that all poses of a run share.
    """
    free_residuals, free_columns = [], []
    for values, fitted, weigh, extra in zip(residuals, columns, weightings, slopes, strict=True):
        white = weigh(np.concatenate([values[..., None], fitted, extra], axis=-1))
        white = white.reshape(-1, white.shape[-1])
        count = 1 + fitted.shape[2]
        free = without(white[:, :count], white[:, count:] * deviations) if len(deviations) else white
        free_residuals.append(np.ascontiguousarray(free[:, 0]))
        free_columns.append(free[:, 1:])
    return Whitened(
        tuple(free_residuals), tuple(free_columns), _products(free_columns), _scores(free_columns, free_residuals)
    )


def without(values: Array, nuisances: Array) -> Array:
    """Values (k, n) less what nuisances (k, m) of unit variance explain: (1 + N N')^(-1/2) values."""
    basis, sizes, _ = np.linalg.svd(nuisances, full_matrices=False)
    shrink = 1 - 1 / np.sqrt(1 + sizes**2)
    return values - basis @ (shrink[:, None] * (basis.T @ values))


def _products(columns: Sequence[Array]) -> Array:
    total = np.zeros((columns[0].shape[1],) * 2)
    for part in range(0, len(columns), 32):
        stacked = np.concatenate(columns[part : part + 32])
        total += stacked.T @ stacked
    return total


def _scores(columns: Sequence[Array], residuals: Sequence[Array]) -> Array:
    return np.array([slopes.T @ values for slopes, values in zip(columns, residuals, strict=True)])


@dataclass(frozen=True, eq=False)
class Given:
    """Schur complement of the information matrix: what columns add once others are fitted.

    information (p, p), scores (Z, p): computed from the columns' parts beyond the others. total (p,): diagonal of the
    information before, against which a direction counts as determined.
    """

    information: Array
    scores: Array
    total: Array

    def chi_square(self, index: Sequence[int]) -> float:
        """Chi-square difference: by how much fitting some columns lowers it."""
        roots = self.roots(index)
        return float(np.square(roots.T @ self.scores[:, list(index)].sum(axis=0)).sum())

    def rank(self, index: Sequence[int]) -> int:
        """Degrees of freedom: independent directions that some columns have left."""
        return self.roots(index).shape[1]

    def roots(self, index: Sequence[int]) -> Array:
        """Matrix (n, d) that turns the scores of n columns into d independent ones of unit variance."""
        index = list(index)
        scale = 1 / np.sqrt(np.maximum(self.total[index], 1e-300))
        inner = self.information[np.ix_(index, index)] * np.outer(scale, scale)
        values, vectors = np.linalg.eigh(inner)
        known = values > _DETERMINED
        roots: Array = scale[:, None] * vectors[:, known] / np.sqrt(values[known])
        return roots

    def share_left(self, index: Sequence[int]) -> float:
        """The largest share of itself that any direction of some columns keeps beyond those that are fitted, 0 to 1."""
        index = list(index)
        scale = 1 / np.sqrt(np.maximum(self.total[index], 1e-300))
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
    return _beyond(data.information, data.scores, np.diag(data.information).copy(), index)


def _beyond(information: Array, scores: Array, total: Array, index: Sequence[int]) -> Given:
    index = list(index)
    if not index:
        return Given(information, scores, total)
    roots = Given(information, scores, total).roots(index)
    taken = information[:, index] @ roots
    return Given(information - taken @ taken.T, scores - (scores[:, index] @ roots) @ taken.T, total)
