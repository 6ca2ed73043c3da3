"""Covariance of an estimate that minimises a sum of norms, from the scatter of what each run pulls it by."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.least_squares.repetitions import grouped, repetitions_of_commands
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch

# The scatter between clusters counts as more than repetitions explain where chance exceeds it once in a thousand times.
_CHANCE = 0.001
# A cluster that alone holds a direction of the fit cannot be judged there: its pull counts at most this often.
_LEAST_FREE = 0.05
_FEWEST_CLUSTERS = 4
_NOTHING = 1e-9  # of the largest curvature: along such directions the cost does not change
_INTERPOLATED = 1e-6  # of the median error


@dataclass(frozen=True, eq=False)
class Pulls:
    """A cost near its minimum, run by run, in n searched numbers.

    scores (Z, n): the runs' shares of the gradient. hessians (Z, n, n): of the Hessian. trajectories: the Z runs.
    step (n,): towards the minimum by reweighted least squares, which never overshoots far.
    """

    scores: Array
    hessians: Array
    trajectories: Sequence[Trajectory]
    step: Array


@dataclass(frozen=True, eq=False)
class Sandwich:
    """Covariance (n, n), the degrees of freedom of its variances, and what it rests on, in words.

    lack_of_fit: whether commands or sessions scatter more than their repetitions explain.
    """

    covariance: Array
    degrees_of_freedom: int
    words: str
    lack_of_fit: bool = False


def pulls_of_runs(
    objective: SumOfNorms, odometry: OdometryBatch, errors: Array, jacobian: Array, trajectories: Sequence[Trajectory]
) -> Pulls:
    """Scores and Hessians of the runs.

    errors (S, 3): odometry minus reference at the cost's stamps. jacobian (S, 3, n): their derivatives with respect to
    the searched numbers; the poses count as linear.

    A norm |e| counts as sqrt(|e|^2 + h^2), h small against the errors: a norm of one component has a Hessian only so
    (it is then twice a kernel estimate of the density at zero), others do not notice.
    """
    weights = np.array(objective.weights)
    used = np.flatnonzero(weights)
    errors = errors[:, used] * weights[used]
    slopes = jacobian[:, used] * weights[used, None]
    owner = odometry.trajectory
    count = len(trajectories)
    norms = np.linalg.norm(errors, axis=1)
    shares = objective.shares(owner)
    if len(used) == 1:  # as many errors as there are numbers are made zero, which says nothing of the others' density
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
    return Pulls(np.array(scores), np.array(hessians), trajectories, step)


def sandwich(pulls: Pulls) -> Sandwich:
    """The covariance H^-1 B H^-1 of an M-estimator (Huber 1967), H the Hessian and B the scores' covariance.

    B comes from the differences between repetitions of a command within a session. Where commands, or sessions,
    scatter more than their repetitions explain, the model does not fit and other commands would give another
    calibration: then whole commands, or sessions, are what scatters (clusters, with the small-sample correction of
    Bell and McCaffrey 2002), and in no direction is the result narrower than what repetitions say. Without
    repetitions every run is a cluster. DataError when there are fewer than two runs more than the fit takes up.
    """
    runs = pulls.trajectories
    hessian = pulls.hessians.sum(axis=0)
    bread = _root(_pinv(hessian))  # H^-1/2
    count, size = len(runs), int(np.linalg.matrix_rank(hessian, _NOTHING * np.abs(hessian).max(), hermitian=True))
    free_runs = count - max(1, -(-size // 3))  # a run has three numbers
    if free_runs < 1:
        raise DataError(f"runs are too few ({count}) for the scatter of {size} fitted numbers")
    repeated = repetitions_of_commands(runs)
    groups = repeated.groups
    if not groups:
        spread = _between([(index,) for index in range(count)], pulls, bread)
        words = f"the scatter between {count} runs: no command is repeated, so what the model cannot express counts too"
        return Sandwich(bread @ spread @ bread, free_runs, words)
    within = _within(groups, pulls, bread)
    freedom = sum(len(group) - 1 for group in groups)
    spread, clusters, words = within, None, f"the scatter between repetitions ({repeated.description})"
    largest = 1.0
    for name, members in _clusterings(runs):
        between = _between(members, pulls, bread)
        ratio = float(np.trace(between) / np.trace(within))
        unlikely = float(stats.f.isf(_CHANCE, _effective(between, len(members) - 1), _effective(within, freedom)))
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
    """Ways to put runs together that may have more in common than the model says, with enough clusters to judge."""
    ways: list[tuple[str, list[Hashable]]] = [
        ("command", [run.command if run.command is not None else ("run", run.id) for run in runs]),
        ("session", [run.session if run.session is not None else ("run", run.id) for run in runs]),
    ]
    found = [(name, grouped(keys)) for name, keys in ways]
    return [(name, members) for name, members in found if len(members) >= _FEWEST_CLUSTERS]


def _within(groups: Sequence[tuple[int, ...]], pulls: Pulls, bread: Array) -> Array:
    """Scatter (n, n) of whitened scores about their commands' means; runs that are not repeated count about zero."""
    scores = pulls.scores @ bread
    total = np.zeros((scores.shape[1],) * 2)
    repeated: set[int] = set()
    for group in groups:
        apart = scores[list(group)] - scores[list(group)].mean(axis=0)
        total += len(group) / (len(group) - 1) * apart.T @ apart
        repeated.update(group)
    alone = [(index,) for index in range(len(scores)) if index not in repeated]
    return total + (_between(alone, pulls, bread) if alone else 0.0)


def _between(clusters: Sequence[tuple[int, ...]], pulls: Pulls, bread: Array) -> Array:
    """Scatter (n, n) of whitened scores of clusters, freed of the share that the fit has taken up of each."""
    total = np.zeros(bread.shape)
    for members in clusters:
        score = bread @ pulls.scores[list(members)].sum(axis=0)
        taken = bread @ pulls.hessians[list(members)].sum(axis=0) @ bread
        values, vectors = np.linalg.eigh(np.eye(len(taken)) - taken)
        score = vectors @ ((vectors.T @ score) / np.sqrt(np.maximum(values, _LEAST_FREE)))
        total += np.outer(score, score)
    return total


def _effective(spread: Array, freedom: int) -> float:
    """Degrees of freedom of the mean of a spread's variances: as many times as there are independent directions."""
    values = np.linalg.eigvalsh(spread)
    return freedom * float(values.sum() ** 2 / np.square(values).sum())


def _wider(first: Array, second: Array) -> Array:
    """In every direction the larger of two spreads (n, n)."""
    root = _root(first)
    inverse = np.linalg.pinv(root, hermitian=True)
    values, vectors = np.linalg.eigh(inverse @ second @ inverse)
    turned = root @ vectors
    wider: Array = (turned * np.maximum(values, 1.0)) @ turned.T
    return wider


def _root(matrix: Array) -> Array:
    values, vectors = np.linalg.eigh(matrix)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root


def _pinv(matrix: Array) -> Array:
    """The inverse (n, n) where the matrix has one: zero along directions that nothing depends on."""
    inverse: Array = np.linalg.pinv(matrix, rcond=_NOTHING, hermitian=True)
    return inverse
