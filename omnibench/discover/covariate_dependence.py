"""Covariate dependence: where the residuals depend on something, before any effect is added and after all are.

With t bases of its kind, a basis A has the probability ln P(A) = ln B'(A) - ln t + constant, B' of evidence.py, Eq.
(2), and a covariate the sum over its bases: the probability that what is missing depends on it rather than on another
that was tried. As in significance.py, chi-square differences Q are those without the run that adds most, divided by
what chance makes of them. As no basis has the form of what is missing, what they have beyond chance counts less, with N
the largest Q - d of all bases (compare evidence.py, Eq. (3)):

    Q' = d + (Q - d) / (1 + delta^2 N).                                                                            (1)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from omnibench.discover.regressors.significance import Group, Significance
from omnibench.discover.result import CovariateDependence
from omnibench.discover.selection.evidence import log_evidence
from omnibench.discover.selection.model_selection import MotorEffects, Screening, Selection

# delta of the generic bases, which no effect has the form of. With it the likeliest covariate is right in 72 % of 57
# blind sets, of which 80 % is said, and the second in 11 %, of which 7 % is said. Half of it says 99 % of 72 %, 1.5
# times 31 % of 51 % (tests/studies/place_study.py).
_DISCREPANCY = 0.2
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


def without_smooth_term(
    dependences: Dependences, left: Significance, screening: Screening, selection: Selection
) -> Dependences:
    """The dependences with those of the odometry that a smooth term leaves. left: significance beyond it."""
    of_motors = tuple(each for each in dependences.left if each.stage == "actuator")
    of_odometry = _significant(left, "still ", lambda group: screening.quantisation_chi_square(group, selection.chosen))
    return replace(dependences, left=(*of_odometry, *of_motors))


def _significant(
    bases: Significance, still: str = "", quantisation: Callable[[Group], float] | None = None
) -> list[CovariateDependence]:
    """The most significant basis of each covariate, unless it may be chance.

    still: a word for the description. quantisation: the chi-square difference that encoder quantisation could make.
    """
    best: dict[str, int] = {}
    for index in bases.surest:
        best.setdefault(bases.groups[index].name, index)
    weights, dependences = weights_of_covariates(bases), []
    for index in best.values():
        group, p_value = bases.groups[index], bases.p_value(index)
        assert group.basis is not None
        if p_value < _SHOWN:
            words = f"the residual {still}depends on {group.basis.detail}"
            excess, rank = float(bases.excess[index]), int(bases.rank[index])
            small = quantisation is not None and excess <= quantisation(group)
            words += ", by no more than rounding to encoder ticks can make it" if small else ""
            dependences.append(
                CovariateDependence(
                    group.name, group.basis.stage, p_value, excess, rank, words, small, weights[group.name]
                )
            )
    return dependences


def weights_of_covariates(bases: Significance) -> dict[str, float]:
    """The probability of each covariate, Eq. (1)."""
    chi_square = bases.steady / bases.spread
    beyond = chi_square - bases.rank
    tempered = bases.rank + beyond / (1 + _DISCREPANCY**2 * max(float(beyond.max(initial=0.0)), 0.0))  # Eq. (1)
    tries = np.array([group.tries for group in bases.groups], dtype=float)
    evidence = log_evidence(tempered, bases.rank, 0.0) - np.log(tries)
    likely = np.exp(evidence - evidence.max(initial=0.0))
    weights: dict[str, float] = {}
    for group, weight in zip(bases.groups, likely / max(likely.sum(), 1e-300), strict=True):
        weights[group.name] = weights.get(group.name, 0.0) + float(weight)
    return weights
