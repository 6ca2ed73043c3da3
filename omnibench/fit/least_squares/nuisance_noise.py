"""Noise of the reference poses and of the runs' nuisances, by maximum likelihood from repetitions.

Nuisances of a run whose standard deviations from run to run are S (a diagonal matrix) add N S S N' to the covariance of
its poses, N being the derivatives of the poses by them. With residuals r and N both whitened under the noise, whose
covariance is C, up to a constant

    -2 ln L = ln |1 + S N'N S| - (S N'r)' (1 + S N'N S)^-1 (S N'r) + r'r + ln |C|.                        (1)

Its derivative by a variance v of the noise or of a nuisance is, with a = (C + N S S N')^-1 r before whitening,

    d(-2 ln L) / dv = tr((C + N S S N')^-1 dC/dv) - a' dC/dv a,    dC/dv = N_j N_j' for nuisance j.        (2)

A deviation is zero unless a likelihood ratio test rejects that, all components of the noise and the nuisances found
before being fitted anew. Nuisances and noise resemble each other: an error of the start heading shifts the headings by
as much, like a bias, and only the path that turns about the start distinguishes it; so does an error of the clock by
what differs between fast and slow runs. An error of the start position is a bias, exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.special import chdtri

from omnibench.fit.least_squares.noise import LEAST_WHITE, NoiseEstimate, Whitener, estimate_noise
from omnibench.fit.least_squares.nuisances import TURN
from omnibench.fit.least_squares.repetitions import Differences, differences_between_repetitions
from omnibench.fit.least_squares.trajectory_fit import TrajectoryFit
from omnibench.fit.least_squares.usable_runs import in_start_frames
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

_NAMES = ("pose_position", "walk_position", "bias_position", "pose_heading", "walk_heading", "bias_heading")
# Level of the tests, shared by the nuisances that are asked about (Bonferroni): noise alone shows any of them in one
# set of twenty.
CHANCE = 0.05
# Share of the critical value that a nuisance alone must gain before all components are fitted with it: the others do
# not add four times as much. Half of this and twice give the same estimates from right and wrong starts
# (tests/studies/constants_fit.py).
_PROMISING = 0.25
# rad, s, s per s: largest deviations that are searched, 17 degrees and several times those of clocks that are
# synchronised by hand (0.2 s, 0.003). Half and twice as wide, the search finds the same to 1e-5
# (tests/studies/constants_fit.py).
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
    """A noise without that of nuisances, their deviations (3,), and -2 ln L of both, Eq. (1).

    slopes (9,): derivatives of -2 ln L by the logarithms of the noise's components and of the deviations.
    """

    noise: Noise
    deviations: Array
    minus_log_likelihood: float
    slopes: Array

    @classmethod
    def of(cls, differences: Differences, noise: Noise, deviations: Array) -> SeparateNoise:
        """This noise with these deviations, as likely as differences between repetitions make them."""
        total, slopes = 0.0, np.zeros(len(_NAMES) + 3)
        for stamps, values, columns in differences.by_stamps:
            of_group, of_variances = _likelihood(Whitener(noise, stamps), values, columns, deviations)
            total += of_group
            slopes += of_variances
        components = np.concatenate([[getattr(noise, name) for name in _NAMES], deviations])
        return cls(noise, deviations, total, 2 * np.square(components) * slopes)


@dataclass(frozen=True, eq=False)
class _Products:
    """Products of differences at the same stamps, whitened, with the columns of some nuisances.

    log_determinant: ln |C|. squares (n,), beside (n, m), inner (n, m, m): r'r, N'r and N'N of n differences.
    """

    log_determinant: float
    squares: Array
    beside: Array
    inner: Array

    @classmethod
    def of(cls, whitener: Whitener, white: Array) -> _Products:
        """Products of white (K, 3, n, 1 + m), differences and nuisances."""
        of_runs = white.reshape(-1, *white.shape[2:]).transpose(1, 0, 2)
        products = of_runs.transpose(0, 2, 1) @ of_runs
        return cls(whitener.log_determinant, products[:, 0, 0], products[:, 1:, 0], products[:, 1:, 1:])

    def lower(self, sizes: Array) -> Array:
        """Cholesky factors (n, m, m) of 1 + S N'N S, S being the sizes (m,)."""
        lower: Array = np.linalg.cholesky(np.eye(len(sizes)) + self.inner * np.outer(sizes, sizes))
        return lower

    def minus_log_likelihood(self, sizes: Array) -> float:
        """-2 ln L, Eq. (1), of nuisances with standard deviations (m,)."""
        lower = self.lower(sizes)
        reduced = np.linalg.solve(lower, (sizes * self.beside)[..., None])
        determinants = 2 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum()
        total = len(self.squares) * self.log_determinant + self.squares.sum() - np.square(reduced).sum() + determinants
        return float(total)


