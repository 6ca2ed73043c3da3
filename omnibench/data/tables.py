"""Tables of a data set, Parquet or CSV: runs, wheels, poses and references; every flaw is told with its file and row.

The table references.parquet (or .csv) has a row for each measurement of a run's motion. Columns: trajectory, kind,
value and sigma of kinds of one number, value_x, value_y, sigma_x and sigma_y of those of two (sigma stands for both
where these are empty), t0 and t1, which may be missing or empty: the run's start and end; sigma_rate (rad/s) of a
gyro's offset, which the turns of a session share.
"""

from __future__ import annotations

import glob
import os
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import polars as pl
from numpy.typing import NDArray

from omnibench.config import LONGEST_NAME
from omnibench.data.dataset import SPLITS, Dataset, Header, Split, Trajectory
from omnibench.data.dataset import make_dataset as of_trajectories
from omnibench.data.delimited import missing_column, not_increasing
from omnibench.data.references import AT_ONE_TIME, NUMBERS, PLANAR, References, reference_flaw, references_of
from omnibench.data.run_checks import LARGEST, Flaw, pose_times_flaw, stored_pose_times_flaw, wheel_times_flaw
from omnibench.data.scans import Scans
from omnibench.data.splits import every_second
from omnibench.data.stored_rows import (
    BLOCK_ROWS,
    BlockFile,
    StoredRows,
    count_rows,
    file_state,
    median_period,
    read_parquet,
    read_rows,
    readable,
    types_of,
)
from omnibench.errors import DataError, nearest, require_type
from omnibench.files import MOST_TEXT, check_file, unquoted_formulas
from omnibench.progress import tell_reading
from omnibench.robot.kinematics import Array, Robot

# Names may consist of digits: 007 is not 7.
_TEXTS = dict.fromkeys(("trajectory", "command", "split", "session"), pl.String)


class Table:
    """A table and the file it came from. Rows of messages count from 1, the first after the header.

    rows_before: rows of the file that stand before those of the frame.
    """

    def __init__(self, file: Path, frame: pl.DataFrame, rows_before: int = 0) -> None:
        self.file = file
        self.frame = frame
        self.rows_before = rows_before

    def fail(self, row: int, what: str) -> DataError:
        """The error to raise for ``row``, counted from 0."""
        return DataError(f"{self.file}, row {self.rows_before + row + 1}: {what}")

    def refuse(self, faulty: NDArray[np.bool_] | pl.Series, words: Callable[[int], str]) -> None:
        """DataError for the first row that is ``faulty`` (rows,). words: what is wrong in that row, counted from 0."""
        for row in np.flatnonzero(faulty)[:1]:
            raise self.fail(int(row), words(int(row)))

    def floats(self, column: str) -> pl.Series:
        """A column as floats, null where a cell is empty. DataError for text and other things."""
        series = self.frame[column]
        if series.dtype != pl.String:
            if not series.dtype.is_numeric() and series.null_count() < len(series):
                raise DataError(f"{self.file}: column {column!r} holds {series.dtype}, expected numbers")
            return series.cast(pl.Float64)
        values = series.str.strip_chars().cast(pl.Float64, strict=False)  # one odd cell makes a CSV column text
        odd = values.is_null() & series.is_not_null()
        self.refuse(odd, lambda row: f"{column} is {series[row]!r}, expected a number")
        return values

    def numbers(self, column: str) -> Array:
        """A column as finite floats (rows,). DataError names the first value that is missing or not finite."""
        series = self.floats(column)
        values = series.fill_null(np.nan).to_numpy()
        self.refuse(
            ~np.isfinite(values),
            lambda row: f"{column} is {'missing' if series[row] is None else series[row]}; remove or repair the row",
        )
        huge = np.abs(values) > LARGEST
        way = "count the time from the start of its run" if column == "t" else "check the units"
        self.refuse(huge, lambda row: f"{column} is {values[row]:g}, which no robot can reach; {way}")
        return values

    def name_trajectories(self) -> None:
        """Make the trajectories' ids texts. DataError: one is missing, or no name or number, or a name is too long."""
        ids = self.frame["trajectory"]
        if ids.dtype.is_nested():
            raise DataError(f"{self.file}: column 'trajectory' holds {ids.dtype}, expected names or numbers")
        self.refuse(ids.is_null(), lambda _: "trajectory is missing")
        self.frame = self.frame.with_columns(ids.cast(pl.String))
        for column in _TEXTS:
            if column in self.frame.columns and (names := self.frame[column]).dtype == pl.String:
                for row in (names.str.len_chars() > LONGEST_NAME).fill_null(value=False).arg_true()[:1]:
                    raise self.fail(row, f"{column} has more than {LONGEST_NAME} characters; shorten it")

    def stack(self, columns: Sequence[str]) -> Array | None:
        """Optional columns as (rows, n), or None when none is there. DataError when only some are."""
        if not _all_there(self.file, columns, self.frame.columns):
            return None
        return np.column_stack([self.numbers(column) for column in columns])


