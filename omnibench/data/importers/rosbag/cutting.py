"""Cutting of an unbroken stretch of a recording into runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from omnibench.data.importers.runs.rests import departure
from omnibench.robot.kinematics import Array
from omnibench.robot.planar import interpolated


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
        begin = departure(before, before[0] > span[0], stamps)
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


def _arrival(rest: tuple[float, float], shared: bool, stamps: Array) -> float:
    """End of the run before a rest, s: at a reference pose of the rest, if it has one."""
    begin, end = rest
    return -departure((-end, -begin), shared, -stamps[::-1])


def _stood(times: Array, angles: Array, begin: float, end: float, turned: float) -> bool:
    inside = interpolated(np.array([begin, end]), times, angles)
    between = angles[(times >= begin) & (times <= end)]
    return bool((np.ptp(np.vstack([inside, between]), axis=0) <= turned).all())
