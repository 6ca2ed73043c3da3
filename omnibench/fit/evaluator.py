"""Poses of many candidate matrices at once, from moments of the wheel angles that were summed up once.

For a given row 3 of the matrix positions are linear in rows 1 and 2 (odometry.py): the displacement up to a stamp is
the sum of exponentials

    x + iy = sum_i (m1 + i m2).a_i exp(i m3.c_i),                                                 (1)

an impulse a_i (wheel angles driven, rad) in the heading that the robot has after the wheel angles c_i. The regressors

    G_j(m3) = sum_i a_ij exp(i m3.c_i)                                                            (2)

are smooth functions of row 3 alone. Over a box they are expanded once in Chebyshev polynomials (the class Basis), of
which a singular value decomposition leaves some hundred combinations. The poses of a population then are two matrix
products, whatever the sampling rate. A recording whose heading the box turns too far for one expansion is cut into
segments, each in the frame of its anchor, whose heading is linear in row 3 too; they are joined in the end. Of the
cuts the one is taken that makes a candidate cheapest (make_plan). Runs that are read from files have an evaluator for
each part of them.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import product
from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

from omnibench.fit.geometry import Parameterisation
from omnibench.fit.parameterisation import MatrixElements
from omnibench.processes import one_thread
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex, Integration, OdometryBatch, WheelLog
from omnibench.robot.stored_odometry import parts_of

# Share by which the box of a curved parameterisation is widened beyond its linear reach. Candidates outside are
# integrated directly, so that it decides on speed alone: half of it and twice change costs by 4e-14 m and the memory by
# a third at most (tests/studies/constants_fit.py).
_MARGIN = 0.1
_WIDENED = 1e-9, 1e-15  # shares of the reach and of a row's largest element by which a box is widened against rounding
# Nodes of the quadrature, at most: samples that need more turn by radians. Half of it and twice change nothing
# (tests/studies/constants_fit.py).
_MOST_NODES = 8
# Pieces of a segment, at most, so that the time of cutting is linear in the length of a recording. Half of it and twice
# change nothing (tests/studies/constants_fit.py).
_LONGEST_SEGMENT = 4096
# Terms of a basis, at most: it bounds memory. Half of it and twice choose the same bases
# (tests/studies/constants_fit.py).
_MOST_TERMS = 3000
# rad: beyond it the power series of J_n loses digits, since its alternating terms add up to I_0(4) = 11 (Abramowitz and
# Stegun 1964, 9.1.10 and 9.6.10). Half of it and twice choose the same bases (tests/studies/constants_fit.py).
_LARGEST_ANGLE = 4.0
_LAST_TERM = 1e-17  # share of the first term of a power series: less than a tenth of the rounding of its sum
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
# Share of the largest pose: rounding of a direct sum of some thousand samples, which the check allows beside the bound.
_ROUNDING = 1e-12
# Values of the large product at a time, 2 MB, so that they stay in the processor's cache. It changes the order of sums
# alone, hence costs by 1e-16 m (tests/studies/constants_fit.py); bench_evaluator.py measures the speed.
_BLOCK = 250_000


@dataclass(frozen=True, eq=False)
class ElementBox:
    """Bounds ``lower`` and ``upper`` (3, N) of the matrix elements."""

    lower: Array
    upper: Array

    @classmethod
    def of(
        cls, parameterisation: Parameterisation, lower: Array, upper: Array, frame: DrivenFrame | None = None
    ) -> ElementBox:
        """The box around the matrices of all vectors between ``lower`` and ``upper`` (n,), in a frame if there is one.

        It holds all of them where the matrix is linear in the vector, and nearly all where it is curved.
        """
        middle, half = (lower + upper) / 2, (upper - lower) / 2
        matrices = parameterisation.matrices(middle + np.vstack([np.zeros(len(half)), np.diag(half)]))
        centre, *moved = matrices if frame is None else frame.seen(matrices)
        reach: Array = np.abs(np.array(moved) - centre).sum(axis=0)
        reach *= 1 + (_WIDENED[0] if parameterisation.name == "matrix" else _MARGIN)
        slack = _WIDENED[1] * np.abs(centre).max(axis=1, keepdims=True)
        return cls(centre - reach - slack, centre + reach + slack)

    @property
    def centre(self) -> Array:
        """The middle (3, N)."""
        return (self.lower + self.upper) / 2

    @property
    def reach(self) -> Array:
        """Half-widths (3, N)."""
        return (self.upper - self.lower) / 2

    @property
    def largest(self) -> Array:
        """The largest magnitudes (3, N) of the elements."""
        return np.maximum(np.abs(self.lower), np.abs(self.upper))

    @property
    def speed(self) -> Array:
        """The largest |m1j + i m2j| (N,) in the box, m per rad."""
        return np.asarray(np.hypot(*self.largest[:2]))


@dataclass(frozen=True, eq=False)
class DrivenFrame:
    """Coordinates of recordings and matrices: the directions that the recordings drive.

    Along directions that a calibration keeps at the design K0, matrices do not differ. With orthonormal rows Q (r, M)
    of the others, a matrix K moves the robot by

        K u = (K Q') (Q u) + K0 (u - Q'Q u),                                                      (3)

    so that it is a matrix of r + 3 columns, K Q' and the identity, for the signals Q u and the design's twist by the
    rest. The evaluator's expansion grows fast with the number of columns whose row 3 varies, which are then r in the
    place of M: three for a mecanum base that does not slip, and for a swerve base whose modules are steered as they
    should be. driven: Q. design: K0 (3, M).
    """

    driven: Array
    design: Array

    def seen(self, matrices: Array) -> Array:
        """Matrices (P, 3, M) in the frame, (P, 3, r + 3)."""
        rest = np.broadcast_to(np.eye(3), (len(matrices), 3, 3))
        return np.concatenate([matrices @ self.driven.T, rest], axis=2)

    def log(self, log: WheelLog) -> WheelLog:
        """A log whose signals are those of the frame."""
        along = log.signals @ self.driven.T
        rest = (log.signals - along @ self.driven) @ self.design.T
        return replace(log, rates=np.hstack([along, rest]), wheel_angles=None, steering=None, drive=None)


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

    An Euler step is one impulse of Eq. (1). An arc is an integral of exp(i m3.c) along the sample, whose error with q
    nodes is bounded by

        |error| <= |(m1 + i m2).a| * (q!)^4 / ((2q + 1) (2q)!^3) * (m3.a)^(2q).                   (4)

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


def cut(path: Path, reach: Array, limit: float) -> tuple[NDArray[np.intp], Array]:
    """Segments in which the box turns headings about the anchor's by at most ``limit``, rad.

    reach (N,): half-width of row 3's box. An infinite limit leaves the path whole, anchored at its start. Returns edges
    (G + 1,): the first piece of each segment, and the number of pieces; and the anchors (G, N): wheel angles.
    """
    count, wheels = path.angles.shape
    if np.isinf(limit):
        return np.array([0, count]), np.zeros((1, wheels))
    edges, anchors = [0], []
    while edges[-1] < count:
        window = slice(edges[-1], edges[-1] + _LONGEST_SEGMENT)
        begin, end = path.before[window], path.before[window] + path.angles[window]
        low = np.minimum.accumulate(np.minimum(begin, end))
        high = np.maximum.accumulate(np.maximum(begin, end))
        length = max(1, int(np.searchsorted((high - low) @ reach / 2 > limit, True)))
        edges.append(edges[-1] + length)
        anchors.append((low[length - 1] + high[length - 1]) / 2)
    return np.array(edges), np.array(anchors)


def impulses(
    path: Path, integration: Integration, nodes: int, pieces: slice = slice(None), anchor: Array | float = 0.0
) -> tuple[Array, Array]:
    """Impulses (n, q, N) of some pieces and the wheel angles (n, q, N) of their headings about the anchor (N,)."""
    angles, before = path.angles[pieces, None, :], path.before[pieces, None, :] - anchor
    if integration == "euler":
        return angles, before
    place, weight = np.polynomial.legendre.leggauss(nodes)  # on [-1, 1]
    return angles * (weight / 2)[:, None], before + angles * ((place + 1) / 2)[:, None]


@dataclass(frozen=True)
class Basis:
    """Products of Chebyshev polynomials, one for each wheel, of total degree ``degree`` or less.

    With m3 = centre + reach * d and d in [-1, 1]^N, each exponential is exp(i centre.c) times a product over the wheels
    of (Jacobi-Anger)

        exp(i z d) = J_0(z) + 2 sum_n i^n J_n(z) T_n(d),        z = reach_j c_j.                  (5)

    orders (n, N): order of each wheel's polynomial in the n products; always 0 for an element without width.
    """

    degree: int
    orders: NDArray[np.intp]

    def values(self, places: Array) -> Array:
        """The products (n, P) at places (P, N) in [-1, 1]."""
        angle = np.arccos(np.clip(places.T, -1.0, 1.0))
        return self._products(np.cos(angle[:, None, :] * np.arange(self.degree + 1)[:, None]))

    def coefficients(self, angles: Array) -> Array:
        """Coefficients (n, M) of exp(i sum_j z_j d_j) for z = angles (M, N), each to be times i^(total degree)."""
        return self._products(_bessel(angles.T, self.degree))

    def _products(self, factors: Array) -> Array:
        """Products (n, P) of each wheel's factor (N, degree + 1, P) of its order."""
        first, *others = self.orders.T
        values: Array = factors[0][first]
        for wheel, orders in enumerate(others, 1):
            values *= factors[wheel][orders]
        return values


