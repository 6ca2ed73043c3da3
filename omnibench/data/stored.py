"""Tables of a data set, whose every flaw is refused with its file and row, and the wheel samples of its runs.

Of a data set larger than memory the samples stay in their Parquet file, and are read in blocks of rows whenever an
array of a run is asked for. The last few blocks stay in memory, so that code which takes one run after another reads
every block once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

from omnibench.config import LONGEST_NAME
from omnibench.data.delimited import Lines, missing_column, not_increasing
from omnibench.data.parquet import OpenedTable, parquet_shape, readable, scan_table
from omnibench.errors import DataError, nearest
from omnibench.files import MOST_TEXT, check_file, unquoted_formulas
from omnibench.progress import tell_reading
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Samples

Rows = NDArray[np.intp]  # indices of rows of a table
Flaw = tuple[int, str]  # row (0 is the first) of an array, and what is wrong there
TimesFlaw = Callable[[Array, str], Flaw | None]  # the flaw in the times (n,) of a run, and its id

LARGEST = 1e9  # a larger number is no measurement in SI units

MOST_IN_MEMORY = 5_000_000  # wheel samples that are held: 200 MB of three wheels' (chosen)
MOST_DRAWN = 3_000_000  # wheel samples by which a recording is judged: 500 runs of a minute at 100 Hz (chosen)
_ROWS = 1_000_000  # rows that are checked at a time, of which the names take 16 MB (chosen)
_BLOCK_ROWS = 500_000  # rows of a block: 16 MB of four columns (chosen)
_BLOCKS_HELD = 3  # blocks in memory, those of all files together, beside one that is being read (chosen)
_POSE = 4  # samples as which a reference pose counts when runs are drawn, by the memory that a fit takes (chosen)
_FEWEST = 20  # runs that are drawn at least (chosen)
_OF_EACH = 2  # runs of every command and session that are drawn before others (chosen): a rare one is not missed

# Columns of the arrays of a run's reference, and of its motion commands; those that every table but the wheels' has.
POSES = {"poses": ["x", "y", "theta"]}
COVARIANCES = {"pose_covariances": [f"cov_{name}" for name in ("xx", "xy", "xtheta", "yy", "ytheta", "thetatheta")]}
SENT = {"sent": ["t", "v", "alpha", "omega", "t_r"]}
REQUIRED = {
    "trajectories": ["trajectory", "split"],
    "poses": ["trajectory", "t", *POSES["poses"]],
    "references": ["trajectory", "kind"],
    "commands": ["trajectory", *SENT["sent"]],
}
# Names may consist of digits: 007 is not 7.
_TEXTS = dict.fromkeys(("trajectory", "command", "split", "session"), pl.String)
_OF_ODOMETRY = ("times", "rates", "steering")  # arrays that are read at once


def times_flaw(times: Array, wrong: NDArray[np.bool_] | tuple[()] = (), why: str = "") -> Flaw | None:
    """The first time (n,) that is ``wrong`` (n,), and why, or else not after the one before; None if all are right."""
    for row in np.flatnonzero(wrong)[:1]:
        return int(row), f"t is {times[row]:g}; {why}"
    flaw = not_increasing(times)
    return None if flaw is None else (flaw[0], f"t {flaw[1]}")


def wheel_times_flaw(times: Array, _: str) -> Flaw | None:
    """The flaw in the ends of a run's wheel samples (F,), s; None if there is none."""
    return times_flaw(times, times <= 0, "wheel samples start after t = 0 (a row holds the rate up to its t)")


def pose_times_flaw(times: Array, run: str, *, fewest: int = 1) -> Flaw | None:
    """The flaw in the times of a run's reference poses (K,), s; None if there is none. run: its id.

    fewest: 2 for runs on disk, from whose start alone nothing could be learnt.
    """
    flaw = times_flaw(times, times < 0, "it must not be negative")
    if flaw is None and times[0] != 0:
        return 0, f"trajectory {run} has no reference pose at t = 0, its start pose"
    if flaw is None and len(times) < fewest:
        return 0, f"trajectory {run} has no reference pose after its start"
    return flaw


