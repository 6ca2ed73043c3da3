"""Intervals of ratios of errors, by sessions and by runs."""

from __future__ import annotations

import numpy as np
import pytest

from omnibench.study.cells import Pairs, cell_ratio


def pairs(sessions: int, runs_each: int, folds: int = 1, trained: bool = False) -> Pairs:
    """Each of ``folds`` calibrations judged on all runs of all sessions; trained: the folds are other sessions."""
    runs = np.tile(np.arange(sessions * runs_each), folds)
    of_fold = np.repeat(np.arange(folds), sessions * runs_each)
    return Pairs(
        of_fold,
        runs,
        tuple(f"trained {fold}" if trained else None for fold in of_fold),
        tuple(f"judged {run // runs_each}" for run in runs),
    )


def test_intervals_hold_the_true_ratio_as_often_as_they_say() -> None:
    rng = np.random.default_rng(5)
    judged, trained, held = 8, 6, 0
    cell = pairs(judged, 4, trained, trained=True)
    day, fold = np.unique(cell.judged_in, return_inverse=True)[1], cell.folds
    studies = 400
    for _ in range(studies):
        base = np.exp(rng.normal(0.0, 0.3, judged))[day]
        effect = rng.normal(0.0, 0.2, judged)[day] + rng.normal(0.0, 0.2, trained)[fold]
        errors = 0.8 * base * np.exp(effect - 0.04) * np.exp(rng.normal(0.0, 0.1, len(base)))
        held += cell_ratio(errors, base, cell, 1).alone.holds(0.8 * np.exp(0.005))
    assert 0.92 <= held / studies <= 0.99


def test_a_family_of_cells_has_wider_intervals() -> None:
    rng = np.random.default_rng(1)
    cell = pairs(6, 3)
    errors, others = rng.uniform(0.5, 1.5, 18), rng.uniform(0.5, 1.5, 18)
    ratio = cell_ratio(errors, others, cell, 30)
    assert ratio.alone.known is not None
    assert ratio.in_family.known is not None
    assert ratio.in_family.known[0] < ratio.alone.known[0] < ratio.value < ratio.alone.known[1]


def test_two_sessions_give_an_interval_by_runs() -> None:
    rng = np.random.default_rng(1)
    ratio = cell_ratio(rng.uniform(0.5, 1.5, 20), rng.uniform(0.5, 1.5, 20), pairs(2, 10), 1)
    assert (ratio.unit, ratio.units) == ("run", "20 runs")


def test_two_runs_give_no_interval() -> None:
    ratio = cell_ratio(np.array([1.0, 2.0]), np.array([2.0, 3.0]), pairs(1, 2), 1)
    assert ratio.alone.known is None
    assert ratio.verdict == "undecided"


def test_equal_errors_are_no_difference() -> None:
    errors = np.linspace(1.0, 2.0, 12)
    ratio = cell_ratio(errors, errors, pairs(4, 3), 5)
    assert ratio.alone.known == (1.0, 1.0)
    assert ratio.verdict == "undecided"


@pytest.mark.parametrize(("share", "verdict"), [(0.5, "better"), (2.0, "worse")])
def test_a_clear_difference_is_told_whatever_the_sessions_scale(share: float, verdict: str) -> None:
    others = np.repeat([1.0, 10.0, 0.1, 4.0], 5)
    rng = np.random.default_rng(2)
    assert cell_ratio(share * others * rng.uniform(0.98, 1.02, 20), others, pairs(4, 5), 10).verdict == verdict
