"""Sandwich covariance of an estimate that minimises a sum over runs, from the scatter of the runs' score vectors.

With s_z the score of run z, H_z its share of the Hessian H, and R with R'HR = 1, everything is said in the coordinates
s = R's_z and L = R'H_z R, the leverage of a run; the leverages sum to 1. The covariance of the estimate (Huber 1967) is

    H^-1 B H^-1 = R (R'BR) R',                                                                            (1)

and R'BR is either the scatter within the groups g of n_g repetitions of a command,

    sum_g n_g / (n_g - 1) sum_(z in g) (s_z - mean_g)(s_z - mean_g)',                                     (2)

or that between clusters c, whose leverage and score are the sums of their runs'. A cluster's score is what is left of
its errors u_c after the fit, s_c = u_c - L_c sum_d u_d, and the correction of Bell and McCaffrey (2002) undoes that:

    sum_c M_c s_c s_c' M_c,   M_c = (1 - L_c)^(-1/2).                                                     (3)

A run without repetition is a cluster by itself in (2), too. Where one cluster alone determines a direction, L_c is 1
there, the fit passes through its errors, and nothing is left of them. M_c is bounded, and the scatter S of (2) or (3)
lacks, of every cluster's errors,

    K_c = (1 - (1 - L_c) M_c^2)^(1/2),                                                                    (4)

which is 0 where M_c is not bounded and 1 where nothing is left. There the working model stands in, errors u_z of the
covariance s^2 V_z with V_z = R'D'C D R, C the covariance of a run's poses by the noise model, D the derivatives of its
score by their errors. What is seen of it tells s^2:

    R'BR = S + s^2 N,   N = sum_c K_c V_c K_c,   s^2 = tr S / tr(sum_z V_z - N).                          (5)

If V_z is L_z, as where the noise model weights the fit, the expectation of S is s^2 E with E = sum_g L_g and, of
clusters, E = sum_c G_cc, G_cd = M_c (1_cd L_c - L_c L_d) M_d. E = 1 - N, and (5) has no bias.

The variance of a number whose row of R is r' is a sum of squares, and is distributed nearly as chi-square with the
degrees of freedom that its mean and its variance would have with V_z = L_z (Satterthwaite 1946),

    (r'E r + k tr E)^2 / (v + 2 k r'Q r + k^2 tr Q),   k = r'N r / tr(sum_z V_z - N),                     (6)

in which repetitions and clusters have

    v = sum_g (r'L_g r)^2 / (n_g - 1),   Q = sum_g L_g^2 / (n_g - 1),                                     (7)
    v = sum_cd (r'G_cd r)^2,             Q = sum_cd G_cd G_dc.                                            (8)

(8) with k = 0 is that of Imbens and Kolesar (2016): with few clusters, or one that tells more than the others, far
fewer than clusters less one. There are never said to be more than that, or than differences between repetitions: s^2
may have more, but is that of another direction. An F test of the s^2 of clusters and of repetitions decides whether
clusters scatter more. s^2 has the degrees of freedom of one direction, by the same reasoning, times the effective
number of directions in which the scatter was seen,

    tr E^2 / tr Q  (tr S)^2 / tr S^2.                                                                     (9)

Repetitions that agree exactly are exceeded by whatever scatter there is. Clusters that differ little, by half to once
the noise of a run, are often missed: then 84 to 92 % of the 95 % intervals of a linear model hold the truth, with 4 to
12 clusters, and 92 % of closed_form's with 5 (tests/studies/interval_coverage.py --only slight, 60 sets).

Of runs whose references are no poses, a norm |e| of normal errors e of k coordinates with the standard deviations s_i,
known up to a factor f, has for u = e / |e| and derivatives J the expected curvature

    J' E[(1 - u u') / |e|] J / f,   E[u_i u_j] = 0 of i != j,                                            (10)

which for k = 1 is the density of the error at 0, sqrt(2/pi) / s. With e = S g, S = diag(s), g standard normal of length
r and direction w,

    E[u_i^2] = E_w[s_i^2 w_i^2 / |S w|^2],   E[u_i^2 / |e|] = E[1/r] E_w[s_i^2 w_i^2 / |S w|^3].         (11)

f^2 is the mean square of the errors in standard deviations where that is more than chance, else 1: references know how
exact they are, and not what slip adds. The scores of errors of one coordinate that the fit makes zero are those that
make the sum of all scores zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import chdtrc, fdtrc

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.noise import ROUNDING, covariance_of_sums, grouped, repetitions_of_commands, roots_of
from omnibench.fit.reference_rows import ReferenceBatch
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch
from omnibench.words import plural

# Ten calibrations of tests/studies/constants_fit.py have the same covariance with half of each number below and with
# twice, but for the kernel and the level of doubt. They have 12 commands or more, of which none alone determines a
# direction, so that they say nothing of _LEAST_FREE and _FEWEST_CLUSTERS.
# Level of the F test by which clusters that scatter more than repetitions explain show a lack of fit: strict, since one
# test a clustering is made and a wrong alarm doubts a model that is right. In the data named the test decides the same
# at half the level and at twice.
CHANCE = 0.001
# Level of the same test by which intervals rest on the clusters. A test that decides what an interval rests on must not
# be strict: of closed_form's intervals from five sessions whose scales differ by 2 %, 83 % hold the truth at 0.001 and
# 96 % at 0.05, in 55 sets, and sets of equal sessions lose nothing (tests/studies/interval_coverage.py --doubt).
DOUBT = 0.05
# Least eigenvalue of 1 - L_c, by which the correction of Bell and McCaffrey divides; below it the noise model makes up
# for the difference, Eq. (5). With a single run that turns, beside 5, 8 and 12 straight ones, 95, 95 and 91 % of
# closed_form's intervals of the elements hold the truth, 82 sets (tests/studies/interval_coverage.py --only turn).
# A smaller one lets in the rounding of scores that the fit made zero; half and twice were not tried.
_LEAST_FREE = 0.05
# Fewer clusters are not tested: the 95 % interval of a variance spans a factor of 43 with four, of 146 with three.
_FEWEST_CLUSTERS = 4
# Width of the kernel, in medians of the errors times the number of runs to the power -1/5 (the rate of density
# estimates: Silverman, Density Estimation, 1986, section 3.3). Stated deviations of medians then are 0.78 to 1.19 times
# the true ones in the median, for four distributions and 12 to 144 runs; half as wide, a tenth of them are 2.6 to 3.8
# times the true ones with 12 runs, and twice as wide, those of Laplace's errors are a third too large
# (tests/studies/kernel_width.py).
_KERNEL = 0.7
_LEAST_SEEN = 0.1  # share of the working model's variance; see Sandwich.steadied
_INTERPOLATED = 1e-6  # share of the median error: smaller ones were made zero by the fit, up to rounding
_ZERO = 1e-3  # standard deviations: a smaller error of one coordinate was made zero by the fit
_DIRECTIONS = 400  # of Eq. (11) around the circle, and a tenth of them from pole to pole: integrals to 1e-6


@dataclass(frozen=True, eq=False)
class Scores:
    """Score vectors of Z runs: the cost's gradient near its minimum, split by run.

    scores (Z, n): gradients of the runs' shares of the cost by the n searched numbers. hessians (Z, n, n): Hessians of
    these shares. trajectories: the Z runs. step (n,): to the minimum, by one step of reweighted least squares. working
    (Z, n, n): covariance that the scores would have by the noise model, up to a factor.
    """

    scores: Array
    hessians: Array
    trajectories: Sequence[Trajectory]
    step: Array
    working: Array


@dataclass(frozen=True, eq=False)
class Sandwich:
    """Sandwich covariance (n, n) and the data behind it, in words.

    effective_freedom (n,): degrees of freedom of each searched number's variance, Eq. (6), for intervals by Student's
    t. freedom_of_trace: those of the mean variance of a direction, Eq. (9). model (n, n): the working model's
    covariance at the size that the scatter shows, s^2 R (sum_z V_z) R'. clustered: True if it is the scatter between
    commands or sessions, which seem to scatter more than their repetitions explain. lack_of_fit: True if they certainly
    do.
    """

    covariance: Array
    effective_freedom: Array
    freedom_of_trace: float
    model: Array
    words: str
    clustered: bool = False
    lack_of_fit: bool = False

    @property
    def steadied(self) -> Array:
        """The covariance, in no direction smaller than a share of the working model's: few runs may not scatter there.

        Of n runs' scatter in d directions the smallest eigenvalue is (1 - sqrt(d/n))^2 of the true one (Marchenko and
        Pastur, Math. USSR-Sb. 1:457, 1967), which is a tenth for n near 2 d; fewer runs say nothing of that direction.
        """
        return wider(self.covariance, _LEAST_SEEN * self.model)


def scores_of_runs(
    objective: SumOfNorms,
    odometry: OdometryBatch,
    errors: Array,
    jacobian: Array,
    trajectories: Sequence[Trajectory],
    noise: Noise,
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
    stamps = [log.stamps for log in objective.logs(trajectories)]
    count = len(trajectories)
    norms = np.linalg.norm(errors, axis=1)
    shares = objective.shares(owner)
    middle = float(np.median(norms))
    if middle <= _INTERPOLATED * norms.max():
        raise DataError("the answer passes exactly through half of the poses, and the others are too few")
    apart = norms > _INTERPOLATED * middle
    if len(used) == 1:  # the fit makes n errors exactly zero; they do not belong to the density of the others
        shares = np.where(apart, shares * len(apart) / apart.sum(), 0.0)
        width = _KERNEL * count**-0.2 * float(np.median(norms[apart]))
    else:
        width = count**-0.5 * float(np.median(norms[apart]))
    lengths = np.sqrt(norms**2 + width**2)
    along = np.einsum("ski,sk->si", slopes, errors)
    scores, hessians, working = [], [], []
    curvature = np.zeros((slopes.shape[2],) * 2)
    for run in range(count):
        rows = owner == run
        share, length = shares[rows], lengths[rows]
        scores.append((share / length) @ along[rows])
        columns = (slopes[rows] * np.sqrt(share / length)[:, None, None]).reshape(-1, slopes.shape[2])
        rays = along[rows] * np.sqrt(share / length**3)[:, None]
        squares = columns.T @ columns
        curvature += squares
        hessians.append(squares - rays.T @ rays)
        curved = slopes[rows] - errors[rows][:, :, None] * (along[rows] / length[:, None] ** 2)[:, None]
        by_errors = curved * (share / length)[:, None, None] * weights[used][:, None]
        working.append(covariance_of_sums(noise, stamps[run], by_errors, used.tolist()))  # D'C D
    roots = roots_of(curvature)
    step = -roots @ roots.T @ np.sum(scores, axis=0)
    return Scores(np.array(scores), np.array(hessians), trajectories, step, np.array(working))


def sandwich(scores: Scores) -> Sandwich:
    """The covariance H^-1 B H^-1 of an M-estimator (Huber 1967), H the Hessian and B the scores' covariance, Eq. (1).

    B is estimated from the differences between repetitions of a command within a session, Eq. (2). Where commands, or
    sessions, scatter more than their repetitions explain, the model does not fit and other commands would give another
    calibration. Commands, or sessions, then are the clusters of a cluster-robust B, Eq. (3), which in no direction is
    smaller than B from repetitions; of the two those that scatter more. Without repetitions every run is a cluster.
    DataError when fewer than two runs are left beyond those that the fit uses up, or nothing scatters.
    """
    runs = scores.trajectories
    roots = roots_of(scores.hessians.sum(axis=0))
    count, size = len(runs), roots.shape[1]
    if count - max(1, -(-size // 3)) < 1:  # a run has three numbers
        raise DataError(f"runs are too few ({count}) for the scatter of {plural(size, 'fitted number')}")
    whitened = _Whitened(
        scores.scores @ roots, roots.T @ scores.hessians @ roots, roots.T @ scores.working @ roots, roots
    )
    repeated = repetitions_of_commands(runs)
    if not repeated.groups:
        words = f"the scatter between {count} runs: {repeated.words}, so what the model cannot express counts too"
        return whitened.between([(index,) for index in range(count)]).sandwich(roots, words)
    within = whitened.within(repeated.groups)
    clusterings: list[tuple[str, list[tuple[int, ...]]]] = []
    for name in ("command", "session"):
        keys = [(name, key) if (key := getattr(run, name)) is not None else ("run", run.id) for run in runs]
        clusterings.append((name, grouped(keys)))
    few = [
        f"; {len(members)} {name}s are too few to tell whether they scatter more"
        for name, members in clusterings
        if 1 < len(members) < _FEWEST_CLUSTERS
    ]
    answer = within.sandwich(roots, "".join([f"the scatter between repetitions ({repeated.description})", *few]))
    largest = False, 1.0  # lack of fit, ratio to the scatter of repetitions
    for name, members in clusterings:
        if len(members) < _FEWEST_CLUSTERS:
            continue
        between = whitened.between(members)
        ratio = times_the(within.size, between.size)
        chance = float(fdtrc(between.freedom_of_trace, within.freedom_of_trace, ratio))
        lack_of_fit = chance < CHANCE
        if chance < DOUBT and (lack_of_fit, ratio) > largest:
            largest = lack_of_fit, ratio
            times = f"{np.sqrt(ratio):.1f} times what the repetitions within them explain"
            more = times if np.isfinite(ratio) else "more than the repetitions, which agree exactly"
            words = f"the scatter between {len(members)} {name}s, {more}"
            if lack_of_fit:
                words += ": the model does not fit all of them at once"
            answer = replace(
                between.sandwich(roots, words, name),
                covariance=roots @ wider(within.covariance, between.covariance) @ roots.T,
                clustered=True,
                lack_of_fit=lack_of_fit,
            )
    if not answer.clustered and np.isinf(times_the(within.size, float(np.square(whitened.scores).sum()))):
        raise DataError("the repetitions agree exactly, so that nothing scatters")
    return answer


def times_the(usual: float, seen: float) -> float:
    """Ratio of a variance to a usual one; infinite where the usual one is rounding beside it."""
    return seen / usual if usual > ROUNDING * seen else math.inf


@dataclass(frozen=True, eq=False)
class _Scatter:
    """An estimate of R'BR, Eq. (5).

    spread (d, d): S. expected (d, d): E. unseen (d, d): N. seen: tr(sum_z V_z - N). squares (d, d): Q, Eq. (7) or (8).
    freedom (n,): degrees of freedom of the variances, Eq. (6). working (d, d): sum_z V_z.
    """

    spread: Array
    expected: Array
    unseen: Array
    seen: float
    squares: Array
    freedom: Array
    working: Array

    @property
    def size(self) -> float:
        """s^2, the variance of the working model that the scatter shows."""
        return float(np.trace(self.spread) / self.seen)

    @property
    def covariance(self) -> Array:
        """R'BR, Eq. (5)."""
        return np.asarray(self.spread + self.size * self.unseen)

    @property
    def freedom_of_trace(self) -> float:
        """Degrees of freedom of s^2, Eq. (9); of one direction where nothing scatters."""
        directions = np.trace(self.spread) ** 2 / max(np.square(self.spread).sum(), 1e-300)
        return float(np.square(self.expected).sum() / np.trace(self.squares) * max(directions, 1.0))

    def sandwich(self, roots: Array, words: str, name: str = "run") -> Sandwich:
        """The sandwich that rests on this scatter, which is described in words; name: one of its clusters."""
        if np.linalg.eigvalsh(self.expected)[0] < 0.5:  # most of a variance comes from the working model
            words += (
                f"; directions that one {name} alone determines have the noise model's, as large as the others' tell"
            )
        model = roots @ (self.size * self.working) @ roots.T
        return Sandwich(roots @ self.covariance @ roots.T, self.freedom, self.freedom_of_trace, model, words)