def degree_for(
    zeta: Array, steps: Array, firsts: NDArray[np.intp], tolerance: float, wheels: int
) -> tuple[int | None, float]:
    """Lowest degree whose truncation error over every path is within ``tolerance`` (m), and the bound of that error.

    From |J_n(z)| <= |z/2|^n / n! the terms of total degree above D sum to at most

        2^N sum_{n > D} (zeta/2)^n / n! <= 2^N exp(zeta/2) (zeta/2)^(D + 1) / (D + 1)!,    zeta = sum_j |z_j|.    (6)

    zeta (M,): sum of the angles |z_j| of each exponential, rad. steps (M,): its factor, m. firsts (Z,): index of each
    path's first exponential. The degree is None if it would need too many terms.
    """
    if zeta.max(initial=0.0) > _LARGEST_ANGLE:
        return None, 0.0
    half, power, degree = zeta / 2, steps * (2.0**wheels * np.exp(zeta / 2)), 0
    while comb(degree + wheels, wheels) <= _MOST_TERMS:
        power = power * half / (degree + 1)
        neglected = float(np.add.reduceat(power, firsts).max())
        if neglected <= tolerance:
            return degree, neglected
        degree += 1
    return None, 0.0


def _bessel(angles: Array, degree: int) -> Array:
    """J_0, 2 J_1, ..., 2 J_degree at angles (N, M): (N, degree + 1, M).

    With J_n(z) = (z/2)^n j_n(z) the downward recurrence j_{n-1} = n j_n - (z/2)^2 j_{n+1} is stable and free of
    divisions; it starts from the power series of the two highest orders.
    """
    half = angles / 2
    square = half * half
    scaled: Array = np.empty((len(angles), degree + 2, angles.shape[1]))
    largest = float(square.max(initial=0.0))
    for order in (degree + 1, degree):  # sum_m (-square)^m / (m! (order + m)!), to rounding
        terms = 1
        while largest**terms / (factorial(terms) * factorial(order + terms)) * factorial(order) > _LAST_TERM:
            terms += 1
        total = np.full(square.shape, 1.0 / (factorial(terms) * factorial(order + terms)))
        for m in range(terms - 1, -1, -1):
            total *= -square
            total += 1.0 / (factorial(m) * factorial(order + m))
        scaled[:, order] = total
    for order in range(degree, 0, -1):
        scaled[:, order - 1] = order * scaled[:, order] - square * scaled[:, order + 1]
    power = 2 * half
    for order in range(1, degree + 1):
        scaled[:, order] *= power
        power = power * half
    return scaled[:, : degree + 1]


