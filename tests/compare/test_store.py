"""The file of a run gives back what was put into it."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omnibench.errors import DataError
from omnibench.fit.calibrator import Outcome, RunResult
from omnibench.fit.problem import Improvement
from omnibench.jobs.job import ResultStore

FINITE = st.floats(allow_nan=False, allow_infinity=False)
WORDS = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), max_size=20)
ANSWERS = st.lists(FINITE, min_size=9, max_size=9).map(np.array)


@settings(max_examples=40)
@given(
    outcome=st.sampled_from(Outcome),
    reason=WORDS,
    vector=st.none() | ANSWERS,
    history=st.lists(st.tuples(st.integers(1, 10**9), FINITE, FINITE), max_size=4),
    at_bounds=st.lists(WORDS, max_size=3),
)
def test_a_result_comes_back_to_the_last_bit(
    outcome: Outcome,
    reason: str,
    vector: np.ndarray | None,
    history: list[tuple[int, float, float]],
    at_bounds: list[str],
) -> None:
    matrix = None if vector is None else vector.reshape(3, 3)
    cost = None if vector is None else float(vector[0])
    steps = tuple(Improvement(*step) for step in history)
    put = RunResult(outcome, reason, vector, matrix, cost, 17, 0.1, steps, tuple(at_bounds), ("m12",))
    with tempfile.TemporaryDirectory() as folder:
        ResultStore(Path(folder), RunResult).put("key", put)
        got = ResultStore(Path(folder), RunResult).get("key")
    assert got is not None
    for name in ("outcome", "reason", "cost", "evaluations", "seconds", "history", "at_bounds", "held"):
        assert getattr(got, name) == getattr(put, name)
    for name in ("vector", "matrix"):
        before, after = getattr(put, name), getattr(got, name)
        assert (before is None and after is None) or np.array_equal(before, after)


def test_a_run_that_is_not_there_is_none(tmp_path: Path) -> None:
    assert ResultStore(tmp_path / "runs", RunResult).get("key") is None


@pytest.mark.parametrize(
    ("freedom", "stored"), [("33", 33.0), ("null", None), (None, None), ("[8.5, 9.0]", [8.5, 9.0])]
)
def test_results_are_read_whether_they_hold_one_number_of_degrees_of_freedom_several_or_none(
    freedom: str | None, stored: float | list[float] | None, tmp_path: Path
) -> None:
    store = ResultStore(tmp_path, RunResult)
    store.put("key", RunResult(Outcome.TIME, "", None, None, None, 0, 0.0, ()))
    fields = json.loads(store.file("key").read_text())
    del fields["degrees_of_freedom"]
    if freedom is not None:
        fields["degrees_of_freedom"] = json.loads(freedom)
    store.file("key").write_text(json.dumps(fields))
    result = store.get("key")
    assert result is not None
    assert (None if result.degrees_of_freedom is None else result.degrees_of_freedom.tolist()) == stored


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("a file")
    with pytest.raises(DataError, match=r"runs/key\.json: cannot be written: .*runs is not a folder"):
        ResultStore(tmp_path / "runs", RunResult).put("key", RunResult(Outcome.TIME, "", None, None, None, 0, 0.0, ()))
