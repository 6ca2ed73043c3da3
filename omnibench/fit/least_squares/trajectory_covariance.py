"""Covariance of a trajectory fit, from its noise model or from the scatter of the runs.

In coordinates in which the information of all runs is the unit matrix, the scatter of d directions, S, has the unit
matrix for its expectation under the noise model. Where commands and sessions scatter no more than their repetitions
explain, which the sandwich tests, it is wider than that at the level a if

    tr S / d > chi2(1 - a; v) / v,                                                                        (1)

v being the degrees of freedom of the sandwich's trace, its Eq. (9). The noise model itself is known from D differences
between runs. The part of the noise that all poses of a run share is one number a difference and coordinate, and a
position has two coordinates of the same variance. The variances of positions have at least

    2 D                                                                                                   (2)

degrees of freedom, more where white noise dominates. Those of headings have one coordinate, and D. (2) is taken for
all numbers: with such a shared part, of the elements of the heading's row 99 % of the intervals hold the truth with
D = 4, and 97 % with D = 6.

Without repetitions the residuals of D runs stand in for differences. Of the 3 D numbers of the shared parts a fit of n
numbers leaves 3 D - n, and for the variances of positions two thirds of these,

    2 D - 2 n / 3.                                                                                        (3)

One is taken where that is less. Likelihood does not know what the fit has taken either, and finds variances that are
too small. So the scatter of the runs, which is corrected for that, stands for the noise model wherever the runs are
enough for it: from five runs of configs/small.yaml, each command driven once, the noise model's intervals hold the
truth in 87 %, those of the scatter in 96 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.least_squares.noise import NoiseEstimate
from omnibench.fit.least_squares.roots import roots_of
from omnibench.fit.least_squares.whitened import Whitened
from omnibench.fit.uncertainty.intervals import EstimatedCovariance
from omnibench.fit.uncertainty.sandwich import CHANCE, Sandwich, Scores, sandwich
from omnibench.robot.kinematics import Array

# Share of the noise model's variance below which the scatter is rounding. The noise is 1e-9 m or rad at least; exact
# models of exact poses leave 1e-14 of its variance, Euler steps in flowers 1e10 times it.
_ROUNDING = 1e-6


class FitCovariance:
    """Covariances of the numbers (n,) of a whitened fit, from its noise model and from the scatter of its runs.

    by_model: inverse of the information, zero along undetermined directions. scatter: the sandwich of
    uncertainty/sandwich.py, None if there are too few runs. Both are zero in rows and columns whose ``unit`` (n,) is 0;
    others are the units of the numbers in which directions are judged as undetermined. curvature: of a robust loss, as
    a share of the information of its weights. freedom_of: degrees of freedom (n,) of a covariance (n, n) at most.
    """

    scatter: Sandwich | None = None

    def __init__(
        self,
        data: Whitened,
        runs: Sequence[Trajectory],
        noise: NoiseEstimate,
        unit: Array,
        curvature: float = 1.0,
        freedom_of: Callable[[Array], Array] | None = None,
    ) -> None:
        scores, information = data.scores * unit, data.information_of_runs * np.outer(unit, unit)
        roots = roots_of(information.sum(axis=0))
        self._noise, self._roots = noise, unit[:, None] * roots
        taken = roots.shape[1] if noise.source == "within runs" else 0
        freedom: Array | float = max(2 * noise.degrees_of_freedom - 2 * taken / 3, 1)  # Eq. (2), (3)
        covariance = self._roots @ self._roots.T
        if freedom_of is not None:
            freedom = np.minimum(freedom, freedom_of(covariance))
        self.by_model = EstimatedCovariance(covariance, freedom)
        if not roots.size:
            return
        with suppress(DataError):
            found = sandwich(Scores(scores, curvature * information, runs, np.zeros(len(unit)), information))
            real = float(np.square(scores @ roots).sum()) > _ROUNDING * roots.shape[1]
            self.scatter = replace(
                found,
                covariance=found.covariance * np.outer(unit, unit),
                clustered=found.clustered and real,
                lack_of_fit=found.lack_of_fit and real,
            )

    def chosen(self, robust: bool) -> tuple[EstimatedCovariance, str]:
        """The covariance of the noise model or, if ``robust``, of the scatter, and its source in words.

        DataError: the runs are too few for their scatter.
        """
        if not robust:
            return self.by_model, f"the noise model ({self._noise.description})"
        if self.scatter is None:
            raise DataError("too few runs for a covariance from their scatter; use covariance: model, weights: noise")
        return EstimatedCovariance(self.scatter.covariance, self.scatter.effective_freedom), self.scatter.words

    @property
    def scatter_stands(self) -> bool:
        """True if the runs scatter significantly more than the noise model, or than their repetitions explain.

        The scatter stands, too, where no repetition shows the noise.
        """
        if self.scatter is None:
            return False
        if self._noise.source == "within runs" or self.scatter.clustered:
            return True
        back = np.linalg.pinv(self._roots)
        values = np.linalg.eigvalsh(back @ self.scatter.covariance @ back.T)
        freedom = self.scatter.freedom_of_trace
        return float(values.mean()) > float(chdtri(freedom, CHANCE)) / freedom  # Eq. (1)