@dataclass(frozen=True, eq=False)
class ExpansionPlan:
    """Logs cut into segments, the basis of their expansion, and bounds of what is neglected.

    paths, segments: one for each log, see ``cut``. nodes: number of quadrature nodes within a piece. free (N,): wheels
    whose element of row 3 has a width in the box. error: bound of truncation and quadrature, m. spare: what the
    decomposition may neglect in a row, m. A row is a place on a path where a displacement is wanted: a stamp, or the
    start of the next segment.
    """

    logs: Sequence[WheelLog]
    box: ElementBox
    integration: Integration
    paths: list[Path]
    segments: list[tuple[NDArray[np.intp], Array]]
    nodes: int
    basis: Basis
    free: NDArray[np.bool_]
    error: float
    spare: float


def make_plan(logs: Sequence[WheelLog], integration: Integration, box: ElementBox) -> ExpansionPlan | None:
    """The cheapest plan for matrices in a box; None where direct integration is faster."""
    if any(len(log.stamps) == 0 or log.stamps[0] <= 0 for log in logs) or not np.isfinite(box.reach).all():
        return None
    paths = [make_path(log, integration) for log in logs]
    row, speed = box.largest[2], box.speed
    steps_of = [np.abs(path.angles) @ speed for path in paths]
    length = max(1.0, *(float(of_path.sum()) for of_path in steps_of))
    nodes = quadrature(paths, row, speed, _QUADRATURE * length, integration)
    if nodes is None:
        return None
    free = box.reach[2] > _NO_WIDTH * np.abs(box.centre[2]).max()
    wheels = int(free.sum())
    steps, firsts = np.concatenate(steps_of), np.cumsum([0, *map(len, steps_of[:-1])])
    cheapest, chosen = _SAMPLE * len(steps), None
    for limit in _LIMITS:
        segments = [cut(path, box.reach[2], limit) for path in paths]
        turns = []  # the most (n,) that the box turns the heading of each piece about its anchor, rad
        for path, (edges, anchors) in zip(paths, segments, strict=True):
            begin = path.before - np.repeat(anchors, np.diff(edges), axis=0)
            turns.append(np.maximum(np.abs(begin), np.abs(begin + path.angles)) @ box.reach[2])
        zeta = np.concatenate(turns)
        degree, neglected = degree_for(zeta, steps, firsts, _TRUNCATION * length, wheels)
        if degree is None:
            continue
        terms, count = comb(degree + wheels, wheels), sum(len(anchors) for _, anchors in segments)
        rows = max(sum(len(path.ends) for path in paths), count)
        rank = min(float(terms), _RANK * terms**_POWER)
        values = 2 * len(row) * rows * rank
        cost = values + terms * (rank + _TERM) + (0.0 if np.isinf(limit) else _SEGMENT * count)
        if 8 * values < _MOST_BYTES and cost < cheapest:
            cheapest, chosen = cost, (segments, degree, neglected)
    if chosen is None:
        return None
    segments, degree, neglected = chosen
    error = _QUADRATURE * length * (nodes > 1) + neglected
    spare = _DECOMPOSITION * length / max(len(anchors) for _, anchors in segments)
    ranges = (range(degree + 1) if wheel else range(1) for wheel in free)
    orders = np.array([orders for orders in product(*ranges) if sum(orders) <= degree], dtype=np.intp)
    return ExpansionPlan(logs, box, integration, paths, segments, nodes, Basis(degree, orders), free, error, spare)


