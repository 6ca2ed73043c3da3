"""Fading: outside the training domain, corrections fade to the plain matrix as far as they are not sure.

Let u be the drive signals of a sample, K the model's matrix, c(b) the corrections by parameters b, and K0 the plain
matrix, which was fitted without corrections. The model changes the plain twist by

    m = K u + c(b) - K0 u.                                                                                          (1)

With S the covariance of b and R that of K with b, an error e of b goes along with an error R S^+ e of K, the
conditional mean of normal errors. So m errs by D e, with the variance s^2,

    D = dc/db + (R S^+) u,    s^2 = tr(D S D'),                                                                     (2)

turning counted as the speed that it gives the wheels. Where motions are near to driven ones, runs that were held out
confirmed the corrections. Beyond, at x widths of "near" from there, a correction may have another form, and the
variance of what is extrapolated is taken to grow in proportion to that distance, as that of a random walk does:

    v = GROWTH x s^2.                                                                                               (3)

Of an estimate m with the variance v, the share

    g = max(1 - v / m^2, 0)                                                                                         (4)

is used (positive part of the estimator of James and Stein, Proc. 4th Berkeley Symposium, 1961; non-negative garrote of
Breiman, Technometrics 37, 1995): m is kept where the parameters are known well; where they are not, or models that the
recordings cannot tell apart disagree, the plain matrix is left. Every sample is judged by itself, batch and stream
alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.corrected import corrected_twists
from omnibench.robot.domain.training_domain import TrainingDomain
from omnibench.robot.effects.effect import MotionEffect
from omnibench.robot.effects.term import Term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals

GROWTH = 4.0
_KNOWN = 1e-9  # share of the largest variance below which a direction of the parameters has none but by rounding


class FadedTwists(NamedTuple):
    """Twists (F, 3) of the tracked point, and velocity (F, 2) in the reference's frame, None for none.

    doubts (F, 5, r): standard deviations of twist and velocity in r independent directions by what is extrapolated,
    Eq. (3); None where no sample is outside the training domain.
    """

    twists: Array
    drift: Array | None
    doubts: Array | None


class Fade:
    """How the corrections of a model fade.

    change (3, M): what the matrix has that the plain one has not. driven (n, 3): motions of the training domain, m/s,
    m/s, rad/s. covariance (3M + p, 3M + p): of the matrix, row by row, then of the values of all terms; 0 for those
    that were not fitted.
    """

    def __init__(self, robot: Robot, change: Array, driven: Array, terms: Sequence[Term], covariance: Array) -> None:
        self._change, self._terms = change, tuple(terms)
        self._domain = TrainingDomain(robot, driven)
        self._weights = np.array([1.0, 1.0, robot.reach, 1.0, 1.0])
        elements, variances = change.size, np.diag(covariance)
        values = [(number, name) for number, term in enumerate(terms) for name in term.values]
        known = np.flatnonzero(variances[elements:] > 0)
        sizes = np.sqrt(variances[elements + known])
        self._fitted = [(*values[row], float(size)) for row, size in zip(known, sizes, strict=True)]
        rows = elements + known
        strengths, vectors = np.linalg.eigh(covariance[np.ix_(rows, rows)] / np.outer(sizes, sizes))
        kept = strengths > _KNOWN * strengths.max(initial=0.0)
        self._roots = vectors[:, kept] * np.sqrt(strengths[kept])  # square root of S, in standard deviations
        inverse = vectors[:, kept] / np.sqrt(strengths[kept])
        along = covariance[:elements, rows] / sizes @ inverse  # R S^+ of the roots
        self._matrices = along.T.reshape(-1, *change.shape)

    def applied(self, terms: Sequence[Term], signals: Signals, matrix: Array) -> FadedTwists:
        """The corrected twists of samples, faded outside the training domain. PluginError as ``corrected_twists``."""
        twists, drift = corrected_twists(terms, signals, matrix)
        drive = signals.robot.drive.signals(signals.rates, signals.steering)
        excess = self._domain.excess(drive @ matrix.T)
        rows = np.flatnonzero(excess)
        if not len(rows):
            return FadedTwists(twists, drift, None)
        doubts = np.sqrt(GROWTH * excess[rows])[:, None, None] * self._slopes(_at(signals, rows), drive[rows], matrix)
        plain = drive @ (matrix - self._change).T
        change = np.concatenate([twists - plain, np.zeros((len(twists), 2)) if drift is None else drift], axis=1)
        variance = np.square(doubts * self._weights[:, None]).sum(axis=(1, 2))
        size = np.square(change[rows] * self._weights).sum(axis=1)
        share = np.ones((len(twists), 1))
        share[rows, 0] = np.maximum(1 - variance / np.maximum(size, 1e-300), 0.0)  # Eq. (4)
        outside = np.zeros((len(twists), *doubts.shape[1:]))
        outside[rows] = doubts
        twists = np.where(share < 1, plain + share * change[:, :3], twists)
        return FadedTwists(twists, None if drift is None else share * drift, outside)

    def _slopes(self, signals: Signals, drive: Array, matrix: Array) -> Array:
        """D of Eq. (2) times the roots of S, (F, 5, r)."""
        zeros = self._without_fitted
        twists, _ = corrected_twists((), signals, matrix)
        slopes = np.zeros((len(drive), 5, len(self._fitted)))
        for column, (number, name, size) in enumerate(self._fitted):
            effect = self._terms[number].effect
            if isinstance(effect, MotionEffect):
                moved, drift = corrected_twists([Term(effect, zeros[number] | {name: size})], signals, matrix)
                slopes[:, :3, column] = moved - twists
                if drift is not None:
                    slopes[:, 3:, column] = drift
        slopes = slopes @ self._roots
        slopes[:, :3] += np.einsum("rkm,fm->fkr", self._matrices, drive)
        return slopes

    @cached_property
    def _without_fitted(self) -> list[dict[str, float]]:
        """The values of each term, the fitted ones 0."""
        fitted = {(number, name) for number, name, _ in self._fitted}
        return [
            {name: 0.0 if (number, name) in fitted else value for name, value in term.values.items()}
            for number, term in enumerate(self._terms)
        ]


def faded_twists(fade: Fade | None, terms: Sequence[Term], signals: Signals, matrix: Array) -> FadedTwists:
    """The corrected twists of samples, faded if a fade is given. PluginError as ``corrected_twists``."""
    if fade is None:
        return FadedTwists(*corrected_twists(terms, signals, matrix), None)
    return fade.applied(terms, signals, matrix)


def _at(signals: Signals, rows: NDArray[np.intp]) -> Signals:
    """The signals of some samples."""
    of_rows: dict[str, Any] = {}
    for field in fields(signals):
        value = getattr(signals, field.name)
        if isinstance(value, np.ndarray):
            of_rows[field.name] = value[rows]
    return replace(signals, **of_rows)