def _whitened(whitener: Whitener, values: Array, columns: Array) -> Array:
    """Differences (K, 3, n) and columns (K, 3, n, m), whitened: (K, 3, n, 1 + m)."""
    both = np.concatenate([values[..., None], columns], axis=3)
    return whitener(both.reshape(*values.shape[:2], -1)).reshape(both.shape)


def _products(differences: Differences, noise: Noise, used: NDArray[np.intp]) -> list[_Products]:
    """The products of all differences with the columns of the nuisances ``used``, by stamps."""
    products = []
    for stamps, values, columns in differences.by_stamps:
        whitener = Whitener(noise, stamps)
        products.append(_Products.of(whitener, _whitened(whitener, values, columns[..., used])))
    return products


def _likelihood(whitener: Whitener, values: Array, columns: Array, deviations: Array) -> tuple[float, Array]:
    """-2 ln L of differences (K, 3, n), and its derivatives (9,) by the variances; columns (K, 3, n, 3): N."""
    count, known = values.shape[2], np.flatnonzero(deviations)
    sizes = deviations[known]
    white = _whitened(whitener, values, columns[..., known])
    products = _Products.of(whitener, white)
    beside, inner, lower = products.beside, products.inner, products.lower(sizes)
    reduced = np.linalg.solve(lower, sizes[:, None] * np.concatenate([beside[..., None], inner], axis=2))
    # Eq. (2): a, and columns Z such that (C + N S S N')^-1 = C^-1 - Z Z'.
    solved = whitener.transposed(white)
    roots = np.linalg.solve(lower, sizes[:, None] * np.eye(len(known)))
    removed = np.einsum("ksnj,nij->ksni", solved[..., 1:], roots)
    remaining = solved[..., 0] - np.einsum("ksni,ni->ksn", removed, reduced[..., 0])
    forms = whitener.forms(np.concatenate([remaining[..., None], removed], axis=3).reshape(*values.shape[:2], -1))
    slopes = np.zeros(len(_NAMES) + 3)
    slopes[: len(_NAMES)] = count * whitener.traces - forms
    left = beside - np.einsum("nij,ni->nj", reduced[..., 1:], reduced[..., 0])  # N' a
    of_nuisances = np.diagonal(inner, axis1=1, axis2=2) - np.square(reduced[..., 1:]).sum(axis=1) - np.square(left)
    slopes[len(_NAMES) + known] = of_nuisances.sum(axis=0)
    return products.minus_log_likelihood(sizes), slopes


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
    used = np.flatnonzero((now.deviations > 0) | (np.arange(3) == kind))
    held = None if kind == TURN else _products(differences, now.noise, used)

    def deviations_with(deviation: float) -> Array:
        return np.where(np.arange(3) == kind, deviation, now.deviations)

    def noise_with(deviation: float) -> Noise:
        if kind != TURN:
            return now.noise
        return now.noise.model_copy(update={"bias_heading": float(np.sqrt(max(bias**2 - deviation**2, 0.0)))})

    def minus_log_likelihood(deviation: float) -> float:
        products = _products(differences, noise_with(deviation), used) if held is None else held
        return sum(of_group.minus_log_likelihood(deviations_with(deviation)[used]) for of_group in products)

    answer = minimize_scalar(minus_log_likelihood, bounds=(0.0, reach), method="bounded", options={"xatol": 1e-6})
    found = float(answer.x)
    return SeparateNoise.of(differences, noise_with(found), deviations_with(found))


def _polished(differences: Differences, near: SeparateNoise) -> SeparateNoise:
    """All components of the noise and the deviations that are not 0 estimated together, from a good start."""
    known = near.deviations > 0
    start = np.array([*(getattr(near.noise, name) for name in _NAMES), *near.deviations[known]])
    # The search is on a logarithmic scale, where zero cannot be left. Start headings are the first of the nuisances.
    for of_one_unit in (start[:3], start[3 : 6 + known[TURN]]):
        np.maximum(of_one_unit, 0.1 * max(of_one_unit.max(), LEAST_WHITE), out=of_one_unit)

    moved = np.concatenate([np.ones(len(_NAMES), dtype=bool), known])

    def described(logarithms: Array) -> SeparateNoise:
        values, deviations = start * np.exp(logarithms), np.zeros(3)
        deviations[known] = values[len(_NAMES) :]
        noise = Noise(**dict(zip(_NAMES, map(float, values), strict=False)))
        return SeparateNoise.of(differences, noise, deviations)

    def cost(logarithms: Array) -> tuple[float, Array]:
        there = described(logarithms)
        return there.minus_log_likelihood / count, there.slopes[moved] / count

    count = sum(difference.values.size for difference in differences.each)
    bounds = [(-5.0, 5.0)] * len(start)
    answer = minimize(cost, np.zeros(len(start)), jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-10})
    return described(answer.x)
