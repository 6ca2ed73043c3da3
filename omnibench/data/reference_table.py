"""The table references.parquet (or .csv) of a data set: a row for each measurement of a run's motion.

Columns: trajectory, kind, value and sigma of kinds of one number, value_x, value_y, sigma_x and sigma_y of those of two
(sigma stands for both where these are empty), t0 and t1, which may be missing or empty: the run's start and end;
sigma_rate (rad/s) of a gyro's offset, which the turns of a session share.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from omnibench.data.references import AT_ONE_TIME, NUMBERS, PLANAR, References, reference_flaw, references_of
from omnibench.data.tables.table import Table
from omnibench.robot.kinematics import Array

TABLE = "references"
REFERENCE_COLUMNS = ("trajectory", "kind")  # those that every such table has


def read_references(
    table: Table | None, wheel_times: Mapping[str, Array], started: Collection[str], runs_file: str
) -> dict[str, References]:
    """The references of each run that has some; none where there is no such table.

    wheel_times: ends of the wheel samples (F,) of each run, s. started: ids of the runs whose start pose is known.
    runs_file: the table that names the runs. DataError in one line names the file, the row and what is wrong.
    """
    if table is None:
        return {}
    owners, kinds = table.frame["trajectory"], table.frame["kind"]
    table.refuse(~owners.is_in(list(wheel_times)), lambda row: f"trajectory {owners[row]} is not in {runs_file}")
    numbers = {name: _column(table, name) for name in NUMBERS}
    texts = np.array(["" if kind is None else str(kind).strip() for kind in kinds], dtype=str)
    found: dict[str, References] = {}
    number = {run: index for index, run in enumerate(wheel_times)}
    codes = np.array([number[run] for run in owners], dtype=np.intp)
    counts = np.bincount(codes, minlength=len(number))
    of_runs = np.split(np.argsort(codes, kind="stable"), np.cumsum(counts)[:-1])
    for (run, times), rows in zip(wheel_times.items(), of_runs, strict=True):
        if not len(rows):
            continue
        chosen = {name: values[rows] for name, values in numbers.items()}
        references = references_of(texts[rows], chosen, start_known=run in started).of_run(0.0, float(times[-1]))
        if (flaw := reference_flaw(references, times)) is not None:
            raise table.fail(int(rows[flaw[0]]), flaw[1])
        found[run] = references.by_time()
    return found


def reference_frame(references: Sequence[tuple[str, References]]) -> pl.DataFrame:
    """The table of the references of some runs, given with their ids."""
    rows: list[dict[str, Any]] = []
    for run, of_run in references:
        for kind, t0, t1, value, sigma, gyro in zip(
            of_run.kinds.tolist(), of_run.t0, of_run.t1, of_run.values, of_run.sigmas, of_run.gyro, strict=True
        ):
            start = None if kind in AT_ONE_TIME and t0 == t1 else t0
            numbers = (
                {"value_x": value[0], "value_y": value[1], "sigma_x": sigma[0], "sigma_y": sigma[1]}
                if kind in PLANAR
                else {"value": value[0], "sigma": sigma[0]}
            )
            if gyro and of_run.rate_sigma:
                numbers["sigma_rate"] = of_run.rate_sigma
            rows.append({"trajectory": run, "t0": start, "t1": t1, "kind": kind} | numbers)
    schema = {"trajectory": pl.String, "t0": pl.Float64, "t1": pl.Float64, "kind": pl.String}
    frame = pl.DataFrame(rows, schema=schema | dict.fromkeys(NUMBERS[2:], pl.Float64))
    return frame.select(column for column in frame.iter_columns() if column.null_count() < len(frame))


def _column(table: Table, name: str) -> Array:
    """A column of numbers (rows,), NaN where a cell is empty or the column is missing."""
    if name not in table.frame.columns:
        return np.full(len(table.frame), np.nan)
    values = table.floats(name).fill_null(np.nan).to_numpy()
    if name in ("t0", "t1"):
        table.refuse(np.isinf(values), lambda row: f"{name} is {values[row]}; remove or repair the row")
    return values
