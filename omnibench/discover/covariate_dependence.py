"""Covariate dependence: where the residuals depend on something, before any effect is added and after all are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from omnibench.discover.regressors.column_group import Group
from omnibench.discover.regressors.significance import Significance
from omnibench.discover.result import CovariateDependence
from omnibench.discover.selection.model_selection import Selection
from omnibench.discover.selection.motor_effects import MotorEffects
from omnibench.discover.selection.screening import Screening

_SHOWN = 0.01  # chance up to which a dependence is mentioned; verdicts count those below CHANCE alone


@dataclass(frozen=True)
class Dependences:
    """Covariates that the residuals depend on: of the plain matrix (where), and after the selected effects (left)."""

    where: tuple[CovariateDependence, ...]
    left: tuple[CovariateDependence, ...]


def covariate_dependences(screening: Screening, selection: Selection, motors: MotorEffects | None) -> Dependences:
    """All dependences that are no chance, of the odometry and of the motors; those of the plain matrix surest first."""
    where = _significant(selection.where, "", screening.quantisation_chi_square)
    left = _significant(
        selection.left, "still ", lambda group: screening.quantisation_chi_square(group, selection.chosen)
    )
    if motors is not None:
        where += _significant(motors.selection.where)
        left += _significant(motors.selection.left, "still ")
    return Dependences(tuple(sorted(where, key=lambda each: (each.p_value, -each.excess))), tuple(left))


def _significant(
    bases: Significance, still: str = "", quantisation: Callable[[Group], float] | None = None
) -> list[CovariateDependence]:
    """The most significant basis of each covariate, unless it may be chance.

    still: a word for the description. quantisation: the chi-square difference that encoder quantisation could make.
    """
    best: dict[str, int] = {}
    for index in np.argsort(-bases.evidence, kind="stable"):
        best.setdefault(bases.groups[index].name, int(index))
    dependences = []
    for index in sorted(best.values(), key=lambda row: -bases.evidence[row]):
        group, p_value = bases.groups[index], bases.p_value(index)
        assert group.basis is not None
        if p_value < _SHOWN:
            words = f"the residual {still}depends on {group.basis.detail}"
            excess, rank = float(bases.excess[index]), int(bases.rank[index])
            small = quantisation is not None and excess <= quantisation(group)
            words += ", by no more than rounding to encoder ticks can make it" if small else ""
            dependences.append(CovariateDependence(group.name, group.basis.stage, p_value, excess, rank, words, small))
    return dependences
