"""The rows of a table that belong to each run of a data set."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from omnibench.data.run_checks import Flaw
from omnibench.data.tables.table import Table
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

Rows = np.ndarray[Any, np.dtype[np.intp]]  # indices of rows of a table


def rows_by_trajectory(runs: Table, table: Table, others: Collection[str] = ()) -> list[Rows]:
    """The rows of ``table`` that belong to each run, in the file's order; a run among the others may have none."""
    ids = runs.frame["trajectory"].to_list()
    number = {identity: index for index, identity in enumerate(ids)}
    codes = np.array([number.get(identity, -1) for identity in table.frame["trajectory"]])
    refuse_unknown(runs, table, codes < 0)
    order = np.argsort(codes, kind="stable")
    counts = np.bincount(codes, minlength=len(ids))
    for index, count in enumerate(counts):
        if count == 0 and ids[index] not in others:
            raise no_rows(table, runs, index)
    return np.split(order, np.cumsum(counts)[:-1])


def refuse_unknown(runs: Table, table: Table, unknown: NDArray[np.bool_] | pl.Series) -> None:
    """DataError for the first row of ``table`` whose run is ``unknown`` (rows,): not in the table of runs."""
    names = table.frame["trajectory"]
    table.refuse(unknown, lambda row: f"trajectory {names[row]} is not in {runs.file.name}")


def no_rows(table: Table, runs: Table, index: int) -> DataError:
    """The error of a run, by its row in the table of runs, that has no rows in another table."""
    what = "wheel samples" if table.file.stem == "wheels" else "reference poses"
    run = runs.frame["trajectory"][index]
    return DataError(f"{table.file}: trajectory {run} ({runs.file.name}, row {index + 1}) has no {what}")


def check_times(table: Table, groups: Sequence[Rows], find_flaw: Callable[[Array, str], Flaw | None]) -> None:
    """DataError for the first run whose times in ``table`` have a flaw. groups: the rows of each run."""
    times = table.numbers("t")
    for rows in groups:
        if (flaw := find_flaw(times[rows], table.frame["trajectory"][int(rows[0])])) is not None:
            raise table.fail(int(rows[flaw[0]]), flaw[1])
