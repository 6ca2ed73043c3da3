"""Sandwich covariance of an estimate that minimises a sum over runs, from the scatter of the runs' score vectors.

With s_z the score of run z, H_z its share of the Hessian H, and R with R'HR = 1, everything is said in the coordinates
s = R's_z and L = R'H_z R, the leverage of a run; the leverages sum to 1. The covariance of the estimate (Huber 1967) is

    H^-1 B H^-1 = R (R'BR) R',                                                                            (1)

and R'BR is either the scatter within the groups g of n_g repetitions of a command,

    sum_g n_g / (n_g - 1) sum_(z in g) (s_z - mean_g)(s_z - mean_g)',                                     (2)

or that between clusters c, whose leverage and score are the sums of their runs'. A cluster's score is what is left of
its errors u_c after the fit, s_c = u_c - L_c sum_d u_d, and the correction of Bell and McCaffrey (2002) undoes that:

    sum_c M_c s_c s_c' M_c,   M_c = (1 - L_c)^(-1/2).                                                     (3)

The variance of a number whose row of R is r' is a sum of squares, and is distributed nearly as chi-square with the
degrees of freedom that its mean and its variance would have under errors of covariance L_z (Satterthwaite 1946). Of (2)
and (3) they are

    (sum_g w_g)^2 / sum_g w_g^2 / (n_g - 1),   w_g = r' L_g r,                                            (4)
    (tr G)^2 / tr G^2,   G_cd = y_c' (1_cd L_c - L_c L_d) y_d,   y_c = M_c r,                             (5)

(5) as in Imbens and Kolesar (2016): with few clusters, or one that tells more than the others, far fewer than clusters
less one. An F test of the traces of (3) and (2) decides whether clusters scatter more than repetitions explain. A trace
has the degrees of freedom of one direction, by the same reasoning

    tr E^2 / sum_g tr L_g^2 / (n_g - 1),   E = sum_g L_g,                                                 (6)
    tr E^2 / tr G^2,   G_cd = M_c (1_cd L_c - L_c L_d) M_d,   E = sum_c G_cc,                             (7)

times the effective number of directions in which the scatter S was seen,

    (tr S)^2 / tr S^2.                                                                                    (8)
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.least_squares.repetitions import grouped, repetitions_of_commands
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch
from omnibench.words import plural

# Ten calibrations of tests/benchmarks/constants_fit.py have the same covariance with half of each of these numbers and
# with twice, but for the kernel and the level of doubt.
# Level of the F test by which clusters that scatter more than repetitions explain show a lack of fit: strict, since one
# test a clustering is made and a wrong alarm doubts a model that is right.
_CHANCE = 0.001
# Level of the same test by which intervals rest on the clusters. A test that decides what an interval rests on must not
# be strict: of closed_form's intervals from five sessions whose scales differ by 2 %, 83 % hold the truth at 0.001 and
# 96 % at 0.05, in 55 sets, and sets of equal sessions lose nothing (tests/benchmarks/interval_coverage.py --doubt).
DOUBT = 0.05
# Least eigenvalue of I - H_c, H_c a cluster's share of the Hessian: where a cluster alone determines a direction the
# correction of Bell and McCaffrey divides by zero.
_LEAST_FREE = 0.05
_FEWEST_CLUSTERS = 4  # of fewer than four the 95 % interval of a variance spans more than a factor of 43 (chi-square)
_NOTHING = 1e-9  # share of the largest eigenvalue of the Hessian: below it the cost is flat, up to rounding
# Width of the kernel, in medians of the errors times the number of runs to the power -1/5 (the rate of density
# estimates: Silverman, Density Estimation, 1986, section 3.3). Stated deviations of medians then are 0.78 to 1.19 times
# the true ones in the median, for four distributions and 12 to 144 runs; half as wide, a tenth of them are 2.6 to 3.8
# times the true ones with 12 runs, and twice as wide, those of Laplace's errors are a third too large
# (tests/benchmarks/kernel_width.py).
_KERNEL = 0.7
_INTERPOLATED = 1e-6  # share of the median error: smaller ones were made zero by the fit, up to rounding


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
    """Sandwich covariance (n, n) and the data behind it, in words.

    degrees_of_freedom: independent differences between repetitions, clusters less one, or runs beyond the fitted
    numbers. effective_freedom (n,): degrees of freedom of each searched number's variance, Eq. (4) or (5), for
    intervals by Student's t. clustered: True if it is the scatter between commands or sessions, which seem to scatter
    more than their repetitions explain. lack_of_fit: True if they certainly do.
    """

    covariance: Array
    degrees_of_freedom: int
    effective_freedom: Array
    words: str
    clustered: bool = False
    lack_of_fit: bool = False


def scores_of_runs(
    objective: SumOfNorms, odometry: OdometryBatch, errors: Array, jacobian: Array, trajectories: Sequence[Trajectory]
) -> Scores:
    """Score vectors and Hessians of the runs.

    errors (S, 3): odometry minus reference at the cost's stamps. jacobian (S, 3, n): their derivatives by the searched
    numbers; second derivatives of the poses are neglected.

    A norm |e| is smoothed to sqrt(|e|^2 + h^2), with h small against the errors. A norm of one component needs it: its
    Hessian then is twice a kernel estimate of the error density at zero. Others hardly change. Errors that the fit made
    zero do not count for h. DataError if these are half of all.
    """
    weights = np.array(objective.weights)
    used = np.flatnonzero(weights)
    errors = errors[:, used] * weights[used]
    slopes = jacobian[:, used] * weights[used, None]
    owner = odometry.trajectory
    count = len(trajectories)
    norms = np.linalg.norm(errors, axis=1)
    shares = objective.shares(owner)
    middle = float(np.median(norms))
    if middle <= _INTERPOLATED * norms.max():
        raise DataError("the answer passes exactly through half of the poses, and the others are too few")
    left = norms > _INTERPOLATED * middle
    if len(used) == 1:  # the fit makes n errors exactly zero; they do not belong to the density of the others
        shares = np.where(left, shares * len(left) / left.sum(), 0.0)
        width = _KERNEL * count**-0.2 * float(np.median(norms[left]))
    else:
        width = count**-0.5 * float(np.median(norms[left]))
    lengths = np.sqrt(norms**2 + width**2)
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
    roots = roots_of(curvature, _NOTHING)
    step = -roots @ roots.T @ np.sum(scores, axis=0)
    return Scores(np.array(scores), np.array(hessians), trajectories, step)


def sandwich(scores: Scores) -> Sandwich:
    """The covariance H^-1 B H^-1 of an M-estimator (Huber 1967), H the Hessian and B the scores' covariance, Eq. (1).

    B is estimated from the differences between repetitions of a command within a session, Eq. (2). Where commands, or
    sessions, scatter more than their repetitions explain, the model does not fit and other commands would give another
    calibration. Commands, or sessions, then are the clusters of a cluster-robust B, Eq. (3), which in no direction is
    smaller than B from repetitions; of the two those that scatter more. Without repetitions every run is a cluster.
    DataError when fewer than two runs are left beyond those that the fit uses up.
    """
    runs = scores.trajectories
    roots = roots_of(scores.hessians.sum(axis=0), _NOTHING)
    count, size = len(runs), roots.shape[1]
    free_runs = count - max(1, -(-size // 3))  # a run has three numbers
    if free_runs < 1:
        raise DataError(f"runs are too few ({count}) for the scatter of {plural(size, 'fitted number')}")
    whitened = _Whitened(scores.scores @ roots, roots.T @ scores.hessians @ roots)
    repeated = repetitions_of_commands(runs)
    if not repeated.groups:
        scatter = whitened.between([(index,) for index in range(count)], roots)
        words = f"the scatter between {count} runs: no command is repeated, so what the model cannot express counts too"
        return Sandwich(roots @ scatter.spread @ roots.T, free_runs, scatter.freedom, words)
    within = whitened.within(repeated.groups, roots)
    answer = Sandwich(
        roots @ within.spread @ roots.T,
        sum(len(group) - 1 for group in repeated.groups),
        within.freedom,
        f"the scatter between repetitions ({repeated.description})",
    )
    largest = False, 1.0  # lack of fit, ratio to the scatter of repetitions
    for name, members in _clusterings(runs):
        between = whitened.between(members, roots)
        ratio = float(np.trace(between.spread) / np.trace(within.spread))
        chance = float(fdtrc(between.freedom_of_trace, within.freedom_of_trace, ratio))
        lack_of_fit = chance < _CHANCE
        if chance < DOUBT and (lack_of_fit, ratio) > largest:
            largest = lack_of_fit, ratio
            words = (
                f"the scatter between {len(members)} {name}s, {np.sqrt(ratio):.1f} times what the repetitions within "
                "them explain"
            )
            answer = Sandwich(
                roots @ wider(within.spread, between.spread) @ roots.T,
                len(members) - 1,
                between.freedom,
                f"{words}: the model does not fit all of them at once" if lack_of_fit else words,
                clustered=True,
                lack_of_fit=lack_of_fit,
            )
    return answer


def _clusterings(runs: Sequence[Trajectory]) -> list[tuple[str, list[tuple[int, ...]]]]:
    """Clusterings of the runs, by command and by session, that have enough clusters for a test."""
    keys_of: list[tuple[str, list[Hashable]]] = [
        ("command", [run.command if run.command is not None else ("run", run.id) for run in runs]),
        ("session", [run.session if run.session is not None else ("run", run.id) for run in runs]),
    ]
    clusterings = [(name, grouped(keys)) for name, keys in keys_of]
    return [(name, members) for name, members in clusterings if len(members) >= _FEWEST_CLUSTERS]


@dataclass(frozen=True, eq=False)
class _Scatter:
    """An estimate (d, d) of B in whitened coordinates.

    freedom (n,): degrees of freedom of the n variances, Eq. (4) or (5). of_direction: those of a direction, Eq. (6) or
    (7).
    """

    spread: Array
    freedom: Array
    of_direction: float

    @property
    def freedom_of_trace(self) -> float:
        """Degrees of freedom of the trace: those of a direction times the effective number of directions, Eq. (8)."""
        return self.of_direction * float(np.trace(self.spread) ** 2 / np.square(self.spread).sum())


@dataclass(frozen=True, eq=False)
class _Whitened:
    """Scores (Z, d) and Hessians (Z, d, d) of Z runs in coordinates in which the Hessians sum to the unit matrix.

    directions (n, d): rows of the matrix that turns these coordinates into the n searched numbers.
    """

    scores: Array
    hessians: Array

    def within(self, groups: Sequence[tuple[int, ...]], directions: Array) -> _Scatter:
        """Scatter about the means of repeated commands, Eq. (2); about zero for runs without repetition."""
        total = np.zeros(self.hessians.shape[1:])
        for members in map(list, groups):
            apart = self.scores[members] - self.scores[members].mean(axis=0)
            total += len(members) / (len(members) - 1) * apart.T @ apart
        alone = [(index,) for index in sorted(set(range(len(self.scores))).difference(*groups))]
        if alone:
            total += self.between(alone, directions).spread
        leverages = np.array([self.hessians[list(members)].sum(axis=0) for members in (*groups, *alone)])
        freedoms = np.array([max(len(members) - 1, 1) for members in (*groups, *alone)])
        weights = np.einsum("nd,gde,ne->gn", directions, leverages, directions)
        freedom = _ratio(weights.sum(axis=0) ** 2, (np.square(weights) / freedoms[:, None]).sum(axis=0))  # Eq. (4)
        squares = float((np.square(leverages).sum(axis=(1, 2)) / freedoms).sum())
        return _Scatter(total, freedom, len(total) / squares)  # Eq. (6)

    def between(self, clusters: Sequence[tuple[int, ...]], directions: Array) -> _Scatter:
        """Scatter of clusters about zero, with Bell and McCaffrey's correction for what the fit absorbs, Eq. (3)."""
        leverages = np.array([self.hessians[list(members)].sum(axis=0) for members in clusters])
        scores = np.array([self.scores[list(members)].sum(axis=0) for members in clusters])
        values, vectors = np.linalg.eigh(np.eye(leverages.shape[1]) - leverages)
        corrections = (vectors / np.sqrt(np.maximum(values, _LEAST_FREE))[:, None]) @ vectors.swapaxes(1, 2)
        corrected = np.einsum("cde,ce->cd", corrections, scores)
        along = directions @ corrections  # y_c for every number
        absorbed = along @ leverages
        own, lengths = (along * absorbed).sum(axis=2), np.square(absorbed).sum(axis=2)
        shared = np.square(np.einsum("cnd,cne->nde", absorbed, absorbed)).sum(axis=(1, 2))
        squares = (own * (own - 2 * lengths)).sum(axis=0) + shared  # tr G^2, the C^2 blocks of G not formed
        freedom = _ratio((own - lengths).sum(axis=0) ** 2, squares)  # Eq. (5)
        return _Scatter(corrected.T @ corrected, freedom, _freedom_of_direction(leverages, corrections))


