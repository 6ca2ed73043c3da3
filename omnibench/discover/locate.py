"""Step 2, locate: the covariates that the motion between reference poses depends on beyond the plain matrix.

With t bases of its kind, a basis A has the probability ln P(A) = ln B'(A) - ln t + constant, B' of select.py, Eq. (2),
and a covariate the sum over its bases: the probability that what is missing depends on it rather than on another that
was tried. As in significance.py, chi-square differences Q are those without the run that adds most, divided by what
chance makes of them. As no basis has the form of what is missing, what they have beyond chance counts less, with N the
largest Q - d of all bases (compare select.py, Eq. (3)):

    Q' = d + (Q - d) / (1 + delta^2 N).                                                                            (1)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.discover.fine_structure import fine_structure
from omnibench.discover.fit import Extended, PlainFit
from omnibench.discover.motors import MotorScreening, screen_motors
from omnibench.discover.result import CovariateDependence
from omnibench.discover.screening import Screening, make_groups, screen, significance_left
from omnibench.discover.significance import Group, Significance, log_evidence, significance_of, together

# delta of the generic bases, which no effect has the form of. With it the likeliest covariate is right in 72 % of 57
# blind sets, of which 80 % is said, and the second in 11 %, of which 7 % is said. Half of it says 99 % of 72 %, 1.5
# times 31 % of 51 % (tests/studies/place_study.py).
_OF_BASES = 0.2
_SHOWN = 0.01  # chance up to which a dependence is mentioned; verdicts count those below CHANCE alone


@dataclass(frozen=True, eq=False)
class Located:
    """Residuals of the plain matrix, with all that could explain them and the covariates that they depend on.

    screening: columns of all that could explain it. where: significance of the generic bases. motors: what the wheel
    rates differ from their targets by, None where that is not known.
    """

    plain: PlainFit
    screening: Screening
    where: Significance
    motors: MotorScreening | None


def locate(plain: PlainFit, without: Sequence[str], rng: np.random.Generator) -> Located:
    """Ask the motion between reference poses for all covariates. without: names of effects that are not to be tried."""
    fit = plain.fit
    screening = screen(fit, fit.nuisance_free_residuals, make_groups(fit, without))
    where = significance_of(screening.data, screening.groups.matrix.index, screening.groups.bases, rng)
    return Located(plain, screening, where, screen_motors(fit.runs, fit.model.robot, without))


def remaining(extended: Extended, screening: Screening, rng: np.random.Generator) -> Significance:
    """Significance of generic bases and of fine structure beyond all that an extended model holds."""
    return together(significance_left(extended, screening, rng), fine_structure(extended.fit, rng))


def dependences_on(
    bases: Significance, still: str = "", quantisation: Callable[[Group], float] | None = None
) -> list[CovariateDependence]:
    """The covariates that residuals depend on: the most significant basis of each, unless it may be chance.

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
    tempered = bases.rank + beyond / (1 + _OF_BASES**2 * max(float(beyond.max(initial=0.0)), 0.0))  # Eq. (1)
    tries = np.array([group.tries for group in bases.groups], dtype=float)
    evidence = log_evidence(tempered, bases.rank) - np.log(tries)
    likely = np.exp(evidence - evidence.max(initial=0.0))
    weights: dict[str, float] = {}
    for group, weight in zip(bases.groups, likely / max(likely.sum(), 1e-300), strict=True):
        weights[group.name] = weights.get(group.name, 0.0) + float(weight)
    return weights
