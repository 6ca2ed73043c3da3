"""Identifiability of effects on screenings of a few columns: what is absorbed, alike, imitated, or hidden by noise."""

from __future__ import annotations

import numpy as np
import pytest
from screening_samples import FIRST, FOURTH, MATRIX, SECOND, THIRD, screening

from omnibench.discover.selection.detectability import Detectability, detectability_of
from omnibench.discover.selection.model_selection import select_effects

DRIFT, BIAS, FLOOR, LATENCY = "heading_drift", "body_velocity_bias", "floor_drift", "heading_latency"
BASES = {"place": FOURTH}


def detectability(named: dict[str, np.ndarray], gains: tuple[float, ...] = (0, 0, 0, 0, 0)) -> Detectability:
    given = screening(named, BASES, gains)
    return detectability_of(given, select_effects(given, np.random.default_rng(0)))


def at(degrees: float) -> np.ndarray:
    """A unit vector between the first and the second row."""
    return np.cos(np.radians(degrees)) * FIRST + np.sin(np.radians(degrees)) * SECOND


def test_an_effect_that_the_matrix_reproduces_is_absorbed_and_nothing_else_is_said_of_it() -> None:
    found = detectability({DRIFT: MATRIX, BIAS: MATRIX + 0.02 * FIRST})
    assert [each.name for each in found.absorbed] == [DRIFT]
    assert [each.name for each in found.hidden] == [BIAS]


def test_effects_of_which_one_makes_most_of_the_other_are_one_class() -> None:
    assert detectability({DRIFT: at(0), BIAS: at(12)}).classes == ((BIAS, DRIFT),)  # cos^2 = 0.957
    assert detectability({DRIFT: at(0), BIAS: at(14)}).classes == ()  # cos^2 = 0.941


def test_the_part_that_the_matrix_absorbs_does_not_count_as_alike() -> None:
    assert detectability({DRIFT: 5 * MATRIX + FIRST, BIAS: 5 * MATRIX + SECOND}).classes == ()


def test_pairs_that_share_an_effect_are_one_class() -> None:
    found = detectability({DRIFT: at(0), BIAS: at(12), FLOOR: at(24)})
    assert found.classes == ((BIAS, FLOOR, DRIFT),)


def test_an_effect_that_two_others_make_together_is_said_with_their_names() -> None:
    found = detectability({DRIFT: at(45), BIAS: FIRST, FLOOR: SECOND, LATENCY: THIRD})
    assert found.classes == ()
    imitated = dict(found.sums)
    assert set(imitated) == {DRIFT, BIAS, FLOOR}  # each of the three is made by the other two
    assert set(imitated[DRIFT]) == {BIAS, FLOOR}


def test_a_size_hides_within_its_interval_and_is_found_from_a_few_standard_errors_on() -> None:
    (hidden,) = detectability({DRIFT: 4 * FIRST}).hidden  # an information of 16: a standard error of 1/4
    assert hidden.limit == pytest.approx(1.96 / 4)
    assert hidden.detectable == pytest.approx(5.5 / 4)
    assert hidden.plausible == 0.1


def test_a_faint_effect_hides_at_its_estimate_and_its_interval() -> None:
    (hidden,) = detectability({DRIFT: 4 * FIRST}, (0, -1, 0, 0, 0)).hidden
    assert hidden.limit == pytest.approx(1 / 4 + 1.96 / 4)


def test_an_effect_that_was_found_hides_no_longer() -> None:
    found = detectability({DRIFT: FIRST, BIAS: SECOND}, (0, 20, 0, 0, 0))
    assert [each.name for each in found.hidden] == [BIAS]
