"""The bound on what encoder quantisation can make of a column, by numbers that can be worked out by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from extended_samples import FORWARD, MATRIX, extended_of, run_of
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.dataset import Trajectory
from omnibench.discover.selection.screening import EncoderQuantisation, quantisation_steps

ALONG = np.zeros((2, 3, 1))
ALONG[:, 0] = 1.0  # both poses of a run, 1 m along x
TICKS = 0.1 * np.abs(FORWARD)  # rad: what the wheels turn in each sample of 0.1 s
QUARTER_TICKS = 0.25 * float((TICKS * np.abs(MATRIX[0])).sum())  # m along x, of all wheels in the same direction
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


@given(tick=st.floats(1e-5, 0.05), seed=st.integers(0, 2**32 - 1), most=st.integers(1, 200))
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
