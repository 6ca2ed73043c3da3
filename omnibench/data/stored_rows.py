"""Arrays of a run that are read from their file where they are used, and not kept.

A data set larger than memory is read in blocks of whole runs. The last few blocks that were read stay in memory, so
that code which takes one run after another reads every block once.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_right
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import polars as pl

from omnibench.errors import DataError
from omnibench.files import check_file
from omnibench.progress import tell_reading
from omnibench.robot.kinematics import Array

MOST_IN_MEMORY = 5_000_000  # wheel samples that are kept: 200 MB of three wheels' (chosen)
BLOCK_ROWS = 500_000  # rows of a block, of whole runs: 16 MB of four columns (chosen)
_LARGE = 1 << 27  # bytes in memory up to which a file may be packed as tightly as it likes; chosen
_PACKED = 100  # times smaller than in memory: stamps, which increase, do not pack so tightly; chosen
_LONGEST_CELL = 10_000  # characters of a text in a table, of which names are the longest; chosen
_BLOCKS_KEPT = 4  # blocks in memory, those of all files together (chosen)

Value = TypeVar("Value")


@dataclass(frozen=True)
class BlockFile:
    """A Parquet table in blocks of whole runs, each column of which holds numbers.

    edges: the first row of every block, and the number of rows. state: time of change and size of the file when it was
    opened; DataError when it has changed since.
    """

    file: Path
    edges: tuple[int, ...] = field(compare=False)
    state: tuple[int, int]

    def rows(self, columns: tuple[str, ...], first: int, count: int) -> Array:
        """Values (count, n) of some columns from row ``first`` on, of one block, read-only."""
        block = bisect_right(self.edges, first) - 1
        begin = self.edges[block]
        return self._block(columns, block)[first - begin : first - begin + count]

    def _block(self, columns: tuple[str, ...], block: int) -> Array:
        """A block from memory, or read into it in the place of the one that was used longest ago."""
        key = self, columns, block
        with _blocks_lock:
            if key in _blocks:
                _blocks.move_to_end(key)
                return _blocks[key]
            while len(_blocks) >= _BLOCKS_KEPT:  # before the next is read: memory never holds one more
                _blocks.popitem(last=False)
            values = _blocks[key] = self.read(columns, block)
        tell_reading(len(values), "sample")
        return values

    def read(self, columns: tuple[str, ...], block: int) -> Array:
        """Values (rows, n) of some columns of a block. DataError: the file has changed, or cannot be read."""
        if file_state(self.file) != self.state:
            raise DataError(
                f"{self.file}: the file has changed since it was opened; load it, or run the command, again"
            )
        begin, end = self.edges[block : block + 2]
        values = read_rows(self.file, columns, begin, end - begin).cast(pl.Float64).to_numpy()
        values.flags.writeable = False
        return values


def file_state(file: Path) -> tuple[int, int]:
    """Time of change, ns, and size of a file, bytes. DataError: it cannot be read."""
    try:
        status = file.stat()
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error.strerror}") from None
    return status.st_mtime_ns, status.st_size


def read_rows(file: Path, columns: Sequence[str], first: int, count: int) -> pl.DataFrame:
    """Some rows of a Parquet file. DataError: it cannot be read."""
    with readable(file):
        return pl.scan_parquet(file, glob=False).select(columns).slice(first, count).collect()


def count_rows(file: Path) -> int:
    """The number of rows of a Parquet file. DataError: it cannot be read, or is packed as no recording can be."""
    check_file(file)
    with readable(file):
        scanned = pl.scan_parquet(file, glob=False)
        rows = int(scanned.select(pl.len()).collect().item())
        size = rows * len(scanned.collect_schema()) * 8
        packed = file.stat().st_size
    if size > _LARGE and size > _PACKED * packed:
        raise DataError(
            f"{file}: its {packed / 1e6:.3g} MB would unpack to {size / 1e9:.3g} GB ({rows:,} rows), as no recording "
            "does; write it anew, or leave it out"
        )
    return rows


def read_parquet(file: Path) -> pl.DataFrame:
    """A whole Parquet file. DataError as for count_rows; a column holds lists, or a text that is no name."""
    count_rows(file)
    for column, kind in types_of(file).items():
        if kind.is_nested():
            raise DataError(f"{file}: column {column!r} holds {kind}, expected names or numbers")
    with readable(file):
        frame = pl.read_parquet(file, glob=False)
    for lengths in frame.select(pl.col(pl.String).str.len_chars()).iter_columns():
        longest = lengths.fill_null(0).to_numpy().max(initial=0)
        if longest > _LONGEST_CELL:
            text = f"a text of {longest:,} characters"
            raise DataError(f"{file}: column {lengths.name!r} has {text}, expected names or numbers")
    return frame


def types_of(file: Path) -> pl.Schema:
    """The types of the columns of a Parquet file, by their names. DataError: it cannot be read."""
    with readable(file):
        return pl.scan_parquet(file, glob=False).collect_schema()


@contextmanager
def readable(file: Path) -> Iterator[None]:
    """Turn what Polars raises while it reads a file into a DataError."""
    try:
        yield
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        raise DataError(f"{file}: cannot be read: {error}") from None


# The blocks that were read last, for all threads of this process.
_blocks: OrderedDict[tuple[BlockFile, tuple[str, ...], int], Array] = OrderedDict()
_blocks_lock = threading.Lock()


@dataclass(frozen=True, eq=False)
class StoredRows(np.lib.mixins.NDArrayOperatorsMixin):
    """Rows of a run that behave like their array: (count, n), or (count,) where ``flat``. Whatever uses it reads it.

    columns: those that are read together. chosen: the places of this array's among them. last: the last value of a
    flat one, which is known without reading. more: rows that follow those of the file. notes: see ``noted``.
    """

    file: BlockFile
    columns: tuple[str, ...]
    chosen: tuple[int, ...]
    first: int
    count: int
    flat: bool = False
    last: float | None = None
    more: tuple[Array, ...] = ()
    notes: dict[str, Any] = field(default_factory=dict, init=False)

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self),) if self.flat else (len(self), len(self.chosen))

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    dtype = np.dtype(float)

    def __len__(self) -> int:
        return self.count + len(self.more)

    def followed_by(self, row: Array) -> StoredRows:
        """The rows and one more."""
        return replace(self, more=(*self.more, np.array(row)), last=float(row) if self.flat else None)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        rows = self.file.rows(self.columns, self.first, self.count)
        low, high = self.chosen[0], self.chosen[-1] + 1
        values = rows[:, low] if self.flat else rows[:, low:high]
        if self.more:
            values = np.concatenate([values, self.more])
        if dtype is not None and dtype != values.dtype:
            return values.astype(dtype)
        return values.copy() if copy else values  # a view would keep the whole block

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        if any(isinstance(each, StoredRows) for each in options.get("out", ())):
            raise TypeError("samples that stand in a file cannot be changed; take a copy with np.array")
        return getattr(ufunc, method)(
            *(np.asarray(each) if isinstance(each, StoredRows) else each for each in inputs), **options
        )

    def __getitem__(self, key: Any) -> Any:
        if self.last is not None and isinstance(key, int) and key in (-1, len(self) - 1):
            return self.last
        values = np.asarray(self)[key]
        return values.copy() if isinstance(key, int) and not self.flat else values  # one row would keep its block

    def __iter__(self) -> Any:
        return iter(np.asarray(self))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # protocols of copy and pickle, not of arrays
            raise AttributeError(name)
        return getattr(np.asarray(self), name)


def in_file(rows: object) -> bool:
    """True if rows are read where they are used, and were checked where their file was opened."""
    return isinstance(rows, StoredRows)


def noted(rows: Any, name: str, find: Callable[[], Value]) -> Value:
    """A value that is found from rows, by its name: found once, and noted with them, where they stand in a file.

    Whoever reads the samples first has many such values found while these are at hand.
    """
    if not isinstance(rows, StoredRows):
        return find()
    if name not in rows.notes:
        rows.notes[name] = find()
    found: Value = rows.notes[name]
    return found


class Sampled(Protocol):
    """A run, or a log, of which the ends of the wheel samples are known."""

    @property
    def times(self) -> Array: ...


def median_period(runs: Sequence[Sampled]) -> float:
    """The median time between the wheel samples of runs, the start being the first, s.

    It is robust to jitter and gaps. Of very many samples it is the period of the run in the middle: the median of the
    runs' medians, each of which counts as often as it has samples.
    """
    counts = np.array([len(run.times) for run in runs])
    if counts.sum() <= MOST_IN_MEMORY:
        return float(np.median(np.concatenate([_periods(run) for run in runs])))
    medians = np.array([period_of(run) for run in runs])
    order = np.argsort(medians, kind="stable")
    passed = np.cumsum(counts[order])
    return float(medians[order][np.searchsorted(passed, passed[-1] / 2)])


def period_of(run: Sampled) -> float:
    """The median time between the wheel samples of a run, s."""
    return noted(run.times, "period", lambda: float(np.median(_periods(run))))


def _periods(run: Sampled) -> Array:
    """The periods (F,) of a run, s."""
    periods: Array = np.diff(run.times, prepend=0.0)
    return periods


Run = TypeVar("Run", bound=Sampled)
Data = TypeVar("Data", bound=Any)

MOST_DRAWN = 3_000_000  # wheel samples by which a recording is judged: 500 runs of a minute at 100 Hz (chosen)

_FEWEST = 20  # runs that are drawn at least (chosen)
_OF_EACH = 2  # runs of every command and session that are drawn before others (chosen): a rare one is not missed


def drawn_runs(runs: Sequence[Run], most: int = MOST_DRAWN) -> list[Run]:
    """All runs, or of more than ``most`` wheel samples some that chance has drawn, in memory: the same ones each time.

    They have about so many samples, unless runs are so long that twenty have more. Some of every session and command
    that the runs tell are drawn first, as far as so few runs reach.
    """
    count = count_drawn(runs, most)
    if count == len(runs):
        return list(runs)
    order, seen = np.random.default_rng(0).permutation(len(runs)).tolist(), Counter[object]()
    first, others = list[int](), list[int]()
    for index in order:
        kind = tuple(getattr(runs[index], name, None) for name in ("session", "command"))
        seen[kind] += 1
        (first if seen[kind] <= _OF_EACH else others).append(index)
    return [in_memory(runs[index]) for index in sorted([*first, *others][:count])]


def count_drawn(runs: Sequence[Sampled], most: int = MOST_DRAWN) -> int:
    """How many runs ``drawn_runs`` draws."""
    samples = sum(len(run.times) for run in runs)
    return min(max(_FEWEST, len(runs) * most // max(samples, 1)), len(runs))


def in_memory(run: Data) -> Data:
    """A run, or a log, with copies of the arrays that are read where they are used."""
    stored = {item.name: value for item in fields(run) if isinstance(value := getattr(run, item.name), StoredRows)}
    return replace(run, **{name: np.array(value) for name, value in stored.items()}) if stored else run
