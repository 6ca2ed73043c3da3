"""Significance, corrected for all groups that were tried."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest, chi2
from screening_samples import FIRST, SECOND, THIRD, screening

from omnibench.discover.regressors.columns import Group
from omnibench.discover.regressors.significance import Family, Significance, significance_of, together
from omnibench.fit.trajectory_fit import Whitened

GROUPS = tuple(Group("covariate", f"group {start}", tuple(range(start, start + 2))) for start in range(2, 22, 2))


def data_of(residuals: list[np.ndarray], columns: list[np.ndarray]) -> Whitened:
    return Whitened(
        tuple(residuals),
        tuple(columns),
        np.sum([each.T @ each for each in columns], axis=0),
        np.array([each.T @ own for each, own in zip(columns, residuals, strict=True)]),
    )


def noise(seed: int, runs: int = 40) -> tuple[list[np.ndarray], list[np.ndarray], np.random.Generator]:
    """Heavy-tailed residuals that are correlated within runs, as no noise model says."""
    rng = np.random.default_rng(seed)
    residuals = [rng.standard_t(3, 12) + rng.normal() for _ in range(runs)]
    return residuals, [rng.normal(size=(12, 22)) for _ in range(runs)], rng


def test_noise_of_any_kind_is_surprising_as_often_as_its_p_value_says() -> None:
    seen = []
    for seed in range(200):
        residuals, columns, rng = noise(seed)
        found = significance_of(data_of(residuals, columns), [0, 1], GROUPS, rng)
        seen.append(found.p_value(found.best) < 0.1)
    assert binomtest(sum(seen), len(seen), 0.1, alternative="greater").pvalue > 1e-3


def test_an_effect_in_every_run_is_found_in_its_group() -> None:
    residuals, columns, rng = noise(1)
    residuals = [own + each[:, 6] for own, each in zip(residuals, columns, strict=True)]
    found = significance_of(data_of(residuals, columns), [0, 1], GROUPS, rng)
    assert found.groups[found.best].name == "group 6"
    assert found.p_value(found.best) < 1e-6


def test_one_run_that_went_wrong_is_no_effect() -> None:
    residuals, columns, rng = noise(2)
    residuals[7] = residuals[7] + 40 * columns[7][:, 6]
    found = significance_of(data_of(residuals, columns), [0, 1], GROUPS, rng)
    assert found.chi_square.max() > 100
    assert found.p_value(found.best) > 0.01


def test_what_depends_on_few_runs_is_found_where_these_agree() -> None:
    residuals, columns, rng = noise(3)
    for run in range(5):
        residuals[run] = residuals[run] + 8 * columns[run][:, 6]
    for each in columns[5:]:
        each[:, 6:8] = 0.0
    found = significance_of(data_of(residuals, columns), [0, 1], GROUPS, rng)
    assert found.groups[found.best].name == "group 6"
    assert found.p_value(found.best) < 1e-3


def by_chance(evidence: float, chance: np.ndarray) -> Significance:
    """One group of so much evidence, where random flips made ``chance``."""
    one = np.ones(1)
    return Significance(GROUPS[:1], one, one, one, one, np.array([evidence]), (Family(1, np.sort(chance)),), 0.0, 0)


def test_a_chance_that_many_flips_reach_is_their_share_with_the_data_as_one_more() -> None:
    chance = np.arange(499) / 100
    assert by_chance(4.0, chance).p_value(0) == pytest.approx((99 + 1) / 500)


def test_a_chance_that_hardly_any_flip_reaches_is_that_of_an_exponential_tail() -> None:
    tail = np.concatenate([[1.0], 1.0 + np.linspace(0.0, 1.0, 48)])  # 48 of them beyond the least, by 0.5 in the mean
    chance = np.concatenate([np.zeros(450), tail])
    assert by_chance(3.0, chance).p_value(0) == pytest.approx(49 / 499 * np.exp(-(3 - 1) / 0.5))


def test_what_chance_makes_of_one_family_does_not_hide_another() -> None:
    calm, rough = by_chance(4.0, np.linspace(0, 1, 499)), by_chance(0.5, np.linspace(0, 20, 499))
    both = together(calm, rough)
    assert both.p_value(0) == pytest.approx(2 * calm.p_value(0))  # of two families
    assert both.p_value(1) == min(2 * rough.p_value(0), 1.0)
    assert both.groups == (*calm.groups, *rough.groups)


def test_the_scale_of_the_tail_is_right_in_the_mean() -> None:
    rng = np.random.default_rng(3)
    drawn = np.sort(rng.exponential(size=(2000, 499)), axis=1)
    told = np.array(
        [-np.log(by_chance(edge + 20.0, chance).p_value(0) * 499 / 49) for chance in drawn if (edge := chance[-49])]
    )
    assert np.mean(20.0 / told) == pytest.approx(1.0, abs=0.01)  # the scale of these exponentials; its error is 0.003


def test_the_tail_of_the_surest_of_many_uniform_chances_goes_on_at_ten_to_the_minus_z() -> None:
    chance = -np.log10((np.arange(499) + 0.5) / 499)
    assert by_chance(6.0, chance).p_value(0) == pytest.approx(1e-6, rel=0.5)


def test_evidence_is_of_the_difference_without_the_run_that_adds_most_and_corrected_for_its_tries() -> None:
    given = screening({}, {"heading": FIRST, "place": SECOND}, [0, 6, 0, 0, 0])
    groups = [given.groups.bases[0], Group("covariate", "patch", (1,), tries=5)]
    found = significance_of(given.data, [0], groups, np.random.default_rng(0))
    scores = given.data.scores[:, 1]
    least = min((6.0 - score) ** 2 for score in scores)
    assert found.chi_square == pytest.approx([36, 36])
    assert found.evidence == pytest.approx([-chi2.logsf(least, 1) / np.log(10) - each for each in (0, np.log10(5))])


def test_what_chance_makes_is_no_excess() -> None:
    given = screening({}, {"heading": FIRST, "place": SECOND}, [0, 6, 0, 0, 0])
    found = significance_of(given.data, [0], given.groups.bases, np.random.default_rng(0))
    assert found.spread == pytest.approx([1, 1])
    assert found.excess == pytest.approx([35, 0])


def test_the_surplus_is_that_of_the_group_that_stands_out_most_beyond_what_usually_does() -> None:
    given = screening({}, {"heading": FIRST, "place": SECOND, "time": THIRD}, [0, 6, 9, 0, 0])
    found = significance_of(given.data, [0], given.groups.bases, np.random.default_rng(0))
    assert found.surplus_of == 1
    # of three squares of normal numbers the largest is 2.10 in the mean
    assert found.surplus == pytest.approx((81 - 2.10) / np.sqrt(2), abs=0.15)
    assert found.surplus_chi_square == pytest.approx((81 - 2.10, np.sqrt(2)), abs=0.25)
