"""Covariance of a trajectory fit, from its noise model or from the scatter of the runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri, fdtrc

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.least_squares.repetitions import grouped
from omnibench.fit.least_squares.whitened import Whitened
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.uncertainty.sandwich import Sandwich, Scores, sandwich
from omnibench.robot.kinematics import Array

_CHANCE = 0.001  # level of the tests that decide whether runs scatter more than the noise; chosen strict
_RANK = 1e-12  # share of the largest eigenvalue of the information below which a direction is undetermined
# Share of the largest eigenvalue of a command's information below which a direction has information from encoder noise
# alone. Chosen.
_DETERMINED = 1e-3


class FitCovariance:
    """Covariances (n, n) of the vector of a linearised fit; zero in rows and columns of held elements.

    model: inverse of the information, zero along undetermined directions. scatter: the sandwich of
    uncertainty/sandwich.py, None if there are too few runs.
    """

    def __init__(self, problem: CalibrationProblem, data: Whitened, trajectories: Sequence[Trajectory]) -> None:
        self._free = problem.free
        self._unit = (problem.upper - problem.lower)[problem.free]
        self._size = problem.size
        scores = data.scores[:, self._free] * self._unit
        information = data.information_of_runs[:, self._free][:, :, self._free] * np.outer(self._unit, self._unit)
        values, vectors = np.linalg.eigh(information.sum(axis=0))
        known = values > _RANK * values.max(initial=0.0)
        self._roots, self._directions = np.sqrt(values[known]), vectors[:, known]
        whiten = self._directions / self._roots  # to coordinates in which the model's covariance is the unit matrix
        self._chance_of_misfit = _chance_of_misfit(scores @ whiten, whiten.T @ information @ whiten, trajectories)
        self._scatter: Sandwich | None = None
        if known.any():
            try:
                self._scatter = sandwich(Scores(scores, information, trajectories, np.zeros(len(self._unit))))
            except DataError:
                self._scatter = None

    @property
    def model(self) -> Array:
        return self._whole((self._directions / self._roots**2) @ self._directions.T)

    @property
    def scatter(self) -> Sandwich | None:
        if self._scatter is None:
            return None
        free = self._scatter
        return Sandwich(self._whole(free.covariance), free.degrees_of_freedom, free.words, free.lack_of_fit)

    @property
    def lack_of_fit(self) -> bool:
        """True if commands scatter more than their repetitions explain, by the likelihood and by the sandwich.

        The likelihood's test is an F test between and within commands on the vectors that single commands would give,
        each direction in units of its noise, so that the size of the noise does not matter.
        """
        return self._scatter is not None and self._scatter.lack_of_fit and self._chance_of_misfit < _CHANCE

    @property
    def scatter_is_wider(self) -> bool:
        """True if the runs scatter significantly more than the noise model predicts.

        Scatter between commands counts only if the likelihood's test confirms it.
        """
        if self._scatter is None or self._scatter.lack_of_fit:
            return self.lack_of_fit
        whitened = self._directions * self._roots
        values = np.linalg.eigvalsh(whitened.T @ self._scatter.covariance @ whitened)
        total = float(values.sum())
        freedom = self._scatter.degrees_of_freedom * total**2 / float(np.square(values).sum())
        return total / len(values) > float(chdtri(freedom, _CHANCE)) / freedom

    def _whole(self, covariance: Array) -> Array:
        """A covariance of the free elements, in units of the box, as one (n, n) of the vector."""
        whole = np.zeros((self._size, self._size))
        whole[np.ix_(self._free, self._free)] = covariance * np.outer(self._unit, self._unit)
        return whole


def _chance_of_misfit(scores: Array, information: Array, trajectories: Sequence[Trajectory]) -> float:
    """p-value of the F test that one vector fits all commands; 1 where no repetitions show the noise.

    scores (Z, k) and information (Z, k, k) of the runs, whose sums are 0 and the unit matrix.
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
    if between_freedom <= 0 or within_freedom <= 0 or within <= 0:
        return 1.0
    ratio = (between / between_freedom) / (within / within_freedom)
    return float(fdtrc(between_freedom, within_freedom, ratio))