@dataclass(frozen=True, eq=False)
class _Whitened:
    """Scores (Z, d) and Hessians (Z, d, d) of Z runs in coordinates in which the Hessians sum to the unit matrix.

    working (Z, d, d): V_z, Eq. (5).
    directions (n, d): rows of the matrix R that turns these coordinates into the n searched numbers.
    """

    scores: Array
    hessians: Array
    working: Array
    directions: Array

    def within(self, groups: Sequence[tuple[int, ...]]) -> _Scatter:
        """Scatter about the means of repeated commands, Eq. (2), and about zero of runs without repetition, Eq. (3)."""
        spread = np.zeros(self.hessians.shape[1:])
        for members in map(list, groups):
            apart = self.scores[members] - self.scores[members].mean(axis=0)
            spread += len(members) / (len(members) - 1) * apart.T @ apart
        alone = [(index,) for index in sorted(set(range(len(self.scores))).difference(*groups))]
        scores, leverages, corrections, unseen = self._corrected(alone)
        of_alone = corrections @ (leverages - leverages @ leverages) @ corrections
        shares = np.array([*(self.hessians[list(members)].sum(axis=0) for members in groups), *of_alone])
        freedoms = np.array([*(len(members) - 1.0 for members in groups), *np.ones(len(alone))])
        terms = np.einsum("nd,gde,ne->gn", self.directions, shares, self.directions)
        squares = (shares @ shares / freedoms[:, None, None]).sum(axis=0)  # Eq. (7)
        of_numbers = (np.square(terms) / freedoms[:, None]).sum(axis=0)
        spread += scores.T @ scores
        return self._scatter(spread, shares.sum(axis=0), unseen, squares, of_numbers, freedoms.sum())

    def between(self, clusters: Sequence[tuple[int, ...]]) -> _Scatter:
        """Scatter of clusters about zero, with Bell and McCaffrey's correction for what the fit absorbs, Eq. (3)."""
        scores, leverages, corrections, unseen = self._corrected(clusters)
        rooted = corrections @ leverages  # G_cd = 1_cd whole_c - rooted_c rooted_d', the C^2 blocks not formed
        whole, absorbed = rooted @ corrections, rooted @ rooted
        squares = (whole @ (whole - 2 * absorbed) + rooted @ absorbed.sum(axis=0) @ rooted).sum(axis=0)  # Eq. (8)
        along = self.directions @ rooted
        terms = np.einsum("nd,cde,ne->cn", self.directions, whole, self.directions)
        shared = np.square(np.einsum("cnd,cne->nde", along, along)).sum(axis=(1, 2))
        of_numbers = (terms * (terms - 2 * np.square(along).sum(axis=2))).sum(axis=0) + shared
        expected = (whole - absorbed).sum(axis=0)
        return self._scatter(scores.T @ scores, expected, unseen, squares, of_numbers, len(clusters) - 1.0)

    def _corrected(self, clusters: Sequence[tuple[int, ...]]) -> tuple[Array, Array, Array, Array]:
        """Corrected scores M s (C, d) of clusters, leverages (C, d, d), corrections M (C, d, d) and N (d, d)."""
        size = self.hessians.shape[1]
        leverages, working = (
            np.array([of_runs[list(members)].sum(axis=0) for members in clusters]).reshape(-1, size, size)
            for of_runs in (self.hessians, self.working)
        )
        scores = np.array([self.scores[list(members)].sum(axis=0) for members in clusters]).reshape(-1, size)
        values, vectors = np.linalg.eigh(np.eye(size) - leverages)
        free, turned = np.maximum(values, _LEAST_FREE)[:, None], vectors.swapaxes(1, 2)
        corrections = (vectors / np.sqrt(free)) @ turned  # Eq. (3)
        lost = (vectors * np.sqrt(np.clip(1 - values[:, None] / free, 0.0, 1.0))) @ turned  # Eq. (4)
        return np.einsum("cde,ce->cd", corrections, scores), leverages, corrections, (lost @ working @ lost).sum(axis=0)

    def _scatter(
        self, spread: Array, expected: Array, unseen: Array, squares: Array, of_numbers: Array, most: float
    ) -> _Scatter:
        """The scatter S with E, N, Q and the sums v (n,) of Eq. (6); most: degrees of freedom at most."""
        working = self.working.sum(axis=0)
        total, seen = float(np.trace(expected)), float(np.trace(working - unseen))
        if total < _LEAST_FREE:
            raise DataError("every direction is determined by one run alone, so that nothing scatters; repeat runs")
        means, added, crosses = (
            np.einsum("nd,de,ne->n", self.directions, matrix, self.directions) for matrix in (expected, unseen, squares)
        )
        share = added / seen
        variances = of_numbers + 2 * share * crosses + share**2 * np.trace(squares)
        freedom = (means + share * total) ** 2 / np.maximum(variances, 1e-300)  # Eq. (6); 1 of numbers that do not vary
        return _Scatter(spread, expected, unseen, seen, squares, np.clip(freedom, 1.0, max(most, 1.0)), working)