def read_table(folder: Path, name: str, required: Sequence[str]) -> Table:
    """The table called ``name`` of a data set. DataError when it, its rows or a required column are missing."""
    file = table_file(folder, name)
    if file is None:
        raise DataError(f"{folder}: {name}.parquet (or {name}.csv) is missing")
    if file.suffix == ".parquet":
        return checked_table(file, read_parquet(file), required)
    check_file(file, MOST_TEXT, text=True)
    with readable(file):
        frame = pl.read_csv(file, infer_schema_length=None, schema_overrides=_TEXTS, glob=False)
    twice = [column for column in frame.columns if "_duplicated_" in column]
    if twice:  # polars' name for the second of two
        raise DataError(f"{file}: column {twice[0].partition('_duplicated_')[0]!r} is there twice; remove one")
    return checked_table(file, unquoted_formulas(frame), required)


def checked_table(file: Path, frame: pl.DataFrame, required: Sequence[str], rows_before: int = 0) -> Table:
    """A frame as a table. DataError when it has no rows, or a required column or a trajectory's name is missing.

    file: where it is from; of a frame in memory its name in messages. rows_before: as in Table.
    """
    check_columns(file, frame.columns, required)
    if frame.is_empty():
        raise DataError(f"{file}: it has no rows")
    table = Table(file, frame, rows_before)
    table.name_trajectories()
    return table


def check_columns(file: Path, columns: Sequence[str], required: Sequence[str]) -> None:
    """DataError names the required columns that are not among those of a file."""
    if missing := [column for column in required if column not in columns]:
        raise missing_column(file, missing[0], columns, missing[1:])


def table_file(folder: Path, name: str) -> Path | None:
    """The file of the table called ``name`` in a data set's folder, if there is one. DataError when there are two."""
    files = [file for file in (folder / f"{name}.parquet", folder / f"{name}.csv") if file.exists()]
    if len(files) > 1:
        raise DataError(f"{folder}: both {name}.parquet and {name}.csv are there; remove the one that is not meant")
    return files[0] if files else None


_MAGIC = "*?["


def dataset_folders(places: Path | str | Sequence[Path | str]) -> list[Path]:
    """The folders that places name: each a data set folder or a glob, whose folders come in the order of their names.

    A folder that is named twice counts once. DataError: a glob matches no data set folder, or one without dataset.yaml
    that has wheel samples; or nothing is named.
    """
    if isinstance(places, Path | str):
        places = [places]
    folders = {folder.resolve(): folder for place in places for folder in _named(Path(place))}
    if not folders:
        raise DataError("no data set folder is named")
    return list(folders.values())


def is_glob(place: Path) -> bool:
    """True for a pattern, which no file or folder has as its name."""
    return any(sign in str(place) for sign in _MAGIC) and not place.exists()


def in_few_words(folders: Sequence[Path]) -> str:
    """The folders as words of a shell: a glob that names just these, where there is one, else one by one."""
    begin = os.path.commonprefix([str(folder) for folder in folders])  # noqa: RUF071 (a glob's begin is no path)
    in_one_folder = len(folders) > 2 and begin.startswith(f"{folders[0].parent}/")
    if in_one_folder and _found(f"{glob.escape(begin)}*") == list(folders):
        return f"{shlex.quote(begin)}*"
    return shlex.join(map(str, folders))


