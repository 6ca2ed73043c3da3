"""Plan of the expansion of recordings: the cut into segments that makes a candidate cheapest.

Chebyshev expansion of sums of exponentials exp(i m3.c) over a box of row 3, with a proven bound of its error.

With m3 = centre + reach * d and d in [-1, 1]^N, each exponential is exp(i centre.c) times a product over the wheels of
(Jacobi-Anger)

    exp(i z d) = J_0(z) + 2 sum_n i^n J_n(z) T_n(d),        z = reach_j c_j.

Terms of total degree above D are left out. From |J_n(z)| <= |z/2|^n / n! they sum to at most
2^N sum_{n > D} (zeta/2)^n / n!, zeta = sum_j |z_j|.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

from omnibench.fit.evaluator.element_box import ElementBox
from omnibench.fit.evaluator.impulses import Path, Segment, cut, make_path, quadrature
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, WheelLog

# Terms of a basis, at most: it bounds memory. Half of it and twice choose the same bases
# (tests/studies/constants_fit.py).
_MOST_TERMS = 3000
# rad: beyond it the power series of J_n loses digits, since its alternating terms add up to I_0(4) = 11 (Abramowitz and
# Stegun 1964, 9.1.10 and 9.6.10). Half of it and twice choose the same bases (tests/studies/constants_fit.py).
_LARGEST_ANGLE = 4.0
_ROUNDING = 1e-17  # share of the first term of a power series: less than a tenth of the rounding of its sum


@dataclass(frozen=True)
class Basis:
    """Products of Chebyshev polynomials, one for each wheel, of total degree ``degree`` or less.

    orders (n, N): order of each wheel's polynomial in the n products; always 0 for an element without width.
    """

    degree: int
    orders: NDArray[np.intp]

    @classmethod
    def make(cls, degree: int, free: NDArray[np.bool_]) -> Basis:
        """All products of total degree ``degree`` or less in the free wheels (N,)."""
        ranges = (range(degree + 1) if wheel else range(1) for wheel in free)
        return cls(degree, np.array([orders for orders in product(*ranges) if sum(orders) <= degree], dtype=np.intp))

    def values(self, places: Array) -> Array:
        """The products (n, P) at places (P, N) in [-1, 1]."""
        angle = np.arccos(np.clip(places.T, -1.0, 1.0))
        polynomials = np.cos(angle[:, None, :] * np.arange(self.degree + 1)[:, None])  # (N, D + 1, P)
        first, *others = self.orders.T
        values: Array = polynomials[0][first]
        for wheel, orders in enumerate(others, 1):
            values *= polynomials[wheel][orders]
        return values

    def coefficients(self, angles: Array) -> Array:
        """Coefficients (n, M) of exp(i sum_j z_j d_j) for z = angles (M, N), each to be times i^(total degree)."""
        factors = _bessel(angles.T, self.degree)  # (N, D + 1, M)
        first, *others = self.orders.T
        values: Array = factors[0][first]
        for wheel, orders in enumerate(others, 1):
            values *= factors[wheel][orders]
        return values

    @property
    def quarter_turns(self) -> NDArray[np.intp]:
        """Total degree (n,) modulo 4: the power of i that belongs to each term."""
        turns: NDArray[np.intp] = self.orders.sum(axis=1) % 4
        return turns


def degree_for(
    zeta: Array, steps: Array, firsts: NDArray[np.intp], tolerance: float, wheels: int
) -> tuple[int | None, float]:
    """Lowest degree whose truncation error over every path is within ``tolerance`` (m), and the bound of that error.

    zeta (M,): sum of the angles |z_j| of each exponential, rad. steps (M,): its factor, m. firsts (Z,): index of each
    path's first exponential. The degree is None if it would need too many terms.
    """
    if zeta.max(initial=0.0) > _LARGEST_ANGLE:
        return None, 0.0
    half, power = zeta / 2, steps * truncation_factor(zeta, wheels)
    degree = -1
    while True:
        degree += 1
        if comb(degree + wheels, wheels) > _MOST_TERMS:
            return None, 0.0
        power = power * half / (degree + 1)
        neglected = float(np.add.reduceat(power, firsts).max())
        if neglected <= tolerance:
            return degree, neglected


def truncation_factor(zeta: Array, wheels: int) -> Array:
    """The factor of (zeta/2)^(D + 1) / (D + 1)! in the bound of the terms above degree D.

    It follows from sum_{n > D} x^n / n! <= x^(D + 1) / (D + 1)! * exp(x).
    """
    factor: Array = 2.0**wheels * np.exp(zeta / 2)
    return factor


def _bessel(angles: Array, degree: int) -> Array:
    """J_0, 2 J_1, ..., 2 J_degree at angles (N, M): (N, degree + 1, M).

    With J_n(z) = (z/2)^n j_n(z) the downward recurrence j_{n-1} = n j_n - (z/2)^2 j_{n+1} is stable and free of
    divisions; it starts from the power series of the two highest orders.
    """
    half = angles / 2
    square = half * half
    scaled: Array = np.empty((len(angles), degree + 2, angles.shape[1]))
    for order in (degree + 1, degree):
        scaled[:, order] = _power_series(order, square)
    for order in range(degree, 0, -1):
        scaled[:, order - 1] = order * scaled[:, order] - square * scaled[:, order + 1]
    power = 2 * half
    for order in range(1, degree + 1):
        scaled[:, order] *= power
        power = power * half
    return scaled[:, : degree + 1]


def _power_series(order: int, square: Array) -> Array:
    """sum_m (-square)^m / (m! (order + m)!), to rounding."""
    largest = float(square.max(initial=0.0))
    terms = 1
    while largest**terms / (factorial(terms) * factorial(order + terms)) * factorial(order) > _ROUNDING:
        terms += 1
    total = np.full(square.shape, 1.0 / (factorial(terms) * factorial(order + terms)))
    for m in range(terms - 1, -1, -1):
        total *= -square
        total += 1.0 / (factorial(m) * factorial(order + m))
    return total


# Largest error of a position by truncation, by quadrature and by the decomposition, as shares of the longest path (at
# least 1 m): some ten times the rounding of direct integration. They bound sums of absolute values; half of each and
# twice change costs by 1e-13 m and the memory by a tenth at most (tests/studies/constants_fit.py).
_TRUNCATION, _QUADRATURE, _DECOMPOSITION = 1e-12, 1e-12, 5e-12
# The numbers from here on decide only which way is faster (bench_evaluator.py). Half of each and twice change costs by
# 5e-14 m and the memory by less than a factor of two (tests/studies/constants_fit.py).
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
