"""95 % intervals: of what was fitted, by a jackknife over clusters of runs; and of ratios of mean costs over runs.

**Of what was fitted.** What an estimate has minimised is a sum over clusters of runs, and perhaps a prior's part. With
a cluster's slope g_c and Hessian H_c at the minimum, and the Hessian H of all, one Gauss-Newton step leads to the
minimum without it:

    d_c = (H - H_c)^-1 g_c.                                                                                (1)

Of G clusters the jackknife has the covariance, beside that of the prior with its information P,

    (G - 1) / G sum_c d_c d_c'  +  H^-1 P H^-1,                                                            (2)

(Tukey 1958; the CV3 of MacKinnon, Nielsen and Webb, J. Appl. Econom. 38:671, 2023). What the model cannot express,
and slip, are the same in the runs of a cluster; they count, since other clusters would have others.

The clusters that tell of a number are often few: of five commands two may turn the robot. With v_c = a'd_c for the
function a of the unknowns, and M the covariance of these v_c if the slopes of clusters have H_c for theirs, the first
part of its variance has the degrees of freedom (Satterthwaite 1946; Bell and McCaffrey, Surv. Methodol. 28:169, 2002)

    (tr M)^2 / tr M^2,    M = diag(u_c' H_c u_c) - U (H^-1 + H^-1 P H^-1) U',                             (2a)

u_c = (H - H_c)^-1 a, and H_c u_c the rows of U. The second part is exact.

Sessions that drive the same commands say how far sessions differ, but not what the model lacks on these commands, which
all of them share: with three or more sessions the first part of (2) over sessions and that over commands are summed,
as covariances by two ways of clustering are (Cameron, Gelbach and Miller, J. Bus. Econ. Stat. 29:238, 2011). What
single runs scatter is in both. Taking it out once, as they do, may leave no covariance, and it is little beside the
commands' where three sessions repeat them.

Where leaving a cluster out loses a direction, no other cluster says how far an estimate scatters along it. With the
data's Hessian D = sum_c H_c in units of which D is 1, these are the directions v of

    v' H_c v > 1 - LEAST_LEFT.                                                                             (3)

Along them the covariance is the curvature's, D^-1, times the ratio of (2) to it in all other directions.

**Of ratios**: a mean cost, an improvement, a paired difference. Every run has a numerator and a denominator: the cost
of a calibration and that of the design values (their ratio is 1 minus the improvement), a cost and 1 (a mean cost), a
difference of two costs and 1 (a paired mean difference). The runs of a command share the error that the model makes on
it, so they are no independent draws: where runs repeat commands, commands are the unit. With the sums C_u and D_u over
the runs of unit u, u = 1..n, the estimate is

    R = sum_u C_u / sum_u D_u.                                                                     (R1)

*Ten units or more.* A value rho is the true ratio if the paired differences C_u - rho D_u have mean 0, of which the
statistic of the paired t test tells (C and D are means over the units, S_CC, S_DD, S_CD the covariances of these means,
with n - 1 in the denominator):

    T(rho) = (C - rho D) / sqrt(S_CC - 2 rho S_CD + rho^2 S_DD).                                   (R2)

The 95 % interval is the set of all rho that are not rejected (Fieller, J. R. Stat. Soc. B 16:175, 1954),

    -q_low <= T(rho) <= q_high,                                                                    (R3)

so that an improvement's interval leaves out 0 if and only if the paired difference of the costs is significant. The
quantiles are those of T in B resamples of the units about the estimate, which see skewness (Hwang, Stat. Sinica 5:161,
1995): with E_u = C_u - R D_u and counts w_u of a multinomial draw,

    T* = E* / sqrt((V* - E*^2) / (n - 1)),   E* = sum_u w_u E_u / n,   V* = sum_u w_u E_u^2 / n.   (R4)

The ends are roots of a quadratic in rho, the smaller with q = q_high and the larger with q = q_low:

    (D^2 - q^2 S_DD) rho^2 - 2 (C D - q^2 S_CD) rho + C^2 - q^2 S_CC = 0.                          (R5)

Where D^2 <= q^2 S_DD, as when one unit outweighs all others, (R3) has no bounds, and no interval is stated.

*Three to nine units* are too few to resample, and (R3) with Student's t has no bounds too often. The interval is that
of Student's t with n - 1 degrees of freedom and the jackknife's standard error s of g(R), where R_u is the ratio
without unit u (Tukey 1958), and g the logarithm, which knows that costs are positive, or for differences the identity:

    g(R) +- t s,   s^2 = (n - 1) / n sum_u (g(R_u) - mean of them)^2.                              (R6)

Two units or one have no interval.

tests/studies/improvement_coverage.py tells how often the intervals hold the truth.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import stdtrit

from omnibench.config import Model
from omnibench.data.dataset import Trajectory
from omnibench.fit.noise import roots_of
from omnibench.robot.kinematics import Array
from omnibench.robot.physical import INTERVAL, MANY, EstimatedCovariance
from omnibench.words import plural

UnitName = Literal["command", "run"]
FEWEST_SESSIONS = 3  # that are clusters: the 95 % interval of two would reach 13 standard errors to either side
_LEAST_LEFT = 0.1  # share of what is known of a direction that other clusters must say, too; chosen
_ROUNDING = 1e-12  # share of the largest derivative: a smaller one is rounding
FEWEST = 3  # units of an interval: that of two would reach 13 standard errors to either side
# Fewest units that are resampled. Of five commands 37 to 67 % of the bootstrapped intervals have no bounds, of ten 0 to
# 11 % (tests/studies/improvement_coverage.py --methods --kinds usual tails unequal).
BOOTSTRAPPED = 10
_WIDEST = 30.0  # logarithm of a ratio: e^30 stands for what cannot be bounded
_ALIKE = 1e-12  # share of the numerators: differences between units below it are rounding


def depending(slopes: Array, inputs: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which functions (q,) with derivatives (q, n) depend on one of the n inputs that are marked."""
    return np.asarray((np.abs(slopes[:, inputs]) > _ROUNDING * np.abs(slopes).max()).any(axis=1))


