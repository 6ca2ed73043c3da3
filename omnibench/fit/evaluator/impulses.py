"""Odometry as a sum of exponentials, and its cutting into segments that one expansion can express.

The displacement up to a stamp is x + iy = sum_i (m1 + i m2).a_i exp(i m3.c_i): an impulse a_i (wheel angles driven,
rad) in the heading that the robot has after the wheel angles c_i. An Euler step is one impulse. An arc is an integral
of exp(i m3.c) along the sample, taken by Gauss-Legendre quadrature, whose error is bounded by

    |error| <= |(m1 + i m2).a| * (q!)^4 / ((2q + 1) (2q)!^3) * (m3.a)^(2q)      for q nodes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, WheelLog

# Nodes of the quadrature, at most: samples that need more turn by radians. Half of it and twice change nothing
# (tests/studies/constants_fit.py).
_MOST_NODES = 8
# Pieces of a segment, at most, so that the time of cutting is linear in the length of a recording. Half of it and twice
# change nothing (tests/studies/constants_fit.py).
_LONGEST_SEGMENT = 4096


@dataclass(frozen=True)
class Path:
    """One log in pieces of samples, none of which has a stamp inside.

    angles, before (n, N): wheel angles driven in each piece and before its heading, rad. ends (S,): number of pieces
    up to each stamp. driven (S, N): wheel angles driven up to each stamp, rad.
    """

    angles: Array
    before: Array
    ends: NDArray[np.intp]
    driven: Array


@dataclass(frozen=True)
class Segment:
    """Pieces ``first`` to ``last`` (not included) of a path; ``anchor`` (N,): wheel angles that headings are about."""

    first: int
    last: int
    anchor: Array


def make_path(log: WheelLog, integration: Integration) -> Path:
    """The samples of a log up to its last stamp, cut where stamps lie within them."""
    bounds = np.concatenate([[0.0], log.times])
    stamps = np.minimum(log.stamps, log.times[-1])
    cuts = np.unique(np.concatenate([bounds[bounds < stamps[-1]], stamps]))
    cuts = np.unique(np.concatenate([[0.0], cuts]))
    sample = np.searchsorted(log.times, cuts[1:])
    durations = np.diff(bounds)
    driven = np.concatenate([np.zeros((1, log.signals.shape[1])), np.cumsum(log.signals * durations[:, None], axis=0)])
    angles = log.signals[sample] * np.diff(cuts)[:, None]
    before = driven[sample]
    if integration == "arc":  # an arc may be cut anywhere; an Euler step keeps the heading of its sample's start
        before = before + log.signals[sample] * (cuts[:-1] - bounds[sample])[:, None]
    ends = np.searchsorted(cuts, stamps)
    reached = np.concatenate([np.zeros((1, angles.shape[1])), np.cumsum(angles, axis=0)])
    return Path(angles, before, ends, reached[ends])


def quadrature(
    paths: Iterable[Path], row: Array, weight: Array, tolerance: float, integration: Integration
) -> int | None:
    """Gauss-Legendre nodes that a piece needs for an error of at most ``tolerance`` (m) over a path; None: too many.

    row (N,): the largest absolute elements of row 3; weight (N,): those of rows 1 and 2 together (m per rad).
    """
    if integration == "euler":
        return 1
    for nodes in range(1, _MOST_NODES + 1):
        factor = factorial(nodes) ** 4 / ((2 * nodes + 1) * factorial(2 * nodes) ** 3)
        worst = max(
            float((np.abs(path.angles) @ weight * (np.abs(path.angles) @ row) ** (2 * nodes)).sum()) for path in paths
        )
        if factor * worst <= tolerance:
            return nodes
    return None


def cut(path: Path, reach: Array, limit: float) -> list[Segment]:
    """Segments in which the box turns headings about the anchor's by at most ``limit``, rad.

    reach (N,): half-width of row 3's box. An infinite limit leaves the path whole, anchored at its start.
    """
    count, wheels = path.angles.shape
    if np.isinf(limit):
        return [Segment(0, count, np.zeros(wheels))]
    segments = []
    first = 0
    while first < count:
        window = slice(first, first + _LONGEST_SEGMENT)
        begin, end = path.before[window], path.before[window] + path.angles[window]
        low = np.minimum.accumulate(np.minimum(begin, end))
        high = np.maximum.accumulate(np.maximum(begin, end))
        fitting = int(np.searchsorted((high - low) @ reach / 2 > limit, True))
        length = max(1, fitting)
        segments.append(Segment(first, first + length, (low[length - 1] + high[length - 1]) / 2))
        first += length
    return segments


def impulses(path: Path, segment: Segment, integration: Integration, nodes: int) -> tuple[Array, Array]:
    """Impulses (n, q, N) of a segment's pieces and the wheel angles (n, q, N) of their headings about the anchor."""
    angles = path.angles[segment.first : segment.last, None, :]
    before = path.before[segment.first : segment.last, None, :] - segment.anchor
    if integration == "euler":
        return angles, before
    place, share = _gauss_legendre(nodes)
    return angles * share[:, None], before + angles * place[:, None]


def _gauss_legendre(nodes: int) -> tuple[Array, Array]:
    """Places and weights on [0, 1]."""
    place, weight = np.polynomial.legendre.leggauss(nodes)
    return (place + 1) / 2, weight / 2
