"""D-optimal designs: how often to drive each of some candidate runs so that the covariance becomes smallest.

A run of candidate c gives Fisher information F_c (p, p) of the parameters and costs t_c (1 to count runs, or s, m).
n_c runs of each candidate give M, and the criterion is the information for its cost:

    M = sum_c n_c F_c                                                   (O1)
    criterion = det(M)^(1/p) / sum_c n_c t_c                            (O2)

In shares of the cost, w_c = n_c t_c / sum n_c t_c, which need not be whole runs, the logarithm of the criterion is
concave, and by Kiefer and Wolfowitz (1960) no design has a criterion above

    det(M(w))^(1/p) * max_c tr(M(w)^-1 F_c / t_c) / p                   (O3)
    M(w) = sum_c w_c F_c / t_c                                          (O4)

for any w, because the geometric mean of the eigenvalues of M(w)^-1 M is at most the arithmetic one. The multiplicative
algorithm is that of Silvey, Titterington and Torsney, Commun. Stat. A7:1379 (1978), the exchange that of Fedorov,
Theory of Optimal Experiments (1972).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array

Counts = NDArray[np.intp]

# Half of each of these numbers and twice give the same designs of twelve commands; only a _NEAR of 2e-4 takes another
# one, whose standard deviations differ by 0.03 % (tests/studies/constants_fit.py).
# Information added in every direction, as a share of that of an average candidate: designs of the first few runs, whose
# determinant is zero, can then be compared. Much smaller, and rounding would decide between them.
_RIDGE = 1e-6
# Share of the information of an average candidate: a direction with less is not identified. Its standard deviation is a
# hundred times as large.
_NULL_SHARE = 1e-4
# Smallest gain of log det(M) that counts. Smaller ones are rounding, and exchanging runs for them may never end.
_NO_GAIN = 1e-6
_BLOCK = 256  # pairs whose exchange is tried at once
_NEAR = 1e-4  # relative distance from the bound within which a design is not improved further
_STARTS = 120  # random starts of the exchange for designs of 1 run; 120 / n for n runs, where a start matters less
# Share of the largest information, on a unit diagonal, below which candidates leave a direction open.
_UNDETERMINED = 1e-9
_ROUNDING = 1e-9  # runs: a number of runs that is whole up to rounding
_BEGIN = 0.9  # share of the least cost at which the search for an equal design begins; a lower one takes longer


def scale_of(information: Array) -> Array:
    """Factors (p,) of parameters by which an information (p, p) has a unit diagonal: m and rad may lie orders apart.

    A parameter that is known by rounding alone keeps next to no information.
    """
    own = np.diagonal(information)
    scale: Array = 1 / np.sqrt(np.maximum(own, max(_UNDETERMINED**2 * own.max(), np.finfo(float).tiny)))
    return scale


class Candidates:
    """Runs that a design may choose from, in standard coordinates: their mean information per cost is the identity.

    information (C, p, p): information of one run of each, in any coordinates; designs do not depend on the choice.
    costs (C,): cost of one run of each, > 0. most: number of runs of one candidate that an exact design may have.
    ValueError when the candidates together leave a direction of the parameters undetermined.
    """

    def __init__(self, information: Array, costs: Array | None = None, most: int | None = None) -> None:
        self.costs = np.ones(len(information)) if costs is None else np.asarray(costs, dtype=float)
        self.most = most
        mean = (information / self.costs[:, None, None]).mean(axis=0)
        scale = scale_of(mean)
        values, vectors = np.linalg.eigh(mean * scale * scale[:, None])
        if not (np.isfinite(values).all() and values[0] > _UNDETERMINED * values[-1]):
            raise ValueError("the candidates together leave a direction of the parameters undetermined")
        self.basis: Array = scale[:, None] * vectors / np.sqrt(values)
        standard = self.basis.T @ information @ self.basis
        self.information: Array = (standard + np.swapaxes(standard, 1, 2)) / 2
        self._log_scale = -2 * float(np.linalg.slogdet(self.basis)[1])

    def __len__(self) -> int:
        return len(self.costs)

    @property
    def parameters(self) -> int:
        return self.information.shape[1]

    def sum(self, counts: Array | Counts) -> Array:
        """The information M (p, p) of ``counts`` runs (C,), in standard coordinates, Eq. (O1)."""
        return np.tensordot(counts, self.information, 1)

    def cost(self, counts: Array | Counts) -> float:
        """The total cost of ``counts`` runs (C,)."""
        return float(counts @ self.costs)

    def root(self, counts: Array | Counts) -> float:
        """det(M)^(1/p) in the coordinates of the information given; 0 when a direction is undetermined."""
        sign, log_determinant = np.linalg.slogdet(self.sum(counts))
        return float(np.exp((log_determinant + self._log_scale) / self.parameters)) if sign > 0 else 0.0

    def criterion(self, counts: Array | Counts) -> float:
        """det(M)^(1/p) per cost, Eq. (O2): a design maximises it."""
        return self.root(counts) / self.cost(counts)

    def score(self, counts: Array | Counts) -> float:
        """p times the logarithm of the criterion in standard coordinates, with the ridge: searches maximise it."""
        return float(_log_determinants(self.sum(counts)[None])[0] - self.parameters * np.log(self.cost(counts)))

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


def exact_designs(candidates: Candidates, optimum: ContinuousDesign, most: int) -> Iterator[Counts]:
    """Good designs of 1, 2, ..., ``most`` runs: counts (C,).

    Each is the best of several after the exchange: the previous design with the run added that gains most, the rounded
    shares of the optimum and, while runs are few and a start matters, rounded random shares about these. One within
    0.01 % of the bound ends the search for its number of runs. Ends early when no candidate may be driven more often.
    """
    enough = (1 - _NEAR) * optimum.bound
    counts: Counts = np.zeros(len(candidates), dtype=np.intp)
    for runs in range(1, most + 1):
        free = _free(candidates, counts)
        if len(free) == 0:
            return
        added = candidates.sum(counts) + candidates.information[free]
        costs = candidates.cost(counts) + candidates.costs[free]
        best = free[np.argmax(_log_determinants(added) - candidates.parameters * np.log(costs))]
        counts = counts.copy()
        counts[best] += 1
        counts = exchanged(candidates, counts, enough)
        for shares in _shares_about(optimum.shares, _STARTS // runs):
            if candidates.criterion(counts) >= enough:
                break
            other = rounded(candidates, shares, runs, enough)
            counts = max(counts, other, key=candidates.score)
        yield counts


def _shares_about(shares: Array, draws: int) -> Iterator[Array]:
    """The shares (C,) themselves, then ``draws`` random ones about them, from a fixed seed."""
    yield shares
    rng = np.random.default_rng(draws)
    for _ in range(draws):
        yield shares * rng.exponential(size=len(shares))


def rounded(candidates: Candidates, shares: Array, runs: int, enough: float = math.inf) -> Counts:
    """A design of ``runs`` runs near the shares (C,) of a continuous one: counts (C,).

    The shares become whole runs by the largest remainders, then runs are exchanged. The candidates may be driven that
    often.
    """
    limit = runs if candidates.most is None else candidates.most
    wanted = shares / candidates.costs
    wanted = runs * wanted / wanted.sum()
    counts: Counts = np.minimum(np.floor(wanted + _ROUNDING).astype(np.intp), limit)
    while (missing := runs - int(counts.sum())) > 0:
        short = np.where(counts < limit, wanted - counts, -np.inf)
        counts[np.argsort(-short, kind="stable")[: min(missing, int((counts < limit).sum()))]] += 1
    return exchanged(candidates, counts, enough)


def equal_design(candidates: Candidates, optimum: ContinuousDesign, target: float) -> Counts | None:
    """A small design whose det(M)^(1/p) is at least ``target``: counts (C,); None when the runs allowed do not suffice.

    No such design costs less than target / optimum.bound, Eq. (O3); the search starts a little below that cost.
    """
    least = target / optimum.bound  # cost
    runs_per_cost = float((optimum.shares / candidates.costs).sum())
    runs = max(1, math.ceil(least / candidates.costs.max()), math.floor(_BEGIN * least * runs_per_cost))
    limit = math.inf if candidates.most is None else candidates.most * len(candidates)
    while runs <= limit:
        counts = rounded(candidates, optimum.shares, runs, (1 - _NEAR) * optimum.bound)
        if candidates.root(counts) < target:
            counts = exchanged(candidates, counts)
        if candidates.root(counts) >= target:
            return counts
        runs += 1
    return None


def exchanged(candidates: Candidates, counts: Counts, enough: float = math.inf) -> Counts:
    """A design after Fedorov's exchange: one run is swapped for another until no swap improves the score.

    The result is a local optimum, or its criterion has reached ``enough``.
    """
    counts = counts.copy()
    while candidates.criterion(counts) < enough and (swap := _good_swap(candidates, counts)) is not None:
        given, taken = swap
        counts[given] -= 1
        counts[taken] += 1
    return counts


def _good_swap(candidates: Candidates, counts: Counts) -> tuple[int, int] | None:
    """The best swap (driven, other) in the first block of pairs that has one; None when no swap gains.

    log det is concave, so that its slope is an upper limit on the gain of a swap: pairs that cannot gain are not tried,
    the others block by block, from the highest limit on.
    """
    moment, cost = candidates.sum(counts), candidates.cost(counts)
    identity = np.eye(candidates.parameters)
    slopes = candidates.information.reshape(len(candidates), -1) @ np.linalg.inv(moment + _RIDGE * identity).ravel()
    given, taken = np.flatnonzero(counts), _free(candidates, counts)
    dearer = np.log((cost - candidates.costs[given, None] + candidates.costs[taken]) / cost) * candidates.parameters
    most = slopes[taken] - slopes[given, None] - dearer
    most[given[:, None] == taken] = -np.inf
    rows, columns = np.nonzero(most > _NO_GAIN)
    order = np.argsort(-most[rows, columns], kind="stable")
    rows, columns = rows[order], columns[order]
    now = _log_determinants(moment[None])[0]
    for first in range(0, len(rows), _BLOCK):
        row, column = rows[first : first + _BLOCK], columns[first : first + _BLOCK]
        swapped = moment - candidates.information[given[row]] + candidates.information[taken[column]]
        gains = _log_determinants(swapped) - now - dearer[row, column]
        best = int(np.argmax(gains))
        if gains[best] > _NO_GAIN:
            return int(given[row[best]]), int(taken[column[best]])
    return None


def _free(candidates: Candidates, counts: Counts) -> Counts:
    """The candidates (m,) that may be driven once more."""
    limit = candidates.most
    return np.arange(len(candidates)) if limit is None else np.flatnonzero(counts < limit)


def _log_determinants(moments: Array) -> Array:
    """log det (m,) of information matrices (m, p, p) in standard coordinates, with the ridge added."""
    signs, values = np.linalg.slogdet(moments + _RIDGE * np.eye(moments.shape[-1]))
    return np.where(signs > 0, values, -np.inf)