@dataclass(frozen=True, eq=False)
class Clusters:
    """Independent draws among Z runs.

    of_run (Z,): index of each run's cluster. sessions: of all runs together. across: the commands that several of the
    sessions share, which are draws beside them.
    """

    name: Literal["session", "command", "run"]
    of_run: NDArray[np.intp]
    sessions: int = 1
    across: Clusters | None = None

    @classmethod
    def of(cls, runs: Sequence[Trajectory]) -> Clusters:
        """What a fit scatters over: sessions, where there are three or more, and their commands; else ``units_of``."""
        sessions, units = {run.session for run in runs if run.session is not None}, units_of(runs)
        if len(sessions) < FEWEST_SESSIONS:
            return cls(units.name, units.of_run, max(len(sessions), 1))
        keys = [(run.session is not None, run.session or run.id) for run in runs]
        driven = {(run.session, run.command) for run in runs if run.command is not None}
        shared = len(driven) > len({command for _, command in driven})
        across = units if shared and units.name == "command" and units.count > 1 else None
        return cls("session", _numbers(keys), len(sessions), across)

    @property
    def count(self) -> int:
        """Number of clusters."""
        return int(self.of_run.max(initial=-1)) + 1

    @property
    def words(self) -> str:
        """The basis of a jackknife: ``jackknife over 12 commands, of one session alone``."""
        basis = f"jackknife over {plural(self.count, self.name)}" if self.count > 1 else "curvature of a single run"
        if self.across is not None:
            return f"{basis} and {plural(self.across.count, self.across.name)}"
        few = {1: "one session", 2: "two sessions"}.get(self.sessions)  # too few to tell how sessions differ
        return f"{basis}, of {few} alone" if few else basis

    @property
    def method(self) -> Literal["bootstrap", "Student's t", "none"]:
        """Method of the intervals of ratios."""
        return "none" if self.count < FEWEST else "bootstrap" if self.count >= BOOTSTRAPPED else "Student's t"

    @property
    def ratio_words(self) -> str:
        """The basis of a ratio's interval: ``bootstrap over 36 commands``."""
        of_clusters = plural(self.count, self.name)
        return f"no interval from {of_clusters}" if self.method == "none" else f"{self.method} over {of_clusters}"

    def sums(self, values: Array) -> Array:
        """Sums (n, ...) of values (Z, ...) over the runs of each cluster."""
        total = np.zeros((self.count, *np.shape(values)[1:]))
        np.add.at(total, self.of_run, values)
        return total