def wider(first: Array, second: Array) -> Array:
    """A matrix (d, d) that is the larger of two positive semi-definite ones in every direction.

    In coordinates in which both are diagonal and their sum is the unit matrix.
    """
    roots = roots_of(first + second)
    values, vectors = np.linalg.eigh(roots.T @ second @ roots)
    turned = np.linalg.pinv(roots.T) @ vectors
    return np.asarray((turned * np.maximum(values, 1 - values)) @ turned.T)


def scores_of_references(
    objective: SumOfNorms,
    batch: ReferenceBatch,
    errors: Array,
    jacobian: Array,
    trajectories: Sequence[Trajectory],
    noise: Noise,
) -> Scores:
    """Score vectors and expected Hessians of the runs; arguments as those of ``scores_of_runs``."""
    weights, shares = np.array(objective.weights), objective.shares(batch.trajectory)
    # Standard deviations (S, 3) of the rows, those of poses by the noise model; 0 where nothing was measured.
    rows = batch.rows
    walked = np.square([[noise.walk_position] * 2 + [noise.walk_heading]]) * rows.t1[:, None]
    white = np.square([[noise.pose_position] * 2 + [noise.pose_heading]])
    bias = np.square([[noise.bias_position] * 2 + [noise.bias_heading]])
    of_poses = np.sqrt(np.maximum(white + walked + bias, np.finfo(float).tiny))
    sigmas = np.where(rows.of_references[:, None], np.nan_to_num(rows.whole_sigmas), of_poses)
    # The factor f of the standard deviations, from the errors after the fit; 1 or more.
    measured = sigmas > 0
    square = float(np.square(errors[measured] / sigmas[measured]).sum())
    freedom = max(int(measured.sum()) - jacobian.shape[2], 1)
    factor = math.sqrt(square / freedom) if float(chdtrc(freedom, square)) < DOUBT else 1.0
    errors, slopes, spread = errors * weights, jacobian * weights[:, None], sigmas * np.abs(weights)
    norms = np.linalg.norm(errors, axis=1)
    single = (spread > 0).sum(axis=1) == 1
    zero = single & (norms < _ZERO * factor * spread.sum(axis=1))
    units = np.where(zero[:, None], 0.0, errors / np.maximum(norms, np.finfo(float).tiny)[:, None])
    pulls = shares[:, None] * np.einsum("ski,sk->si", slopes, units)
    if zero.any():  # the scores of errors that the fit made zero balance the others, as nearly as they can
        columns = shares[zero, None] * slopes[zero].sum(axis=1)
        balancing = np.linalg.lstsq(columns.T, -pulls.sum(axis=0), rcond=None)[0]
        pulls[zero] = np.clip(balancing, -1.0, 1.0)[:, None] * columns
    moments = np.array([_moments(tuple(of_row)) for of_row in spread.tolist()])  # (S, 2, 3)
    curved = moments[:, 1] / factor * shares[:, None]
    squares = moments[:, 0] * np.square(shares)[:, None]
    scores, hessians, working = [], [], []
    for run in range(len(trajectories)):
        of_run = batch.trajectory == run
        scores.append(pulls[of_run].sum(axis=0))
        hessians.append(np.einsum("ski,sk,skj->ij", slopes[of_run], curved[of_run], slopes[of_run]))
        working.append(np.einsum("ski,sk,skj->ij", slopes[of_run], squares[of_run], slopes[of_run]))
    roots = roots_of(np.array(hessians).sum(axis=0))
    step = -roots @ roots.T @ np.array(scores).sum(axis=0)
    return Scores(np.array(scores), np.array(hessians), trajectories, step, np.array(working))


def covariance_of_rows(batch: ReferenceBatch, run: int, by_errors: Array, noise: Noise) -> Array:
    """Covariance (n, n) of weighted sums of a run's errors, of which by_errors (K, 3, n) are the weights.

    Poses have the noise model's covariance, references their own.
    """
    rows = batch.rows
    of_run = batch.trajectory == run
    references = rows.of_references[of_run]
    sigmas = np.nan_to_num(rows.whole_sigmas[of_run][references])
    scaled = (by_errors[references] * sigmas[..., None]).reshape(-1, by_errors.shape[2])
    total: Array = scaled.T @ scaled
    if not references.all():
        total = total + covariance_of_sums(noise, rows.t1[of_run][~references], by_errors[~references], (0, 1, 2))
    return total


@cache
def _moments(sigmas: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """E[u_i^2] and E[(1 - u_i^2) / |e|] of each of three coordinates, Eq. (10) and (11); 0 of one with no deviation."""
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
