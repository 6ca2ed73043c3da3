"""Results as files: arrays to the last bit, refusals, and the keys of their content."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from job_samples import Answer

from omnibench.jobs.job import ResultStore, content_key
from omnibench.robot.kinematics import JsonArray


@dataclass(frozen=True, eq=False)
class Table:
    """A result with arrays."""

    values: JsonArray
    empty: JsonArray | None = None


class TestStore:
    def test_gives_arrays_back_to_the_last_bit(self, tmp_path: Path) -> None:
        values = np.random.default_rng(5).normal(size=(4, 3, 3)) * 10.0 ** np.arange(-150, 150, 100)
        values[0, 0] = [np.nan, np.inf, -0.0]
        store = ResultStore(tmp_path, Table)
        store.put("key", Table(values))
        table = store.get("key")
        assert table is not None
        assert table.values.tobytes() == values.tobytes()
        assert table.empty is None

    def test_refuses_what_it_could_not_give_back(self, tmp_path: Path) -> None:
        store = ResultStore(tmp_path, Answer)
        three: Any = "three"  # on purpose not the whole number that an answer takes
        with pytest.raises(ValueError, match="number"):
            store.put("key", Answer(three))
        assert list(tmp_path.iterdir()) == []

    def test_removes_its_files_and_no_others(self, tmp_path: Path) -> None:
        store = ResultStore(tmp_path / "results", Answer)
        store.put("key", Answer(1))
        (tmp_path / "results" / "notes.txt").touch()
        store.remove()
        assert [file.name for file in (tmp_path / "results").iterdir()] == ["notes.txt"]

    def test_a_key_changes_with_every_bit_of_what_it_is_made_of(self) -> None:
        values = np.arange(6.0)
        keys = [
            content_key({"table": Table(values), "number": 1}),
            content_key({"table": Table(np.nextafter(values, 9.0)), "number": 1}),
            content_key({"table": Table(values.reshape(2, 3)), "number": 1}),
            content_key({"table": Table(values, values), "number": 1}),
            content_key({"table": Table(values), "number": 2}),
        ]
        assert len(set(keys)) == len(keys)
        assert keys[0] == content_key({"number": 1, "table": Table(values.copy())})
