"""LISDD (Y. Wang, "Where is my physics wrong?", arXiv 2606.23215, 2026), from its abstract; no code was at hand.

Localised, identifiable sparse discovery of discrepancy: the known physics is fitted to a clean regime that is found
automatically; regimes of the operating space are flagged by a calibrated statistic of their residuals' energy; the
missing term is selected there by exhaustive hold-out over the library, and confirmed by an F test on a part of the data
that selection has not seen; Benjamini and Hochberg's procedure controls false discoveries.

Not in the abstract, and so chosen: regimes are quarters of a covariate's range, and single commands; the clean regime
is the half of the commands with least energy; further terms are selected until one is not confirmed. Otherwise than
there, the known physics, here the matrix, is fitted beside the terms over all rows: few commands do not determine it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution
from scipy.stats import false_discovery_control

from omnibench.robot.kinematics import Array

from .problem import NOTHING, Answer, Form, Problem, Regression, held_out_squares, solved

_LEVEL = 0.01  # of both tests
_MOST_TERMS = 3


def answer(problem: Problem, rng: np.random.Generator, form: Form = "whitened", local: bool = False) -> Answer:
    """Localise, select, confirm. local: terms are selected over the flagged regimes alone, and none where none is.

    Otherwise they are selected over all rows, as effects that act everywhere want it.
    """
    regression = problem.regression(form)
    rows = np.ones(len(regression.target), dtype=bool)
    if local:
        flagged, rows = _flagged(problem, regression)
        if not flagged.any():
            return NOTHING
    # Thirds of the runs: to fit, to select, to test
    part = rng.permutation(np.arange(regression.run.max() + 1) % 3)[regression.run]
    fitting, selecting, testing = (regression.products_of(rows & (part == number)) for number in range(3))
    count = int((rows & (part == 2)).sum())
    support: list[int] = []
    confidence: dict[str, float] = {}
    for _ in range(_MOST_TERMS):
        candidates = [group for group in problem.groups if not set(group.index) & set(support)]
        errors = []
        for group in candidates:
            tried = [*support, *group.index]
            errors.append(held_out_squares(selecting, tried, solved(fitting, tried)[0]))
        best = candidates[int(np.argmin(errors))]
        both = [*support, *best.index]
        before, after = solved(testing, support)[1] if support else 0.0, solved(testing, both)[1]
        width, left = len(best.index), count - len(both) - 9
        ratio = (after - before) / width / ((testing[-1, -1] - after) / left)
        chance = float(f_distribution.sf(ratio, width, left))
        if chance > _LEVEL:
            break
        support = both
        if best.effect is not None:
            confidence[best.name] = max(confidence.get(best.name, 0.0), 1 - chance)
    return problem.linear_answer(regression, support, confidence)


def _flagged(problem: Problem, regression: Regression) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """True for each regime whose residuals have more energy than the clean regime's, and for the rows in these."""
    windows = problem.windows(None, 1e-3)  # one an interval
    starts = np.flatnonzero(np.diff(windows.run, prepend=-1))
    window = starts[regression.run] + regression.stamp
    names = [run.command or run.id for run in problem.plain.runs]
    commands = np.unique(names, return_inverse=True)[1][regression.run]
    energy: Array = regression.target**2
    of_command = {name: energy[commands == name].mean() for name in np.unique(commands).tolist()}
    limit = float(np.median(list(of_command.values())))
    clean = np.array([of_command[name] <= limit for name in commands.tolist()])
    regimes = [commands == name for name in of_command if of_command[name] > limit]
    for values in windows.covariates[window].T:
        quarter = np.searchsorted(np.quantile(values, [0.25, 0.5, 0.75]), values)
        regimes += [quarter == number for number in range(4)]
    usual, degrees = float(energy[clean].mean()), int(clean.sum())
    chances = [float(f_distribution.sf(energy[of].mean() / usual, of.sum(), degrees)) if of.any() else 1.0
               for of in regimes]  # fmt: skip
    flagged = np.asarray(false_discovery_control(chances) < _LEVEL)
    rows = np.any([of for of, high in zip(regimes, flagged, strict=True) if high], axis=0) if flagged.any() else ~clean
    return flagged, rows
