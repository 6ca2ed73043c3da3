"""Sandwich covariance of an estimate that minimises a sum of norms, from the scatter of the runs' score vectors."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.least_squares.repetitions import grouped, repetitions_of_commands
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch
from omnibench.words import plural

# Level of the F test that decides whether clusters scatter more than repetitions explain; chosen strict.
_CHANCE = 0.001
# Least eigenvalue of I - H_c, H_c a cluster's share of the Hessian: where a cluster alone determines a direction the
# correction of Bell and McCaffrey divides by zero. Chosen.
_LEAST_FREE = 0.05
_FEWEST_CLUSTERS = 4  # chosen: fewer cannot show a scatter
_NOTHING = 1e-9  # share of the largest eigenvalue of the Hessian: below it the cost is flat, up to rounding
_INTERPOLATED = 1e-6  # share of the median error: smaller ones were made zero by the fit


@dataclass(frozen=True, eq=False)
class Scores:
    """Score vectors of Z runs: the cost's gradient near its minimum, split by run.

    scores (Z, n): gradients of the runs' shares of the cost by the n searched numbers. hessians (Z, n, n): Hessians of
    these shares. trajectories: the Z runs. step (n,): to the minimum, by one step of reweighted least squares.
    """

    scores: Array
    hessians: Array
    trajectories: Sequence[Trajectory]
    step: Array


@dataclass(frozen=True, eq=False)
class Sandwich:
    """Sandwich covariance (n, n), the degrees of freedom of its variances, and the data behind it, in words.

    lack_of_fit: True if commands or sessions scatter more than their repetitions explain.
    """

    covariance: Array
    degrees_of_freedom: int
    words: str
    lack_of_fit: bool = False


def scores_of_runs(
    objective: SumOfNorms, odometry: OdometryBatch, errors: Array, jacobian: Array, trajectories: Sequence[Trajectory]
) -> Scores:
    """Score vectors and Hessians of the runs.

    errors (S, 3): odometry minus reference at the cost's stamps. jacobian (S, 3, n): their derivatives by the searched
    numbers; second derivatives of the poses are neglected.

    A norm |e| is smoothed to sqrt(|e|^2 + h^2), with h small against the errors. A norm of one component needs it: its
    Hessian then is twice a kernel estimate of the error density at zero. Others hardly change.
    """
    weights = np.array(objective.weights)
    used = np.flatnonzero(weights)
    errors = errors[:, used] * weights[used]
    slopes = jacobian[:, used] * weights[used, None]
    owner = odometry.trajectory
    count = len(trajectories)
    norms = np.linalg.norm(errors, axis=1)
    shares = objective.shares(owner)
    if len(used) == 1:  # the fit makes n errors exactly zero; they do not belong to the density of the others
        left = norms > _INTERPOLATED * np.median(norms)
        shares = np.where(left, shares * len(left) / max(left.sum(), 1), 0.0)
        width = 0.7 * count**-0.2 * float(np.median(norms[left])) if left.any() else 0
    else:
        width = count**-0.5 * float(np.median(norms))
    lengths = np.sqrt(norms**2 + max(width, 1e-15) ** 2)
    along = np.einsum("ski,sk->si", slopes, errors)
    scores, hessians = [], []
    curvature = np.zeros((slopes.shape[2],) * 2)
    for run in range(count):
        own = owner == run
        share, length = shares[own], lengths[own]
        scores.append((share / length) @ along[own])
        columns = (slopes[own] * np.sqrt(share / length)[:, None, None]).reshape(-1, slopes.shape[2])
        rays = along[own] * np.sqrt(share / length**3)[:, None]
        squares = columns.T @ columns
        curvature += squares
        hessians.append(squares - rays.T @ rays)
    step = -_pinv(curvature) @ np.sum(scores, axis=0)
    return Scores(np.array(scores), np.array(hessians), trajectories, step)


def sandwich(scores: Scores) -> Sandwich:
    """The covariance H^-1 B H^-1 of an M-estimator (Huber 1967), H the Hessian and B the scores' covariance.

    B is estimated from the differences between repetitions of a command within a session. Where commands, or sessions,
    scatter more than their repetitions explain, the model does not fit and other commands would give another
    calibration. Commands, or sessions, then are the clusters of a cluster-robust B (small-sample correction of Bell and
    McCaffrey 2002), which in no direction is smaller than B from repetitions. Without repetitions every run is a
    cluster. DataError when fewer than two runs are left beyond those that the fit uses up.
    """
    runs = scores.trajectories
    hessian = scores.hessians.sum(axis=0)
    bread = _root(_pinv(hessian))  # H^-1/2
    count, size = len(runs), int(np.linalg.matrix_rank(hessian, _NOTHING * np.abs(hessian).max(), hermitian=True))
    free_runs = count - max(1, -(-size // 3))  # a run has three numbers
    if free_runs < 1:
        raise DataError(f"runs are too few ({count}) for the scatter of {plural(size, 'fitted number')}")
    repeated = repetitions_of_commands(runs)
    groups = repeated.groups
    if not groups:
        spread = _between([(index,) for index in range(count)], scores, bread)
        words = f"the scatter between {count} runs: no command is repeated, so what the model cannot express counts too"
        return Sandwich(bread @ spread @ bread, free_runs, words)
    within = _within(groups, scores, bread)
    freedom = sum(len(group) - 1 for group in groups)
    spread, clusters, words = within, None, f"the scatter between repetitions ({repeated.description})"
    largest = 1.0
    for name, members in _clusterings(runs):
        between = _between(members, scores, bread)
        ratio = float(np.trace(between) / np.trace(within))
        unlikely = float(fdtri(_effective(between, len(members) - 1), _effective(within, freedom), 1 - _CHANCE))
        if ratio > max(unlikely, largest):
            largest, clusters = ratio, members
            spread = _wider(within, between)
            words = (
                f"the scatter between {len(members)} {name}s, {np.sqrt(ratio):.1f} times what the repetitions within "
                f"them explain: the model does not fit all of them at once"
            )
    lack = clusters is not None
    return Sandwich(bread @ spread @ bread, freedom if clusters is None else len(clusters) - 1, words, lack)


def _clusterings(runs: Sequence[Trajectory]) -> list[tuple[str, list[tuple[int, ...]]]]:
    """Clusterings of the runs, by command and by session, that have enough clusters for a test."""
    keys_of: list[tuple[str, list[Hashable]]] = [
        ("command", [run.command if run.command is not None else ("run", run.id) for run in runs]),
        ("session", [run.session if run.session is not None else ("run", run.id) for run in runs]),
    ]
    clusterings = [(name, grouped(keys)) for name, keys in keys_of]
    return [(name, members) for name, members in clusterings if len(members) >= _FEWEST_CLUSTERS]


def _within(groups: Sequence[tuple[int, ...]], scores: Scores, bread: Array) -> Array:
    """Scatter (n, n) of whitened scores about the means of their commands; about zero for runs without repetition."""
    whitened = scores.scores @ bread
    total = np.zeros((whitened.shape[1],) * 2)
    repeated: set[int] = set()
    for group in groups:
        apart = whitened[list(group)] - whitened[list(group)].mean(axis=0)
        total += len(group) / (len(group) - 1) * apart.T @ apart
        repeated.update(group)
    alone = [(index,) for index in range(len(whitened)) if index not in repeated]
    return total + (_between(alone, scores, bread) if alone else 0.0)


def _between(clusters: Sequence[tuple[int, ...]], scores: Scores, bread: Array) -> Array:
    """Scatter (n, n) of whitened cluster scores, with Bell and McCaffrey's correction for what the fit absorbs."""
    total = np.zeros(bread.shape)
    for members in clusters:
        score = bread @ scores.scores[list(members)].sum(axis=0)
        leverage = bread @ scores.hessians[list(members)].sum(axis=0) @ bread
        values, vectors = np.linalg.eigh(np.eye(len(leverage)) - leverage)
        score = vectors @ ((vectors.T @ score) / np.sqrt(np.maximum(values, _LEAST_FREE)))
        total += np.outer(score, score)
    return total


def _effective(spread: Array, freedom: int) -> float:
    """Degrees of freedom of the trace of a scatter matrix: ``freedom`` times its effective number of directions."""
    values = np.linalg.eigvalsh(spread)
    return freedom * float(values.sum() ** 2 / np.square(values).sum())


def _wider(first: Array, second: Array) -> Array:
    """A scatter matrix (n, n) that in no direction is below the first, and equals the second where that is larger."""
    root = _root(first)
    inverse = np.linalg.pinv(root, hermitian=True)
    values, vectors = np.linalg.eigh(inverse @ second @ inverse)
    turned = root @ vectors
    wider: Array = (turned * np.maximum(values, 1.0)) @ turned.T
    return wider


def _root(matrix: Array) -> Array:
    """Symmetric square root (n, n) of a positive semi-definite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root


def _pinv(matrix: Array) -> Array:
    """Pseudo-inverse (n, n): zero along directions in which the cost is flat."""
    inverse: Array = np.linalg.pinv(matrix, rcond=_NOTHING, hermitian=True)
    return inverse
