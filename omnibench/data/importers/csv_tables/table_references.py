"""Distances, turns, positions and the like in a table: a row for each, with its kind, value and standard deviation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omnibench.data.delimited import CellTable
from omnibench.data.importers.csv_tables.csv_options import CsvOptions
from omnibench.data.importers.csv_tables.table_files import load
from omnibench.data.importers.csv_tables.table_rows import Rows, rows_by_run
from omnibench.data.importers.runs.reference_options import SECONDS
from omnibench.data.references.reference_columns import NUMBERS, references_of
from omnibench.data.references.reference_flaws import measurement_flaw
from omnibench.data.references.run_references import KINDS, References
from omnibench.errors import DataError, nearest
from omnibench.words import some

_KIND = "kind"


@dataclass(frozen=True, eq=False)
class ReferenceRows:
    """A table of references and its rows of each run; {None: None} where it is of one run."""

    table: CellTable
    rows: Mapping[str | None, Rows | None]

    def of(self, run: str, options: CsvOptions, *, shared: bool) -> References | None:
        """The references of a run; None if it has none. shared: as for ``read_measured``."""
        if None in self.rows:
            return read_measured(self.table, options, shared=shared)
        rows = self.rows.get(run)
        return None if rows is None else read_measured(self.table.only(rows), options, shared=shared)

    def check_of_several(self) -> None:
        """DataError: the table does not say of which of several runs a row is."""
        if None in self.rows:
            found = ", ".join(self.table.names)
            raise DataError(
                f"{self.table.file}: column 'run' is missing, which says of which run a row is; found: {found}; --set "
                "run_column=NAME"
            )

    def check_names(self, runs: Sequence[str]) -> None:
        """DataError: the table has references of a run that there is not."""
        for name in self.rows:
            if name is not None and name not in runs:
                hint = nearest(name, runs)
                raise DataError(f"{self.table.file}: run {name!r} has no wheels; {hint}runs: {some(runs)}")


def reference_rows(files: Sequence[Path | None], options: CsvOptions) -> dict[Path, ReferenceRows]:
    """The tables of references of some recordings, each read once. DataError: one of several does not name the run."""
    measured = {}
    as_tables = options.model_copy(update={"header_lines": 1, "separator": None})
    for file in dict.fromkeys(filter(None, files)):
        table = load(file, as_tables).in_lower_case()
        measured[file] = ReferenceRows(table, rows_by_run(table, options))
        if files.count(file) > 1:
            measured[file].check_of_several()
    return measured


def read_measured(table: CellTable, options: CsvOptions, *, shared: bool) -> References:
    """The references in the rows of a run, in the units of the table, by the clock of its poses.

    shared: that clock is the wheels' unless it is said. A heading with t0 = 0 counts from the run's start. DataError
    names the row of what is wrong.
    """
    if table.missing([_KIND]):
        found = ", ".join(filter(None, table.names))
        raise DataError(
            f"{table.file}: column 'kind' is missing; found: {found}; each row needs its kind ({', '.join(KINDS)}), "
            "value and sigma (omnibench guide references)"
        )
    kinds = np.array([kind.lower() for kind in table.texts(_KIND)], dtype=str)
    there = {name for name in NUMBERS if not table.missing([name])}
    numbers = {name: table.numbers([name])[:, 0] if name in there else np.full(len(table), np.nan) for name in NUMBERS}
    for name in ("t0", "t1"):
        for row in np.flatnonzero(np.isinf(numbers[name]))[:1].tolist():
            raise table.fail(row, f"{name} is {numbers[name][row]}; remove or repair the row")
    from_start = (kinds == "heading") & (numbers["t0"] == 0)
    unit = options.pose_time_unit or (options.wheel_time_unit if shared else "s")
    numbers |= {name: numbers[name] * SECONDS[unit] for name in ("t0", "t1")}
    numbers["t0"][from_start] = -np.inf
    references = references_of(kinds, numbers)
    if (flaw := measurement_flaw(references)) is not None:
        raise table.fail(flaw[0], flaw[1])
    return references
