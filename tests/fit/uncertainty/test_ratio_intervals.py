"""Intervals of ratios over commands or runs: their units, what they cover, and where there is none."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from fit_samples import noisy_trajectories
from scipy import stats

from omnibench.fit.ratio_intervals import Bootstrap, RatioIntervals, Units, units_of

STUDIES = Path(__file__).parents[2] / "studies"
BOOTSTRAP = Bootstrap(resamples=2000, seed=1)


@pytest.fixture(scope="module")
def study() -> ModuleType:
    """The study of coverage."""
    sys.path.insert(0, str(STUDIES))
    try:
        spec = importlib.util.spec_from_file_location("improvement_coverage", STUDIES / "improvement_coverage.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["improvement_coverage"] = module  # where dataclasses look up their annotations
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(STUDIES))
    return module


def units(commands: int, repetitions: int = 1) -> Units:
    return Units("command", np.repeat(np.arange(commands), repetitions))


def test_commands_are_the_unit_where_runs_repeat_them_and_runs_elsewhere() -> None:
    (run, *_) = noisy_trajectories()
    named = [replace(run, id=f"{index}", command=name) for index, name in enumerate(["a", "b", "a", None, None])]
    assert units_of(named).name == "command"
    assert units_of(named).of_run.tolist() == [0, 1, 0, 2, 3]  # a run without a command is its own unit
    assert units_of(named, "run").of_run.tolist() == [0, 1, 2, 3, 4]
    assert (units_of(named[:2]).name, units_of(named[:2]).count) == ("run", 2)


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (1, "no interval from 1 command"),
        (2, "no interval from 2 commands"),
        (3, "Student's t over 3 commands"),
        (9, "Student's t over 9 commands"),
        (10, "bootstrap over 10 commands"),
    ],
)
def test_the_number_of_units_decides_the_method_and_is_said(count: int, words: str) -> None:
    of = units(count, 2)
    costs = np.random.default_rng(0).uniform(1.0, 2.0, 2 * count)
    found = RatioIntervals(BOOTSTRAP).mean(costs, of)
    assert of.words == words
    assert (found.known is None) == words.startswith("no interval")
    assert found.value == pytest.approx(costs.mean())


def test_a_difference_over_few_units_has_the_interval_of_the_paired_t_test() -> None:
    rng = np.random.default_rng(3)
    first, second = rng.normal(1.0, 0.3, 7), rng.normal(0.8, 0.3, 7)
    found = RatioIntervals(BOOTSTRAP).difference(first - second, units(7))
    expected = stats.ttest_rel(first, second).confidence_interval(0.95)
    assert found.known == pytest.approx((expected.low, expected.high))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_difference_of_one_sign_everywhere_has_the_interval_of_the_t_test_too(sign: int) -> None:
    differences = sign * np.array([1e-4, 2e-4, 1e-4, 3e-4, 0.05])
    found = RatioIntervals(BOOTSTRAP).difference(differences, units(5))
    expected = stats.ttest_1samp(differences, 0.0).confidence_interval(0.95)
    assert found.known == pytest.approx((expected.low, expected.high))
    assert found.holds(0.0)


@pytest.mark.parametrize("count", [3, 4, 9])
def test_a_true_difference_of_zero_is_left_out_in_five_per_cent_of_the_sets(count: int) -> None:
    rng = np.random.default_rng(count)
    intervals, of = RatioIntervals(BOOTSTRAP), units(count)
    left_out = sum(not intervals.difference(rng.standard_normal(count), of).holds(0.0) for _ in range(2000))
    assert 70 <= left_out <= 130  # binomial: 100 +- 9.7; on the logarithm's scale 288 of 3 units


def test_twenty_runs_of_a_command_tell_no_more_than_one_of_their_mean() -> None:
    rng = np.random.default_rng(4)
    costs, before = rng.uniform(1, 2, 12), rng.uniform(2, 4, 12)
    intervals = RatioIntervals(BOOTSTRAP)
    once = intervals.improvement(costs, before, units(12))
    repeated = intervals.improvement(np.repeat(costs, 20), np.repeat(before, 20), units(12, 20))
    assert once is not None
    assert repeated is not None
    assert repeated.known == pytest.approx(once.known)


def test_the_interval_of_an_improvement_leaves_out_zero_where_the_mean_paired_difference_does() -> None:
    intervals = RatioIntervals(BOOTSTRAP)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        before = rng.uniform(1, 2, 14)
        after = before * rng.normal(0.9, 0.2, 14)
        gain = intervals.improvement(after, before, units(14))
        difference = intervals.difference(after - before, units(14))
        assert gain is not None
        edge = min(abs(end) for end in gain.known or (1.0,))
        assert gain.holds(0.0) == difference.holds(0.0) or edge < 0.02  # resamples of another statistic, at the edge


def test_an_improvement_is_below_one_and_a_mean_cost_above_zero_over_few_units() -> None:
    intervals = RatioIntervals(BOOTSTRAP)
    costs, before = np.array([0.01, 0.5, 0.02]), np.array([1.0, 1.1, 0.9])
    gain, mean = intervals.improvement(costs, before, units(3)), intervals.mean(costs, units(3))
    assert gain is not None
    assert gain.known is not None
    assert mean.known is not None
    assert gain.known[0] < gain.value < gain.known[1] < 1
    assert mean.known[0] > 0


def test_the_ends_are_where_the_paired_t_statistic_reaches_its_bootstrapped_quantiles() -> None:
    """Resampled here anew, by another generator: 2 % of noise in each quantile."""
    rng = np.random.default_rng(8)
    before = rng.uniform(1, 2, 14)
    after = before * rng.gamma(4.0, 0.2, 14)  # skewed, so that the two quantiles differ
    found = RatioIntervals(Bootstrap(resamples=20_000)).ratio(after, before, units(14))
    left = after - after.sum() / before.sum() * before
    low, high = np.percentile(stats.ttest_1samp(rng.choice(left, (20_000, 14)), 0.0, axis=1).statistic, [2.5, 97.5])
    assert found.known is not None
    reached = [stats.ttest_1samp(after - end * before, 0.0).statistic for end in found.known]
    assert reached == pytest.approx([high, low], rel=0.06)


def test_one_command_that_outweighs_all_others_has_no_interval() -> None:
    before = np.append(np.full(11, 1e-3), 100.0)
    gain = RatioIntervals(BOOTSTRAP).improvement(np.append(np.full(11, 2e-3), 90.0), before, units(12))
    assert gain is not None
    assert (gain.known, gain.holds(0.0)) == (None, True)


def test_equal_shares_everywhere_have_an_interval_without_width() -> None:
    before = np.array([1.0, 2.0, 4.0, 8.0])
    gain = RatioIntervals(BOOTSTRAP).improvement(0.25 * before, before, units(4))
    assert gain is not None
    assert gain.known == pytest.approx((0.75, 0.75))


@pytest.mark.parametrize("kind", ["usual", "none", "unequal"])
@pytest.mark.parametrize("commands", [30, 12, 5])
def test_intervals_over_commands_that_share_an_error_cover_the_improvement(
    study: ModuleType, kind: str, commands: int
) -> None:
    rng = np.random.default_rng(commands)
    truth = study.improvement_of(study.KINDS[kind])
    hits = [study.ours(study.drawn(study.KINDS[kind], commands, rng), seed).holds(truth) for seed in range(200)]
    # Binomial: 95 % of 200 leaves fewer than 179 inside with a probability of 4e-4, 92 % fewer than 171 with 2e-4.
    assert sum(hits) >= (171 if (kind, commands) == ("unequal", 5) else 179)


def test_intervals_over_runs_that_share_the_error_of_their_command_do_not_cover(study: ModuleType) -> None:
    rng = np.random.default_rng(1)
    truth = study.improvement_of(study.KINDS["usual"])
    sets = [study.drawn(study.KINDS["usual"], 12, rng) for _ in range(100)]
    by_run = [replace(errors, units=Units("run", np.arange(len(errors.design)))) for errors in sets]
    assert sum(study.ours(errors, seed).holds(truth) for seed, errors in enumerate(by_run)) < 80


def test_the_verdict_of_a_calibration_covers_what_its_matrix_improves_on_fresh_commands(study: ModuleType) -> None:
    found = [study.whole_way(12, seed) for seed in range(12)]
    # Binomial: 95 % of 12 leaves fewer than 9 inside with a probability of 2e-4.
    assert sum(interval.holds(truth) for interval, truth in found) >= 9
