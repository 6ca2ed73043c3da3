"""D-optimal designs: how often to drive each of some candidate runs so that the covariance becomes smallest.

A run of candidate c gives Fisher information F_c (p, p) of the parameters and costs t_c (1 to count runs, or s, m).
With the information M of n_c runs of each candidate, Eq. (O1) of exchange.py, the criterion is that for its cost:

    criterion = det(M)^(1/p) / sum_c n_c t_c                            (O2)

In shares of the cost, w_c = n_c t_c / sum n_c t_c, which need not be whole runs, the logarithm of the criterion is
concave, and by Kiefer and Wolfowitz (1960) no design has a criterion above

    det(M(w))^(1/p) * max_c tr(M(w)^-1 F_c / t_c) / p                   (O3)
    M(w) = sum_c w_c F_c / t_c                                          (O4)

for any w, because the geometric mean of the eigenvalues of M(w)^-1 M is at most the arithmetic one. The multiplicative
algorithm is that of Silvey, Titterington and Torsney, Commun. Stat. A7:1379 (1978).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np

from omnibench.design.exchange import Counts, Criterion, exchanged, grown
from omnibench.robot.kinematics import Array

# Half of each of these numbers and twice give the same designs of twelve commands; only a _NEAR of 2e-4 takes another
# one, whose standard deviations differ by 0.03 % (tests/studies/constants_fit.py).
# Information added in every direction, as a share of that of an average candidate: designs of the first few runs, whose
# determinant is zero, can then be compared. Much smaller, and rounding would decide between them.
_RIDGE = 1e-6
# Share of the information of an average candidate: a direction with less is not identified. Its standard deviation is a
# hundred times as large.
_NULL_SHARE = 1e-4
_NEAR = 1e-4  # relative distance from the bound within which a design is not improved further
_STARTS = 120  # random starts of the exchange for designs of 1 run; 120 / n for n runs, where a start matters less
# Share of the largest information, on a unit diagonal, below which candidates leave a direction open.
_UNDETERMINED = 1e-9
_ROUNDING = 1e-9  # runs: a number of runs that is whole up to rounding
_BEGIN = 0.9  # share of the least cost at which the search for an equal design begins; a lower one takes longer


class UndeterminedError(ValueError):
    """Candidates that together leave a direction (p,) of the parameters undetermined."""

    def __init__(self, direction: Array) -> None:
        super().__init__("the candidates together leave a direction of the parameters undetermined")
        self.direction = direction


class Candidates(Criterion):
    """D-optimality of candidate runs, in standard coordinates: their mean information per cost is the identity.

    information (C, p, p): information of one run of each, in any coordinates; designs do not depend on the choice.
    costs (C,): cost of one run of each, > 0. most: number of runs of one candidate that an exact design may have.
    UndeterminedError when the candidates together leave a direction of the parameters undetermined.
    """

    def __init__(self, information: Array, costs: Array | None = None, most: int | None = None) -> None:
        costs = np.ones(len(information)) if costs is None else np.asarray(costs, dtype=float)
        mean = (information / costs[:, None, None]).mean(axis=0)
        # On a unit diagonal, since m and rad may lie orders apart; what rounding alone tells keeps next to nothing
        own = np.diagonal(mean)
        scale = 1 / np.sqrt(np.maximum(own, max(_UNDETERMINED**2 * own.max(), np.finfo(float).tiny)))
        values, vectors = np.linalg.eigh(mean * scale * scale[:, None])
        if not (np.isfinite(values).all() and values[0] > _UNDETERMINED * values[-1]):
            raise UndeterminedError(scale * vectors[:, 0])
        self.basis: Array = scale[:, None] * vectors / np.sqrt(values)
        standard = self.basis.T @ information @ self.basis
        super().__init__((standard + np.swapaxes(standard, 1, 2)) / 2, costs)
        self.parameters, self.most = len(own), math.inf if most is None else most
        self._ridge = _RIDGE * np.eye(len(own))
        self.log_scale = -2 * float(np.linalg.slogdet(self.basis)[1])

    def root(self, counts: Array | Counts) -> float:
        """det(M)^(1/p) in the coordinates of the information given; 0 when a direction is undetermined."""
        sign, log_determinant = np.linalg.slogdet(self.sum(counts))
        return float(np.exp((log_determinant + self.log_scale) / self.parameters)) if sign > 0 else 0.0

    def criterion(self, counts: Array | Counts) -> float:
        """det(M)^(1/p) per cost, Eq. (O2): a design maximises it."""
        return self.root(counts) / float(self.cost(counts))

    def merit(self, information: Array) -> Array:
        """log det (n,) of the information in standard coordinates, with the ridge."""
        signs, values = np.linalg.slogdet(information + self._ridge)
        return np.where(signs > 0, values, -np.inf)

    def score(self, information: Array, costs: Array) -> Array:
        """p times the logarithm of the criterion (n,) in standard coordinates, with the ridge."""
        return self.merit(information) - self.parameters * np.log(costs)

    def additions(self, counts: Counts) -> tuple[Counts, Array]:
        """One run more of each candidate that may be driven more often."""
        added = np.flatnonzero(counts < self.most)
        return np.column_stack([added, 0 * added, added, 0 * added + 1]), self.cost(counts) + self.costs[added]

    def exchanges(self, counts: Counts) -> tuple[Counts, Array, Array]:
        """Exchanges of one run. log det is concave, so that its slope limits their gain."""
        moment, cost = self.sum(counts), self.cost(counts)
        slopes = self.information.reshape(len(self), -1) @ np.linalg.inv(moment + self._ridge).ravel()
        pairs = np.meshgrid(np.flatnonzero(counts), np.flatnonzero(counts < self.most), indexing="ij")
        removed, added = (each.ravel() for each in pairs)
        costs = cost - self.costs[removed] + self.costs[added]
        limits = self.merit(moment[None]) + slopes[added] - slopes[removed] - self.parameters * np.log(costs)
        return np.column_stack([removed, 0 * removed + 1, added, 0 * added + 1]), costs, limits

    def identifies(self, counts: Array | Counts) -> bool:
        """True if ``counts`` runs (C,) determine every direction of the parameters."""
        share = np.linalg.eigvalsh(self.sum(counts))[0] / self.cost(counts)
        return bool(share > _NULL_SHARE)

    def covariance(self, counts: Array | Counts) -> Array:
        """The covariance (p, p) that ``counts`` runs (C,) give, in the coordinates of the information given."""
        return self.basis @ np.linalg.inv(self.sum(counts)) @ self.basis.T


@dataclass(frozen=True, eq=False)
class ContinuousDesign:
    """The optimum over shares (C,) of the cost. No design has a criterion above ``bound``, Eq. (O3).

    gap: bound / criterion - 1, an upper limit on the distance from the optimum.
    """

    shares: Array
    criterion: float
    bound: float
    gap: float
    iterations: int


def continuous_optimum(candidates: Candidates, gap: float = 1e-5, iterations: int = 20_000) -> ContinuousDesign:
    """Shares within ``gap`` of the optimum, or those after ``iterations`` steps of the multiplicative algorithm.

    A step multiplies every share by tr(M^-1 F_c / t_c) / p, which never lowers the criterion. The bound holds wherever
    the algorithm ends.
    """
    per_cost = candidates.information / candidates.costs[:, None, None]
    flat = per_cost.reshape(len(candidates), -1)
    shares = np.full(len(candidates), 1 / len(candidates))
    for iteration in range(1, iterations + 1):
        moment = np.tensordot(shares, per_cost, 1)
        gains = flat @ np.linalg.inv(moment).ravel() / candidates.parameters
        excess = float(gains.max()) - 1
        if excess <= gap or iteration == iterations:
            break
        shares = shares * gains
        shares /= shares.sum()
    criterion = candidates.criterion(shares / candidates.costs)
    return ContinuousDesign(shares, criterion, criterion * (1 + max(excess, 0.0)), max(excess, 0.0), iteration)


def exact_designs(candidates: Candidates, optimum: ContinuousDesign, numbers: Iterable[int]) -> Iterator[Counts]:
    """Good designs (C,) of so many runs each, of numbers that follow each other.

    Each is the best of several after the exchange: the previous design with the run added that gains most for its cost,
    the rounded shares of the optimum and, while runs are few and a start matters, rounded random shares about these.
    One within 0.01 % of the bound ends the search for its number of runs. Ends early when no candidate may be driven
    more often.
    """
    enough = candidates.parameters * math.log((1 - _NEAR) * optimum.bound) - candidates.log_scale
    counts: Counts | None = None
    for runs in numbers:
        if runs > candidates.most * len(candidates):
            return
        larger = None if counts is None else grown(candidates, counts)
        starts = (rounded(candidates, shares, runs) for shares in _shares_about(optimum.shares, _STARTS // runs))
        counts = exchanged(candidates, next(starts) if larger is None else larger, enough)
        for start in starts:
            if candidates.criterion(counts) >= (1 - _NEAR) * optimum.bound:
                break
            counts = max(counts, exchanged(candidates, start, enough), key=candidates.criterion)
        yield counts


def _shares_about(shares: Array, draws: int) -> Iterator[Array]:
    """The shares (C,) themselves, then ``draws`` random ones about them, from a fixed seed."""
    yield shares
    rng = np.random.default_rng(draws)
    for _ in range(draws):
        yield shares * rng.exponential(size=len(shares))


def rounded(candidates: Candidates, shares: Array, runs: int) -> Counts:
    """The design (C,) of ``runs`` runs next to shares (C,) of a continuous one, by the largest remainders.

    The candidates may be driven that often.
    """
    wanted = shares / candidates.costs
    wanted = runs * wanted / wanted.sum()
    counts: Counts = np.minimum(np.floor(wanted + _ROUNDING), candidates.most).astype(np.intp)
    while (missing := runs - int(counts.sum())) > 0:
        short = np.where(counts < candidates.most, wanted - counts, -np.inf)
        counts[np.argsort(-short, kind="stable")[: min(missing, np.isfinite(short).sum())]] += 1
    return counts


def equal_design(candidates: Candidates, optimum: ContinuousDesign, target: float) -> Counts | None:
    """A small design (C,) whose det(M)^(1/p) is at least ``target``; None when the runs allowed do not suffice.

    No such design costs less than target / optimum.bound, Eq. (O3); the search starts a little below that cost.
    """
    least = target / optimum.bound  # cost
    runs_per_cost = float((optimum.shares / candidates.costs).sum())
    first = max(1, math.ceil(least / candidates.costs.max()), math.floor(_BEGIN * least * runs_per_cost))
    designs = exact_designs(candidates, optimum, count(first))
    return next((counts for counts in designs if candidates.root(counts) >= target), None)