def units_of(runs: Sequence[Trajectory], unit: UnitName | None = None) -> Clusters:
    """Some runs by their commands, a run without one being its own cluster, or each by itself.

    unit: default ``command`` where runs repeat commands, else ``run``.
    """
    commands = [run.command for run in runs if run.command is not None]
    name = unit or ("command" if len(set(commands)) < len(commands) else "run")
    keys = [(True, run.command) if name == "command" and run.command else (False, run.id) for run in runs]
    return Clusters(name, _numbers(keys))


def _numbers(keys: Sequence[Hashable]) -> NDArray[np.intp]:
    """The number of each key among those that differ, as they come."""
    of_key = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return np.array([of_key[key] for key in keys], dtype=np.intp)


def jackknife(
    information: Array, scores: Array, clusters: Clusters, prior: Array | None = None, functions: Array | None = None
) -> EstimatedCovariance:
    """Eq. (2) of some functions of the unknowns, with the degrees of freedom (q,) of each variance.

    information (Z, k, k), scores (Z, k): Hessians and slopes of the runs' parts of what was minimised. prior (k, k): P;
    None: no prior. functions (q, k): their derivatives by the unknowns; None: the unknowns themselves. Directions of
    which neither runs nor prior say anything have no variance. A single cluster has the curvature's covariance.
    """
    prior = np.zeros(information.shape[1:]) if prior is None else prior
    roots = roots_of(information.sum(axis=0) + prior)  # H = 1 in these coordinates
    own, wanted = roots.T @ prior @ roots, roots if functions is None else functions @ roots
    if clusters.count == 1:
        return EstimatedCovariance(wanted @ wanted.T, MANY)
    covariance, parts = own, list[Array]()
    for way in filter(None, (clusters, clusters.across)):
        scatter, freedom = _scatter(roots.T @ way.sums(information) @ roots, way.sums(scores) @ roots, own, wanted)
        covariance = covariance + scatter
        parts.append(np.square(np.diag(wanted @ scatter @ wanted.T)) / freedom)
    whole = wanted @ covariance @ wanted.T
    of_parts = np.sum(parts, axis=0)
    freedom = np.where(of_parts > 0, np.square(np.diag(whole)) / np.maximum(of_parts, 1e-300), MANY)
    return EstimatedCovariance(whole, np.minimum(freedom, MANY))


