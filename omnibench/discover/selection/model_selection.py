"""Which effects are missing: sets of effects compared by their evidence, their idealised forms allowed for.

Every set A of at most m effects lowers the whitened chi2 by Q(A) and costs what its parameters (a g-prior, as wide as
the data say: Liang et al. 2008) and its choice among the catalogue are worth. The form that the catalogue gives an
effect is an idealisation, off by a share ``DISCREPANCY`` of its size: with an effect of non-centrality N that moves
differences in Q by DISCREPANCY^2 N times as much as noise does, so that evidence counts that much less. A name's
weight is its probability against all others in its place, the other names given, times the probability that what is
there is in the catalogue at all: what generic bases still find after the effects, in their own forms or slightly
different ones, says how likely that is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from omnibench.discover.regressors.significance import Gains, gains_of
from omnibench.discover.regressors.whitened import Given, Whitened, given
from omnibench.discover.selection.candidate_groups import Group, Groups
from omnibench.robot.kinematics import Array

DISCREPANCY = 0.1
SURE = 0.95
CHANCE = 0.002  # of naming anything where nothing is missing
_PRIOR = float(np.log(20))  # an effect is missing once in 20 robots
_MOST = 3  # effects
ABSORBED = 1e-4  # share of its signature that an effect must keep beyond the matrix to be told at all
_LEFT_RIGHT = 0.04  # share that right names leave, in the mean; wrong ones leave anything
_BEYOND_RIGHT = 0.01  # likewise, when their forms may differ a little
_MOST_ODDS = 10.0  # that another form may lend a name
_CANCELLING = 0.45  # effects that undo each other to such a share imitate something else rather than being there all
_SURELY = 3.0  # standard errors
_MOSTLY = 0.3  # what is left of what was left
_IMITATION = 1.0  # odds, at most, that they are
_ODDS_OF_ONE = 9.0  # that what one name explains is in the catalogue; sums of several imitate what is not more often
_ODDS_OF_TWO = 1.0
_CREDIBLE = 0.55  # what is less likely to have a name in the catalogue gets none, and no model holds it
_CONFUSABLE = 0.03


@dataclass(frozen=True, eq=False)
class Named:
    """Names and how sure they are.

    chosen: the effects in the order in which they were found. weights: of every candidate. steps: gains of all
    candidates when each effect was looked for. known: probability that what is there is in the catalogue. confusable:
    of each chosen effect, as stand_ins. left: what generic bases find after the effects. tentative: names that were
    given up since too much is left beside them, as columns have it, which are no more than slopes.
    """

    chosen: tuple[Group, ...]
    weights: dict[str, float]
    known: float
    confusable: tuple[tuple[str, ...], ...]
    stand_ins: tuple[tuple[Group, ...], ...]
    steps: tuple[Gains, ...]
    left: Gains
    left_share: float
    tentative: tuple[Group, ...] = ()

    def is_same_as(self, other: Named) -> bool:
        """Whether the same effects were chosen, in the same shapes."""
        ours, theirs = ([(group.name, dict(group.shapes)) for group in each.chosen] for each in (self, other))
        return ours == theirs


def name_effects(
    data: Whitened, groups: Groups, confirmed: Callable[[Sequence[int], Sequence[int]], bool], rng: np.random.Generator
) -> Named:
    """Effects by forward selection, with exchange of all that were chosen before.

    data: all columns against what the matrix leaves. confirmed: whether held-out runs gain by columns (second) beyond
    others (first).
    """
    start = given(data, groups.matrix.index)
    told = [each for each in groups.effects if start.share_left(each.index) > ABSORBED]
    steps: list[Gains] = []
    chosen: tuple[Group, ...] = ()
    pool: list[Group] = []
    while len(chosen) < _MOST:
        others = [each for each in told if each.name not in _names(chosen)]
        if not others or start.scores.shape[0] == 0:
            break
        found = gains_of(data, [*groups.matrix.index, *_indices(chosen)], others, rng)
        steps.append(found)
        pool += [group for group in _best_shapes(found) if group not in pool]
        if found.p_value(found.best) > CHANCE:
            break
        larger = _sets(start, pool, len(chosen) + 1)
        best = larger.best
        if len(best) <= len(chosen):
            best = (*chosen, found.groups[found.best])
            if not _explains_what_is_left(data, groups, chosen, best, rng):
                break
        if not all(
            confirmed([*groups.matrix.index, *_indices([other for other in best if other is not each])], each.index)
            for each in best
        ):
            break
        chosen = best
    sets = _sets(start, pool, max(len(chosen), 1))
    fitted = [*groups.matrix.index, *_indices(chosen)]
    left = gains_of(data, fitted, groups.places, rng)
    share, known = 0.0, 1.0
    if chosen:
        forms = [index for group in chosen for index in group.forms]
        share, known = _known(sets, start, chosen, left, gains_of(data, [*fitted, *forms], groups.places, rng))
    given_up: tuple[Group, ...] = ()
    if chosen and known < _CREDIBLE:
        given_up = chosen
        chosen, left = (), gains_of(data, groups.matrix.index, groups.places, rng)
    ordered = tuple(sorted(chosen, key=lambda group: -start.gain(group.index)))
    rivals = [_rivals(start, pool, ordered, place) for place in range(len(ordered))]
    weights: dict[str, float] = {}
    for own in rivals:
        for group, weight in own:
            weights[group.name] = max(weights.get(group.name, 0.0), known * weight)
    stand_ins = tuple(
        tuple(other for other, weight in own if other.name != group.name and weight > _CONFUSABLE)
        for group, own in zip(ordered, rivals, strict=True)
    )
    return Named(
        ordered,
        weights,
        known,
        tuple(tuple(each.name for each in own) for own in stand_ins),
        stand_ins,
        tuple(steps),
        left,
        share,
        given_up,
    )


def _rivals(start: Given, pool: Sequence[Group], chosen: Sequence[Group], place: int) -> list[tuple[Group, float]]:
    """What could stand in one place among the chosen effects, the others given, with its probability there."""
    others = [group for index, group in enumerate(chosen) if index != place]
    now = start.given(_indices(others))
    best: dict[str, Group] = {chosen[place].name: chosen[place]}
    for group in pool:
        taken = best.get(group.name)
        if group.name not in _names(chosen) and (taken is None or now.gain(group.index) > now.gain(taken.index)):
            best[group.name] = group
    groups = list(best.values())
    gain = np.array([now.gain(group.index) for group in groups])
    rank = np.array([now.rank(group.index) for group in groups])
    evidence = _evidence_of(gain, rank, float(max((gain - rank).max(), 0.0)))
    evidence -= [np.log(group.tries) for group in groups]
    likely = np.exp(evidence - evidence.max())
    ordered = sorted(zip(groups, likely / likely.sum(), strict=True), key=lambda pair: -pair[1])
    return [(group, float(weight)) for group, weight in ordered]


def _evidence_of(gain: Array, rank: Array, energy: float) -> Array:
    """Logarithms of the evidence of gains; what other forms of effects of such an energy could do is none."""
    trusted = gain / (1 + DISCREPANCY**2 * energy)
    found: Array = (trusted - rank - rank * np.log(np.maximum(trusted / np.maximum(rank, 1), 1.0))) / 2
    return found


def _explains_what_is_left(
    data: Whitened, groups: Groups, chosen: Sequence[Group], larger: Sequence[Group], rng: np.random.Generator
) -> bool:
    """Whether a larger set makes most of what generic bases find after the smaller one go away.

    An idealised form leaves something, too, but hardly just what another effect makes.
    """
    before, after = (
        gains_of(data, [*groups.matrix.index, *_indices(each)], groups.places, rng).surplus_gain
        for each in (chosen, larger)
    )
    return bool(chosen) and before[0] > _SURELY * before[1] and after[0] < _MOSTLY * before[0]


def _indices(chosen: Sequence[Group]) -> list[int]:
    return [index for group in chosen for index in group.index]


def _names(chosen: Sequence[Group]) -> set[str]:
    return {group.name for group in chosen}


def _best_shapes(found: Gains) -> list[Group]:
    """Of every effect the shape that gains most."""
    best: dict[str, tuple[float, Group]] = {}
    for group, gain, rank in zip(found.groups, found.gain, found.rank, strict=True):
        if rank and (group.name not in best or gain > best[group.name][0]):
            best[group.name] = (float(gain), group)
    return [group for _, group in best.values()]


@dataclass(frozen=True, eq=False)
class _Sets:
    """Sets of effects with the logarithms of their evidence."""

    sets: tuple[tuple[Group, ...], ...]
    evidence: Array
    gain: Array
    energy: float

    @property
    def best(self) -> tuple[Group, ...]:
        return self.sets[int(self.evidence.argmax())]


def _sets(start: Given, pool: Sequence[Group], most: int) -> _Sets:
    sets = [each for size in range(most + 1) for each in combinations(pool, size) if len(_names(each)) == size]
    gain = np.array([start.gain(_indices(each)) if each else 0.0 for each in sets])
    rank = np.array([start.rank(_indices(each)) if each else 0 for each in sets])
    choices = np.array([sum(_PRIOR + np.log(group.tries) for group in each) for each in sets])
    energy = float(max((gain - rank).max(), 0.0))
    evidence = _evidence_of(gain, rank, energy) - choices
    return _Sets(tuple(sets), evidence, gain, energy)


def _known(sets: _Sets, start: Given, chosen: Sequence[Group], left: Gains, beyond: Gains) -> tuple[float, float]:
    """The share that the chosen effects leave, and how likely it is that their names are right.

    left: what generic bases find after the effects; beyond: after the effects in slightly different forms, too.
    """
    energy = max(sets.energy, 1.0)
    gain, scatter = left.surplus_gain
    after = start.given(_indices(chosen))
    forms = [index for group in chosen for index in group.forms]
    of_forms = max(after.gain(forms) - after.rank(forms), 0.0) if forms else 0.0
    shares = [
        (max(gain, of_forms), scatter, _LEFT_RIGHT),
        (*beyond.surplus_gain, _BEYOND_RIGHT),
    ]
    odds = _ODDS_OF_ONE if len(chosen) == 1 else _ODDS_OF_TWO / (len(chosen) - 1)
    for (found, spread, usual), most in zip(shares, (np.inf, _MOST_ODDS), strict=True):
        odds *= min(_odds(found, float(np.sqrt(spread**2 + 4 * found)), energy, usual), most)
    if (len(chosen) > 1 and _cancelling(start, chosen) < _CANCELLING) or _wrong_sign(start, chosen):
        odds = min(odds, _IMITATION)
    share = shares[0][0] / (shares[0][0] + energy)
    return share, odds / (1 + odds)


def _odds(left: float, spread: float, energy: float, usual: float) -> float:
    """How much likelier right names are than wrong ones to leave so much; usual: the mean share of right ones."""
    shares = (np.arange(400) + 0.5) / 400 * 0.99
    right, wrong = -usual * np.log1p(-shares / 0.99), shares

    def likelihood(each: Array) -> float:
        expected = energy * np.minimum(each, 0.99) / (1 - np.minimum(each, 0.99))
        return float(np.exp(-(((left - expected) / spread) ** 2) / 2).mean())

    return likelihood(right) / max(likelihood(wrong), 1e-300)


def _wrong_sign(start: Given, chosen: Sequence[Group]) -> bool:
    """Whether a parameter is surely negative that physics allows to be positive only.

    Euler steps in the recordings' making, for one, leave a centripetal slip of minus half a sample period.
    """
    values, covariance = start.estimate(_indices(chosen))
    sure = values < -_SURELY * np.sqrt(np.diag(covariance))
    parameters = [each for group in chosen for each in group.parameters]
    return any(bool(wrong) and each.low == 0 for wrong, each in zip(sure, parameters, strict=True))


def _cancelling(start: Given, chosen: Sequence[Group]) -> float:
    """What the effects make together against what they make apart: little, where they mostly undo each other."""
    index = _indices(chosen)
    values, _ = start.estimate(index)
    apart, first = 0.0, 0
    for group in chosen:
        own, rows = values[first : first + len(group.index)], list(group.index)
        apart += float(own @ start.information[np.ix_(rows, rows)] @ own)
        first += len(group.index)
    return start.gain(index) / max(apart, 1e-300)
