"""Odometry of any number of runs: of few their samples are held, of very many they are read whenever they are needed.

``odometry_of``, ``poses_of_runs``, ``of_runs`` and ``EachLog`` decide which by themselves; their callers need not know.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, Generic, TypeVar

import numpy as np

from omnibench.jobs.job import Backend, gathered
from omnibench.progress import Reporter
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex, Integration, OdometryBatch, RunSamples, WheelLog, split_by

Sampled = TypeVar("Sampled", bound=Any)  # a log, or a run
Value = TypeVar("Value")

# Samples up to which an OdometryBatch holds them, in 0.1 kB each of three wheels (chosen: beyond, reading them anew and
# summing in compiled code takes a tenth of the time, too).
_HELD = 1_000_000
_TOGETHER = 500_000  # samples that are read together (chosen: as many as a block of a stored table)
_PARTS_OF_A_JOB = 4  # read together one after another: some 0.1 s of work (chosen)
_MATRICES = 3  # whose poses are kept: a descent goes on from one of the last (chosen)

_WORKERS: ContextVar[Backend | None] = ContextVar("workers", default=None)


def odometry_of(logs: Sequence[WheelLog], integration: Integration) -> OdometryBatch:
    """The odometry of logs, by samples that are held where these are few, and else read anew for every matrix."""
    return (StoredOdometry if are_many(logs) else OdometryBatch)(logs, integration)


def poses_of_runs(logs: Sequence[WheelLog], matrix: Array, integration: Integration) -> list[Array]:
    """Poses (S, 3) in m, m, rad of each log at its stamps by one matrix (3, M)."""
    if not are_many(logs):
        return [OdometryBatch([log], integration).poses(matrix[None])[0] for log in logs]
    return split_by(StoredOdometry(logs, integration).poses(matrix[None])[0], [log.stamps for log in logs])


def of_runs(
    function: Callable[..., Value], logs: Sequence[WheelLog], integration: Integration, *arguments: Any
) -> list[Value]:
    """Results of a function, from the top of a module, for each log, or for parts of very many, in the logs' order.

    function: takes the odometry of some logs, these logs, and the arguments.
    """
    if not are_many(logs):
        return [function(OdometryBatch([log], integration), [log], *arguments) for log in logs]
    tasks = [(function, part, integration, arguments) for part in together(logs)]
    return gathered(workers(), _of_part, tasks)


def _of_part(task: tuple[Callable[..., Value], Sequence[WheelLog], Integration, tuple[Any, ...]], _: Reporter) -> Value:
    function, logs, integration, arguments = task
    return function(StoredOdometry(logs, integration), logs, *arguments)


class EachLog(Generic[Value]):
    """What a function makes of each log: held, or for very many samples made again in every iteration."""

    def __init__(self, make: Callable[[WheelLog], Value], logs: Sequence[WheelLog]) -> None:
        self._make, self._logs = make, logs
        self._made = None if are_many(logs) else [make(log) for log in logs]

    def __iter__(self) -> Iterator[Value]:
        return map(self._make, self._logs) if self._made is None else iter(self._made)


def parts_of(logs: Sequence[WheelLog]) -> list[list[WheelLog]]:
    """All logs in one part, or very many in parts that are read at a time."""
    return list(together(logs)) if are_many(logs) else [list(logs)]


def are_many(logs: Sequence[WheelLog]) -> bool:
    """True if logs have so many samples that odometry should not hold them."""
    return sum(log.samples.count for log in logs) > _HELD


def together(logs: Iterable[Sampled], samples: int | None = None) -> Iterator[list[Sampled]]:
    """Logs, or runs, in parts of about so many samples, as many as are read at a time by default.

    Each log counts as the longest of its part, as long as it is in an array of them all.
    """
    part, longest = list[Sampled](), 0
    for log in logs:
        longest = max(longest, log.samples.count)
        if part and (len(part) + 1) * longest > (samples or _TOGETHER):
            yield part
            part, longest = [], log.samples.count
        part.append(log)
    if part:
        yield part


@dataclass(frozen=True, eq=False)
class AtStamps:
    """Sums at the stamps for one matrix, see path_sums. slopes (2, S, 2 M): real and imaginary parts of row_12 and of
    row_3 by turns; None where they were not asked for.
    """

    moved: Array
    driven: Array
    slopes: Array | None


def workers() -> Backend | None:
    """The backend whose workers read many logs; None: this process does."""
    return _WORKERS.get()


@contextmanager
def read_by(backend: Backend | None) -> Iterator[None]:
    """Let the workers of a backend read and sum the samples of many logs, which gives the same to the bit."""
    before = _WORKERS.set(backend)
    try:
        yield
    finally:
        _WORKERS.reset(before)


class StoredOdometry(OdometryBatch):
    """Poses of many logs, whose samples are read anew for every matrix.

    The poses of the last few matrices are kept, and their derivatives once some were asked for: who descends by
    derivatives needs them wherever a pose was good.
    """

    def __init__(self, logs: Sequence[WheelLog], integration: Integration) -> None:
        self.integration = integration
        self._logs = logs
        self.trajectory = np.repeat(np.arange(len(logs)), [len(log.stamps) for log in logs])
        starts = np.array([log.start for log in logs])[self.trajectory]
        self._start, self._turn = starts, np.exp(1j * starts[:, 2])
        self._signals = logs[0].signals.shape[1]
        self._cached: OrderedDict[bytes, AtStamps] = OrderedDict()
        self._descends = False

    @cached_property
    def driven(self) -> Array:
        """Integrals (S, M) of the signals up to each stamp, rad."""
        sums = next(iter(self._cached.values()), None) or self._of_all([np.zeros((3, self._signals))], slopes=False)[0]
        return sums.driven

    def poses(self, matrices: Array) -> Array:
        """Poses (P, S, 3) of candidate matrices (P, 3, M), see OdometryBatch."""
        one = len(matrices) == 1
        sums_by_matrix = [self._of(matrices[0], self._descends)] if one else self._of_all(matrices, slopes=False)
        result = np.empty((len(matrices), *self._start.shape))
        for poses, matrix, sums in zip(result, matrices, sums_by_matrix, strict=True):
            path = (sums.moved[:, 0] + 1j * sums.moved[:, 1]) * self._turn
            poses[:, 0], poses[:, 1] = self._start[:, 0] + path.real, self._start[:, 1] + path.imag
            poses[:, 2] = self._start[:, 2] + sums.driven @ matrix[2]
        return result

    def jacobian(self, matrix: Array) -> Array:
        """Derivatives (S, 3, 3, M) of the poses by the elements of one matrix, see OdometryBatch."""
        self._descends = True
        sums = self._of(matrix, slopes=True)
        assert sums.slopes is not None  # they were asked for
        row_12, row_3 = np.ascontiguousarray(sums.slopes).view(complex)
        return self._as_jacobian(row_12, row_3, sums.driven)

    def position_design(self, headings: Iterable[Array]) -> Complex:
        """Regressors (S, M) of positions for given headings, see OdometryBatch."""
        rest = iter(headings)
        return np.concatenate(
            [
                OdometryBatch(part, self.integration).position_design(list(islice(rest, len(part))))
                for part in together(self._logs)
            ]
        )

    def _of(self, matrix: Array, slopes: bool) -> AtStamps:
        """The sums for one matrix, from those of the last few if it is among them."""
        key = np.ascontiguousarray(matrix, dtype=float).tobytes()
        sums = self._cached.pop(key, None)
        if sums is None or (slopes and sums.slopes is None):
            while len(self._cached) >= _MATRICES:
                self._cached.popitem(last=False)
            (sums,) = self._of_all([matrix], slopes)
        self._cached[key] = sums
        return sums

    def _of_all(self, matrices: Sequence[Array] | Array, slopes: bool) -> list[AtStamps]:
        """The sums for some matrices, by one reading of the samples."""
        of_a_job = _TOGETHER if workers() is None else _PARTS_OF_A_JOB * _TOGETHER
        tasks = [(part, list(matrices), self.integration, slopes) for part in together(self._logs, of_a_job)]
        return _joined(gathered(workers(), sums_of_logs, tasks))


def sums_of_logs(task: tuple[Sequence[WheelLog], Sequence[Array], Integration, bool], _: Reporter) -> list[AtStamps]:
    """The sums of some logs for some matrices. The task: logs, matrices, integration, and whether slopes are wanted."""
    from omnibench.robot.compiled import path_sums  # numba, which only very many samples need

    logs, matrices, integration, slopes = task
    parts = []
    for part in together(logs):
        samples = RunSamples.of([log.times for log in part])
        signals = np.ascontiguousarray(np.concatenate([log.signals for log in part]))
        edges = np.cumsum([0, *(len(log.stamps) for log in part)])
        stamps, count, size = np.concatenate([log.stamps for log in part]), int(edges[-1]), signals.shape[1]
        sums = []
        for matrix in matrices:
            moved, driven = np.empty((count, 2)), np.empty((count, size))
            rows = np.empty((2, count if slopes else 1, size), dtype=complex)
            path_sums(
                samples.times, signals, samples.edges, stamps, edges, np.ascontiguousarray(matrix),
                integration == "arc", slopes, moved, rows[0], rows[1], driven,
            )  # fmt: skip
            sums.append(AtStamps(moved, driven, rows.view(float) if slopes else None))
        parts.append(sums)
    return _joined(parts)


def _joined(parts: Sequence[Sequence[AtStamps]]) -> list[AtStamps]:
    """The sums for each matrix over all parts, each of which has its sums by matrix. They have ``driven`` in common."""
    driven = np.concatenate([part[0].driven for part in parts])
    joined = []
    for of_matrix in zip(*parts, strict=True):
        slopes = [part.slopes for part in of_matrix if part.slopes is not None]
        moved = np.concatenate([part.moved for part in of_matrix])
        joined.append(AtStamps(moved, driven, np.concatenate(slopes, axis=1) if slopes else None))
    return joined
