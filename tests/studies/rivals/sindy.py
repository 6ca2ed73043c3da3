"""PySINDy: sequentially thresholded least squares (STLSQ) over the library, with the inclusion of ensemble-SINDy.

S. L. Brunton, J. L. Proctor and J. N. Kutz, Discovering governing equations from data by sparse identification of
nonlinear dynamical systems, 2016; weak form: D. A. Messenger and D. M. Bortz, Weak SINDy, 2021; inclusion
probabilities: U. Fasel et al., Ensemble-SINDy, 2022.

pysindy gets the triangular factor of the rows instead of the rows, which has the same least squares. The threshold, in
standard errors of the noise, is the largest within one standard error of the least held-out error.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import numpy as np
from pysindy import STLSQ

from omnibench.robot.kinematics import Array

from .problem import NOTHING, Answer, Form, Problem, held_out_squares

_BLOCKS, _FOLDS = 20, 4
_THRESHOLDS = (4.0, 6.0, 9.0, 13.0)


def answer(
    problem: Problem,
    rng: np.random.Generator,
    form: Form = "whitened",
    alpha: float = 0.05,
    bags: int = 10,
    *,
    catalogue: bool = False,
) -> Answer:
    """Choose terms. alpha: of the ridge. bags: bootstraps. catalogue: the library holds no generic functions."""
    regression = problem.regression(form)
    groups = [group for group in problem.groups if group.effect is not None or not catalogue]
    used = [column for group in groups for column in group.index]
    blocks = regression.blocks(_BLOCKS, rng)[:, [*used, -1]][:, :, [*used, -1]]
    folds = np.arange(_BLOCKS) % _FOLDS
    every = list(range(len(used)))
    gains = np.empty((len(_THRESHOLDS), _FOLDS))
    for number, threshold in enumerate(_THRESHOLDS):
        for fold in range(_FOLDS):
            values = _stlsq(blocks[folds != fold].sum(axis=0), threshold, alpha)
            held_out = blocks[folds == fold].sum(axis=0)
            gains[number, fold] = held_out[-1, -1] - held_out_squares(held_out, every, values)
    means, errors = gains.mean(axis=1), gains.std(axis=1, ddof=1) / np.sqrt(_FOLDS)
    best = int(means.argmax())
    if means[best] < 2 * errors[best]:
        return NOTHING
    threshold = max(size for size, mean in zip(_THRESHOLDS, means, strict=True) if mean >= means[best] - errors[best])
    support = np.flatnonzero(_stlsq(blocks.sum(axis=0), threshold, alpha))
    counts: dict[str, float] = {}
    for _ in range(bags):
        bag = rng.multinomial(_BLOCKS, np.full(_BLOCKS, 1 / _BLOCKS))
        chosen = {used[column] for column in np.flatnonzero(_stlsq(np.tensordot(bag, blocks, 1), threshold, alpha))}
        for name in {group.name for group in groups if group.effect is not None and chosen & set(group.index)}:
            counts[name] = counts.get(name, 0.0) + 1 / bags
    confidence: Mapping[str, float] = counts
    return problem.linear_answer(regression, [used[column] for column in support], confidence)


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