def _named(place: Path) -> list[Path]:
    if not is_glob(place):
        return [place]
    pattern = str(place)
    if not (folders := _found(pattern)):
        matching = sorted(glob.glob(pattern, recursive=True))
        seen = f"; {matching[0]} has no dataset.yaml" if matching else ""
        raise DataError(f"{place}: no data set folder matches{seen}")
    return folders


def _found(pattern: str) -> list[Path]:
    matching = [Path(match) for match in sorted(glob.glob(pattern, recursive=True))]
    for match in matching:
        if table_file(match, "wheels") is not None and not (match / "dataset.yaml").is_file():
            raise DataError(f"{match}: it has wheel samples, but no dataset.yaml; write one there, or name the others")
    return [match for match in matching if (match / "dataset.yaml").is_file()]


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


class WheelArrays(NamedTuple):
    """A run's wheel samples, as in Trajectory."""

    times: Array
    rates: Array
    steering: Array | None = None
    angles: Array | None = None
    targets: Array | None = None
    odometry: Array | None = None


def wheel_columns(robot: Robot) -> dict[str, list[str]]:
    """The columns of each of the arrays of WheelArrays; those of no length are not there."""
    wheels, steered = robot.wheel_names, robot.drive.steered
    columns = {
        "times": ["t"],
        "rates": [f"omega_{wheel}" for wheel in wheels],
        "steering": [f"steer_{wheel}" for wheel in steered],
        "angles": [f"phi_{wheel}" for wheel in wheels],
        "targets": [f"target_{wheel}" for wheel in wheels],
        "odometry": ["odom_x", "odom_y", "odom_theta"],
    }
    return {name: names for name, names in columns.items() if names}


def check_steering(file: Path, columns: Sequence[str], robot: Robot) -> None:
    """DataError: there is no column with the steering angles of a wheel."""
    for wheel in robot.drive.steered:
        if (column := f"steer_{wheel}") not in columns:
            hint = nearest(column, [name for name in columns if not name.startswith("omega_")])
            raise DataError(
                f"{file}: column {column!r}, the steering angle of wheel {wheel} (rad, counter-clockwise, at "
                f"the sample's end), is missing; {hint}found: {', '.join(columns)}"
            )


@dataclass(frozen=True, eq=False)
class WheelTable:
    """A table of wheel samples in memory."""

    table: Table

    def of_runs(self, runs: Table, robot: Robot) -> list[WheelArrays]:
        """The samples of each of the runs. DataError names the table, the row and what is wrong."""
        table = self.table
        check_steering(table.file, table.frame.columns, robot)
        rows_of_runs = rows_by_trajectory(runs, table)
        check_times(table, rows_of_runs, wheel_times_flaw)
        times = table.numbers("t")
        stacked = {
            name: values
            for name, columns in wheel_columns(robot).items()
            if name != "times" and (values := table.stack(columns)) is not None
        }
        return [
            WheelArrays(times[rows], **{name: values[rows] for name, values in stacked.items()})
            for rows in rows_of_runs
        ]


TABLE = "references"
REFERENCE_COLUMNS = ("trajectory", "kind")  # those that every such table has


def read_references(
    runs: Table, table: Table | None, wheel_times: Sequence[Array], started: Collection[str]
) -> dict[str, References]:
    """The references of each run that has some; none where there is no such table.

    wheel_times: ends of the wheel samples (F,) of each run, s. started: ids of the runs whose start pose is known.
    DataError in one line names the file, the row and what is wrong.
    """
    if table is None:
        return {}
    ids = runs.frame["trajectory"].to_list()
    rows_of_runs = rows_by_trajectory(runs, table, ids)
    numbers = {name: _column(table, name) for name in NUMBERS}
    texts = np.array(["" if kind is None else str(kind).strip() for kind in table.frame["kind"]], dtype=str)
    found: dict[str, References] = {}
    for run, times, rows in zip(ids, wheel_times, rows_of_runs, strict=True):
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
        present = {name: each for name, each in named.items() if _all_there(self.file, each, types)}
        columns = [column for each in present.values() for column in each]
        if not all(types[column].is_numeric() for column in columns):
            raise WholeTableError
        rows = self._rows_of_runs(runs, columns)
        # First rows of blocks of whole runs, and the end of the last.
        edges = [0]
        ends = sorted(of_run.first + of_run.count for of_run in rows)
        for end, after in zip(ends, [*ends[1:], None], strict=True):
            if after is None or after - edges[-1] > BLOCK_ROWS:
                edges.append(end)
        blocks = BlockFile(file, tuple(edges), state)
        together = [column for name in ("times", "rates", "steering") for column in present.get(name, ())]
        return [WheelArrays(**_arrays(blocks, present, together, of_run)) for of_run in rows]

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


