"""Many columns against the residuals of many runs, whitened, nuisances of each run eliminated; sums of runs thereof."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.fit.least_squares.noise import Whitener
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

_DETERMINED = 1e-6  # share of a direction that must be left for it to count as one


@dataclass(frozen=True, eq=False)
class Whitened:
    """Residuals and columns of Z runs, independent and of unit variance under the noise.

    residuals: of each run (k,). columns: of each run (k, p). information (p, p): their products over all runs. scores
    (Z, p): of each run, columns times residuals.
    """

    residuals: tuple[Array, ...]
    columns: tuple[Array, ...]
    information: Array
    scores: Array

    def with_residuals(self, residuals: Sequence[Array]) -> Whitened:
        """The same columns against other whitened residuals."""
        return Whitened(tuple(residuals), self.columns, self.information, _scores(self.columns, residuals))


def whitened(
    runs: Sequence[Array],
    columns: Sequence[Array],
    stamps: Sequence[Array],
    noise: Noise,
    nuisances: Sequence[Array],
    deviations: Array,
) -> Whitened:
    """Whiten residuals (K, 3) and columns (K, 3, p) of every run.

    nuisances: derivatives (K, 3, m) of each run's poses by what is its own, of the expected sizes deviations (m,), 0
    for one that is none: what these could explain counts for little.
    """
    whiteners: dict[bytes, Whitener] = {}
    known = deviations > 0
    residuals, whites = [], []
    for own, slopes, times, extra in zip(runs, columns, stamps, nuisances, strict=True):
        key = times.tobytes()
        if key not in whiteners:
            whiteners[key] = Whitener(noise, times)
        everything = np.concatenate([own[..., None], slopes, extra[..., known]], axis=-1)
        white = whiteners[key](everything).reshape(3 * len(own), -1)
        count = 1 + slopes.shape[2]
        free = _without(white[:, :count], white[:, count:] * deviations[known]) if known.any() else white
        residuals.append(np.ascontiguousarray(free[:, 0]))
        whites.append(free[:, 1:])
    return Whitened(tuple(residuals), tuple(whites), _products(whites), _scores(whites, residuals))


def _without(values: Array, nuisances: Array) -> Array:
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
    return np.array([slopes.T @ own for slopes, own in zip(columns, residuals, strict=True)])


@dataclass(frozen=True, eq=False)
class Given:
    """What columns say beyond others that are fitted already.

    information (p, p): what is left of it. scores (Z, p): likewise, of each run. total (p,): information's diagonal
    before, against which a direction counts as determined.
    """

    information: Array
    scores: Array
    total: Array

    def gain(self, index: Sequence[int]) -> float:
        """By how much fitting some columns lowers chi2."""
        roots = self.roots(index)
        return float(np.square(roots.T @ self.scores[:, list(index)].sum(axis=0)).sum())

    def rank(self, index: Sequence[int]) -> int:
        """How many independent directions they have left."""
        return self.roots(index).shape[1]

    def roots(self, index: Sequence[int]) -> Array:
        """(n, d): turns the scores of n columns into d independent ones of unit variance."""
        index = list(index)
        scale = 1 / np.sqrt(np.maximum(self.total[index], 1e-300))
        inner = self.information[np.ix_(index, index)] * np.outer(scale, scale)
        values, vectors = np.linalg.eigh(inner)
        known = values > _DETERMINED
        found: Array = scale[:, None] * vectors[:, known] / np.sqrt(values[known])
        return found

    def share_left(self, index: Sequence[int]) -> float:
        """The largest share of itself that any direction of some columns keeps beyond those that are fitted."""
        index = list(index)
        scale = 1 / np.sqrt(np.maximum(self.total[index], 1e-300))
        return float(np.linalg.eigvalsh(self.information[np.ix_(index, index)] * np.outer(scale, scale))[-1])

    def estimate(self, index: Sequence[int]) -> tuple[Array, Array]:
        """Values (n,) of some columns and their covariance (n, n), by the noise model."""
        roots = self.roots(index)
        covariance = roots @ roots.T
        values: Array = covariance @ self.scores[:, list(index)].sum(axis=0)
        return values, covariance

    def given(self, index: Sequence[int]) -> Given:
        """The same beyond further columns."""
        return _beyond(self.information, self.scores, self.total, index)


def given(data: Whitened, index: Sequence[int]) -> Given:
    """What all columns say beyond the columns ``index``."""
    return _beyond(data.information, data.scores, np.diag(data.information).copy(), index)


def _beyond(information: Array, scores: Array, total: Array, index: Sequence[int]) -> Given:
    index = list(index)
    if not index:
        return Given(information, scores, total)
    roots = Given(information, scores, total).roots(index)
    taken = information[:, index] @ roots
    return Given(information - taken @ taken.T, scores - (scores[:, index] @ roots) @ taken.T, total)
