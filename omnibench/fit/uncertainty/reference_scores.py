"""Score vectors of runs whose references are no poses, for the sandwich.

A norm |e| of normal errors e of k coordinates with the standard deviations s_i, known up to a factor f, has for
u = e / |e| and derivatives J the expected curvature

    J' E[(1 - u u') / |e|] J / f,   E[u_i u_j] = 0 of i != j,                                             (1)

which for k = 1 is the density of the error at 0, sqrt(2/pi) / s. With e = S g, S = diag(s), g standard normal of length
r and direction w,

    E[u_i^2] = E_w[s_i^2 w_i^2 / |S w|^2],   E[u_i^2 / |e|] = E[1/r] E_w[s_i^2 w_i^2 / |S w|^3].          (2)

f^2 is the mean square of the errors in standard deviations where that is more than chance, else 1: references know how
exact they are, and not what slip adds. The scores of errors of one coordinate that the fit makes zero are those that
make the sum of all scores zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.special import chdtrc

from omnibench.data.dataset import Trajectory
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.least_squares.noise import covariance_of_sums
from omnibench.fit.least_squares.roots import roots_of
from omnibench.fit.observations.reference_batch import ReferenceBatch
from omnibench.fit.uncertainty.sandwich import DOUBT, Scores
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

_ZERO = 1e-3  # standard deviations: a smaller error of one coordinate was made zero by the fit
_DIRECTIONS = 400  # of Eq. (2) around the circle, and a tenth of them from pole to pole: integrals to 1e-6


def scores_of_references(
    objective: SumOfNorms,
    batch: ReferenceBatch,
    errors: Array,
    jacobian: Array,
    trajectories: Sequence[Trajectory],
    noise: Noise,
) -> Scores:
    """Score vectors and expected Hessians of the runs; arguments as those of ``scores_of_runs`` of sandwich.py."""
    weights, shares = np.array(objective.weights), objective.shares(batch.trajectory)
    sigmas = sigmas_of_rows(batch, noise)
    factor = scale_of(errors, sigmas, jacobian.shape[2])
    errors, slopes, spread = errors * weights, jacobian * weights[:, None], sigmas * np.abs(weights)
    norms = np.linalg.norm(errors, axis=1)
    single = (spread > 0).sum(axis=1) == 1
    zero = single & (norms < _ZERO * factor * spread.sum(axis=1))
    units = np.where(zero[:, None], 0.0, errors / np.maximum(norms, np.finfo(float).tiny)[:, None])
    pulls = shares[:, None] * np.einsum("ski,sk->si", slopes, units)
    pulls[zero] = _balancing(pulls.sum(axis=0), shares[zero, None] * slopes[zero].sum(axis=1))
    moments = np.array([_moments(tuple(of_row)) for of_row in spread.tolist()])  # (S, 2, 3)
    curved = moments[:, 1] / factor * shares[:, None]
    count = range(len(trajectories))
    own = [batch.trajectory == run for run in count]
    hessians = np.array([np.einsum("ski,sk,skj->ij", slopes[of_run], curved[of_run], slopes[of_run]) for of_run in own])
    squares = moments[:, 0] * np.square(shares)[:, None]
    working = np.array([np.einsum("ski,sk,skj->ij", slopes[of_run], squares[of_run], slopes[of_run]) for of_run in own])
    scores = np.array([pulls[of_run].sum(axis=0) for of_run in own])
    roots = roots_of(hessians.sum(axis=0))
    return Scores(scores, hessians, trajectories, -roots @ roots.T @ scores.sum(axis=0), working)


def sigmas_of_rows(batch: ReferenceBatch, noise: Noise) -> Array:
    """Standard deviations (S, 3) of the rows, those of poses by a noise model; 0 where nothing was measured."""
    rows = batch.rows
    walked = np.square([[noise.walk_position] * 2 + [noise.walk_heading]]) * rows.t1[:, None]
    white = np.square([[noise.pose_position] * 2 + [noise.pose_heading]])
    bias = np.square([[noise.bias_position] * 2 + [noise.bias_heading]])
    of_poses = np.sqrt(np.maximum(white + walked + bias, np.finfo(float).tiny))
    return np.where(rows.of_references[:, None], np.nan_to_num(rows.whole_sigmas), of_poses)


def scale_of(errors: Array, sigmas: Array, fitted: int) -> float:
    """The factor f of the standard deviations (S, 3), from errors (S, 3) after a fit of some numbers; 1 or more."""
    measured = sigmas > 0
    square = float(np.square(errors[measured] / sigmas[measured]).sum())
    freedom = max(int(measured.sum()) - fitted, 1)
    return math.sqrt(square / freedom) if float(chdtrc(freedom, square)) < DOUBT else 1.0


def covariance_of_rows(batch: ReferenceBatch, run: int, by_errors: Array, noise: Noise) -> Array:
    """Covariance (n, n) of weighted sums of a run's errors, of which by_errors (K, 3, n) are the weights.

    Poses have the noise model's covariance, references their own.
    """
    rows = batch.rows
    own = batch.trajectory == run
    references = rows.of_references[own]
    sigmas = np.nan_to_num(rows.whole_sigmas[own][references])
    scaled = (by_errors[references] * sigmas[..., None]).reshape(-1, by_errors.shape[2])
    total: Array = scaled.T @ scaled
    if not references.all():
        total = total + covariance_of_sums(noise, rows.t1[own][~references], by_errors[~references], (0, 1, 2))
    return total


def _balancing(total: Array, columns: Array) -> Array:
    """Scores (z, n) of z rows along their columns (z, n) that make a sum of scores (n,) zero, as nearly as they can."""
    if not len(columns):
        return columns
    units = np.linalg.lstsq(columns.T, -total, rcond=None)[0]
    return np.clip(units, -1.0, 1.0)[:, None] * columns


@cache
def _moments(sigmas: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """E[u_i^2] and E[(1 - u_i^2) / |e|] of each of three coordinates, Eq. (1) and (2); 0 of one with no deviation."""
    used = [axis for axis, sigma in enumerate(sigmas) if sigma > 0]
    squares, curved = np.zeros(3), np.zeros(3)
    if len(used) == 1:
        squares[used], curved[used] = 1.0, math.sqrt(2 / math.pi) / sigmas[used[0]]
    elif used:
        directions, weights = _directions(len(used))
        scaled = directions * np.array(sigmas)[used]
        lengths = np.linalg.norm(scaled, axis=1)
        shares = np.square(scaled / lengths[:, None])
        reciprocal = math.sqrt(math.pi / 2) if len(used) == 2 else math.sqrt(2 / math.pi)  # E[1/r]
        squares[used] = weights @ shares
        curved[used] = reciprocal * (weights / lengths) @ (1 - shares)
    return tuple(squares.tolist()), tuple(curved.tolist())


@cache
def _directions(count: int) -> tuple[Array, Array]:
    """Directions (n, count) in two or three dimensions, and their weights (n,), by which means over all are sums."""
    around = 2 * np.pi * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    circle = np.column_stack([np.cos(around), np.sin(around)])
    if count == 2:
        return circle, np.full(_DIRECTIONS, 1 / _DIRECTIONS)
    height, share = np.polynomial.legendre.leggauss(_DIRECTIONS // 10)
    width = np.sqrt(1 - height**2)
    directions = [np.column_stack([w * circle, np.full(_DIRECTIONS, h)]) for h, w in zip(height, width, strict=True)]
    return np.concatenate(directions), np.repeat(share / 2 / _DIRECTIONS, _DIRECTIONS)