POSE_COLUMNS = ("trajectory", "t", "x", "y", "theta")
COMMAND_COLUMNS = ("trajectory", "t", "v", "alpha", "omega", "t_r")
_RUN_NUMBERS = ("started_at", "v", "alpha", "omega", "duration", "distance")
_COVARIANCE = ("xx", "xy", "xtheta", "yy", "ytheta", "thetatheta")
_ONLY_RUN = "run"  # id of the run of tables without a column "trajectory"
_PERIOD_DECIMALS = 9  # of a sample period in s that is taken from stamps: ns


def make_dataset(
    name: str,
    robot: Robot,
    sample_period: float | None = None,
    trajectories: Iterable[Trajectory] | Any = None,
    *,
    wheels: Any = None,
    poses: Any = None,
    references: Any = None,
    description: str = "",
    source: str = "",
    licence: str = "",
    simulated: bool = False,
    scans: Scans | None = None,
) -> Dataset:
    """A data set from arrays or data frames, checked as files are checked.

    sample_period: s, that of the wheel samples; default: the median of their stamps. Either

    - ``trajectories``: :class:`Trajectory` objects, one a run, with arrays; or
    - tables: Polars or pandas data frames, or dicts of columns, with the columns of a data set's files.
      wheels: trajectory, t (s), omega_<wheel> (rad/s) of every wheel, steer_<wheel> (rad) of steered ones; poses:
      trajectory, t, x, y (m), theta (rad), the first of a run at t = 0; references: in their place or beside them.
      trajectories: trajectory, split (train or validation), command ...; default: every run of ``wheels``. Without
      ``split`` every second run of a command validates. Tables of one run need no column ``trajectory``.

    DataError names the table, its row (1 is the first) and column, and what is wrong: a missing column or value, times
    that do not increase, a run without a pose at t = 0, two runs of the same name, values that no robot reaches. Units
    and signs that look wrong are the data set's ``warnings``.

    >>> import numpy as np
    >>> robot = Robot(name="cart", wheels=[
    ...     Wheel(name="left", type="fixed", radius=0.05, x=0, y=0.15),
    ...     Wheel(name="right", type="fixed", radius=0.05, x=0, y=-0.15)])
    >>> t = np.arange(1, 51) * 0.02
    >>> wheels = {"t": t, "omega_left": np.full(50, 4.0), "omega_right": np.full(50, 4.0)}
    >>> poses = {"t": [0.0, 1.0], "x": [0.0, 0.2], "y": [0.0, 0.0], "theta": [0.0, 0.0]}
    >>> make_dataset("day1", robot, wheels=wheels, poses=poses)
    Dataset 'day1': 1 run (1 train, 0 validation) of robot cart (wheels left, right)
      recorded, 50 wheel samples every 20 ms, 2 reference poses
    """
    require_type(robot, Robot, "Robot(name=..., wheels=[...])")
    texts: dict[str, Any] = {"description": description, "source": source, "licence": licence, "simulated": simulated}
    if wheels is None:
        runs = _runs(name, trajectories, poses is not None or references is not None)
    elif poses is None and references is None:
        raise DataError(
            f"data set {name}: poses is missing: a table with the columns t, x, y and theta; or references, with "
            "distances, turns and the like"
        )
    else:
        runs = _tables(robot, trajectories, wheels, poses, references).trajectories(robot)
    if not isinstance(sample_period, Real | None):
        raise DataError(f"data set {name}: sample_period is {sample_period!r}, expected a number of seconds")
    if sample_period is None:  # the median; that there is no run is said next
        sample_period = round(median_period(runs), _PERIOD_DECIMALS) if runs else 1.0
    return of_trajectories(name, robot, sample_period, runs, scans=scans, **texts)