def values_flaw(values: Array, holds: str = "it holds", way: str = "check the units") -> Flaw | None:
    """The first row of values (rows, ...) with one that is not finite or that no robot can reach; None if all are.

    holds, way: words for the row and its value, and what to do.
    """
    if (np.abs(values) <= LARGEST).all():
        return None
    rows = values.reshape(len(values), -1)
    for row in np.flatnonzero(~np.isfinite(rows).all(axis=1))[:1]:
        return int(row), f"{holds} {rows[row][~np.isfinite(rows[row])][0]}; remove or repair the row"
    row = int(np.flatnonzero((np.abs(rows) > LARGEST).any(axis=1))[0])
    return row, f"{holds} {rows[row][np.abs(rows[row]).argmax()]:g}, which no robot can reach; {way}"


def refuse(file: Path, rows: Lines, faulty: Any, what: str, values: Sequence[Any] | pl.Series = ()) -> None:
    """DataError for the first of some rows of a file, from 0, that is ``faulty`` (n,).

    what: with ``{}`` for the row's one of the values (n,).
    """
    for index in np.flatnonzero(faulty)[:1].tolist():
        raise DataError(f"{file}, row {rows[index] + 1}: {what.format(values[index]) if len(values) else what}")


class Table:
    """A table with a column of the trajectories' names. Rows of messages count from 1, the first after the header.

    file: where it is from; of a table in memory its name in messages. first: row of the file, from 0, that the frame
    begins with. DataError: no rows, a required column or a trajectory's name is missing, a name is none.
    """

    def __init__(self, file: Path, frame: pl.DataFrame, required: Sequence[str] = ("trajectory",), first: int = 0):
        self.file, self.frame, self.first = file, frame, first
        check_columns(file, frame.columns, required)
        if frame.is_empty():
            raise DataError(f"{file}: it has no rows")
        ids = frame["trajectory"]
        if ids.dtype.is_nested():
            raise DataError(f"{file}: column 'trajectory' holds {ids.dtype}, expected names or numbers")
        self.refuse(ids.is_null(), "trajectory is missing")
        self.frame = frame.with_columns(ids.cast(pl.String))
        for column in _TEXTS:
            if column in frame.columns and (names := self.frame[column]).dtype == pl.String:
                what = f"{column} has more than {LONGEST_NAME} characters; shorten it"
                self.refuse(names.str.len_chars() > LONGEST_NAME, what)

    @property
    def ids(self) -> list[str]:
        """The trajectory of each row."""
        return self.frame["trajectory"].to_list()

    def fail(self, row: int, what: str) -> DataError:
        """The error to raise for ``row``, counted from 0."""
        return DataError(f"{self.file}, row {self.first + row + 1}: {what}")

    def refuse(self, faulty: NDArray[np.bool_] | pl.Series, what: str, values: Sequence[Any] | pl.Series = ()) -> None:
        """DataError for the first row that is ``faulty`` (rows,), as ``refuse`` says it."""
        refuse(self.file, range(self.first, self.first + len(self.frame)), faulty, what, values)

    def floats(self, column: str) -> pl.Series:
        """A column as floats, null where a cell is empty. DataError for text and other things."""
        series = self.frame[column]
        if series.dtype != pl.String:
            if not series.dtype.is_numeric() and series.null_count() < len(series):
                raise DataError(f"{self.file}: column {column!r} holds {series.dtype}, expected numbers")
            return series.cast(pl.Float64)
        values = series.str.strip_chars().cast(pl.Float64, strict=False)  # one odd cell makes a CSV column text
        self.refuse(values.is_null() & series.is_not_null(), f"{column} is {{!r}}, expected a number", series)
        return values

    def numbers(self, column: str) -> Array:
        """A column as floats (rows,). DataError: a value is missing, not finite, or none that a robot can reach."""
        series = self.floats(column)
        self.refuse(series.is_null(), f"{column} is missing; remove or repair the row")
        values: Array = series.to_numpy()
        way = "count the time from the start of its run" if column == "t" else "check the units"
        if (flaw := values_flaw(values, f"{column} is", way)) is not None:
            raise self.fail(*flaw)
        return values

    def stack(self, columns: Sequence[str]) -> Array:
        """Columns of numbers as (rows, n)."""
        return np.column_stack([self.numbers(column) for column in columns])

    def rows_by_run(self, ids: Sequence[str], where: str) -> Iterator[tuple[int, Rows]]:
        """The rows of each run that has some, and its index in ``ids``; in the file's order, mixed as they may be.

        DataError: a row is of none of them. where: they stand, in words.
        """
        runs = self.frame["trajectory"].rle().struct
        number = {identity: index for index, identity in enumerate(ids)}
        of_parts = [number.get(identity, -1) for identity in runs.field("value")]
        codes = np.repeat(of_parts, runs.field("len").to_numpy())
        for row in np.flatnonzero(codes < 0)[:1].tolist():
            name = self.frame["trajectory"][row]
            raise self.fail(row, f"trajectory {name} is not in {where}; {nearest(name, ids)}".rstrip("; "))
        order = np.argsort(codes, kind="stable")
        present, firsts = np.unique(codes[order], return_index=True)
        return zip(present.tolist(), np.split(order, firsts[1:]), strict=True)


