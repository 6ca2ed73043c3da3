"""Odometry of runs whose samples are read where they are used: as OdometryBatch, without holding them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import numpy as np

from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex, Integration, OdometryBatch, RunSamples, WheelLog
from omnibench.robot.path_sums import path_sums

# Samples up to which an OdometryBatch holds them, in 0.1 kB each of three wheels (chosen: beyond, reading them anew and
# summing in compiled code takes a tenth of the time, too).
_HELD = 1_000_000
_TOGETHER = 500_000  # samples that are read together (chosen: as many as a block of a stored table)
_MATRICES = 3  # whose poses are kept: a descent goes on from one of the last (chosen)


def odometry_of(logs: Sequence[WheelLog], integration: Integration) -> OdometryBatch:
    """The odometry of logs, which holds their samples where these are few."""
    return (StoredOdometry if are_many(logs) else OdometryBatch)(logs, integration)


def are_many(logs: Sequence[WheelLog]) -> bool:
    """True if logs have so many samples that odometry should not hold them."""
    return sum(len(log.times) for log in logs) > _HELD


def together(logs: Iterable[WheelLog], samples: int = _TOGETHER) -> Iterator[list[WheelLog]]:
    """Logs in parts of about so many samples."""
    part, count = list[WheelLog](), 0
    for log in logs:
        if part and count + len(log.times) > samples:
            yield part
            part, count = [], 0
        part.append(log)
        count += len(log.times)
    if part:
        yield part


@dataclass(frozen=True, eq=False)
class _AtStamps:
    """Sums at the stamps for one matrix, see path_sums; slopes: None where they were not asked for."""

    moved: Array
    driven: Array
    slopes: tuple[Complex, Complex] | None


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
        self._kept: OrderedDict[bytes, _AtStamps] = OrderedDict()
        self._descends = False

    @cached_property
    def driven(self) -> Array:
        """Integrals (S, M) of the signals up to each stamp, rad."""
        kept = next(iter(self._kept.values()), None) or self._of_all([np.zeros((3, self._signals))], slopes=False)[0]
        return kept.driven

    def poses(self, matrices: Array) -> Array:
        """Poses (P, S, 3) of candidate matrices (P, 3, M), see OdometryBatch."""
        found = [self._of(matrices[0], self._descends)] if len(matrices) == 1 else self._of_all(matrices, slopes=False)
        result = np.empty((len(matrices), *self._start.shape))
        for poses, matrix, sums in zip(result, matrices, found, strict=True):
            path = (sums.moved[:, 0] + 1j * sums.moved[:, 1]) * self._turn
            poses[:, 0], poses[:, 1] = self._start[:, 0] + path.real, self._start[:, 1] + path.imag
            poses[:, 2] = self._start[:, 2] + sums.driven @ matrix[2]
        return result

    def jacobian(self, matrix: Array) -> Array:
        """Derivatives (S, 3, 3, M) of the poses by the elements of one matrix, see OdometryBatch."""
        self._descends = True
        sums = self._of(matrix, slopes=True)
        assert sums.slopes is not None  # they were asked for
        return self._as_jacobian(*sums.slopes, sums.driven)

    def position_design(self, headings: Iterable[Array]) -> Complex:
        """Regressors (S, M) of positions for given headings, see OdometryBatch."""
        rest = iter(headings)
        return np.concatenate(
            [
                OdometryBatch(part, self.integration).position_design(list(islice(rest, len(part))))
                for part in together(self._logs)
            ]
        )

    def _of(self, matrix: Array, slopes: bool) -> _AtStamps:
        key = np.ascontiguousarray(matrix, dtype=float).tobytes()
        kept = self._kept.get(key)
        if kept is None or (slopes and kept.slopes is None):
            while len(self._kept) >= _MATRICES:
                self._kept.popitem(last=False)
            (kept,) = self._of_all([matrix], slopes)
            self._kept[key] = kept
        return kept

    def _of_all(self, matrices: Sequence[Array] | Array, slopes: bool) -> list[_AtStamps]:
        """The sums for some matrices, by one reading of the samples."""
        parts = [[_sums(*part, matrix, self.integration, slopes) for matrix in matrices] for part in self._read()]
        return [_joined([of_part[index] for of_part in parts]) for index in range(len(matrices))]

    def _read(self) -> Iterator[tuple[RunSamples, Array, list[Array]]]:
        """Samples, signals (F, M) and stamps of the logs, some at a time."""
        for part in together(self._logs):
            samples = RunSamples.of([np.asarray(log.times) for log in part])
            signals = np.concatenate([np.asarray(log.signals) for log in part])
            yield samples, signals, [log.stamps for log in part]


def _sums(
    samples: RunSamples, signals: Array, stamps: Sequence[Array], matrix: Array, integration: Integration, slopes: bool
) -> _AtStamps:
    edges = np.cumsum([0, *map(len, stamps)])
    count, size = int(edges[-1]), signals.shape[1]
    moved, driven = np.empty((count, 2)), np.empty((count, size))
    row_12, row_3 = (np.empty((count if slopes else 1, size), dtype=complex) for _ in range(2))
    path_sums(
        samples.times, signals, samples.edges, np.concatenate(stamps), edges, np.ascontiguousarray(matrix),
        integration == "arc", slopes, moved, row_12, row_3, driven,
    )  # fmt: skip
    return _AtStamps(moved, driven, (row_12, row_3) if slopes else None)


def _joined(parts: Sequence[_AtStamps]) -> _AtStamps:
    """The sums of parts one after another."""
    slopes = [part.slopes for part in parts if part.slopes is not None]
    row_12, row_3 = ([each[row] for each in slopes] for row in range(2))
    return _AtStamps(
        np.concatenate([part.moved for part in parts]),
        np.concatenate([part.driven for part in parts]),
        (np.concatenate(row_12), np.concatenate(row_3)) if slopes else None,
    )
