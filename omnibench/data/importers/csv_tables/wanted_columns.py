"""The columns that are wanted of tables, and the ones of a table that they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from omnibench.data.delimited import CellTable, ColumnError, missing_column
from omnibench.data.importers.csv_tables.csv_options import HEADINGS, PREFIXES, RUNS, TIMES, CsvOptions


@dataclass(frozen=True)
class Wanted:
    """A column that is wanted: its key in the option ``columns``, and the names that it may have, the first first."""

    key: str
    names: tuple[str, ...]

    def found(self, table: CellTable) -> str | None:
        """The name that it has in a table, in any case of letters; None if it is not there."""
        for name in self.names:
            if not table.missing([name]):
                return name
        lower = {name.lower(): name for name in reversed(table.names)}
        return next((lower[name.lower()] for name in self.names if name.lower() in lower), None)


@dataclass(frozen=True)
class WantedColumns:
    """The columns that a stream needs: its time, then its values. what: wheels or poses."""

    what: str
    time: Wanted
    values: tuple[Wanted, ...]

    @property
    def all(self) -> tuple[Wanted, ...]:
        """Time and values."""
        return (self.time, *self.values)

    def missing(self, table: CellTable) -> list[Wanted]:
        """The columns that a table does not have."""
        return [wanted for wanted in self.all if wanted.found(table) is None]

    def names(self, table: CellTable) -> tuple[str, list[str]]:
        """The names of time and values in a table that has them all."""
        found = [wanted.found(table) or wanted.names[0] for wanted in self.all]
        return found[0], found[1:]


def wheel_columns(options: CsvOptions) -> WantedColumns:
    """The columns of the wheels, and of the steering angles where the robot steers."""
    wheels = _each(options, options.prefix, options.robot.wheel_names, options.wheel_columns, bare=True)
    steering = _each(options, "steer_", options.robot.drive.steered, options.steering_columns, bare=False)
    return WantedColumns("wheels", _time(options), (*wheels, *steering))


def pose_columns(options: CsvOptions, *, shared: bool) -> WantedColumns:
    """The columns of the poses. shared: wheels stand in the same table, whose time is theirs unless it is said."""
    given = options.pose_time_column or options.columns.get("pose_t")
    wheels = _time(options)
    alike = tuple(dict.fromkeys((*wheels.names, *TIMES)))
    time = Wanted("pose_t", (given,)) if given else wheels if shared else Wanted("pose_t", alike)
    keys = ("x", "y", "theta")
    values = []
    for index, (key, names) in enumerate(zip(keys, (("x",), ("y",), HEADINGS), strict=True)):
        said = options.columns.get(key) or (options.pose_columns[index] if options.pose_columns else None)
        values.append(Wanted(key, (said,) if said else names))
    return WantedColumns("poses", time, tuple(values))


def run_column(options: CsvOptions, table: CellTable) -> str | None:
    """The column that names the run of a row; None without one. DataError: it has not the one that the options name."""
    given = options.run_column or options.columns.get("run")
    found = Wanted("run", (given, *RUNS) if given else RUNS).found(table)
    if given and found is None:
        raise ColumnError(f"{missing_column(table.file, given, table.names)}; --set run_column=NAME")
    return found


def _time(options: CsvOptions) -> Wanted:
    given = options.wheel_time_column or options.columns.get("t")
    return Wanted("t", (given,) if given else TIMES)


def _each(options: CsvOptions, prefix: str, wheels: Sequence[str], given: Sequence[str], *, bare: bool) -> list[Wanted]:
    """The columns of some wheels. bare: wheels' names are some, too, and those of other units where one is said."""
    others = tuple(other for other in PREFIXES if other != prefix) if bare else ()
    wanted = []
    for index, wheel in enumerate(wheels):
        key = f"{prefix}{wheel}"
        keys = (key, wheel, *(f"{other}{wheel}" for other in others)) if bare else (key,)
        said = next((options.columns[each] for each in keys if each in options.columns), None)
        said = said or (given[index] if given else None)
        found = keys if "wheel_unit" in options.model_fields_set else keys[:2]
        wanted.append(Wanted(key, (said,) if said else found))
    return wanted
