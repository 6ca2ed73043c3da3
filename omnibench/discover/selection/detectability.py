"""What these recordings could tell at all: absorbed effects, classes of look-alikes, and how much could still hide."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from omnibench.discover.regressors.whitened import Given, given
from omnibench.discover.result import Absorbed, Hidden
from omnibench.discover.selection.candidate_groups import Group
from omnibench.discover.selection.model_selection import ABSORBED, Named
from omnibench.discover.selection.screening import Look
from omnibench.registry import effects
from omnibench.robot.kinematics import Array

_ALIKE = 0.95  # share of one effect's signature that another makes
_SUM = 0.98  # that several others make together
_TOGETHER = 3
_DETECTED = 5.5  # standard errors from which on an effect is found nearly always


def absorbed_effects(look: Look) -> tuple[Absorbed, ...]:
    """Effects that a matrix reproduces in these recordings, with what would tell them."""
    now = given(look.data, look.groups.matrix.index)
    found = {
        group.name: Absorbed(group.name, group.effect.stage, group.effect.measurement or "another kind of motion")
        for group in look.groups.effects
        if group.effect is not None and now.share_left(group.index) < ABSORBED
    }
    for name, reason in look.groups.not_looked_for:
        if reason == ONE_SESSION:
            effect = effects.create(name)
            found[name] = Absorbed(name, effect.stage, effect.measurement or "recordings of another session")
    return tuple(found.values())


ONE_SESSION = "all runs are of one session"


def _visible(look: Look) -> list[Group]:
    """One group of each effect that is not absorbed: of several shapes the one that gains most."""
    now = given(look.data, look.groups.matrix.index)
    best: dict[str, Group] = {}
    for group in look.groups.effects:
        if now.share_left(group.index) < ABSORBED:
            continue
        if group.name not in best or now.gain(group.index) > now.gain(best[group.name].index):
            best[group.name] = group
    return list(best.values())


def classes_of(look: Look) -> tuple[tuple[str, ...], ...]:
    """Effects of which one makes at least 95 % of another's signature; pairs that share one are one class."""
    now = given(look.data, look.groups.matrix.index)
    groups = _visible(look)
    joined = {group.name: {group.name} for group in groups}
    for first, second in combinations(groups, 2):
        if max(_made_by(now, first, second), _made_by(now, second, first)) > _ALIKE:
            together = joined[first.name] | joined[second.name]
            for name in together:
                joined[name] = together
    return tuple(dict.fromkeys(tuple(sorted(names)) for names in joined.values() if len(names) > 1))


def sums_of(look: Look) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Effects whose signature up to three others make together (98 %) and no other alone: name and those others."""
    now = given(look.data, look.groups.matrix.index)
    groups = _visible(look)
    found = []
    for group in groups:
        others = sorted(
            (each for each in groups if each is not group and len(each.index) <= 3),
            key=lambda each: -_made_by(now, group, each),
        )[:6]
        if not others or _made_by(now, group, others[0]) > _ALIKE:
            continue
        for count in range(2, _TOGETHER + 1):
            best = max(combinations(others, count), key=lambda each: _made_by(now, group, *each), default=())
            if best and _made_by(now, group, *best) > _SUM:
                found.append((group.name, tuple(each.name for each in best)))
                break
    return tuple(found)


def _made_by(now: Given, group: Group, *others: Group) -> float:
    """The share of a group's signature that others make."""
    index = [each for other in others for each in other.index]
    own = list(group.index)
    roots = now.roots(index)
    taken = now.information[np.ix_(own, index)] @ roots
    whole = float(np.trace(now.information[np.ix_(own, own)]))
    return float(np.square(taken).sum()) / whole if whole > 0 else 0.0


def hidden_sizes(look: Look, named: Named) -> tuple[Hidden, ...]:
    """How large effects could still be that were neither named nor are confusable with a name."""
    chosen = {group.name for group in named.chosen} | {name for names in named.confusable for name in names}
    fitted = [index for group in named.chosen for index in group.index]
    spread = float(np.median(named.left.spread))  # by how much chance exceeds the noise model
    now = given(look.data, [*look.groups.matrix.index, *fitted])
    found = []
    for group in _visible(look):
        if group.name in chosen:
            continue
        values, covariance = now.estimate(group.index)
        errors = np.sqrt(np.maximum(np.diag(covariance), 0.0) * spread)
        found += _of_parameters(group, values, errors)
    return tuple(found)


def _of_parameters(group: Group, values: Array, errors: Array) -> list[Hidden]:
    return [
        Hidden(
            group.name,
            parameter.name,
            parameter.unit,
            float(abs(value) + 1.96 * error),
            float(_DETECTED * error),
            max(abs(parameter.low), abs(parameter.high)),
        )
        for parameter, value, error in zip(group.parameters, values, errors, strict=True)
        if error > 0
    ]
