"""Step 3, propose: the effects that these recordings can show, and those that they cannot tell apart.

With I the information of all columns beyond the matrix, the share of the signature of an effect with columns i that the
columns j of others make is

    a = tr(I_ij I_jj^+ I_ji) / tr(I_ii).                                                                           (1)

What they do not make tells the effect from them with a non-centrality of (1 - a) N, N being its own. By Eq. (1) of
select.py the log odds approach (1 - a) N / (2 (1 + delta^2 N)), which no size of the effect raises above

    (1 - a) / (2 delta^2).                                                                                         (2)

With b the estimate of a parameter and sigma its standard error, the parameter lies within

    |b| + z(0.975) sigma,                                                                                          (3)

and is found nearly always from z(1 - alpha / (2 G)) sigma + z(0.93) sigma on, as the largest of G effects at the chance
alpha (Bonferroni).                                                                                                (4)
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from omnibench.discover.locate import Located
from omnibench.discover.result import Absorbed, Hidden
from omnibench.discover.screening import Missing, Screening
from omnibench.discover.significance import Group
from omnibench.fit.trajectory_fit import Given, given
from omnibench.registry import effects

_ALIKE = 0.95  # a, Eq. (1), of one class: log odds of at most 2.5, Eq. (2), a weight below that of a sure name
_SUM = 0.98  # a, Eq. (1), of several effects that imitate one: log odds of at most 1, Eq. (2)
_TOGETHER = 3  # effects that imitate one together, at most: as many as are named together
_SEARCHED, _FEW = 6, 3  # the effects that make most by themselves, of up to three columns, are put together: 35 sums
_NORMAL_95 = 1.96  # z(0.975)
_DETECTED = 5.5  # Eq. (4) for a chance of 0.002 and 30 to 40 effects: 4.0 + 1.5 standard errors


@dataclass(frozen=True, eq=False)
class Proposal:
    """Effects that could be missing: those that a change of the matrix does not reproduce (``screening.tellable``).

    absorbed: those that it reproduces. not_looked_for: effects with what the recordings lack. classes: names of effects
    that look alike. sums: effects, and the others that imitate each together.
    """

    located: Located
    absorbed: tuple[Absorbed, ...]
    not_looked_for: tuple[tuple[str, Missing], ...]
    classes: tuple[tuple[str, ...], ...]
    sums: tuple[tuple[str, tuple[str, ...]], ...]


def propose(located: Located) -> Proposal:
    """Propose the effects of the catalogue that these recordings can show."""
    screening = located.screening
    names = {group.name for group in screening.tellable}
    absorbed = {
        group.name: Absorbed(group.name, group.effect.stage, group.effect.measurement or "another kind of motion")
        for group in screening.groups.effects
        if group.effect is not None and group.name not in names
    }
    for name, missing in screening.groups.not_looked_for:
        if missing is Missing.SECOND_SESSION:
            effect = effects.create(name)
            absorbed[name] = Absorbed(name, effect.stage, effect.measurement or "recordings of another session")
    start, visible = screening.beyond_matrix, screening.visible
    return Proposal(
        located,
        tuple(absorbed.values()),
        screening.groups.not_looked_for,
        _classes(start, visible),
        _sums(start, visible),
    )


def _classes(start: Given, visible: Sequence[Group]) -> tuple[tuple[str, ...], ...]:
    """Effects of which one makes at least 95 % of another's signature; pairs that share one are one class."""
    joined = {group.name: {group.name} for group in visible}
    for first, second in combinations(visible, 2):
        if max(_made_by(start, first, second), _made_by(start, second, first)) > _ALIKE:
            together = joined[first.name] | joined[second.name]
            for name in together:
                joined[name] = together
    return tuple(dict.fromkeys(tuple(sorted(names)) for names in joined.values() if len(names) > 1))


def _sums(start: Given, visible: Sequence[Group]) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Effects whose signature up to three others make together (98 %) and no other alone: name and those others."""
    sums = []
    for group in visible:
        others = sorted(
            (other for other in visible if other is not group and len(other.index) <= _FEW),
            key=lambda other: -_made_by(start, group, other),
        )[:_SEARCHED]
        if not others or _made_by(start, group, others[0]) > _ALIKE:
            continue
        for count in range(2, _TOGETHER + 1):
            best = max(combinations(others, count), key=lambda some: _made_by(start, group, *some), default=())
            if best and _made_by(start, group, *best) > _SUM:
                sums.append((group.name, tuple(other.name for other in best)))
                break
    return tuple(sums)


def _made_by(start: Given, group: Group, *others: Group) -> float:
    """The share a of a group's signature that others make, Eq. (1)."""
    index = [column for other in others for column in other.index]
    rows = list(group.index)
    roots = start.roots(index)
    made = start.information[np.ix_(rows, index)] @ roots
    whole = float(np.trace(start.information[np.ix_(rows, rows)]))
    return float(np.square(made).sum()) / whole if whole > 0 else 0.0


def hidden_sizes(
    screening: Screening, chosen: Sequence[Group], confusable: Collection[str], spread: float
) -> tuple[Hidden, ...]:
    """Sizes that effects could have which were neither chosen nor are confusable with one that was, Eq. (3) and (4).

    spread: by how much chance exceeds the noise model.
    """
    excluded = {*confusable, *(group.name for group in chosen)}
    now = given(screening.data, screening.index_with(chosen))
    hidden = []
    for group in screening.visible:
        if group.name in excluded:
            continue
        values, covariance = now.estimate(group.index)
        errors = np.sqrt(np.maximum(np.diag(covariance), 0.0) * spread)
        hidden += [
            Hidden(
                group.name,
                parameter.name,
                parameter.unit,
                float(abs(value) + _NORMAL_95 * error),  # Eq. (3)
                float(_DETECTED * error),  # Eq. (4)
                max(abs(parameter.low), abs(parameter.high)),
            )
            for parameter, value, error in zip(group.parameters, values, errors, strict=True)
            if error > 0
        ]
    return tuple(hidden)
