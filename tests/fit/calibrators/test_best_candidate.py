"""Whatever the batches, the problem keeps the best candidate and a history that only goes down."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from omnibench.testing import synthetic_problem


@settings(max_examples=25, deadline=None)
@given(sizes=st.lists(st.integers(1, 9), min_size=1, max_size=6), seed=st.integers(0, 2**16))
def test_the_best_of_all_batches_is_kept(sizes: list[int], seed: int) -> None:
    problem = synthetic_problem(undefined=lambda points: points[:, 0] > 0.7)
    rng = np.random.default_rng(seed)
    batches = [problem.from_unit(rng.uniform(size=(size, problem.size))) for size in sizes]
    values = np.concatenate([problem.cost(batch) for batch in batches])
    if np.isnan(values).all():
        assert problem.best_cost == np.inf
        return
    assert problem.best_cost == np.nanmin(values)
    assert np.array_equal(problem.best_vector, np.concatenate(batches)[np.nanargmin(values)])


@settings(max_examples=25, deadline=None)
@given(sizes=st.lists(st.integers(1, 9), min_size=1, max_size=6), seed=st.integers(0, 2**16))
def test_the_history_goes_down_and_says_at_which_evaluation(sizes: list[int], seed: int) -> None:
    problem = synthetic_problem()
    rng = np.random.default_rng(seed)
    values = np.concatenate([problem.cost(problem.from_unit(rng.uniform(size=(n, problem.size)))) for n in sizes])
    costs = [improvement.cost for improvement in problem.history]
    assert costs == sorted(set(costs), reverse=True)
    assert [values[improvement.evaluations - 1] for improvement in problem.history] == costs
