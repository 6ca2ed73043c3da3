"""The rows of a table that belong to each run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnibench.data.delimited import CellTable
from omnibench.data.importers.csv_tables.csv_options import CsvOptions
from omnibench.data.importers.csv_tables.wanted_columns import run_column

Rows = NDArray[np.intp]


def rows_by_run(table: CellTable | None, options: CsvOptions) -> dict[str | None, Rows | None]:
    """The rows of each run that a column names; {None: None} for a table of one run."""
    column = None if table is None else run_column(options, table)
    if table is None or column is None:
        return {None: None}
    rows: dict[str | None, list[int]] = {}
    for row, run in enumerate(table.texts(column)):
        rows.setdefault(run, []).append(row)
    if "" in rows:
        raise table.fail(rows[""][0], f"{column} is missing; name the run of every row")
    return {run: np.array(of_run) for run, of_run in rows.items()}