def _runs(name: str, trajectories: Any, others: bool) -> list[Trajectory]:
    """Trajectory objects whose fields may be lists. DataError: there are none, or tables without that of the wheels."""
    if others or trajectories is None:
        raise DataError(f"data set {name}: wheels is missing: a table with the columns t and omega_<wheel>")
    runs = list(trajectories)
    for run in runs:
        if not isinstance(run, Trajectory):
            given = type(run).__name__
            raise DataError(f"data set {name}: a trajectory is of type {given}; of tables give wheels= and poses=, too")
    return [run.with_arrays() for run in runs]


def _tables(robot: Robot, trajectories: Any, wheels: Any, poses: Any, references: Any) -> DatasetTables:
    """The tables that a user gave, with a table of runs."""
    frames = {"wheels": _frame("wheels", wheels)}
    if poses is not None:
        frames["poses"] = _frame("poses", poses)
    if references is not None:
        frames[TABLE] = _frame(TABLE, references)
    if all("trajectory" not in frame.columns for frame in frames.values()):
        frames = {name: frame.with_columns(pl.lit(_ONLY_RUN).alias("trajectory")) for name, frame in frames.items()}
    rates = [f"omega_{wheel}" for wheel in robot.wheel_names]
    required = {"wheels": ("trajectory", "t", *rates), "poses": POSE_COLUMNS, TABLE: REFERENCE_COLUMNS}
    checked = {name: checked_table(Path(name), frame, required[name]) for name, frame in frames.items()}
    named = checked["wheels"].frame["trajectory"].unique(maintain_order=True)
    runs = pl.DataFrame({"trajectory": named}) if trajectories is None else _frame("trajectories", trajectories)
    if "split" not in runs.columns:
        commands = runs["command"].to_list() if "command" in runs.columns else [None] * len(runs)
        runs = runs.with_columns(pl.Series("split", every_second(commands), dtype=pl.String))
    of_runs = checked_table(Path("trajectories"), runs, ("trajectory", "split"))
    return DatasetTables(of_runs, WheelTable(checked["wheels"]), checked.get("poses"), checked.get(TABLE))


def _frame(name: str, content: Any) -> pl.DataFrame:
    """A data frame or a dict of columns as a Polars frame. DataError names the table and the column that is unfit."""
    if isinstance(content, pl.DataFrame):
        return content
    if isinstance(content, Mapping):
        columns = {str(column): content[column] for column in content}
    elif hasattr(content, "columns") and hasattr(content, "__getitem__"):  # pandas, and others like it
        columns = {str(column): content[column] for column in content.columns}
    else:
        raise DataError(f"{name}: expected a data frame or a dict of arrays, found {type(content).__name__}")
    arrays = {column: np.atleast_1d(np.asarray(values)) for column, values in columns.items()}
    if not arrays:
        raise DataError(f"{name}: it has no columns")
    first, rows = next((column, len(array)) for column, array in arrays.items())
    for column, array in arrays.items():
        if array.ndim != 1:
            raise DataError(f"{name}: column {column!r} has shape {array.shape}; give a column for each wheel or axis")
        if len(array) != rows:
            raise DataError(f"{name}: column {column!r} has {len(array)} rows, {first!r} has {rows}")
    return pl.DataFrame(
        {column: array.tolist() if array.dtype == object else array for column, array in arrays.items()}, strict=False
    )


@dataclass(frozen=True, eq=False)
class DatasetTables:
    """The tables of a data set, whose required columns are there. poses: None where all runs have references.

    commands: the motion commands that were sent in runs, if they were recorded.
    """

    runs: Table
    wheels: WheelTable | StoredWheels
    poses: Table | None
    references: Table | None
    commands: Table | None = None

    def trajectories(self, robot: Robot) -> list[Trajectory]:
        """The runs of the tables. DataError names the table, the row and what is wrong."""
        runs, poses = self.runs, self.poses
        for column in (*_RUN_NUMBERS, "repetition"):
            if column in runs.frame.columns:
                series = runs.floats(column)
                _refuse_infinite(runs, series)
                runs.frame = runs.frame.with_columns(series.alias(column))
        if "repetition" in runs.frame.columns:
            numbers = runs.frame["repetition"]
            runs.refuse(numbers % 1 != 0, lambda row: f"repetition is {numbers[row]}, not a whole number")
        named = runs.frame["trajectory"]
        runs.refuse(
            ~named.is_first_distinct(), lambda row: f"trajectory {named[row]} is there twice; give each its own id"
        )
        for row, split in enumerate(runs.frame["split"]):
            if split not in SPLITS:
                raise runs.fail(row, f"split is {split!r}; {nearest(str(split), SPLITS)}it must be train or validation")
        samples = self.wheels.of_runs(runs, robot)
        ids = runs.frame["trajectory"].to_list()
        started = set() if poses is None else set(poses.frame["trajectory"])
        references = read_references(runs, self.references, [arrays.times for arrays in samples], started)
        pose_rows = _pose_rows(runs, poses, references)
        reference = None if poses is None else _PoseColumns(poses)
        sent = [None] * len(ids) if self.commands is None else _sent(runs, self.commands)
        return [
            _trajectory(row, samples[index], reference, pose_rows[index], references.get(row["trajectory"]), commands)
            for index, (row, commands) in enumerate(zip(runs.frame.iter_rows(named=True), sent, strict=True))
        ]


