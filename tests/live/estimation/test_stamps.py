"""No stamp is published twice."""

from __future__ import annotations

import time
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from omnibench.live.estimation.robot_state import PublishedStamps

PERIOD, SECOND = 10**7, 10**9  # ns


@given(st.lists(st.integers(0, 300), max_size=300))
def test_no_stamp_comes_twice_in_any_order(stamps: list[int]) -> None:
    published = PublishedStamps()
    given_out = [published.unique(stamp) for stamp in stamps]
    assert len(set(given_out)) == len(given_out)


@given(st.lists(st.integers(0, 60), max_size=300), st.integers(1, 40))
def test_no_stamp_comes_twice_among_those_that_are_remembered(stamps: list[int], remembered: int) -> None:
    published = PublishedStamps(remembered)
    given_out = [published.unique(stamp) for stamp in stamps]
    for begin in range(len(given_out)):
        latest = given_out[begin : begin + remembered + 1]
        assert len(set(latest)) == len(latest)


@given(st.lists(st.integers(0, 10**18), unique=True, max_size=100))
def test_a_stamp_that_is_new_stays_as_it_is_when_time_goes_forward(stamps: list[int]) -> None:
    published = PublishedStamps()
    assert [published.unique(stamp) for stamp in sorted(stamps)] == sorted(stamps)


@given(st.lists(st.integers(0, 10**18), unique=True, max_size=100))
def test_a_stamp_that_is_new_stays_as_it_is_in_any_order(stamps: list[int]) -> None:
    published = PublishedStamps()
    assert [published.unique(stamp) for stamp in stamps] == stamps


def test_a_clock_that_jumps_back_over_and_over_repeats_no_stamp() -> None:
    published = PublishedStamps(remembered=1000)
    given_out = [published.unique(PERIOD * (k % 100)) for k in range(900)]
    assert len(set(given_out)) == 900
    assert max(abs(out - PERIOD * (k % 100)) for k, out in enumerate(given_out)) <= 9  # ns


def test_old_stamps_are_forgotten_and_memory_stays_flat() -> None:
    published = PublishedStamps(remembered=1000)
    for stamp in range(20_000):
        published.unique(stamp)
    assert len(published) == 1000
    assert published.unique(19_500) != 19_500  # among the latest thousand


@pytest.mark.parametrize(
    "stamps",
    [
        pytest.param([PERIOD * (k // 2) - 10 * SECOND * (k % 2) for k in range(30_000)], id="two clocks, 10 s apart"),
        pytest.param([PERIOD * (k % 1000) for k in range(30_000)], id="a recording of 10 s in a loop"),
        pytest.param([PERIOD * (k % 3) for k in range(30_000)], id="three stamps in a loop"),
        pytest.param([PERIOD * (k % 3) - SECOND * (k // 3) for k in range(30_000)], id="ever further back"),
        pytest.param([PERIOD * (k * 7919 % 29_989) for k in range(30_000)], id="no order at all"),
    ],
)
def test_a_clock_gone_wild_costs_a_sample_no_more_than_20_us(stamps: Iterable[int]) -> None:
    published = PublishedStamps()
    begin = time.thread_time()
    given_out = [published.unique(stamp) for stamp in stamps]
    seconds = time.thread_time() - begin
    assert seconds / len(given_out) < 20e-6
    assert len(set(given_out)) == len(given_out)
