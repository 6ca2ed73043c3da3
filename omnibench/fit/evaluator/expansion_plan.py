"""Plan of the expansion of recordings: the cut into segments that makes a candidate cheapest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from omnibench.fit.evaluator.element_box import ElementBox
from omnibench.fit.evaluator.expansion import Basis, degree_for
from omnibench.fit.evaluator.impulses import Path, Segment, cut, make_path, quadrature
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, WheelLog

# Largest error of a position by truncation, by quadrature and by the decomposition, as shares of the longest path (at
# least 1 m): some ten times the rounding of direct integration. They bound sums of absolute values; half of each and
# twice change costs by 1e-13 m and the memory by a tenth at most (tests/benchmarks/constants_fit.py).
_TRUNCATION, _QUADRATURE, _DECOMPOSITION = 1e-12, 1e-12, 5e-12
# The numbers from here on decide only which way is faster (bench_evaluator.py). Half of each and twice change costs by
# 5e-14 m and the memory by less than a factor of two (tests/benchmarks/constants_fit.py).
# How far the box may turn the heading of a segment about its anchor, rad; infinity leaves recordings whole.
_LIMITS = (np.inf, 2.0, 1.0, 0.5, 0.25)
# Time that a sample of direct integration, a segment and a term of the basis take, in units of one multiplication and
# addition of a matrix product.
_SAMPLE, _SEGMENT, _TERM = 400.0, 1000.0, 100.0
_MOST_BYTES = 48e6  # bytes of the large matrix product, at most
_RANK, _POWER = 1.65, 0.7  # likely rank of the decomposition of n terms: a power law through omnibench's recordings
_NO_WIDTH = 1e-14  # share of row 3's largest element: one with less width in the box is fixed, up to rounding


@dataclass(frozen=True, eq=False)
class ExpansionPlan:
    """Logs cut into segments, the basis of their expansion, and bounds of what is neglected.

    paths, segments: one for each log. nodes: number of quadrature nodes within a piece. free (N,): wheels whose element
    of row 3 has a width in the box. error: bound of truncation and quadrature, m. spare: what the decomposition may
    neglect in a row, m. A row is a place on a path where a displacement is wanted: a stamp, or the start of the next
    segment.
    """

    logs: Sequence[WheelLog]
    box: ElementBox
    integration: Integration
    paths: list[Path]
    segments: list[list[Segment]]
    nodes: int
    basis: Basis
    free: NDArray[np.bool_]
    error: float
    spare: float

    def row_ends(self, index: int) -> list[tuple[Segment, list[int]]]:
        """The segments of a path, each with the number of pieces up to each of its rows."""
        path, segments = self.paths[index], self.segments[index]
        rows = []
        for number, segment in enumerate(segments, 1):
            stamps = path.ends[(path.ends > segment.first) & (path.ends <= segment.last)]
            onward = [segment.last] if number < len(segments) else []
            rows.append((segment, sorted({*stamps.tolist(), *onward})))
        return rows


def make_plan(logs: Sequence[WheelLog], integration: Integration, box: ElementBox) -> ExpansionPlan | None:
    """The cheapest plan for matrices in a box; None where direct integration is faster."""
    if any(len(log.stamps) == 0 or log.stamps[0] <= 0 for log in logs) or not np.isfinite(box.reach).all():
        return None
    paths = [make_path(log, integration) for log in logs]
    row, speed = box.largest[2], box.speed
    lengths = [float((np.abs(path.angles) @ speed).sum()) for path in paths]
    length = max(1.0, *lengths)
    nodes = quadrature(paths, row, speed, _QUADRATURE * length, integration)
    if nodes is None:
        return None
    free = box.reach[2] > _NO_WIDTH * np.abs(box.centre[2]).max()
    wheels = int(free.sum())
    steps = np.concatenate([np.abs(path.angles) @ speed for path in paths])
    firsts = np.cumsum([0, *(len(path.angles) for path in paths[:-1])])
    cheapest, chosen = _SAMPLE * len(steps), None
    for limit in _LIMITS:
        segments = [cut(path, box.reach[2], limit) for path in paths]
        zeta = np.concatenate(
            [_largest_turns(path, parts, box.reach[2]) for path, parts in zip(paths, segments, strict=True)]
        )
        degree, neglected = degree_for(zeta, steps, firsts, _TRUNCATION * length, wheels)
        if degree is None:
            continue
        terms, count = comb(degree + wheels, wheels), sum(map(len, segments))
        rows = max(sum(len(path.ends) for path in paths), count)
        rank = _likely_rank(terms)
        values = 2 * len(row) * rows * rank
        cost = values + terms * (rank + _TERM) + (0.0 if np.isinf(limit) else _SEGMENT * count)
        if 8 * values < _MOST_BYTES and cost < cheapest:
            cheapest, chosen = cost, (segments, degree, neglected)
    if chosen is None:
        return None
    segments, degree, neglected = chosen
    error = _QUADRATURE * length * (nodes > 1) + neglected
    spare = _DECOMPOSITION * length / max(map(len, segments))
    basis = Basis.make(degree, free)
    return ExpansionPlan(logs, box, integration, paths, segments, nodes, basis, free, error, spare)


def _likely_rank(terms: int) -> float:
    """Rank that the decomposition will have for so many terms."""
    return min(float(terms), _RANK * terms**_POWER)


def _largest_turns(path: Path, segments: list[Segment], reach: Array) -> Array:
    """The most (n,) that the box turns the heading of each piece about its anchor, rad."""
    anchors = np.repeat([s.anchor for s in segments], [s.last - s.first for s in segments], axis=0)
    begin = path.before - anchors
    turns: Array = np.maximum(np.abs(begin), np.abs(begin + path.angles)) @ reach
    return turns