def check_columns(file: Path, columns: Sequence[str], required: Sequence[str]) -> None:
    """DataError names the required columns that are not among those of a file."""
    if missing := [column for column in required if column not in columns]:
        raise missing_column(file, missing[0], columns, missing[1:])


def present_groups(file: Path, groups: Mapping[str, list[str]], columns: Collection[str]) -> dict[str, list[str]]:
    """The groups whose columns are there. DataError: only some of a group's are."""
    present = {}
    for name, group in groups.items():
        missing = [column for column in group if column not in columns]
        if 0 < len(missing) < len(group):
            raise DataError(f"{file}: column {missing[0]!r} is missing; give all of {', '.join(group)} or none")
        if not missing:
            present[name] = group
    return present


def arrays_by_run(
    pieces: Iterable[Table], runs: Table, groups: Mapping[str, list[str]], flaw: TimesFlaw
) -> Iterator[tuple[int, Rows, dict[str, Array]]]:
    """Arrays of the runs in the pieces of a table one after another: index of the run, its rows, its arrays by name.

    The array ``times`` (F,) is column t, the others (F, n) are groups of columns. flaw: what is wrong with the times of
    a run, in a further piece with the last time of the piece before. DataError names the row and what is wrong.
    """
    ids, ends = runs.ids, dict[int, Array]()
    for table in pieces:
        values = {"times": table.numbers("t")} | {name: table.stack(columns) for name, columns in groups.items()}
        for index, rows in table.rows_by_run(ids, runs.file.name):
            times, before = values["times"][rows], ends.get(index, np.zeros(0))
            if (wrong := flaw(np.append(before, times), ids[index])) is not None:
                raise table.fail(int(rows[wrong[0] - len(before)]), wrong[1])
            ends[index] = times[-1:]
            yield index, table.first + rows, {name: array[rows] for name, array in values.items()}


def arrays_of_runs(
    table: Table | None, runs: Table, groups: Mapping[str, list[str]], flaw: TimesFlaw, without: Collection[str] = ()
) -> list[dict[str, Array]]:
    """The arrays of each run in a table, if there is one. without: ids of runs that may have no rows in it."""
    arrays = {index: of_run for index, _, of_run in arrays_by_run([table] if table else [], runs, groups, flaw)}
    require_rows(table.file if table else None, runs, arrays, without)
    return [arrays.get(index, {}) for index in range(len(runs.frame))]


def require_rows(file: Path | None, runs: Table, present: Collection[int], without: Collection[str] = ()) -> None:
    """DataError: a run, by its index not among those present, has no rows in a file, and is not in ``without``."""
    for index, run in enumerate(runs.ids):
        if index not in present and run not in without:
            if file is None:
                raise runs.fail(index, f"trajectory {run} has neither references nor, without poses.parquet, poses")
            what = "wheel samples" if file.stem == "wheels" else "reference poses"
            raise DataError(f"{file}: trajectory {run} ({runs.file.name}, row {index + 1}) has no {what}")


def table_file(folder: Path, name: str) -> Path | None:
    """The file of the table called ``name`` in a data set's folder, if there is one. DataError when there are two."""
    files = [file for file in (folder / f"{name}.parquet", folder / f"{name}.csv") if file.exists()]
    if len(files) > 1:
        raise DataError(f"{folder}: both {name}.parquet and {name}.csv are there; remove the one that is not meant")
    return files[0] if files else None


