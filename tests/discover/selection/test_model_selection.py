"""Screening, selection, identifiability and dependences, on columns of which all that each explains is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import plain_fit, shorn, simulated
from extended_samples import FORWARD, extended_of, run_of
from extended_samples import MATRIX as DESIGN
from hypothesis import given as drawn
from hypothesis import strategies as st
from screening_samples import FIRST, FOURTH, MATRIX, POSITIVE, SECOND, THIRD, screening

from omnibench.data.dataset import Trajectory
from omnibench.discover.covariate_dependence import Dependences, covariate_dependences, weights_of_covariates
from omnibench.discover.fitting import Extended, Fit, extend
from omnibench.discover.regressors.covariate_bases import Basis
from omnibench.discover.regressors.significance import Family, Group, Significance, together
from omnibench.discover.selection.detectability import Detectability, detectability_of
from omnibench.discover.selection.evidence import Missing
from omnibench.discover.selection.model_selection import Selection, select_effects
from omnibench.discover.selection.screening import (
    EncoderQuantisation,
    Screening,
    quantisation_steps,
    screen_again,
    screen_extended,
    screen_plain,
)

DRIFT, BIAS, SLIP = "heading_drift", "body_velocity_bias", "rotation_translation_coupling"
FLOOR, LATENCY = "floor_drift", "heading_latency"
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


LEFT_OUT = ("heading_drift",)


@pytest.fixture(scope="module")
def plain() -> Fit:
    return plain_fit(shorn(simulated(validation=None), session="first"))


@pytest.fixture(scope="module")
def screened(plain: Fit) -> Screening:
    return screen_plain(plain, LEFT_OUT)


@pytest.fixture(scope="module")
def extended(plain: Fit, screened: Screening) -> Extended:
    (coupling,) = (group for group in screened.groups.effects if group.name == "rotation_translation_coupling")
    return extend(plain, [coupling])


def test_an_extended_model_is_screened_with_its_effects_put_back(extended: Extended) -> None:
    again = screen_extended(extended, LEFT_OUT)
    (coupling,) = (group for group in again.groups.effects if group.name == "rotation_translation_coupling")
    values, _ = again.beyond_matrix().estimate(coupling.index)
    np.testing.assert_allclose(values, extended.values, rtol=0.05)
    assert again.beyond_matrix().chi_square(coupling.index) > 10 * len(extended.values)


def test_columns_are_made_once_for_both_screenings(screened: Screening, extended: Extended) -> None:
    assert screen_again(extended, screened).groups is screened.groups
    assert screen_extended(extended, LEFT_OUT).groups is not screened.groups


def test_effects_that_need_a_second_session_are_absorbed_in_a_single_one(screened: Screening) -> None:
    limits = detectability_of(screened, selected(screened))
    of_sessions = {name for name, missing in limits.not_looked_for if missing is Missing.SECOND_SESSION}
    assert of_sessions
    assert of_sessions <= {effect.name for effect in limits.absorbed}


def detectability(named: dict[str, np.ndarray], gains: tuple[float, ...] = (0, 0, 0, 0, 0)) -> Detectability:
    given = screening(named, {"place": FOURTH}, gains)
    return detectability_of(given, selected(given))


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


def test_an_effect_that_was_found_hides_no_longer() -> None:
    found = detectability({DRIFT: FIRST, BIAS: SECOND}, (0, 20, 0, 0, 0))
    assert [each.name for each in found.hidden] == [BIAS]


def dependences(gains: Sequence[float], named: dict[str, np.ndarray], covariates: Sequence[str] = ()) -> Dependences:
    """Dependences of residuals. covariates: of the bases in turn, by default their names."""
    given = screening(named, {"heading": FIRST, "place": SECOND, "elapsed time": THIRD}, gains)
    bases = tuple(replace(base, name=name) for base, name in zip(given.groups.bases, covariates, strict=False))
    given = replace(given, groups=replace(given.groups, bases=bases or given.groups.bases))
    return covariate_dependences(given, selected(given), None)


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


def test_of_two_families_the_one_that_is_no_chance_stands_for_their_covariate() -> None:
    calm, rough = family("a line", 4.0, 4, np.linspace(0, 1, 499)), family("tiles", 5.0, 140, np.linspace(0, 9, 499))
    given = screening({}, {"place": FIRST}, [0, 0, 0, 0, 0])
    selection = replace(selected(given), where=together(rough, calm))
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


# The bound on what encoder quantisation can make of a column

ALONG = np.zeros((2, 3, 1))
ALONG[:, 0] = 1.0  # both poses of a run, 1 m along x
TICKS = 0.1 * np.abs(FORWARD)  # rad: what the wheels turn in each sample of 0.1 s
QUARTER_TICKS = 0.25 * float((TICKS * np.abs(DESIGN[0])).sum())  # m along x, of all wheels in the same direction
OF_RUN = (2 + 1) * QUARTER_TICKS  # at the start they move both poses, at rest the last one


def turning(angles: np.ndarray) -> Trajectory:
    """A run whose wheels turn by angles (F, N), rad, in samples of 0.02 s."""
    times = 0.02 * np.arange(1, len(angles) + 1)
    return replace(run_of(FORWARD, "go", "run"), times=times, rates=angles / 0.02)


def test_wheels_with_gaussian_noise_have_no_ticks() -> None:
    rng = np.random.default_rng(5)
    for speed in (0.005, 0.03, 0.1):
        angles = speed * np.array([1.0, -0.3, 0.5]) + 3e-4 * rng.standard_normal((800, 3))
        assert not quantisation_steps([turning(np.round(angles / 0.02, 6) * 0.02)]).any()


@pytest.mark.parametrize("tick", [1e-4, 1e-3])
def test_ticks_are_found_in_wheel_rates_that_are_written_with_six_digits(tick: float) -> None:
    rng = np.random.default_rng(6)
    counts = np.floor(np.cumsum(0.03 + 3e-4 * rng.standard_normal((800, 3)), axis=0) / tick)
    angles = tick * np.diff(counts, axis=0, prepend=0.0)
    steps = quantisation_steps([turning(np.round(angles / 0.02, 6) * 0.02)])
    assert steps == pytest.approx(tick, rel=1e-3)


@drawn(tick=st.floats(1e-5, 0.05), seed=st.integers(0, 2**32 - 1), most=st.integers(1, 200))
def test_the_size_of_a_tick_is_found(tick: float, seed: int, most: int) -> None:
    counts = np.random.default_rng(seed).integers(-most, most + 1, size=(400, 3))
    counts[:2] = [[most] * 3, [most - 1] * 3]
    np.testing.assert_allclose(quantisation_steps([turning(tick * counts)]), tick, rtol=1e-9)


def bound(commands: Sequence[str], columns: Sequence[np.ndarray], beyond: Sequence[int] = ()) -> float:
    runs = [run_of(FORWARD, command, f"run {number}") for number, command in enumerate(commands)]
    fit = extended_of(runs, [np.zeros((2, 3)) for _ in runs]).fit
    return EncoderQuantisation(fit, fit.whitened(columns)).chi_square([0], beyond)


def test_a_column_explains_at_most_the_quarter_ticks_that_all_push_along_it() -> None:
    assert bound(["a", "b"], [ALONG, ALONG]) == pytest.approx((2 * OF_RUN) ** 2 / 4)  # X'X = 2 poses of 2 runs


def test_repetitions_of_a_command_are_off_by_the_same_part_of_a_tick() -> None:
    assert bound(["a", "a"], [ALONG, -ALONG]) == pytest.approx(0.0, abs=1e-20)
    assert bound(["a", "b"], [ALONG, -ALONG]) == pytest.approx((2 * OF_RUN) ** 2 / 4)


def test_what_other_columns_make_does_not_count() -> None:
    other = np.zeros((2, 3, 1))
    other[1, 0] = 1.0  # the last pose alone, so that beyond it a column keeps the first: only starts push that
    columns = [np.concatenate([ALONG, other], axis=2)] * 2
    assert bound(["a", "b"], columns, [1]) == pytest.approx((2 * QUARTER_TICKS) ** 2 / 2)
