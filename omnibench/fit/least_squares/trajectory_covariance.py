"""Covariance of a trajectory fit, from its noise model or from the scatter of the runs.

Scores s_z and information L_z of the runs z are said in coordinates in which the information of all runs is the unit
matrix, as in uncertainty/sandwich.py. If one vector of n numbers fits all commands g, and q_g = rank L_g, then

    F = [sum_g s_g' L_g^+ s_g / (sum_g q_g - n)]
        / [(sum_z s_z' L_z^+ s_z - sum_g s_g' L_g^+ s_g) / sum_g (n_g - 1) q_g]                           (1)

has the F distribution whatever the size of the noise. Where no lack of fit shows, the scatter S of d directions, whose
expectation under the noise model is the unit matrix, is wider than that at the level a if

    tr S / d > chi2(1 - a; v) / v,                                                                        (2)

v being the degrees of freedom of the sandwich's trace, its Eq. (9). The noise model itself is known from D differences
between runs. The part of the noise that all poses of a run share is one number a difference and coordinate, and a
position has two coordinates of the same variance. The variances of positions have at least

    2 D                                                                                                   (3)

degrees of freedom, more where white noise dominates. Those of headings have one coordinate, and D. (3) is taken for
all numbers: with such a shared part, of the elements of the heading's row 99 % of the intervals hold the truth with
D = 4, and 97 % with D = 6.

Without repetitions the residuals of D runs stand in for differences. A fit of n numbers leaves 3 D - n of the D shared
parts, and the variances have at least two thirds as many degrees of freedom,

    2 D - 2 n / 3,                                                                                        (4)

but one. They are too small then, since likelihood does not know what the fit has taken, and the scatter of the runs,
which is corrected for that, stands for the noise model wherever the runs are enough for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.special import chdtri, fdtrc

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.least_squares.noise import NoiseEstimate
from omnibench.fit.least_squares.repetitions import grouped
from omnibench.fit.least_squares.roots import roots_of
from omnibench.fit.least_squares.whitened import Whitened
from omnibench.fit.uncertainty.intervals import EstimatedCovariance
from omnibench.fit.uncertainty.sandwich import CHANCE, DOUBT, Sandwich, Scores, sandwich, times_the
from omnibench.robot.kinematics import Array

# Share of the largest eigenvalue of a command's information below which a direction has information from encoder noise
# alone: wheel rates that are 3 % of the strongest. Five calibrations of tests/benchmarks/constants_fit.py are the same
# with half of it and with twice.
_DETERMINED = 1e-3


class FitCovariance:
    """Covariances of the numbers (n,) of a whitened fit, from its noise model and from the scatter of its runs.

    by_model: inverse of the information, zero along undetermined directions. scatter: the sandwich of
    uncertainty/sandwich.py, None if there are too few runs. Both are zero in rows and columns whose ``unit`` (n,) is 0;
    others are the units of the numbers in which directions are judged as undetermined.
    """

    scatter: Sandwich | None = None

    def __init__(self, data: Whitened, runs: Sequence[Trajectory], noise: NoiseEstimate, unit: Array) -> None:
        scores, information = data.scores * unit, data.information_of_runs * np.outer(unit, unit)
        roots = roots_of(information.sum(axis=0))
        self._noise, self._roots = noise, unit[:, None] * roots
        taken = 0 if noise.source == "repetitions" else roots.shape[1]
        freedom = max(2 * noise.degrees_of_freedom - 2 * taken / 3, 1)  # Eq. (3), (4)
        self.by_model = EstimatedCovariance(self._roots @ self._roots.T, freedom)
        self._chance_of_misfit = _chance_of_misfit(scores @ roots, roots.T @ information @ roots, runs)
        if not roots.size:
            return
        with suppress(DataError):
            found = sandwich(Scores(scores, information, runs, np.zeros(len(unit)), information))
            self.scatter = replace(found, covariance=found.covariance * np.outer(unit, unit))

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
    def lack_of_fit(self) -> bool:
        """True if commands scatter more than their repetitions explain, by the likelihood and by the sandwich.

        The likelihood's test is an F test between and within commands on the vectors that single commands would give,
        each direction in units of its noise, so that the size of the noise does not matter.
        """
        return self.scatter is not None and self.scatter.lack_of_fit and self._chance_of_misfit < CHANCE

    @property
    def scatter_stands(self) -> bool:
        """True if the runs scatter significantly more than the noise model predicts, or no repetition shows the noise.

        Scatter between commands counts only if the likelihood's test confirms it, at the level of the sandwich's.
        """
        if self.scatter is None:
            return False
        if self._noise.source == "within runs":
            return True
        if self.scatter.clustered:
            return self._chance_of_misfit < DOUBT
        back = np.linalg.pinv(self._roots)
        values = np.linalg.eigvalsh(back @ self.scatter.covariance @ back.T)
        freedom = self.scatter.freedom_of_trace
        return float(values.mean()) > float(chdtri(freedom, CHANCE)) / freedom  # Eq. (2)


def _chance_of_misfit(scores: Array, information: Array, trajectories: Sequence[Trajectory]) -> float:
    """p-value of the F test that one vector fits all commands; 1 where no repetitions show the noise.

    scores (Z, k) and information (Z, k, k) of the runs, whose sums are 0 and the unit matrix. Repetitions that agree
    exactly are exceeded by whatever is above the noise.
    """
    groups = grouped([(run.session, run.command, run.id if run.command is None else None) for run in trajectories])
    between, within, between_freedom, within_freedom = 0.0, 0.0, -scores.shape[1], 0
    for members in map(list, groups):
        values, vectors = np.linalg.eigh(information[members].sum(axis=0))
        determined = values > _DETERMINED * values.max(initial=0.0)
        turned, rank = scores[members] @ vectors[:, determined], int(determined.sum())
        common = float((turned.sum(axis=0) ** 2 / values[determined]).sum())
        between, between_freedom = between + common, between_freedom + rank
        if len(members) > 1:
            of_runs = vectors[:, determined].T @ information[members] @ vectors[:, determined]
            within += sum(float(s @ np.linalg.lstsq(m, s)[0]) for s, m in zip(turned, of_runs, strict=True)) - common
            within_freedom += (len(members) - 1) * rank
    if between_freedom <= 0 or within_freedom <= 0:
        return 1.0
    ratio = times_the(within / within_freedom, between / between_freedom)  # Eq. (1)
    if np.isinf(ratio) and between < between_freedom:
        return 1.0
    return float(fdtrc(between_freedom, within_freedom, ratio))
