"""Gaps between errors on held-out runs and what repetitions allow, from residuals that are known."""

from __future__ import annotations

import numpy as np
import pytest
from extended_samples import FORWARD, TURN, extended_of, run_of

from omnibench.discover.held_out import (
    ValidationRuns,
    compare_held_out,
    errors_of_repetitions,
    floor_of,
    gap_between,
    training_gap,
)

RUNS = [
    run_of(rates, name, f"{name} {number}") for name, rates in (("go", FORWARD), ("turn", TURN)) for number in (1, 2)
]
NO_VALIDATION = ValidationRuns((), (), ())


def left(*finals: float) -> list[np.ndarray]:
    """Residuals along x alone, half of the final one at the middle of a run."""
    return [np.array([[final / 2, 0.0, 0.0], [final, 0.0, 0.0]]) for final in finals]


def test_the_share_that_is_closed_is_that_of_the_gap_to_the_floor() -> None:
    gap = gap_between("eq6", np.array([5.0, 5.0]), np.array([2.0, 2.0]), np.array([1.0, 1.0]))
    assert (gap.before, gap.after, gap.floor, gap.closed, gap.standard_error) == (5.0, 2.0, 1.0, 0.75, 0.0)


def test_of_a_gap_within_two_standard_errors_no_share_is_closed() -> None:
    before, floor = np.array([2.0, 4.0]), np.array([0.0, 2.0])  # 3 and 1, each with a variance of 1: an error of 1
    gap = gap_between("eq6", before, before / 2, floor)
    assert gap.standard_error == pytest.approx(1.0)
    assert gap.closed is None
    assert gap_between("eq6", before + 0.1, before, floor).closed == pytest.approx(0.1 / 2.1)


def test_without_repetitions_there_is_no_floor_and_nothing_is_closed() -> None:
    gap = gap_between("chi2", np.array([3.0, 5.0]), np.array([2.0, 2.0]), None)
    assert (gap.floor, gap.closed) == (None, None)
    assert gap.standard_error == pytest.approx(1 / np.sqrt(2))


def test_what_a_model_errs_less_than_is_no_floor() -> None:
    before, floor = np.full(4, 5.0), np.full(4, 3.0)
    gap = gap_between("eq6", before, np.full(4, 2.0), floor)
    assert (gap.floor, gap.closed) == (None, 1.0)
    assert gap_between("eq6", before, np.full(4, 3.5), floor).floor == 3.0


def test_where_all_runs_are_in_one_fold_nothing_is_held_out() -> None:
    model = extended_of(RUNS, left(4, 6, 4, 6))
    assert compare_held_out(model, model, NO_VALIDATION, np.zeros(4, dtype=np.intp)) == ()
    assert training_gap(model, model).before == 5.0


def test_a_model_with_nothing_to_fit_errs_by_its_residuals() -> None:
    errors = errors_of_repetitions(extended_of(RUNS, left(1, 3, 2, 2)), np.array([0, 1, 0, 1]))
    assert errors.finals[:, 0].tolist() == pytest.approx([1, 3, 2, 2])
    assert errors.chi2.tolist() == pytest.approx([1.25 / 6, 1.25 * 9 / 6, 1.25 * 4 / 6, 1.25 * 4 / 6])


def test_a_run_is_predicted_by_the_runs_of_the_other_folds_alone() -> None:
    slopes = [each[..., None] for each in left(1, 1, 1, 1)]  # one column, of which each run wants as much as it leaves
    errors = errors_of_repetitions(extended_of(RUNS, left(1, 3, 2, 4), slopes), np.array([0, 1, 0, 1]))
    assert errors.finals[:, 0].tolist() == pytest.approx([1 - 3.5, 3 - 1.5, 2 - 3.5, 4 - 1.5])


def test_the_floor_is_the_scatter_between_repetitions_as_one_prediction_errs_by_it() -> None:
    floor = floor_of(extended_of(RUNS, left(1, 3, 2, 2)).fit)
    assert floor is not None
    assert sorted(floor.eq6.tolist()) == pytest.approx([0.0, np.sqrt(2)])  # 2 apart, over the root of 2


def test_single_runs_of_commands_have_no_floor() -> None:
    assert floor_of(extended_of(RUNS[::2], left(1, 2)).fit) is None


def test_held_out_errors_are_means_of_both_models_over_the_runs() -> None:
    plain, better = extended_of(RUNS, left(4, 6, 4, 6)), extended_of(RUNS, left(1, 3, 1, 3))
    (held_out,) = compare_held_out(plain, better, NO_VALIDATION, np.array([0, 1, 0, 1]))
    assert (held_out.data, held_out.runs) == ("repetitions", 4)
    assert held_out.position_m == (5.0, 2.0)
    assert held_out.heading_rad == (0.0, 0.0)
    assert held_out.eq6.floor == pytest.approx(np.sqrt(2))
    assert held_out.eq6.closed == pytest.approx(3 / (5 - np.sqrt(2)))


def test_runs_of_the_validation_are_predicted_as_they_are() -> None:
    late = run_of(FORWARD, "go", "later", split="validation")
    late.poses[-1] += [0.3, 0.4, 0.1]
    model = extended_of(RUNS, left(1, 1, 1, 1))
    _, held_out = compare_held_out(model, model, ValidationRuns((late,), (), ()), np.array([0, 1, 0, 1]))
    assert held_out.data == "session"
    assert held_out.position_m == pytest.approx((0.5, 0.5))
    assert held_out.heading_rad == pytest.approx((0.1, 0.1))
    assert held_out.chi2.before == pytest.approx((0.09 + 0.16 + 0.01) / 6)
