"""How surprising the gains of groups of columns are, all that was looked at counted.

Where nothing is missing, the residuals of a run are as likely as their opposites, whatever their distribution and
however they are correlated within the run. Signs of whole runs, turned at random, therefore show what chance makes of
the largest gain of all (Westfall and Young 1993). What is plainly there is taken out of the residuals before, so that
it does not pass for noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from omnibench.discover.regressors.whitened import Given, Whitened, given
from omnibench.discover.selection.candidate_groups import Group
from omnibench.robot.kinematics import Array

_FLIPS = 499
_TAIL = 0.1  # share of the flips whose maxima say how fast chance falls off
_PLAIN = 3.0  # evidence from which on something is plainly there
_MOST_TAKEN = 3  # groups that are taken out of what stands for noise


@dataclass(frozen=True, eq=False)
class Gains:
    """Gains of groups: gain (G,), rank (G,), spread (G,): the mean gain of chance per degree of freedom.

    evidence (G,): -log10 of the chance of such a gain of one group by itself. chance: largest evidence of all groups
    in each flip, sorted. surplus: largest gain beyond chance of all groups in units of its own scatter, less what
    chance makes of that; surplus_of: the group that has it.
    """

    groups: tuple[Group, ...]
    gain: Array
    rank: Array
    spread: Array
    evidence: Array
    chance: Array
    surplus: float
    surplus_of: int

    @property
    def excess(self) -> Array:
        """Gains beyond chance (G,)."""
        return np.maximum(self.gain - self.rank * self.spread, 0.0)

    def p_value(self, index: int) -> float:
        """The chance that any of all groups gains as surprisingly as this one."""
        own, chance = float(self.evidence[index]), self.chance
        exceeded = int((chance >= own).sum())
        tail = max(int(_TAIL * len(chance)), 1)
        if exceeded >= tail // 4:
            return (exceeded + 1) / (len(chance) + 1)
        edge = float(chance[-tail])
        scale = max(float((chance[-tail:] - edge).mean()), 1e-3)
        return float(max(tail / len(chance) * np.exp(-(own - edge) / scale), 1e-300))

    @property
    def best(self) -> int:
        """Index of the most surprising group."""
        return int(self.evidence.argmax())

    @property
    def surplus_gain(self) -> tuple[float, float]:
        """The gain that goes with the surplus, and its scatter by chance."""
        scatter = float(np.sqrt(2 * self.rank[self.surplus_of]) * self.spread[self.surplus_of])
        return max(self.surplus, 0.0) * scatter, scatter


def gains_of(data: Whitened, fitted: Sequence[int], groups: Sequence[Group], rng: np.random.Generator) -> Gains:
    """Gains of groups beyond the columns ``fitted``, and what chance makes of them."""
    now = given(data, fitted)
    roots = [now.roots(group.index) for group in groups]
    rank = np.array([each.shape[1] for each in roots], dtype=float)
    tries = np.array([group.tries for group in groups], dtype=float)
    own = [now.scores[:, list(group.index)] @ each for group, each in zip(groups, roots, strict=True)]
    gain = np.array([float(np.square(each.sum(axis=0)).sum()) for each in own])
    steady = np.array([_without_any_one(each) for each in own])
    noise = _noise_scores(data, list(fitted), groups)
    left = [noise.scores[:, list(group.index)] @ each for group, each in zip(groups, roots, strict=True)]
    spread = np.maximum([float(np.square(each).sum()) / max(each.shape[1], 1) for each in left], 1.0)
    signs = rng.choice([-1.0, 1.0], size=(_FLIPS, len(now.scores)))
    flipped = np.array([np.square(signs @ each).sum(axis=1) for each in left]).T
    chance = _evidence(flipped, rank, spread, tries)
    evidence = _evidence(steady[None], rank, spread, tries)[0]
    scatter = np.sqrt(2 * np.maximum(rank, 1.0)) * spread
    beyond = (gain - rank * spread) / scatter
    usual = float(np.mean(((flipped - rank * spread) / scatter).max(axis=1)))
    best = int(beyond.argmax())
    return Gains(
        tuple(groups), gain, rank, spread, evidence, np.sort(chance.max(axis=1)), float(beyond[best]) - usual, best
    )


def _without_any_one(scores: Array) -> float:
    """The gain that is left without the run that it owes most to: one run that went wrong is no effect."""
    total = scores.sum(axis=0)
    return float(np.square(total - scores).sum(axis=1).min(initial=np.inf)) if scores.size else 0.0


def _noise_scores(data: Whitened, fitted: list[int], groups: Sequence[Group]) -> Given:
    """Scores (Z, p) of residuals without what is plainly there."""
    taken = list(fitted)
    now = given(data, taken)
    for _ in range(_MOST_TAKEN if groups else 0):
        gain = np.array([now.gain(group.index) for group in groups])
        rank = np.array([now.rank(group.index) for group in groups], dtype=float)
        evidence = _evidence(gain[None], rank, np.ones(len(groups)), np.array([each.tries for each in groups]))[0]
        best = int(evidence.argmax())
        if evidence[best] < _PLAIN:
            break
        taken += groups[best].index
        now = now.given(groups[best].index)
    if len(taken) == len(fitted):
        return now
    values, _ = given(data, []).estimate(taken)
    residuals = [own - columns[:, taken] @ values for own, columns in zip(data.residuals, data.columns, strict=True)]
    return given(data.with_residuals(residuals), fitted)


def _evidence(gain: Array, rank: Array, spread: Array, tries: Array) -> Array:
    """-log10 of the chance of gains (B, G), and of being the best of so many tries."""
    scaled, freedom = gain / spread, np.maximum(rank, 1.0)
    found = -chi2.logsf(scaled, freedom) / np.log(10)
    evidence: Array = np.where(rank > 0, np.maximum(found - np.log10(tries), 0.0), 0.0)
    return evidence
