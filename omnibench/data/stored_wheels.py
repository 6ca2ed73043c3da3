"""The wheel samples of a data set's runs, left in their Parquet file."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from omnibench.data.run_checks import wheel_times_flaw
from omnibench.data.stored_rows import BLOCK_ROWS, BlockFile, StoredRows, file_state, read_rows, types_of
from omnibench.data.tables.table import (
    Table,
    WheelArrays,
    check_columns,
    check_steering,
    checked_table,
    no_rows,
    refuse_unknown,
    wheel_columns,
)
from omnibench.errors import DataError
from omnibench.progress import tell_reading
from omnibench.robot.kinematics import Robot

_ROWS = 1_000_000  # rows that are checked at a time, of which the names take 16 MB (chosen)


@dataclass(frozen=True)
class RunRows:
    """Rows of a run in its file: the first, their number, and the time of the last, s."""

    first: int
    count: int
    end: float


class WholeTableError(Exception):
    """A table must be read whole: the rows of a run do not stand together, or its numbers are texts."""


@dataclass(frozen=True, eq=False)
class StoredWheels:
    """A Parquet table of wheel samples, which is checked piece by piece and stays where it is."""

    file: Path

    def of_runs(self, runs: Table, robot: Robot) -> list[WheelArrays]:
        """The samples of each of the runs, which are read where they are used.

        DataError names the table, the row and what is wrong. WholeTableError: read the table whole.
        """
        file = self.file.absolute()  # workers, and jobs that change their folder, find it, too
        state, types = file_state(file), types_of(file)
        named = wheel_columns(robot)
        check_columns(self.file, list(types), ("trajectory", *named["times"], *named["rates"]))
        check_steering(self.file, list(types), robot)
        wanted = {name: each for name, each in named.items() if _all_there(self.file, each, types)}
        columns = [column for each in wanted.values() for column in each]
        if not all(types[column].is_numeric() for column in columns):
            raise WholeTableError
        rows = self._rows_of_runs(runs, columns)
        blocks = BlockFile(file, _block_edges(rows), state)
        together = [column for name in ("times", "rates", "steering") for column in wanted.get(name, ())]
        return [WheelArrays(**_arrays(blocks, wanted, together, of_run)) for of_run in rows]

    def _rows_of_runs(self, runs: Table, columns: Sequence[str]) -> list[RunRows]:
        """The rows of each run, whose values are checked. DataError, WholeTableError: see of_runs."""
        found: dict[str, RunRows] = {}
        known = runs.frame["trajectory"].to_list()
        last: str | None = None
        for table in self._pieces(columns):
            names, times = table.frame["trajectory"], table.numbers("t")
            for column in columns:
                table.numbers(column)
            refuse_unknown(runs, table, ~names.is_in(known))
            begins = np.flatnonzero(np.append(True, (names[1:] != names[:-1]).to_numpy()))
            for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), len(names)], strict=True):
                run = names[begin]
                before = found.get(run)
                if before is not None and run != last:
                    raise WholeTableError
                whole = times[begin:end] if before is None else np.append(before.end, times[begin:end])
                if (flaw := wheel_times_flaw(whole, run)) is not None:
                    raise table.fail(begin + flaw[0] - (before is not None), flaw[1])
                count = end - begin
                found[run] = (
                    RunRows(table.rows_before + begin, count, float(times[end - 1]))
                    if before is None
                    else RunRows(before.first, before.count + count, float(times[end - 1]))
                )
                last = run
        for index, run in enumerate(runs.frame["trajectory"]):
            if run not in found:
                raise no_rows(Table(self.file, pl.DataFrame()), runs, index)
        return [found[run] for run in runs.frame["trajectory"]]

    def _pieces(self, columns: Sequence[str]) -> Iterator[Table]:
        """The table in pieces."""
        first = 0
        while True:
            frame = read_rows(self.file, ["trajectory", *columns], first, _ROWS)
            if first and frame.is_empty():
                return
            tell_reading(len(frame), "sample")
            yield checked_table(self.file, frame, ("trajectory", *columns), first)
            if len(frame) < _ROWS:
                return
            first += len(frame)


def _all_there(file: Path, columns: Sequence[str], present: Collection[str]) -> bool:
    """True if the file has all of some columns, False if none. DataError: it has only some."""
    missing = [column for column in columns if column not in present]
    if 0 < len(missing) < len(columns):
        raise DataError(f"{file}: column {missing[0]!r} is missing; give all of {', '.join(columns)} or none")
    return not missing


def _arrays(blocks: BlockFile, wanted: dict[str, list[str]], together: Sequence[str], rows: RunRows) -> dict[str, Any]:
    """A run's arrays. Times, rates and steering, which odometry needs, are read together, the others by themselves."""
    arrays: dict[str, Any] = {}
    for name, columns in wanted.items():
        read = tuple(together) if columns[0] in together else tuple(columns)
        chosen = tuple(read.index(column) for column in columns)
        flat = name == "times"
        arrays[name] = StoredRows(blocks, read, chosen, rows.first, rows.count, flat, rows.end if flat else None)
    return arrays


def _block_edges(rows: Sequence[RunRows]) -> tuple[int, ...]:
    """First rows of blocks of whole runs, and the end of the last."""
    edges = [0]
    ends = sorted(of_run.first + of_run.count for of_run in rows)
    for end, after in zip(ends, [*ends[1:], None], strict=True):
        if after is None or after - edges[-1] > BLOCK_ROWS:
            edges.append(end)
    return tuple(edges)
