"""Windows of long drives: a drive or few, cut into parts that serve as runs, each from its own reference pose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.noise import grouped

_ENOUGH = 30  # runs that are not cut: signs of fewer are flipped in too few ways for chances of 0.002 to be known well
_MOST = 60  # windows of all drives, at most; chosen
_SHORTEST = (
    4.0  # s, of a window: slip after a start has settled, and chance in the pose it begins with averages out; chosen
)


def in_windows(runs: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
    """The runs; where they are few, and no command is repeated, their parts of equal length."""
    repeated = any(len(members) > 1 for members in grouped([run.command or run.id for run in runs]))
    if repeated or len(runs) >= _ENOUGH:
        return tuple(runs)
    length = max(_SHORTEST, sum(run.end for run in runs) / _MOST)
    return tuple(window for run in runs for window in _windows(run, max(1, int(run.end / length))))


def _windows(run: Trajectory, count: int) -> Iterator[Trajectory]:
    """So many parts of a run, which begin and end at reference poses."""
    if count == 1:
        yield run
        return
    wanted = np.linspace(0.0, run.end, count + 1)
    edges = np.unique(np.clip(np.searchsorted(run.pose_times, wanted), 0, len(run.pose_times) - 1))
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        begin, end = float(run.pose_times[first]), float(run.pose_times[last])
        driven = slice(*np.searchsorted(run.times, [begin, end], side="right").tolist())
        driven = slice(driven.start, min(driven.stop + 1, len(run.times)))
        if last - first > 1 and driven.stop > driven.start:
            yield _part(run, driven, slice(first, last + 1), begin, end)


def _part(run: Trajectory, driven: slice, seen: slice, begin: float, end: float) -> Trajectory:
    fields = {
        name: value[driven]
        for name in ("rates", "angles", "targets", "steering", "odometry")
        if (value := getattr(run, name)) is not None
    }
    return replace(
        run,
        id=f"{run.id} ({begin:.1f} to {end:.1f} s)",
        times=run.times[driven] - begin,
        pose_times=run.pose_times[seen] - begin,
        poses=run.poses[seen],
        pose_covariances=None if run.pose_covariances is None else run.pose_covariances[seen],
        started_at=None if run.started_at is None else run.started_at + begin,
        command=None,
        sent=None,
        **fields,
    )
