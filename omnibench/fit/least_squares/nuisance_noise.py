"""Noise of the start headings, as one more variance component beside those of noise.py.

An error e of a run's start position shifts its poses by e: a bias. An error of its start heading shifts the headings
by as much, and also turns the path about the start: with u the derivative of the poses by the start heading, the
covariance of a run grows by deviation^2 u u', and the likelihood is that of nuisances.py, Eq. (2), with one nuisance.
The turned path distinguishes it from a biased heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from omnibench.data.dataset import Trajectory
from omnibench.fit.least_squares.noise import LEAST_WHITE
from omnibench.fit.least_squares.nuisances import NuisanceLikelihood
from omnibench.fit.least_squares.repetitions import Differences, differences_between_repetitions
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

_NAMES = ("pose_position", "walk_position", "bias_position", "pose_heading", "walk_heading", "bias_heading")
# Critical value (5 %) of the likelihood ratio statistic for one variance that may be zero: under the null half of it is
# chi-square with one degree of freedom, half is 0 (Self and Liang 1987).
_CHI_SQUARE = 2.71
# Share of it that the start headings alone must gain before all components are fitted with them: the others do not add
# four times as much. Half of this and of the next number and twice give the same estimates from right and wrong starts
# (tests/benchmarks/constants_fit.py).
_PROMISING = 0.25
_LARGEST = 0.3  # rad: largest start heading error that is searched, 17 degrees


@dataclass(frozen=True)
class StartNoise:
    """The noise without that of the start headings, whose standard deviation is start_heading, rad."""

    noise: Noise
    start_heading: float


def separate_start_noise(
    trajectories: Sequence[Trajectory], residuals: Sequence[Array], turning: Sequence[Array], noise: Noise
) -> StartNoise:
    """Maximum likelihood estimate of the noise and of the start headings' deviation, from repetitions.

    residuals (K, 3) of every trajectory as for estimate_noise; turning (K, 3): derivatives of its poses by its start
    heading; noise: the estimate without start noise, where the search begins. The deviation is 0 unless a likelihood
    ratio test (5 %) rejects that.
    """
    columns = [of_run[..., None] for of_run in turning]
    differences = differences_between_repetitions(trajectories, residuals, columns)
    constant = noise.bias_heading

    def apart(deviation: float) -> Noise:
        rest = np.sqrt(max(constant**2 - deviation**2, 0.0))
        return noise.model_copy(update={"bias_heading": float(rest)})

    before = _minus_log_likelihood(differences, noise, 0.0)
    first = minimize_scalar(
        lambda deviation: _minus_log_likelihood(differences, apart(deviation), deviation),
        bounds=(0.0, min(max(2 * constant, 4 * noise.pose_heading, 1e-6), _LARGEST)),
        method="bounded",
        options={"xatol": 1e-6},
    )
    if before - float(first.fun) < _PROMISING * _CHI_SQUARE:
        return StartNoise(noise, 0.0)
    likeliest, deviation, after = _polished(differences, apart(float(first.x)), float(first.x))
    return StartNoise(likeliest, deviation) if before - after > _CHI_SQUARE else StartNoise(noise, 0.0)


def _minus_log_likelihood(differences: Differences, noise: Noise, deviation: float) -> float:
    """-2 ln L of the differences, up to a constant: Eq. (2) of nuisances.py."""
    likelihood = NuisanceLikelihood(differences, noise)
    return likelihood.noise_part + likelihood(np.array([deviation]))


def _polished(differences: Differences, noise: Noise, deviation: float) -> tuple[Noise, float, float]:
    """All components estimated together, from a good start: the noise, the deviation and the likelihood there."""
    start = np.array([*(getattr(noise, name) for name in _NAMES), deviation])
    # The search is on a logarithmic scale, where zero cannot be left.
    start[:3] = np.maximum(start[:3], 0.1 * max(start[:3].max(), LEAST_WHITE))
    start[3:] = np.maximum(start[3:], 0.1 * max(start[3:].max(), LEAST_WHITE))

    def described(logarithms: Array) -> tuple[Noise, float]:
        values = [float(value) for value in start * np.exp(logarithms)]
        return Noise(**dict(zip(_NAMES, values[:6], strict=True))), values[6]

    count = sum(difference.values.size for difference in differences.each)
    answer = minimize(
        lambda logarithms: _minus_log_likelihood(differences, *described(logarithms)) / count,
        np.zeros(7),
        method="L-BFGS-B",
        bounds=[(-5.0, 5.0)] * 7,
        options={"eps": 1e-5, "ftol": 1e-10},
    )
    likeliest, deviation = described(answer.x)
    return likeliest, deviation, _minus_log_likelihood(differences, likeliest, deviation)
