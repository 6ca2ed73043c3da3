"""The table of runs: the command, repetition, split and session of each."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omnibench.data.dataset import SPLITS, Split
from omnibench.data.delimited import row_error
from omnibench.data.importers.csv_tables.csv_options import CsvOptions
from omnibench.data.importers.csv_tables.table_files import RUN_TABLES, file_called, load
from omnibench.data.importers.csv_tables.wanted_columns import run_column
from omnibench.errors import DataError, nearest

_TEXTS, _NUMBERS = ("command", "split", "session"), ("repetition", "started_at")


@dataclass(frozen=True)
class RunAttributes:
    """What a table of runs says of one; None where it says nothing."""

    command: str | None = None
    repetition: int | None = None
    split: Split | None = None
    session: str | None = None
    started_at: float | None = None


def read_run_attributes(source: Path, options: CsvOptions, warnings: list[str]) -> dict[str, RunAttributes]:
    """The attributes of each run by its name; empty without a table of runs. DataError names the row of a flaw."""
    file = options.runs_table or _beside(source)
    if file is None:
        return {}
    table = load(file, options).in_lower_case()
    named = run_column(options, table)
    if named is None:
        raise DataError(f"{file}: column 'run' is missing; found: {', '.join(table.names)}; --set run_column=NAME")
    known = [key for key in (*_TEXTS, *_NUMBERS) if key not in table.names]
    others = [name for name in table.names if name not in (named, *_TEXTS, *_NUMBERS)]
    alike = {name: hint.strip() for name in others if (hint := nearest(name, known))}
    warnings.extend(f"{file}: column {name!r} is not read; {hint}" for name, hint in alike.items())
    texts = {key: table.texts(key) for key in _TEXTS if key in table.names}
    numbers = {key: table.numbers([key])[:, 0] for key in _NUMBERS if key in table.names}
    attributes: dict[str, RunAttributes] = {}
    for row, run in enumerate(table.texts(named)):
        split = texts["split"][row] if "split" in texts else None
        if split is not None and split not in SPLITS:
            what = f"split is {split!r}; {nearest(split, SPLITS)}it must be train or validation"
            raise row_error(file, row, int(table.lines[row]), what)
        if run in attributes:
            raise row_error(file, row, int(table.lines[row]), f"run {run!r} is there twice")
        repetition, started_at = (_number(numbers.get(key), row) for key in _NUMBERS)
        attributes[run] = RunAttributes(
            command=texts["command"][row] or None if "command" in texts else None,
            repetition=None if repetition is None else round(repetition),
            split=split,
            session=texts["session"][row] or None if "session" in texts else None,
            started_at=started_at,
        )
    return attributes


def check_names(attributes: Collection[str], runs: Collection[str], warnings: list[str]) -> None:
    """Check that a table of runs lists the runs that there are. DataError names one that is missing."""
    if not attributes:
        return
    for run in runs:
        if run not in attributes:
            raise DataError(
                f"the table of runs does not list run {run!r}; {nearest(run, attributes)}it has: "
                f"{', '.join(list(attributes)[:12])}"
            )
    extra = [run for run in attributes if run not in runs]
    if extra:
        warnings.append(f"the table of runs lists runs that have no samples: {', '.join(extra[:12])}")


def _beside(source: Path) -> Path | None:
    return file_called(source if source.is_dir() else source.parent, RUN_TABLES, other_than=source)


def _number(numbers: np.ndarray | None, row: int) -> float | None:
    return None if numbers is None or np.isnan(numbers[row]) else float(numbers[row])