def _scatter(by_cluster: Array, slopes: Array, own: Array, wanted: Array) -> tuple[Array, Array]:
    """The first part (k, k) of Eq. (2), in units of which H is 1, and its degrees of freedom (q,), Eq. (2a).

    by_cluster (G, k, k), slopes (G, k): H_c and g_c. own (k, k): P. wanted (q, k): derivatives of functions.
    """
    count, whole = len(by_cluster), np.eye(len(own))
    of_data = whole - own
    alone = _carried_by_one(by_cluster, of_data)
    others = whole - alone @ alone.T
    # Along directions that one cluster alone carries, H - H_c may be singular: they are left out of Eq. (1)
    kept = [others @ (whole - of_one) @ others + alone @ alone.T for of_one in by_cluster]
    without = np.array([others @ np.linalg.solve(left, others) for left in kept])
    moved = np.einsum("cij,cj->ci", without, slopes)
    scatter = (count - 1) / count * moved.T @ moved
    if alone.shape[1]:
        seen = float(np.trace(others @ of_data))
        ratio = float(np.trace(scatter)) / seen if seen > _LEAST_LEFT else 1.0
        scatter = scatter + ratio * alone @ (alone.T @ of_data @ alone) @ alone.T
    # Eq. (2a), by the traces of M
    pulls = np.einsum("cij,qj->qci", without, wanted)
    rows = np.einsum("cij,qcj->qci", by_cluster, pulls)
    inner = whole + own
    single = np.einsum("qci,qci->qc", pulls, rows)
    shared = np.einsum("qci,ij,qcj->qc", rows, inner, rows)
    products = inner @ np.einsum("qci,qcj->qij", rows, rows)
    squares = np.square(single).sum(axis=1) - 2 * (single * shared).sum(axis=1)
    squares += np.einsum("qij,qji->q", products, products)
    expected = (single - shared).sum(axis=1)
    freedom = np.where(squares > 0, np.square(expected) / np.maximum(squares, 1e-300), count - 1)
    return scatter, np.clip(freedom, 1.0, count - 1)


def _carried_by_one(by_cluster: Array, data: Array) -> Array:
    """Orthonormal directions (k, q) of which a single cluster says nearly all that is said, Eq. (3).

    by_cluster (G, k, k), data (k, k): information in units in which that of data and prior is 1. A direction that is
    left to the prior counts for none.
    """
    values, vectors = np.linalg.eigh(data)
    said = values > 1 / 2
    basis = vectors[:, said] / np.sqrt(values[said])
    carried = [np.zeros((len(data), 0))]
    for of_one in by_cluster:
        shares, directions = np.linalg.eigh(basis.T @ of_one @ basis)
        carried.append(vectors[:, said] @ directions[:, shares > 1 - _LEAST_LEFT])
    together = np.hstack(carried)
    if not together.shape[1]:
        return together
    left, strengths, _ = np.linalg.svd(together, full_matrices=False)
    return np.asarray(left[:, strengths > 1e-6])


class Bootstrap(Model):
    """The units that intervals rest on, and the resamples that are drawn of them from ten units on."""

    resamples: int = Field(2000, ge=100, le=100_000)
    seed: int = Field(0, ge=0)
    unit: UnitName | None = Field(
        None, description="what counts as one independent draw; default: commands where runs repeat them, else runs"
    )


@dataclass(frozen=True)
class Interval:
    """A value with its 95 % interval; low and high are None where the units are too few to say."""

    value: float
    low: float | None
    high: float | None

    @property
    def known(self) -> tuple[float, float] | None:
        """Both ends, or None."""
        return None if self.low is None or self.high is None else (self.low, self.high)

    def holds(self, value: float) -> bool:
        """True unless the interval excludes a value; one without ends excludes none."""
        return self.known is None or self.known[0] <= value <= self.known[1]


