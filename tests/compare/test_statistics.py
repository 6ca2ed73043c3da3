"""Statistics of entries: what intervals cover, what is paired, what is practically equal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omnibench.compare.config import Bootstrap
from omnibench.compare.plan import SearchSpace
from omnibench.compare.result import EntryStatistics, RunRecord, ScoredRun, SplitScore
from omnibench.compare.statistics import NEGLIGIBLE_SHARE, entry_statistics, is_mean
from omnibench.data.dataset import Split
from omnibench.fit.calibrator import Outcome
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.ratio_intervals import Interval, Units
from omnibench.robot.kinematics import Array

BOOTSTRAP = Bootstrap(resamples=1000, seed=3)


def scored(
    label: str,
    train: Array | None,
    validation: Array | None = None,
    *,
    seed: int = 1,
    dataset: str = "flower",
    theoretical: Array | None = None,
    gap: float | None = None,
    evaluations: int = 10,
) -> ScoredRun:
    """A run whose trajectories have these costs; None: no answer."""
    design = np.ones(8 if train is None else len(train)) if theoretical is None else theoretical
    answered = Outcome.FAILED if train is None else Outcome.CONVERGED
    names = {"dataset": dataset, "label": label, "calibrator": "crs", "parameterisation": "matrix", "box": "row"}
    counts = {"seed": seed, "evaluations": evaluations, "seconds": 1.0}
    measures = {
        "train_cost": None if train is None else float(train.mean()),
        "validation_cost": None if validation is None else float(validation.mean()),
        "theoretical_train_cost": float(design.mean()),
        "theoretical_validation_cost": None if validation is None else float(design.mean()),
        "gap": gap,
    }
    others = {"options": {}, "outcome": answered, "reason": "", "at_bounds": (), "held": ()}
    record = RunRecord(**dict.fromkeys(RunRecord.model_fields) | names | counts | measures | others)
    costs: dict[Split, Array | None] = {"train": train, "validation": validation}
    scores = {split: split_score(values) for split, values in costs.items() if values is not None}
    designs: dict[Split, SplitScore] = {"train": split_score(design)}
    if validation is not None:
        designs["validation"] = split_score(design)
    return ScoredRun(record, SearchSpace("matrix", "row", bounded=True), (), scores, designs)


def split_score(costs: Array) -> SplitScore:
    units = Units("run", np.arange(len(costs)))
    return SplitScore(float(costs.mean()), costs, np.zeros((len(costs), 3)), units, SumOfNorms.rounding)


def train_cost(entry: EntryStatistics) -> Interval:
    cost = entry.cost("train")
    assert cost is not None
    return cost


def of(runs: list[ScoredRun], bootstrap: Bootstrap = BOOTSTRAP) -> dict[str, EntryStatistics]:
    return {entry.label: entry for entry in entry_statistics(runs, bootstrap)}


def test_the_intervals_hold_the_mean_as_often_as_they_say() -> None:
    rng = np.random.default_rng(0)
    held = 0
    for seed in range(300):
        (entry,) = entry_statistics([scored("a", rng.normal(5.0, 1.0, 60))], Bootstrap(resamples=400, seed=seed))
        train = train_cost(entry)
        held += train.low <= 5.0 <= train.high
    assert 0.90 <= held / 300 <= 0.98


def test_the_same_seed_draws_the_same_intervals() -> None:
    runs = [scored("a", np.random.default_rng(6).normal(5.0, 1.0, 40))]
    assert entry_statistics(runs, BOOTSTRAP) == entry_statistics(runs, BOOTSTRAP)
    assert entry_statistics(runs, BOOTSTRAP) != entry_statistics(runs, Bootstrap(resamples=1000, seed=4))


def test_an_interval_is_as_wide_as_the_standard_error_says() -> None:
    costs = np.random.default_rng(1).normal(5.0, 1.0, 400)
    entry = of([scored("a", costs)], Bootstrap(resamples=20_000))["a"]
    train = train_cost(entry)
    error = costs.std(ddof=1) / np.sqrt(400)
    assert train.value == pytest.approx(costs.mean())
    assert train.low == pytest.approx(costs.mean() - 1.96 * error, abs=0.05 * error)
    assert train.high == pytest.approx(costs.mean() + 1.96 * error, abs=0.05 * error)


def test_the_interval_of_an_improvement_pairs_each_trajectory_with_its_own_theoretical_cost() -> None:
    theoretical = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0])
    entry = of([scored("a", 0.25 * theoretical, theoretical=theoretical)])["a"]
    improvement = entry.improvement("train")
    assert improvement is not None
    assert (improvement.value, improvement.low, improvement.high) == (
        pytest.approx(0.75),
        pytest.approx(0.75),
        pytest.approx(0.75),
    )


def test_a_difference_is_paired_by_trajectory() -> None:
    rng = np.random.default_rng(2)
    hard_and_easy = rng.uniform(1.0, 100.0, 50)
    entries = of([scored("best", hard_and_easy), scored("other", hard_and_easy + rng.normal(0.5, 0.05, 50))])
    difference = entries["other"].difference
    assert difference is not None
    assert difference.value == pytest.approx(0.5, abs=0.05)
    assert difference.high - difference.low < 0.1  # unpaired it would be about 20
    assert entries["other"].practically_equal is False


def test_the_best_entry_has_the_lowest_validation_cost_not_the_lowest_training_cost() -> None:
    entries = of([scored("a", np.full(8, 1.0), np.full(8, 3.0)), scored("b", np.full(8, 2.0), np.full(8, 2.0))])
    assert (entries["a"].is_best, entries["b"].is_best) == (False, True)
    difference = entries["a"].difference
    assert difference is not None
    assert difference.value == pytest.approx(1.0)
    best = entries["b"].difference
    assert best is not None
    assert (best.value, best.low, best.high) == (0.0, 0.0, 0.0)
    assert entries["b"].practically_equal is True


def test_between_entries_within_the_noise_the_training_cost_decides_which_is_best() -> None:
    noise = np.random.default_rng(0).normal(size=100)
    lowest = scored("lowest", np.full(100, 2.0), 2 + 0.1 * noise)
    level = scored("level", np.full(100, 1.0), 2 + 0.1 * noise + 1e-4)
    worse = scored("worse", np.full(100, 0.5), 3 + 0.1 * noise)
    entries = of([lowest, level, worse])
    assert [label for label, entry in entries.items() if entry.is_best] == ["level"]
    assert (entries["lowest"].practically_equal, entries["worse"].practically_equal) == (True, False)


def test_without_validation_data_the_training_cost_decides_for_every_data_set_apart() -> None:
    runs = [scored("a", np.full(8, cost), dataset=name) for name, cost in (("one", 1.0), ("two", 5.0))]
    runs += [scored("b", np.full(8, cost), dataset=name) for name, cost in (("one", 2.0), ("two", 4.0))]
    best = {(entry.dataset, entry.label) for entry in entry_statistics(runs, BOOTSTRAP) if entry.is_best}
    assert best == {("one", "a"), ("two", "b")}


def test_an_entry_within_the_noise_of_the_best_is_practically_equal() -> None:
    rng = np.random.default_rng(4)
    costs = rng.uniform(1.0, 2.0, 40)
    entries = of([scored("best", costs), scored("close", costs + rng.normal(0.001, 0.05, 40))])
    assert entries["close"].practically_equal is True


def test_a_difference_of_one_sign_everywhere_is_practically_equal_where_chance_explains_it() -> None:
    more = np.array([1e-4, 2e-4, 1e-4, 3e-4, 0.05])
    entries = of([scored("best", np.full(5, 1.0)), scored("other", 1.0 + more)])
    difference = entries["other"].difference
    assert difference is not None
    assert difference.known is not None
    assert difference.known[0] < 0 < difference.known[1] < 0.1
    assert entries["other"].practically_equal is True


def test_a_certain_difference_is_practically_equal_below_a_tenth_of_the_standard_error_of_the_best() -> None:
    costs = np.random.default_rng(5).uniform(1.0, 2.0, 40)
    limit = NEGLIGIBLE_SHARE * costs.std(ddof=1) / np.sqrt(40)
    entries = of([scored("best", costs), scored("below", costs + 0.99 * limit), scored("above", costs + 1.01 * limit)])
    assert entries["below"].difference is not None
    assert entries["below"].difference.low > 0  # the interval does not contain zero
    assert (entries["below"].practically_equal, entries["above"].practically_equal) == (True, False)


def test_the_median_and_the_spread_are_over_seeds() -> None:
    runs = [
        scored("a", np.full(8, cost), seed=seed, evaluations=10 * seed) for seed, cost in enumerate((5, 1, 3, 9, 2), 1)
    ]
    entry = of(runs)["a"]
    assert (entry.train_median, entry.train_spread, entry.evaluations_median) == (3.0, 3.0, 30.0)
    assert (entry.runs, entry.answers) == (5, 5)


@pytest.mark.parametrize(("costs", "seed"), [((5.0, 1.0, 3.0), 3), ((5.0, 1.0), 1)])
def test_the_typical_run_has_the_median_training_cost_and_of_two_the_worse(costs: tuple[float, ...], seed: int) -> None:
    entry = of([scored("a", np.full(8, cost), seed=seed) for seed, cost in enumerate(costs, 1)])["a"]
    assert entry.typical is not None
    assert entry.typical.record.seed == seed


def test_runs_without_an_answer_are_counted_and_left_out() -> None:
    entry = of([scored("a", None, seed=1), scored("a", np.full(8, 2.0), seed=2)])["a"]
    assert (entry.runs, entry.answers, entry.train_median) == (2, 1, 2.0)
    assert entry.typical is not None
    assert entry.typical.record.seed == 2


def test_an_entry_without_any_answer_has_no_statistics_and_is_never_best() -> None:
    entry = of([scored("a", None), scored("b", np.full(8, 2.0))])["a"]
    assert (entry.typical, entry.cost("train"), entry.train_median, entry.difference) == (None, None, None, None)
    assert (entry.practically_equal, entry.is_best) == (None, False)


def test_the_gap_of_an_entry_is_the_median_of_its_runs() -> None:
    runs = [scored("a", np.full(8, 1.0), seed=seed, gap=gap) for seed, gap in enumerate((0.3, None, 0.1, 0.2))]
    assert of(runs)["a"].gap_median == pytest.approx(0.2)


@pytest.mark.parametrize("number", [1, 2])
def test_one_or_two_runs_have_no_interval_and_nothing_is_said_to_differ(number: int) -> None:
    runs = [
        scored(name, np.full(number, cost), theoretical=np.full(number, 4.0)) for name, cost in (("a", 2), ("b", 3))
    ]
    entries = of(runs)
    improvement, difference = entries["a"].improvement("train"), entries["b"].difference
    assert (train_cost(entries["a"]).value, train_cost(entries["a"]).known) == (2.0, None)
    assert improvement is not None
    assert (improvement.value, improvement.known) == (0.5, None)
    assert difference is not None
    assert (difference.known, entries["b"].practically_equal) == (None, None)


@settings(max_examples=30)
@given(st.lists(st.floats(0.01, 100), min_size=2, max_size=30), st.integers(0, 2**32))
def test_the_value_of_an_interval_is_the_mean_and_lies_within_it(costs: list[float], seed: int) -> None:
    values = np.array(costs)
    (entry,) = entry_statistics([scored("a", values)], Bootstrap(resamples=100, seed=seed))
    train = train_cost(entry)
    assert train.value == pytest.approx(values.mean())
    assert train.known is None or train.known[0] <= train.value <= train.known[1]


def test_a_cost_that_is_no_mean_over_trajectories_is_noticed() -> None:
    run = scored("a", np.array([1.0, 2.0, 6.0]))
    assert is_mean(run)
    root_mean_square = replace(run.scores["train"], cost=float(np.sqrt(41 / 3)))
    assert not is_mean(replace(run, scores={"train": root_mean_square}))
