"""Covariance of a trajectory fit: what the noise means, and what the scatter of the runs shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.least_squares.repetitions import grouped
from omnibench.fit.least_squares.trajectory_fit import Linearisation
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.uncertainty.sandwich import Sandwich, Scores, sandwich
from omnibench.robot.kinematics import Array

# Scatter counts as more than noise where chance exceeds it once in a thousand times.
_CHANCE = 0.001
_RANK = 1e-12
_TOLD = 1e-3  # of what a command tells most sharply: what it tells by encoder noise alone is less


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
        turn = self._directions / self._roots  # to numbers whose covariance, by the model, is the unit matrix
        self._chance_of_misfit = _chance_of_misfit(scores @ turn, turn.T @ information @ turn, trajectories)
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
        found = self._scatter
        return Sandwich(self._whole(found.covariance), found.degrees_of_freedom, found.words, found.lack_of_fit)

    @property
    def lack_of_fit(self) -> bool:
        """Whether commands scatter more than their repetitions explain, by the likelihood as well as by the sandwich.

        The likelihood's is an F test on what every command by itself says of the vector, each direction in units of
        its noise, so that the noise's size does not matter.
        """
        return self._scatter is not None and self._scatter.lack_of_fit and self._chance_of_misfit < _CHANCE

    @property
    def scatter_is_wider(self) -> bool:
        """Whether the runs scatter more than the noise means, by more than chance.

        Scatter between commands counts only where the likelihood's test bears it out.
        """
        if self._scatter is None or self._scatter.lack_of_fit:
            return self.lack_of_fit
        whitened = self._directions * self._roots
        values = np.linalg.eigvalsh(whitened.T @ self._scatter.covariance @ whitened)
        total = float(values.sum())
        freedom = self._scatter.degrees_of_freedom * total**2 / float(np.square(values).sum())
        return total / len(values) > float(stats.chi2.isf(_CHANCE, freedom)) / freedom

    def _whole(self, covariance: Array) -> Array:
        whole = np.zeros((self._size, self._size))
        whole[np.ix_(self._free, self._free)] = covariance * np.outer(self._unit, self._unit)
        return whole


def _chance_of_misfit(scores: Array, information: Array, trajectories: Sequence[Trajectory]) -> float:
    """The chance that commands differ from one vector as much as they do; 1 where no repetitions show the noise.

    scores (Z, k) and information (Z, k, k) of the runs, summed up to 0 and the unit matrix.
    """
    groups = grouped([(run.session, run.command, run.id if run.command is None else None) for run in trajectories])
    between, within, between_freedom, within_freedom = 0.0, 0.0, -scores.shape[1], 0
    for members in map(list, groups):
        values, vectors = np.linalg.eigh(information[members].sum(axis=0))
        told = values > _TOLD * values.max(initial=0.0)
        own, rank = scores[members] @ vectors[:, told], int(told.sum())
        common = float((own.sum(axis=0) ** 2 / values[told]).sum())
        between, between_freedom = between + common, between_freedom + rank
        if len(members) > 1:
            each = vectors[:, told].T @ information[members] @ vectors[:, told]
            within += sum(float(s @ np.linalg.lstsq(m, s)[0]) for s, m in zip(own, each, strict=True)) - common
            within_freedom += (len(members) - 1) * rank
    if between_freedom <= 0 or within_freedom <= 0 or within <= 0:
        return 1.0
    ratio = (between / between_freedom) / (within / within_freedom)
    return float(stats.f.sf(ratio, between_freedom, within_freedom))
