"""Selection of effects, evidence for and against them, competing models, unknown terms and motors."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from discovery_samples import APR02, COUPLING, nothing, plain_fit, shorn, simulated
from extended_samples import FORWARD, extended_of, run_of
from extended_samples import MATRIX as DESIGN
from hidden.experiment import ROBOT
from hidden.sets import Truth, make_set
from hypothesis import given as drawn
from hypothesis import strategies as st
from scipy.stats import ncx2
from screening_samples import FIRST, FOURTH, MATRIX, PARAMETER, POSITIVE, SECOND, THIRD, screening

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover.confirm import CompetingModels, averaged, competing_models
from omnibench.discover.covariates import Basis
from omnibench.discover.discover import discover_effects
from omnibench.discover.fit import Extended, Fit, PlainFit, extend
from omnibench.discover.held_out import group_counts, step_name
from omnibench.discover.locate import Located, dependences_on, weights_of_covariates
from omnibench.discover.motors import fit_motors, screen_motors
from omnibench.discover.propose import Proposal, hidden_sizes, propose
from omnibench.discover.result import CovariateDependence, Discovery, Hidden
from omnibench.discover.screening import (
    EncoderQuantisation,
    Missing,
    Screening,
    make_groups,
    quantisation_steps,
    screen,
)
from omnibench.discover.select import (
    Credibility,
    Selection,
    bayes_factor,
    credibility_of,
    effect_sets,
    select_effects,
    tempered_evidence,
)
from omnibench.discover.significance import Family, Group, Significance, log_evidence, significance_of, together
from omnibench.discover.spline_term import add_smooth_terms
from omnibench.fit.noise import Whitener
from omnibench.registry import effects
from omnibench.robot.calibration import Calibration
from omnibench.robot.effects.effect import Parameter
from omnibench.robot.kinematics import Robot
from omnibench.robot.physical import EstimatedCovariance

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


def test_what_one_run_alone_shows_is_no_effect() -> None:
    given = screening({DRIFT: FIRST}, BASES, [0, 0, 0, 0, 0])
    residuals = (given.data.residuals[0] + 80 * FIRST, *given.data.residuals[1:])
    scores = np.array([each.T @ own for each, own in zip(given.data.columns, residuals, strict=True)])
    again = Screening(given.groups, replace(given.data, residuals=residuals, scores=scores), given.folds)
    assert again.beyond_matrix.chi_square((1,)) == pytest.approx(80**2 / 20)
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
    return screened_plain(plain, LEFT_OUT)


def screened_plain(plain: Fit, without: Sequence[str] = ()) -> Screening:
    return screen(plain, plain.nuisance_free_residuals, make_groups(plain, without))


def screened_extended(extended: Extended) -> Screening:
    return screen(extended.fit, extended.residuals_without_effects, make_groups(extended.fit, LEFT_OUT))


@pytest.fixture(scope="module")
def extended(plain: Fit, screened: Screening) -> Extended:
    (coupling,) = (group for group in screened.groups.effects if group.name == "rotation_translation_coupling")
    return extend(plain, [coupling])


def test_an_extended_model_is_screened_with_its_effects_put_back(extended: Extended) -> None:
    again = screened_extended(extended)
    (coupling,) = (group for group in again.groups.effects if group.name == "rotation_translation_coupling")
    values, _ = again.beyond_matrix.estimate(coupling.index)
    np.testing.assert_allclose(values, extended.values, rtol=0.05)
    assert again.beyond_matrix.chi_square(coupling.index) > 10 * len(extended.values)


def test_effects_that_need_a_second_session_are_absorbed_in_a_single_one(screened: Screening) -> None:
    limits = proposed(screened)
    of_sessions = {name for name, missing in limits.not_looked_for if missing is Missing.SECOND_SESSION}
    assert of_sessions
    assert of_sessions <= {effect.name for effect in limits.absorbed}


def proposed(screened: Screening) -> Proposal:
    where = significance_of(screened.data, [0], screened.groups.bases, np.random.default_rng(0))
    return propose(Located(PlainFit(Mock(Dataset), Mock(Fit)), screened, where, None))


def limits(named: dict[str, np.ndarray]) -> Proposal:
    return proposed(screening(named, {"place": FOURTH}, (0, 0, 0, 0, 0)))


def hidden(named: dict[str, np.ndarray], gains: tuple[float, ...] = (0, 0, 0, 0, 0)) -> tuple[Hidden, ...]:
    given = screening(named, {"place": FOURTH}, gains)
    return hidden_sizes(given, selected(given).chosen, (), 1.0)


def at(degrees: float) -> np.ndarray:
    """A unit vector between the first and the second row."""
    return np.cos(np.radians(degrees)) * FIRST + np.sin(np.radians(degrees)) * SECOND


def test_an_effect_that_the_matrix_reproduces_is_absorbed_and_nothing_else_is_said_of_it() -> None:
    columns = {DRIFT: MATRIX, BIAS: MATRIX + 0.02 * FIRST}
    assert [each.name for each in limits(columns).absorbed] == [DRIFT]
    assert [each.name for each in hidden(columns)] == [BIAS]


def test_effects_of_which_one_makes_most_of_the_other_are_one_class() -> None:
    assert limits({DRIFT: at(0), BIAS: at(12)}).classes == ((BIAS, DRIFT),)  # cos^2 = 0.957
    assert limits({DRIFT: at(0), BIAS: at(14)}).classes == ()  # cos^2 = 0.941


def test_the_part_that_the_matrix_absorbs_does_not_count_as_alike() -> None:
    assert limits({DRIFT: 5 * MATRIX + FIRST, BIAS: 5 * MATRIX + SECOND}).classes == ()


def test_pairs_that_share_an_effect_are_one_class() -> None:
    found = limits({DRIFT: at(0), BIAS: at(12), FLOOR: at(24)})
    assert found.classes == ((BIAS, FLOOR, DRIFT),)


def test_an_effect_that_two_others_make_together_is_said_with_their_names() -> None:
    found = limits({DRIFT: at(45), BIAS: FIRST, FLOOR: SECOND, LATENCY: THIRD})
    assert found.classes == ()
    imitated = dict(found.sums)
    assert set(imitated) == {DRIFT, BIAS, FLOOR}  # each of the three is made by the other two
    assert set(imitated[DRIFT]) == {BIAS, FLOOR}


def test_a_size_hides_within_its_interval_and_is_found_from_a_few_standard_errors_on() -> None:
    (size,) = hidden({DRIFT: 4 * FIRST})  # an information of 16: a standard error of 1/4
    assert size.limit == pytest.approx(1.96 / 4)
    assert size.detectable == pytest.approx(5.5 / 4)
    assert size.plausible == 0.1


def test_an_effect_that_was_found_hides_no_longer() -> None:
    assert [each.name for each in hidden({DRIFT: FIRST, BIAS: SECOND}, (0, 20, 0, 0, 0))] == [BIAS]


Dependences = tuple[list[CovariateDependence], list[CovariateDependence]]


def dependences(gains: Sequence[float], named: dict[str, np.ndarray], covariates: Sequence[str] = ()) -> Dependences:
    """What residuals depend on, before and after effects. covariates: of the bases, by default their names."""
    given = screening(named, {"heading": FIRST, "place": SECOND, "elapsed time": THIRD}, gains)
    bases = tuple(replace(base, name=name) for base, name in zip(given.groups.bases, covariates, strict=False))
    given = replace(given, groups=replace(given.groups, bases=bases or given.groups.bases))
    where = significance_of(given.data, given.groups.matrix.index, given.groups.bases, np.random.default_rng(0))
    return dependences_on(where), dependences_on(selected(given).left, "still ")


def covariates(given: Dependences) -> tuple[list[str], list[str]]:
    where, left = given
    return [each.covariate for each in where], [each.covariate for each in left]


def test_the_surest_covariate_comes_first_and_chance_is_not_mentioned() -> None:
    assert covariates(dependences([0, 8, 20, 0, 0], {})) == (["place", "heading"], ["place", "heading"])


def test_what_a_named_effect_explains_is_no_longer_left() -> None:
    assert covariates(dependences([0, 20, 0, 0, 0], {DRIFT: FIRST})) == (["heading"], [])


def test_of_several_bases_of_a_covariate_the_surest_stands_for_it() -> None:
    (place,) = dependences([0, 8, 20, 0, 0], {}, ["place", "place", "elapsed time"])[0]
    assert place.description == "the residual depends on the place"
    assert place.excess == pytest.approx(399)
    assert place.degrees_of_freedom == 1


def test_of_two_families_the_one_that_is_no_chance_stands_for_their_covariate() -> None:
    calm, rough = family("a line", 4.0, 4, np.linspace(0, 1, 499)), family("tiles", 5.0, 140, np.linspace(0, 9, 499))
    (place,) = dependences_on(together(rough, calm))
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


# Evidence of sets of effects and credibility of their names, by numbers that can be worked out by hand.

PLACE = {"place": THIRD}


def significance(left: float, rank: int = 1) -> Significance:
    """Generic bases that find a chi-square difference ``left`` beyond chance."""
    one = np.ones(1)
    surplus = left / np.sqrt(2 * rank)
    basis = Group("covariate", "place", (3,))
    return Significance((basis,), left * one, left * one, rank * one, one, one, (Family(1, np.zeros(499)),), surplus, 0)


def test_the_evidence_of_a_difference_is_that_of_the_likeliest_g_prior() -> None:
    # (10 - 2 - 2 ln 5) / 2
    assert log_evidence(np.array([10.0]), np.array([2]))[0] == pytest.approx(2.390562)
    ratios = [(1 + g) ** -1 * np.exp(10 / 2 * g / (1 + g)) for g in np.linspace(0, 20, 20_001)]
    assert log_evidence(np.array([10.0]), np.array([2]))[0] == pytest.approx(np.log(max(ratios)), abs=1e-6)


def test_a_difference_no_larger_than_chance_makes_counts_against_its_columns() -> None:
    at_chance, below = log_evidence(np.array([3.0, 1.0]), np.array([3, 3]))
    assert at_chance == 0.0
    assert below == -1.0


def test_beside_an_effect_ten_percent_off_its_form_differences_count_as_much_less_as_their_variance_is_larger() -> None:
    # 1 + 0.1^2 * 300 = 4: a difference of 40 counts as one of 10
    assert tempered_evidence(np.array([40.0]), np.array([2]), 300.0)[0] == pytest.approx(2.390562)


def test_sets_are_all_of_different_effects_up_to_a_size_with_their_prior_odds() -> None:
    given = screening({DRIFT: FIRST, BIAS: SECOND}, PLACE, [0, 3, 4, 0, 0], tries={BIAS: 2})
    sets = effect_sets(given.beyond_matrix, given.groups.effects, 2)
    assert [tuple(group.name for group in each) for each in sets.sets] == [(), (DRIFT,), (BIAS,), (DRIFT, BIAS)]
    assert sets.energy == pytest.approx(9 + 16 - 2)
    trusted = np.array([0.0, 9.0, 16.0, 25.0]) / (1 + 0.01 * 23)
    expected = (trusted[1:] - [1, 1, 2] - [1, 1, 2] * np.log(trusted[1:] / [1, 1, 2])) / 2
    expected -= [np.log(20), np.log(40), np.log(20) + np.log(40)]
    np.testing.assert_allclose(sets.evidence, [0.0, *expected])
    assert sets.best == (sets.sets[int(np.argmax([0.0, *expected]))])


def test_two_shapes_of_an_effect_are_never_in_one_set() -> None:
    given = screening({DRIFT: FIRST, BIAS: SECOND}, PLACE, [0, 3, 4, 0, 0])
    pool = [given.groups.effects[0], Group("effect", DRIFT, (2,), parameters=(POSITIVE,))]
    assert max(len(each) for each in effect_sets(given.beyond_matrix, pool, 2).sets) == 1


def test_where_little_noise_blurs_what_is_left_the_bayes_factor_is_the_ratio_of_the_densities_of_its_share() -> None:
    energy, usual = 1e6, 0.04
    for share in (0.01, 0.04, 0.1, 0.5):
        left = energy * share / (1 - share)
        expected = np.exp(-share / usual) / usual
        assert bayes_factor(left, 1e-4 * energy, energy, usual) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("left", [0.0, 5.0, 20.0, 40.0])
def test_the_bayes_factor_is_near_that_of_non_central_chi_squares(left: float) -> None:
    freedom, energy, usual = 8, 800.0, 0.005
    shares = np.linspace(1e-5, 0.3, 30_000)
    density = ncx2.pdf(left + freedom, freedom, energy * shares / (1 - shares))
    exact = (density * np.exp(-shares / usual) / usual).sum() / density.sum()
    assert bayes_factor(left, 4.0, energy, usual) == pytest.approx(exact, rel=0.35)


def credibility(
    gains: Sequence[float],
    left: float = 0.0,
    beyond: float = 0.0,
    count: int = 1,
    *,
    second: np.ndarray = SECOND,
    function: np.ndarray = THIRD,
    parameter: Parameter = PARAMETER,
) -> Credibility:
    """Credibility of the first ``count`` of two effects beside a basis of one function."""
    given = screening({DRIFT: FIRST, BIAS: second}, {"place": function}, gains, parameter=parameter)
    start, chosen = given.beyond_matrix, given.groups.effects[:count]
    return credibility_of(effect_sets(start, chosen, count), start, chosen, significance(left), significance(beyond))


def test_a_name_that_leaves_nothing_is_credible_and_one_that_leaves_half_is_not() -> None:
    right, wrong = credibility([0, 20, 0, 0, 0], 0.0, 0.0), credibility([0, 20, 0, 0, 0], 399.0, 399.0)
    assert right.probability > 0.99
    assert right.left_share == 0.0
    assert wrong.probability < 0.02
    assert wrong.left_share == pytest.approx(0.5)


def test_a_name_is_the_less_credible_the_more_it_leaves() -> None:
    found = [credibility([0, 20, 0, 0, 0], left, left / 4).probability for left in (0, 10, 20, 40, 80, 160)]
    assert found == sorted(found, reverse=True)


def test_what_bases_do_not_find_beside_a_name_raises_the_odds_only_so_far() -> None:
    unexplained, little, nothing = (
        credibility([0, 20, 0, 0, 0], 40.0, beyond).probability for beyond in (40.0, 2.0, 0.0)
    )
    assert unexplained < little == nothing < 1


def test_two_names_have_a_fifth_of_the_odds_of_one() -> None:
    one = credibility([0, 20, 0, 0, 0], 20.0, 20.0)
    two = credibility([0, np.sqrt(201), np.sqrt(200), 0, 0], 20.0, 20.0, 2)  # as large together: 401 - 2 = 400 - 1
    odds = [each.probability / (1 - each.probability) for each in (one, two)]
    assert odds[1] == pytest.approx(odds[0] / 5)


def test_an_effect_of_an_impossible_sign_has_even_odds_at_most() -> None:
    assert credibility([0, -20, 0, 0, 0], parameter=POSITIVE).probability == 0.5
    assert credibility([0, -2, 0, 0, 0], parameter=POSITIVE).probability > 0.5  # within 3 standard errors of 0
    assert credibility([0, 20, 0, 0, 0], parameter=POSITIVE).probability > 0.99


def test_effects_that_cancel_each_other_have_even_odds_at_most() -> None:
    # Columns 25 degrees apart, and residuals along their difference: together 1 of what they make alone is left.
    close = np.cos(np.radians(25)) * FIRST + np.sin(np.radians(25)) * SECOND
    given = screening({DRIFT: FIRST, BIAS: close}, PLACE, [0, 0, 20, 0, 0])
    start = given.beyond_matrix
    values, _ = start.estimate([1, 2])
    joint = start.chi_square([1, 2]) / float(np.square(values).sum())
    assert joint == pytest.approx(1 / (1 / np.tan(np.radians(25)) ** 2 + 1 / np.sin(np.radians(25)) ** 2))
    assert joint < 0.45
    assert credibility([0, 0, 20, 0, 0], count=2, second=close).probability == 0.5


@pytest.mark.parametrize(
    ("apart", "along", "credible"),
    [
        (25.0, 25.0, False),  # the function explains all of it, the name 82 %
        (25.0, 0.0, True),  # the name explains all of it, the function 82 %
        (0.5, 0.5, True),  # the function is the name's own but for 0.0001
    ],
)
def test_a_name_has_even_odds_at_most_where_one_function_that_is_not_its_own_explains_more(
    apart: float, along: float, credible: bool
) -> None:
    function, residual = (
        np.cos(np.radians(turn)) * FIRST + np.sin(np.radians(turn)) * THIRD for turn in (apart, along)
    )
    probability = credibility(20 * residual, function=function).probability
    assert (probability > 0.95) is credible
    assert credible or probability == 0.5


def test_two_names_have_even_odds_at_most_where_one_function_explains_nearly_as_much() -> None:
    both = (FIRST + SECOND) / np.sqrt(2)
    function = np.cos(np.radians(7)) * both + np.sin(np.radians(7)) * THIRD  # 98.5 % of what both explain, each 50 %
    assert credibility(20 * both, count=2, function=function).probability == 0.5


def test_two_names_stay_sure_where_one_function_explains_no_more_than_the_first_of_them() -> None:
    function = np.cos(np.radians(7)) * FIRST + np.sin(np.radians(7)) * THIRD
    assert credibility(300 * FIRST + 30 * SECOND, count=2, function=function).probability > 0.95


# Closing the gap without a name: on recordings with something in them that no catalogue has.

FOLDS = np.tile(np.arange(5), 12)  # of the 60 runs of a small set


def recorded(kind: str) -> tuple[Dataset, Truth]:
    """60 + 60 runs with an effect that no catalogue has, of a non-centrality of 600."""
    return make_set("outside", kind, 600.0, 1000, design="small")


def left_out() -> Discovery:
    return discover_effects(simulated(), without=("rotation_translation_coupling",), unknown_term=False)


@pytest.fixture(scope="module")
def grooved() -> tuple[Dataset, Truth, Discovery]:
    dataset, truth = recorded("turning_by_heading")
    return dataset, truth, discover_effects(dataset)


@pytest.fixture(scope="module")
def bare(grooved: tuple[Dataset, Truth, Discovery]) -> Extended:
    """Their plain fit."""
    return extend(plain_fit(grooved[0]), ())


@pytest.fixture(scope="module")
def screened_again(bare: Extended) -> tuple[Screening, Selection]:
    """Their screening, and what is selected after it."""
    screening = screened_plain(bare.fit)
    return screening, select_effects(screening, np.random.default_rng(0))


def error(calibration: Calibration, dataset: Dataset, truth: Truth, found: Discovery) -> float:
    """Whitened chi2 of a calibration against the poses of the validation without their noise."""
    true = {run.id: run for run in truth.clean}
    runs = dataset.split("validation")
    logs = [replace(run.reference_log, start=true[run.id].poses[0]) for run in runs]
    return sum(
        float(np.square(Whitener(found.noise.noise, run.pose_times[1:])(true[run.id].poses[1:] - poses)).sum())
        for run, poses in zip(runs, calibration.model.reported(logs), strict=True)
    )


def test_most_of_the_gap_closes_on_a_held_out_session_by_a_step_without_a_name(
    grooved: tuple[Dataset, Truth, Discovery],
) -> None:
    dataset, truth, found = grooved
    before, after = (error(each, dataset, truth, found) for each in (found.plain, found.extended))
    assert after < 0.25 * before
    assert (found.verdict, found.effects) == ("unknown", ())
    unnamed = {"smooth_heading", "smooth_course", "smooth_heading_wave"}
    assert {term.name for term in found.extended.effects} <= unnamed | {"wheel_dead_zone"}  # which its class has
    assert [step.name for step in found.steps] == ["plain matrix", "+ wheel_dead_zone", "+ unnamed, over heading"]
    first, *_, last = (step.held_out for step in found.steps)
    assert last < first
    assert len([note for note in found.notes if "unnamed term" in note]) == 1


def test_the_calibration_file_has_the_physical_parameters(grooved: tuple[Dataset, Truth, Discovery]) -> None:
    dataset, _, found = grooved
    for wheel, design in zip("abc", (wheel.radius for wheel in dataset.robot.wheels), strict=True):
        radius = found.plain.parameters[f"radius_{wheel}"]
        assert radius.design == design
        assert radius.low < radius.value < radius.high


@pytest.mark.parametrize("make", [left_out, nothing])
def test_no_term_is_tried_where_it_is_not_wanted_or_nothing_is_missing(make: Callable[[], Discovery]) -> None:
    found = make()
    assert found.verdict == ("none" if make is nothing else "unknown")
    usual = set() if make is nothing else {"wheel_dead_zone"}  # of its class, wherever something has no name
    assert {term.name for term in found.extended.effects} == usual
    assert not any("unnamed" in note for note in found.notes)


def test_functions_are_fitted_together_with_named_effects_and_stand_after_them(
    bare: Extended, screened_again: tuple[Screening, Selection]
) -> None:
    screening, selection = screened_again
    named = extend(bare.fit, [group("heading_drift")])
    smooth = add_smooth_terms(bare.fit, screening, named, selection.left, lambda _: selection.left, FOLDS)
    used = smooth.model
    assert used.groups[0].name == "heading_drift"
    assert {each.name for each in used.groups[1:]} <= {"smooth_heading", "smooth_course", "smooth_heading_wave"}
    assert used.groups[1:] == smooth.terms
    assert "unnamed" in smooth.notes[0]
    calibrated = {term.name: term.values for term in used.fit.model.terms}
    assert calibrated["heading_drift"]["b"] == used.values[0]


@pytest.mark.slow
def test_runs_of_few_kinds_of_motion_get_no_term(grooved: tuple[Dataset, Truth, Discovery]) -> None:
    dataset = grooved[0]
    commands = sorted({run.command or "" for run in dataset.trajectories})[:9]
    few = replace(dataset, trajectories=tuple(run for run in dataset.trajectories if run.command in commands))
    found = discover_effects(few)
    assert found.verdict == "unknown"
    assert {term.name for term in found.extended.effects} == {"wheel_dead_zone"}
    assert any("No unnamed term was tried: 9 kinds of motion" in note for note in found.notes)


def test_nothing_is_added_to_a_model_that_leaves_nothing_of_it(
    bare: Extended, screened_again: tuple[Screening, Selection]
) -> None:
    screening, selection = screened_again
    model = extend(bare.fit, [group("smooth_heading"), group("smooth_course")])
    smooth = add_smooth_terms(bare.fit, screening, model, selection.left, lambda _: selection.left, FOLDS)
    assert smooth.model is model
    assert smooth.terms == ()
    assert "unnamed term" in smooth.notes[0]
    assert "was added" in smooth.notes[0] or "left out" in smooth.notes[0]


def test_named_effects_come_one_by_one_and_what_has_no_name_at_once() -> None:
    basis = Basis("place", "body", "where on the floor the robot is")
    named, nameless = group("heading_drift"), replace(group("smooth_place"), basis=basis)
    assert group_counts([named, named, nameless, nameless]) == [1, 2, 4]
    assert group_counts([named]) == [1]
    assert group_counts([]) == []
    assert step_name(nameless) == "unnamed, over place"


def group(name: str, **shapes: float) -> Group:
    effect = effects.create(name)
    parameters = effect.parameters(ROBOT)
    linear = tuple(each for each in parameters if not each.choices)
    usual = {each.name: each.choices[0] for each in parameters if each.choices}
    return Group("effect", name, (), effect, linear, usual | shapes)


# Models that recordings cannot tell apart: which is used, and their average with its weights and how unsure it is.

Fitted = tuple[Fit, Selection, dict[str, Group]]
RIGHT, WRONG = "rotation_translation_coupling", "acceleration_slip"


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    """The plain fit, the selection of the one effect that is there, and all effects."""
    plain = plain_fit(simulated(COUPLING, validation=None))
    screening = screened_plain(plain)
    return (
        plain,
        select_effects(screening, np.random.default_rng(0)),
        {g.name: g for g in screening.groups.effects},
    )


def competing(fitted: Fitted, chosen: str, *others: str) -> CompetingModels:
    """Models with the chosen effect, and others that could take its place."""
    plain, selection, groups = fitted
    weights = {chosen: 0.6, **dict.fromkeys(others, 0.4)}
    doubtful = replace(
        selection, chosen=(groups[chosen],), stand_ins=(tuple(groups[name] for name in others),), weights=weights
    )
    return competing_models(plain, doubtful, extend(plain, doubtful.chosen))


def used(models: CompetingModels) -> list[str]:
    return [group.name for group in models.used.groups]


@pytest.mark.parametrize("likelier_first", [(WRONG, RIGHT), (RIGHT, WRONG)])
def test_the_effect_that_predicts_held_out_commands_better_is_used_and_all_models_keep_their_weights(
    fitted: Fitted, likelier_first: tuple[str, str]
) -> None:
    models = competing(fitted, *likelier_first)
    assert used(models) == [group.name for group in models.selection.chosen] == [RIGHT]
    assert models.selection.confusable == ((WRONG,),)
    assert models.preferred[0].startswith(f"{RIGHT} is used: it predicts commands that were held out better")
    assert models.weighted[0][1] is models.used
    assert {model.groups[0].name: weight for weight, model in models.weighted} == models.selection.weights


def test_an_effect_without_a_stand_in_has_no_competitor_and_needs_no_reason(fitted: Fitted) -> None:
    models = competing(fitted, RIGHT)
    assert used(models) == [RIGHT]
    assert len(models.weighted) == 1
    assert models.preferred == ("",)


def model(fitted: Fitted, name: str) -> Extended:
    return extend(fitted[0], [fitted[2][name]])


def copy_of(extended: Extended) -> Extended:
    """The model with a group of its own, so that it counts as another effect."""
    return replace(extended, groups=tuple(replace(group) for group in extended.groups))


def test_a_model_that_predicts_held_out_commands_far_worse_has_no_share(fitted: Fitted) -> None:
    right, wrong = model(fitted, RIGHT), model(fitted, WRONG)
    average = averaged([(0.1, wrong), (0.9, right)])
    assert average.members == ((1.0, right),)
    assert average.extended is right
    assert average.note == ""


def test_models_that_predict_alike_share_by_the_probabilities_of_their_names(fitted: Fitted) -> None:
    right = model(fitted, RIGHT)
    average = averaged([(0.3, right), (0.1, copy_of(right))])
    assert [weight for weight, _ in average.members] == pytest.approx([0.75, 0.25])
    np.testing.assert_allclose(average.extended.values, np.append(0.75 * right.values, 0.25 * right.values))
    together, alone = (np.concatenate(extended.fit.poses) for extended in (average.extended, right))
    np.testing.assert_allclose(together, alone, atol=1e-9)
    assert average.note.startswith("The extended model is the average of models that these recordings cannot tell ")


def test_values_that_no_robot_has_cost_a_model_its_share(fitted: Fitted) -> None:
    right = model(fitted, RIGHT)
    narrow = tuple(replace(each, low=each.low / 1e3, high=each.high / 1e3) for each in right.groups[0].parameters)
    absurd = replace(right, groups=(replace(right.groups[0], parameters=narrow),))
    assert averaged([(0.9, absurd), (0.1, right)]).members == ((1.0, right),)


def test_what_members_disagree_on_is_not_known(fitted: Fitted) -> None:
    right = model(fitted, RIGHT)
    opposite = copy_of(right)
    elements = right.fit.model.matrix.size
    average = averaged([(0.5, right), (0.5, opposite)]).extended
    apart = np.zeros((elements + 4, elements + 4))
    half = np.concatenate([np.zeros(elements), right.values, -right.values]) / 2
    within = np.zeros_like(apart)
    for rows in ([*range(elements), elements, elements + 1], [*range(elements), elements + 2, elements + 3]):
        within[np.ix_(rows, rows)] += right.covariance.matrix / 2
    np.testing.assert_allclose(average.covariance.matrix, within + np.outer(half, half), atol=1e-15)


# Effects of the motors, from a few runs whose wheel rates follow their targets in a way that is known.

APR = Robot.model_validate(APR02)
NOISE = 1e-3  # rad/s, of each measured rate


def runs(name: str = "motor_gain", count: int = 12, **values: float) -> list[Trajectory]:
    """Runs of three commands, each wheel at its own two speeds in turn, both ways; driven by one effect."""
    rng = np.random.default_rng(1)
    times = np.arange(1, 81) / 20
    effect = effects.create(name)
    made = []
    for number in range(count):
        speeds = (0.5 + number % 3) * np.array([1.0, -0.6, 0.3])
        targets = np.sign(np.sin(np.pi * times + 0.1))[:, None] * speeds
        rates = effect.driven(np.diff(times, prepend=0.0), targets, values)
        rates = rates + NOISE * rng.standard_normal(rates.shape)
        still = np.zeros((1, 3))
        made.append(
            Trajectory(f"run {number}", "train", times, rates, np.zeros(1), still, f"{number % 3}", targets=targets)
        )
    return made


Motors = tuple[Selection, np.ndarray, EstimatedCovariance]


def found(recorded: list[Trajectory], *without: str) -> Motors:
    """What was selected, with its values and their covariance."""
    screened = screen_motors(recorded, APR, without)
    assert screened is not None
    selection = select_effects(screened.screening, np.random.default_rng(0))
    return selection, *fit_motors(screened, selection.chosen)


@pytest.mark.parametrize(
    ("name", "values"),
    [("motor_gain", {"g": -0.03}), ("motor_lag", {"tau": 0.08}), ("motor_dead_band", {"band": 0.05})],
)
def test_an_effect_is_named_and_its_parameter_exact_to_its_standard_error(name: str, values: dict[str, float]) -> None:
    selection, parameters, covariance = found(runs(name, **values))
    assert [group.name for group in selection.chosen] == [name]
    error = covariance.standard_deviations[0]
    assert parameters[0] == pytest.approx(*values.values(), abs=4 * error)
    assert error < 0.02 * abs(next(iter(values.values())))


def test_the_standard_error_of_a_gain_is_that_of_a_regression_on_the_targets() -> None:
    recorded = runs(g=-0.03, count=60)
    _, _, covariance = found(recorded)
    squares = sum(float(np.square(run.targets).sum()) for run in recorded if run.targets is not None)
    assert covariance.standard_deviations[0] == pytest.approx(NOISE / np.sqrt(squares), rel=0.5)


def test_of_motors_that_only_scatter_nothing_is_named() -> None:
    selection, parameters, _ = found(runs(g=0.0))
    assert selection.chosen == ()
    assert parameters.shape == (0,)


def test_an_effect_that_is_left_out_is_not_named() -> None:
    selection, _, _ = found(runs(g=-0.03), "motor_gain")
    assert "motor_gain" not in selection.weights


def test_without_targets_there_is_nothing_to_say() -> None:
    assert screen_motors([replace(run, targets=None) for run in runs(g=-0.03)], APR, ()) is None


def test_targets_that_are_copies_of_the_rates_or_were_never_filled_say_nothing() -> None:
    recorded = runs(g=-0.03)
    assert screen_motors([replace(run, targets=run.rates) for run in recorded], APR, ()) is None
    assert screen_motors([replace(run, targets=np.zeros_like(run.rates)) for run in recorded], APR, ()) is None
