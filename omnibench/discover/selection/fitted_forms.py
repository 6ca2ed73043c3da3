"""The fitted members of the families of chosen effects: the forms that the recordings ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.discover.fitting.extend import extend
from omnibench.discover.fitting.model_fit import Fit
from omnibench.discover.regressors.column_group import Group
from omnibench.discover.selection.competing_models import CompetingModels
from omnibench.discover.selection.screening import Screening
from omnibench.fit.least_squares.whitened import given

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
