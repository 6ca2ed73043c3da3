"""Evidence of sets of effects and credibility of their names, by numbers that can be worked out by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import ncx2
from screening_samples import FIRST, PARAMETER, POSITIVE, SECOND, THIRD, screening

from omnibench.discover.regressors.significance import Family, Group, Significance
from omnibench.discover.selection.evidence import Credibility, bayes_factor, credibility_of, effect_sets, log_evidence
from omnibench.robot.effects.effect import Parameter

DRIFT, BIAS = "heading_drift", "body_velocity_bias"
BASES = {"place": THIRD}


def significance(left: float, rank: int = 1) -> Significance:
    """Generic bases that find a chi-square difference ``left`` beyond chance."""
    one = np.ones(1)
    surplus = left / np.sqrt(2 * rank)
    basis = Group("covariate", "place", (3,))
    return Significance((basis,), left * one, left * one, rank * one, one, one, (Family(1, np.zeros(499)),), surplus, 0)


def test_the_evidence_of_a_difference_is_that_of_the_likeliest_g_prior() -> None:
    # (10 - 2 - 2 ln 5) / 2
    assert log_evidence(np.array([10.0]), np.array([2]), 0.0)[0] == pytest.approx(2.390562)
    ratios = [(1 + g) ** -1 * np.exp(10 / 2 * g / (1 + g)) for g in np.linspace(0, 20, 20_001)]
    assert log_evidence(np.array([10.0]), np.array([2]), 0.0)[0] == pytest.approx(np.log(max(ratios)), abs=1e-6)


def test_a_difference_no_larger_than_chance_makes_counts_against_its_columns() -> None:
    at_chance, below = log_evidence(np.array([3.0, 1.0]), np.array([3, 3]), 0.0)
    assert at_chance == 0.0
    assert below == -1.0


def test_beside_an_effect_ten_percent_off_its_form_differences_count_as_much_less_as_their_variance_is_larger() -> None:
    # 1 + 0.1^2 * 300 = 4: a difference of 40 counts as one of 10
    assert log_evidence(np.array([40.0]), np.array([2]), 300.0)[0] == pytest.approx(2.390562)


def test_sets_are_all_of_different_effects_up_to_a_size_with_their_prior_odds() -> None:
    given = screening({DRIFT: FIRST, BIAS: SECOND}, BASES, [0, 3, 4, 0, 0], tries={BIAS: 2})
    sets = effect_sets(given.beyond_matrix(), given.groups.effects, 2)
    assert [tuple(group.name for group in each) for each in sets.sets] == [(), (DRIFT,), (BIAS,), (DRIFT, BIAS)]
    assert sets.energy == pytest.approx(9 + 16 - 2)
    trusted = np.array([0.0, 9.0, 16.0, 25.0]) / (1 + 0.01 * 23)
    expected = (trusted[1:] - [1, 1, 2] - [1, 1, 2] * np.log(trusted[1:] / [1, 1, 2])) / 2
    expected -= [np.log(20), np.log(40), np.log(20) + np.log(40)]
    np.testing.assert_allclose(sets.evidence, [0.0, *expected])
    assert sets.best == (sets.sets[int(np.argmax([0.0, *expected]))])


def test_two_shapes_of_an_effect_are_never_in_one_set() -> None:
    given = screening({DRIFT: FIRST, BIAS: SECOND}, BASES, [0, 3, 4, 0, 0])
    pool = [given.groups.effects[0], Group("effect", DRIFT, (2,), parameters=(POSITIVE,))]
    assert max(len(each) for each in effect_sets(given.beyond_matrix(), pool, 2).sets) == 1


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
    start, chosen = given.beyond_matrix(), given.groups.effects[:count]
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
    given = screening({DRIFT: FIRST, BIAS: close}, BASES, [0, 0, 20, 0, 0])
    start = given.beyond_matrix()
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
