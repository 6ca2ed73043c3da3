"""Competing models: those that the recordings cannot tell apart, and which of them is used.

Where several effects explain the same residuals, each in its place makes a model of its own. The one that best predicts
commands that its fit did not see, in the paper's cost, is used; what the models disagree on is not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.discover.fitting import Extended, Fit, extend
from omnibench.discover.held_out import folds_of_commands, held_out_residuals, is_gain
from omnibench.discover.regressors.columns import Group
from omnibench.discover.selection.model_selection import Selection
from omnibench.discover.selection.screening import Screening
from omnibench.fit.trajectory_fit import given
from omnibench.robot.kinematics import Array

# Share of a column that must be left beyond the others, as in unknown_term.py: much of a form is another matrix.
_DETERMINED = 0.01


def with_fitted_forms(plain: Fit, screening: Screening, models: CompetingModels) -> CompetingModels:
    """The competing models, the used one with the forms of its effects by which held-out runs gain."""
    chosen = models.selection.chosen
    formed = [_formed(screening, chosen, position) for position in range(len(chosen))]
    if all(group is before for group, before in zip(formed, chosen, strict=True)):
        return models
    used = extend(plain, formed)
    weighted = ((models.weighted[0][0], used), *models.weighted[1:])
    return replace(models, used=used, selection=replace(models.selection, chosen=tuple(formed)), weighted=weighted)


def _formed(screening: Screening, chosen: Sequence[Group], position: int) -> Group:
    """An effect with those parameters of its forms that gain more than ln(runs) each (BIC), if all are confirmed."""
    group = chosen[position]
    if group.family is None or not group.forms:
        return group
    left, kept = given(screening.data, screening.index_with(chosen)), list[int]()
    columns = np.array(group.forms)
    while len(kept) < len(columns):
        free = np.diag(left.information)[columns] > _DETERMINED * left.total[columns]
        gains = [left.chi_square([int(column)]) if there else 0.0 for column, there in zip(columns, free, strict=True)]
        best = int(np.argmax(gains))
        if gains[best] <= np.log(len(screening.data.scores)):
            break
        kept.append(best)
        left = left.given([int(columns[best])])
    index = tuple(int(columns[row]) for row in sorted(kept))
    if not index or not screening.confirms(chosen, replace(group, index=index)):
        return group
    parameters = tuple(group.family.parameters[row] for row in sorted(kept))
    varied = {parameter.name.split(":")[1] for parameter in parameters}
    scales = {name: value for name, value in group.family.scales.items() if name.partition(":")[0] in varied}
    return replace(
        group,
        index=(*group.index, *index),
        parameters=(*group.parameters, *parameters),
        shapes=dict(group.shapes) | scales,
        forms=tuple(column for column in group.forms if column not in index),
    )


@dataclass(frozen=True, eq=False)
class CompetingModels:
    """The model that is used, the selection of its effects, and all competing models.

    weighted: all models with the weights of their names, the used one first. preferred: for each chosen effect, why it
    is used where another is as likely, or nothing.
    """

    used: Extended
    selection: Selection
    weighted: tuple[tuple[float, Extended], ...]
    preferred: tuple[str, ...]


def competing_models(plain: Fit, selection: Selection, extended: Extended) -> CompetingModels:
    """Fit all models that the data cannot tell apart, and use the best of them on commands that are held out."""
    used = extended
    preferred = ["" for _ in selection.chosen]
    others: list[tuple[float, Extended]] = []
    for position, stand_ins in enumerate(selection.stand_ins):
        for stand_in in stand_ins:
            chosen = selection.chosen
            model = extend(plain, [*chosen[:position], stand_in, *chosen[position + 1 :]])
            weight = selection.weights.get(stand_in.name, 0.0)
            difference = _costs(used) - _costs(model)
            if difference.mean() > 0:
                others.append((selection.weights.get(chosen[position].name, 0.0), used))
                preferred[position] = _reason(stand_in, difference)
                selection, used = _exchanged(selection, position, stand_in), model
            else:
                others.append((weight, model))
                preferred[position] = preferred[position] or _reason(chosen[position], -difference)
    weight = min((selection.weights.get(group.name, 0.0) for group in selection.chosen), default=1.0)
    return CompetingModels(used, selection, ((weight, used), *others), tuple(preferred))


def _exchanged(selection: Selection, position: int, stand_in: Group) -> Selection:
    """The selection with a stand-in at one position, and the effect that stood there among the stand-ins."""
    before = selection.chosen[position]
    chosen = (*selection.chosen[:position], stand_in, *selection.chosen[position + 1 :])
    exchanged = tuple(before if group is stand_in else group for group in selection.stand_ins[position])
    stand_ins = (*selection.stand_ins[:position], exchanged, *selection.stand_ins[position + 1 :])
    return replace(selection, chosen=chosen, stand_ins=stand_ins)


def _reason(group: Group, difference: Array) -> str:
    how = "better" if is_gain(difference) else "no worse"
    return f"{group.name} is used: it predicts commands that were held out {how} in the cost of Eq. (6)"


def _costs(extended: Extended) -> Array:
    """Eq. (6) of every run (Z,), its command held out of the fit."""
    residuals = held_out_residuals(extended, folds_of_commands(extended.fit.runs))
    return np.array([float(np.linalg.norm(of_run[-1])) for of_run in residuals])
