"""Ranks, critical differences and performance profiles."""

from __future__ import annotations

import numpy as np
import pytest

from omnibench.study.cells import MEASURES, CellKey, MethodInCell, Pairs, StudyCell
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
