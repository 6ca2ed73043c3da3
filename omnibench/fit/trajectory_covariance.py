"""Covariance of a trajectory fit: what the noise means, and what the scatter of the runs shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.sandwich import Pulls, Sandwich, sandwich
from omnibench.fit.trajectory_fit import Linearisation
from omnibench.robot.kinematics import Array

# The scatter counts as wider than the noise means where chance exceeds it once in a thousand times.
_CHANCE = 0.001
_RANK = 1e-12


class FitCovariance:
    """The covariances (n, n) of the vector that a linearised fit gives; zero in rows and columns of held elements.

    model: the inverse of the information, none along directions that the data do not tell at all. scatter: the
    sandwich of fit/sandwich.py, None for too few runs.
    """

    def __init__(self, problem: CalibrationProblem, linear: Linearisation, trajectories: Sequence[Trajectory]) -> None:
        self._free = problem.free
        self._unit = (problem.upper - problem.lower)[problem.free]
        self._size = problem.size
        scores = linear.scores[:, self._free] * self._unit
        information = linear.information[:, self._free][:, :, self._free] * np.outer(self._unit, self._unit)
        values, vectors = np.linalg.eigh(information.sum(axis=0))
        known = values > _RANK * values.max(initial=0.0)
        self._roots, self._directions = np.sqrt(values[known]), vectors[:, known]
        self._scatter: Sandwich | None = None
        if known.any():
            try:
                self._scatter = sandwich(Pulls(scores, information, trajectories, np.zeros(len(self._unit))))
            except DataError:
                self._scatter = None

    @property
    def model(self) -> Array:
        return self._whole((self._directions / self._roots**2) @ self._directions.T)

    @property
    def scatter(self) -> Sandwich | None:
        if self._scatter is None:
            return None
        found = self._scatter
        return Sandwich(self._whole(found.covariance), found.degrees_of_freedom, found.words, found.lack_of_fit)

    @property
    def lack_of_fit(self) -> bool:
        """Whether commands or sessions scatter more than their repetitions explain."""
        return self._scatter is not None and self._scatter.lack_of_fit

    @property
    def scatter_is_wider(self) -> bool:
        """Whether the runs scatter more than the noise means, by more than chance."""
        if self._scatter is None:
            return False
        whitened = self._directions * self._roots
        values = np.linalg.eigvalsh(whitened.T @ self._scatter.covariance @ whitened)
        total = float(values.sum())
        freedom = self._scatter.degrees_of_freedom * total**2 / float(np.square(values).sum())
        return total / len(values) > float(stats.chi2.isf(_CHANCE, freedom)) / freedom

    def _whole(self, covariance: Array) -> Array:
        whole = np.zeros((self._size, self._size))
        whole[np.ix_(self._free, self._free)] = covariance * np.outer(self._unit, self._unit)
        return whole