def read_table(folder: Path, name: str, required: Sequence[str] = ()) -> Table:
    """The table called ``name`` of a data set. DataError when it, its rows or a required column are missing."""
    file, required = table_file(folder, name), required or REQUIRED[name]
    if file is None:
        raise DataError(f"{folder}: {name}.parquet (or {name}.csv) is missing")
    if file.suffix == ".parquet":
        with readable(file):
            return Table(file, scan_table(file)[1].collect(), required)
    check_file(file, MOST_TEXT, text=True)
    with readable(file):
        frame = pl.read_csv(file, infer_schema_length=None, schema_overrides=_TEXTS, glob=False)
    if twice := [column for column in frame.columns if "_duplicated_" in column]:  # polars' name for the second of two
        raise DataError(f"{file}: column {twice[0].partition('_duplicated_')[0]!r} is there twice; remove one")
    return Table(file, unquoted_formulas(frame), required)


def wheel_columns(robot: Robot) -> dict[str, list[str]]:
    """The columns of each array of wheel samples besides the times, by its name in Trajectory."""
    wheels = robot.wheel_names
    columns = {
        "rates": [f"omega_{wheel}" for wheel in wheels],
        "steering": [f"steer_{wheel}" for wheel in robot.drive.steered],
        "angles": [f"phi_{wheel}" for wheel in wheels],
        "targets": [f"target_{wheel}" for wheel in wheels],
        "odometry": ["odom_x", "odom_y", "odom_theta"],
    }
    return {name: names for name, names in columns.items() if names}


def required_columns(robot: Robot) -> list[str]:
    """The columns that every table of wheel samples has."""
    return ["trajectory", "t", *wheel_columns(robot)["rates"]]


def _present_columns(file: Path, columns: Sequence[str], robot: Robot) -> dict[str, list[str]]:
    """The columns of the arrays that a table has. DataError: a required column, or one of an array, is missing."""
    check_columns(file, columns, required_columns(robot))
    for wheel in robot.drive.steered:
        if (column := f"steer_{wheel}") not in columns:
            hint = nearest(column, [name for name in columns if not name.startswith("omega_")])
            what = f"the steering angle of wheel {wheel} (rad, counter-clockwise, at the sample's end), is missing"
            raise DataError(f"{file}: column {column!r}, {what}; {hint}found: {', '.join(columns)}")
    return present_groups(file, wheel_columns(robot), columns)


def read_samples(folder: Path, runs: Table, robot: Robot, *, left_in_files: bool) -> list[Samples]:
    """The wheel samples of each run of a data set, which stay in a Parquet file if its rows allow it. DataError."""
    file, samples = table_file(folder, "wheels"), None
    if left_in_files and file is not None and file.suffix == ".parquet":
        samples = _samples_in_file(file, runs, robot)
    return samples or samples_in_memory(read_table(folder, "wheels", required_columns(robot)), runs, robot)


def samples_in_memory(table: Table, runs: Table, robot: Robot) -> list[Samples]:
    """The wheel samples of each run. DataError names the table, the row and what is wrong."""
    columns = _present_columns(table.file, table.frame.columns, robot)
    return [Samples(arrays) for arrays in arrays_of_runs(table, runs, columns, wheel_times_flaw)]


def _samples_in_file(file: Path, runs: Table, robot: Robot) -> list[Samples] | None:
    """The wheel samples of each run in a Parquet file, which are checked piece by piece and stay there.

    None: the rows of a run do not stand together, or numbers are texts, so that the table must be read whole. DataError
    as for ``samples_in_memory``.
    """
    # Workers, and jobs that change their folder, find an absolute path, too.
    table, (length, types) = OpenedTable.of(file.absolute()), parquet_shape(file)
    columns = _present_columns(file, list(types), robot)
    names = ["trajectory", "t", *(name for group in columns.values() for name in group)]
    if not all(types[name].is_numeric() for name in names[1:]):
        return None
    pieces = (Table(file, _rows(table, names, at, _ROWS), names, at) for at in range(0, max(length, 1), _ROWS))
    places: dict[int, tuple[int, int, float]] = {}  # first row, number of rows and end of each run
    for index, rows, arrays in arrays_by_run(pieces, runs, columns, wheel_times_flaw):
        first, count, _ = places.get(index, (int(rows[0]), 0, 0.0))
        if not np.array_equal(rows, np.arange(first + count, first + count + len(rows))):
            return None
        places[index] = first, count + len(rows), float(arrays["times"][-1])
    require_rows(file, runs, places)
    columns = {"times": ["t"], **columns}
    of_odometry = [column for name in _OF_ODOMETRY for column in columns.get(name, ())]
    samples = []
    for index in range(len(places)):
        first, count, end = places[index]
        readers: dict[str, Any] = {}
        for name, group in columns.items():
            together = of_odometry if name in _OF_ODOMETRY else group
            chosen = slice(begin := together.index(group[0]), begin + len(group))
            readers[name] = partial(_read, table, tuple(together), chosen, first, count, name == "times")
        samples.append(Samples(readers, (count, end)))
    return samples


