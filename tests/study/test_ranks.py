"""Intervals of ratios of errors, ranks, critical differences and performance profiles."""

from __future__ import annotations

import numpy as np
import pytest

from omnibench.study.cells import MEASURES, CellKey, MethodInCell, Pairs, StudyCell, cell_ratio
from omnibench.study.study_result import profiles, ranking


def cell(**errors: float | None) -> StudyCell:
    """A cell in which each method has one error; None: no answer."""

    def of(value: float) -> dict[str, np.ndarray]:
        return dict.fromkeys(MEASURES, np.array([value]))

    methods = {
        name: MethodInCell(
            name, "other", 1, {}, "", None if value is None else of(value), 0.0, "", int(value is not None)
        )
        for name, value in errors.items()
    }
    pairs = Pairs(np.zeros(1, dtype=int), np.zeros(1, dtype=int), (None,), (None,))
    return StudyCell(CellKey("robot", "a", "as recorded", "b", False), pairs, of(1.0), methods)  # type: ignore[arg-type]


def test_the_critical_difference_is_that_of_demsars_tables() -> None:
    """Demsar 2006: q is 2.343 for three methods, so CD = 2.343 sqrt(3 * 4 / (6 * 10)) for ten data sets."""
    ranked = ranking([cell(a=1.0, b=2.0, c=3.0)] * 10, ("a", "b", "c"))
    assert ranked is not None
    assert ranked.critical_difference == pytest.approx(2.343 * np.sqrt(12 / 60), rel=1e-3)
    assert ranked.methods == ("a", "b", "c")
    assert ranked.ranks == pytest.approx([1.0, 2.0, 3.0])
    assert ranked.groups == ((0, 1), (1, 2))


def test_a_method_without_an_answer_in_one_cell_has_no_rank_but_a_profile() -> None:
    cells = [cell(a=1.0, b=2.0, c=4.0, d=None), cell(a=2.0, b=1.0, c=4.0, d=0.5)]
    ranked = ranking(cells, ("a", "b", "c", "d"))
    assert ranked is not None
    assert set(ranked.methods) == {"a", "b", "c"}
    shares = {
        each.method: (each.share(1.0), each.share(2.0), each.share(100.0)) for each in profiles(cells, ("a", "d"))
    }
    assert shares == {"a": (0.5, 0.5, 1.0), "d": (0.5, 0.5, 0.5)}


def test_two_methods_have_no_ranks() -> None:
    assert ranking([cell(a=1.0, b=2.0)] * 5, ("a", "b")) is None


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