def compress(moments: Array, plan: ExpansionPlan) -> tuple[Array, float]:
    """The fewest combinations (n, K) of terms that keep every row of moments (R, 2N, n) to ``plan.spare``.

    Also returns a bound of what they neglect over a path, m: polynomials are at most 1, so it is a sum of residuals.
    """
    rows, components, terms = moments.shape
    speed = np.tile(plan.box.speed, 2)
    scaled = (moments * speed[:, None]).reshape(-1, terms)
    _, _, directions = np.linalg.svd(np.linalg.qr(scaled, mode="r"), full_matrices=False)

    def neglected(count: int) -> float:
        used = directions[:count]
        residual = np.abs(scaled - (scaled @ used.T) @ used).sum(axis=1).reshape(rows, 2, components // 2)
        return float(np.hypot(residual[:, 0], residual[:, 1]).sum(axis=1).max())

    fewest = bisect_left(range(len(directions)), True, key=lambda count: neglected(count) <= plan.spare)
    return directions[:fewest].T, neglected(fewest) * max(len(anchors) for _, anchors in plan.segments)


class PoseEvaluator:
    """Poses at the stamps of some logs, for candidate matrices in a box. Made by :func:`make_evaluator`.

    error_bound: largest difference of a position from direct integration, m. size: memory that is kept, bytes.
    combinations: number of those of polynomials that stand for the recordings. segments: that these are cut into.
    """

    def __init__(self, plan: ExpansionPlan) -> None:
        self._basis, self._centre = plan.basis, plan.box.centre[2]
        self._scale = np.where(plan.free, plan.box.reach[2], 1.0)
        # Indices that join rows, segments and stamps: the segment of each row, the first segment of each segment's log,
        # the row and the log of each stamp.
        row_ends, segment_of_row, first_of_log, row_of_stamp = [], list[int](), list[int](), list[int]()
        for path, (edges, anchors) in zip(plan.paths, plan.segments, strict=True):
            ends = np.union1d(path.ends, edges[1:-1])  # pieces up to each row
            row_of_stamp += (len(segment_of_row) + np.searchsorted(ends, path.ends)).tolist()
            row_ends.append(ends)
            segment_of_row += (len(first_of_log) + np.searchsorted(edges, ends) - 1).tolist()
            first_of_log += [len(first_of_log)] * len(anchors)
        self._anchors = np.concatenate([anchors for _, anchors in plan.segments])  # (G, N), rad
        self._segment_of_row, self._first_of_log = np.array(segment_of_row), np.array(first_of_log)
        self._row_of_stamp = np.array(row_of_stamp)
        self._last_row = np.searchsorted(self._segment_of_row, np.arange(len(self._anchors)), side="right") - 1
        moments = moments_of(plan, row_ends)
        combinations, dropped = compress(moments, plan)
        rows, components, terms = moments.shape
        left = (moments.reshape(-1, terms) @ combinations).reshape(rows, components, -1)
        self._product = np.ascontiguousarray(np.transpose(left, (2, 1, 0)).reshape(-1, components * rows))  # (K, 2N R)
        self._combinations = np.ascontiguousarray(combinations.T)  # (K, n)
        starts = np.array([log.start for log in plan.logs])
        self._start = np.ascontiguousarray(np.repeat(starts, [len(path.ends) for path in plan.paths], axis=0).T)
        self._driven = np.concatenate([path.driven for path in plan.paths]).T
        self.error_bound = plan.error + dropped
        self.size = sum(kept.nbytes for kept in (self._product, self._combinations, self._driven, self._start))
        self.combinations, self.segments = len(self._combinations), len(self._anchors)

    def poses(self, matrices: Array) -> Array:
        """Poses (P, S, 3) in m, m, rad of matrices (P, 3, N) in the box. Headings are not wrapped."""
        result = np.empty((len(matrices), *self._start.shape))
        block = max(1, _BLOCK // self._product.shape[1])
        with nullcontext() if len(matrices) == 1 else one_thread():
            for first in range(0, len(matrices), block):
                part = matrices[first : first + block]
                # x and y (P, 2, R) of every row relative to its segment's start, in the frame of its anchor, m.
                features = self._combinations @ self._basis.values((part[:, 2] - self._centre) / self._scale)
                weights = np.concatenate([part[:, 0], -part[:, 1], part[:, 1], part[:, 0]], axis=1)
                regressors = (features.T @ self._product).reshape(len(part), weights.shape[1] // 2, -1)
                displacements = weights.reshape(len(part), 2, -1) @ regressors
                np.add(self._joined(displacements, part), self._start[:2], out=result[first : first + block, :2])
            np.add(matrices[:, 2] @ self._driven, self._start[2], out=result[:, 2])
        return np.swapaxes(result, 1, 2)

    def _joined(self, displacements: Array, matrices: Array) -> Array:
        """x and y (P, 2, S) relative to the start, m, from displacements (P, 2, R) within the rows' segments."""
        if not self._anchors.any():  # uncut: the anchors are the starts
            alike = len(self._segment_of_row) == len(self._row_of_stamp)
            return displacements if alike else displacements[:, :, self._row_of_stamp]
        phase = matrices[:, 2] @ self._anchors.T
        turn: Complex = (np.cos(phase) + 1j * np.sin(phase))[:, self._segment_of_row]
        moved = (displacements[:, 0] + 1j * displacements[:, 1]) * turn
        before = np.zeros((len(matrices), self.segments + 1), dtype=complex)
        np.cumsum(moved[:, self._last_row], axis=1, out=before[:, 1:])
        carried = before[:, :-1] - before[:, self._first_of_log]
        path = (moved + carried[:, self._segment_of_row])[:, self._row_of_stamp]
        return np.stack([path.real, path.imag], axis=1)


def moments_of(plan: ExpansionPlan, row_ends: Sequence[NDArray[np.intp]]) -> Array:
    """Coefficients (R, 2N, n) of the regressors at the R rows of all logs: real parts of the N wheels, then imaginary.

    row_ends: pieces up to each row of each log. n: terms of the plan's basis.
    """
    centre, reach = plan.box.centre[2], np.where(plan.free, plan.box.reach[2], 0.0)
    quarter_turns = (plan.basis.orders.sum(axis=1) % 4)[:, None]
    moments = []
    for path, log, (edges, anchors), ends in zip(plan.paths, plan.logs, plan.segments, row_ends, strict=True):
        rows = []  # sums (n, 2N) of cosines and sines up to each row
        for first, last, anchor in zip(edges[:-1].tolist(), edges[1:].tolist(), anchors, strict=True):
            angles, about = impulses(path, plan.integration, plan.nodes, slice(first, last), anchor)
            heading = about @ centre + log.start[2]
            sources = np.concatenate([angles * np.cos(heading)[..., None], angles * np.sin(heading)[..., None]], axis=2)
            wheels = about.shape[2]
            coefficients = plan.basis.coefficients(about.reshape(-1, wheels) * reach)
            total, begin = 0.0, 0
            for end in (ends[(ends > first) & (ends <= last)] - first).tolist():
                summed = slice(begin * plan.nodes, end * plan.nodes)
                total = total + coefficients[:, summed] @ sources[begin:end].reshape(-1, 2 * wheels)
                begin = end
                rows.append(total)
        # Each term is to be times i^(total degree), Eq. (5).
        cosine, sine = np.split(np.array(rows), 2, axis=2)
        real = np.choose(quarter_turns, [cosine, -sine, -cosine, sine])
        imaginary = np.choose(quarter_turns, [sine, cosine, -sine, -cosine])
        moments.append(np.concatenate([real, imaginary], axis=2))
    return np.ascontiguousarray(np.swapaxes(np.concatenate(moments), 1, 2))


def make_evaluator(
    odometry: OdometryBatch, logs: Sequence[WheelLog], integration: Integration, box: ElementBox
) -> PoseEvaluator | None:
    """The evaluator of logs for matrices in a box, checked against direct integration by ``odometry``.

    None where direct integration is faster, or the check finds a larger error than the bound.
    """
    plan = make_plan(logs, integration, box)
    if plan is None:
        return None
    with one_thread():
        evaluator = PoseEvaluator(plan)
    # Both ways give the same poses, up to the bound and rounding, at the box's centre and some corners.
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(3, *box.centre.shape))
    matrices = np.concatenate([box.centre[None], box.centre + signs * box.reach])
    direct, fast = odometry.poses(matrices), evaluator.poses(matrices)
    allowed = evaluator.error_bound + _ROUNDING * max(1.0, float(np.abs(direct).max()))
    return evaluator if fast.shape == direct.shape and np.abs(fast - direct).max() <= allowed else None


@dataclass(frozen=True, eq=False)
class RunsEvaluator:
    """Poses at the stamps of runs for matrices in a box, by the evaluators of parts of their logs.

    frame: of the box and of the matrices that are evaluated, where the parameterisation keeps directions.
    """

    parts: Sequence[PoseEvaluator]
    box: ElementBox
    frame: DrivenFrame | None

    @classmethod
    def of(
        cls, logs: Sequence[WheelLog], integration: Integration, searched: Parameterisation, lower: Array, upper: Array
    ) -> RunsEvaluator | None:
        """The evaluator for the matrices of vectors between ``lower`` and ``upper`` (n,).

        None where direct integration is faster.
        """
        frame = None
        if isinstance(searched, MatrixElements) and len(searched.null):
            signals = searched.null.shape[1]
            _, _, directions = np.linalg.svd(np.vstack([searched.null, np.zeros((signals, signals))]))
            frame = DrivenFrame(directions[len(searched.null) :], searched.robot.inverse_kinematic_matrix)
        box, parts = ElementBox.of(searched, lower, upper, frame), []
        for part in parts_of(logs):
            seen = part if frame is None else [frame.log(log) for log in part]
            evaluator = make_evaluator(OdometryBatch(seen, integration), seen, integration, box)
            if evaluator is None:
                return None
            parts.append(evaluator)
        return cls(parts, box, frame)

    @property
    def size(self) -> int:
        """Memory that is kept, bytes."""
        return sum(part.size for part in self.parts)

    def seen(self, matrices: Array) -> Array:
        """Matrices (P, 3, M) as they are evaluated: in the frame, (P, 3, r + 3), if there is one."""
        return matrices if self.frame is None else self.frame.seen(matrices)

    def covers(self, seen: Array) -> NDArray[np.bool_]:
        """True (P,) for the matrices that lie in the box."""
        return np.asarray(((seen >= self.box.lower) & (seen <= self.box.upper)).all(axis=(1, 2)))

    def poses(self, seen: Array) -> Array:
        """Poses (P, S, 3) of matrices in the box, see PoseEvaluator."""
        if len(self.parts) == 1:
            return self.parts[0].poses(seen)
        return np.concatenate([part.poses(seen) for part in self.parts], axis=1)