def _rows(table: OpenedTable, columns: Sequence[str], first: int, count: int) -> pl.DataFrame:
    rows = table.rows(columns, first, count)
    tell_reading(len(rows), "sample")
    return rows


@lru_cache(maxsize=_BLOCKS_HELD)
def read_block(table: OpenedTable, columns: tuple[str, ...], number: int) -> Array:
    """Values (rows, n) of some columns of a block of a Parquet file, by its number from 0 on. DataError."""
    return _rows(table, columns, number * _BLOCK_ROWS, _BLOCK_ROWS).cast(pl.Float64).to_numpy()


def _read(table: OpenedTable, columns: tuple[str, ...], chosen: slice, first: int, count: int, flat: bool) -> Array:
    """Values (count, n) of the chosen ones of some columns, from a row on; (count,) where ``flat``."""
    parts = []
    for number in range(first // _BLOCK_ROWS, (first + count - 1) // _BLOCK_ROWS + 1):
        begin = first - number * _BLOCK_ROWS
        parts.append(read_block(table, columns, number)[max(begin, 0) : begin + count, chosen])
    # A copy, as a view would keep the whole block.
    values = np.concatenate(parts, out=np.empty((count, chosen.stop - chosen.start)))
    values.flags.writeable = False  # a change would be lost
    return values[:, 0] if flat else values


Run = TypeVar("Run", bound=Any)  # a run, or a log


def median_period(runs: Sequence[Any]) -> float:
    """The median time between the wheel samples of runs, the start being the first, s.

    It is robust to jitter and gaps. Of very many samples it is the period of the run in the middle: the median of the
    runs' medians, each of which counts as often as it has samples.
    """
    counts = np.array([run.samples.count for run in runs])
    if counts.sum() <= MOST_IN_MEMORY:
        return median_step(np.append(0.0, run.samples.array("times")) for run in runs)
    medians = np.array([run.samples.period for run in runs])
    order = np.argsort(medians, kind="stable")
    passed = np.cumsum(counts[order])
    return float(medians[order][np.searchsorted(passed, passed[-1] / 2)])


def median_step(times: Iterable[Array]) -> float:
    """The median time between stamps that follow each other in one of several arrays, s."""
    return float(np.median(np.concatenate([np.diff(stamps) for stamps in times]), overwrite_input=True))


def drawn_runs(runs: Sequence[Run], most: int = MOST_DRAWN) -> list[Run]:
    """All runs, or of more than ``most`` wheel samples some that chance has drawn, in memory: the same ones each time.

    They have about so many samples, unless runs are so long that twenty have more. Some of every session and command
    that the runs tell are drawn first, as far as so few runs reach.
    """
    count = count_drawn(runs, most)
    if count == len(runs):
        return [in_memory(run) for run in runs]
    order, seen = np.random.default_rng(0).permutation(len(runs)).tolist(), Counter[object]()
    first, others = list[int](), list[int]()
    for index in order:
        kind = tuple(getattr(runs[index], name, None) for name in ("session", "command"))
        seen[kind] += 1
        (first if seen[kind] <= _OF_EACH else others).append(index)
    return [in_memory(runs[index]) for index in sorted([*first, *others][:count])]


def count_drawn(runs: Sequence[Any], most: int = MOST_DRAWN) -> int:
    """How many runs ``drawn_runs`` draws."""
    rows = sum(max(run.samples.count, _POSE * len(getattr(run, "pose_times", ()))) for run in runs)
    return min(max(_FEWEST, len(runs) * most // max(rows, 1)), len(runs))


def in_memory(run: Run) -> Run:
    """A run, or a log, whose samples are in memory."""
    return run if run.samples.held else replace(run, samples=run.samples.loaded())
