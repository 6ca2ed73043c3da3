"""Evidence of sets of effects, and credibility of their names; their idealised forms are allowed for.

Every set A of at most m effects lowers the whitened chi-square by Q(A) and costs what its parameters (a g-prior, as
wide as the data say: Liang et al. 2008) and its choice among the catalogue are worth. The form that the catalogue gives
an effect is an idealisation, off by a share ``DISCREPANCY`` of its size: with an effect of non-centrality N that moves
differences in Q by DISCREPANCY^2 N times as much as noise does, so that evidence counts that much less.

The numbers below are chosen; the rates of right and wrong names to which they lead are those of the study
tests/benchmarks/discover_study.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from omnibench.discover.regressors.column_group import Group
from omnibench.discover.regressors.significance import Significance
from omnibench.fit.least_squares.whitened import Given
from omnibench.robot.kinematics import Array

DISCREPANCY = 0.1  # share of an effect's size by which its true form differs from the catalogue's
_PRIOR = float(np.log(20))  # an effect is missing in one of 20 robots
_LEFT_RIGHT = 0.04  # share of the chi-square that right names leave, in the mean; wrong ones leave anything
_BEYOND_RIGHT = 0.01  # share that right names leave, in the mean, when their forms may differ a little
_MOST_ODDS = 10.0  # factor, at most, by which a good fit in slightly different forms raises the odds
_CANCELLING = 0.45  # effects that cancel each other down to such a share imitate something else
_SURELY = 3.0  # standard errors
_IMITATION = 1.0  # odds, at most, of effects that cancel each other or have an impossible sign
_ODDS_OF_ONE = 9.0  # prior odds that a single name is right
_ODDS_OF_TWO = 1.0  # prior odds of two names: sums of effects imitate what is not in the catalogue more often


def indices_of(groups: Sequence[Group]) -> list[int]:
    """The columns of some groups in turn."""
    return [index for group in groups for index in group.index]


def names_of(groups: Sequence[Group]) -> set[str]:
    """The names of some groups."""
    return {group.name for group in groups}


def log_evidence(chi_square: Array, rank: Array, energy: float) -> Array:
    """Logarithms of the evidence of chi-square differences of so many degrees of freedom.

    energy: non-centrality of what is missing; differences that other forms of such effects could make count for less.
    """
    trusted = chi_square / (1 + DISCREPANCY**2 * energy)
    evidence: Array = (trusted - rank - rank * np.log(np.maximum(trusted / np.maximum(rank, 1), 1.0))) / 2
    return evidence


@dataclass(frozen=True, eq=False)
class EffectSets:
    """Sets of effects with the logarithms of their evidence (n,). energy: non-centrality of what is missing."""

    sets: tuple[tuple[Group, ...], ...]
    evidence: Array
    energy: float

    @property
    def best(self) -> tuple[Group, ...]:
        """The set with the most evidence."""
        return self.sets[int(self.evidence.argmax())]


def effect_sets(start: Given, pool: Sequence[Group], most: int) -> EffectSets:
    """All sets of up to ``most`` different effects from a pool. start: all columns beyond the matrix."""
    sets = [each for size in range(most + 1) for each in combinations(pool, size) if len(names_of(each)) == size]
    chi_square = np.array([start.chi_square(indices_of(each)) if each else 0.0 for each in sets])
    rank = np.array([start.rank(indices_of(each)) if each else 0 for each in sets])
    choices = np.array([sum(_PRIOR + np.log(group.tries) for group in each) for each in sets])
    energy = float(max((chi_square - rank).max(), 0.0))
    return EffectSets(tuple(sets), log_evidence(chi_square, rank, energy) - choices, energy)


@dataclass(frozen=True)
class Credibility:
    """Probability that chosen names are right. left_share: share of the chi-square that generic bases still find."""

    left_share: float
    probability: float


def credibility_of(
    sets: EffectSets, start: Given, chosen: Sequence[Group], left: Significance, beyond: Significance
) -> Credibility:
    """Probability that the names of chosen effects are right, by what generic bases still find.

    left: significance of the bases after the effects. beyond: after the effects in slightly different forms, too.
    """
    energy = max(sets.energy, 1.0)
    chi_square, scatter = left.surplus_chi_square
    after = start.given(indices_of(chosen))
    forms = [index for group in chosen for index in group.forms]
    of_forms = max(after.chi_square(forms) - after.rank(forms), 0.0) if forms else 0.0
    remaining = max(chi_square, of_forms)
    of_bases = [(remaining, scatter, _LEFT_RIGHT), (*beyond.surplus_chi_square, _BEYOND_RIGHT)]
    odds = _ODDS_OF_ONE if len(chosen) == 1 else _ODDS_OF_TWO / (len(chosen) - 1)
    for (size, spread, usual), most in zip(of_bases, (np.inf, _MOST_ODDS), strict=True):
        odds *= min(_odds(size, float(np.sqrt(spread**2 + 4 * size)), energy, usual), most)
    if (len(chosen) > 1 and _joint_share(start, chosen) < _CANCELLING) or _has_wrong_sign(start, chosen):
        odds = min(odds, _IMITATION)
    return Credibility(remaining / (remaining + energy), odds / (1 + odds))


def _odds(left: float, spread: float, energy: float, usual: float) -> float:
    """Bayes factor of right names against wrong ones for so much that is left; usual: mean share left by right ones."""
    shares = (np.arange(400) + 0.5) / 400 * 0.99
    right, wrong = -usual * np.log1p(-shares / 0.99), shares

    def likelihood(of_shares: Array) -> float:
        expected = energy * np.minimum(of_shares, 0.99) / (1 - np.minimum(of_shares, 0.99))
        return float(np.exp(-(((left - expected) / spread) ** 2) / 2).mean())

    return likelihood(right) / max(likelihood(wrong), 1e-300)


def _has_wrong_sign(start: Given, chosen: Sequence[Group]) -> bool:
    """True if a parameter is surely negative that physics allows to be positive only.

    Recordings made with Euler steps, for one, leave a centripetal slip of minus half a sample period.
    """
    values, covariance = start.estimate(indices_of(chosen))
    negative = values < -_SURELY * np.sqrt(np.diag(covariance))
    parameters = [parameter for group in chosen for parameter in group.parameters]
    return any(bool(wrong) and parameter.low == 0 for wrong, parameter in zip(negative, parameters, strict=True))


def _joint_share(start: Given, chosen: Sequence[Group]) -> float:
    """Chi-square difference of the effects together over the sum of what each makes alone: small if they cancel."""
    index = indices_of(chosen)
    values, _ = start.estimate(index)
    apart, first = 0.0, 0
    for group in chosen:
        of_group, rows = values[first : first + len(group.index)], list(group.index)
        apart += float(of_group @ start.information[np.ix_(rows, rows)] @ of_group)
        first += len(group.index)
    return start.chi_square(index) / max(apart, 1e-300)
