"""Gaussian process discrepancy (M. C. Kennedy and A. O'Hagan, Bayesian calibration of computer models, 2001).

The twist that the matrix lacks is a Gaussian process over the covariates along each axis of the robot, with a length
scale for each covariate (ARD); the matrix was fitted before (modular: F. Liu, M. J. Bayarri and J. O. Berger, 2009),
and is fitted again beside the process. The odds that anything is missing are those of the windows that did not choose
the length scales, against noise alone: the evidence of those that did found something in empty sets.
"""

from __future__ import annotations

import warnings

import numpy as np
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from omnibench.robot.kinematics import Array

from .problem import COVARIATE_OF, NOTHING, Answer, Problem, Windows

_PLACES = 0.2  # share of all inverse square length scales that makes a covariate one of the answer; chosen


def answer(problem: Problem, rng: np.random.Generator, seconds: float = 2.0, most: int = 150) -> Answer:
    """Fit a process along each axis to windows; at most so many of them choose the length scales."""
    windows = problem.windows(None, seconds)
    targets = problem.missing_twists(windows)
    order = rng.permutation(len(windows.run))
    rows, others = np.split(order, [min(most, len(order) // 2)])
    varying = windows.covariates.std(axis=0) > 1e-9
    mean, spread = windows.covariates[:, varying].mean(axis=0), windows.covariates[:, varying].std(axis=0)
    inputs = (windows.covariates[:, varying] - mean) / spread
    labels = [label for label, varies in zip(windows.labels, varying, strict=True) if varies]
    axes: list[tuple[int, float, GaussianProcessRegressor]] = []
    relevance, gained = np.zeros(len(labels)), 0.0
    for axis in range(3):
        size = float(targets[:, axis].std())
        kernel = ConstantKernel(0.1, (1e-4, 10.0)) * RBF(np.full(len(labels), 3.0), (0.3, 300.0))
        process = GaussianProcessRegressor(kernel + WhiteKernel(1.0, (0.05, 2.0)), random_state=0)
        scaled = targets[:, axis] / size
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # length scales at their bounds: covariates that do not matter
            process.fit(inputs[rows], scaled[rows])
        # Log density of the other windows, against noise alone; their deviations contain the noise
        expected, deviation = process.predict(inputs[others], return_std=True)
        under = -0.5 * np.square((scaled[others] - expected) / deviation) - np.log(deviation)
        noise = float(scaled[rows].std())
        gain = float((under + 0.5 * np.square(scaled[others] / noise) + np.log(noise)).sum())
        process = GaussianProcessRegressor(process.kernel_, optimizer=None).fit(inputs, scaled)
        if gain > 0:
            gained += gain
            axes.append((axis, size, process))
            strength = process.kernel_.k1.k1.constant_value
            relevance += strength * gain / np.square(process.kernel_.k1.k2.length_scale)
    if not axes or gained < np.log(20):
        return NOTHING
    by_covariate: dict[str, float] = {}
    for label, value in zip(labels, relevance / relevance.sum(), strict=True):
        covariate = COVARIATE_OF.get(label, COVARIATE_OF.get(label.rpartition("_")[0], ""))
        by_covariate[covariate] = by_covariate.get(covariate, 0.0) + float(value)
    places = frozenset(name for name, share in by_covariate.items() if share >= _PLACES)

    def twists_of(at: Windows) -> Array:
        twists = np.zeros((len(at.run), 3))
        for axis, size, process in axes:
            twists[:, axis] = size * process.predict((at.covariates[:, varying] - mean) / spread)
        return twists

    return problem.function_answer(twists_of, seconds, places, float(1 / (1 + 20 * np.exp(-min(gained, 500.0)))))
