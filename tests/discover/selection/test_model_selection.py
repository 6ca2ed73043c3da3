"""Model selection on screenings of a few columns, of which all that each explains is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from screening_samples import FIRST, FOURTH, MATRIX, POSITIVE, SECOND, THIRD, screening

from omnibench.discover.selection.model_selection import Selection, select_effects
from omnibench.discover.selection.screening import Screening

DRIFT, BIAS, SLIP = "heading_drift", "body_velocity_bias", "rotation_translation_coupling"
BASES = {"heading": (FIRST + SECOND) / np.sqrt(2), "place": THIRD, "elapsed time": FOURTH}


def selected(given: Screening) -> Selection:
    return select_effects(given, np.random.default_rng(0))


def names(selection: Selection) -> list[str]:
    return [group.name for group in selection.chosen]


def test_the_effect_whose_column_the_residuals_follow_is_chosen_alone() -> None:
    found = selected(screening({DRIFT: FIRST, BIAS: SECOND}, BASES, [0, 20, 0, 0, 0]))
    assert names(found) == [DRIFT]
    assert found.weights[DRIFT] == pytest.approx(found.known)
    assert found.known > 0.99
    assert found.confusable == ((),)
    assert found.where.p_value(0) < 1e-6
    assert found.left.p_value(found.left.best) > 0.1


def test_nothing_is_chosen_where_the_residuals_are_their_noise() -> None:
    found = selected(screening({DRIFT: FIRST, BIAS: SECOND}, BASES, [0, 0, 0, 0, 0]))
    assert found.chosen == ()
    assert found.tentative == ()
    assert found.known == 1.0


def test_an_effect_that_the_matrix_makes_is_never_chosen() -> None:
    found = selected(screening({DRIFT: MATRIX + 1e-3 * FIRST, BIAS: SECOND}, BASES, [0, 20, 0, 0, 0]))
    assert found.chosen == ()


def test_two_effects_with_one_signature_share_the_probability_and_stand_in_for_each_other() -> None:
    found = selected(screening({DRIFT: FIRST, BIAS: FIRST}, BASES, [0, 20, 0, 0, 0]))
    assert len(found.chosen) == 1
    assert found.weights[DRIFT] == found.weights[BIAS] == pytest.approx(found.known / 2)
    assert {*names(found), *found.confusable[0]} == {DRIFT, BIAS}


def test_of_two_effects_with_one_signature_one_is_twice_as_likely_right_as_a_single_effect() -> None:
    effects = ({DRIFT: FIRST, BIAS: other} for other in (SECOND, FIRST))
    single, alike = (selected(screening(columns, BASES, [0, 20, 0, 0, 0])).known for columns in effects)
    assert alike / (1 - alike) == pytest.approx(2 * single / (1 - single), rel=0.02)


def test_an_effect_of_many_shapes_is_as_much_less_likely_as_it_has_shapes() -> None:
    alike = {DRIFT: FIRST, BIAS: FIRST}
    found = selected(screening(alike, BASES, [0, 20, 0, 0, 0], tries={BIAS: 4}))
    assert found.weights[DRIFT] == pytest.approx(found.known * 4 / 5)
    assert found.weights[BIAS] == pytest.approx(found.known / 5)


def test_two_effects_are_chosen_one_after_the_other_the_larger_first() -> None:
    found = selected(screening({DRIFT: FIRST, BIAS: SECOND, SLIP: FOURTH}, BASES, [0, 15, 25, 0, 0]))
    assert names(found) == [BIAS, DRIFT]
    assert len(found.steps) == 3  # the third looked for what is left, and found nothing
    assert [float(step.chi_square.max()) for step in found.steps[:2]] == pytest.approx([625, 225])


def test_one_effect_that_explains_what_two_others_would_is_chosen_in_their_place() -> None:
    together = (FIRST + SECOND) / np.sqrt(2)
    found = selected(screening({DRIFT: FIRST, BIAS: SECOND, SLIP: together}, BASES, [0, 15, 15, 0, 0]))
    assert names(found) == [SLIP]


@pytest.mark.parametrize(("kinds", "most"), [(7, 1), (8, 2), (None, 2)])
def test_there_are_four_kinds_of_motion_for_every_effect_that_is_chosen(kinds: int | None, most: int) -> None:
    given = screening({DRIFT: FIRST, BIAS: SECOND, SLIP: FOURTH}, BASES, [0, 15, 25, 0, 0])
    assert len(selected(replace(given, kinds=kinds)).steps) >= most
    assert len(selected(replace(given, kinds=kinds)).chosen + selected(replace(given, kinds=kinds)).tentative) == most


def test_an_effect_that_leaves_most_to_the_generic_bases_is_given_up_and_stays_tentative() -> None:
    found = selected(screening({DRIFT: FIRST}, BASES, [0, 15, 0, 15, 0]))
    assert found.chosen == ()
    assert [group.name for group in found.tentative] == [DRIFT]
    assert found.left_share == pytest.approx(0.5, abs=0.02)
    assert found.known < 0.05
    assert found.left.p_value(1) < 1e-6  # what is left is looked for beyond the matrix alone


def test_an_effect_of_an_impossible_sign_has_even_odds_and_gets_no_name() -> None:
    right, wrong = (
        selected(screening({DRIFT: FIRST}, BASES, [0, sign * 20, 0, 0, 0], parameter=POSITIVE)) for sign in (1, -1)
    )
    assert names(right) == [DRIFT]
    assert wrong.chosen == ()
    assert wrong.known == pytest.approx(0.5)


def test_what_one_run_alone_shows_is_no_effect() -> None:
    given = screening({DRIFT: FIRST}, BASES, [0, 0, 0, 0, 0])
    residuals = (given.data.residuals[0] + 80 * FIRST, *given.data.residuals[1:])
    scores = np.array([each.T @ own for each, own in zip(given.data.columns, residuals, strict=True)])
    again = Screening(given.groups, replace(given.data, residuals=residuals, scores=scores), given.folds)
    assert again.beyond_matrix().chi_square((1,)) == pytest.approx(80**2 / 20)
    assert selected(again).chosen == ()


def test_the_same_seed_selects_the_same_with_the_same_weights() -> None:
    given = screening({DRIFT: FIRST, BIAS: (FIRST + SECOND) / np.sqrt(2)}, BASES, [0, 12, 4, 0, 0])
    first, second = selected(given), selected(given)
    assert first.is_same_as(second)
    assert first.weights == second.weights