class RatioIntervals:
    """Intervals of ratios with the same resamples for all, so that comparisons are paired."""

    def __init__(self, bootstrap: Bootstrap) -> None:
        self._bootstrap = bootstrap
        self._counts: dict[int, Array] = {}

    def ratio(self, numerators: Array, denominators: Array, units: Clusters) -> Interval:
        """The ratio of two sums of costs over runs (Z,), with its interval. The denominators' sum must not be 0."""
        return self._interval(numerators, denominators, units, logarithm=True)

    def mean(self, costs: Array, units: Clusters) -> Interval:
        """The mean of costs (Z,), one a run."""
        return self.ratio(costs, np.ones(len(costs)), units)

    def difference(self, differences: Array, units: Clusters) -> Interval:
        """The mean of paired differences of costs (Z,), one a run; it may be 0 even where all are positive."""
        return self._interval(differences, np.ones(len(differences)), units, logarithm=False)

    def _interval(self, numerators: Array, denominators: Array, units: Clusters, *, logarithm: bool) -> Interval:
        """The interval of a ratio; logarithm: the function g of Eq. (R6), else the identity."""
        upper, lower = units.sums(numerators), units.sums(denominators)
        ratio = float(numerators.mean() / denominators.mean())  # Eq. (R1)
        if units.count < FEWEST:
            return Interval(ratio, None, None)
        errors = upper - ratio * lower
        if np.abs(errors).max() <= _ALIKE * np.abs(numerators).sum():
            return Interval(ratio, ratio, ratio)
        if units.count < BOOTSTRAPPED:
            return _jackknifed(ratio, upper, lower, logarithm)
        # Quantiles of Eq. (R3) by Eq. (R4).
        count = units.count
        if count not in self._counts:
            rng = np.random.default_rng(self._bootstrap.seed)
            drawn = rng.multinomial(count, np.full(count, 1 / count), size=self._bootstrap.resamples)
            self._counts[count] = drawn / count
        means = self._counts[count] @ errors
        spreads = np.maximum(self._counts[count] @ np.square(errors) - np.square(means), 0.0)
        # A resample of one unit only, or of equal ones, has no spread: it counts as far from the estimate.
        spreads = np.maximum(spreads, np.finfo(float).eps * np.square(errors).max())
        statistics = means / np.sqrt(spreads / (count - 1))
        least, most = np.percentile(statistics, [50 * (1 - INTERVAL), 50 * (1 + INTERVAL)])
        below, above = max(-float(least), 0.0), max(float(most), 0.0)
        low, high = _end(upper, lower, above, -1), _end(upper, lower, below, 1)
        return Interval(ratio, None, None) if low is None or high is None else Interval(ratio, low, high)

    def improvement(self, values: Array, before: Array, units: Clusters, rounding: float = 0.0) -> Interval | None:
        """The share of the costs ``before`` (Z,) that is gone; None where their mean is not above ``rounding``."""
        if before.mean() <= rounding:
            return None
        ratio = self.ratio(values, before, units)
        low, high = (None, None) if ratio.known is None else (1 - ratio.known[1], 1 - ratio.known[0])
        return Interval(1 - ratio.value, low, high)


def _jackknifed(ratio: float, upper: Array, lower: Array, logarithm: bool) -> Interval:
    """The interval of a ratio of sums (n,) by Eq. (R6), on the scale of its logarithm or its own."""
    count = len(upper)
    rest = lower.sum() - lower
    others = (upper.sum() - upper) / np.where(rest > 0, rest, np.nan)
    if not np.isfinite(others).all() or (logarithm and not (others > 0).all()):
        return Interval(ratio, None, None)
    scaled = np.log(others) if logarithm else others
    error = math.sqrt((count - 1) / count * float(np.square(scaled - scaled.mean()).sum()))
    reach = float(stdtrit(count - 1, (1 + INTERVAL) / 2)) * error
    if logarithm:
        return Interval(ratio, ratio * math.exp(-reach), ratio * math.exp(min(reach, _WIDEST)))
    return Interval(ratio, ratio - reach, ratio + reach)


def _end(upper: Array, lower: Array, quantile: float, side: Literal[-1, 1]) -> float | None:
    """The smaller (-1) or larger (1) root of Eq. (R5); None where the denominators' mean may be 0."""
    mean, of_lower = float(upper.mean()), float(lower.mean())
    covariance = np.cov(upper, lower) / len(upper)
    square = quantile * quantile
    leading = of_lower**2 - square * covariance[1, 1]
    if leading <= 0:
        return None
    middle = mean * of_lower - square * covariance[0, 1]
    constant = mean**2 - square * covariance[0, 0]
    root = math.sqrt(max(middle * middle - leading * constant, 0.0))
    return float((middle + side * root) / leading)
