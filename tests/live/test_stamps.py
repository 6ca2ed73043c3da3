"""No stamp is published twice."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from omnibench.live.stamps import PublishedStamps


@given(st.lists(st.integers(0, 300), max_size=300))
def test_no_stamp_comes_twice_in_any_order(stamps: list[int]) -> None:
    published = PublishedStamps()
    given_out = [published.unique(stamp) for stamp in stamps]
    assert len(set(given_out)) == len(given_out)


@given(st.lists(st.integers(0, 10**18), unique=True, max_size=100))
def test_a_stamp_that_is_new_stays_as_it_is_when_time_goes_forward(stamps: list[int]) -> None:
    published = PublishedStamps()
    assert [published.unique(stamp) for stamp in sorted(stamps)] == sorted(stamps)


def test_a_clock_that_jumps_back_over_and_over_repeats_no_stamp() -> None:
    published = PublishedStamps(remembered=1000)
    given_out = [published.unique(10**7 * (k % 100)) for k in range(900)]
    assert len(set(given_out)) == 900
    assert max(abs(out - 10**7 * (k % 100)) for k, out in enumerate(given_out)) <= 9  # ns


def test_old_stamps_are_forgotten_and_memory_stays_flat() -> None:
    published = PublishedStamps(remembered=1000)
    for stamp in range(20_000):
        published.unique(stamp)
    assert 1000 <= sum(map(len, published._runs)) <= 1250
    assert published.unique(19_500) != 19_500  # among the latest thousand