def _freedom_of_direction(leverages: Array, corrections: Array) -> float:
    """Eq. (7) from the leverages (C, d, d) of clusters and their corrections M."""
    own = corrections @ leverages @ corrections
    absorbed = corrections @ leverages @ leverages @ corrections
    squares = float((own * (own - 2 * absorbed)).sum() + np.square(absorbed.sum(axis=0)).sum())
    return float(np.square((own - absorbed).sum(axis=0)).sum()) / max(squares, 1e-300)


def _ratio(numerators: Array, denominators: Array) -> Array:
    """Degrees of freedom (n,), at least 1; of numbers that do not vary, 1."""
    return np.maximum(numerators / np.maximum(denominators, 1e-300), 1.0)


def roots_of(information: Array, share: float) -> Array:
    """Roots R (n, d) with R'AR = 1 of a positive semi-definite matrix A (n, n).

    Directions whose eigenvalue is below a share of the largest are left out: R R' is the pseudo-inverse of A.
    """
    values, vectors = np.linalg.eigh(information)
    known = values > share * values.max(initial=0.0)
    roots: Array = vectors[:, known] / np.sqrt(values[known])
    return roots


def wider(first: Array, second: Array) -> Array:
    """A matrix (d, d) that is the larger of two positive semi-definite ones in every direction.

    In coordinates in which both are diagonal and their sum is the unit matrix.
    """
    roots = roots_of(first + second, _NOTHING)
    values, vectors = np.linalg.eigh(roots.T @ second @ roots)
    turned = np.linalg.pinv(roots.T) @ vectors
    larger: Array = (turned * np.maximum(values, 1 - values)) @ turned.T
    return larger
