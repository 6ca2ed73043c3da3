"""Numbers as a person reads them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from omnibench.report.numbers import (
    NOTHING,
    decimals_for,
    fixed,
    listing,
    percent,
    power_of_ten,
    round_down,
    seconds,
    significant,
    typeset,
    with_unit,
)
from omnibench.words import noun_for, plural


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.12345, "0.1235"),
        (-0.5, "−0.5000"),
        (12345.0, "12,345.0000"),
        (-1e-9, "0.0000"),
        (None, NOTHING),
        (math.nan, NOTHING),
        (math.inf, "∞"),
    ],
)
def test_a_fixed_number_has_its_decimals_and_a_true_minus(value: float | None, text: str) -> None:
    assert fixed(value, 4) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.021434, "0.0214"),
        (2.04e-8, "2.04 × 10⁻⁸"),
        (9.996e-8, "1.00 × 10⁻⁷"),
        (1234567.0, "1.23 × 10⁶"),
        (637.0, "637"),
    ],
)
def test_significant_digits_use_powers_of_ten_where_zeros_would_be_counted(value: float, text: str) -> None:
    assert significant(value, 3) == text


@given(st.floats(min_value=-1e12, max_value=1e12, allow_nan=False).filter(lambda value: abs(value) > 1e-300))
def test_significant_digits_read_back_to_the_same_value(value: float) -> None:
    words = significant(value, 4).replace("−", "-").replace(",", "")
    if " × 10" in words:
        mantissa, exponent = words.split(" × 10")
        power = exponent.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
        words = f"{mantissa}e{power}"
    assert float(words) == pytest.approx(value, rel=6e-4)


@given(st.floats(min_value=1e-6, max_value=1e6))
def test_decimals_show_the_digits_that_were_asked_for(value: float) -> None:
    assert float(fixed(value, decimals_for(value, 3)).replace(",", "")) == pytest.approx(value, rel=6e-3)


@pytest.mark.parametrize(("value", "text"), [(5e-5, "< 1 ms"), (0.0823, "82 ms"), (26.54, "26.5 s"), (637.2, "637 s")])
def test_a_duration_has_a_unit_that_suits_it(value: float, text: str) -> None:
    assert seconds(value) == text


def test_a_share_is_told_in_per_cent() -> None:
    assert percent(0.8394, 2) == "83.94 %"
    assert percent(None) == NOTHING


def test_a_listing_ends_with_and_and_counts_what_it_leaves_out() -> None:
    assert listing(["a"]) == "a"
    assert listing(["a", "b", "c"]) == "a, b and c"
    assert listing(["a", "b", "c", "d"], limit=2) == "a, b and 2 more"
    assert listing(["a", "b", "c"], last="or") == "a, b or c"


def test_sentences_of_the_terminal_get_arrows_minus_and_degree_signs() -> None:
    words = "held out: 52 mm -> 14 mm, 4.4 deg -> 1.0 deg (95 % interval -3.2 to 7.3 %); run-01, turn-360"
    assert typeset(words) == "held out: 52 mm → 14 mm, 4.4° → 1.0° (95 % interval −3.2 to 7.3 %); run-01, turn-360"


def test_the_degree_sign_alone_follows_without_a_space() -> None:
    assert [with_unit("3", unit) for unit in ("mm", "°", "°/s", "")] == ["3 mm", "3°", "3°/s", "3"]


def test_plurals_are_english() -> None:
    assert [plural(1, "run"), plural(2, "run"), plural(180, "trajectory")] == ["1 run", "2 runs", "180 trajectories"]
    assert [noun_for(1, "run"), noun_for(2000, "run")] == ["run", "runs"]
    assert [plural(1, "simulated trajectory"), plural(0, "ray")] == ["1 simulated trajectory", "0 rays"]


def test_powers_of_ten_are_set_as_such() -> None:
    assert [power_of_ten(exponent) for exponent in (-10, -1, 0, 3, 4)] == ["10⁻¹⁰", "0.1", "1", "1,000", "10⁴"]


@pytest.mark.parametrize(("value", "step"), [(7.3, 5), (5.0, 5), (1.0, 1), (0.37, 0.2), (99.0, 50)])
def test_enlargements_are_round(value: float, step: float) -> None:
    assert round_down(value) == pytest.approx(step)
