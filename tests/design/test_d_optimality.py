"""D-optimal designs: the bound holds against brute force, exchange never loses, and known optima are found."""

from collections.abc import Iterator
from itertools import combinations_with_replacement

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omnibench.design import d_optimality
from omnibench.design.exchange import Counts, exchanged
from omnibench.robot.kinematics import Array

seeds = st.integers(0, 10_000)


def information(seed: int, candidates: int = 5, parameters: int = 3, rank: int = 2) -> Array:
    """Random information matrices (C, p, p), none of which tells every parameter."""
    slopes = np.random.default_rng(seed).standard_normal((candidates, rank, parameters))
    return np.swapaxes(slopes, 1, 2) @ slopes


def costs(seed: int, candidates: int = 5) -> Array:
    return np.random.default_rng(seed + 1).uniform(0.5, 3.0, candidates)


def every_design(candidates: int, runs: int) -> Iterator[Counts]:
    for chosen in combinations_with_replacement(range(candidates), runs):
        yield np.bincount(chosen, minlength=candidates)


@given(seed=seeds, runs=st.integers(1, 5))
def test_no_exact_design_exceeds_the_bound(seed: int, runs: int) -> None:
    candidates = d_optimality.Candidates(information(seed), costs(seed))
    bound = d_optimality.continuous_optimum(candidates).bound
    assert max(candidates.criterion(counts) for counts in every_design(5, runs)) <= bound * (1 + 1e-9)


@given(seed=seeds, iterations=st.integers(1, 4))
def test_the_bound_holds_wherever_the_algorithm_is_stopped(seed: int, iterations: int) -> None:
    candidates = d_optimality.Candidates(information(seed), costs(seed))
    early = d_optimality.continuous_optimum(candidates, iterations=iterations)
    best = d_optimality.continuous_optimum(candidates)
    assert early.bound >= best.criterion * (1 - 1e-9)
    assert early.criterion <= best.bound * (1 + 1e-9)


@given(seed=seeds)
def test_no_candidate_gains_more_than_the_gap_says(seed: int) -> None:
    """The theorem of Kiefer and Wolfowitz, in the coordinates that were given."""
    given_information, given_costs = information(seed), costs(seed)
    optimum = d_optimality.continuous_optimum(d_optimality.Candidates(given_information, given_costs))
    per_cost = given_information / given_costs[:, None, None]
    inverse = np.linalg.inv(np.tensordot(optimum.shares, per_cost, 1))
    assert optimum.shares.sum() == pytest.approx(1)
    assert optimum.gap <= 1e-5
    assert max(np.trace(inverse @ each) for each in per_cost) <= 3 * (1 + optimum.gap) * (1 + 1e-9)


@given(seed=seeds, runs=st.integers(4, 7))
def test_after_an_exchange_no_single_swap_gains(seed: int, runs: int) -> None:
    candidates = d_optimality.Candidates(information(seed), costs(seed))
    counts = exchanged(candidates, d_optimality.rounded(candidates, np.full(5, 0.2), runs))
    swaps = [counts - np.eye(5, dtype=int)[i] + np.eye(5, dtype=int)[j] for i in range(5) for j in range(5)]
    best = max(candidates.criterion(swapped) for swapped in swaps if (swapped >= 0).all())
    assert best <= candidates.criterion(counts) * (1 + 1e-5)


@settings(max_examples=10)
@given(seed=seeds, runs=st.integers(3, 6))
def test_exact_designs_are_within_1_percent_of_the_best_of_all(seed: int, runs: int) -> None:
    candidates = d_optimality.Candidates(information(seed, candidates=4, parameters=2))
    numbers = range(1, runs + 1)
    *_, found = d_optimality.exact_designs(candidates, d_optimality.continuous_optimum(candidates), numbers)
    best = max(candidates.criterion(counts) for counts in every_design(4, runs))
    assert candidates.criterion(found) >= 0.99 * best


@given(seed=seeds)
def test_designs_do_not_depend_on_the_coordinates_of_the_parameters(seed: int) -> None:
    own = information(seed)
    change = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0] @ np.diag([1e-3, 1.0, 1e3])
    there = d_optimality.Candidates(change.T @ own @ change)
    here = d_optimality.Candidates(own)
    scale = abs(np.linalg.det(change)) ** (2 / 3)
    assert d_optimality.continuous_optimum(there).bound == pytest.approx(
        scale * d_optimality.continuous_optimum(here).bound, rel=1e-4
    )
    for counts in ([1, 1, 1, 1, 1], [2, 0, 1, 1, 0], [0, 3, 1, 0, 2]):
        assert there.root(np.array(counts)) == pytest.approx(scale * here.root(np.array(counts)), rel=1e-6)


def test_cheap_runs_are_preferred_when_cost_counts() -> None:
    own = np.concatenate([information(5), information(5)])
    prices = np.array([1.0] * 5 + [2.0] * 5)
    candidates = d_optimality.Candidates(own, prices)
    assert d_optimality.continuous_optimum(candidates).shares[5:].sum() < 1e-4
    assert np.flatnonzero(exchanged(candidates, d_optimality.rounded(candidates, np.full(10, 0.1), 8))).max() < 5


@settings(max_examples=8)
@given(seed=seeds, most=st.integers(1, 3), runs=st.integers(1, 5))
def test_no_candidate_is_driven_more_often_than_allowed(seed: int, most: int, runs: int) -> None:
    candidates = d_optimality.Candidates(information(seed), most=most)
    optimum = d_optimality.continuous_optimum(candidates)
    assert exchanged(candidates, d_optimality.rounded(candidates, optimum.shares, runs)).max() <= most
    designs = list(d_optimality.exact_designs(candidates, optimum, range(1, 21)))
    assert len(designs) == 5 * most
    assert max(counts.max() for counts in designs) == most


@given(seed=seeds, target=st.floats(0.5, 30.0))
def test_an_equal_design_reaches_its_target_and_respects_the_bound(seed: int, target: float) -> None:
    candidates = d_optimality.Candidates(information(seed), costs(seed))
    optimum = d_optimality.continuous_optimum(candidates)
    counts = d_optimality.equal_design(candidates, optimum, target * optimum.criterion)
    assert candidates.root(counts) >= target * optimum.criterion
    assert candidates.cost(counts) >= target * optimum.criterion / optimum.bound * (1 - 1e-9)


def test_an_equal_design_that_is_not_allowed_is_none() -> None:
    candidates = d_optimality.Candidates(information(2), most=1)
    optimum = d_optimality.continuous_optimum(candidates)
    assert d_optimality.equal_design(candidates, optimum, 6 * optimum.bound) is None


def test_candidates_that_leave_a_direction_open_are_refused() -> None:
    own = information(4)
    own[:, 2] = own[:, :, 2] = 0.0
    with pytest.raises(ValueError, match="undetermined"):
        d_optimality.Candidates(own)


def test_too_few_runs_identify_nothing() -> None:
    candidates = d_optimality.Candidates(information(6))
    assert not candidates.identifies(np.array([4, 0, 0, 0, 0]))
    assert candidates.identifies(np.array([1, 1, 1, 1, 1]))
