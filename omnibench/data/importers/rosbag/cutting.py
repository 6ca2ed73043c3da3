"""Cutting of an unbroken stretch of a recording into runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from omnibench.robot.kinematics import Array
from omnibench.robot.planar import interpolated

_KEPT_REST = 0.5  # s of rest that are kept before and after a run (chosen)


@dataclass(frozen=True)
class Piece:
    """Time span of a run, begin and end in s. moving: how long the robot drives or may drive, s."""

    begin: float
    end: float
    moving: float
    command: str | None = None


@dataclass(frozen=True)
class Cut:
    """An instant (s) at which a run begins, and the command that is driven from then on."""

    time: float
    command: str | None


def find_rests(times: Array, angles: Array, least: float, turned: float) -> list[tuple[float, float]]:
    """Rests as (begin, end), s: no wheel's angle leaves a range of ``turned`` rad for at least ``least`` s.

    times (F + 1,): s. angles (F + 1, N): rad, at these times. The range is used and not the rate from sample to sample,
    because one encoder tick within a short sample is a high rate.
    """
    # (first, last) indices of the shortest spans of that length from each time on, and up to each time.
    every, enough = np.arange(len(times)), least * (1 - 1e-9)
    on = np.column_stack([every, np.searchsorted(times, times + enough)])
    back = np.column_stack([np.searchsorted(times, times - enough, side="right") - 1, every])
    spans = np.vstack([on[on[:, 1] < len(times)], back[back[:, 0] >= 0]])
    if not len(spans):
        return []
    # reduceat takes pairs (first, behind the last); every second result is that between two pairs.
    pairs = (spans + np.array([0, 1])).ravel()
    padded = np.vstack([angles, angles[-1:]])
    ranges = np.maximum.reduceat(padded, pairs)[::2] - np.minimum.reduceat(padded, pairs)[::2]
    quiet = spans[(ranges <= turned).all(axis=1)]
    balance = np.zeros(len(times) + 1, dtype=int)
    np.add.at(balance, quiet[:, 0], 1)
    np.add.at(balance, quiet[:, 1], -1)
    resting = np.cumsum(balance)[:-1] > 0  # (T,): the sample that begins at each time is at rest
    steps = np.flatnonzero(np.diff(resting.astype(int), prepend=0, append=0))
    return [(float(times[begin]), float(times[end])) for begin, end in zip(steps[::2], steps[1::2], strict=True)]


def between_rests(span: tuple[float, float], rests: Sequence[tuple[float, float]], stamps: Array) -> list[Piece]:
    """The drives between rests, each with a little rest at both ends, from a reference pose to another.

    stamps (K,): stamps of the reference poses, s. Drives on either side of a rest share at most an instant of it.
    """
    edges = [(span[0], span[0]), *rests, (span[1], span[1])]
    if rests and rests[0][0] == span[0]:
        edges = edges[1:]
    if rests and rests[-1][1] == span[1]:
        edges = edges[:-1]
    pieces = []
    for before, after in pairwise(edges):
        begin = _departure(before, before[0] > span[0], stamps)
        end = _arrival(after, after[1] < span[1], stamps)
        pieces.append(Piece(begin, end, after[0] - before[1]))
    return pieces


def windows(span: tuple[float, float], length: float) -> list[Piece]:
    """Pieces of ``length`` s one after the other; the last may be shorter."""
    begins = np.arange(span[0], span[1], length)
    ends = np.append(begins[1:], span[1])
    return [Piece(float(begin), float(end), float(end - begin)) for begin, end in zip(begins, ends, strict=True)]


def from_cuts(times: Array, angles: Array, cuts: Sequence[Cut], stamps: Array, turned: float) -> list[Piece]:
    """The pieces of a stretch (times and angles as for ``find_rests``) from each cut to the next.

    A piece begins at the last reference pose (``stamps``, s) before its cut if the wheels stood since then, so that
    nothing of the drive is lost. It has the command's name only if the stretch holds the command from its begin.
    """
    pieces = []
    for cut, following in zip(cuts, [*cuts[1:], None], strict=True):
        begin, end = max(cut.time, times[0]), min(following.time, times[-1]) if following else times[-1]
        if end <= begin:
            continue
        whole = begin == cut.time and (following is None or end == following.time)
        earlier = stamps[(stamps <= begin) & (stamps >= times[0])]
        start = float(earlier[-1]) if len(earlier) and _stood(times, angles, earlier[-1], begin, turned) else begin
        pieces.append(Piece(float(start), float(end), float(end - begin), cut.command if whole else None))
    return pieces


def _departure(rest: tuple[float, float], shared: bool, stamps: Array) -> float:
    """Begin of the run after a rest, s: at a reference pose of the rest, if it has one."""
    begin, end = rest
    target = max(end - _KEPT_REST, (begin + end) / 2 if shared else begin)
    inside = stamps[(stamps >= begin) & (stamps <= end)]
    if not len(inside):
        return target
    late = inside[inside >= target]
    return float(late[0] if len(late) else inside[-1])


def _arrival(rest: tuple[float, float], shared: bool, stamps: Array) -> float:
    """End of the run before a rest, s: at a reference pose of the rest, if it has one."""
    begin, end = rest
    return -_departure((-end, -begin), shared, -stamps[::-1])


def _stood(times: Array, angles: Array, begin: float, end: float, turned: float) -> bool:
    inside = interpolated(np.array([begin, end]), times, angles)
    between = angles[(times >= begin) & (times <= end)]
    return bool((np.ptp(np.vstack([inside, between]), axis=0) <= turned).all())
