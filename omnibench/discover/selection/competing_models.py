"""Models that the recordings cannot tell apart, and which of them to use.

Where several effects explain the same, each in its place makes a model of its own. The one that predicts commands
that its fit did not see best, in the paper's cost, is used; what they disagree on is not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting.extend import Extended, extend
from omnibench.discover.fitting.model_fit import Fit
from omnibench.discover.held_out.gaps import held_out_residuals
from omnibench.discover.selection.candidate_groups import Group
from omnibench.discover.selection.model_selection import Named
from omnibench.discover.selection.screening import Look
from omnibench.fit.least_squares.repetitions import grouped
from omnibench.robot.kinematics import Array

_CLEARLY = 2.0  # standard errors of the difference in cost


@dataclass(frozen=True, eq=False)
class Rivals:
    """The model that is used, its names, and all models with their weights, the used one first.

    preferred: of each chosen effect, why it is used where another is as likely, or nothing.
    """

    used: Extended
    named: Named
    models: tuple[tuple[float, Extended], ...]
    preferred: tuple[str, ...]


def rivals_of(plain: Fit, look: Look, extended: Extended) -> Rivals:
    """All models that the data cannot tell apart, and the best of them on commands that are held out."""
    named, used = look.named, extended
    preferred = ["" for _ in named.chosen]
    others: list[tuple[float, Extended]] = []
    for place, stand_ins in enumerate(named.stand_ins):
        for other in stand_ins:
            groups = [*named.chosen[:place], other, *named.chosen[place + 1 :]]
            model = extend(plain, groups)
            weight = named.weights.get(other.name, 0.0)
            difference = _costs(used) - _costs(model)
            if difference.mean() > 0:
                others.append((named.weights.get(named.chosen[place].name, 0.0), used))
                preferred[place] = _reason(other, difference)
                named, used = _exchanged(named, place, other), model
            else:
                others.append((weight, model))
                preferred[place] = preferred[place] or _reason(named.chosen[place], -difference)
    first = min((named.weights.get(group.name, 0.0) for group in named.chosen), default=1.0)
    return Rivals(used, named, ((first, used), *others), tuple(preferred))


def _exchanged(named: Named, place: int, other: Group) -> Named:
    """The names with another effect in one place."""
    before = named.chosen[place]
    chosen = (*named.chosen[:place], other, *named.chosen[place + 1 :])
    own = tuple(before if each is other else each for each in named.stand_ins[place])
    stand_ins = (*named.stand_ins[:place], own, *named.stand_ins[place + 1 :])
    return replace(
        named, chosen=chosen, stand_ins=stand_ins,
        confusable=tuple(tuple(each.name for each in members) for members in stand_ins),
    )  # fmt: skip


def _reason(group: Group, difference: Array) -> str:
    sure = difference.mean() > _CLEARLY * difference.std() / np.sqrt(max(len(difference), 1))
    return (
        f"{group.name} is used: it predicts commands that were held out {'better' if sure else 'no worse'} in the cost "
        "of Eq. (6)"
    )


def _costs(extended: Extended) -> Array:
    """Eq. (6) of every run (Z,), its command held out of the fit."""
    left = held_out_residuals(extended, folds_of_commands(extended.fit.runs))
    return np.array([float(np.linalg.norm(own[-1])) for own in left])


def folds_of_commands(runs: Sequence[Trajectory]) -> NDArray[np.intp]:
    """A fold (Z,) of each run: whole commands, in five folds."""
    folds = np.zeros(len(runs), dtype=np.intp)
    for number, members in enumerate(grouped([run.command or run.id for run in runs])):
        folds[list(members)] = number % 5
    return folds
