"""Covariates that residuals depend on, on screenings of a few columns of which all that each explains is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from screening_samples import FIRST, SECOND, THIRD, screening

from omnibench.discover.covariate_dependence import Dependences, covariate_dependences, weights_of_covariates
from omnibench.discover.regressors.columns import Group
from omnibench.discover.regressors.covariate_bases import Basis
from omnibench.discover.regressors.significance import Family, Significance, together
from omnibench.discover.selection.model_selection import select_effects

DRIFT = "heading_drift"
BASES = {"heading": FIRST, "place": SECOND, "elapsed time": THIRD}


def dependences(gains: Sequence[float], named: dict[str, np.ndarray], covariates: Sequence[str] = ()) -> Dependences:
    """Dependences of residuals. covariates: of the bases in turn, by default their names."""
    given = screening(named, BASES, gains)
    bases = tuple(replace(base, name=name) for base, name in zip(given.groups.bases, covariates, strict=False))
    given = replace(given, groups=replace(given.groups, bases=bases or given.groups.bases))
    return covariate_dependences(given, select_effects(given, np.random.default_rng(0)), None)


def covariates(given: Dependences) -> tuple[list[str], list[str]]:
    return [each.covariate for each in given.where], [each.covariate for each in given.left]


def test_the_surest_covariate_comes_first_and_chance_is_not_mentioned() -> None:
    assert covariates(dependences([0, 8, 20, 0, 0], {})) == (["place", "heading"], ["place", "heading"])


def test_what_a_named_effect_explains_is_no_longer_left() -> None:
    assert covariates(dependences([0, 20, 0, 0, 0], {DRIFT: FIRST})) == (["heading"], [])


def test_of_several_bases_of_a_covariate_the_surest_stands_for_it() -> None:
    (place,) = dependences([0, 8, 20, 0, 0], {}, ["place", "place", "elapsed time"]).where
    assert place.description == "the residual depends on the place"
    assert place.excess == pytest.approx(399)
    assert place.degrees_of_freedom == 1


def test_without_encoder_ticks_nothing_is_rounding_to_them() -> None:
    assert not any(each.within_ticks for each in dependences([0, 8, 20, 0, 0], {}).where)


def test_of_two_families_the_one_that_is_no_chance_stands_for_their_covariate() -> None:
    calm, rough = family("a line", 4.0, 4, np.linspace(0, 1, 499)), family("tiles", 5.0, 140, np.linspace(0, 9, 499))
    given = screening({}, {"place": FIRST}, [0, 0, 0, 0, 0])
    selection = replace(select_effects(given, np.random.default_rng(0)), where=together(rough, calm))
    (place,) = covariate_dependences(given, selection, None).where
    assert place.description == "the residual depends on a line"


def test_a_basis_of_many_functions_is_less_likely_than_one_of_few_that_stands_out_as_far_but_not_ruled_out() -> None:
    few, many = (family(str(rank), 9.0, rank, np.zeros(499), chi_square=rank + 300.0) for rank in (4, 140))
    renamed = replace(many, groups=(replace(many.groups[0], name="joints"),))
    weights = weights_of_covariates(together(few, renamed))
    assert 5e-4 < weights["joints"] < weights["place"]


def family(words: str, evidence: float, rank: int, chance: np.ndarray, chi_square: float = 300.0) -> Significance:
    """One basis over the place, by itself."""
    basis, one = Basis("place", "body", words), np.ones(1)
    group = Group("covariate", "place", (), basis=basis)
    of_group = (chi_square * one, chi_square * one, rank * one, one, evidence * one)
    return Significance((group,), *of_group, (Family(1, np.sort(chance)),), 0.0, 0)
