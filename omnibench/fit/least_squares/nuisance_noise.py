"""Noise of the reference poses and of the runs' nuisances, by maximum likelihood from repetitions.

Nuisances of a run whose standard deviations from run to run are S (a diagonal matrix) add N S S N' to the covariance of
its poses, N being the derivatives of the poses by them. With residuals r and N both whitened under the noise, whose
covariance is C, up to a constant

    -2 ln L = ln |1 + S N'N S| - (S N'r)' (1 + S N'N S)^-1 (S N'r) + r'r + ln |C|.                        (1)

A deviation is zero unless a likelihood ratio test rejects that, all components of the noise and the nuisances found
before being fitted anew. Nuisances and noise resemble each other: an error of the start heading shifts the headings by
as much, like a bias, and only the path that turns about the start distinguishes it; so does an error of the clock by
what differs between fast and slow runs. An error of the start position is a bias, exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import chdtri

from omnibench.fit.least_squares.noise import LEAST_WHITE, NoiseEstimate, Whitener, estimate_noise
from omnibench.fit.least_squares.nuisances import TURN
from omnibench.fit.least_squares.repetitions import Differences, differences_between_repetitions
from omnibench.fit.least_squares.start_frames import in_start_frames
from omnibench.fit.least_squares.trajectory_fit import TrajectoryFit
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

_NAMES = ("pose_position", "walk_position", "bias_position", "pose_heading", "walk_heading", "bias_heading")
# Level of the tests, shared by the nuisances that are asked about (Bonferroni): noise alone shows any of them in one
# set of twenty.
CHANCE = 0.05
# Share of the critical value that a nuisance alone must gain before all components are fitted with it: the others do
# not add four times as much. Half of this and twice give the same estimates from right and wrong starts
# (tests/benchmarks/constants_fit.py).
_PROMISING = 0.25
# rad, s, s per s: largest deviations that are searched, 17 degrees and several times those of clocks that are
# synchronised by hand (0.2 s, 0.003). Half and twice as wide, the search finds the same to 1e-5
# (tests/benchmarks/constants_fit.py).
_LARGEST = np.array([0.3, 0.5, 0.02])


@dataclass(frozen=True, eq=False)
class FitNoise:
    """The noise of the reference poses, and the standard deviations (3,) of the nuisances: rad, s, s per s."""

    estimate: NoiseEstimate
    deviations: Array

    @property
    def sizes(self) -> dict[str, float]:
        """Standard deviations of poses and start headings, by their names."""
        return {**self.estimate.noise.model_dump(), "start_heading": float(self.deviations[TURN])}


def noise_of_fit(
    fit: TrajectoryFit, kinds: Sequence[int], near: Noise | None = None, chance: float = CHANCE
) -> FitNoise:
    """The noise that the residuals of a fit show beside nuisances of some kinds, and the deviations of these.

    Nuisances of other kinds keep their values; their deviations are 0. near: an earlier estimate of the noise. chance:
    level of the tests.
    """
    differences = differences_without_nuisances(fit, kinds)
    estimate = estimate_noise(differences, near)
    separate = separate_nuisances(differences, estimate.noise, kinds, chance)
    return FitNoise(replace(estimate, noise=separate.noise), separate.deviations)


def differences_without_nuisances(fit: TrajectoryFit, kinds: Sequence[int]) -> Differences:
    """Differences between repetitions of the residuals that a fit leaves if nuisances of some kinds are 0."""
    values = fit.nuisances.values.copy()
    values[:, kinds] = 0.0
    if not np.array_equal(values, fit.nuisances.values):
        fit = replace(fit, nuisances=replace(fit.nuisances, values=values))
    slopes = fit.slopes if kinds else [np.zeros((*residuals.shape, 3)) for residuals in fit.residuals]
    residuals, slopes = (in_start_frames(fit.runs, of_runs) for of_runs in (fit.residuals, slopes))
    return differences_between_repetitions(fit.runs, residuals, slopes)


@dataclass(frozen=True, eq=False)
class SeparateNoise:
    """A noise without that of nuisances, their deviations (3,), and -2 ln L of both."""

    noise: Noise
    deviations: Array
    minus_log_likelihood: float

    @classmethod
    def of(cls, differences: Differences, noise: Noise, deviations: Array) -> SeparateNoise:
        """This noise with these deviations, as likely as differences between repetitions make them, Eq. (1)."""
        known = np.flatnonzero(deviations)
        sizes = deviations[known]
        of_noise, of_nuisances = 0.0, 0.0
        for stamps, values, slopes in differences.by_stamps:
            whitener, count = Whitener(noise, stamps), values.shape[2]
            white = whitener(values).reshape(-1, count)
            of_noise += count * whitener.log_determinant + float(np.square(white).sum())
            if len(known):
                columns = whitener(slopes[..., known].reshape(*values.shape[:2], -1)).reshape(len(white), count, -1)
                inner = np.eye(len(known)) + np.einsum("rnk,rnl->nkl", columns, columns) * np.outer(sizes, sizes)
                scaled = np.einsum("rnk,rn->nk", columns, white) * sizes
                of_nuisances += float(np.linalg.slogdet(inner)[1].sum())
                of_nuisances -= float(np.einsum("nk,nk->", scaled, np.linalg.solve(inner, scaled[..., None])[..., 0]))
        return cls(noise, deviations, of_noise + of_nuisances)


def separate_nuisances(
    differences: Differences, noise: Noise, kinds: Sequence[int], chance: float = CHANCE
) -> SeparateNoise:
    """Maximum likelihood estimate of the noise and of the deviations of nuisances of some kinds.

    noise: the estimate without nuisances, where the search begins. The likeliest nuisance comes in first, a further one
    for what those before it leave unexplained.
    """
    # Under the null half of the statistic of one variance that may be zero is chi-square with one degree of freedom,
    # half is 0 (Self and Liang 1987).
    critical = chdtri(1, 2 * chance / max(len(kinds), 1))
    now = SeparateNoise.of(differences, noise, np.zeros(3))

    def gain(then: SeparateNoise) -> float:
        return now.minus_log_likelihood - then.minus_log_likelihood

    while True:
        trials = [_along(differences, now, kind) for kind in kinds if now.deviations[kind] == 0]
        likeliest = max(trials, key=gain, default=now)
        if gain(likeliest) >= _PROMISING * critical:
            likeliest = _polished(differences, likeliest)
        if gain(likeliest) <= critical:
            return now
        now = likeliest


def _along(differences: Differences, now: SeparateNoise, kind: int) -> SeparateNoise:
    """The best deviation of one more nuisance, other noise held.

    The bias of the headings has stood in for start headings and becomes smaller by as much.
    """
    reach, bias = float(_LARGEST[kind]), now.noise.bias_heading
    if kind == TURN:
        reach = min(max(2 * bias, 4 * now.noise.pose_heading, 1e-6), reach)

    def with_deviation(deviation: float) -> SeparateNoise:
        noise = now.noise
        if kind == TURN:
            noise = noise.model_copy(update={"bias_heading": float(np.sqrt(max(bias**2 - deviation**2, 0.0)))})
        return SeparateNoise.of(differences, noise, np.where(np.arange(3) == kind, deviation, now.deviations))

    answer = minimize_scalar(
        lambda deviation: with_deviation(deviation).minus_log_likelihood,
        bounds=(0.0, reach),
        method="bounded",
        options={"xatol": 1e-6},
    )
    return with_deviation(float(answer.x))


def _polished(differences: Differences, near: SeparateNoise) -> SeparateNoise:
    """All components of the noise and the deviations that are not 0 estimated together, from a good start."""
    known = near.deviations > 0
    start = np.array([*(getattr(near.noise, name) for name in _NAMES), *near.deviations[known]])
    # The search is on a logarithmic scale, where zero cannot be left. Start headings are the first of the nuisances.
    for of_one_unit in (start[:3], start[3 : 6 + known[TURN]]):
        np.maximum(of_one_unit, 0.1 * max(of_one_unit.max(), LEAST_WHITE), out=of_one_unit)

    def described(logarithms: Array) -> SeparateNoise:
        values, deviations = start * np.exp(logarithms), np.zeros(3)
        deviations[known] = values[len(_NAMES) :]
        noise = Noise(**dict(zip(_NAMES, map(float, values), strict=False)))
        return SeparateNoise.of(differences, noise, deviations)

    count = sum(difference.values.size for difference in differences.each)
    answer = minimize(
        lambda logarithms: described(logarithms).minus_log_likelihood / count,
        np.zeros(len(start)),
        method="L-BFGS-B",
        bounds=[(-5.0, 5.0)] * len(start),
        options={"eps": 1e-5, "ftol": 1e-10},
    )
    return described(answer.x)
