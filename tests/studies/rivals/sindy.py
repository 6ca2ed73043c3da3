"""PySINDy: sequentially thresholded least squares (STLSQ) over the library, with the inclusion of ensemble-SINDy.

S. L. Brunton, J. L. Proctor and J. N. Kutz, Discovering governing equations from data by sparse identification of
nonlinear dynamical systems, 2016; weak form: D. A. Messenger and D. M. Bortz, Weak SINDy, 2021; inclusion
probabilities: U. Fasel et al., Ensemble-SINDy, 2022.

pysindy gets the triangular factor of the rows instead of the rows, which has the same least squares. The threshold, in
standard errors of the noise, is the largest within one standard error of the least held-out error.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from pysindy import STLSQ

from omnibench.robot.kinematics import Array

from .problem import NOTHING, Answer, Form, Problem, held_out_squares

_BLOCKS, _FOLDS = 20, 4
_THRESHOLDS = (4.0, 6.0, 9.0, 13.0)


def answer(
    problem: Problem, rng: np.random.Generator, form: Form = "whitened", alpha: float = 0.05, bags: int = 10
) -> Answer:
    """Choose terms. alpha: of the ridge. bags: bootstraps.

    The library is the catalogue alone or with all generic functions, whichever predicts held-out runs better.
    """
    regression = problem.regression(form)
    blocks = regression.blocks(_BLOCKS, rng)
    named = [column for group in problem.groups if group.effect is not None for column in group.index]
    fits = [_Library.of(blocks, used, alpha) for used in (named, list(range(blocks.shape[1] - 1)))]
    best = max(fits, key=lambda each: each.gain)
    if best.gain < 2 * best.error:
        return NOTHING
    counts: dict[str, float] = {}
    for _ in range(bags):
        bag = np.tensordot(rng.multinomial(_BLOCKS, np.full(_BLOCKS, 1 / _BLOCKS)), blocks, 1)
        chosen = set(best.chosen(bag, alpha))
        for name in {group.name for group in problem.groups if group.effect is not None and chosen & set(group.index)}:
            counts[name] = counts.get(name, 0.0) + 1 / bags
    return problem.linear_answer(regression, best.chosen(blocks.sum(axis=0), alpha), counts)


@dataclass(frozen=True)
class _Library:
    """Some columns, with the threshold chosen by held-out runs, and what these gain, with its standard error."""

    used: list[int]
    threshold: float
    gain: float
    error: float

    @classmethod
    def of(cls, blocks: Array, used: list[int], alpha: float) -> _Library:
        of_library = blocks[:, [*used, -1]][:, :, [*used, -1]]
        folds, every = np.arange(_BLOCKS) % _FOLDS, list(range(len(used)))
        gains = np.empty((len(_THRESHOLDS), _FOLDS))
        for number, threshold in enumerate(_THRESHOLDS):
            for fold in range(_FOLDS):
                values = _stlsq(of_library[folds != fold].sum(axis=0), threshold, alpha)
                held_out = of_library[folds == fold].sum(axis=0)
                gains[number, fold] = held_out[-1, -1] - held_out_squares(held_out, every, values)
        means, errors = gains.mean(axis=1), gains.std(axis=1, ddof=1) / np.sqrt(_FOLDS)
        best = int(means.argmax())
        near = means >= means[best] - errors[best]
        threshold = max(size for size, is_near in zip(_THRESHOLDS, near, strict=True) if is_near)
        return cls(used, threshold, float(means[best]), float(errors[best]))

    def chosen(self, products: Array, alpha: float) -> list[int]:
        """Columns that are left over rows with these products."""
        values = _stlsq(products[np.ix_([*self.used, -1], [*self.used, -1])], self.threshold, alpha)
        return [self.used[column] for column in np.flatnonzero(values)]


def _stlsq(products: Array, threshold: float, alpha: float) -> Array:
    """Values (p,) by STLSQ over rows with these products (p + 1, p + 1)."""
    inner = products[:-1, :-1]
    root = np.linalg.cholesky(inner + np.diag(1e-8 * np.diag(inner) + 1e-12))
    target = np.linalg.solve(root, products[:-1, -1])
    optimiser = STLSQ(threshold=threshold, alpha=alpha, max_iter=20, normalize_columns=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # all terms below the threshold
        optimiser.fit(root.T, target[:, None])
    values: Array = np.asarray(optimiser.coef_).ravel()
    return values
