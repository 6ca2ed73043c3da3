"""Noise of the start headings, as one more variance component beside those of noise.py.

An error e of a run's start position shifts its poses by e: a bias. An error of its start heading shifts the headings
by as much, and also turns the path about the start: with u the derivative of the poses by the start heading, the
covariance of a run grows by deviation^2 u u'. The turned path distinguishes it from a biased heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from omnibench.data.dataset import Trajectory
from omnibench.fit.least_squares.noise import LEAST_WHITE, Whitener
from omnibench.fit.least_squares.repetitions import Difference, differences_between_repetitions
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

_NAMES = ("pose_position", "walk_position", "bias_position", "pose_heading", "walk_heading", "bias_heading")
# Critical value (5 %) of the likelihood ratio statistic for one variance that may be zero: under the null half of it is
# chi-square with one degree of freedom, half is 0 (Self and Liang 1987).
_CHI_SQUARE = 2.71
_LARGEST = 0.3  # rad, largest start heading error that is searched; chosen


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
    groups = by_stamps(differences_between_repetitions(trajectories, residuals, turning).each)
    constant = noise.bias_heading

    def apart(deviation: float) -> Noise:
        rest = np.sqrt(max(constant**2 - deviation**2, 0.0))
        return noise.model_copy(update={"bias_heading": float(rest)})

    before = _twice_negative_log_likelihood(groups, noise, 0.0)
    first = minimize_scalar(
        lambda deviation: _twice_negative_log_likelihood(groups, apart(deviation), deviation),
        bounds=(0.0, min(max(2 * constant, 4 * noise.pose_heading, 1e-6), _LARGEST)),
        method="bounded",
        options={"xatol": 1e-6},
    )
    if before - float(first.fun) < _CHI_SQUARE / 4:  # fitting the other components again will not add that much
        return StartNoise(noise, 0.0)
    likeliest, deviation, after = _polished(groups, apart(float(first.x)), float(first.x))
    return StartNoise(likeliest, deviation) if before - after > _CHI_SQUARE else StartNoise(noise, 0.0)


def by_stamps(differences: Sequence[Difference]) -> list[tuple[Array, Array]]:
    """Differences grouped by their stamps (K,): values (K, 3, n) and companions (K, 3, n) of n, as one (K, 3, 2n)."""
    groups: dict[bytes, list[Difference]] = {}
    for difference in differences:
        groups.setdefault(difference.stamps.tobytes(), []).append(difference)
    return [
        (
            members[0].stamps,
            np.stack([*(member.values for member in members), *(member.companion for member in members)], axis=-1),
        )
        for members in groups.values()
    ]


def _twice_negative_log_likelihood(groups: list[tuple[Array, Array]], noise: Noise, deviation: float) -> float:
    """Twice the negative log-likelihood of the differences, up to a constant."""
    total = 0.0
    for stamps, everything in groups:
        whitener = Whitener(noise, stamps)
        count = everything.shape[2] // 2
        white = whitener(everything).reshape(-1, 2 * count)
        values, columns = white[:, :count], white[:, count:]
        lengths = 1 + deviation**2 * np.square(columns).sum(axis=0)
        along = (values * columns).sum(axis=0)
        total += count * whitener.log_determinant + float(np.log(lengths).sum() + np.square(values).sum())
        total -= deviation**2 * float((along**2 / lengths).sum())
    return total


def _polished(groups: list[tuple[Array, Array]], noise: Noise, deviation: float) -> tuple[Noise, float, float]:
    """All components estimated together, from a good start: the noise, the deviation and the likelihood there."""
    start = np.array([*(getattr(noise, name) for name in _NAMES), deviation])
    # The search is on a logarithmic scale, where zero cannot be left.
    start[:3] = np.maximum(start[:3], 0.1 * max(start[:3].max(), LEAST_WHITE))
    start[3:] = np.maximum(start[3:], 0.1 * max(start[3:].max(), LEAST_WHITE))

    def described(logarithms: Array) -> tuple[Noise, float]:
        values = [float(value) for value in start * np.exp(logarithms)]
        return Noise(**dict(zip(_NAMES, values[:6], strict=True))), values[6]

    count = sum(everything[..., 0].size for _, everything in groups)
    answer = minimize(
        lambda logarithms: _twice_negative_log_likelihood(groups, *described(logarithms)) / count,
        np.zeros(7),
        method="L-BFGS-B",
        bounds=[(-5.0, 5.0)] * 7,
        options={"eps": 1e-5, "ftol": 1e-10},
    )
    likeliest, deviation = described(answer.x)
    return likeliest, deviation, _twice_negative_log_likelihood(groups, likeliest, deviation)