def read_trajectories(folder: Path, header: Header, *, left_in_files: bool) -> list[Trajectory]:
    """The trajectories of a data set's folder, its tables checked. DataError as for ``load_dataset``.

    left_in_files: the wheel samples of a Parquet file stay there, if its rows allow to read it run by run.
    """
    runs = read_table(folder, "trajectories", ("trajectory", "split"))
    references = None if table_file(folder, TABLE) is None else read_table(folder, TABLE, REFERENCE_COLUMNS)
    poses = None  # where there are none, references must be in their place
    if references is None or table_file(folder, "poses") is not None:
        poses = read_table(folder, "poses", POSE_COLUMNS)
    commands = None if table_file(folder, "commands") is None else read_table(folder, "commands", COMMAND_COLUMNS)
    if left_in_files and (file := _parquet_of_wheels(folder)) is not None:
        with suppress(WholeTableError):
            return DatasetTables(runs, StoredWheels(file), poses, references, commands).trajectories(header.robot)
    columns = ("trajectory", "t", *(f"omega_{wheel}" for wheel in header.wheels))
    wheels = WheelTable(read_table(folder, "wheels", columns))
    return DatasetTables(runs, wheels, poses, references, commands).trajectories(header.robot)


def stored_samples(folder: Path) -> int:
    """The number of wheel samples that a folder has in a Parquet file."""
    file = _parquet_of_wheels(folder)
    return 0 if file is None else count_rows(file)


def _parquet_of_wheels(folder: Path) -> Path | None:
    file = table_file(folder, "wheels")
    return file if file is not None and file.suffix == ".parquet" else None


def tables_of(dataset: Dataset) -> dict[str, pl.DataFrame]:
    """The tables of a data set by name: trajectories, wheels, and poses and references where there are some."""
    tables = {
        "trajectories": pl.DataFrame([_run_row(run) for run in dataset.trajectories], infer_schema_length=None),
        "wheels": pl.concat([_wheel_frame(run, dataset.robot) for run in dataset.trajectories]),
    }
    if placed := [_pose_frame(run) for run in dataset.trajectories if run.start_known]:
        tables["poses"] = pl.concat(placed)
    if measured := [(run.id, run.references) for run in dataset.trajectories if run.references is not None]:
        tables[TABLE] = reference_frame(measured)
    if rows := [(run.id, *row) for run in dataset.trajectories if run.sent is not None for row in run.sent.tolist()]:
        tables["commands"] = pl.DataFrame(rows, schema=list(COMMAND_COLUMNS), orient="row")
    return tables


def _sent(runs: Table, commands: Table) -> list[Array | None]:
    """The motion commands (C, 5) of each run; None for one without any."""
    rows = rows_by_trajectory(runs, commands, runs.frame["trajectory"].to_list())
    check_times(commands, [of_run for of_run in rows if len(of_run)], lambda times, _: not_increasing(times))
    values = np.column_stack([commands.numbers(column) for column in COMMAND_COLUMNS[1:]])
    return [values[of_run] if len(of_run) else None for of_run in rows]


class _PoseColumns:
    def __init__(self, table: Table) -> None:
        self.times = table.numbers("t")
        self.poses = np.column_stack([table.numbers(column) for column in ("x", "y", "theta")])
        upper = table.stack([f"cov_{name}" for name in _COVARIANCE])
        self.covariances = None if upper is None else upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def _refuse_infinite(runs: Table, values: pl.Series) -> None:
    infinite = ~values.is_finite() & values.is_not_null()
    runs.refuse(infinite, lambda row: f"{values.name} is {values[row]}; leave it empty if it is not known")


def _pose_rows(runs: Table, poses: Table | None, referenced: Collection[str]) -> list[Rows]:
    """The rows of poses of each run; runs that have references may have none, or the start alone."""
    ids = runs.frame["trajectory"].to_list()
    if poses is None:
        for index, run in enumerate(ids):
            if run not in referenced:
                raise runs.fail(index, f"trajectory {run} has neither references nor, without poses.parquet, poses")
        return [np.zeros(0, dtype=np.intp) for _ in ids]
    rows = rows_by_trajectory(runs, poses, referenced)
    given = [(run in referenced, of_run) for run, of_run in zip(ids, rows, strict=True) if len(of_run)]
    check_times(poses, [of_run for has_references, of_run in given if not has_references], stored_pose_times_flaw)
    check_times(poses, [of_run for has_references, of_run in given if has_references], pose_times_flaw)
    return rows


def _trajectory(
    run: dict[str, Any],
    wheels: WheelArrays,
    reference: _PoseColumns | None,
    pose_rows: Rows,
    references: References | None,
    sent: Array | None,
) -> Trajectory:
    pose_times: Array = np.zeros(1)
    poses: Array = np.zeros((1, 3))
    covariances: Array | None = None
    if reference is not None and len(pose_rows):
        pose_times, poses = reference.times[pose_rows], reference.poses[pose_rows]
        covariances = None if reference.covariances is None else reference.covariances[pose_rows]
    numbers: dict[str, Any] = {name: float(run[name]) for name in _RUN_NUMBERS if run.get(name) is not None}
    return Trajectory(
        id=run["trajectory"],
        split=cast(Split, run["split"]),
        times=wheels.times,
        rates=wheels.rates,
        pose_times=pose_times,
        poses=poses,
        command=None if run.get("command") is None else str(run["command"]),
        repetition=None if run.get("repetition") is None else round(run["repetition"]),
        session=None if run.get("session") is None else str(run["session"]),
        angles=wheels.angles,
        targets=wheels.targets,
        steering=wheels.steering,
        odometry=wheels.odometry,
        sent=sent,
        pose_covariances=covariances,
        references=references,
        **numbers,
    )


def _run_row(trajectory: Trajectory) -> dict[str, Any]:
    names = ("command", "repetition", "split", "session", *_RUN_NUMBERS)
    return {"trajectory": trajectory.id} | {name: getattr(trajectory, name) for name in names}


def _wheel_frame(trajectory: Trajectory, robot: Robot) -> pl.DataFrame:
    columns: dict[str, Any] = {"trajectory": [trajectory.id] * len(trajectory.times), "t": np.asarray(trajectory.times)}
    for prefix, wheels, values in (
        ("omega", robot.wheel_names, trajectory.rates),
        ("steer", robot.drive.steered, trajectory.steering),
        ("phi", robot.wheel_names, trajectory.angles),
        ("target", robot.wheel_names, trajectory.targets),
        ("odom", ("x", "y", "theta"), trajectory.odometry),
    ):
        for index, wheel in enumerate(wheels):
            columns[f"{prefix}_{wheel}"] = [None] * len(trajectory.times) if values is None else values[:, index]
    return pl.DataFrame(columns, schema_overrides={name: pl.Float64 for name in columns if name != "trajectory"})


def _pose_frame(trajectory: Trajectory) -> pl.DataFrame:
    count = len(trajectory.pose_times)
    columns: dict[str, Any] = {"trajectory": [trajectory.id] * count, "t": trajectory.pose_times}
    columns |= {name: trajectory.poses[:, index] for index, name in enumerate(("x", "y", "theta"))}
    covariances = trajectory.pose_covariances
    for name, (row, column) in zip(_COVARIANCE, ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)), strict=True):
        columns[f"cov_{name}"] = [None] * count if covariances is None else covariances[:, row, column]
    return pl.DataFrame(columns, schema_overrides={name: pl.Float64 for name in columns if name != "trajectory"})
